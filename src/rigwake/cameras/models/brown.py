"""Radial-tangential distortion of image-plane coordinates, shared by the pinhole and the unified lens.

With `r2 = x^2 + y^2` and `g = (1 + k1 r2 + k2 r2^2 + k3 r2^3) / (1 + k4 r2 + k5 r2^2 + k6 r2^3)`:

    x' = g x + 2 p1 x y + p2 (r2 + 2 x^2)
    y' = g y + p1 (r2 + 2 y^2) + 2 p2 x y

Source: Brown, *Close-Range Camera Calibration* (1971); the signs and the order
`k1, k2, p1, p2, k3[, k4, k5, k6]` are OpenCV's.
"""

from __future__ import annotations

from math import hypot, isfinite

from numba.extending import register_jitable

from rigwake._types import Array
from rigwake.cameras.models.projection_kernels import increasing_root

_NEWTON_STEPS = 20


@register_jitable
def _gain(d: Array, r2: float) -> tuple[float, float, float]:
    """The radial factor g, its derivative by r2, and the denominator."""
    k1, k2, k3 = d[0], d[1], d[4]
    above = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
    slope = k1 + r2 * (2.0 * k2 + 3.0 * r2 * k3)
    if len(d) == 5:
        return above, slope, 1.0
    k4, k5, k6 = d[5], d[6], d[7]
    below = 1.0 + r2 * (k4 + r2 * (k5 + r2 * k6))
    gain = above / below
    return gain, (slope - gain * (k4 + r2 * (2.0 * k5 + 3.0 * r2 * k6))) / below, below


@register_jitable
def radial_curve(d: Array, radius: float) -> tuple[float, float]:
    """Distorted radius without tangential terms, and its derivative."""
    r2 = radius * radius
    gain, slope, _ = _gain(d, r2)
    return gain * radius, gain + 2.0 * r2 * slope


@register_jitable
def distort(x: float, y: float, d: Array) -> tuple[float, float, float, float, float]:
    """Distorted `x', y'` and the derivatives `dx'/dx`, `dx'/dy = dy'/dx`, `dy'/dy`."""
    p1, p2 = d[2], d[3]
    r2 = x * x + y * y
    gain, slope, _ = _gain(d, r2)
    return (
        gain * x + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x),
        gain * y + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y,
        gain + 2.0 * slope * x * x + 2.0 * p1 * y + 6.0 * p2 * x,
        2.0 * slope * x * y + 2.0 * p1 * x + 2.0 * p2 * y,
        gain + 2.0 * slope * y * y + 6.0 * p1 * y + 2.0 * p2 * x,
    )


@register_jitable
def distortion_derivatives(
    x: float, y: float, d: Array, fx: float, fy: float, skew: float, out: Array
) -> None:
    """Derivatives (2, len(d)) of the pixel `(fx x' + skew y', fy y')` by the distortion coefficients."""
    r2 = x * x + y * y
    gain, _, below = _gain(d, r2)
    sx, sy = fx * x + skew * y, fy * y
    factor = r2 / below
    out[0, 0], out[1, 0] = sx * factor, sy * factor
    out[0, 1], out[1, 1] = sx * factor * r2, sy * factor * r2
    a, b, c = 2.0 * x * y, r2 + 2.0 * y * y, r2 + 2.0 * x * x
    out[0, 2], out[1, 2] = fx * a + skew * b, fy * b
    out[0, 3], out[1, 3] = fx * c + skew * a, fy * a
    out[0, 4], out[1, 4] = sx * factor * r2 * r2, sy * factor * r2 * r2
    for i in range(5, len(d)):
        out[0, i], out[1, i] = -gain * sx * factor, -gain * sy * factor
        factor *= r2


@register_jitable
def undistort(xd: float, yd: float, d: Array, max_radius: float) -> tuple[float, float, bool]:
    """Undistorted `x, y` inside `max_radius`: the radial curve's root, then Newton with tangential terms."""
    rd = hypot(xd, yd)
    if rd == 0.0 and d[2] == 0.0 and d[3] == 0.0:
        return 0.0, 0.0, True
    radius = increasing_root(radial_curve, d, rd, max_radius, rd)
    if d[2] == 0.0 and d[3] == 0.0:
        return xd * radius / rd, yd * radius / rd, isfinite(radius)
    if not isfinite(radius):
        radius = max_radius  # tangential terms may still bring the point inside
    x, y = (xd * radius / rd, yd * radius / rd) if rd > 0.0 else (0.0, 0.0)
    for _ in range(_NEWTON_STEPS):
        fx, fy, a, b, c = distort(x, y, d)
        determinant = a * c - b * b
        if not determinant > 0.0:
            return x, y, False
        ex, ey = fx - xd, fy - yd
        dx, dy = (c * ex - b * ey) / determinant, (a * ey - b * ex) / determinant
        x, y = x - dx, y - dy
        if abs(dx) + abs(dy) <= 1e-15 * (1.0 + hypot(x, y)):
            return x, y, True
    fx, fy, a, b, c = distort(x, y, d)
    return x, y, hypot(fx - xd, fy - yd) <= 1e-12 * (1.0 + rd)


def radial_slope(d: Array, radius: Array) -> Array:
    """Derivative of the distorted radius at radii (N,), as `radial_curve` gives it."""
    return radial_curve(d, radius)[1]
