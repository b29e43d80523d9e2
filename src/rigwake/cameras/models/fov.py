"""The field-of-view model, continued past 90 degrees."""

from __future__ import annotations

from dataclasses import dataclass
from math import atan2, cos, hypot, sin, sqrt, tan
from typing import ClassVar

import numpy as np
from numba.extending import register_jitable

from rigwake._types import Array
from rigwake.cameras.models.lens import Lens
from rigwake.cameras.models.projection_kernels import (
    build_kernels,
    ray_at_angle,
    scale_slopes,
    scale_to_pixel,
)


@register_jitable
def _project_point(
    x: float, y: float, z: float, p: Array, scratch: Array, pixel: Array, d_point: Array, d_params: Array
) -> None:
    w = p[4]
    t = tan(0.5 * w)
    q = x * x + y * y
    rho = sqrt(q)
    if z > 0.0 and q < 1e-30 * z * z:
        s = 2.0 * t / (w * z)
        scale_to_pixel(x, y, s, 0.0, -s / z, p, pixel, d_point, d_params)
        d_params[0, 4] = d_params[1, 4] = 0.0
        return
    radius = atan2(2.0 * t * rho, z) / w
    below = z * z + 4.0 * t * t * q
    s, s_q, s_z = scale_slopes(radius, 2.0 * t * z / (w * below), -2.0 * t * rho / (w * below), rho)
    scale_to_pixel(x, y, s, s_q, s_z, p, pixel, d_point, d_params)
    by_w = (z * (1.0 + t * t) / below - s) / w
    d_params[0, 4], d_params[1, 4] = p[0] * x * by_w, p[1] * y * by_w


@register_jitable
def _unproject_point(u: float, v: float, p: Array, max_angle: float, scratch: Array, ray: Array) -> bool:
    mx, my = (u - p[2]) / p[0], (v - p[3]) / p[1]
    angle = p[4] * hypot(mx, my)
    if angle > np.pi:
        return False
    return ray_at_angle(mx, my, atan2(sin(angle), 2.0 * tan(0.5 * p[4]) * cos(angle)), ray)


@dataclass(frozen=True)
class FieldOfView(Lens):
    """`fov`: one coefficient, the ideal field of view w of the lens, 0 < w < pi.

    `r = atan2(2 tan(w / 2) hypot(x, y), z) / w`, `(u, v) = (fx r x, fy r y) / hypot(x, y) + (cx, cy)`.
    Equal to the published `atan(2 tan(w / 2) r_u) / w` in front of the camera, and continues it behind.

    Source: Devernay and Faugeras, *Straight Lines Have to Be Straight*, MVA 13(1), 2001, equation 13.
    """

    model: ClassVar[str] = "fov"
    bounds: ClassVar[dict[str, tuple[float, float]]] = {"w": (1e-6, np.pi - 1e-6)}
    kernels = build_kernels(_project_point, _unproject_point)

    @property
    def param_names(self) -> tuple[str, ...]:
        """fx, fy, cx, cy (pixels), w (radians)."""
        return ("fx", "fy", "cx", "cy", "w")

    @classmethod
    def nominal_values(cls, focal_px: float, cx: float, cy: float) -> tuple[float, ...]:
        """The lens with w = 1."""
        fx = focal_px / (2 * np.tan(0.5))
        return (fx, fx, cx, cy, 1.0)

    def _slope(self, angles: Array) -> Array:
        t2 = 4 * np.tan(0.5 * self.values[4]) ** 2
        return 1.0 / (np.cos(angles) ** 2 + t2 * np.sin(angles) ** 2)
