"""`write_recording`: a recording in any format that rigwake writes."""

from __future__ import annotations

from pathlib import Path
from typing import Literal, get_args

from rigwake.errors import UsageError
from rigwake.recording import Finding, Recording
from rigwake.writers.encoded_images import ImageEncoding
from rigwake.writers.euroc_writer import write_euroc
from rigwake.writers.folders import write_folder
from rigwake.writers.rosbag import write_rosbag1, write_rosbag2

RecordingFormat = Literal["ros1", "ros2", "mcap", "euroc", "folder"]


def format_of_path(path: Path) -> RecordingFormat:
    """`.bag` is a ROS 1 bag, `.mcap` a ROS 2 MCAP file, anything else a plain folder."""
    formats: dict[str, RecordingFormat] = {".bag": "ros1", ".mcap": "mcap"}
    return formats.get(path.suffix, "folder")


def write_recording(
    recording: Recording,
    path: Path | str,
    *,
    file_format: RecordingFormat | None = None,
    image_encoding: ImageEncoding = "jpeg",
) -> tuple[Finding, ...]:
    """Write a recording, streaming its images; it is whole or not there.

    file_format: `ros1` (bag), `ros2` (folder with sqlite3), `mcap` (a file if the path ends in `.mcap`, else
    a ROS 2 folder), `euroc`, `folder`; by default as the path's suffix says. image_encoding: `jpeg` loses a
    little, `png` and `raw` nothing; folders cannot hold `raw`. Images that are stored so already are handed on as
    they are; `copy` hands on every JPEG and PNG and encodes others as JPEG. EuRoC folders hold PNG unless `copy` is
    asked for. Returns findings about what the format cannot hold. Raises UsageError for an unknown format or a
    path that is in the way.
    """
    path = Path(path)
    chosen = file_format or format_of_path(path)
    if image_encoding not in get_args(ImageEncoding):
        raise UsageError(
            f"Image encoding {image_encoding!r} is not one of {', '.join(get_args(ImageEncoding))}."
        )
    match chosen:
        case "ros1":
            return write_rosbag1(recording, path, image_encoding)
        case "ros2":
            return write_rosbag2(recording, path, image_encoding, "sqlite3")
        case "mcap":
            return write_rosbag2(recording, path, image_encoding, "mcap")
        case "euroc":
            return write_euroc(recording, path, "copy" if image_encoding == "copy" else "png")
        case "folder":
            return write_folder(recording, path, image_encoding)
    raise UsageError(
        f"{chosen!r} is no format of recordings.", remedy=f"Choose one of {get_args(RecordingFormat)}."
    )
