"""Images between their pixels: cubic B-splines.

Bilinear interpolation blurs more the further a point lies from a pixel centre, which pulls a registration
towards whole and half pixels; on the recordings that rigwake is tested with that was the largest bias of all
(`docs/tracking.md`). A cubic B-spline interpolates the pixels exactly and is smooth enough to differentiate.

Source: Unser, *Splines: a perfect fit for signal and image processing*, IEEE Signal Processing Magazine 16(6), 1999.
"""

from __future__ import annotations

from math import sqrt

import numpy as np
from numpy.typing import NDArray

from rigwake._kernels import inlined, njit
from rigwake._types import Image

Coefficients = NDArray[np.float32]

_POLE = sqrt(3.0) - 2.0
_HORIZON = 12  # the pole's 12th power is 1e-7: what lies further away cannot be seen in float32


@njit(nogil=True)
def spline_coefficients(image: Image) -> Coefficients:
    """Cubic B-spline coefficients of an image, mirrored at its borders: (H, W) -> (H, W); both sides >= 13."""
    height, width = image.shape
    out = np.empty((height, width), np.float32)
    gain = np.float32(_POLE / (_POLE * _POLE - 1.0))
    pole = np.float32(_POLE)
    six = np.float32(6.0)
    for y in range(height):
        power = np.float32(1.0)
        start = np.float32(0.0)
        for x in range(_HORIZON):
            start += power * np.float32(image[y, x])
            power *= pole
        out[y, 0] = start
        for x in range(1, width):
            out[y, x] = np.float32(image[y, x]) + pole * out[y, x - 1]
        out[y, width - 1] = gain * (out[y, width - 1] + pole * out[y, width - 2])
        for x in range(width - 2, -1, -1):
            out[y, x] = pole * (out[y, x + 1] - out[y, x])
    for x in range(width):
        power = np.float32(1.0)
        start = np.float32(0.0)
        for y in range(_HORIZON):
            start += power * out[y, x]
            power *= pole
        out[0, x] = start
    for y in range(1, height):
        for x in range(width):
            out[y, x] += pole * out[y - 1, x]
    for x in range(width):
        out[height - 1, x] = gain * (out[height - 1, x] + pole * out[height - 2, x])
    for y in range(height - 2, -1, -1):
        for x in range(width):
            out[y, x] = pole * (out[y + 1, x] - out[y, x])
    for y in range(height):
        for x in range(width):
            out[y, x] *= six * six
    return out


# typed, for the compiled loops: numba turns `1 - t` into a double, and checks a signed index for being negative
_1, _2, _3, _4, _6 = (np.float32(value) for value in (1, 2, 3, 4, 6))
_NEXT = np.uint32(1)


@inlined
def _weights(t):  # type: ignore[no-untyped-def]
    s = _1 - t
    return (
        s * s * s / _6,
        (_4 - _6 * t * t + _3 * t * t * t) / _6,
        (_4 - _6 * s * s + _3 * s * s * s) / _6,
        t * t * t / _6,
    )


@inlined
def _slopes(t):  # type: ignore[no-untyped-def]
    s = _1 - t
    return -s * s / _2, (_3 * t * t - _4 * t) / _2, (_4 * s - _3 * s * s) / _2, t * t / _2


@inlined
def _along(c, row, column, w):  # type: ignore[no-untyped-def]
    i0 = column - _NEXT
    i2 = column + _NEXT
    i3 = i2 + _NEXT
    return w[0] * c[row, i0] + w[1] * c[row, column] + w[2] * c[row, i2] + w[3] * c[row, i3]


@inlined
def sample(coefficients: Coefficients, x: float, y: float) -> float:
    """Grey level at (x, y); 1 <= x < W - 2 and 1 <= y < H - 2 is the caller's duty."""
    column, row = np.uint32(x), np.uint32(y)
    a, b = _weights(np.float32(x - np.float32(column))), _weights(np.float32(y - np.float32(row)))
    v0 = _along(coefficients, row - _NEXT, column, a)
    v1 = _along(coefficients, row, column, a)
    v2 = _along(coefficients, row + _NEXT, column, a)
    v3 = _along(coefficients, row + _NEXT + _NEXT, column, a)
    return b[0] * v0 + b[1] * v1 + b[2] * v2 + b[3] * v3


@inlined
def sample_with_gradient(coefficients: Coefficients, x: float, y: float) -> tuple[float, float, float]:
    """Grey level at (x, y) and its derivatives by x and y; same duty as for `sample`."""
    column, row = np.uint32(x), np.uint32(y)
    u, v = np.float32(x - np.float32(column)), np.float32(y - np.float32(row))
    wx, wy, sx, sy = _weights(u), _weights(v), _slopes(u), _slopes(v)
    value = by_x = by_y = 0.0
    line = row - _NEXT
    for j in range(4):
        along = _along(coefficients, line, column, wx)
        value += wy[j] * along
        by_x += wy[j] * _along(coefficients, line, column, sx)
        by_y += sy[j] * along
        line += _NEXT
    return value, by_x, by_y
