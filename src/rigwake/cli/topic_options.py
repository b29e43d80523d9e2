"""The options that say which topic is which sensor, the same for every verb that opens a recording.

def command(recording: Path, topic: TopicOption = (), topics: TopicsOption = None) -> None:
    opened = open_recording(recording, TopicMap.from_options(topic, topics))
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import typer

TopicOption = Annotated[
    Sequence[str],
    typer.Option(help="Which topic is which sensor: camera.front=/a/b, imu=/x, gnss=/y. May be repeated."),
]
TopicsOption = Annotated[
    Path | None, typer.Option(help="YAML file of the same: camera: {front: /a/b}, imu: /x.")
]
