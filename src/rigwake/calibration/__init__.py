"""The one result that everything downstream reads: rig, uncertainty, verdicts, provenance."""

from rigwake.calibration.rig_calibration import (
    CalibratedCamera,
    Calibration,
    KnownOffset,
    UnobservableDirection,
)
from rigwake.calibration.yaml_file import load_calibration, save_calibration

__all__ = [
    "CalibratedCamera",
    "Calibration",
    "KnownOffset",
    "UnobservableDirection",
    "load_calibration",
    "save_calibration",
]
