"""Compiled loops over the steps of a trajectory: interpolation, residuals, Jacobians and normal equations.

Each computes in one pass what `geometry.se3` says in arrays; the callers document what it means.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from rigwake.geometry.so3 import Array


@njit(cache=True)
def _rotation_vector(R: Array, out: Array) -> None:
    trace = R[0, 0] + R[1, 1] + R[2, 2]
    if trace > -0.5:
        w = 0.5 * math.sqrt(1.0 + trace)
        out[0] = (R[2, 1] - R[1, 2]) / (4 * w)
        out[1] = (R[0, 2] - R[2, 0]) / (4 * w)
        out[2] = (R[1, 0] - R[0, 1]) / (4 * w)
    else:  # beyond 138 degrees the largest component of the axis is the well-conditioned one
        i = 0
        for candidate in (1, 2):
            if R[candidate, candidate] > R[i, i]:
                i = candidate
        j, k = (i + 1) % 3, (i + 2) % 3
        s = math.sqrt(1.0 + R[i, i] - R[j, j] - R[k, k])
        w = (R[k, j] - R[j, k]) / (2 * s)
        sign = -1.0 if w < 0 else 1.0
        w *= sign
        out[i] = sign * s / 2
        out[j] = sign * (R[j, i] + R[i, j]) / (2 * s)
        out[k] = sign * (R[k, i] + R[i, k]) / (2 * s)
    norm = math.sqrt(out[0] * out[0] + out[1] * out[1] + out[2] * out[2])
    factor = 2.0 if norm < 1e-12 else 2 * math.atan2(norm, w) / norm
    for i in range(3):
        out[i] *= factor


@njit(cache=True)
def _add_twice_crossed(phi: Array, v: Array, once: float, twice: float, out: Array) -> None:
    """`out = v + once phi x v + twice phi x (phi x v)`."""
    x = phi[1] * v[2] - phi[2] * v[1]
    y = phi[2] * v[0] - phi[0] * v[2]
    z = phi[0] * v[1] - phi[1] * v[0]
    a, b, c = v[0], v[1], v[2]
    out[0] = a + once * x + twice * (phi[1] * z - phi[2] * y)
    out[1] = b + once * y + twice * (phi[2] * x - phi[0] * z)
    out[2] = c + once * z + twice * (phi[0] * y - phi[1] * x)


@njit(cache=True)
def _log(R: Array, t: Array, out: Array) -> None:
    """Tangent (6,) of one transform."""
    _rotation_vector(R, out[:3])
    angle2 = out[0] * out[0] + out[1] * out[1] + out[2] * out[2]
    if angle2 < 1e-4:
        c = 1 / 12 + angle2 / 720 + angle2 * angle2 / 30240 + angle2**3 / 1209600
    else:
        half = 0.5 * math.sqrt(angle2)
        c = (1 - half / math.tan(half)) / angle2
    _add_twice_crossed(out[:3], t, -0.5, c, out[3:])


@njit(cache=True)
def _exp(tangent: Array, R: Array, t: Array) -> None:
    x, y, z = tangent[0], tangent[1], tangent[2]
    angle2 = x * x + y * y + z * z
    angle = math.sqrt(angle2)
    if angle < 1e-4:
        a, b, c = 1 - angle2 / 6, 0.5 - angle2 / 24, 1 / 6 - angle2 / 120
    else:
        a, b = math.sin(angle) / angle, 2 * math.sin(angle / 2) ** 2 / angle2
        c = (angle - math.sin(angle)) / (angle2 * angle)
    R[0, 0], R[1, 1], R[2, 2] = 1 - b * (y * y + z * z), 1 - b * (x * x + z * z), 1 - b * (x * x + y * y)
    R[0, 1], R[1, 0] = b * x * y - a * z, b * x * y + a * z
    R[0, 2], R[2, 0] = b * x * z + a * y, b * x * z - a * y
    R[1, 2], R[2, 1] = b * y * z - a * x, b * y * z + a * x
    _add_twice_crossed(tangent[:3], tangent[3:], b, c, t)


@njit(cache=True)
def _times(Ra: Array, ta: Array, Rb: Array, tb: Array, R: Array, t: Array) -> None:
    """`(R, t) = a b`; the outputs may not be the inputs."""
    for i in range(3):
        t[i] = ta[i] + Ra[i, 0] * tb[0] + Ra[i, 1] * tb[1] + Ra[i, 2] * tb[2]
        for j in range(3):
            R[i, j] = Ra[i, 0] * Rb[0, j] + Ra[i, 1] * Rb[1, j] + Ra[i, 2] * Rb[2, j]


@njit(cache=True)
def _inverse_times(Ra: Array, ta: Array, Rb: Array, tb: Array, R: Array, t: Array) -> None:
    """`(R, t) = a^-1 b`; the outputs may not be the inputs."""
    for i in range(3):
        t[i] = Ra[0, i] * (tb[0] - ta[0]) + Ra[1, i] * (tb[1] - ta[1]) + Ra[2, i] * (tb[2] - ta[2])
        for j in range(3):
            R[i, j] = Ra[0, i] * Rb[0, j] + Ra[1, i] * Rb[1, j] + Ra[2, i] * Rb[2, j]


@njit(cache=True)
def motions(R: Array, t: Array, starts: NDArray[np.int64], stride: int) -> tuple[Array, Array]:
    """Motions `V_k^-1 V_k+stride` of the poses k in `starts`, as rotations and translations."""
    rotations, translations = np.empty((len(starts), 3, 3)), np.empty((len(starts), 3))
    for i in range(len(starts)):
        k = starts[i]
        _inverse_times(R[k], t[k], R[k + stride], t[k + stride], rotations[i], translations[i])
    return rotations, translations


@njit(cache=True)
def rotation_vectors(R: Array) -> Array:
    """Logarithms (N, 3) of N rotations."""
    out = np.empty((len(R), 3))
    for k in range(len(R)):
        _rotation_vector(R[k], out[k])
    return out


@njit(cache=True)
def misfit(
    AR: Array, At: Array, BR: Array, Bt: Array, scales: Array, XR: Array, Xt: Array
) -> tuple[float, float]:
    """Mean squares of the rotation and the translation entries of `A X - X B`; B scaled by (N,) `scales`."""
    R1, t1, R2, t2 = np.empty((3, 3)), np.empty(3), np.empty((3, 3)), np.empty(3)
    scaled, turned, moved = np.empty(3), 0.0, 0.0
    for k in range(len(At)):
        for i in range(3):
            scaled[i] = Bt[k, i] * scales[k]
        _times(AR[k], At[k], XR, Xt, R1, t1)
        _times(XR, Xt, BR[k], scaled, R2, t2)
        for i in range(3):
            moved += (t1[i] - t2[i]) ** 2
            for j in range(3):
                turned += (R1[i, j] - R2[i, j]) ** 2
    return turned / (9 * len(At)), moved / (3 * len(At))


@njit(cache=True)
def tangents(R: Array, t: Array) -> Array:
    """Logarithms (N, 6) of N transforms."""
    out = np.empty((len(t), 6))
    for k in range(len(t)):
        _log(R[k], t[k], out[k])
    return out


@njit(cache=True)
def interpolate(
    R: Array,
    t: Array,
    increments: Array,
    twists: Array,
    left: NDArray[np.int64],
    alpha: Array,
    span: Array,
) -> tuple[Array, Array, Array]:
    """Rotations, translations and twists on the cubic from pose `left` on, at the share `alpha` of `span`."""
    n = len(left)
    rotations, translations, velocities = np.empty((n, 3, 3)), np.empty((n, 3)), np.empty((n, 6))
    step, dR, dt = np.empty(6), np.empty((3, 3)), np.empty(3)
    start, end, turned = np.empty(6), np.empty(6), np.empty(6)
    for k in range(n):
        j, a = left[k], alpha[k]
        D = increments[j]
        for i in range(6):
            velocities[k, i] = twists[j, i] + a * (twists[j + 1, i] - twists[j, i])
            start[i], end[i] = twists[j, i] * span[k], twists[j + 1, i] * span[k]
        _bracket(D, end, turned)
        for i in range(6):
            last = end[i] + 0.5 * turned[i]  # J_r^-1(D) to first order
            step[i] = D[i] * (3 - 2 * a) * a * a + start[i] * a * (1 - a) ** 2 - last * a * a * (1 - a)
        _exp(step, dR, dt)
        _times(R[j], t[j], dR, dt, rotations[k], translations[k])
    return rotations, translations, velocities


@njit(cache=True)
def _bracket(x: Array, y: Array, out: Array) -> None:
    """`[x, y] = ad(x) y` of two tangents."""
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        out[i] = x[j] * y[k] - x[k] * y[j]
        out[3 + i] = x[3 + j] * y[k] - x[3 + k] * y[j] + x[j] * y[3 + k] - x[k] * y[3 + j]


@njit(cache=True)
def residuals(
    AR: Array,
    At: Array,
    BR: Array,
    Bt: Array,
    scales: Array,
    segments: NDArray[np.int64],
    valid: NDArray[np.bool_],
    YR: Array,
    Yt: Array,
    XR: Array,
    Xt: Array,
) -> Array:
    """`log(B^-1 Y A X)` of N steps, zero where not valid; Y (S, ...) is that of the segment, or the only one."""
    out = np.zeros((len(valid), 6))
    R1, t1, R2, t2 = np.empty((3, 3)), np.empty(3), np.empty((3, 3)), np.empty(3)
    scaled = np.empty(3)
    for k in range(len(valid)):
        if valid[k]:
            s = segments[k]
            y = s if len(YR) > 1 else 0
            _times(YR[y], Yt[y], AR[k], At[k], R1, t1)
            _times(R1, t1, XR, Xt, R2, t2)
            for i in range(3):
                scaled[i] = Bt[k, i] * scales[s]
            _inverse_times(BR[k], scaled, R2, t2, R1, t1)
            _log(R1, t1, out[k])
    return out


@njit(cache=True)
def agreed_motions(
    AR: Array,
    At: Array,
    segments: NDArray[np.int64],
    valid: NDArray[np.bool_],
    YR: Array,
    Yt: Array,
    XR: Array,
    Xt: Array,
    errors: Array,
) -> tuple[Array, Array]:
    """`C = Y A X exp(-error)`: (N, 6, 6) `Ad(C^-1)` and (N, 3) translations `R_C^T t_C`; zero if not valid."""
    n = len(valid)
    adjoints, ways = np.zeros((n, 6, 6)), np.zeros((n, 3))
    R1, t1, R2, t2 = np.empty((3, 3)), np.empty(3), np.empty((3, 3)), np.empty(3)
    for k in range(n):
        if not valid[k]:
            continue
        y = segments[k] if len(YR) > 1 else 0
        _times(YR[y], Yt[y], AR[k], At[k], R1, t1)
        _times(R1, t1, XR, Xt, R2, t2)
        _exp(-errors[k], R1, t1)
        _times(R2, t2, R1, t1, adjoints[k, :3, :3], ways[k])  # C for now
        for i in range(3):
            for j in range(3):
                R1[i, j] = adjoints[k, j, i]
            t1[i] = 0.0
        for i in range(3):
            for j in range(3):
                t1[i] += R1[i, j] * ways[k, j]
        for i in range(3):
            a, b = (i + 1) % 3, (i + 2) % 3
            ways[k, i] = t1[i]
            for j in range(3):
                adjoints[k, i, j] = adjoints[k, 3 + i, 3 + j] = R1[i, j]
                adjoints[k, 3 + i, j] = t1[b] * R1[a, j] - t1[a] * R1[b, j]  # -hat(t1) R1
    return adjoints, ways


@njit(cache=True)
def jacobians(
    adjoints: Array,
    ways: Array,
    twists_before: Array,
    twists_after: Array,
    scales: Array,
    segments: NDArray[np.int64],
    valid: NDArray[np.bool_],
    world_count: int,
    has_clock: bool,
    scale_count: int,
) -> Array:
    """(N, 6, P) of the residuals by mounting, worlds, clock and logarithms of the scales; zero if not valid."""
    clock = 6 + 6 * world_count
    out = np.zeros((len(valid), 6, clock + has_clock + scale_count))
    for k in range(len(valid)):
        if not valid[k]:
            continue
        J, s = out[k], segments[k]
        moved = 0 if world_count == 0 else 6 + 6 * min(s, world_count - 1)
        for i in range(6):
            J[i, i] = 1.0
            for j in range(6):
                J[i, moved + j] -= adjoints[k, i, j]
        if has_clock:
            for i in range(6):
                J[i, clock] = twists_after[k, i] * (1.0 if i < 3 else scales[s])
                for j in range(6):
                    J[i, clock] -= adjoints[k, i, j] * twists_before[k, j] * (1.0 if j < 3 else scales[s])
        if s < scale_count:
            for i in range(3):
                J[3 + i, clock + has_clock + s] = -ways[k, i]
    return out


@njit(cache=True)
def normal_block(Jm: Array, Jn: Array, W: Array, rho: Array, steps: NDArray[np.int64]) -> Array:
    """`sum_k rho_k Jm_k^T W_k Jn_k` over the steps; W (1 or len(steps), 6, 6)."""
    p, q = Jm.shape[2], Jn.shape[2]
    total, WJ = np.zeros((p, q)), np.empty((6, q))
    for i in range(len(steps)):
        k, w = steps[i], i if len(W) > 1 else 0
        for a in range(6):
            for c in range(q):
                value = 0.0
                for b in range(6):
                    value += W[w, a, b] * Jn[k, b, c]
                WJ[a, c] = rho[i] * value
        for r in range(p):
            for c in range(q):
                value = 0.0
                for a in range(6):
                    value += Jm[k, a, r] * WJ[a, c]
                total[r, c] += value
    return total


@njit(cache=True)
def normal_scores(J: Array, weighted: Array, steps: NDArray[np.int64], out: Array) -> None:
    """`out[k] = J_k^T weighted_i` for the i-th of the steps k."""
    for i in range(len(steps)):
        k = steps[i]
        for a in range(6):
            for c in range(J.shape[2]):
                out[k, c] += J[k, a, c] * weighted[i, a]


@njit(cache=True)
def innovations(rows: Array, rotation: float, translation: float) -> Array:
    """`e_k = row_k + theta e_(k-1)` along time over rows (N, 6, P), the first three with theta `rotation`."""
    out = rows.copy()
    for k in range(1, len(rows)):
        for a in range(6):
            theta = rotation if a < 3 else translation
            if theta != 0.0:
                for c in range(rows.shape[2]):
                    out[k, a, c] += theta * out[k - 1, a, c]
    return out


@njit(cache=True)
def robust_mean(squared: Array, median_of_unit: float, limit: float) -> float:
    """Mean with outliers pulled in to `limit` times the scale that the median tells."""
    if len(squared) == 0:
        return 0.0
    highest = np.median(squared) / median_of_unit * limit
    total = 0.0
    for value in squared:
        total += min(value, highest)
    return total / len(squared)


@njit(cache=True)
def feigned(
    errors: Array,
    weights: Array,
    adjoints: Array,
    ways: Array,
    segments: NDArray[np.int64],
    world_count: int,
    scale_start: int,
    size: int,
    scale_count: int,
) -> Array:
    """`sum dJ^T W dJ` over n steps and their six independent errors (1 or n, 6, 6), one per column.

    An error e changes the columns of the frame by `ad(e) Ad(C^-1)` and that of a scale by
    `ad(e) [0, way] - [0, e_t]`: both are `D(e) Z`, Z (7, 7) from the step alone.
    """
    total, Z, MZ = np.zeros((size, size)), np.zeros((7, 7)), np.empty((7, 7))
    columns, M = np.empty(7, dtype=np.int64), np.zeros((7, 7))
    Z[6, 6] = 1.0
    for k in range(len(segments)):
        if k == 0 or len(errors) > 1 or len(weights) > 1:
            M[:] = _spread(errors[k if len(errors) > 1 else 0], weights[k if len(weights) > 1 else 0])
        for c in range(6):
            columns[c] = c if world_count == 0 else 6 + 6 * segments[k] + c
            Z[c, :6] = adjoints[k, c]
        columns[6] = scale_start + segments[k]
        Z[3:6, 6] = ways[k]
        used = 7 if segments[k] < scale_count else 6
        for r in range(7):
            for c in range(used):
                MZ[r, c] = 0.0
                for i in range(7):
                    MZ[r, c] += M[r, i] * Z[i, c]
        for r in range(used):
            for c in range(used):
                value = 0.0
                for i in range(7):
                    value += Z[i, r] * MZ[i, c]
                total[columns[r], columns[c]] += value
    return total


@njit(cache=True)
def _spread(errors: Array, W: Array) -> Array:
    """`sum_e D(e)^T W D(e)` (7, 7) over the columns e, `D(e) = [ad(e), -[0, e_t]]`."""
    D, error, unit = np.zeros((7, 6)), np.empty(6), np.zeros(6)
    total = np.zeros((7, 7))
    for e in range(6):
        error[:] = errors[:, e]
        for c in range(6):
            unit[:] = 0.0
            unit[c] = 1.0
            _bracket(error, unit, D[c])
        D[6, 3:] = -error[3:]
        for r in range(7):
            for i in range(6):
                weighted = 0.0
                for j in range(6):
                    weighted += D[r, j] * W[j, i]
                for c in range(7):
                    total[r, c] += weighted * D[c, i]
    return total
