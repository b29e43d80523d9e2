"""The pinhole with skew, and radial-tangential (`pinhole`) or rational (`rational`) distortion.

`(x, y) = (X / Z, Y / Z)`, distorted to `(x', y')` as in `rigwake.cameras.models.brown`, then
`u = fx x' + skew y' + cx`, `v = fy y' + cy`.

The aspect ratio is `fy / fx`. The classical two-term radial model is the case `skew = p1 = p2 = k3 = 0`.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import tan
from typing import ClassVar

import numpy as np
from numba.extending import register_jitable

from rigwake._types import Array
from rigwake.cameras.models.brown import distort, distortion_derivatives, radial_slope, undistort
from rigwake.cameras.models.lens import Lens
from rigwake.cameras.models.projection_kernels import build_kernels


@register_jitable
def _project_point(
    X: float, Y: float, Z: float, p: Array, scratch: Array, pixel: Array, d_point: Array, d_params: Array
) -> None:
    fx, fy, skew = p[0], p[1], p[4]
    x, y = X / Z, Y / Z
    xd, yd, a, b, c = distort(x, y, p[5:])
    pixel[0], pixel[1] = fx * xd + skew * yd + p[2], fy * yd + p[3]
    ux, uy, vx, vy = fx * a + skew * b, fx * b + skew * c, fy * b, fy * c
    d_point[0, 0], d_point[0, 1], d_point[0, 2] = ux / Z, uy / Z, -(ux * x + uy * y) / Z
    d_point[1, 0], d_point[1, 1], d_point[1, 2] = vx / Z, vy / Z, -(vx * x + vy * y) / Z
    d_params[0, 0], d_params[0, 1], d_params[0, 2], d_params[0, 3], d_params[0, 4] = xd, 0.0, 1.0, 0.0, yd
    d_params[1, 0], d_params[1, 1], d_params[1, 2], d_params[1, 3], d_params[1, 4] = 0.0, yd, 0.0, 1.0, 0.0
    distortion_derivatives(x, y, p[5:], fx, fy, skew, d_params[:, 5:])


@register_jitable
def _unproject_point(u: float, v: float, p: Array, max_angle: float, scratch: Array, ray: Array) -> bool:
    yd = (v - p[3]) / p[1]
    xd = (u - p[2] - p[4] * yd) / p[0]
    x, y, found = undistort(xd, yd, p[5:], tan(max_angle))
    ray[0], ray[1], ray[2] = x, y, 1.0
    return found


@dataclass(frozen=True)
class Pinhole(Lens):
    """`pinhole`: Brown's distortion, OpenCV's five coefficients; ROS `plumb_bob`, Kalibr `radtan`."""

    model: ClassVar[str] = "pinhole"
    angle_ceiling: ClassVar[float] = float(np.deg2rad(89.9))
    fixed_by_default: ClassVar[tuple[str, ...]] = ("skew", "k3")
    kernels = build_kernels(_project_point, _unproject_point)
    _names: ClassVar[tuple[str, ...]] = ("fx", "fy", "cx", "cy", "skew", "k1", "k2", "p1", "p2", "k3")

    @property
    def param_names(self) -> tuple[str, ...]:
        """fx, fy, cx, cy, skew (pixels), k1, k2, p1, p2, k3 and, if rational, k4, k5, k6."""
        return self._names

    @classmethod
    def nominal_values(cls, focal_px: float, cx: float, cy: float) -> tuple[float, ...]:
        """The ideal pinhole."""
        return (focal_px, focal_px, cx, cy, *[0.0] * (len(cls._names) - 4))

    def _slope(self, angles: Array) -> Array:
        return radial_slope(self.params[5:], np.tan(angles))


@dataclass(frozen=True)
class RationalPinhole(Pinhole):
    """`rational`: OpenCV's eight coefficients, a quotient of polynomials; ROS `rational_polynomial`."""

    model: ClassVar[str] = "rational"
    fixed_by_default: ClassVar[tuple[str, ...]] = ("skew",)

    _names: ClassVar[tuple[str, ...]] = (*Pinhole._names, "k4", "k5", "k6")
