"""The text file of OCamCalib (`calib_results.txt`).

Five rows of numbers between comments: the polynomial a0..aN after its length, its inverse after its length, the
centre as row and column counted from zero, the affine c, d, e, and the image's height and width. The toolbox's
x runs down the rows and its y along the columns: `row = c x + d y + row0`, `column = e x + y + column0`.
"""

from __future__ import annotations

from rigwake.cameras.models.scaramuzza import Scaramuzza
from rigwake.cameras.protocol import CameraModel
from rigwake.errors import CameraError

_LABELS = (
    "#polynomial coefficients for the DIRECT mapping function (ocam_model.ss in MATLAB)",
    "#polynomial coefficients for the inverse mapping function (ocam_model.invpol in MATLAB)",
    '#center: "row" and "column", starting from 0 (C convention)',
    '#affine parameters "c", "d", "e"',
    '#image size: "height" and "width"',
)


def camera_from_ocamcalib(text: str, max_angle: float | None = None) -> Scaramuzza:
    """The lens of an OCamCalib file. The inverse polynomial is not needed: projection solves for the root."""
    try:
        rows = [
            [float(word) for word in line.split()]
            for line in text.splitlines()
            if line.strip() and not line.lstrip().startswith("#")
        ]
        direct, _, (row, column), (c, d, e), (height_px, width_px) = rows[:5]
        degree, size = int(direct[0]), (int(width_px), int(height_px))
    except (ValueError, OverflowError) as error:
        raise CameraError("This is not an OCamCalib file: it must hold five rows of numbers.") from error
    if degree != len(direct) - 1:
        raise CameraError(f"The OCamCalib file announces {degree} coefficients and holds {len(direct) - 1}.")
    values = (column, row, c, d, e, *direct[1:])
    return Scaramuzza(values, *size, max_angle)


def camera_to_ocamcalib(camera: CameraModel) -> str:
    """The OCamCalib file of a Scaramuzza lens, with an inverse polynomial fitted for other readers."""
    if not isinstance(camera, Scaramuzza):
        raise CameraError(
            f"OCamCalib has no form for a {camera.model} lens.", remedy="Convert it to scaramuzza first."
        )
    cx, cy, c, d, e, *direct = camera.values
    inverse = camera.inverse_polynomial()
    rows = (
        [len(direct), *direct],
        [len(inverse), *inverse.tolist()],
        [cy, cx],
        [c, d, e],
        [camera.height_px, camera.width_px],
    )
    numbers = (" ".join(repr(value) for value in row) for row in rows)
    return "\n\n".join(f"{label}\n\n{row}" for label, row in zip(_LABELS, numbers, strict=True)) + "\n"
