"""KITTI: odometry sequences (`image_0/`, `times.txt`, `calib.txt`) and raw drives (`image_00/data/`, `oxts/`)."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from rigwake._types import Array, Stamps
from rigwake.cameras.formats.camera_info import camera_from_info
from rigwake.errors import CameraError, InputError
from rigwake.geometry import so3
from rigwake.geometry.geodesy import enu_from_lla
from rigwake.geometry.se3 import SE3
from rigwake.readers.image_files import FileFrames, first_file_size, image_files
from rigwake.readers.rig_file import rigid_transform
from rigwake.readers.stamp_units import stamps_from_text
from rigwake.readers.streams import time_order, usable_rows
from rigwake.readers.trajectories import read_trajectory
from rigwake.recording import AttitudeStream, CameraStream, Finding, GnssStream, ImuStream, Recording
from rigwake.rig import Rig, RigCamera
from rigwake.text_files import read_text_file
from rigwake.trajectory import Trajectory

_NOMINAL_PERIOD_NS = 100_000_000
_MAX_TEXT_BYTES = 2**28
_OXTS_VALUES = 25
_LAT, _ROLL, _VN, _VE, _ACCEL, _VU, _GYRO, _POSITION_STD = 0, 3, 6, 7, 11, 10, 17, 23


def is_kitti_odometry(path: Path) -> bool:
    """A sequence folder: images in `image_0` ... with `calib.txt` or `times.txt` beside it."""
    has_images = any((path / f"image_{n}").is_dir() for n in range(4))
    return has_images and any((path / name).is_file() for name in ("calib.txt", "times.txt"))


def is_kitti_raw(path: Path) -> bool:
    """A drive folder: images in `image_00/data` ... or `oxts/data`, with timestamps."""
    return any((path / name / "timestamps.txt").is_file() for name in ("image_00", "image_02", "oxts"))


def read_kitti_odometry(path: Path) -> Recording:
    """Read a KITTI odometry sequence; `poses.txt` becomes the true trajectory of `image_0`.

    Raises InputError if no camera can be read.
    """
    findings: list[Finding] = []
    projections = _matrices(path / "calib.txt", findings)
    stamps = _odometry_stamps(path / "times.txt", findings)
    cameras, rig_cameras = {}, {}
    for folder in sorted(p for p in path.glob("image_[0-3]") if p.is_dir()):
        projection = projections.get(f"P{folder.name[-1]}")
        try:
            camera = _camera(folder.name, folder, stamps, projection, findings)
        except InputError as error:
            findings.append(Finding("error", folder.name, f"left out: {error.cause}"))
            continue
        cameras[folder.name] = camera
        if camera.model is not None and projection is not None:
            rig_cameras[folder.name] = RigCamera(folder.name, _first_from_rectified(projection), camera.model)
    if not cameras:
        raise InputError(f"No camera of the KITTI sequence {path} can be read.")
    return Recording(
        path,
        "kitti odometry",
        cameras,
        true_rig=Rig("image_0", rig_cameras) if len(rig_cameras) == len(cameras) else None,
        true_trajectories=_truth(path, findings),
        findings=tuple(findings),
    )


def _first_from_rectified(projection: Array) -> SE3:
    """Where a rectified camera sits in the frame of the first: `P = K [I | t]` maps its points by `x + t`."""
    return SE3(np.eye(3), np.asarray(-np.linalg.solve(projection[:, :3], projection[:, 3]), np.float64))


def _truth(path: Path, findings: list[Finding]) -> dict[str, Trajectory]:
    if not (path / "poses.txt").is_file():
        return {}
    try:
        times = path / "times.txt"
        file = read_trajectory(
            path / "poses.txt", name="image_0", file_format="kitti", times=times if times.is_file() else None
        )
    except InputError as error:
        findings.append(Finding("warning", "poses.txt", error.cause))
        return {}
    findings += file.findings
    return {"image_0": file.trajectory}


def _lines(path: Path) -> list[str]:
    return read_text_file(path, _MAX_TEXT_BYTES).splitlines()


def _matrices(path: Path, findings: list[Finding]) -> dict[str, Array]:
    """Matrices `NAME: numbers` of a calibration file, 12 numbers as (3, 4), 9 as (3, 3)."""
    try:
        lines = _lines(path)
    except InputError as error:
        findings.append(Finding("warning", "", f"no calibration: {error.cause}"))
        return {}
    matrices = {}
    for line in lines:
        name, _, text = line.partition(":")
        try:
            values = np.array(text.split(), dtype=np.float64)
        except ValueError:
            continue  # dates and the like
        if values.size in (3, 9, 12) and np.isfinite(values).all():
            matrices[name.strip()] = values if values.size == 3 else values.reshape(3, -1)
    return matrices


def _odometry_stamps(path: Path, findings: list[Finding]) -> Stamps | None:
    try:
        return stamps_from_text([line for line in _lines(path) if line.strip()], "s")
    except InputError:
        findings.append(Finding("warning", "", "no times.txt: 10 Hz is assumed."))
        return None


def _camera(
    name: str, folder: Path, stamps: Stamps | None, projection: Array | None, findings: list[Finding]
) -> CameraStream:
    files = image_files(folder)
    size = first_file_size(files)
    if stamps is None:
        stamps = np.arange(len(files), dtype=np.int64) * _NOMINAL_PERIOD_NS
    if len(stamps) != len(files):
        message = f"{len(files)} images but {len(stamps)} times; the first of both are used."
        findings.append(Finding("warning", name, message))
    count = min(len(files), len(stamps))
    rows = np.flatnonzero(stamps[:count] >= 0)
    order, repaired = time_order(name, stamps[rows])
    rows = rows[order]
    findings += repaired
    source = FileFrames(folder, tuple(files[row].name for row in rows), stamps[rows], size)
    model = None
    if projection is None:
        findings.append(Finding("warning", name, "no projection matrix: intrinsics must be given."))
    else:
        try:
            model = camera_from_info("", [], projection[:, :3], *size)
        except CameraError as error:
            findings.append(Finding("warning", name, error.cause))
    return CameraStream(name, stamps[rows], source, *size, model, name)


def read_kitti_raw(path: Path) -> Recording:
    """Read a drive of KITTI raw (synchronised and rectified): cameras, and OXTS as IMU, GNSS and attitude.

    The calibration files are looked for here and in the folder above. Raises InputError if nothing can be read.
    """
    findings: list[Finding] = []
    calibration = {
        name: _matrices(_calibration_file(path, f"calib_{name}.txt"), findings)
        for name in ("cam_to_cam", "velo_to_cam", "imu_to_velo")
    }
    cameras: dict[str, CameraStream] = {}
    for folder in sorted(p for p in path.glob("image_0[0-3]") if p.is_dir()):
        projection = calibration["cam_to_cam"].get(f"P_rect_{folder.name[-2:]}")
        try:
            stamps = _text_stamps(folder / "timestamps.txt")
            cameras[folder.name] = _camera(folder.name, folder / "data", stamps, projection, findings)
        except (InputError, OSError) as error:
            findings.append(Finding("error", folder.name, f"left out: {error}"))
    imus, gnss, attitudes = {}, {}, {}
    if (path / "oxts").is_dir():
        try:
            imus["oxts"], gnss["oxts"], attitudes["oxts"] = _oxts(path / "oxts", findings)
        except (InputError, OSError) as error:
            findings.append(Finding("error", "oxts", f"left out: {error}"))
    if not cameras and not imus:
        raise InputError(f"No sensor of the KITTI drive {path} can be read.")
    return Recording(
        path,
        "kitti raw",
        cameras,
        imus,
        gnss,
        attitudes,
        true_rig=_raw_rig(cameras, calibration),
        findings=tuple(findings),
    )


def _calibration_file(path: Path, name: str) -> Path:
    return path / name if (path / name).is_file() else path.parent / name


def _text_stamps(path: Path) -> Stamps:
    """`2011-09-26 13:02:25.964389445` per line; unreadable ones are -1."""
    stamps = []
    for line in _lines(path):
        match = re.fullmatch(r"(\d{4}-\d\d-\d\d \d\d:\d\d:\d\d)(?:\.(\d{1,9}))?", line.strip())
        if match is None:
            stamps.append(-1)
            continue
        try:
            whole = datetime.fromisoformat(match[1]).replace(tzinfo=UTC)
        except ValueError:
            stamps.append(-1)
            continue
        stamps.append(int(whole.timestamp()) * 10**9 + int((match[2] or "0").ljust(9, "0")))
    return np.array(stamps, dtype=np.int64)


def _oxts(folder: Path, findings: list[Finding]) -> tuple[ImuStream, GnssStream, AttitudeStream]:
    files = sorted((folder / "data").glob("*.txt"))
    stamps = _text_stamps(folder / "timestamps.txt")
    count = min(len(files), len(stamps))
    values = np.array([_oxts_values(file) for file in files[:count]]).reshape(-1, _OXTS_VALUES)
    values[stamps[:count] < 0] = np.nan
    rows, repaired = usable_rows("oxts", stamps[:count], values)
    findings += repaired
    if not len(rows):
        raise InputError("there is no readable packet.")
    stamps, values = stamps[rows], values[rows]
    lla = values[:, _LAT : _LAT + 3]
    origin = (float(lla[0, 0]), float(lla[0, 1]), float(lla[0, 2]))
    spread = np.maximum(values[:, _POSITION_STD], 1e-3) ** 2
    gnss = GnssStream(
        "oxts",
        stamps,
        enu_from_lla(lla, origin),
        spread[:, None, None] * np.eye(3),
        origin,
        values[:, [_VE, _VN, _VU]],
        "oxts",
    )
    imu = ImuStream("oxts", stamps, values[:, _GYRO : _GYRO + 3], values[:, _ACCEL : _ACCEL + 3], "oxts")
    return imu, gnss, AttitudeStream("oxts", stamps, *_oxts_attitude(values), "oxts")


def _oxts_values(file: Path) -> Sequence[float]:
    try:
        values = [float(cell) for cell in _lines(file)[0].split()[:_OXTS_VALUES]]
    except (ValueError, IndexError, InputError):
        values = []
    return values if len(values) == _OXTS_VALUES else [float("nan")] * _OXTS_VALUES


def _oxts_attitude(values: Array) -> tuple[Array, Array]:
    """`Rz(yaw) Ry(pitch) Rx(roll)`, yaw 0 = east, counter-clockwise; OXTS states 0.03 deg, 0.1 in heading."""
    roll, pitch, yaw = (np.outer(values[:, _ROLL + k], np.eye(3)[k]) for k in range(3))
    rotations = so3.exp(yaw) @ so3.exp(pitch) @ so3.exp(roll)
    std = np.radians([0.03, 0.03, 0.1])
    return rotations, np.broadcast_to(np.diag(std**2), rotations.shape).copy()


def _raw_rig(cameras: Mapping[str, CameraStream], calibration: Mapping[str, dict[str, Array]]) -> Rig | None:
    """Rig with the IMU as reference: `x_rect0 = R_rect_00 * velo_to_cam * imu_to_velo * x_imu`."""
    cam, velo, imu = (calibration[n] for n in ("cam_to_cam", "velo_to_cam", "imu_to_velo"))
    if not cameras or "R_rect_00" not in cam or not {"R", "T"} <= velo.keys() & imu.keys():
        return None
    try:
        links = [rigid_transform(np.column_stack([m["R"], m["T"]]), "velodyne") for m in (velo, imu)]
        rectified = rigid_transform(np.column_stack([cam["R_rect_00"], np.zeros(3)]), "R_rect_00")
    except (InputError, ValueError):
        return None
    imu_from_rect0 = (rectified * links[0] * links[1]).inverse()
    rig_cameras = {}
    for name, camera in cameras.items():
        projection = cam.get(f"P_rect_{name[-2:]}")
        if projection is None or camera.model is None:
            return None
        rig_from_cam = imu_from_rect0 * _first_from_rectified(projection)
        rig_cameras[name] = RigCamera(name, rig_from_cam, camera.model)
    return Rig("oxts", rig_cameras, rig_from_imu=SE3.identity())
