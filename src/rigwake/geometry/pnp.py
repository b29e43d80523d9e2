"""Pose of one camera from known points and the unit bearings that see them (PnP), also beyond 90 degrees."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import poselib
from numpy.typing import NDArray

from rigwake._kernels import njit
from rigwake._types import Array, Mask
from rigwake.errors import EstimationError
from rigwake.geometry import so3
from rigwake.geometry.ransac import Budget, search
from rigwake.geometry.se3 import SE3


@dataclass(frozen=True, eq=False)
class AbsolutePose:
    """A camera's pose, its right-tangent covariance for the given noise, and the points that agree."""

    world_from_cam: SE3
    covariance: Array
    inliers: Mask


@njit(error_model="numpy")
def _bearing_angles(R: Array, c: Array, points: Array, bearings: Array) -> Array:
    """Angles between bearings and the directions to points; R, c: world_from_cam."""
    out = np.empty(len(points))
    for n in range(len(points)):
        d0, d1, d2 = points[n, 0] - c[0], points[n, 1] - c[1], points[n, 2] - c[2]
        x = R[0, 0] * d0 + R[1, 0] * d1 + R[2, 0] * d2
        y = R[0, 1] * d0 + R[1, 1] * d1 + R[2, 1] * d2
        z = R[0, 2] * d0 + R[1, 2] * d1 + R[2, 2] * d2
        b = bearings[n]
        cx, cy, cz = y * b[2] - z * b[1], z * b[0] - x * b[2], x * b[1] - y * b[0]
        out[n] = np.arctan2(np.sqrt(cx * cx + cy * cy + cz * cz), x * b[0] + y * b[1] + z * b[2])
    return out


def bearing_angles(world_from_cam: SE3, points_world: Array, bearings_cam: Array) -> Array:
    """Angle between each bearing and the direction to its point, radians: (N, 3), (N, 3) -> (N,)."""
    return np.asarray(
        _bearing_angles(
            np.ascontiguousarray(world_from_cam.rotation),
            np.ascontiguousarray(world_from_cam.translation),
            np.ascontiguousarray(points_world),
            np.ascontiguousarray(bearings_cam),
        )
    )


@njit(error_model="numpy")
def _tangents(b: Array, e: Array) -> None:
    """Writes two unit vectors normal to b and to each other into e (2, 3) (Duff et al., JCGT 2017)."""
    sign = 1.0 if b[2] >= 0 else -1.0
    p = -1.0 / (sign + b[2])
    q = b[0] * b[1] * p
    e[0, 0], e[0, 1], e[0, 2] = 1.0 + sign * b[0] * b[0] * p, sign * q, -sign * b[0]
    e[1, 0], e[1, 1], e[1, 2] = q, sign + b[1] * b[1] * p, -b[1]


@njit(error_model="numpy")
def _normal_equations(
    R: Array, c: Array, points: Array, bearings: Array, stds: Array, scale: float
) -> tuple[Array, Array, float]:
    """J^T W J, J^T W r and the Cauchy cost of the whitened components of `u` tangent to the sphere at `b`.

    `u` is the direction to the point in the camera frame, X / |X|; a right perturbation [w, v] of
    world_from_cam moves X by `X x w - v`. Points on the far side of the sphere cost, and do not pull.
    """
    H, g, cost = np.zeros((6, 6)), np.zeros(6), 0.0
    X, u, row, e = np.zeros(3), np.zeros(3), np.zeros(6), np.zeros((2, 3))
    for n in range(len(points)):
        d0, d1, d2 = points[n, 0] - c[0], points[n, 1] - c[1], points[n, 2] - c[2]
        for i in range(3):
            X[i] = R[0, i] * d0 + R[1, i] * d1 + R[2, i] * d2
        norm = max(np.sqrt(X[0] ** 2 + X[1] ** 2 + X[2] ** 2), 1e-12)
        b = bearings[n]
        for i in range(3):
            u[i] = X[i] / norm
        if u[0] * b[0] + u[1] * b[1] + u[2] * b[2] <= 0:
            cost += 0.5 * scale**2 * np.log1p(4.0 / (stds[n] * scale) ** 2)
            continue
        _tangents(b, e)
        r0 = (e[0, 0] * u[0] + e[0, 1] * u[1] + e[0, 2] * u[2]) / stds[n]
        r1 = (e[1, 0] * u[0] + e[1, 1] * u[1] + e[1, 2] * u[2]) / stds[n]
        s = (r0 * r0 + r1 * r1) / scale**2
        weight = 1.0 / (1.0 + s)
        cost += 0.5 * scale**2 * np.log1p(s)
        for k in range(2):
            r = r0 if k == 0 else r1
            for i in range(3):
                row[3 + i] = -(e[k, i] - r * stds[n] * u[i]) / (norm * stds[n])
            row[0] = row[5] * X[1] - row[4] * X[2]
            row[1] = row[3] * X[2] - row[5] * X[0]
            row[2] = row[4] * X[0] - row[3] * X[1]
            for i in range(6):
                g[i] += weight * row[i] * r
                for j in range(i, 6):
                    H[i, j] += weight * row[i] * row[j]
    for i in range(6):
        for j in range(i):
            H[i, j] = H[j, i]
    return H, g, cost


@njit(error_model="numpy")
def _moved(R: Array, c: Array, step: Array) -> tuple[Array, Array]:
    """`SE3(R, c).retract(step)`, in loops: products of small arrays take long to compile."""
    w = step
    squared = w[0] * w[0] + w[1] * w[1] + w[2] * w[2]
    if squared < 1e-8:
        a, b, d = 1 - squared / 6, 0.5 - squared / 24, 1 / 6 - squared / 120
    else:
        angle = np.sqrt(squared)
        a = np.sin(angle) / angle
        b, d = 2 * np.sin(angle / 2) ** 2 / squared, (1 - a) / squared
    turn, new_R, new_c, v = np.empty((3, 3)), np.empty((3, 3)), np.empty(3), np.empty(3)
    for i in range(3):
        v[i] = 0.0
        for j in range(3):
            # of the cross product's matrix, and of its square
            hat = 0.0 if i == j else (w[3 - i - j] if (i - j) % 3 == 1 else -w[3 - i - j])
            square, unit = w[i] * w[j], 0.0
            if i == j:
                square, unit = square - squared, 1.0
            turn[i, j] = unit + a * hat + b * square
            v[i] += (unit + b * hat + d * square) * step[3 + j]
    for i in range(3):
        new_c[i] = c[i] + R[i, 0] * v[0] + R[i, 1] * v[1] + R[i, 2] * v[2]
        for j in range(3):
            new_R[i, j] = R[i, 0] * turn[0, j] + R[i, 1] * turn[1, j] + R[i, 2] * turn[2, j]
    return new_R, new_c


@njit(error_model="numpy")
def _damped_step(H: Array, g: Array, damping: float) -> Array:
    """`-(H + damping diag(H))^-1 g` by L D L^T."""
    n = len(g)
    L, step = H.copy(), np.empty(n)
    for i in range(n):
        L[i, i] += damping * (H[i, i] + 1e-12)
        step[i] = -g[i]
        for j in range(i + 1):
            total = L[i, j]
            for k in range(j):
                total -= L[i, k] * L[j, k] * L[k, k]
            if i > j:
                total /= L[j, j]
                step[i] -= total * step[j]
            L[i, j] = total
    for i in range(n - 1, -1, -1):
        step[i] /= L[i, i]
        for k in range(i + 1, n):
            step[i] -= L[k, i] * step[k]
    return step


@njit(error_model="numpy")
def _minimise(
    R: Array, c: Array, points: Array, bearings: Array, stds: Array, scale: float, iterations: int
) -> tuple[Array, Array, Array]:
    """Levenberg-Marquardt: the pose and the normal matrix there."""
    H, g, cost = _normal_equations(R, c, points, bearings, stds, scale)
    damping = 1e-6
    for _ in range(iterations):
        step = _damped_step(H, g, damping)
        new_R, new_c = _moved(R, c, step)
        new_H, new_g, new_cost = _normal_equations(new_R, new_c, points, bearings, stds, scale)
        if new_cost <= cost:
            done = cost - new_cost < 1e-6 * cost
            R, c, H, g, cost = new_R, new_c, new_H, new_g, new_cost
            damping = max(damping * 0.1, 1e-9)
            if done:
                break
        else:
            damping *= 100
    return R, c, H


def refine_absolute_pose(
    world_from_cam: SE3,
    points_world: Array,
    bearings_cam: Array,
    angle_stds: Array,
    *,
    robust_scale: float = 3.0,
    iterations: int = 10,
) -> tuple[SE3, Array]:
    """Levenberg-Marquardt on bearing residuals with a Cauchy loss: the pose and its covariance (6, 6).

    angle_stds: (N,) standard deviation of a bearing per axis, radians. robust_scale: in standard deviations.
    The covariance is the inverse of the weighted normal matrix; infinite where that is singular.
    """
    R, c, H = _minimise(
        np.ascontiguousarray(world_from_cam.rotation),
        np.ascontiguousarray(world_from_cam.translation),
        np.ascontiguousarray(points_world),
        np.ascontiguousarray(bearings_cam),
        np.ascontiguousarray(angle_stds, dtype=np.float64),
        robust_scale,
        iterations,
    )
    try:
        covariance = np.linalg.inv(H)
    except np.linalg.LinAlgError:
        covariance = np.full((6, 6), np.inf)
    return SE3(R, c), np.asarray(covariance)


@dataclass(frozen=True, eq=False)
class _Resection:
    points: Array
    bearings: Array
    gates: Array
    sample_size: int = 3

    @property
    def count(self) -> int:
        return len(self.points)

    def solve(self, sample: NDArray[np.int64]) -> Sequence[SE3]:
        poses = poselib.p3p(self.bearings[sample], self.points[sample])
        return [SE3(so3.nearest_rotation(p.R), p.t).inverse() for p in poses if np.isfinite(p.Rt).all()]

    def errors(self, model: SE3) -> Array:
        return bearing_angles(model, self.points, self.bearings) / self.gates

    def polish(self, model: SE3, inliers: Mask) -> SE3:
        kept = self.points[inliers], self.bearings[inliers], self.gates[inliers]
        return refine_absolute_pose(model, *kept, iterations=5)[0]


def absolute_pose(
    points_world: Array,
    bearings_cam: Array,
    *,
    max_angles: Array,
    angle_stds: Array,
    rng: np.random.Generator,
    budget: Budget | None = None,
) -> AbsolutePose:
    """Pose from N points and bearings, some of them wrong: P3P (Persson and Nordberg 2018), RANSAC, refined.

    points_world, bearings_cam: (N, 3). max_angles: (N,) inlier gates; angle_stds: (N,) standard deviations; both
    in radians, both may be single numbers.
    Raises EstimationError with fewer than three points or if no sample gave a pose.
    """
    points = np.ascontiguousarray(points_world, dtype=np.float64)
    bearings = np.ascontiguousarray(bearings_cam, dtype=np.float64)
    if points.shape != bearings.shape or not (np.isfinite(points).all() and np.isfinite(bearings).all()):
        raise EstimationError("Points and bearings must be finite (N, 3) arrays of equal length.")
    gates = np.broadcast_to(np.asarray(max_angles, dtype=np.float64), (len(points),))
    found = search(_Resection(points, bearings, gates), rng, budget)
    return refined(found.model, points, bearings, max_angles=gates, angle_stds=angle_stds)


def refined(
    world_from_cam: SE3, points_world: Array, bearings_cam: Array, *, max_angles: Array, angle_stds: Array
) -> AbsolutePose:
    """Refine from a good guess (the previous frame's motion) and judge every point anew."""
    stds = np.broadcast_to(np.asarray(angle_stds, dtype=np.float64), (len(points_world),))
    x, covariance = refine_absolute_pose(world_from_cam, points_world, bearings_cam, stds)
    return AbsolutePose(x, covariance, bearing_angles(x, points_world, bearings_cam) <= max_angles)
