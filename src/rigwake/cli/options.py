"""Options that several verbs share.

def command(recording: Path, topic: TopicOption = (), topics: TopicsOption = None) -> None:
    opened = open_recording(recording, TopicMap.from_options(topic, topics))
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import typer

from rigwake.errors import UsageError

TopicOption = Annotated[
    Sequence[str],
    typer.Option(
        metavar="SENSOR=TOPIC",
        help="Which topic is which sensor: camera.front=/a/b, imu=/x, gnss=/y. May be repeated.",
    ),
]
TopicsOption = Annotated[
    Path | None, typer.Option(help="YAML file of the same: camera: {front: /a/b}, imu: /x.")
]
JsonOption = Annotated[Path | None, typer.Option("--json", help="Write the result as JSON ('-': print).")]


def require(option: str, value: str, known: Sequence[str]) -> None:
    """UsageError, with the words to choose from, for a value that an option does not know."""
    if value not in known:
        raise UsageError(f"{option} {value!r} is unknown.", remedy=f"Choose from {', '.join(known)}.")
