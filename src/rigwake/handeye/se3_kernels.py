"""Compiled operations on single transforms: what `geometry.se3` does in arrays, without any memory.

A transform is a tuple of its 12 entries, the rotation by rows, then the translation; a tangent is one of 6. So
compiled, they live in registers. numba does not notice that a cached caller in another file is older than these:
remove its cache after a change.
"""

from __future__ import annotations

import math

from numba import njit

from rigwake._types import Array

Transform = tuple[float, ...]
Tangent = tuple[float, ...]
Vector = tuple[float, float, float]


@njit(cache=True)
def load(R: Array, t: Array, unit: float = 1.0) -> Transform:
    """The transform of a rotation (3, 3) and a translation (3,) in that unit."""
    a, b, c = R[0], R[1], R[2]
    return (a[0], a[1], a[2], b[0], b[1], b[2], c[0], c[1], c[2], unit * t[0], unit * t[1], unit * t[2])


@njit(cache=True)
def store(x: Transform, R: Array, t: Array) -> None:
    """Write a transform to a rotation (3, 3) and a translation (3,)."""
    R[0, 0], R[0, 1], R[0, 2] = x[0], x[1], x[2]
    R[1, 0], R[1, 1], R[1, 2] = x[3], x[4], x[5]
    R[2, 0], R[2, 1], R[2, 2] = x[6], x[7], x[8]
    t[0], t[1], t[2] = x[9], x[10], x[11]


@njit(cache=True)
def rotated(x: Transform, u: float, v: float, w: float) -> Vector:
    """The vector (u, v, w) turned by the rotation of x."""
    return (
        x[0] * u + x[1] * v + x[2] * w,
        x[3] * u + x[4] * v + x[5] * w,
        x[6] * u + x[7] * v + x[8] * w,
    )


@njit(cache=True)
def transposed(x: Transform) -> Transform:
    """The transform with its rotation transposed and its translation as it is."""
    return (x[0], x[3], x[6], x[1], x[4], x[7], x[2], x[5], x[8], x[9], x[10], x[11])


@njit(cache=True)
def times(a: Transform, b: Transform) -> Transform:
    """`a b`."""
    p, q = rotated(a, b[0], b[3], b[6]), rotated(a, b[1], b[4], b[7])
    r, t = rotated(a, b[2], b[5], b[8]), rotated(a, b[9], b[10], b[11])
    return (p[0], q[0], r[0], p[1], q[1], r[1], p[2], q[2], r[2], a[9] + t[0], a[10] + t[1], a[11] + t[2])


@njit(cache=True)
def inverse_times(a: Transform, b: Transform) -> Transform:
    """`a^-1 b`."""
    R = transposed(a)
    p, q, r = rotated(R, b[0], b[3], b[6]), rotated(R, b[1], b[4], b[7]), rotated(R, b[2], b[5], b[8])
    t = rotated(R, b[9] - a[9], b[10] - a[10], b[11] - a[11])
    return (p[0], q[0], r[0], p[1], q[1], r[1], p[2], q[2], r[2], t[0], t[1], t[2])


@njit(cache=True)
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


@njit(cache=True)
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


@njit(cache=True)
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


@njit(cache=True)
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


@njit(cache=True)
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
