"""The unified model with distortion (Mei)."""

from __future__ import annotations

from dataclasses import dataclass
from math import cos, sin, sqrt
from typing import ClassVar

import numpy as np
from numba.extending import register_jitable

from rigwake._types import Array
from rigwake.cameras.models.brown import distort, distortion_derivatives, radial_slope, undistort
from rigwake.cameras.models.lens import Lens, quotient_slope
from rigwake.cameras.models.projection_kernels import build_kernels


@register_jitable
def _project_point(
    X: float, Y: float, Z: float, p: Array, scratch: Array, pixel: Array, d_point: Array, d_params: Array
) -> None:
    fx, fy, xi = p[0], p[1], p[4]
    n = sqrt(X * X + Y * Y + Z * Z)
    s = 1.0 / (Z + xi * n)
    x, y = s * X, s * Y
    xd, yd, a, b, c = distort(x, y, p[5:])
    pixel[0], pixel[1] = fx * xd + p[2], fy * yd + p[3]
    # derivatives of (x, y): those of s times (X, Y), plus s on the diagonal
    s_x, s_y, s_z = -s * s * xi * X / n, -s * s * xi * Y / n, -s * s * (1.0 + xi * Z / n)
    ux, uy, vx, vy = fx * a, fx * b, fy * b, fy * c
    along_u, along_v = ux * X + uy * Y, vx * X + vy * Y
    d_point[0, 0], d_point[0, 1], d_point[0, 2] = (
        along_u * s_x + ux * s,
        along_u * s_y + uy * s,
        along_u * s_z,
    )
    d_point[1, 0], d_point[1, 1], d_point[1, 2] = (
        along_v * s_x + vx * s,
        along_v * s_y + vy * s,
        along_v * s_z,
    )
    d_params[0, 0], d_params[0, 1], d_params[0, 2], d_params[0, 3] = xd, 0.0, 1.0, 0.0
    d_params[1, 0], d_params[1, 1], d_params[1, 2], d_params[1, 3] = 0.0, yd, 0.0, 1.0
    d_params[0, 4], d_params[1, 4] = -s * s * n * along_u, -s * s * n * along_v
    distortion_derivatives(x, y, p[5:], fx, fy, 0.0, d_params[:, 5:])


@register_jitable
def _unproject_point(u: float, v: float, p: Array, max_angle: float, scratch: Array, ray: Array) -> bool:
    xi = p[4]
    max_radius = sin(max_angle) / (cos(max_angle) + xi)
    x, y, found = undistort((u - p[2]) / p[0], (v - p[3]) / p[1], p[5:], max_radius)
    q = x * x + y * y
    under = 1.0 + (1.0 - xi * xi) * q
    if not found or under < 0.0:
        return False
    scale = (xi + sqrt(under)) / (1.0 + q)
    ray[0], ray[1], ray[2] = scale * x, scale * y, scale - xi
    return True


@dataclass(frozen=True)
class Mei(Lens):
    """`mei`: projection onto the unit sphere, then a distorted pinhole xi behind its centre.

    `(x, y) = (X, Y) / (Z + xi |(X, Y, Z)|)`, distorted to `(x', y')` with three radial and two tangential
    terms as in `rigwake.cameras.models.brown`, then `u = fx x' + cx`, `v = fy y' + cy`. fx, fy are the generalised
    focal lengths (gamma), not those of the lens at its axis, which are `fx / (1 + xi)`. OpenCV's `omnidir` and
    Kalibr's `omni-radtan` are the case k3 = 0.

    Source: Mei and Rives, *Single View Point Omnidirectional Camera Calibration from Planar Grids*, ICRA 2007.
    """

    model: ClassVar[str] = "mei"
    bounds: ClassVar[dict[str, tuple[float, float]]] = {"xi": (0.0, np.inf)}
    fixed_by_default: ClassVar[tuple[str, ...]] = ("k3",)
    kernels = build_kernels(_project_point, _unproject_point)

    @property
    def param_names(self) -> tuple[str, ...]:
        """fx, fy, cx, cy (pixels), xi, k1, k2, p1, p2, k3."""
        return ("fx", "fy", "cx", "cy", "xi", "k1", "k2", "p1", "p2", "k3")

    @classmethod
    def nominal_values(cls, focal_px: float, cx: float, cy: float) -> tuple[float, ...]:
        """The stereographic lens, xi = 1."""
        return (2 * focal_px, 2 * focal_px, cx, cy, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0)

    def _slope(self, angles: Array) -> Array:
        xi, below = self.values[4], np.cos(angles) + self.values[4]
        slope = quotient_slope(angles, below / (1 + xi), -np.sin(angles) / (1 + xi))
        held = slope > 0
        radius = np.where(held, np.sin(angles) / np.where(held, below, 1.0), 0.0)
        return np.asarray(slope * radial_slope(self.params[5:], radius))
