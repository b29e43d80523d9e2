"""Images between their pixels: cubic B-splines.

Bilinear interpolation blurs more the further a point lies from a pixel centre, which pulls a registration
towards whole and half pixels; on the recordings that rigwake is tested with that was the largest bias of all
(`docs/tracking.md`). A cubic B-spline interpolates the pixels exactly and is smooth enough to differentiate.

Source: Unser, *Splines: a perfect fit for signal and image processing*, IEEE Signal Processing Magazine 16(6), 1999.
"""

from __future__ import annotations

from math import sqrt

import numpy as np
from numba import njit
from numba.extending import register_jitable
from numpy.typing import NDArray

from rigwake.recording import Image

Coefficients = NDArray[np.float32]

_POLE = sqrt(3.0) - 2.0
_HORIZON = 12  # the pole's 12th power is 1e-7: what lies further away cannot be seen in float32


@njit(cache=True, nogil=True)
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
    first = np.zeros(width, np.float32)
    power = np.float32(1.0)
    for y in range(_HORIZON):
        first += power * out[y]
        power *= pole
    out[0] = first
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


@register_jitable(inline="always")
def _weights(t: float) -> tuple[float, float, float, float]:
    s = 1 - t
    return (
        s * s * s / 6,
        (4 - 6 * t * t + 3 * t * t * t) / 6,
        (4 - 6 * s * s + 3 * s * s * s) / 6,
        t * t * t / 6,
    )


@register_jitable(inline="always")
def _slopes(t: float) -> tuple[float, float, float, float]:
    s = 1 - t
    return -s * s / 2, (9 * t * t - 12 * t) / 6, (12 * s - 9 * s * s) / 6, t * t / 2


@register_jitable(inline="always")
def sample(coefficients: Coefficients, x: float, y: float) -> float:
    """Grey level at (x, y); 1 <= x < W - 2 and 1 <= y < H - 2 is the caller's duty."""
    column, row = int(x), int(y)
    a0, a1, a2, a3 = _weights(x - np.float32(column))
    b0, b1, b2, b3 = _weights(y - np.float32(row))
    c = coefficients
    r, i = row - 1, column - 1
    v0 = a0 * c[r, i] + a1 * c[r, i + 1] + a2 * c[r, i + 2] + a3 * c[r, i + 3]
    v1 = a0 * c[r + 1, i] + a1 * c[r + 1, i + 1] + a2 * c[r + 1, i + 2] + a3 * c[r + 1, i + 3]
    v2 = a0 * c[r + 2, i] + a1 * c[r + 2, i + 1] + a2 * c[r + 2, i + 2] + a3 * c[r + 2, i + 3]
    v3 = a0 * c[r + 3, i] + a1 * c[r + 3, i + 1] + a2 * c[r + 3, i + 2] + a3 * c[r + 3, i + 3]
    return b0 * v0 + b1 * v1 + b2 * v2 + b3 * v3


@register_jitable
def sample_with_gradient(coefficients: Coefficients, x: float, y: float) -> tuple[float, float, float]:
    """Grey level at (x, y) and its derivatives by x and y; same duty as for `sample`."""
    column, row = int(x), int(y)
    wx, wy = _weights(x - column), _weights(y - row)
    sx, sy = _slopes(x - column), _slopes(y - row)
    value = by_x = by_y = 0.0
    for j in range(4):
        along = slope = 0.0
        for i in range(4):
            c = coefficients[row - 1 + j, column - 1 + i]
            along += wx[i] * c
            slope += sx[i] * c
        value += wy[j] * along
        by_x += wy[j] * slope
        by_y += sy[j] * along
    return value, by_x, by_y
