"""A calibration against a known rig, whichever frames the two name."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Literal

from rigwake.calibration import Calibration
from rigwake.errors import RigwakeError
from rigwake.evaluation.rig_errors import RigErrors, evaluate_calibration
from rigwake.exporters.export_base import UNNAMED_FRAMES, refer_to_camera
from rigwake.exporters.export_formats import read_calibration
from rigwake.readers.truth_files import rig_in_frame
from rigwake.rig import Rig


def is_trajectory_file(path: Path) -> bool:
    """By its suffix; a csv file may be either: one that is no calibration is taken for a trajectory."""
    suffix = path.suffix.lower()
    if suffix != ".csv" or not path.is_file():
        return suffix in (".tum", ".txt") and path.is_file()
    try:
        read_calibration(path)
    except RigwakeError:
        return True
    return False


def evaluate_against(
    found: Calibration, rig: Rig, *, gauge: Literal["reference", "align"] = "reference"
) -> tuple[Calibration, RigErrors]:
    """Errors of a calibration; also the calibration in the frame in which the errors are.

    gauge: `reference`: in the reference frame; `align`: after fitting the whole rig to the known one. Raises InputError
    when the known rig does not know the frame.
    """
    if found.reference in UNNAMED_FRAMES:
        found = replace(found, reference=rig.reference)
    elif rig.reference in UNNAMED_FRAMES:
        rig = replace(rig, reference=found.reference)
    elif gauge == "reference" and rig.reference in found.cameras and not _knows(rig, found.reference):
        found = refer_to_camera(found, rig.reference)
    known = rig_in_frame(rig, found.reference) if gauge == "reference" else rig
    return found, evaluate_calibration(found, known, gauge=gauge)


def _knows(rig: Rig, frame: str) -> bool:
    return frame == rig.reference or frame in rig.cameras or (frame == "imu" and rig.rig_from_imu is not None)
