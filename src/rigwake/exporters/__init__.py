"""Calibrations in other programs' formats: written, and read back."""

from rigwake.exporters.base import UNNAMED_FRAMES, ExportOptions, ImuNoise
from rigwake.exporters.catalogue import FORMATS, export_calibration, read_calibration
from rigwake.exporters.common_frame import in_common_frame

__all__ = [
    "FORMATS",
    "UNNAMED_FRAMES",
    "ExportOptions",
    "ImuNoise",
    "export_calibration",
    "in_common_frame",
    "read_calibration",
]
