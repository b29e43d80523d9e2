"""Compiled loops over the steps of a trajectory: motions, interpolation, residuals and their Jacobians.

Each computes in one pass what `geometry.se3` says in arrays; the callers document what it means. Single transforms are
tuples of 12 entries, the rotation by rows, then the translation, and tangents of 6: nothing is allocated.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from rigwake._kernels import njit
from rigwake._types import Array

Transform = tuple[float, ...]
Tangent = tuple[float, ...]
Vector = tuple[float, float, float]


@njit()
def load(R: Array, t: Array, unit: float = 1.0) -> Transform:
    """The transform of a rotation (3, 3) and a translation (3,) in that unit."""
    a, b, c = R[0], R[1], R[2]
    return (a[0], a[1], a[2], b[0], b[1], b[2], c[0], c[1], c[2], unit * t[0], unit * t[1], unit * t[2])


@njit()
def store(x: Transform, R: Array, t: Array) -> None:
    """Write a transform to a rotation (3, 3) and a translation (3,)."""
    R[0, 0], R[0, 1], R[0, 2] = x[0], x[1], x[2]
    R[1, 0], R[1, 1], R[1, 2] = x[3], x[4], x[5]
    R[2, 0], R[2, 1], R[2, 2] = x[6], x[7], x[8]
    t[0], t[1], t[2] = x[9], x[10], x[11]


@njit()
def rotated(x: Transform, u: float, v: float, w: float) -> Vector:
    """The vector (u, v, w) turned by the rotation of x."""
    return (
        x[0] * u + x[1] * v + x[2] * w,
        x[3] * u + x[4] * v + x[5] * w,
        x[6] * u + x[7] * v + x[8] * w,
    )


@njit()
def transposed(x: Transform) -> Transform:
    """The transform with its rotation transposed and its translation as it is."""
    return (x[0], x[3], x[6], x[1], x[4], x[7], x[2], x[5], x[8], x[9], x[10], x[11])


@njit()
def times(a: Transform, b: Transform) -> Transform:
    """`a b`."""
    p, q = rotated(a, b[0], b[3], b[6]), rotated(a, b[1], b[4], b[7])
    r, t = rotated(a, b[2], b[5], b[8]), rotated(a, b[9], b[10], b[11])
    return (p[0], q[0], r[0], p[1], q[1], r[1], p[2], q[2], r[2], a[9] + t[0], a[10] + t[1], a[11] + t[2])


@njit()
def inverse_times(a: Transform, b: Transform) -> Transform:
    """`a^-1 b`."""
    R = transposed(a)
    p, q, r = rotated(R, b[0], b[3], b[6]), rotated(R, b[1], b[4], b[7]), rotated(R, b[2], b[5], b[8])
    t = rotated(R, b[9] - a[9], b[10] - a[10], b[11] - a[11])
    return (p[0], q[0], r[0], p[1], q[1], r[1], p[2], q[2], r[2], t[0], t[1], t[2])


@njit()
def rotation_vector(x: Transform) -> Vector:
    """Logarithm of the rotation of x."""
    trace = x[0] + x[4] + x[8]
    u, v, w = x[7] - x[5], x[2] - x[6], x[3] - x[1]
    if trace > -0.5:
        real = 0.5 * math.sqrt(1.0 + trace)
        u, v, w = u / (4 * real), v / (4 * real), w / (4 * real)
    else:  # beyond 138 degrees the largest component of the axis is the well-conditioned one
        xy, xz, yz = x[1] + x[3], x[2] + x[6], x[5] + x[7]
        if x[0] >= x[4] and x[0] >= x[8]:
            s = 2 * math.sqrt(1.0 + x[0] - x[4] - x[8])
            real, u, v, w = u / s, s / 4, xy / s, xz / s
        elif x[4] >= x[8]:
            s = 2 * math.sqrt(1.0 + x[4] - x[8] - x[0])
            real, u, v, w = v / s, xy / s, s / 4, yz / s
        else:
            s = 2 * math.sqrt(1.0 + x[8] - x[0] - x[4])
            real, u, v, w = w / s, xz / s, yz / s, s / 4
        if real < 0:
            real, u, v, w = -real, -u, -v, -w
    norm = math.sqrt(u * u + v * v + w * w)
    factor = 2.0 if norm < 1e-12 else 2 * math.atan2(norm, real) / norm
    return (factor * u, factor * v, factor * w)


@njit()
def _twice_crossed(phi: Vector, v: Vector, once: float, twice: float) -> Vector:
    """`v + once phi x v + twice phi x (phi x v)`."""
    x = phi[1] * v[2] - phi[2] * v[1]
    y = phi[2] * v[0] - phi[0] * v[2]
    z = phi[0] * v[1] - phi[1] * v[0]
    return (
        v[0] + once * x + twice * (phi[1] * z - phi[2] * y),
        v[1] + once * y + twice * (phi[2] * x - phi[0] * z),
        v[2] + once * z + twice * (phi[0] * y - phi[1] * x),
    )


@njit()
def log(x: Transform) -> Tangent:
    """Tangent of a transform."""
    phi = rotation_vector(x)
    angle2 = phi[0] * phi[0] + phi[1] * phi[1] + phi[2] * phi[2]
    if angle2 < 1e-4:
        c = 1 / 12 + angle2 / 720 + angle2 * angle2 / 30240 + angle2**3 / 1209600
    else:
        half = 0.5 * math.sqrt(angle2)
        c = (1 - half / math.tan(half)) / angle2
    rho = _twice_crossed(phi, (x[9], x[10], x[11]), -0.5, c)
    return (phi[0], phi[1], phi[2], rho[0], rho[1], rho[2])


@njit()
def exp(tangent: Tangent) -> Transform:
    """Transform of a tangent."""
    x, y, z, u, v, w = tangent
    angle2 = x * x + y * y + z * z
    angle = math.sqrt(angle2)
    if angle < 1e-4:
        a, b, c = 1 - angle2 / 6, 0.5 - angle2 / 24, 1 / 6 - angle2 / 120
    else:
        a, b = math.sin(angle) / angle, 2 * math.sin(angle / 2) ** 2 / angle2
        c = (angle - math.sin(angle)) / (angle2 * angle)
    t = _twice_crossed((x, y, z), (u, v, w), b, c)
    p, q, r = 1 - b * (y * y + z * z), 1 - b * (x * x + z * z), 1 - b * (x * x + y * y)
    xy, xz, yz, ax, ay, az = b * x * y, b * x * z, b * y * z, a * x, a * y, a * z
    return (p, xy - az, xz + ay, xy + az, q, yz - ax, xz - ay, yz + ax, r, t[0], t[1], t[2])


@njit()
def bracket(x: Tangent, y: Tangent) -> Tangent:
    """`[x, y] = ad(x) y`."""
    return (
        x[1] * y[2] - x[2] * y[1],
        x[2] * y[0] - x[0] * y[2],
        x[0] * y[1] - x[1] * y[0],
        x[4] * y[2] - x[5] * y[1] + x[1] * y[5] - x[2] * y[4],
        x[5] * y[0] - x[3] * y[2] + x[2] * y[3] - x[0] * y[5],
        x[3] * y[1] - x[4] * y[0] + x[0] * y[4] - x[1] * y[3],
    )


@njit()
def motions(R: Array, t: Array, starts: NDArray[np.int64], stride: int) -> tuple[Array, Array]:
    """Motions `V_k^-1 V_k+stride` of the poses k in `starts`, as rotations and translations."""
    rotations, translations = np.empty((len(starts), 3, 3)), np.empty((len(starts), 3))
    for i in range(len(starts)):
        k, end = starts[i], starts[i] + stride
        motion = inverse_times(load(R[k], t[k]), load(R[end], t[end]))
        store(motion, rotations[i], translations[i])
    return rotations, translations


@njit()
def rotation_vectors(R: Array) -> Array:
    """Logarithms (N, 3) of N rotations."""
    out, zero = np.empty((len(R), 3)), np.zeros(3)
    for k in range(len(R)):
        out[k, 0], out[k, 1], out[k, 2] = rotation_vector(load(R[k], zero))
    return out


@njit()
def tangents(R: Array, t: Array) -> Array:
    """Logarithms (N, 6) of N transforms."""
    out = np.empty((len(t), 6))
    for k in range(len(t)):
        _write(log(load(R[k], t[k])), out[k])
    return out


@njit()
def _write(x: Tangent, out: Array) -> None:
    out[0], out[1], out[2], out[3], out[4], out[5] = x


@njit()
def _read(x: Array, factor: float) -> Tangent:
    return (factor * x[0], factor * x[1], factor * x[2], factor * x[3], factor * x[4], factor * x[5])


@njit()
def retracted(R: Array, t: Array, deltas: Array) -> tuple[Array, Array]:
    """N transforms times the exponentials of N tangents."""
    rotations, translations = np.empty((len(t), 3, 3)), np.empty((len(t), 3))
    for k in range(len(t)):
        moved = times(load(R[k], t[k]), exp(_read(deltas[k], 1.0)))
        store(moved, rotations[k], translations[k])
    return rotations, translations


@njit()
def misfit(
    AR: Array, At: Array, BR: Array, Bt: Array, scales: Array, XR: Array, Xt: Array
) -> tuple[float, float]:
    """Mean squares of the rotation and the translation entries of `A X - X B`; B scaled by (N,) `scales`."""
    turned, moved, X = 0.0, 0.0, load(XR, Xt)
    for k in range(len(At)):
        left = times(load(AR[k], At[k]), X)
        right = times(X, load(BR[k], Bt[k], scales[k]))
        for i in range(9):
            turned += (left[i] - right[i]) ** 2
        for i in range(9, 12):
            moved += (left[i] - right[i]) ** 2
    return turned / (9 * len(At)), moved / (3 * len(At))


@njit()
def disagreement(AR: Array, BR: Array, R: Array) -> float:
    """Norm of all `R_A R - R R_B`."""
    total, zero = 0.0, np.zeros(3)
    X = load(R, zero)
    for k in range(len(AR)):
        left, right = times(load(AR[k], zero), X), times(X, load(BR[k], zero))
        for i in range(9):
            total += (left[i] - right[i]) ** 2
    return np.sqrt(total)


@njit()
def _first_from(times_s: Array, x: float) -> int:
    """Index of the first time not before x, by bisection (np.searchsorted takes seconds to compile)."""
    low, high = 0, len(times_s)
    while low < high:
        middle = (low + high) // 2
        if times_s[middle] < x:
            low = middle + 1
        else:
            high = middle
    return low


@njit()
def sample(
    times_s: Array,
    R: Array,
    t: Array,
    increments: Array,
    twists: Array,
    segment_ids: NDArray[np.int64],
    asked: Array,
    max_gap: float,
    edge: float,
) -> tuple[Array, Array, Array, NDArray[np.int64]]:
    """Rotations, translations, twists and segments at the times `asked`; segment -1 in gaps and past the ends."""
    n, last = len(asked), len(times_s) - 1
    rotations, translations, velocities = np.empty((n, 3, 3)), np.empty((n, 3)), np.empty((n, 6))
    segments = np.empty(n, dtype=np.int64)
    for k in range(n):
        x = asked[k]
        nearest = min(_first_from(times_s, x - 1e-9), last)
        at_node = abs(times_s[nearest] - x) <= 1e-9
        if at_node or last == 0:
            store(load(R[nearest], t[nearest]), rotations[k], translations[k])
            _write(_read(twists[nearest], 1.0), velocities[k])
            segments[k] = segment_ids[nearest] if at_node else -1
            continue
        j = min(max(nearest - 1, 0), last - 1)
        span = times_s[j + 1] - times_s[j]
        a = min(max((x - times_s[j]) / span, -0.1), 1.1)
        for i in range(6):
            velocities[k, i] = twists[j, i] + a * (twists[j + 1, i] - twists[j, i])
        step = _cubic(_read(increments[j], 1.0), _read(twists[j], span), _read(twists[j + 1], span), a)
        store(times(load(R[j], t[j]), exp(step)), rotations[k], translations[k])
        segments[k] = -1
        inside = times_s[0] - edge <= x <= times_s[last] + edge
        if inside and span <= max_gap and segment_ids[j] == segment_ids[j + 1]:
            segments[k] = segment_ids[nearest]
    return rotations, translations, velocities, segments


@njit()
def _cubic(D: Tangent, start: Tangent, end: Tangent, a: float) -> Tangent:
    """The cubic over the increment D at the fraction `a` of it; start, end: velocities times its duration."""
    turned = bracket(D, end)  # half of it: J_r^-1(D) to first order
    d, s, e = (3 - 2 * a) * a * a, a * (1 - a) ** 2, -a * a * (1 - a)
    h = 0.5 * e
    return (
        D[0] * d + start[0] * s + end[0] * e + turned[0] * h,
        D[1] * d + start[1] * s + end[1] * e + turned[1] * h,
        D[2] * d + start[2] * s + end[2] * e + turned[2] * h,
        D[3] * d + start[3] * s + end[3] * e + turned[3] * h,
        D[4] * d + start[4] * s + end[4] * e + turned[4] * h,
        D[5] * d + start[5] * s + end[5] * e + turned[5] * h,
    )


@njit()
def _carried(A: Transform, G: Transform, X: Transform) -> Transform:
    """`G^-1 A X`: the motion or pose of the reference, as the member would have it."""
    return inverse_times(G, times(A, X))


@njit()
def residuals(
    AR: Array,
    At: Array,
    BR: Array,
    Bt: Array,
    scales: Array,
    segments: NDArray[np.int64],
    valid: NDArray[np.bool_],
    GR: Array,
    Gt: Array,
    XR: Array,
    Xt: Array,
) -> Array:
    """`log(B^-1 G^-1 A X)` of N steps, zero where not valid; G (S, ...) is that of the segment, or the only one."""
    out, X = np.zeros((len(valid), 6)), load(XR, Xt)
    for k in range(len(valid)):
        if valid[k]:
            s = segments[k]
            g = s if len(GR) > 1 else 0
            expected = _carried(load(AR[k], At[k]), load(GR[g], Gt[g]), X)
            _write(log(inverse_times(load(BR[k], Bt[k], scales[s]), expected)), out[k])
    return out


@njit()
def agreed_motions(
    AR: Array,
    At: Array,
    segments: NDArray[np.int64],
    valid: NDArray[np.bool_],
    GR: Array,
    Gt: Array,
    XR: Array,
    Xt: Array,
    errors: Array,
) -> tuple[Array, Array]:
    """`C = G^-1 A X exp(-error)`: (N, 6, 6) `Ad(C^-1)` and (N, 3) translations `R_C^T t_C`; zero if not valid."""
    n, X = len(valid), load(XR, Xt)
    adjoints, ways, R, zero = np.zeros((n, 6, 6)), np.zeros((n, 3)), np.empty((3, 3)), np.empty(3)
    for k in range(n):
        if not valid[k]:
            continue
        g = segments[k] if len(GR) > 1 else 0
        carried = _carried(load(AR[k], At[k]), load(GR[g], Gt[g]), X)
        C = transposed(times(carried, exp(_read(errors[k], -1.0))))
        way = rotated(C, C[9], C[10], C[11])
        store(C, R, zero)
        ways[k, 0], ways[k, 1], ways[k, 2] = way
        for j in range(3):
            for i in range(3):
                adjoints[k, i, j] = adjoints[k, 3 + i, 3 + j] = R[i, j]
            # -hat(way) R
            adjoints[k, 3, j] = way[2] * R[1, j] - way[1] * R[2, j]
            adjoints[k, 4, j] = way[0] * R[2, j] - way[2] * R[0, j]
            adjoints[k, 5, j] = way[1] * R[0, j] - way[0] * R[1, j]
    return adjoints, ways


@njit()
def jacobians(
    adjoints: Array,
    ways: Array,
    twists_before: Array,
    twists_after: Array,
    scales: Array,
    segments: NDArray[np.int64],
    valid: NDArray[np.bool_],
    world_count: int,
    has_time_offset: bool,
    scale_count: int,
) -> Array:
    """(N, 6, P) of the residuals by mounting, worlds, clock and logarithms of the scales; zero if not valid."""
    time_offset = 6 + 6 * world_count
    out = np.zeros((len(valid), 6, time_offset + has_time_offset + scale_count))
    for k in range(len(valid)):
        if not valid[k]:
            continue
        J, s = out[k], segments[k]
        moved = 0 if world_count == 0 else 6 + 6 * min(s, world_count - 1)
        for i in range(6):
            J[i, i] = 1.0
            for j in range(6):
                J[i, moved + j] -= adjoints[k, i, j]
        if has_time_offset:
            for i in range(6):
                J[i, time_offset] = twists_after[k, i] * (1.0 if i < 3 else scales[s])
                for j in range(6):
                    J[i, time_offset] -= (
                        adjoints[k, i, j] * twists_before[k, j] * (1.0 if j < 3 else scales[s])
                    )
        if s < scale_count:
            for i in range(3):
                J[3 + i, time_offset + has_time_offset + s] = -ways[k, i]
    return out
