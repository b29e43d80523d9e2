"""A lens whose picture was enlarged about its centre and moved, whatever the model calls its parameters."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from rigwake.cameras.protocol import CameraModel

_IN_PIXELS = frozenset({"fx", "fy", "mu", "mv", "skew"})  # grow with the picture
_CENTRE = ({"cx", "u0"}, {"cy", "v0"})


def moved_lens(camera: CameraModel, scale: float, shift_px: ArrayLike) -> CameraModel:
    """The lens that sees at pixel `c + s (p - c) + d` what the given one sees at p, with its centre c.

    scale: s. shift_px: (2,) d. Scaramuzza's polynomial `z = a0 + a1 r + ...` of the radius r becomes one of `r / s`,
    times s. Raises CameraError where the model does not allow such values.
    """
    shift = np.asarray(shift_px, dtype=float)
    params = camera.params.copy()
    for k, name in enumerate(camera.param_names):
        if name in _IN_PIXELS:
            params[k] *= scale
        elif name in _CENTRE[0]:
            params[k] += shift[0]
        elif name in _CENTRE[1]:
            params[k] += shift[1]
        elif name[0] == "a" and name[1:].isdigit():
            params[k] *= scale ** (1 - int(name[1:]))
    return camera.with_params(params)
