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
_MOST_SWEEPS = 12  # Jacobi's method needs about five
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
    weights, error, rotation = np.ones(len(before)), np.empty(len(before)), np.zeros((3, 3))
    for _ in range(_ROUNDS):
        moment = np.zeros((3, 3))
        for n in range(len(before)):
            for i in range(3):
                for j in range(3):
                    moment[i, j] += weights[n] * after[n, i] * before[n, j]
        _nearest_rotation(moment, rotation)
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


# in loops: what numba has for singular values takes ten seconds to compile
@njit(nogil=True, error_model="numpy")
def _nearest_rotation(moment: Array, rotation: Array) -> None:
    """Into `rotation` (3, 3) the R with the largest trace of `R^T moment`: the quaternion that is the eigenvector with
    the largest eigenvalue of a symmetric matrix (Horn 1987), by Jacobi's rotations."""
    m, q, s = np.zeros((4, 4)), np.zeros((4, 4)), moment
    m[0, 0] = s[0, 0] + s[1, 1] + s[2, 2]
    m[1, 1], m[2, 2] = s[0, 0] - s[1, 1] - s[2, 2], s[1, 1] - s[0, 0] - s[2, 2]
    m[3, 3] = s[2, 2] - s[0, 0] - s[1, 1]
    m[0, 1], m[0, 2], m[0, 3] = s[2, 1] - s[1, 2], s[0, 2] - s[2, 0], s[1, 0] - s[0, 1]
    m[1, 2], m[1, 3], m[2, 3] = s[0, 1] + s[1, 0], s[0, 2] + s[2, 0], s[1, 2] + s[2, 1]
    for i in range(4):
        q[i, i] = 1.0
        for j in range(i):
            m[i, j] = m[j, i]
    for _ in range(_MOST_SWEEPS):
        rest = 0.0
        for i in range(4):
            for j in range(i):
                rest += m[i, j] * m[i, j]
                _annul(m, q, i, j)
        if rest <= 1e-32 * (m[0, 0] ** 2 + m[1, 1] ** 2 + m[2, 2] ** 2 + m[3, 3] ** 2):
            break
    best = 0
    for i in range(1, 4):
        if m[i, i] > m[best, best]:
            best = i
    w, x, y, z = q[0, best], q[1, best], q[2, best], q[3, best]
    rotation[0, 0], rotation[0, 1], rotation[0, 2] = (
        1 - 2 * (y * y + z * z),
        2 * (x * y - w * z),
        2 * (x * z + w * y),
    )
    rotation[1, 0], rotation[1, 1], rotation[1, 2] = (
        2 * (x * y + w * z),
        1 - 2 * (x * x + z * z),
        2 * (y * z - w * x),
    )
    rotation[2, 0], rotation[2, 1], rotation[2, 2] = (
        2 * (x * z - w * y),
        2 * (y * z + w * x),
        1 - 2 * (x * x + y * y),
    )


@njit(nogil=True, error_model="numpy")
def _annul(m: Array, vectors: Array, i: int, j: int) -> None:
    """One rotation of Jacobi's: entry (i, j) of the symmetric `m` (4, 4) becomes zero, `vectors` turn with it."""
    if m[i, j] == 0.0:
        return
    theta = (m[j, j] - m[i, i]) / (2 * m[i, j])
    t = (1.0 if theta >= 0 else -1.0) / (abs(theta) + sqrt(theta * theta + 1))
    c = 1 / sqrt(t * t + 1)
    s = t * c
    for k in range(4):
        a, b = m[k, i], m[k, j]
        m[k, i], m[k, j] = c * a - s * b, s * a + c * b
    for k in range(4):
        a, b = m[i, k], m[j, k]
        m[i, k], m[j, k] = c * a - s * b, s * a + c * b
        a, b = vectors[k, i], vectors[k, j]
        vectors[k, i], vectors[k, j] = c * a - s * b, s * a + c * b


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
