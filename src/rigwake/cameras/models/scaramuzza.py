"""Scaramuzza's polynomial model (OCamCalib), in this project's pixels and axes.

Source: Scaramuzza, Martinelli and Siegwart, *A Flexible Technique for Accurate Omnidirectional Camera
Calibration*, ICVS 2006, and the OCamCalib toolbox. What differs from the toolbox:

- there x runs down the rows, y along the columns and z towards the viewer. Here x runs along the columns, y
  down the rows and z out of the lens, so that the ray is `(x, y, -f(r))`. The coefficients are the toolbox's
  own, `a0 < 0`;
- there pixels count from one in Matlab and the centre is given row first; here they count from zero and the
  centre is `cx` (column), `cy` (row). `rigwake.cameras.formats.ocamcalib` converts the files.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import atan2, hypot, isfinite, sqrt
from typing import ClassVar

import numpy as np
from numba.extending import register_jitable

from rigwake._types import Array
from rigwake.cameras.models.lens import FLATTEST_SLOPE, Lens
from rigwake.cameras.models.projection_kernels import build_kernels, increasing_root, polynomial
from rigwake.errors import CameraError

# params: cx, cy, c, d, e, a0..aN; the kernels are given two more: the largest radius and its angle


@register_jitable
def _radius_at(rho: float, z: float, p: Array, scratch: Array) -> float:
    """The radius whose ray `(r, -f(r))` is parallel to (rho, z): the root of `r z + f(r) rho`."""
    end = len(p) - 2
    coefficients = scratch[: end - 5]
    norm = hypot(rho, z)
    for i in range(5, end):
        coefficients[i - 5] = p[i] * rho / norm
    coefficients[1] += z / norm
    start = p[end] * atan2(rho, z) / p[end + 1]
    return increasing_root(polynomial, coefficients, 0.0, p[end] * (1.0 + 1e-9), start)


@register_jitable
def _project_point(
    x: float, y: float, z: float, p: Array, scratch: Array, pixel: Array, d_point: Array, d_params: Array
) -> None:
    end = len(p) - 2
    q = x * x + y * y
    rho = sqrt(q)
    if z > 0.0 and q < 1e-30 * z * z:
        radius, s, s_q, s_z, pull = 0.0, -p[5] / z, 0.0, p[5] / (z * z), -1.0 / z
    else:
        radius = _radius_at(rho, z, p, scratch)
        value, slope = polynomial(p[5:end], radius)
        below = z + slope * rho
        s = radius / rho
        s_q, s_z, pull = 0.5 * (-value / below - s) / q, -s / below, -1.0 / below
    mx, my = s * x, s * y
    c, d, e = p[2], p[3], p[4]
    pixel[0], pixel[1] = mx + e * my + p[0], d * mx + c * my + p[1]
    across, ax, by = 2.0 * x * y * s_q, s + 2.0 * x * x * s_q, s + 2.0 * y * y * s_q
    d_point[0, 0], d_point[0, 1], d_point[0, 2] = ax + e * across, across + e * by, (x + e * y) * s_z
    d_point[1, 0], d_point[1, 1], d_point[1, 2] = (
        d * ax + c * across,
        d * across + c * by,
        (d * x + c * y) * s_z,
    )
    d_params[0, 0], d_params[0, 1], d_params[0, 2], d_params[0, 3], d_params[0, 4] = 1.0, 0.0, 0.0, 0.0, my
    d_params[1, 0], d_params[1, 1], d_params[1, 2], d_params[1, 3], d_params[1, 4] = 0.0, 1.0, my, mx, 0.0
    for i in range(5, end):
        d_params[0, i], d_params[1, i] = pull * (x + e * y), pull * (d * x + c * y)
        pull *= radius


@register_jitable
def _unproject_point(u: float, v: float, p: Array, max_angle: float, scratch: Array, ray: Array) -> bool:
    end = len(p) - 2
    c, d, e = p[2], p[3], p[4]
    du, dv = u - p[0], v - p[1]
    determinant = c - d * e
    x, y = (c * du - e * dv) / determinant, (dv - d * du) / determinant
    radius = hypot(x, y)
    if not radius <= p[end] * (1.0 + 1e-12):
        return False
    ray[0], ray[1], ray[2] = x, y, -polynomial(p[5:end], radius)[0]
    return isfinite(ray[2])


@dataclass(frozen=True)
class Scaramuzza(Lens):
    """`scaramuzza`: the ray of a pixel is a polynomial of its distance from the centre.

    `u = x + e y + cx`, `v = d x + c y + cy`, `r = hypot(x, y)`, ray `(x, y, -f(r))`,
    `f(r) = a0 + a1 r + ... + aN r^N` of any degree N >= 1; the toolbox has N = 4 and a1 = 0.

    Unprojection is exact; projection finds the root of the polynomial by a bracketed Newton iteration, to the
    last digits. d would turn the image like a rotation about the axis, so fits hold it.
    """

    model: ClassVar[str] = "scaramuzza"
    fixed_by_default: ClassVar[tuple[str, ...]] = ("d", "a1")
    kernels = build_kernels(_project_point, _unproject_point)

    @property
    def param_names(self) -> tuple[str, ...]:
        """cx, cy (pixels), c, d, e, a0..aN."""
        return ("cx", "cy", "c", "d", "e", *(f"a{i}" for i in range(max(len(self.values) - 5, 2))))

    @classmethod
    def nominal_values(cls, focal_px: float, cx: float, cy: float) -> tuple[float, ...]:
        """The equidistant lens to fourth order: `-f(r) = r / tan(r / focal)`."""
        return (cx, cy, 1.0, 0.0, 0.0, -focal_px, 0.0, 1 / (3 * focal_px), 0.0, 1 / (45 * focal_px**3))

    def _angles_of(self, radii: Array) -> Array:
        return np.arctan2(radii, -np.polynomial.polynomial.polyval(radii, self.values[5:]))

    def _check_values(self) -> None:
        super()._check_values()
        if not self.values[5] < 0 or not self.values[2] - self.values[3] * self.values[4] > 0:
            raise CameraError(
                "scaramuzza: a0 must be negative and c - d e positive.",
                remedy="Check the order of the parameters and the sign of the polynomial.",
            )

    def _largest_radius(self) -> float:
        """How far, up to twice the farthest corner, the angle grows with the radius."""
        cx, cy = self.values[:2]
        farthest = np.hypot(max(cx, self.width_px - cx), max(cy, self.height_px - cy))
        low, high = 0.0, 2 * float(farthest)
        coefficients = self.values[5:]
        for _ in range(2):
            radii = np.linspace(low, high, 513)
            f = np.polynomial.polynomial.polyval(radii, coefficients)
            df = np.polynomial.polynomial.polyval(radii, np.polynomial.polynomial.polyder(coefficients))
            slopes = (radii * df - f) / (radii * radii + f * f) * -coefficients[0]
            folded = np.flatnonzero(~(slopes > FLATTEST_SLOPE))
            if not len(folded):
                return high
            low, high = radii[max(folded[0] - 1, 0)], radii[folded[0]]
        return float(low)

    def _observable_angle(self) -> float:
        return float(self._angles_of(np.array([self._largest_radius()]))[0])

    def _kernel_params(self) -> Array:
        largest = self._largest_radius()
        return np.array([*self.values, largest, self._angles_of(np.array([largest]))[0]])

    def inverse_polynomial(self, degree: int = 12) -> Array:
        """Coefficients b0..b_degree, lowest first, of `r = b0 + b1 t + ...` with t the angle above the image
        plane (`atan2(z, hypot(x, y))`, negated): the toolbox's `invpol`, fitted over the lens."""
        radii = np.linspace(0.0, self._largest_radius(), 1000)
        angles = self._angles_of(radii)
        held = angles <= self.max_angle + 1e-12
        fit = np.polynomial.Polynomial.fit(angles[held] - np.pi / 2, radii[held], degree)
        return np.asarray(fit.convert().coef)
