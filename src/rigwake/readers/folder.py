"""A plain folder: images or a video per camera, with csv files beside them. The layout is in docs/recordings.md."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from rigwake._types import Stamps
from rigwake.cameras.protocol import CameraModel
from rigwake.errors import InputError
from rigwake.readers.csv_sensors import read_attitude_csv, read_gnss_csv, read_imu_csv
from rigwake.readers.csv_tables import read_table, stamps_from_text
from rigwake.readers.image_files import (
    IMAGE_SUFFIXES,
    VIDEO_SUFFIXES,
    FileFrames,
    VideoFrames,
    first_file_size,
    image_files,
    index_video,
)
from rigwake.readers.nmea import read_nmea
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

_NOMINAL_PERIOD_NS = 100_000_000
_STAMP_DIGITS = 16  # a file name of so many digits is a stamp in microseconds or nanoseconds
_TABLES = ("imu", "gnss", "attitude")


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
    """`imu` for `imu.csv`, `imu_port.csv` and so on."""
    name = path.stem.split("_")[0] if path.suffix == ".csv" else ""
    return name if name in _TABLES else None


def read_folder(path: Path) -> Recording:
    """Read a plain folder. Raises InputError if no sensor of it can be read."""
    found = _FolderStreams(path)
    if (path / "rig.yaml").is_file():
        found.models, found.rig = read_rig_file(path / "rig.yaml")
    flat = [path] if image_files(path) else []
    for entry in [*flat, *sorted(path.iterdir())]:
        add = _adder(entry)
        if add is None:
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


def _adder(entry: Path) -> Callable[[Path, _FolderStreams], None] | None:
    suffix = entry.suffix.lower()
    if entry.is_dir():
        return _add_images if image_files(entry) else None
    if suffix in VIDEO_SUFFIXES:
        return _add_video
    return _add_nmea if suffix == ".nmea" else _ADD_TABLE.get(_table_of(entry) or "")


def _add_images(folder: Path, found: _FolderStreams) -> None:
    name = "camera" if folder == found.root else folder.name
    listed = folder / "timestamps.csv"
    shared = found.root / "timestamps.csv"
    if listed.is_file() or shared.is_file():
        names, stamps = _listed(listed if listed.is_file() else shared, name, folder, found.findings)
    else:
        names, stamps = _unlisted(name, folder, found.findings)
    order, repaired = time_order(name, stamps)
    chosen, stamps = tuple(names[at] for at in order), stamps[order]
    size = first_file_size([folder / file for file in chosen])
    found.findings += repaired
    _add_camera(name, FileFrames(folder, chosen, stamps, size), size, stamps, found)


def _listed(table_path: Path, name: str, folder: Path, findings: list[Finding]) -> tuple[list[str], Stamps]:
    """Frames by a table `timestamp, filename` (and `camera`, where it serves several)."""
    table = read_table(table_path)
    stamps = table.stamps_ns()
    column = table.find("filename", "file", "image", "frame")
    if column is None:
        raise InputError(f"{table_path} lacks a column filename.")
    cameras = table.columns.get("camera", [name] * len(stamps))
    rows = [row for row, camera in enumerate(cameras) if camera == name]
    files = [Path(table.columns[column][row].replace("\0", "")).name for row in rows]
    kept = [at for at, row in enumerate(rows) if stamps[row] >= 0 and (folder / files[at]).is_file()]
    kept = [at for at in kept if Path(files[at]).suffix.lower() in IMAGE_SUFFIXES]
    if len(kept) < len(rows) or table.dropped_rows:
        message = f"{len(rows)} frames listed, {len(kept)} usable; the rest is left out."
        findings.append(Finding("warning", name, message))
    return [files[at] for at in kept], stamps[[rows[at] for at in kept]]


def _unlisted(name: str, folder: Path, findings: list[Finding]) -> tuple[list[str], Stamps]:
    files = image_files(folder)
    if all(file.stem.isascii() and file.stem.isdigit() and len(file.stem) >= _STAMP_DIGITS for file in files):
        return [file.name for file in files], stamps_from_text([file.stem for file in files])
    findings.append(Finding("warning", name, "no timestamps.csv: 10 Hz is assumed."))
    return [file.name for file in files], np.arange(len(files), dtype=np.int64) * _NOMINAL_PERIOD_NS


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
    index = index_video(path)
    stamps = index.stamps_ns()
    listed = path.with_name(f"{path.stem}_timestamps.csv")
    if listed.is_file():
        given = read_table(listed).stamps_ns()
        if len(given) != len(stamps):
            raise InputError(f"{listed.name} has {len(given)} rows, the video {len(stamps)} frames.")
        stamps = given
    else:
        message = "a video without a table of stamps has its own clock, from 0 at its first frame."
        found.findings.append(Finding("warning", path.stem, message))
    order, repaired = time_order(path.stem, stamps)
    found.findings += repaired
    index = replace(index, ticks=tuple(index.ticks[at] for at in order))
    _add_camera(path.stem, VideoFrames(path, index, stamps[order]), index.size, stamps[order], found)


def _add_imu(path: Path, found: _FolderStreams) -> None:
    found.imus[path.stem], findings = read_imu_csv(path, path.stem)
    found.findings += findings


def _add_gnss(path: Path, found: _FolderStreams) -> None:
    found.gnss[path.stem], findings = read_gnss_csv(path, path.stem)
    found.findings += findings


def _add_attitude(path: Path, found: _FolderStreams) -> None:
    found.attitudes[path.stem], findings = read_attitude_csv(path, path.stem)
    found.findings += findings


_ADD_TABLE: dict[str, Callable[[Path, _FolderStreams], None]] = {
    "imu": _add_imu,
    "gnss": _add_gnss,
    "attitude": _add_attitude,
}


def _add_nmea(path: Path, found: _FolderStreams) -> None:
    found.gnss[path.stem], attitude, findings = read_nmea(path, path.stem)
    if attitude is not None:
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
