"""EuRoC / ASL folders (`mav0/cam0/data.csv`, ...), also as TUM-VI writes them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from rigwake.cameras.formats.camera_info import camera_from_info
from rigwake.cameras.protocol import CameraModel
from rigwake.cameras.registry import camera_from_params
from rigwake.errors import CameraError, InputError
from rigwake.geometry.se3 import SE3
from rigwake.readers.csv_sensors import read_attitude_csv, read_gnss_csv, read_imu_csv
from rigwake.readers.csv_tables import read_table
from rigwake.readers.folder import read_trajectory_folder
from rigwake.readers.image_files import FileFrames, first_file_size
from rigwake.readers.images import ImageSize
from rigwake.readers.rig_file import rigid_transform
from rigwake.readers.streams import time_order
from rigwake.readers.trajectories import read_trajectory
from rigwake.recording import AttitudeStream, CameraStream, Finding, GnssStream, ImuStream, Recording
from rigwake.rig import Rig, RigCamera
from rigwake.trajectory import Trajectory
from rigwake.yaml_input import read_yaml_settings

_TRUTH_FOLDERS = ("state_groundtruth_estimate0",)
_POSE_FOLDERS = ("vicon0", "mocap0")
_ROS_DISTORTIONS = {"radial-tangential": "plumb_bob", "radtan": "plumb_bob", "equidistant": "equidistant"}


@dataclass
class _EurocStreams:
    cameras: dict[str, CameraStream] = field(default_factory=dict)
    rig_cameras: dict[str, RigCamera] = field(default_factory=dict)
    imus: dict[str, ImuStream] = field(default_factory=dict)
    gnss: dict[str, GnssStream] = field(default_factory=dict)
    attitudes: dict[str, AttitudeStream] = field(default_factory=dict)
    rig_from_imu: SE3 | None = None
    findings: list[Finding] = field(default_factory=list)


def euroc_root(path: Path) -> Path | None:
    """The folder that holds `cam0/` or `imu0/` (itself, or its `mav0`), if this is an ASL folder."""
    for root in (path / "mav0", path):
        if any((root / sensor / "data.csv").is_file() for sensor in ("cam0", "cam1", "imu0")):
            return root
    return None


def read_euroc(path: Path) -> Recording:
    """Read an ASL folder. The published extrinsics (`T_BS`) become the true rig, the truth a trajectory.

    Raises InputError if no sensor of it can be read.
    """
    root = euroc_root(path)
    if root is None:
        raise InputError(f"{path} is not an EuRoC / ASL folder.")
    found = _EurocStreams()
    kalibr = _kalibr_chain(root.parent / "dso" / "camchain.yaml", found)
    for folder in sorted(p for p in root.iterdir() if p.is_dir()):
        try:
            if folder.name.startswith("cam"):
                _add_camera(folder, kalibr.get(folder.name), found)
            elif folder.name.startswith("imu"):
                _add_imu(folder, found)
            else:
                _add_own(folder, found)
        except InputError as error:
            found.findings.append(Finding("error", folder.name, f"left out: {error.cause}"))
    if not found.cameras and not found.imus:
        causes = " ".join(finding.message for finding in found.findings)
        raise InputError(f"No sensor of the EuRoC folder {path} can be read. {causes}")
    has_rig = bool(found.rig_cameras) and found.rig_cameras.keys() == found.cameras.keys()
    return Recording(
        path,
        "euroc folder",
        found.cameras,
        found.imus,
        found.gnss,
        found.attitudes,
        poses=_trajectories(root, _POSE_FOLDERS, found.findings)
        | read_trajectory_folder(root / "poses", found.findings),
        true_rig=Rig("body", found.rig_cameras, rig_from_imu=found.rig_from_imu) if has_rig else None,
        true_trajectories=_trajectories(root, _TRUTH_FOLDERS, found.findings)
        | read_trajectory_folder(root / "truth", found.findings),
        findings=tuple(found.findings),
    )


def _kalibr_chain(path: Path, found: _EurocStreams) -> dict[str, Mapping[str, Any]]:
    if not path.is_file():
        return {}
    try:
        return {str(n): entry for n, entry in read_yaml_settings(path).items() if isinstance(entry, dict)}
    except InputError as error:
        found.findings.append(Finding("warning", "", error.cause))
        return {}


def _add_camera(folder: Path, kalibr: Mapping[str, Any] | None, found: _EurocStreams) -> None:
    name = folder.name
    table = read_table(folder / "data.csv", names=("timestamp", "filename"))
    stamps = table.stamps_ns()
    file_column = table.find("filename", "file", "image", *[c for c in table.columns if c != "timestamp"])
    if file_column is None:
        raise InputError(f"{table.path} names no image files.")
    files = table.columns[file_column]
    rows = [row for row, file in enumerate(files) if stamps[row] >= 0 and _is_plain_name(file)]
    order, repaired = time_order(name, stamps[rows])
    rows = [rows[at] for at in order]
    present = [row for row in rows if (folder / "data" / files[row]).is_file()]
    if len(present) < len(files):
        message = f"{len(files)} frames listed, {len(present)} there; the rest is left out."
        repaired.append(Finding("warning", name, message))
    paths = [folder / "data" / files[row] for row in present]
    size = first_file_size(paths)
    found.findings += repaired
    source = FileFrames(folder / "data", tuple(files[row] for row in present), stamps[present], size)
    model, body_from_cam = _camera_settings(folder, kalibr, size, found)
    found.cameras[name] = CameraStream(name, stamps[present], source, *size, model, name, name)
    if body_from_cam is not None:
        found.rig_cameras[name] = RigCamera(name, body_from_cam, model)


def _is_plain_name(file: str) -> bool:
    return bool(file) and "\0" not in file and Path(file).name == file


def _camera_settings(
    folder: Path, kalibr: Mapping[str, Any] | None, size: ImageSize, found: _EurocStreams
) -> tuple[CameraModel | None, SE3 | None]:
    name = folder.name
    try:
        if (folder / "sensor.yaml").is_file():
            settings = read_yaml_settings(folder / "sensor.yaml")
            body_from_cam = _matrix(settings.get("T_BS"), f"{name}: T_BS")
            coefficients = settings.get("distortion_coefficients", [])
        elif kalibr is not None:
            settings = dict(kalibr)
            cam_from_imu = settings.get("T_cam_imu")
            body_from_cam = (
                None
                if cam_from_imu is None
                else rigid_transform(cam_from_imu, f"{name}: T_cam_imu").inverse()
            )
            coefficients = settings.get("distortion_coeffs", [])
        else:
            raise InputError("no sensor.yaml: intrinsics must be given.")
        if list(settings.get("resolution", size)) != list(size):
            raise InputError(
                f"sensor.yaml is for {settings['resolution']} pixels, images are {size.width_px} x "
                f"{size.height_px}: its intrinsics are not used."
            )
        if "intrinsics" not in settings:
            found.findings.append(
                Finding("warning", name, "no intrinsics in sensor.yaml: they must be given.")
            )
            return None, body_from_cam
        return _lens(settings, coefficients, size), body_from_cam
    except (InputError, CameraError) as error:
        found.findings.append(Finding("warning", name, error.cause))
    except (TypeError, ValueError, KeyError) as error:
        found.findings.append(Finding("warning", name, f"its settings are damaged ({error})."))
    return None, None


def _matrix(settings: Any, where: str) -> SE3 | None:
    return None if settings is None else rigid_transform(settings["data"], where)


def _lens(settings: Mapping[str, Any], coefficients: Any, size: ImageSize) -> CameraModel:
    intrinsics = [float(value) for value in settings["intrinsics"]]
    camera = str(settings.get("camera_model", "pinhole"))
    if camera in ("ds", "eucm"):
        extra, focal = intrinsics[:2], intrinsics[2:]
        return camera_from_params(camera, [*focal, *extra], *size)
    fx, fy, cx, cy = intrinsics
    distortion = str(settings.get("distortion_model", "none"))
    if camera != "pinhole" or distortion not in (*_ROS_DISTORTIONS, "none"):
        raise InputError(f"camera model {camera!r} with distortion {distortion!r} is not known.")
    K = [fx, 0, cx, 0, fy, cy, 0, 0, 1]
    return camera_from_info(_ROS_DISTORTIONS.get(distortion, "plumb_bob"), coefficients, K, *size)


def _add_imu(folder: Path, found: _EurocStreams) -> None:
    stream, repaired = read_imu_csv(folder / "data.csv", folder.name)
    found.findings += repaired
    if (folder / "sensor.yaml").is_file():
        settings = read_yaml_settings(folder / "sensor.yaml")
        stream = replace(
            stream,
            gyro_noise_density=_positive(settings.get("gyroscope_noise_density")),
            accel_noise_density=_positive(settings.get("accelerometer_noise_density")),
            gyro_bias_walk=_positive(settings.get("gyroscope_random_walk")),
            accel_bias_walk=_positive(settings.get("accelerometer_random_walk")),
        )
        try:
            found.rig_from_imu = _matrix(settings.get("T_BS"), f"{folder.name}: T_BS")
        except (TypeError, KeyError) as error:
            found.findings.append(Finding("warning", folder.name, f"T_BS is damaged ({error})."))
    found.imus[folder.name] = replace(stream, topic=folder.name)


def _add_own(folder: Path, found: _EurocStreams) -> None:
    """Folders that `writers.euroc` adds to the format."""
    table = folder / "data.csv"
    if not table.is_file():
        return
    if folder.name.startswith("gnss"):
        gnss, repaired = read_gnss_csv(table, folder.name)
        found.gnss[folder.name] = replace(gnss, topic=folder.name)
    elif folder.name.startswith("attitude"):
        attitude, repaired = read_attitude_csv(table, folder.name)
        found.attitudes[folder.name] = replace(attitude, topic=folder.name)
    else:
        return
    found.findings += repaired


def _positive(value: Any) -> float | None:
    return float(value) if isinstance(value, int | float) and value > 0 else None


def _trajectories(root: Path, folders: tuple[str, ...], findings: list[Finding]) -> dict[str, Trajectory]:
    found = {}
    for name in folders:
        path = root / name / "data.csv"
        if not path.is_file():
            continue
        try:
            file = read_trajectory(
                path, name="body" if folders is _TRUTH_FOLDERS else name, file_format="euroc"
            )
        except InputError as error:
            findings.append(Finding("warning", name, error.cause))
            continue
        findings += file.findings
        found[file.trajectory.name] = file.trajectory
    return found
