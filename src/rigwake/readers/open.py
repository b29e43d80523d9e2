"""`open_recording`: any recording, whatever its format."""

from __future__ import annotations

from pathlib import Path

from rigwake.errors import InputError
from rigwake.readers.ros import recording_from_bag
from rigwake.readers.rosbag1 import MAGIC as ROSBAG1_MAGIC
from rigwake.readers.rosbag1 import index_rosbag1
from rigwake.readers.topics import TopicMap
from rigwake.recording import Recording


def open_recording(path: Path | str, topics: TopicMap | None = None) -> Recording:
    """Open a recording, recognised by its content.

    topics: which topic is which sensor, where the names do not say (ROS bags only). Images are not read.
    Raises InputError if the path is no recording, UsageError if `topics` names what is not there.
    """
    path = Path(path)
    if not path.exists():
        raise InputError(f"There is no {path}.", remedy="Check the path.")
    try:
        with path.open("rb") as file:
            start = file.read(64)
        if start.startswith(ROSBAG1_MAGIC):
            return recording_from_bag(path, index_rosbag1(path), topics or TopicMap())
    except OSError as error:
        raise InputError(f"{path} cannot be read: {error.strerror}.") from error
    raise InputError(f"{path} is not a recording that rigwake knows.")
