"""Relative pose of two views from matched unit bearings; nothing assumes that a point lies in front (z > 0).

`second_from_first` maps the first camera's frame to the second's. Its translation is a direction:
two views do not know the scale. A bearing pair fulfils `b2^T [t]x R b1 = 0` (Longuet-Higgins 1981).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import poselib

from rigwake._kernels import njit
from rigwake._types import Array, Indices, Mask
from rigwake.errors import EstimationError
from rigwake.geometry import so3
from rigwake.geometry.ransac import Budget, search
from rigwake.geometry.se3 import SE3

SOLVERS = ("five-point", "eight-point")


@dataclass(frozen=True, eq=False)
class TwoView:
    """A relative pose with unit translation, the pairs that agree with it, and the RANSAC trials spent.

    parallax: (N,) angle between the two rays of each pair after the rotation is undone, radians; all small:
    the translation direction means nothing (the views differ by a rotation only).
    """

    second_from_first: SE3
    inliers: Mask
    parallax: Array
    trials: int


def rotation_compensated_parallax(rotation: Array, bearings_first: Array, bearings_second: Array) -> Array:
    """Angle between `R b1` and `b2`: what a rotation `second_from_first` leaves unexplained, (N,) radians."""
    turned = bearings_first @ rotation.T
    cross = np.linalg.norm(np.cross(turned, bearings_second), axis=-1)
    return np.asarray(np.arctan2(cross, np.einsum("ni,ni->n", turned, bearings_second)))


@njit()
def _sampson(R: Array, t: Array, first: Array, second: Array) -> Array:
    out = np.empty(len(first))
    E = np.empty((3, 3))
    for j in range(3):
        E[0, j] = t[1] * R[2, j] - t[2] * R[1, j]
        E[1, j] = t[2] * R[0, j] - t[0] * R[2, j]
        E[2, j] = t[0] * R[1, j] - t[1] * R[0, j]
    for n in range(len(first)):
        e = n1 = n2 = 0.0
        for i in range(3):
            row = E[i, 0] * first[n, 0] + E[i, 1] * first[n, 1] + E[i, 2] * first[n, 2]
            col = E[0, i] * second[n, 0] + E[1, i] * second[n, 1] + E[2, i] * second[n, 2]
            e += second[n, i] * row
            n1 += row * row
            n2 += col * col
        out[n] = abs(e) / np.sqrt(max(n1 + n2 - 2 * e * e, 1e-12))
    return out


def sampson_angles(second_from_first: SE3, bearings_first: Array, bearings_second: Array) -> Array:
    """First-order angular distance of pairs (N, 3), (N, 3) to the epipolar constraint, radians (N,).

    `|e| / sqrt(|E b1|^2 + |E^T b2|^2 - 2 e^2)` with `e = b2^T E b1`: Sampson's distance on the unit
    sphere, where only the part of the gradient tangent to the sphere counts.
    """
    return np.asarray(
        _sampson(
            np.ascontiguousarray(second_from_first.rotation),
            np.ascontiguousarray(second_from_first.translation),
            np.ascontiguousarray(bearings_first),
            np.ascontiguousarray(bearings_second),
        )
    )


def in_front(second_from_first: SE3, bearings_first: Array, bearings_second: Array) -> Mask:
    """(N,) whether both rays of a pair meet ahead of their cameras, along the bearings (not: z > 0).

    With `s b2 = r R b1 + t`, both `r > 0` and `s > 0` for the nearest points of the rays.
    """
    a = bearings_first @ second_from_first.rotation.T
    b, t = bearings_second, second_from_first.translation
    cos, at, bt = np.einsum("ni,ni->n", a, b), a @ t, b @ t
    return np.asarray((cos * bt - at > 0) & (bt - cos * at > 0))


def refine_relative_pose(
    second_from_first: SE3, bearings_first: Array, bearings_second: Array, iterations: int = 5
) -> SE3:
    """Gauss-Newton on Sampson angles over rotation and translation direction (5 degrees of freedom)."""
    R, t = second_from_first.rotation, second_from_first.translation
    for _ in range(iterations):
        turned = bearings_first @ R.T
        E = so3.hat(t) @ R
        row, col = bearings_first @ E.T, bearings_second @ E
        e = np.einsum("ni,ni->n", bearings_second, row)
        norm = np.sqrt(np.maximum((row**2).sum(1) + (col**2).sum(1) - 2 * e**2, 1e-12))
        tangent = np.linalg.svd(t[None])[2][1:]
        d_rotation = -np.einsum("ni,nij->nj", col, so3.hat(bearings_first))
        d_direction = np.cross(turned, bearings_second) @ tangent.T
        J = np.hstack([d_rotation, d_direction]) / norm[:, None]
        step = np.linalg.lstsq(J, -e / norm, rcond=None)[0]
        R = R @ so3.exp(step[:3])
        t = t + step[3:] @ tangent
        t = t / np.linalg.norm(t)
        if np.abs(step).max() < 1e-10:
            break
    return SE3(R, t)


@dataclass(frozen=True, eq=False)
class _Essential:
    first: Array
    second: Array
    max_angle: float
    sample_size: int

    @property
    def count(self) -> int:
        return len(self.first)

    def solve(self, sample: Indices) -> Sequence[SE3]:
        solver = poselib.relpose_5pt if self.sample_size == 5 else poselib.relpose_8pt
        poses = solver(self.first[sample], self.second[sample])
        return [SE3(p.R, p.t / np.linalg.norm(p.t)) for p in poses if np.linalg.norm(p.t) > 1e-9]

    def errors(self, model: SE3) -> Array:
        return sampson_angles(model, self.first, self.second) / self.max_angle

    def polish(self, model: SE3, inliers: Mask) -> SE3:
        return refine_relative_pose(model, self.first[inliers], self.second[inliers])


@dataclass(frozen=True, eq=False)
class _Direction:
    """Translation direction with known rotation: it is normal to `R b1 x b2` of every pair."""

    rotation: Array
    first: Array
    second: Array
    max_angle: float
    normals: Array
    sample_size: int = 2

    @property
    def count(self) -> int:
        return len(self.first)

    def solve(self, sample: Indices) -> Sequence[SE3]:
        direction = np.cross(*self.normals[sample])
        norm = np.linalg.norm(direction)
        return [SE3(self.rotation, direction / norm)] if norm > 1e-12 else []

    def errors(self, model: SE3) -> Array:
        return sampson_angles(model, self.first, self.second) / self.max_angle

    def polish(self, model: SE3, inliers: Mask) -> SE3:
        return SE3(self.rotation, np.linalg.svd(self.normals[inliers])[2][-1])


def _facing(pose: SE3, first: Array, second: Array, inliers: Mask) -> SE3:
    """The sign of the translation that puts most inliers in front."""
    mirrored = SE3(pose.rotation, -pose.translation)
    kept = first[inliers], second[inliers]
    return pose if in_front(pose, *kept).sum() >= in_front(mirrored, *kept).sum() else mirrored


def _checked(bearings_first: Array, bearings_second: Array) -> tuple[Array, Array]:
    first = np.ascontiguousarray(bearings_first, dtype=np.float64)
    second = np.ascontiguousarray(bearings_second, dtype=np.float64)
    if first.shape != second.shape or first.ndim != 2 or first.shape[1] != 3:
        raise EstimationError(f"Bearings must be two (N, 3) arrays, got {first.shape} and {second.shape}.")
    if not (np.isfinite(first).all() and np.isfinite(second).all()):
        raise EstimationError("Bearings contain NaN or infinite values.", remedy="Drop invalid pixels first.")
    return first, second


def relative_pose(
    bearings_first: Array,
    bearings_second: Array,
    *,
    max_angle: float,
    rng: np.random.Generator,
    solver: str = "five-point",
    budget: Budget | None = None,
) -> TwoView:
    """Relative pose by RANSAC over Nister's five-point solver (or the eight-point one, for comparison).

    bearings_first, bearings_second: (N, 3) unit vectors of the same points. max_angle: inlier gate on the
    Sampson angle, radians. Raises EstimationError with too few or broken pairs.
    """
    if solver not in SOLVERS:
        raise EstimationError(f"No two-view solver {solver!r}.", remedy=f"Choose from {', '.join(SOLVERS)}.")
    first, second = _checked(bearings_first, bearings_second)
    size = 5 if solver == "five-point" else 8
    found = search(_Essential(first, second, max_angle, size), rng, budget)
    return _two_view(found.model, first, second, found.inliers, found.trials)


def relative_pose_known_rotation(
    rotation: Array,
    bearings_first: Array,
    bearings_second: Array,
    *,
    max_angle: float,
    rng: np.random.Generator,
    budget: Budget | None = None,
) -> TwoView:
    """Translation direction by two-point RANSAC with known rotation `second_from_first` (3, 3): a gyroscope's.

    The cost hardly grows with outliers. Where there is no parallax there is no direction: `TwoView.parallax`
    tells. Raises EstimationError with too few or broken pairs, or if all pairs are explained by the rotation.
    """
    first, second = _checked(bearings_first, bearings_second)
    normals = np.cross(first @ rotation.T, second)
    found = search(_Direction(rotation, first, second, max_angle, normals), rng, budget)
    return _two_view(found.model, first, second, found.inliers, found.trials)


def _two_view(model: SE3, first: Array, second: Array, inliers: Mask, trials: int) -> TwoView:
    pose = _facing(model, first, second, inliers)
    parallax = rotation_compensated_parallax(pose.rotation, first, second)
    # a pair whose rays meet behind a camera is no inlier, unless it is too far away to tell
    ahead = in_front(pose, first, second) | (parallax < 1e-3)
    return TwoView(pose, inliers & ahead, parallax, trials)


def rotation_between(bearings_first: Array, bearings_second: Array, scale: float = 0.01) -> Array:
    """The rotation `second_from_first` (3, 3) that best explains the pairs without any translation.

    Wahba's problem by SVD, reweighted with Cauchy weights of this scale (radians) against near points and
    outliers.
    """
    first, second = _checked(bearings_first, bearings_second)
    weights = np.ones(len(first))
    R = np.eye(3)
    for _ in range(10):
        R = so3.nearest_rotation((second * weights[:, None]).T @ first)
        weights = 1 / (1 + (rotation_compensated_parallax(R, first, second) / scale) ** 2)
    return R
