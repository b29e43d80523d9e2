"""Kannala-Brandt: the image radius is an odd polynomial of the angle off the axis.

Source: Kannala and Brandt, *A Generic Camera Model and Calibration Method for Conventional, Wide-Angle, and
Fish-Eye Lenses*, PAMI 28(8), 2006.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import atan2, hypot, sqrt
from typing import ClassVar

import numpy as np
from numba.extending import register_jitable

from rigwake._types import Array
from rigwake.cameras.models.lens import Lens
from rigwake.cameras.models.projection_kernels import (
    build_kernels,
    increasing_root,
    odd_polynomial,
    ray_at_angle,
    scale_slopes,
    scale_to_pixel,
)


@register_jitable
def _project_point(
    x: float, y: float, z: float, p: Array, scratch: Array, pixel: Array, d_point: Array, d_params: Array
) -> None:
    q = x * x + y * y
    n2 = q + z * z
    s, s_q, s_z, t2, power = 1.0 / z, 0.0, -1.0 / (z * z), 0.0, 0.0
    if z <= 0.0 or q > 1e-30 * n2:  # else on the axis
        rho = sqrt(q)
        theta = atan2(rho, z)
        radius, slope = odd_polynomial(p[4:], theta)
        s, s_q, s_z = scale_slopes(radius, slope * z / n2, -slope * rho / n2, rho)
        t2 = theta * theta
        power = theta * t2 / rho
    scale_to_pixel(x, y, s, s_q, s_z, p, pixel, d_point, d_params)
    for i in range(4, len(p)):
        d_params[0, i], d_params[1, i] = p[0] * x * power, p[1] * y * power
        power *= t2


@register_jitable
def _unproject_point(u: float, v: float, p: Array, max_angle: float, scratch: Array, ray: Array) -> bool:
    mx, my = (u - p[2]) / p[0], (v - p[3]) / p[1]
    radius = hypot(mx, my)
    theta = increasing_root(odd_polynomial, p[4:], radius, max_angle, radius)
    return ray_at_angle(mx, my, theta, ray)


@dataclass(frozen=True)
class KannalaBrandt4(Lens):
    """`kb4`: four coefficients; OpenCV's `fisheye`, ROS and Kalibr `equidistant`.

    `theta = atan2(hypot(x, y), z)`, `r = theta (1 + k1 theta^2 + k2 theta^4 + k3 theta^6 + k4 theta^8)`,
    `u = cx + fx r x / hypot(x, y)`, `v = cy + fy r y / hypot(x, y)`.

    This is also the model's reduced form with eight parameters, `k2, k3, k4, k5, mu, mv, u0, v0` in
    CamOdoCal: the coefficient of theta is one there, so that its k2..k5 are k1..k4 here and mu, mv, u0, v0
    are fx, fy, cx, cy.
    """

    model: ClassVar[str] = "kb4"
    kernels = build_kernels(_project_point, _unproject_point)

    @property
    def param_names(self) -> tuple[str, ...]:
        """fx, fy, cx, cy (pixels), k1..k4."""
        return ("fx", "fy", "cx", "cy", "k1", "k2", "k3", "k4")

    @classmethod
    def nominal_values(cls, focal_px: float, cx: float, cy: float) -> tuple[float, ...]:
        """The equidistant lens."""
        return (focal_px, focal_px, cx, cy, 0.0, 0.0, 0.0, 0.0)

    def _slope(self, angles: Array) -> Array:
        squares = angles * angles
        return np.polynomial.polynomial.polyval(squares, np.array([1, 3, 5, 7, 9]) * [1, *self.values[4:]])
