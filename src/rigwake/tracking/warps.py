"""How a turning camera deforms image patches.

Between two frames the bearings of a patch turn with the camera; a fisheye draws them rotated, squeezed and
stretched. Far away (and on water most things are) this is nearly all the deformation there is, and it is known
from the lens and from the rotation, which the tracks themselves tell.
"""

from __future__ import annotations

import numpy as np

from rigwake.cameras.base import CameraModel, Mask
from rigwake.geometry import so3
from rigwake.geometry.so3 import Array

_STENCIL_PX = 2.0
_STENCIL = np.array([[1.0, 0], [-1, 0], [0, 1], [0, -1]]) * _STENCIL_PX
_MIN_ANGLE = 1e-4  # scale of the robust loss: about a fiftieth of a pixel of a wide lens


def dominant_rotation(bearings_before: Array, bearings_after: Array) -> Array:
    """Rotation `after_from_before` (3, 3) of most bearings (N, 3); identity without any.

    Kabsch's solution with Cauchy weights, five rounds; what moves otherwise (near points, water) is outvoted.
    """
    weights = np.ones(len(bearings_before))
    rotation = np.eye(3)
    if len(weights) < 2:
        return rotation
    for _ in range(5):
        rotation = so3.nearest_rotation((bearings_after * weights[:, None]).T @ bearings_before)
        error = np.linalg.norm(bearings_after - bearings_before @ rotation.T, axis=1)
        scale = max(1.4826 * float(np.median(error)), _MIN_ANGLE)
        weights = 1.0 / (1.0 + (error / scale) ** 2)
    return rotation


def stencil_bearings(model: CameraModel, pixels: Array) -> tuple[Array, Mask]:
    """Bearings (N, 4, 3) of the pixels 2 px right, left, below and above each pixel (N, 2), and validity (N,)."""
    bearings, valid = model.unproject((pixels[:, None] + _STENCIL).reshape(-1, 2))
    return bearings.reshape(-1, 4, 3), np.asarray(valid.reshape(-1, 4).all(axis=1))


def rotation_warps(
    model: CameraModel, reference_stencils: Array, after_from_reference: Array, bearings_after: Array
) -> tuple[Array, Mask]:
    """Affine warps (N, 2, 2) of patches by the turn of the camera, and validity (N,).

    reference_stencils: (N, 4, 3) from `stencil_bearings` in the reference frames. after_from_reference:
    (N, 3, 3) rotation of the camera since then. bearings_after: (N, 3) where the patch is now: what parallax
    has added to the turn is taken as the smallest rotation that explains it.
    """
    stencils = np.einsum("nij,nkj->nki", after_from_reference, reference_stencils)
    centres = stencils.sum(axis=1)
    centres /= np.linalg.norm(centres, axis=1, keepdims=True)
    stencils = np.einsum("nij,nkj->nki", _smallest_rotation(centres, bearings_after), stencils)
    pixels, valid = model.project(stencils.reshape(-1, 3))
    right, left, below, above = pixels.reshape(-1, 4, 2).transpose(1, 0, 2)
    warps = np.stack([right - left, below - above], axis=2) / (2 * _STENCIL_PX)
    good = np.asarray(valid.reshape(-1, 4).all(axis=1))
    warps[~good] = np.eye(2)
    return warps, good


def _smallest_rotation(before: Array, after: Array) -> Array:
    """Rotations (N, 3, 3) that take unit vectors to unit vectors about their common normal."""
    K = so3.hat(np.cross(before, after))
    cosine = np.einsum("ni,ni->n", before, after)
    return np.asarray(np.eye(3) + K + K @ K / np.maximum(1.0 + cosine, 1e-9)[:, None, None])
