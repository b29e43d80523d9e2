"""The one result that everything downstream reads: rig, doubt, verdicts, provenance."""

from rigwake.calibration.values import (
    CalibratedCamera,
    Calibration,
    KnownOffset,
    UndeterminedDirection,
)
from rigwake.calibration.yaml_file import load_calibration, save_calibration

__all__ = [
    "CalibratedCamera",
    "Calibration",
    "KnownOffset",
    "UndeterminedDirection",
    "load_calibration",
    "save_calibration",
]
