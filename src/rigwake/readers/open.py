"""`open_recording`: any recording, whatever its format."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from rigwake.errors import InputError
from rigwake.readers.channels import BagIndex
from rigwake.readers.euroc_folder import euroc_root, read_euroc
from rigwake.readers.folder import is_plain_folder, read_folder
from rigwake.readers.kitti import is_kitti_odometry, is_kitti_raw, read_kitti_odometry, read_kitti_raw
from rigwake.readers.mcap_file import MAGIC as MCAP_MAGIC
from rigwake.readers.mcap_file import index_mcap
from rigwake.readers.nmea import nmea_recording
from rigwake.readers.nmea_sentences import looks_like_nmea
from rigwake.readers.ros_recording import recording_from_bag
from rigwake.readers.rosbag1 import MAGIC as ROSBAG1_MAGIC
from rigwake.readers.rosbag1 import index_rosbag1
from rigwake.readers.rosbag2 import METADATA, SQLITE_MAGIC, index_rosbag2_folder, index_sqlite
from rigwake.readers.topics import TopicMap
from rigwake.recording import Recording
from rigwake.text_files import require_file

_START_BYTES = 65536
_BAGS: tuple[tuple[bytes, Callable[[Path], BagIndex]], ...] = (
    (ROSBAG1_MAGIC, index_rosbag1),
    (MCAP_MAGIC, index_mcap),
    (SQLITE_MAGIC, index_sqlite),
)

_FOLDERS: tuple[tuple[Callable[[Path], object], Callable[[Path], Recording]], ...] = (
    (euroc_root, read_euroc),
    (is_kitti_odometry, read_kitti_odometry),
    (is_kitti_raw, read_kitti_raw),
    (is_plain_folder, read_folder),
)


def open_recording(path: Path | str, topics: TopicMap | None = None) -> Recording:
    """Open a recording, recognised by its content.

    topics: which topic is which sensor, where the names do not say (ROS bags only). Images are not read.
    Raises InputError if the path is no recording, UsageError if `topics` names what is not there.
    """
    path = Path(path)
    try:
        if not path.exists():
            raise InputError(f"There is no {path}.", remedy="Check the path.")
        if not path.is_dir():
            require_file(path)
        bag = _bag_index(path)
        if bag is not None:
            return recording_from_bag(path, bag, topics or TopicMap())
        if path.is_dir():
            for recognised, read in _FOLDERS:
                if recognised(path):
                    return read(path)
        else:
            with path.open("rb") as file:
                if looks_like_nmea(file.read(_START_BYTES)):
                    return nmea_recording(path)
    except (OSError, ValueError) as error:  # ValueError: a NUL in the path
        words = error.strerror if isinstance(error, OSError) else str(error)
        raise InputError(f"{path!s:.200} cannot be read: {words}.") from error
    raise InputError(f"{path} is not a recording that rigwake knows.", remedy=_KNOWN)


_KNOWN = (
    "Known are ROS 1 bags, ROS 2 bags (sqlite3, MCAP), EuRoC/ASL and KITTI folders, folders of images or "
    "videos with csv files, and NMEA logs."
)


def _bag_index(path: Path) -> BagIndex | None:
    if path.is_dir():
        return index_rosbag2_folder(path) if (path / METADATA).is_file() else None
    with path.open("rb") as file:
        start = file.read(_START_BYTES)
    for magic, index in _BAGS:
        if start.startswith(magic):
            return index(path)
    return None
