"""Observations whose landmark the lens model cannot project: predicted beyond the rim of a fisheye.

Noise puts points at the rim on either side of it, and a cost that jumps there traps a solver. Such an
observation is compared with its own ray instead, by the lens model linearised there: continuous with the
model's residual up to second order in the angle between the two.
"""

from __future__ import annotations

import numpy as np

from rigwake._types import Array
from rigwake.cameras.protocol import CameraModel, Projection

_INWARDS = 1e-6  # rays on the very rim are moved in by this much, so that rounding does not exclude them


def extrapolated(model: CameraModel, observed_px: Array, directions: Array) -> Projection:
    """Pixels (N, 2) of directions (N, 3) of any length near the rays of `observed_px` (N, 2), linearised there.

    With b the observed ray, D the model's derivative there and y a unit direction, the pixel is
    `observed + D y * 2 / (1 + b . y)` (stereographic, so that it grows all the way to the opposite ray).
    Not valid where the model has no ray for the observed pixel itself.
    """
    rays, valid = model.unproject(observed_px)
    inner = np.where(valid[:, None], rays, (0.0, 0.0, 1.0)) + np.array([0.0, 0.0, _INWARDS])
    at_rays = model.project_with_jacobians(inner)
    valid = valid & at_rays.valid
    D = at_rays.d_point * np.linalg.norm(inner, axis=1)[:, None, None]
    b = inner / np.linalg.norm(inner, axis=1, keepdims=True)
    lengths = np.linalg.norm(directions, axis=1, keepdims=True)
    y = directions / lengths
    stretch = 2 / np.maximum(1 + np.sum(b * y, axis=1), 1e-3)[:, None]
    offset = np.einsum("nij,nj->ni", D, y) * stretch
    by_unit = stretch[..., None] * (D - 0.5 * offset[:, :, None] * b[:, None, :])
    by_direction = (by_unit - (by_unit @ y[:, :, None]) * y[:, None, :]) / lengths[..., None]
    none = np.zeros((len(y), 2, at_rays.d_params.shape[2]))
    pixels = np.where(valid[:, None], observed_px + offset, np.nan)
    return Projection(pixels, valid, np.where(valid[:, None, None], by_direction, 0.0), none)
