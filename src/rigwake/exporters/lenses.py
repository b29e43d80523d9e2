"""Lenses in formats that do not know their model: converted by fitting, or refused."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TypeVar

import numpy as np

from rigwake.cameras.model_fitting import Conversion, convert_camera
from rigwake.cameras.protocol import CameraModel
from rigwake.errors import CameraError
from rigwake.exporters.export_base import Notes

Written = TypeVar("Written")


def write_lens(
    lens: CameraModel,
    write: Callable[[CameraModel], Written],
    substitutes: Sequence[str],
    max_fit_error_px: float,
    name: str,
) -> tuple[Written, CameraModel, Notes]:
    """What `write` makes of a lens; where it raises CameraError, of the substitute model that fits best.

    Returns also the lens that was written, and a note that gives the residual of a conversion. Raises
    CameraError if no substitute covers the whole image to within `max_fit_error_px`.
    """
    try:
        return write(lens), lens, []
    except CameraError as error:
        refusal = error
    conversions = [convert_camera(lens, model) for model in substitutes if model != lens.model]
    covering = [c for c in conversions if _covers(lens, c)]
    if not covering:
        raise CameraError(
            f"{name}: {refusal.cause} None of its models ({', '.join(substitutes)}) reaches the edge of the "
            f"image of this lens.",
            remedy="Choose a format that holds the lens, such as kalibr or json.",
        )
    best = min(covering, key=lambda c: c.max_px)
    if best.max_px > max_fit_error_px:
        raise CameraError(
            f"{name}: {refusal.cause} The nearest {best.camera.model} lens is off by up to "
            f"{best.max_px:.3g} px (rms {best.rms_px:.3g} px).",
            consequence=f"That is more than the {max_fit_error_px:g} px allowed.",
            remedy="Choose another format, or raise --max-fit-error.",
        )
    note = (
        f"{name}: {lens.model} written as {best.camera.model}, "
        f"off by at most {best.max_px:.2g} px (rms {best.rms_px:.2g} px)"
    )
    return write(best.camera), best.camera, [note]


def _covers(lens: CameraModel, conversion: Conversion) -> bool:
    """Whether the substitute holds wherever the image shows anything."""
    if conversion.fitted_angle >= lens.max_angle:
        return True
    along = np.linspace(0.0, 1.0, 50)
    near, far = np.zeros_like(along), np.ones_like(along)
    sides = [(along, near), (along, far), (near, along), (far, along)]
    border = np.concatenate([np.stack(side, axis=1) for side in sides])
    bearings, seen = lens.unproject(border * [lens.width_px - 1, lens.height_px - 1])
    # a border that shows nothing lies outside the image circle: then the lens's own end is inside the image
    return bool(seen.all() and np.all(bearings[:, 2] >= np.cos(conversion.fitted_angle)))
