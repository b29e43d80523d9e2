"""`open_recording`: any recording, whatever its format."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from rigwake.errors import InputError
from rigwake.excerpt import longest_stretch
from rigwake.readers.channels import BagIndex
from rigwake.readers.clock_steps import on_one_clock
from rigwake.readers.euroc_folder import euroc_root, read_euroc
from rigwake.readers.folder import VIDEO_SUFFIXES, is_plain_folder, read_folder, read_video
from rigwake.readers.kitti import is_kitti_odometry, is_kitti_raw, read_kitti_odometry, read_kitti_raw
from rigwake.readers.lens_choice import with_chosen_lenses
from rigwake.readers.mcap_file import MAGIC as MCAP_MAGIC
from rigwake.readers.nmea import nmea_recording
from rigwake.readers.nmea_sentences import looks_like_nmea
from rigwake.readers.packed_files import packing_of, unpacked_file
from rigwake.readers.rig_description import description_beside, renamed, with_description
from rigwake.readers.ros_recording import recording_from_bag
from rigwake.readers.rosbag1 import MAGIC as ROSBAG1_MAGIC
from rigwake.readers.rosbag1 import index_rosbag1
from rigwake.readers.rosbag2 import (
    METADATA,
    SQLITE_MAGIC,
    index_rosbag2_folder,
    index_storage_file,
    is_rosbag2_folder,
)
from rigwake.readers.topics import TopicMap
from rigwake.recording import Finding, Recording
from rigwake.text_files import require_file

_START_BYTES = 65536
_BAGS: tuple[tuple[bytes, Callable[[Path], BagIndex]], ...] = (
    (ROSBAG1_MAGIC, index_rosbag1),
    (MCAP_MAGIC, index_storage_file),
    (SQLITE_MAGIC, index_storage_file),
)

_FOLDERS: tuple[tuple[Callable[[Path], object], Callable[[Path], Recording]], ...] = (
    (euroc_root, read_euroc),
    (is_kitti_odometry, read_kitti_odometry),
    (is_kitti_raw, read_kitti_raw),
    (is_plain_folder, read_folder),
)


def open_recording(path: Path | str, topics: TopicMap | None = None) -> Recording:
    """Open a recording, recognised by its content.

    topics: which topic is which sensor, where the names do not say (ROS bags only), and intrinsics that the user
    gives. A `rig.yaml` in a folder, or `NAME.rig.yaml` beside a file, tells lenses too. Images are not read.
    Raises InputError if the path is no recording, UsageError if `topics` names what is not there.
    """
    path, topics = Path(path), topics or TopicMap()
    recording = _read(path, topics)
    try:
        description = description_beside(euroc_root(path) or path if path.is_dir() else path)
        if description is not None:
            named = recording if topics.roles else renamed(recording, description)
            recording = with_description(named, description)
    except InputError as error:
        recording = replace(recording, findings=(*recording.findings, Finding("warning", "", error.cause)))
    return longest_stretch(on_one_clock(with_chosen_lenses(recording, topics.lenses)))


def _read(path: Path, topics: TopicMap) -> Recording:
    if "\0" in str(path):
        raise InputError("The path of the recording holds a NUL character.", remedy="Check the path.")
    try:
        if not path.exists():
            raise InputError(f"There is no {path}.", remedy="Check the path.")
        if not path.is_dir():
            require_file(path)
        bag = _bag_index(path)
        if bag is not None:
            return recording_from_bag(path, bag, topics)
        if path.is_dir():
            for recognised, read in _FOLDERS:
                if recognised(path):
                    return read(path)
            if is_rosbag2_folder(path):  # its recorder was killed before it wrote metadata.yaml
                return recording_from_bag(path, index_rosbag2_folder(path), topics)
        elif path.suffix.lower() in VIDEO_SUFFIXES:
            return read_video(path)
        else:
            with path.open("rb") as file:
                if looks_like_nmea(file.read(_START_BYTES)):
                    return nmea_recording(path)
    except OSError as error:
        raise InputError(f"{path!s:.200} cannot be read: {error.strerror}.") from error
    raise InputError(f"{path} is not a recording that rigwake knows.", remedy=_KNOWN)


_KNOWN = (
    "Known are ROS 1 bags, ROS 2 bags (sqlite3, MCAP), EuRoC/ASL and KITTI folders, folders of images or "
    "videos with csv files, single videos, and NMEA logs."
)


def _bag_index(path: Path) -> BagIndex | None:
    if path.is_dir():
        return index_rosbag2_folder(path) if (path / METADATA).is_file() else None
    problem = ""
    if packing_of(path) is not None:
        path, problem = unpacked_file(path)
    with path.open("rb") as file:
        start = file.read(_START_BYTES)
    for magic, index in _BAGS:
        if start.startswith(magic):
            bag = index(path)
            return replace(bag, findings=(Finding("error", "", problem), *bag.findings)) if problem else bag
    return None
