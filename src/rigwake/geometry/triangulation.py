"""Points from unit bearings seen from known places: two-view DLT, and any number of rays at once.

All functions work on rays (`origin + range * direction`, range > 0), so points behind a lens's image plane
are points like any other.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rigwake._kernels import njit
from rigwake._types import Array, Indices
from rigwake.geometry.se3 import SE3


@dataclass(frozen=True, eq=False)
class Triangulated:
    """Points of P groups of rays.

    points: (P, 3), NaN where the rays do not fix a point. max_parallax: (P,) the largest angle at the point
    between the first ray and any other, radians. rms_angle: (P,) root mean square angle between ray and point.
    ahead: (P,) whether the point lies ahead along every ray.
    """

    points: Array
    max_parallax: Array
    rms_angle: Array
    ahead: NDArray[np.bool_]

    def accepted(self, min_parallax: float, max_rms_angle: float) -> NDArray[np.bool_]:
        """(P,) points that are ahead, with enough parallax, and agree with their rays."""
        good = np.isfinite(self.points).all(1) & self.ahead
        return good & (self.max_parallax >= min_parallax) & (self.rms_angle <= max_rms_angle)


def triangulate_midpoint(second_from_first: SE3, bearings_first: Array, bearings_second: Array) -> Array:
    """The points nearest to both rays, in the first camera's frame: (N, 3), (N, 3) -> (N, 3)."""
    first_from_second = second_from_first.inverse()
    n = len(bearings_first)
    origins = np.zeros((n, 2, 3))
    origins[:, 1] = first_from_second.translation
    directions = np.stack([bearings_first, bearings_second @ first_from_second.rotation.T], axis=1)
    return triangulate_rays(
        origins.reshape(-1, 3), directions.reshape(-1, 3), np.arange(0, 2 * n + 1, 2), refine=False
    ).points


@njit(error_model="numpy")
def _nearest_point(origins: Array, directions: Array, weights: Array, lo: int, hi: int) -> tuple[Array, bool]:
    """Minimises the weighted squared distances to the rays lo..hi."""
    A = np.zeros((3, 3))
    b = np.zeros(3)
    for k in range(lo, hi):
        d = directions[k]
        o = origins[k]
        along = d[0] * o[0] + d[1] * o[1] + d[2] * o[2]
        for i in range(3):
            for j in range(3):
                A[i, j] -= weights[k] * d[i] * d[j]
            A[i, i] += weights[k]
            b[i] += weights[k] * (o[i] - along * d[i])
    c00 = A[1, 1] * A[2, 2] - A[1, 2] * A[2, 1]
    c01 = A[1, 2] * A[2, 0] - A[1, 0] * A[2, 2]
    c02 = A[1, 0] * A[2, 1] - A[1, 1] * A[2, 0]
    det = A[0, 0] * c00 + A[0, 1] * c01 + A[0, 2] * c02
    trace = A[0, 0] + A[1, 1] + A[2, 2]
    x = np.zeros(3)
    if det <= 1e-14 * trace**3:
        return x, False
    x[0] = (c00 * b[0] + c01 * b[1] + c02 * b[2]) / det
    x[1] = (
        c01 * b[0]
        + (A[0, 0] * A[2, 2] - A[0, 2] * A[2, 0]) * b[1]
        + (A[0, 2] * A[1, 0] - A[0, 0] * A[1, 2]) * b[2]
    ) / det
    x[2] = (
        c02 * b[0]
        + (A[0, 1] * A[2, 0] - A[0, 0] * A[2, 1]) * b[1]
        + (A[0, 0] * A[1, 1] - A[0, 1] * A[1, 0]) * b[2]
    ) / det
    return x, True


@njit(error_model="numpy")
def _direction(x: Array, origin: Array, out: Array) -> None:
    d0, d1, d2 = x[0] - origin[0], x[1] - origin[1], x[2] - origin[2]
    norm = max(np.sqrt(d0 * d0 + d1 * d1 + d2 * d2), 1e-18)
    out[0], out[1], out[2] = d0 / norm, d1 / norm, d2 / norm


@njit(error_model="numpy")
def _angle(a: Array, b: Array) -> float:
    x, y, z = a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]
    return float(np.arctan2(np.sqrt(x * x + y * y + z * z), a[0] * b[0] + a[1] * b[1] + a[2] * b[2]))


@njit(error_model="numpy")
def _triangulate(
    origins: Array, directions: Array, starts: Indices, rounds: int
) -> tuple[Array, Array, Array, NDArray[np.bool_]]:
    count = len(starts) - 1
    points = np.full((count, 3), np.nan)
    parallax = np.zeros(count)
    rms = np.full(count, np.inf)
    ahead = np.zeros(count, dtype=np.bool_)
    weights = np.ones(len(origins))
    first, ray = np.zeros(3), np.zeros(3)
    for p in range(count):
        lo, hi = starts[p], starts[p + 1]
        if hi - lo < 2:
            continue
        x, fixed = _nearest_point(origins, directions, weights, lo, hi)
        for _ in range(rounds):
            if not fixed:
                break
            for k in range(lo, hi):
                o = origins[k]
                squared = (x[0] - o[0]) ** 2 + (x[1] - o[1]) ** 2 + (x[2] - o[2]) ** 2
                weights[k] = 1.0 / max(squared, 1e-18)
            x, fixed = _nearest_point(origins, directions, weights, lo, hi)
        if not fixed:
            continue
        points[p, 0], points[p, 1], points[p, 2] = x[0], x[1], x[2]
        _direction(x, origins[lo], first)
        squares, all_ahead = 0.0, True
        for k in range(lo, hi):
            _direction(x, origins[k], ray)
            angle = _angle(ray, directions[k])
            squares += angle * angle
            all_ahead = all_ahead and angle < 0.5 * np.pi
            parallax[p] = max(parallax[p], _angle(first, ray))
        rms[p] = np.sqrt(squares / (hi - lo))
        ahead[p] = all_ahead
    return points, parallax, rms, ahead


def triangulate_rays(
    origins: Array, directions: Array, starts: Indices, *, refine: bool = True
) -> Triangulated:
    """Triangulate P points, each from its own rays.

    origins, directions (unit): (M, 3), the rays of point p being rows `starts[p]:starts[p + 1]`; starts:
    (P + 1,). The point nearest to all rays, and with `refine` the same again with weights 1 / range^2, so that
    angles (what a camera measures) are minimised instead of distances.
    """
    result = _triangulate(
        np.ascontiguousarray(origins, dtype=np.float64),
        np.ascontiguousarray(directions, dtype=np.float64),
        np.ascontiguousarray(starts, dtype=np.int64),
        3 if refine else 0,
    )
    return Triangulated(*result)
