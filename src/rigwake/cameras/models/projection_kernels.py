"""Compiled loops over points, and the scalar steps that several lenses share.

A lens writes two scalar functions, compiled into the loops built here:

- `project_point(x, y, z, params, scratch, pixel, d_point, d_params)` fills the pixel (2,) and its derivatives
  (2, 3) and (2, P) of one point that is known to lie inside the lens's maximal angle;
- `unproject_point(u, v, params, max_angle, scratch, ray) -> bool` fills a ray (3,) of any positive length.

What all lenses have in common (finite input, the angle limit, normalisation, NaN where not valid) is done
here.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from dataclasses import dataclass
from math import cos, hypot, isfinite, nan, sqrt
from pathlib import Path
from typing import Any

import numpy as np
from numba.extending import register_jitable

from rigwake._kernels import njit
from rigwake._types import Array

_SCRATCH = 64
_COS_SLACK = 1e-14  # rounding of cos(max_angle) and of z / norm
_MAX_ITERATIONS = 100


@dataclass(frozen=True)
class Kernels:
    """The two compiled loops of one lens."""

    project: Callable[..., None]
    unproject: Callable[..., None]


def _source_version(point_function: Callable[..., object]) -> str:
    """Digest of the sources that a lens is compiled from: numba keys its cache by the loop's own file only,
    so that without it an edited lens would go on running its old machine code."""
    shared = Path(__file__).parent
    sources = {
        shared / "projection_kernels.py",
        shared / "brown.py",
        Path(point_function.__code__.co_filename),
    }
    return hashlib.sha256(b"".join(path.read_bytes() for path in sorted(sources))).hexdigest()


def build_kernels(project_point: Callable[..., None], unproject_point: Callable[..., bool]) -> Kernels:
    """Loops over points around the scalar functions of a lens; compiled on first use, cached on disk."""
    version = _source_version(project_point)

    @njit(nogil=True, error_model="numpy")
    def project(
        points: Array, params: Array, max_angle: float, keep: int, pixels: Array, valid: Any,
        d_point: Array, d_params: Array,
    ) -> None:  # fmt: skip
        # keep = 0 lets all points share one row of derivatives that nobody reads
        if version == "":
            return
        scratch = np.empty(_SCRATCH)
        cos_max = cos(max_angle) - _COS_SLACK
        for i in range(points.shape[0]):
            x, y, z = points[i, 0], points[i, 1], points[i, 2]
            norm = sqrt(x * x + y * y + z * z)
            inside = isfinite(norm) and norm > 0.0 and z >= cos_max * norm
            ok = inside and (z > 0.0 or x != 0.0 or y != 0.0)
            valid[i] = ok
            if ok:
                j = i * keep
                project_point(x, y, z, params, scratch, pixels[i], d_point[j], d_params[j])
                continue
            pixels[i] = nan
            d_point[i * keep] = 0.0
            d_params[i * keep] = 0.0

    @njit(nogil=True, error_model="numpy")
    def unproject(pixels: Array, params: Array, max_angle: float, bearings: Array, valid: Any) -> None:
        if version == "":
            return
        scratch = np.empty(_SCRATCH)
        cos_max = cos(max_angle) - 1e-12
        for i in range(pixels.shape[0]):
            u, v = pixels[i, 0], pixels[i, 1]
            ray = bearings[i]
            found = isfinite(u) and isfinite(v) and unproject_point(u, v, params, max_angle, scratch, ray)
            norm = sqrt(ray[0] ** 2 + ray[1] ** 2 + ray[2] ** 2) if found else 0.0
            valid[i] = found and isfinite(norm) and norm > 0.0 and ray[2] >= cos_max * norm
            if valid[i]:
                ray /= norm
            else:
                ray[:] = nan

    return Kernels(project, unproject)


@register_jitable
def odd_polynomial(k: Array, t: float) -> tuple[float, float]:
    """`t (1 + k[0] t^2 + k[1] t^4 + ...)` and its derivative."""
    t2 = t * t
    value, slope = 0.0, 0.0
    for i in range(len(k) - 1, -1, -1):
        value = (value + k[i]) * t2
        slope = (slope + (2 * i + 3) * k[i]) * t2
    return t * (1.0 + value), 1.0 + slope


@register_jitable
def polynomial(c: Array, t: float) -> tuple[float, float]:
    """`c[0] + c[1] t + c[2] t^2 + ...` and its derivative."""
    value, slope = 0.0, 0.0
    for i in range(len(c) - 1, -1, -1):
        slope = slope * t + value
        value = value * t + c[i]
    return value, slope


@register_jitable
def increasing_root(
    curve: Callable[[Array, float], tuple[float, float]], c: Array, y: float, upper: float, start: float
) -> float:
    """The `t` in [0, upper] with `curve(c, t) = y`, for a curve that increases there; NaN if there is none.

    Newton's method, kept inside a shrinking bracket by bisection: it cannot diverge.
    """
    top = curve(c, upper)[0]
    if y >= top:
        return upper if y - top <= 1e-12 * (1.0 + abs(top)) else nan
    low, high, t = 0.0, upper, min(max(start, 0.0), upper)
    for _ in range(_MAX_ITERATIONS):
        value, slope = curve(c, t)
        if value > y:
            high = t
        else:
            low = t
        following = t - (value - y) / slope
        if low <= following <= high:
            # convergence is quadratic: the next step would be of the order of this one's square
            if abs(following - t) <= 1e-9 * upper:
                return following
        else:
            following = 0.5 * (low + high)
            if high - low <= 2e-16 * upper:
                return following
        t = following
    return t


@register_jitable
def scale_to_pixel(
    x: float, y: float, s: float, s_q: float, s_z: float, params: Array, pixel: Array, d_point: Array,
    d_params: Array,
) -> None:  # fmt: skip
    """Pixel `(fx s x + cx, fy s y + cy)` of a radially symmetric lens with params `fx, fy, cx, cy, ...`.

    s: the scale; s_q, s_z: its derivatives by `x^2 + y^2` and by z. The first four columns of d_params are
    filled.
    """
    fx, fy = params[0], params[1]
    pixel[0], pixel[1] = fx * s * x + params[2], fy * s * y + params[3]
    d_point[0, 0], d_point[0, 1] = fx * (s + 2.0 * x * x * s_q), fx * 2.0 * x * y * s_q
    d_point[1, 0], d_point[1, 1] = fy * 2.0 * x * y * s_q, fy * (s + 2.0 * y * y * s_q)
    d_point[0, 2], d_point[1, 2] = fx * x * s_z, fy * y * s_z
    d_params[0, 0], d_params[0, 1], d_params[0, 2], d_params[0, 3] = s * x, 0.0, 1.0, 0.0
    d_params[1, 0], d_params[1, 1], d_params[1, 2], d_params[1, 3] = 0.0, s * y, 0.0, 1.0


@register_jitable
def scale_slopes(radius: float, by_rho: float, by_z: float, rho: float) -> tuple[float, float, float]:
    """The scale `s = radius / rho` and its derivatives by `rho^2` and z, from those of the radius."""
    s = radius / rho
    return s, 0.5 * (by_rho - s) / (rho * rho), by_z / rho


@register_jitable
def quotient_to_pixel(
    x: float, y: float, below: float, by_q: float, by_z: float, by_first: float, by_second: float,
    params: Array, pixel: Array, d_point: Array, d_params: Array,
) -> None:  # fmt: skip
    """As `scale_to_pixel` for `s = 1 / below`, from the derivatives of `below` by `x^2 + y^2`, by z, and by
    the two parameters after the first four."""
    s = 1.0 / below
    s2 = s * s
    scale_to_pixel(x, y, s, -s2 * by_q, -s2 * by_z, params, pixel, d_point, d_params)
    to_u, to_v = -s2 * params[0] * x, -s2 * params[1] * y
    d_params[0, 4], d_params[0, 5] = to_u * by_first, to_u * by_second
    d_params[1, 4], d_params[1, 5] = to_v * by_first, to_v * by_second


@register_jitable
def ray_at_angle(mx: float, my: float, theta: float, ray: Array) -> bool:
    """Unit ray at angle theta off the axis, towards the image direction (mx, my)."""
    radius = hypot(mx, my)
    scale = np.sin(theta) / radius if radius > 0.0 else 0.0
    ray[0], ray[1], ray[2] = scale * mx, scale * my, cos(theta)
    return isfinite(theta)
