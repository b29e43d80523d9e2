"""The enhanced unified camera model (EUCM)."""

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
    alpha, beta = p[4], p[5]
    q = x * x + y * y
    d = sqrt(beta * q + z * z)
    below = alpha * d + (1.0 - alpha) * z
    by_q, by_z = 0.5 * alpha * beta / d, alpha * z / d + 1.0 - alpha
    by_alpha, by_beta = d - z, 0.5 * alpha * q / d
    quotient_to_pixel(x, y, below, by_q, by_z, by_alpha, by_beta, p, pixel, d_point, d_params)


@register_jitable
def _unproject_point(u: float, v: float, p: Array, max_angle: float, scratch: Array, ray: Array) -> bool:
    alpha, beta = p[4], p[5]
    mx, my = (u - p[2]) / p[0], (v - p[3]) / p[1]
    q = beta * (mx * mx + my * my)
    under = 1.0 - (2.0 * alpha - 1.0) * q
    if under < 0.0:
        return False
    ray[0], ray[1] = mx, my
    ray[2] = (1.0 - alpha * alpha * q) / (alpha * sqrt(under) + 1.0 - alpha)
    return True


@dataclass(frozen=True)
class EnhancedUnified(Lens):
    """`eucm`: projection onto an ellipsoid or hyperboloid, then a pinhole.

    `d = sqrt(beta (x^2 + y^2) + z^2)`, `(u, v) = (fx x, fy y) / (alpha d + (1 - alpha) z) + (cx, cy)`,
    0 <= alpha <= 1, beta > 0.

    Source: Khomutenko, Garcia and Martinet, *An Enhanced Unified Camera Model*, RA-L 1(1), 2016.
    """

    model: ClassVar[str] = "eucm"
    bounds: ClassVar[dict[str, tuple[float, float]]] = {"alpha": (0.0, 1.0), "beta": (1e-9, np.inf)}
    kernels = build_kernels(_project_point, _unproject_point)

    @property
    def param_names(self) -> tuple[str, ...]:
        """fx, fy, cx, cy (pixels), alpha, beta."""
        return ("fx", "fy", "cx", "cy", "alpha", "beta")

    @classmethod
    def nominal_values(cls, focal_px: float, cx: float, cy: float) -> tuple[float, ...]:
        """The stereographic lens."""
        return (focal_px, focal_px, cx, cy, 0.5, 1.0)

    def _slope(self, angles: Array) -> Array:
        alpha, beta = self.values[4:]
        s, c = np.sin(angles), np.cos(angles)
        d = np.sqrt(beta * s * s + c * c)
        below = alpha * d + (1 - alpha) * c
        return quotient_slope(angles, below, alpha * (beta - 1) * s * c / d - (1 - alpha) * s)
