"""The double sphere model."""

from __future__ import annotations

from dataclasses import dataclass
from math import sqrt
from typing import ClassVar

import numpy as np
from numba.extending import register_jitable

from rigwake._types import Array
from rigwake.cameras.models.lens import Lens, quotient_slope
from rigwake.cameras.models.projection_kernels import build_kernels, quotient_to_pixel


@register_jitable
def _project_point(
    x: float, y: float, z: float, p: Array, scratch: Array, pixel: Array, d_point: Array, d_params: Array
) -> None:
    xi, alpha = p[4], p[5]
    q = x * x + y * y
    d1 = sqrt(q + z * z)
    w = xi * d1 + z
    d2 = sqrt(q + w * w)
    w_q, w_z = 0.5 * xi / d1, xi * z / d1 + 1.0
    by_w = alpha * w / d2 + 1.0 - alpha
    by_q = 0.5 * alpha / d2 + by_w * w_q
    below = alpha * d2 + (1.0 - alpha) * w
    quotient_to_pixel(x, y, below, by_q, by_w * w_z, by_w * d1, d2 - w, p, pixel, d_point, d_params)


@register_jitable
def _unproject_point(u: float, v: float, p: Array, max_angle: float, scratch: Array, ray: Array) -> bool:
    xi, alpha = p[4], p[5]
    mx, my = (u - p[2]) / p[0], (v - p[3]) / p[1]
    q = mx * mx + my * my
    under = 1.0 - (2.0 * alpha - 1.0) * q
    if under < 0.0:
        return False
    mz = (1.0 - alpha * alpha * q) / (alpha * sqrt(under) + 1.0 - alpha)
    inside = mz * mz + (1.0 - xi * xi) * q
    if inside < 0.0:
        return False
    scale = (mz * xi + sqrt(inside)) / (mz * mz + q)
    ray[0], ray[1], ray[2] = scale * mx, scale * my, scale * mz - xi
    return True


@dataclass(frozen=True)
class DoubleSphere(Lens):
    """`ds`: projection onto two unit spheres whose centres lie xi apart, then a pinhole.

    `d1 = |X|`, `w = xi d1 + z`, `d2 = sqrt(x^2 + y^2 + w^2)`,
    `(u, v) = (fx x, fy y) / (alpha d2 + (1 - alpha) w) + (cx, cy)`, 0 <= alpha <= 1.

    Source: Usenko, Demmel and Cremers, *The Double Sphere Camera Model*, 3DV 2018, equations 40 to 52.
    """

    model: ClassVar[str] = "ds"
    bounds: ClassVar[dict[str, tuple[float, float]]] = {"xi": (-0.999, np.inf), "alpha": (0.0, 1.0)}
    kernels = build_kernels(_project_point, _unproject_point)

    @property
    def param_names(self) -> tuple[str, ...]:
        """fx, fy, cx, cy (pixels), xi, alpha."""
        return ("fx", "fy", "cx", "cy", "xi", "alpha")

    @classmethod
    def nominal_values(cls, focal_px: float, cx: float, cy: float) -> tuple[float, ...]:
        """The stereographic lens."""
        return (focal_px, focal_px, cx, cy, 0.0, 0.5)

    def _slope(self, angles: Array) -> Array:
        xi, alpha = self.values[4:]
        s, c = np.sin(angles), np.cos(angles)
        w = xi + c
        d2 = np.sqrt(s * s + w * w)
        below = alpha * d2 + (1 - alpha) * w
        return quotient_slope(angles, below, -alpha * xi * s / d2 - (1 - alpha) * s)
