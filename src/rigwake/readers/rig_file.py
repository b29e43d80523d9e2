"""`rig.yaml`: the cameras of a folder, their lenses and, where known, where they sit."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from rigwake.cameras.protocol import CameraModel
from rigwake.cameras.registry import camera_from_dict
from rigwake.errors import CameraError, InputError
from rigwake.geometry.se3 import SE3
from rigwake.rig import Rig, RigCamera
from rigwake.yaml_input import read_yaml_settings

# what a file may describe without any camera
_WITHOUT_CAMERAS = {"imu", "imus", "gnss", "attitudes", "poses", "truth", "static_transforms"}


def rigid_transform(matrix: Any, where: str) -> SE3:
    """A transform from 16 (or 12) numbers, checked to be rigid and made exactly so. InputError otherwise."""
    try:
        values = np.array(matrix, dtype=np.float64).reshape(-1, 4)[:3]
    except (TypeError, ValueError) as error:
        raise InputError(f"{where} is not a 4 x 4 matrix.") from error
    R = values[:, :3] if values.shape == (3, 4) else np.zeros((3, 3))
    if not np.isfinite(values).all() or np.abs(R @ R.T - np.eye(3)).max() > 1e-3 or np.linalg.det(R) < 0:
        raise InputError(f"{where} is not a rigid transform.")
    return SE3.from_matrix(values).normalised()


def read_rig_file(path: Path) -> tuple[dict[str, CameraModel], Rig | None]:
    """Lenses by camera name, and the rig if the file says where every camera sits.

    Keys: `reference`, `cameras.NAME.camera` (a lens), `cameras.NAME.rig_from_cam` (`quat_wxyz`,
    `translation_m`), `cameras.NAME.time_offset_s`, `antenna_rig_m`, `rig_from_imu`; `imu` is for `imu_noise_settings`.
    Raises InputError.
    """
    content = read_yaml_settings(path)
    return rig_from_mapping(content, str(path))


def rig_from_mapping(content: Mapping[str, Any], path: str) -> tuple[dict[str, CameraModel], Rig | None]:
    """The same from plain values; path names them in errors."""
    if not content.get("cameras") and content.keys() & _WITHOUT_CAMERAS:
        return {}, None
    try:
        described = {str(name): dict(entry or {}) for name, entry in dict(content["cameras"]).items()}
        lenses = {n: e if "params" in e else e.get("camera") for n, e in described.items()}
        models = {n: camera_from_dict(lens) for n, lens in lenses.items() if lens}
        if not described or not all("rig_from_cam" in entry for entry in described.values()):
            return models, None
        cameras = {
            name: RigCamera(
                name,
                _transform(entry["rig_from_cam"]),
                models.get(name),
                float(entry.get("time_offset_s") or 0.0),
                str(entry.get("topic") or ""),
            )
            for name, entry in described.items()
        }
        antenna, imu = content.get("antenna_rig_m"), content.get("rig_from_imu")
        rig = Rig(
            str(content.get("reference", "base_link")),
            cameras,
            None if antenna is None else _position(antenna),
            None if imu is None else _transform(imu),
        )
    except (KeyError, TypeError, ValueError, CameraError) as error:
        raise InputError(
            f"{path} does not describe a rig ({error}).", remedy="See docs/recordings.md."
        ) from error
    return models, rig


def _position(values: Any) -> tuple[float, float, float]:
    x, y, z = np.array(values, dtype=np.float64).reshape(3).tolist()
    return x, y, z


def _transform(entry: Any) -> SE3:
    quat_wxyz = np.array(entry["quat_wxyz"], dtype=np.float64).reshape(4)
    translation = np.array(entry["translation_m"], dtype=np.float64).reshape(3)
    if not np.isfinite([*quat_wxyz, *translation]).all() or abs(np.linalg.norm(quat_wxyz) - 1) > 1e-3:
        raise ValueError("a transform is not finite or its quaternion not of unit length")
    return SE3.from_quat_wxyz(quat_wxyz, translation)
