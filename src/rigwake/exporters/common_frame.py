"""Two calibrations in one frame, although not every format says which frame it means."""

from __future__ import annotations

from dataclasses import replace

from rigwake.calibration import Calibration
from rigwake.errors import InputError
from rigwake.exporters.export_base import UNNAMED_FRAMES, Notes, refer_to_camera


def in_common_frame(a: Calibration, b: Calibration) -> tuple[Calibration, Calibration, Notes]:
    """Both referring to one frame, and what was assumed for that.

    A format without a name for its frame is taken to mean that of the other calibration; if one refers to a
    camera that the other knows, both are given relative to that camera. InputError if neither helps.
    """
    if a.reference == b.reference:
        return a, b, []
    if b.reference in UNNAMED_FRAMES:
        return a, replace(b, reference=a.reference), [_assumed(b, a)]
    if a.reference in UNNAMED_FRAMES:
        return replace(a, reference=b.reference), b, [_assumed(a, b)]
    for camera in (a.reference, b.reference):
        if camera in a.cameras and camera in b.cameras:
            note = f"compared relative to {camera}, without sigmas: the files refer to different frames"
            return refer_to_camera(a, camera), refer_to_camera(b, camera), [note]
    raise InputError(
        f"The calibrations refer to different frames: {a.reference} and {b.reference}.",
        remedy="Calibrate both with the same --reference.",
    )


def _assumed(unnamed: Calibration, named: Calibration) -> str:
    return f"the frame {unnamed.reference} of one file is taken to be {named.reference}"
