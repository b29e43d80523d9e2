"""Known rigs for comparison, of any file or folder that tells where cameras sit."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from math import nan
from pathlib import Path

import numpy as np

from rigwake.calibration import Calibration
from rigwake.errors import InputError, UsageError
from rigwake.exporters.export_formats import read_calibration
from rigwake.geometry.se3 import SE3
from rigwake.readers.open import open_recording
from rigwake.readers.rig_file import read_rig_file
from rigwake.readers.trajectory_frames import FRAME_MEANINGS
from rigwake.readers.truth_files import read_true_rig
from rigwake.rig import Rig
from rigwake.yaml_input import read_yaml

_MIRROR_Y = np.diag([1.0, -1.0, 1.0])
_FLU_FROM_FRD = np.diag([1.0, -1.0, -1.0])
_TRUTH_NAMES = ("truth.yaml", "rig.yaml")


def read_known_rig(path: Path | str) -> Rig:
    """The rig of a `truth.yaml`, a `rig.yaml`, a calibration in any known format, or a recording that holds its rig.

    Raises InputError, saying what was expected, if the file tells no rig.
    """
    path = Path(path)
    if path.is_dir():
        return _rig_of_folder(path)
    if path.suffix.lower() in (".yaml", ".yml"):
        content = read_yaml(path)
        cameras = content.get("cameras") if isinstance(content, Mapping) else None
        entries = (
            [e for e in cameras.values() if isinstance(e, Mapping)] if isinstance(cameras, Mapping) else []
        )
        if any("base_from_cam" in entry for entry in entries):
            return read_true_rig(path)
        if entries and "rigwake_calibration" not in content and all("rig_from_cam" in e for e in entries):
            rig = read_rig_file(path)[1]
            if rig is not None:
                return rig
    return _rig(read_calibration(path))


def _rig(calibration: Calibration) -> Rig:
    """The rig of a calibration; time offsets that it does not hold are NaN."""
    rig = calibration.rig
    cameras = {
        name: camera
        if calibration.cameras[name].time_offset_s is not None
        else replace(camera, time_offset_s=nan)
        for name, camera in rig.cameras.items()
    }
    return replace(rig, cameras=cameras)


def rig_in_house_frames(rig: Rig, meaning: str) -> Rig:
    """The rig with `rig_from_cam` of transforms that were written as `meaning` says.

    enu: as they stand. inverse: they are `cam_from_rig`. ned: the rig's axes are forward-right-down. left-handed: y is
    mirrored in the rig and in the cameras. Raises UsageError for another meaning.
    """
    if meaning not in FRAME_MEANINGS:
        raise UsageError(
            f"--frame {meaning!r} is unknown.", remedy=f"Choose from {', '.join(FRAME_MEANINGS)}."
        )
    cameras = {n: replace(c, rig_from_cam=_meant(c.rig_from_cam, meaning)) for n, c in rig.cameras.items()}
    return rig if meaning == "enu" else Rig(rig.reference, cameras)


def _meant(transform: SE3, meaning: str) -> SE3:
    if meaning == "inverse":
        return transform.inverse()
    if meaning == "left-handed":
        return SE3(_MIRROR_Y @ transform.rotation @ _MIRROR_Y, _MIRROR_Y @ transform.translation)
    return SE3(_FLU_FROM_FRD, np.zeros(3)) * transform if meaning == "ned" else transform


def _rig_of_folder(path: Path) -> Rig:
    """Of a folder of calibrations, else of the recording that it is."""
    for name in _TRUTH_NAMES:
        if (path / name).is_file():
            return read_known_rig(path / name)
    try:
        return _rig(read_calibration(path))
    except InputError as error:
        try:
            rig = open_recording(path).true_rig
        except InputError:
            raise error from None
        if rig is None:
            raise InputError(f"{path} does not say where its cameras sit.", remedy=error.remedy) from error
        return rig
