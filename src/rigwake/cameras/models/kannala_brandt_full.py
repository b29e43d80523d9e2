"""The full Kannala-Brandt model: 23 parameters, with asymmetric radial and tangential terms.

Source: Kannala and Brandt, *A Generic Camera Model and Calibration Method for Conventional, Wide-Angle, and
Fish-Eye Lenses*, PAMI 28(8), 2006, equations 6 to 12. The angle is measured from the optical axis, phi from the
x axis towards the y axis.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import atan2, hypot, isfinite, sqrt
from typing import ClassVar

import numpy as np
from numba.extending import register_jitable

from rigwake._types import Array
from rigwake.cameras.models.lens import Lens
from rigwake.cameras.models.projection_kernels import build_kernels, increasing_root, ray_at_angle

_NEWTON_STEPS = 30


@register_jitable
def _cubic(a: Array, t: float) -> tuple[float, float]:
    """`a[0] t + a[1] t^3 + a[2] t^5` and its derivative."""
    t2 = t * t
    value = t * (a[0] + t2 * (a[1] + t2 * a[2]))
    return value, a[0] + t2 * (3.0 * a[1] + 5.0 * t2 * a[2])


@register_jitable
def _wave(a: Array, c: float, s: float) -> tuple[float, float]:
    """`a[0] cos phi + a[1] sin phi + a[2] cos 2 phi + a[3] sin 2 phi` and its derivative by phi."""
    c2, s2 = c * c - s * s, 2.0 * c * s
    value = a[0] * c + a[1] * s + a[2] * c2 + a[3] * s2
    return value, -a[0] * s + a[1] * c + 2.0 * (a[3] * c2 - a[2] * s2)


@register_jitable
def _symmetric(p: Array, theta: float) -> tuple[float, float]:
    """`k1 theta + ... + k5 theta^9` and its derivative."""
    t2 = theta * theta
    value, slope = 0.0, 0.0
    for i in range(8, 3, -1):
        value = value * t2 + p[i]
        slope = slope * t2 + (2 * (i - 4) + 1) * p[i]
    return value * theta, slope


@register_jitable
def _plane(
    p: Array, theta: float, c: float, s: float
) -> tuple[float, float, float, float, float, float, float, float]:
    """Radial and tangential distance at (theta, phi), and the plane's (x, y) by theta and by phi."""
    radius, slope = _symmetric(p, theta)
    outward, outward_t = _cubic(p[9:12], theta)
    wave_i, wave_i_phi = _wave(p[12:16], c, s)
    around, around_t = _cubic(p[16:19], theta)
    wave_j, wave_j_phi = _wave(p[19:23], c, s)
    radial, radial_t, radial_phi = radius + outward * wave_i, slope + outward_t * wave_i, outward * wave_i_phi
    tangential, tangential_t, tangential_phi = around * wave_j, around_t * wave_j, around * wave_j_phi
    along, across = radial_phi - tangential, radial + tangential_phi
    return (
        radial, tangential,
        radial_t * c - tangential_t * s, radial_t * s + tangential_t * c,
        along * c - across * s, along * s + across * c,
        outward, around,
    )  # fmt: skip


@register_jitable
def _project_point(
    x: float, y: float, z: float, p: Array, scratch: Array, pixel: Array, d_point: Array, d_params: Array
) -> None:
    # on the axis phi, and with it the asymmetric terms' derivative, is undefined: take phi = 0 beside it
    if z > 0.0 and x * x + y * y < 1e-30 * z * z:
        x, y = 1e-15 * z, 0.0
    q = x * x + y * y
    rho, n2 = sqrt(q), q + z * z
    c, s = x / rho, y / rho
    theta = atan2(rho, z)
    radial, tangential, x_t, y_t, x_phi, y_phi, outward, around = _plane(p, theta, c, s)
    mx, my = radial * c - tangential * s, radial * s + tangential * c
    mu, mv = p[0], p[1]
    pixel[0], pixel[1] = mu * mx + p[2], mv * my + p[3]
    t_x, t_y, t_z, phi_x, phi_y = c * z / n2, s * z / n2, -rho / n2, -s / rho, c / rho
    d_point[0, 0], d_point[0, 1] = mu * (x_t * t_x + x_phi * phi_x), mu * (x_t * t_y + x_phi * phi_y)
    d_point[1, 0], d_point[1, 1] = mv * (y_t * t_x + y_phi * phi_x), mv * (y_t * t_y + y_phi * phi_y)
    d_point[0, 2], d_point[1, 2] = mu * x_t * t_z, mv * y_t * t_z
    d_params[0, 0], d_params[0, 1], d_params[0, 2], d_params[0, 3] = mx, 0.0, 1.0, 0.0
    d_params[1, 0], d_params[1, 1], d_params[1, 2], d_params[1, 3] = 0.0, my, 0.0, 1.0
    wave_i, wave_j = _wave(p[12:16], c, s)[0], _wave(p[19:23], c, s)[0]
    t2, power = theta * theta, theta
    for i in range(5):
        d_params[0, 4 + i], d_params[1, 4 + i] = mu * power * c, mv * power * s
        if i < 3:
            d_params[0, 9 + i], d_params[1, 9 + i] = mu * power * wave_i * c, mv * power * wave_i * s
            d_params[0, 16 + i], d_params[1, 16 + i] = -mu * power * wave_j * s, mv * power * wave_j * c
        power *= t2
    scratch[0], scratch[1], scratch[2], scratch[3] = c, s, c * c - s * s, 2.0 * c * s
    for i in range(4):
        d_params[0, 12 + i], d_params[1, 12 + i] = (
            mu * outward * scratch[i] * c,
            mv * outward * scratch[i] * s,
        )
        d_params[0, 19 + i], d_params[1, 19 + i] = -mu * around * scratch[i] * s, mv * around * scratch[i] * c


@register_jitable
def _unproject_point(u: float, v: float, p: Array, max_angle: float, scratch: Array, ray: Array) -> bool:
    mx, my = (u - p[2]) / p[0], (v - p[3]) / p[1]
    radius = hypot(mx, my)
    if radius == 0.0:
        return ray_at_angle(mx, my, 0.0, ray)
    theta = increasing_root(_symmetric, p, radius, max_angle, radius / p[4])
    if not isfinite(theta):
        theta = max_angle  # the asymmetric terms may still bring the point inside
    a, b = theta * mx / radius, theta * my / radius
    for _ in range(_NEWTON_STEPS):
        theta = hypot(a, b)
        if not 0.0 < theta < 4.0:
            return False
        c, s = a / theta, b / theta
        radial, tangential, x_t, y_t, x_phi, y_phi, _, _ = _plane(p, theta, c, s)
        ex, ey = radial * c - tangential * s - mx, radial * s + tangential * c - my
        xf, yf = x_phi / theta, y_phi / theta
        determinant = x_t * yf - xf * y_t
        along, across = (yf * ex - xf * ey) / determinant, (x_t * ey - y_t * ex) / determinant
        a, b = a - (along * c - across * s), b - (along * s + across * c)
        if abs(along) + abs(across) <= 1e-15 + 1e-15 * theta:
            return ray_at_angle(a, b, hypot(a, b), ray)
    return hypot(ex, ey) <= 1e-13 * (1.0 + radius) and ray_at_angle(a, b, hypot(a, b), ray)


@dataclass(frozen=True)
class KannalaBrandtFull(Lens):
    """`kb23`: radially symmetric, asymmetric radial and asymmetric tangential terms.

    With `theta = atan2(hypot(x, y), z)`, `phi = atan2(y, x)`:

        r  = k1 theta + k2 theta^3 + k3 theta^5 + k4 theta^7 + k5 theta^9
        dr = (l1 theta + l2 theta^3 + l3 theta^5) (i1 cos phi + i2 sin phi + i3 cos 2phi + i4 sin 2phi)
        dt = (m1 theta + m2 theta^3 + m3 theta^5) (j1 cos phi + j2 sin phi + j3 cos 2phi + j4 sin 2phi)
        (x', y') = (r + dr) (cos phi, sin phi) + dt (-sin phi, cos phi)
        u = mu x' + u0, v = mv y' + v0

    mu, mv (pixels) and k1 share one scale, l and i another, m and j a third; fits hold k1. The paper's shorter
    forms are this one with l = m = 0 (nine parameters) and also k3 = k4 = k5 = 0 (six). On the optical axis
    dr and dt have no derivative; that of the direction phi = 0 is given.
    """

    model: ClassVar[str] = "kb23"
    fixed_by_default: ClassVar[tuple[str, ...]] = ("k1",)
    kernels = build_kernels(_project_point, _unproject_point)

    @property
    def param_names(self) -> tuple[str, ...]:
        """mu, mv, u0, v0 (pixels), k1..k5, l1..l3, i1..i4, m1..m3, j1..j4."""
        terms = (("k", 5), ("l", 3), ("i", 4), ("m", 3), ("j", 4))
        return ("mu", "mv", "u0", "v0", *(f"{name}{i + 1}" for name, count in terms for i in range(count)))

    @classmethod
    def nominal_values(cls, focal_px: float, cx: float, cy: float) -> tuple[float, ...]:
        """The equidistant lens. i and j are one, so that l and m have a derivative to start from."""
        asymmetric = (0.0, 0.0, 0.0, 1.0, 1.0, 1.0, 1.0)
        return (focal_px, focal_px, cx, cy, 1.0, 0.0, 0.0, 0.0, 0.0, *asymmetric, *asymmetric)

    def _slope(self, angles: Array) -> Array:
        coefficients = np.array([1, 3, 5, 7, 9]) * self.values[4:9]
        return np.asarray(np.polynomial.polynomial.polyval(angles * angles, coefficients), dtype=np.float64)
