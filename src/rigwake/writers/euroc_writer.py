"""EuRoC / ASL folders from a `Recording`."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import yaml

from rigwake.cameras.formats.camera_info import info_from_camera
from rigwake.errors import CameraError
from rigwake.geometry.se3 import SE3
from rigwake.recording import CameraStream, Finding, ImuStream, Recording
from rigwake.rig import Rig
from rigwake.writers.folders import new_folder, write_csv, write_images, write_imu

_IMU_HEADER = "#timestamp [ns]," + ",".join(
    [f"w_RS_S_{axis} [rad s^-1]" for axis in "xyz"] + [f"a_RS_S_{axis} [m s^-2]" for axis in "xyz"]
)
_TRUTH_HEADER = (
    "#timestamp, p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m], q_RS_w [], q_RS_x [], q_RS_y [], q_RS_z []"
)
_DISTORTIONS = {"plumb_bob": "radial-tangential", "equidistant": "equidistant"}


def write_euroc(recording: Recording, path: Path) -> tuple[Finding, ...]:
    """Write an EuRoC / ASL folder (`mav0/`, PNG images named by their stamps).

    Lenses that the format knows (pinhole with radial-tangential or equidistant distortion) and the true rig go
    to `sensor.yaml`. Returns what the format cannot hold.
    """
    findings = [Finding("note", name, "EuRoC folders hold no GNSS; left out.") for name in recording.gnss]
    with new_folder(Path(path)) as folder:
        for camera in recording.cameras.values():
            root = folder / "mav0" / _sensor_name(camera.name, "cam", list(recording.cameras))
            names = write_images(camera, root / "data", ".png", "png")
            write_csv(root / "data.csv", "#timestamp [ns],filename", names)
            rig_camera = recording.true_rig.cameras.get(camera.name) if recording.true_rig else None
            body_from_cam = rig_camera.rig_from_cam if rig_camera else None
            settings = _sensor_settings(camera, body_from_cam, findings)
            _write_yaml(root / "sensor.yaml", settings)
        for imu in recording.imus.values():
            root = folder / "mav0" / _sensor_name(imu.name, "imu", list(recording.imus))
            root.mkdir(parents=True)
            write_imu(imu, root / "data.csv", _IMU_HEADER)
            _write_yaml(root / "sensor.yaml", _imu_settings(imu, recording.true_rig))
        _write_truth(recording, folder / "mav0", findings)
    return tuple(findings)


def _sensor_name(name: str, kind: str, names: list[str]) -> str:
    """`cam0`, `cam1` ...: its own name if it is such a one, else by its place."""
    proper = all(other.startswith(kind) and other.removeprefix(kind).isdigit() for other in names)
    return name if proper else f"{kind}{names.index(name)}"


def _sensor_settings(
    camera: CameraStream, body_from_cam: SE3 | None, findings: list[Finding]
) -> dict[str, Any]:
    settings: dict[str, Any] = {"sensor_type": "camera", "comment": camera.name}
    if body_from_cam is not None:
        settings["T_BS"] = _matrix(body_from_cam)
    settings["resolution"] = [camera.width_px, camera.height_px]
    if camera.model is None:
        return settings
    try:
        info = info_from_camera(camera.model)
    except CameraError as error:
        findings.append(Finding("warning", camera.name, f"intrinsics are not written: {error.cause}"))
        return settings
    if info.distortion_model not in _DISTORTIONS or any(info.D[4:]) or info.K[1]:
        message = "intrinsics are not written: the format has no k3, skew or rational distortion."
        findings.append(Finding("warning", camera.name, message))
        return settings
    settings["camera_model"] = "pinhole"
    settings["intrinsics"] = [info.K[0], info.K[4], info.K[2], info.K[5]]
    settings["distortion_model"] = _DISTORTIONS[info.distortion_model]
    settings["distortion_coefficients"] = list(info.D[:4])
    return settings


def _imu_settings(imu: ImuStream, rig: Rig | None) -> dict[str, Any]:
    settings: dict[str, Any] = {"sensor_type": "imu", "comment": imu.name}
    if rig is not None and rig.rig_from_imu is not None:
        settings["T_BS"] = _matrix(rig.rig_from_imu)
    noise = {
        "gyroscope_noise_density": imu.gyro_noise_density,
        "gyroscope_random_walk": imu.gyro_bias_walk,
        "accelerometer_noise_density": imu.accel_noise_density,
        "accelerometer_random_walk": imu.accel_bias_walk,
    }
    return settings | {key: value for key, value in noise.items() if value is not None}


def _matrix(a_from_b: SE3) -> dict[str, Any]:
    return {"cols": 4, "rows": 4, "data": a_from_b.matrix.ravel().tolist()}


def _write_yaml(path: Path, settings: dict[str, Any]) -> None:
    body = yaml.safe_dump(settings, sort_keys=False, default_flow_style=None)
    path.write_text("%YAML:1.0\n" + body, encoding="utf-8")


def _write_truth(recording: Recording, root: Path, findings: list[Finding]) -> None:
    """The format holds one true trajectory: that of the body."""
    bodies = recording.true_trajectories
    findings += [
        Finding("note", name, "EuRoC folders hold the truth of the body only; left out.")
        for name in bodies
        if name != "body"
    ]
    if "body" in bodies:
        truth = bodies["body"]
        poses = truth.world_from_body
        values = np.hstack([poses.translation, poses.quat_wxyz]).tolist()
        rows = ([t, *row] for t, row in zip(truth.timestamps_ns.tolist(), values, strict=True))
        folder = root / "state_groundtruth_estimate0"
        folder.mkdir(parents=True)
        write_csv(folder / "data.csv", _TRUTH_HEADER, rows)
