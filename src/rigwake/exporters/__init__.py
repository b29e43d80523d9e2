"""Calibrations in other programs' formats: written, and read back."""

from rigwake.exporters.common_frame import in_common_frame
from rigwake.exporters.export_base import UNNAMED_FRAMES, ExportedImuNoise, ExportOptions
from rigwake.exporters.export_formats import FORMATS, export_calibration, read_calibration

__all__ = [
    "FORMATS",
    "UNNAMED_FRAMES",
    "ExportOptions",
    "ExportedImuNoise",
    "export_calibration",
    "in_common_frame",
    "read_calibration",
]
