"""A plain folder: images or a video per camera, with csv files beside them. The layout is in docs/recordings.md."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

from rigwake._types import Stamps
from rigwake.cameras.formats.camera_files import read_cameras
from rigwake.cameras.protocol import CameraModel
from rigwake.errors import CameraError, InputError
from rigwake.extras import require_extra
from rigwake.readers.csv_sensors import read_attitude_csv, read_gnss_csv, read_imu_csv
from rigwake.readers.frame_lists import LIST_ENDINGS, frames_of_folder, read_frame_list
from rigwake.readers.image_files import file_frames, image_files
from rigwake.readers.images import ImageSize
from rigwake.readers.nmea import read_nmea
from rigwake.readers.nmea_sentences import looks_like_nmea
from rigwake.readers.picture_files import swaps_sides
from rigwake.readers.rig_file import read_rig_file
from rigwake.readers.streams import time_order
from rigwake.readers.trajectories import read_trajectory
from rigwake.recording import (
    AttitudeStream,
    CameraStream,
    Finding,
    FrameSource,
    GnssStream,
    ImuStream,
    Recording,
)
from rigwake.rig import Rig
from rigwake.trajectory import Trajectory

VIDEO_SUFFIXES = frozenset(
    {".mp4", ".avi", ".mkv", ".mov", ".webm", ".m4v", ".ts", ".mts", ".m2ts", ".mpg", ".mpeg", ".wmv", ".3gp"}
)
_TABLES = {"imu": "imu", "gnss": "gnss", "gps": "gnss", "attitude": "attitude"}
_TABLE_NAME = re.compile(r"(imu|gnss|gps|attitude)\d*(?:[_-].*)?")
_TABLE_SUFFIXES = (".csv", ".txt", ".tsv", ".dat")
_LOG_SUFFIXES = (".nmea", ".log", ".ubx", ".txt", ".dat", ".nma")
_LENS_FILES = ("rig.yaml", "cameras.yaml", "intrinsics.yaml", "camchain.yaml", "calibration.yaml", "rig.yml")
_START_BYTES = 65536


@dataclass
class _FolderStreams:
    root: Path
    models: Mapping[str, CameraModel] = field(default_factory=dict)
    rig: Rig | None = None
    cameras: dict[str, CameraStream] = field(default_factory=dict)
    imus: dict[str, ImuStream] = field(default_factory=dict)
    gnss: dict[str, GnssStream] = field(default_factory=dict)
    attitudes: dict[str, AttitudeStream] = field(default_factory=dict)
    findings: list[Finding] = field(default_factory=list)


def is_plain_folder(path: Path) -> bool:
    """Whether the folder holds images, videos, or csv or NMEA files of known names."""
    return bool(image_files(path)) or any(_adder(entry) for entry in path.iterdir())


def _table_of(path: Path) -> str | None:
    """`imu` for `imu.csv`, `imu0.csv`, `imu_port.csv` and so on."""
    found = _TABLE_NAME.fullmatch(path.stem.lower()) if path.suffix.lower() in _TABLE_SUFFIXES else None
    return _TABLES[found[1]] if found is not None else None


def read_folder(path: Path) -> Recording:
    """Read a plain folder. Raises InputError if no sensor of it can be read."""
    found = _FolderStreams(path)
    _find_lenses(found)
    flat = [path] if image_files(path) else []
    for entry in [*flat, *sorted(path.iterdir())]:
        add = _adder(entry)
        if add is None:
            _mention(entry, found)
            continue
        try:
            add(entry, found)
        except InputError as error:
            found.findings.append(Finding("error", entry.stem, f"left out: {error.cause}"))
    if not (found.cameras or found.imus or found.gnss):
        causes = " ".join(finding.message for finding in found.findings)
        raise InputError(f"No sensor of the folder {path} can be read. {causes}")
    return Recording(
        path,
        "folder",
        found.cameras,
        found.imus,
        found.gnss,
        found.attitudes,
        poses=read_trajectory_folder(path / "poses", found.findings),
        true_rig=found.rig,
        true_trajectories=read_trajectory_folder(path / "truth", found.findings),
        findings=tuple(found.findings),
    )


def read_video(path: Path) -> Recording:
    """A video alone, with the lens of a camera file beside it. Raises InputError if it cannot be read."""
    found = _FolderStreams(path.parent)
    _find_lenses(found)
    _add_video(path, found)
    return Recording(path, "video", found.cameras, findings=tuple(found.findings))


def _find_lenses(found: _FolderStreams) -> None:
    """Lenses, and the rig where it is known, of `rig.yaml` or of any camera file of the usual names."""
    path = next((found.root / name for name in _LENS_FILES if (found.root / name).is_file()), None)
    if path is None:
        return
    if path.stem == "rig":
        try:
            found.models, found.rig = read_rig_file(path)
        except InputError as error:
            found.models = _lenses(path)
            if not found.models:
                raise error from None
        if found.models or found.rig:
            return
    found.models = _lenses(path)
    if not found.models:
        found.findings.append(Finding("warning", "", f"{path.name} holds no lens that is known here."))


def _lenses(path: Path) -> dict[str, CameraModel]:
    try:
        return read_cameras(path)
    except (InputError, CameraError):
        return {}


def _mention(entry: Path, found: _FolderStreams) -> None:
    """A note for tables that are read as no sensor, so that nothing is lost without a word."""
    is_list = entry.name in ("timestamps.csv", "times.csv") or entry.stem.endswith("_timestamps")
    is_of_camera = (entry.parent / entry.stem).is_dir()
    if entry.is_file() and entry.suffix.lower() == ".csv" and not is_list and not is_of_camera:
        message = f"{entry.name} is not read: name it imu.csv, gnss.csv or attitude.csv if it is one."
        found.findings.append(Finding("note", entry.stem, message))


def _adder(entry: Path) -> Callable[[Path, _FolderStreams], None] | None:
    suffix = entry.suffix.lower()
    if entry.is_dir():
        kind = _table_of(entry / f"{entry.name}.csv")
        if kind is not None and (entry / "data.csv").is_file():  # as in EuRoC
            return lambda folder, found: _ADD_TABLE[kind](folder / "data.csv", found)
        return _add_images if image_files(entry) else None
    if not entry.is_file():
        return None
    if suffix in VIDEO_SUFFIXES:
        return _add_video
    if suffix in _LOG_SUFFIXES and (suffix == ".nmea" or _holds_nmea(entry)):
        return _add_nmea
    return _ADD_TABLE.get(_table_of(entry) or "")


def _holds_nmea(entry: Path) -> bool:
    try:
        with entry.open("rb") as file:
            return looks_like_nmea(file.read(_START_BYTES))
    except OSError:
        return False


def _free_name(entry: Path, taken: Mapping[str, object], found: _FolderStreams) -> str:
    """The stem of a file or folder; where another sensor has it, the suffix is added, and that is said."""
    name = entry.stem if entry.is_file() else entry.name
    name = entry.parent.name if name == "data" and entry.parent != found.root else name
    if name not in taken:
        return name
    longer = f"{name}_{entry.suffix.lstrip('.').lower() or 'folder'}"
    while longer in taken:
        longer += "_"
    message = f"{entry.name} has the name of another sensor: it is called {longer}."
    found.findings.append(Finding("note", longer, message))
    return longer


def _add_images(folder: Path, found: _FolderStreams) -> None:
    name = "camera" if folder == found.root else _free_name(folder, found.cameras, found)
    files, stamps = frames_of_folder(folder, found.root, name, found.findings)
    order, repaired = time_order(name, stamps)
    chosen, stamps = tuple(files[at] for at in order), stamps[order]
    source, orientation = file_frames(folder, chosen, stamps)
    size = source.size
    found.findings += repaired
    if orientation > 1:
        turned = ImageSize(size.height_px, size.width_px)
        upright = swaps_sides(orientation) and _fits(found, name, turned) and not _fits(found, name, size)
        if upright:
            source, size = replace(source, size=turned, upright=True), turned
        _say_turned(found, name, f"EXIF orientation {orientation}", upright)
    _add_camera(name, source, size, stamps, found)


def _fits(found: _FolderStreams, name: str, size: ImageSize) -> bool:
    model = found.models.get(name)
    return model is not None and (model.width_px, model.height_px) == tuple(size)


def _say_turned(found: _FolderStreams, name: str, flag: str, turned: bool) -> None:
    done = "turned so, since the intrinsics are of that size" if turned else "read as stored, not turned"
    message = (
        f"the files ask viewers to turn them ({flag}): {done}. Intrinsics must be of the images as read."
    )
    found.findings.append(Finding("note" if turned else "warning", name, message))


def _add_camera(
    name: str, source: FrameSource, size: tuple[int, int], stamps: Stamps, found: _FolderStreams
) -> None:
    model = found.models.get(name)
    if model is not None and (model.width_px, model.height_px) != tuple(size):
        message = (
            f"rig.yaml is for {model.width_px} x {model.height_px} pixels, images are {size[0]} x {size[1]}: "
            "its intrinsics are not used."
        )
        found.findings.append(Finding("error", name, message))
        model = None
    elif model is None:
        found.findings.append(Finding("warning", name, "no intrinsics in rig.yaml: they must be given."))
    found.cameras[name] = CameraStream(name, stamps, source, *size, model, name)


def _add_video(path: Path, found: _FolderStreams) -> None:
    require_extra("av", "video", f"Reading {path.name}")
    from rigwake.readers.video_files import VideoFrames, index_video

    name = _free_name(path, found.cameras, found)
    index = index_video(path)
    stamps = index.stamps_ns()
    if index.missing:
        found.findings.append(Finding("error", name, f"{path.name} is cut off: {index.missing}."))
    names = [f"{path.stem}{ending}" for ending in LIST_ENDINGS]
    listed = next((path.with_name(file) for file in names if path.with_name(file).is_file()), None)
    frames = None if listed is None else read_frame_list(listed)
    if frames is not None and listed is not None:
        if len(frames.stamps) != len(stamps):
            raise InputError(f"{listed.name} has {len(frames.stamps)} rows, the video {len(stamps)} frames.")
        stamps = frames.stamps
    else:
        message = "a video without a table of stamps has its own clock, from 0 at its first frame."
        found.findings.append(Finding("warning", name, message))
    order, repaired = time_order(name, stamps)
    found.findings += repaired
    index = replace(index, ticks=tuple(index.ticks[at] for at in order))
    size, turned_deg = index.size, 0
    if index.rotation_deg:
        swapped = ImageSize(size.height_px, size.width_px)
        quarter = index.rotation_deg in (90, 270)
        if quarter and _fits(found, name, swapped) and not _fits(found, name, size):
            size, turned_deg = swapped, index.rotation_deg
        _say_turned(found, name, f"rotation by {index.rotation_deg} deg", bool(turned_deg))
    _add_camera(name, VideoFrames(path, index, stamps[order], turned_deg), size, stamps[order], found)


def _add_imu(path: Path, found: _FolderStreams) -> None:
    name = _free_name(path, found.imus, found)
    found.imus[name], findings = read_imu_csv(path, name)
    found.findings += findings


def _add_gnss(path: Path, found: _FolderStreams) -> None:
    name = _free_name(path, found.gnss, found)
    found.gnss[name], findings = read_gnss_csv(path, name)
    found.findings += findings


def _add_attitude(path: Path, found: _FolderStreams) -> None:
    name = _free_name(path, found.attitudes, found)
    found.attitudes[name], findings = read_attitude_csv(path, name)
    found.findings += findings


_ADD_TABLE: dict[str, Callable[[Path, _FolderStreams], None]] = {
    "imu": _add_imu,
    "gnss": _add_gnss,
    "attitude": _add_attitude,
}


def _add_nmea(path: Path, found: _FolderStreams) -> None:
    name = _free_name(path, found.gnss, found)
    found.gnss[name], attitude, findings = read_nmea(path, name)
    if attitude is not None:
        taken = attitude.name in found.attitudes
        attitude = replace(attitude, name=f"{attitude.name}_{name}") if taken else attitude
        found.attitudes[attitude.name] = attitude
    found.findings += findings


def read_trajectory_folder(folder: Path, findings: list[Finding]) -> dict[str, Trajectory]:
    """All TUM files of a folder by name; what cannot be read is added to `findings`."""
    trajectories = {}
    for path in sorted(folder.glob("*.tum")) if folder.is_dir() else []:
        try:
            file = read_trajectory(path)
        except InputError as error:
            findings.append(Finding("warning", path.stem, error.cause))
            continue
        findings += file.findings
        trajectories[file.trajectory.name] = file.trajectory
    return trajectories
