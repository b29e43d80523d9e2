"""EuRoC / ASL folders from a `Recording`."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from rigwake.cameras.formats.camera_info import info_from_camera
from rigwake.errors import CameraError
from rigwake.geometry.se3 import SE3
from rigwake.readers.rig_description import RIG_FILE
from rigwake.recording import CameraStream, Finding, ImuStream, Recording
from rigwake.rig import Rig
from rigwake.writers.encoded_images import ImageEncoding, lossy_remark
from rigwake.writers.folders import (
    new_folder,
    write_attitude,
    write_csv,
    write_gnss,
    write_images,
    write_imu,
    write_trajectories,
)
from rigwake.writers.rig_text import describe, yaml_text

_IMU_HEADER = "#timestamp [ns]," + ",".join(
    [f"w_RS_S_{axis} [rad s^-1]" for axis in "xyz"] + [f"a_RS_S_{axis} [m s^-2]" for axis in "xyz"]
)
_TRUTH_HEADER = (
    "#timestamp, p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m], q_RS_w [], q_RS_x [], q_RS_y [], q_RS_z []"
)
_DISTORTIONS = {"plumb_bob": "radial-tangential", "equidistant": "equidistant"}


def write_euroc(
    recording: Recording, path: Path, image_encoding: ImageEncoding = "png"
) -> tuple[Finding, ...]:
    """Write an EuRoC / ASL folder (`mav0/`, images named by their stamps).

    Lenses that the format knows (pinhole with radial-tangential or equidistant distortion) and the true rig go
    to `sensor.yaml`. What the format has no place for goes into folders and files beside: `gnss0/`, `attitude0/`,
    `poses/`, `truth/` and `rig.yaml`, which rigwake reads. Returns what other readers will not find.
    """
    findings = [f for camera in recording.cameras.values() for f in lossy_remark(camera, image_encoding)]
    places: dict[tuple[str, str], str] = {}
    with new_folder(Path(path)) as folder:
        root = folder / "mav0"
        root.mkdir()
        for camera in recording.cameras.values():
            place = places["cameras", camera.name] = _sensor_name(camera.name, "cam", list(recording.cameras))
            names = write_images(camera, root / place / "data", image_encoding)
            write_csv(root / place / "data.csv", "#timestamp [ns],filename", names)
            rig_camera = recording.true_rig.cameras.get(camera.name) if recording.true_rig else None
            body_from_cam = rig_camera.rig_from_cam if rig_camera else None
            _write_yaml(root / place / "sensor.yaml", _sensor_settings(camera, body_from_cam, findings))
        for imu in recording.imus.values():
            place = places["imus", imu.name] = _sensor_name(imu.name, "imu", list(recording.imus))
            (root / place).mkdir()
            write_imu(imu, root / place / "data.csv", _IMU_HEADER)
            _write_yaml(root / place / "sensor.yaml", _imu_settings(imu, recording.true_rig))
        for gnss in recording.gnss.values():
            place = places["gnss", gnss.name] = _sensor_name(gnss.name, "gnss", list(recording.gnss))
            (root / place).mkdir()
            write_gnss(gnss, root / place / "data.csv")
            findings.append(
                Finding("note", gnss.name, f"EuRoC folders hold no GNSS; {place}/ is rigwake's own.")
            )
        for attitude in recording.attitudes.values():
            names_of = list(recording.attitudes)
            place = places["attitudes", attitude.name] = _sensor_name(attitude.name, "attitude", names_of)
            (root / place).mkdir()
            write_attitude(attitude, root / place / "data.csv")
            words = f"EuRoC folders hold no attitude; {place}/ is rigwake's own."
            findings.append(Finding("note", attitude.name, words))
        _write_truth(recording, root)
        others = {name: t for name, t in recording.true_trajectories.items() if name != "body"}
        write_trajectories(replace(recording, true_trajectories=others), root, places)
        content = describe(recording, places, transforms=True)
        if content:
            (root / RIG_FILE).write_text(yaml_text(content), encoding="utf-8")
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
        findings.append(
            Finding(
                "warning",
                camera.name,
                f"sensor.yaml has no form for its lens, which stands in rig.yaml only: {error.cause}",
            )
        )
        return settings
    if info.distortion_model not in _DISTORTIONS or any(info.D[4:]) or info.K[1]:
        message = "sensor.yaml has no k3, skew or rational distortion: the lens stands in rig.yaml only."
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


def _write_truth(recording: Recording, root: Path) -> None:
    """The format holds one true trajectory: that of the body."""
    bodies = recording.true_trajectories
    if "body" in bodies:
        truth = bodies["body"]
        poses = truth.world_from_body
        values = np.hstack([poses.translation, poses.quat_wxyz]).tolist()
        rows = ([t, *row] for t, row in zip(truth.timestamps_ns.tolist(), values, strict=True))
        folder = root / "state_groundtruth_estimate0"
        folder.mkdir(parents=True)
        write_csv(folder / "data.csv", _TRUTH_HEADER, rows)
