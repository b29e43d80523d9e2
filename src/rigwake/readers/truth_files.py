"""Known rigs: the `truth.yaml` that stands beside a simulated recording, or any calibration file.

Layout of truth.yaml (units in the key names): `cameras.NAME.{base_from_cam: {quat_wxyz, translation_m},
time_offset_s, topic}`, `imu.base_from_imu`, `gnss.antenna_lever_arm_base_m`.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from rigwake.calibration.yaml_file import calibration_from_dict
from rigwake.errors import InputError
from rigwake.geometry.se3 import SE3
from rigwake.rig import Rig, RigCamera
from rigwake.yaml_input import read_yaml_settings

BASE = "base_link"
_UNIT = 1e-2


def read_true_rig(path: Path | str) -> Rig:
    """The rig of a `truth.yaml` (frame `base_link`) or of a calibration file (its own reference)."""
    path = Path(path)
    content = read_yaml_settings(path)
    if "rigwake_calibration" in content:
        return calibration_from_dict(content, str(path)).rig
    try:
        return _rig_of_truth(content)
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise InputError(
            f"{path} is neither a calibration nor a truth.yaml: {type(error).__name__}: {error}.",
            remedy="A truth.yaml names cameras.NAME.base_from_cam.{quat_wxyz, translation_m}.",
        ) from error


def _rig_of_truth(content: Mapping[str, Any]) -> Rig:
    cameras = {
        str(name): RigCamera(
            str(name),
            _transform(camera["base_from_cam"]),
            time_offset_s=float(camera.get("time_offset_s", 0.0)),
            topic=str(camera.get("topic", "")),
        )
        for name, camera in content["cameras"].items()
    }
    imu, gnss = content.get("imu"), content.get("gnss")
    antenna = None
    if gnss and "antenna_lever_arm_base_m" in gnss:
        x, y, z = (float(value) for value in gnss["antenna_lever_arm_base_m"])
        antenna = (x, y, z)
    return Rig(
        BASE, cameras, antenna, _transform(imu["base_from_imu"]) if imu and "base_from_imu" in imu else None
    )


def _transform(content: Mapping[str, Any]) -> SE3:
    quat_wxyz = np.array(content["quat_wxyz"], dtype=np.float64)
    translation = np.array(content["translation_m"], dtype=np.float64)
    if quat_wxyz.shape != (4,) or translation.shape != (3,) or not np.isfinite(translation).all():
        raise ValueError("a transform wants quat_wxyz (4) and translation_m (3), finite")
    if not abs(np.linalg.norm(quat_wxyz) - 1) < _UNIT:
        raise ValueError(f"quat_wxyz {quat_wxyz.tolist()} is not of norm 1")
    return SE3.from_quat_wxyz(quat_wxyz, translation)


def rig_in_frame(rig: Rig, reference: str) -> Rig:
    """The same rig seen from another of its frames: `imu`, `base_link` or a camera's name.

    Raises InputError when the rig does not know that frame.
    """
    if reference == rig.reference:
        return rig
    if reference == "imu" and rig.rig_from_imu is not None:
        new_from_rig = rig.rig_from_imu.inverse()
    elif reference in rig.cameras:
        new_from_rig = rig.cameras[reference].rig_from_cam.inverse()
    else:
        known = [rig.reference, *(["imu"] if rig.rig_from_imu is not None else []), *rig.cameras]
        raise InputError(
            f"The rig does not say where {reference!r} is.", remedy=f"It knows: {', '.join(known)}."
        )
    cameras = {
        name: RigCamera(name, new_from_rig * c.rig_from_cam, c.model, c.time_offset_s, c.topic)
        for name, c in rig.cameras.items()
    }
    antenna = None
    if rig.antenna_rig is not None:
        x, y, z = (new_from_rig * np.array(rig.antenna_rig)).tolist()
        antenna = (x, y, z)
    imu = None if rig.rig_from_imu is None else new_from_rig * rig.rig_from_imu
    return Rig(reference, cameras, antenna, imu)
