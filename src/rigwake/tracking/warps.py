"""How a turning camera deforms image patches.

Between two frames the bearings of a patch turn with the camera; a fisheye draws them rotated, squeezed and
stretched. Far away (and on water most things are) this is nearly all the deformation there is, and it is known
from the lens and from the rotation, which the tracks themselves tell.
"""

from __future__ import annotations

from math import sqrt

import numpy as np

from rigwake._kernels import njit
from rigwake._robust import MAD_TO_STD
from rigwake._types import Array, Mask
from rigwake.geometry import so3
from rigwake.tracking.picture_scale import ScaledRays

_STENCIL_PX = 2.0
_STENCIL = np.array([[1.0, 0], [-1, 0], [0, 1], [0, -1], [1, 1], [-1, -1], [0, 0]]) * _STENCIL_PX
_ROUNDS = 5
_MIN_ANGLE = 1e-4  # scale of the robust loss: about a fiftieth of a pixel of a wide lens


def dominant_rotation(bearings_before: Array, bearings_after: Array) -> Array:
    """Rotation `after_from_before` (3, 3) of most bearings (N, 3); identity without any.

    Kabsch's solution with Cauchy weights, five rounds; what moves otherwise (near points, water) is outvoted.
    """
    if len(bearings_before) < 2:
        return np.eye(3)
    return np.asarray(_kabsch(np.ascontiguousarray(bearings_before), np.ascontiguousarray(bearings_after)))


@njit(nogil=True)
def _kabsch(before: Array, after: Array) -> Array:
    weights, error, rotation = np.ones(len(before)), np.empty(len(before)), np.eye(3)
    for _ in range(_ROUNDS):
        moment = np.zeros((3, 3))
        for n in range(len(before)):
            for i in range(3):
                for j in range(3):
                    moment[i, j] += weights[n] * after[n, i] * before[n, j]
        u, _, vt = np.linalg.svd(moment)
        u[:, 2] *= np.linalg.det(u) * np.linalg.det(vt)
        rotation = u @ vt
        for n in range(len(before)):
            squared = 0.0
            for i in range(3):
                seen = (
                    rotation[i, 0] * before[n, 0]
                    + rotation[i, 1] * before[n, 1]
                    + rotation[i, 2] * before[n, 2]
                )
                squared += (after[n, i] - seen) ** 2
            error[n] = sqrt(squared)
        scale = max(MAD_TO_STD * np.median(error), _MIN_ANGLE)
        for n in range(len(before)):
            weights[n] = 1.0 / (1.0 + (error[n] / scale) ** 2)
    return rotation


def stencil_bearings(model: ScaledRays, pixels: Array) -> tuple[Array, Mask]:
    """Bearings (N, 7, 3) of pixels (N, 2) and of six pixels about each of them, and validity (N,).

    These are 2 px to the right, left, below and above, on the diagonal to the lower right and upper left, and the
    pixel itself.
    """
    n_points = len(_STENCIL)
    bearings, valid = model.unproject((pixels[:, None] + _STENCIL).reshape(-1, 2))
    return bearings.reshape(len(pixels), n_points, 3), np.asarray(
        valid.reshape(len(pixels), n_points).all(axis=1)
    )


def rotation_warps(
    model: ScaledRays, reference_stencils: Array, after_from_reference: Array, bearings_after: Array
) -> tuple[Array, Array, Mask]:
    """Warps of patches by the turn of the camera: affine (N, 2, 2), their bends (N, 2, 3), and validity (N,).

    reference_stencils: (N, 7, 3) from `stencil_bearings` in the reference frames. after_from_reference:
    (N, 3, 3) rotation of the camera since then. bearings_after: (N, 3) where the patch is now: what parallax
    has added to the turn is taken as the smallest rotation that explains it. The bends are the second derivatives of
    the pixel by that in the reference: xx, xy, yy.
    """
    centres = np.einsum("nij,nj->ni", after_from_reference, reference_stencils[:, -1])
    turned = _smallest_rotation(centres, bearings_after) @ after_from_reference
    stencils = np.einsum("nij,nkj->nki", turned, reference_stencils)
    pixels, valid = model.project(stencils.reshape(-1, 3))
    pixels = pixels.reshape(len(stencils), len(_STENCIL), 2)
    right, left, below, above, lower_right, upper_left, centre = pixels.transpose(1, 0, 2)
    warps = np.stack([right - left, below - above], axis=2) / (2 * _STENCIL_PX)
    second_xx, second_yy = right + left - 2 * centre, below + above - 2 * centre
    second_xy = (lower_right + upper_left - 2 * centre - second_xx - second_yy) / 2
    second_order = np.stack([second_xx, second_xy, second_yy], axis=2) / _STENCIL_PX**2
    good = np.asarray(valid.reshape(len(stencils), len(_STENCIL)).all(axis=1))
    warps[~good] = np.eye(2)
    second_order[~good] = 0.0
    return warps, second_order, good


def _smallest_rotation(before: Array, after: Array) -> Array:
    """Rotations (N, 3, 3) that take unit vectors to unit vectors about their common normal."""
    K = so3.hat(np.cross(before, after))
    cosine = np.einsum("ni,ni->n", before, after)
    return np.asarray(np.eye(3) + K + K @ K / np.maximum(1.0 + cosine, 1e-9)[:, None, None])
