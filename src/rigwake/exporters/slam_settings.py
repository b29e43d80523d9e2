"""Rigs in the settings files of VINS-Mono, VINS-Fusion and ORB-SLAM3 (read only).

VINS: `body_T_cam0` (VINS-Fusion) or `extrinsicRotation` and `extrinsicTranslation` (VINS-Mono) map camera to IMU axes;
`td`: `t_imu = t_cam + td`; lenses stand in the file itself or in `cam0_calib` beside it. ORB-SLAM3: `IMU.T_b_c1`
(older: `Tbc`) maps the first camera's axes to the IMU's, `Stereo.T_c1_c2` (older: `Tlr`) the second's to the first's.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from rigwake.calibration import CalibratedCamera, Calibration
from rigwake.cameras.formats.opencv_yaml import camera_from_camodocal
from rigwake.cameras.protocol import CameraModel
from rigwake.cameras.slam_lenses import cameras_from_orbslam
from rigwake.errors import CameraError, InputError
from rigwake.exporters.export_base import (
    IMU,
    external_calibration,
    external_camera,
    read_yaml_file,
    transform_from_matrix,
)
from rigwake.geometry.se3 import SE3

_VINS_KEYS = ("body_T_cam0", "extrinsicRotation")


def is_vins(content: Mapping[Any, Any]) -> bool:
    """Whether these are the settings of VINS-Mono or VINS-Fusion."""
    return any(key in content for key in _VINS_KEYS)


def read_vins(path: Path) -> Calibration:
    """The cameras of a VINS settings file, named cam0, cam1, in the frame of the IMU.

    Raises InputError if the file leaves the transform to be estimated, or is damaged.
    """
    content = read_yaml_file(path)
    if not isinstance(content, Mapping):
        raise InputError(f"{path} is no settings file of VINS.")
    transforms = _vins_transforms(content, path)
    shift = content.get("td")
    try:
        offset_s = None if shift is None else float(shift)
    except (TypeError, ValueError) as error:
        raise InputError(f"{path}: td must be a number, it is {shift!r}.") from error
    cameras = [
        external_camera(
            f"cam{number}",
            rig_from_cam,
            _vins_lens(content, path, number),
            offset_s,
            str(content.get(f"image{number}_topic") or content.get("image_topic") or ""),
        )
        for number, rig_from_cam in transforms.items()
    ]
    return external_calibration(IMU, cameras, path)


def _vins_transforms(content: Mapping[Any, Any], path: Path) -> dict[int, SE3]:
    if "extrinsicRotation" in content:
        rotation = _matrix(content["extrinsicRotation"], (3, 3), f"{path}: extrinsicRotation")
        shift = _matrix(content.get("extrinsicTranslation"), (3, 1), f"{path}: extrinsicTranslation")
        return {0: transform_from_matrix(np.hstack([rotation, shift]), f"{path}: extrinsicRotation")}
    keys = {number: f"body_T_cam{number}" for number in range(10) if f"body_T_cam{number}" in content}
    if not keys:
        raise InputError(
            f"{path} holds no body_T_cam0: it leaves the transform to be estimated.",
            remedy="Give the file that VINS wrote after estimating (vins_config.yaml or extrinsic_parameter.csv).",
        )
    return {
        number: transform_from_matrix(_matrix(content[key], (4, 4), f"{path}: {key}"), f"{path}: {key}")
        for number, key in keys.items()
    }


def _vins_lens(content: Mapping[Any, Any], path: Path, number: int) -> CameraModel | None:
    file = content.get(f"cam{number}_calib")
    if "model_type" in content and number == 0:
        return camera_from_camodocal(content)
    if not isinstance(file, str) or Path(file).name != file:
        return None
    beside = path.with_name(file)
    lens = read_yaml_file(beside) if beside.is_file() else None
    return camera_from_camodocal(lens) if isinstance(lens, Mapping) else None


def read_orbslam(path: Path) -> Calibration:
    """The cameras of an ORB-SLAM3 settings file, named cam0 and cam1; in the frame of the IMU, else of cam0."""
    content = read_yaml_file(path)
    if not isinstance(content, Mapping):
        raise InputError(f"{path} is no settings file of ORB-SLAM.")
    try:
        lenses = cameras_from_orbslam({str(key): value for key, value in content.items()})
    except CameraError as error:
        raise InputError(f"{path}: {error.cause}") from error
    imu_from_cam = _first(content, ("IMU.T_b_c1", "Tbc"), path)
    first_from_second = _first(content, ("Stereo.T_c1_c2", "Tlr"), path)
    if first_from_second is None and "Stereo.b" in content:
        try:
            first_from_second = SE3(np.eye(3), np.array([float(content["Stereo.b"]), 0.0, 0.0]))
        except (TypeError, ValueError) as error:
            raise InputError(f"{path}: Stereo.b must be a number.") from error
    rig_from_first = SE3.identity() if imu_from_cam is None else imu_from_cam
    cameras: list[CalibratedCamera] = [external_camera("cam0", rig_from_first, lenses["cam0"])]
    if first_from_second is not None:
        lens = lenses.get("cam1", lenses["cam0"] if "Stereo.b" in content else None)
        cameras.append(external_camera("cam1", rig_from_first * first_from_second, lens))
    return external_calibration("cam0" if imu_from_cam is None else IMU, cameras, path)


def _first(content: Mapping[Any, Any], keys: tuple[str, ...], path: Path) -> SE3 | None:
    for key in keys:
        if key in content:
            entry = content[key]
            shape = (3, 4) if isinstance(entry, Mapping) and entry.get("rows") == 3 else (4, 4)
            return transform_from_matrix(_matrix(entry, shape, f"{path}: {key}"), f"{path}: {key}")
    return None


def _matrix(
    entry: Any, shape: tuple[int, int], where: str
) -> np.ndarray[tuple[int, ...], np.dtype[np.float64]]:
    """A matrix of OpenCV's (or a list of numbers) of this shape; InputError if it is none."""
    values = entry.get("data") if isinstance(entry, Mapping) else entry
    try:
        array = np.array(values, dtype=np.float64).reshape(shape)
    except (TypeError, ValueError) as error:
        raise InputError(f"{where} must hold {shape[0]} x {shape[1]} numbers.") from error
    if not np.isfinite(array).all():
        raise InputError(f"{where} holds NaN or infinite values.")
    return array
