"""Basalt's calibration JSON: `T_imu_cam` maps camera axes to those of the IMU.

Basalt adds one `cam_time_offset_ns` to the stamps of all cameras. Its IMU corrections (`calib_accel_bias`,
`calib_gyro_bias`) are written as zeros, which apply none. Source: basalt-headers,
`serialization/headers_serialization.h`.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from rigwake.atomic import write_text_atomic
from rigwake.calibration import Calibration
from rigwake.cameras.formats.camera_dicts import camera_from_basalt, camera_to_basalt
from rigwake.errors import InputError, UsageError
from rigwake.exporters.export_base import (
    IMU,
    ExportedImuNoise,
    ExportOptions,
    Notes,
    external_calibration,
    external_camera,
    read_json_file,
    require_lenses,
    require_reference,
    transform_from_parts,
)
from rigwake.exporters.lenses import write_lens
from rigwake.yaml_input import read_yaml_settings

_LENSES = ("kb4", "ds", "eucm", "rational")
_OFFSETS_AGREE_S = 1e-3


def write_basalt(calibration: Calibration, path: Path, options: ExportOptions, notes: Notes) -> Notes:
    """The calibration JSON; the notes stand in the terminal only, since JSON has no comments."""
    require_reference(calibration, IMU, "Basalt")
    if options.imu is None:
        raise UsageError(
            "Basalt's file holds the noise of the IMU, which a calibration of cameras does not know.",
            remedy="Give Kalibr's imu.yaml: --imu imu.yaml.",
        )
    intrinsics, resolution, more = [], [], []
    for name, lens in require_lenses(calibration, "Basalt").items():
        entry, written, lens_notes = write_lens(
            lens, camera_to_basalt, _LENSES, options.max_fit_error_px, name
        )
        intrinsics.append(entry)
        resolution.append([written.width_px, written.height_px])
        more += lens_notes
    offset_s, offset_notes = _common_offset(calibration)
    content = {
        "T_imu_cam": [_pose(camera.rig_from_cam) for camera in calibration.cameras.values()],
        "intrinsics": intrinsics,
        "resolution": resolution,
        "calib_accel_bias": [0.0] * 9,
        "calib_gyro_bias": [0.0] * 12,
        "imu_update_rate": options.imu.rate_hz,
        "accel_noise_std": [options.imu.accel_density] * 3,
        "gyro_noise_std": [options.imu.gyro_density] * 3,
        "accel_bias_std": [options.imu.accel_walk] * 3,
        "gyro_bias_std": [options.imu.gyro_walk] * 3,
        "cam_time_offset_ns": round(offset_s * 1e9),
        "vignette": [],
    }
    write_text_atomic(path, json.dumps({"value0": content}, indent=2, allow_nan=False) + "\n")
    return [*more, *offset_notes, f"order of the cameras: {', '.join(calibration.cameras)}"]


def _pose(imu_from_cam: Any) -> dict[str, float]:
    w, x, y, z = (float(value) for value in imu_from_cam.quat_wxyz)
    px, py, pz = (float(value) for value in imu_from_cam.translation)
    return {"px": px, "py": py, "pz": pz, "qx": x, "qy": y, "qz": z, "qw": w}


def _common_offset(calibration: Calibration) -> tuple[float, Notes]:
    """The one time offset that Basalt knows; UsageError if the cameras' clocks differ."""
    known = [c.time_offset_s for c in calibration.cameras.values() if c.time_offset_s is not None]
    if not known:
        return 0.0, ["cam_time_offset_ns is 0: the clocks were not estimated"]
    spread = max(known) - min(known)
    if spread > _OFFSETS_AGREE_S:
        raise UsageError(
            f"Basalt knows one time offset for all cameras; these differ by {1e3 * spread:.2f} ms.",
            remedy="Correct the stamps of the recording, or export to kalibr.",
        )
    note = f"one time offset for all cameras: each within {1e3 * spread:.3f} ms of it"
    return float(np.mean(known)), [note] if spread > 0 else []


def read_basalt(path: Path) -> Calibration:
    """The cameras of a Basalt calibration, named cam0, cam1, ..."""
    try:
        content = read_json_file(path)["value0"]
        poses, lenses, sizes = content["T_imu_cam"], content["intrinsics"], content["resolution"]
        offset_s = float(content.get("cam_time_offset_ns", 0)) * 1e-9
        cameras = [
            external_camera(
                f"cam{number}",
                transform_from_parts(
                    [pose[k] for k in ("qw", "qx", "qy", "qz")],
                    [pose[k] for k in ("px", "py", "pz")],
                    f"{path}: T_imu_cam {number}",
                ),
                camera_from_basalt(lens, size),
                offset_s,
            )
            for number, (pose, lens, size) in enumerate(zip(poses, lenses, sizes, strict=True))
        ]
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise InputError(f"{path} is not a Basalt calibration: {type(error).__name__}: {error}.") from error
    return external_calibration(IMU, cameras, path)


_IMU_KEYS = {
    "accel_density": "accelerometer_noise_density",
    "accel_walk": "accelerometer_random_walk",
    "gyro_density": "gyroscope_noise_density",
    "gyro_walk": "gyroscope_random_walk",
    "rate_hz": "update_rate",
}


def read_imu_noise(path: Path) -> ExportedImuNoise:
    """Kalibr's imu.yaml, or the `imu0` of OpenVINS' kalibr_imu_chain.yaml."""
    content: Mapping[str, Any] = read_yaml_settings(path)
    content = content.get("imu0", content)
    try:
        values = {ours: float(content[theirs]) for ours, theirs in _IMU_KEYS.items()}
        return ExportedImuNoise(**values, topic=str(content.get("rostopic", "")))
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(
            f"{path} is not an imu.yaml: {type(error).__name__}: {error}.",
            remedy=f"It must hold {', '.join(_IMU_KEYS.values())}.",
        ) from error
