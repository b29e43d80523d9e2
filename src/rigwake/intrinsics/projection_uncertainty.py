"""How uncertain a calibrated lens's projection is, over the image.

A parameter alone says little: a longer focal length and a stronger distortion may cancel. What counts is where a
distant point lands. A turn of the whole camera is not an error of the lens, since every later
estimate takes it up; so the turn
that explains most of the change is taken out, as mrcal does for its implied transformation
(https://mrcal.secretsauce.net/uncertainty.html).
"""

from __future__ import annotations

import numpy as np

from rigwake._types import Array
from rigwake.geometry import so3
from rigwake.intrinsics.board_calibration import IntrinsicCalibration


def projection_std_px(result: IntrinsicCalibration, pixels: Array) -> Array:
    """(N,) standard deviations along the worst direction, px, of the projections of distant points now at `pixels`
    (N, 2); NaN outside the lens, infinite where an unobservable parameter moves them.

    The turn taken out is the one that fits best at those of the pixels that the board reached.
    """
    camera, covariance = result.camera, result.covariance
    bearings, seen = camera.unproject(np.asarray(pixels, np.float64))
    std = np.full(len(bearings), np.nan)
    rows = np.flatnonzero(seen)
    projection = camera.project_with_jacobians(bearings[rows])
    rows, valid = rows[projection.valid], projection.valid
    if not len(rows):
        return std
    J = projection.d_params[valid]
    by_turn = -projection.d_point[valid] @ so3.hat(bearings[rows])  # of R exp(w): R (b + w x b)
    reached = np.arccos(np.clip(bearings[rows, 2], -1, 1)) <= result.max_observed_angle
    fitted = reached if reached.sum() >= 3 else np.ones(len(rows), np.bool_)
    turn = np.linalg.lstsq(
        by_turn[fitted].reshape(-1, 3), J[fitted].reshape(-1, J.shape[2]), rcond=None
    )[0]  # fmt: skip
    J = J - by_turn @ turn
    known = np.isfinite(np.diag(covariance))
    C = np.where(known[:, None] & known[None, :], covariance, 0.0)
    moved = np.linalg.eigvalsh(np.einsum("nap,pq,nbq->nab", J, C, J))[:, -1]
    std[rows] = np.sqrt(np.maximum(moved, 0.0))
    if not known.all():
        std[rows[np.abs(J[:, :, ~known]).max(axis=(1, 2)) > 1e-9]] = np.inf
    return std
