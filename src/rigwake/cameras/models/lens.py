"""The base of every lens: values, validation, and calls into the compiled loops."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import ClassVar, Self

import numpy as np
from numpy.typing import ArrayLike

from rigwake._types import Array, Mask
from rigwake.cameras.models.projection_kernels import Kernels
from rigwake.cameras.protocol import CameraModel, Projection
from rigwake.errors import CameraError

FLATTEST_SLOPE = 1e-2  # a radius that grows slower than this, relative to the axis, has reached its fold
_SMALLEST_DIVISOR = 1e-2
_FOCAL = ("fx", "fy", "mu", "mv")


@dataclass(frozen=True)
class Lens:
    """A camera model with parameter `values`, comparable and hashable by value, and picklable.

    angle_limit: where the lens ends (half its field of view, radians), if that is known; otherwise the model
    holds as far as its radius grows with the angle.
    bounds: what values a parameter may take. fixed_by_default: parameters that calibration and fitting leave
    at their starting values unless asked, because boards hardly determine them.

    Raises CameraError for a wrong number of parameters, values that are not finite, focal lengths that are
    not positive, image sizes below one pixel, and an angle limit beyond what the parameters can represent.
    """

    model: ClassVar[str]
    angle_ceiling: ClassVar[float] = np.pi
    bounds: ClassVar[dict[str, tuple[float, float]]] = {}
    fixed_by_default: ClassVar[tuple[str, ...]] = ()
    kernels: ClassVar[Kernels]

    values: tuple[float, ...]
    width_px: int
    height_px: int
    angle_limit: float | None = None
    max_angle: float = field(init=False, compare=False, repr=False, default=0.0)

    def __post_init__(self) -> None:
        object.__setattr__(self, "values", tuple(float(value) for value in self.values))
        self._check_values()
        observable = self._observable_angle()
        if self.angle_limit is not None:
            if not 0.0 < self.angle_limit <= observable + 1e-9:
                raise CameraError(
                    f"{self.model}: a maximal angle of {np.rad2deg(self.angle_limit):.2f} deg was asked for, "
                    f"but with these parameters the model holds to {np.rad2deg(observable):.2f} deg.",
                    consequence="Beyond, one pixel would show two directions.",
                    remedy="Give a smaller field of view, or leave it out.",
                )
            object.__setattr__(self, "angle_limit", float(self.angle_limit))
            observable = min(observable, self.angle_limit)
        object.__setattr__(self, "max_angle", float(observable))

    def _check_values(self) -> None:
        names = self.param_names
        if len(self.values) != len(names):
            raise CameraError(
                f"{self.model} takes {len(names)} parameters ({', '.join(names)}), got {len(self.values)}."
            )
        if not np.isfinite(self.values).all():
            raise CameraError(f"{self.model}: parameters must be finite, got {self.values}.")
        for name, value in zip(names, self.values, strict=True):
            low, high = (1e-9, np.inf) if name in _FOCAL else self.bounds.get(name, (-np.inf, np.inf))
            if not low <= value <= high:
                raise CameraError(f"{self.model}: {name} = {value:g} is not between {low:g} and {high:g}.")
        if self.width_px < 1 or self.height_px < 1:
            raise CameraError(f"{self.model}: the image is {self.width_px} x {self.height_px} pixels.")

    def _slope(self, angles: Array) -> Array:
        """Growth of the (radially symmetric part of the) image radius at angles (N,) off the axis, up to a
        positive factor. Where it vanishes the lens folds over."""
        raise NotImplementedError

    @classmethod
    def nominal_values(cls, focal_px: float, cx: float, cy: float) -> tuple[float, ...]:
        """Values of an undistorted lens whose radius grows by `focal_px` per radian at the axis, centred at
        pixel (cx, cy): where fits and calibrations start."""
        raise NotImplementedError

    def _observable_angle(self) -> float:
        """How far the parameters can represent angles off the axis."""
        return monotonic_limit(self._slope, self.angle_ceiling)

    def _kernel_params(self) -> Array:
        """What the compiled loops are given: the parameters, and any constants that follow from them."""
        return self.params

    @property
    def param_names(self) -> tuple[str, ...]:
        """Names of the parameters, in order."""
        raise NotImplementedError

    @property
    def params(self) -> Array:
        """(P,) parameter values."""
        return np.array(self.values)

    def with_params(self, params: ArrayLike) -> Self:
        """The same lens with other values; a known angle limit is kept as far as they allow it."""
        values = tuple(float(value) for value in np.asarray(params))
        unlimited = replace(self, values=values, angle_limit=None)
        if self.angle_limit is None:
            return unlimited
        return replace(unlimited, angle_limit=min(self.angle_limit, unlimited.max_angle))

    def project(self, points_cam: ArrayLike) -> tuple[Array, Mask]:
        """Pixels (N, 2), NaN where not valid, and validity (N,) of points (N, 3) at any depth."""
        result = self._project(points_cam, keep=False)
        return result.pixels, result.valid

    def project_with_jacobians(self, points_cam: ArrayLike) -> Projection:
        """As `project`, with analytic derivatives by the point and by the parameters."""
        return self._project(points_cam, keep=True)

    def _project(self, points_cam: ArrayLike, keep: bool) -> Projection:
        points = _rows(points_cam, 3, "points_cam")
        n, rows = len(points), len(points) if keep else 1
        d_point, d_params = np.empty((rows, 2, 3)), np.empty((rows, 2, len(self.values)))
        pixels, valid = np.empty((n, 2)), np.empty(n, dtype=np.bool_)
        self.kernels.project(
            points, self._kernel_params(), self.max_angle, int(keep), pixels, valid, d_point, d_params
        )
        return Projection(pixels, valid, d_point, d_params)

    def unproject(self, pixels: ArrayLike) -> tuple[Array, Mask]:
        """Unit bearings (N, 3), NaN where not valid, and validity (N,) of pixels (N, 2)."""
        points = _rows(pixels, 2, "pixels")
        bearings, valid = np.empty((len(points), 3)), np.empty(len(points), dtype=np.bool_)
        self.kernels.unproject(points, self._kernel_params(), self.max_angle, bearings, valid)
        return bearings, valid


def _rows(values: ArrayLike, columns: int, name: str) -> Array:
    rows = np.ascontiguousarray(values, dtype=np.float64)
    if rows.ndim != 2 or rows.shape[1] != columns:
        raise CameraError(f"{name} must have shape (N, {columns}), got {rows.shape}.")
    return rows


def axis_focal_px(camera: CameraModel) -> float:
    """Pixels per radian at the optical axis, whatever the model calls its focal length."""
    at_axis = camera.project_with_jacobians(np.array([[0.0, 0.0, 1.0]])).d_point[0, :, :2]
    return float(np.sqrt(abs(np.linalg.det(at_axis))))


def quotient_slope(angles: Array, below: Array, below_slope: Array) -> Array:
    """Derivative of the radius `sin(angle) / below` of a lens that divides, zero from where `below` has all
    but vanished: there pixels run off to infinity. `below` is 1 on the axis."""
    held = below > _SMALLEST_DIVISOR
    safe = np.where(held, below, 1.0)
    return np.asarray(np.where(held, (np.cos(angles) * below - np.sin(angles) * below_slope) / safe**2, 0.0))


def monotonic_limit(slope: Callable[[Array], Array], ceiling: float) -> float:
    """The angle up to which a radius grows: just before `slope` falls under 1 % of its value on the axis.

    Found on a grid of 512 angles, refined on another 512 between its neighbours: good to 1e-5 rad, and
    always on the safe side. `ceiling` if the radius grows all the way. Raises CameraError if it never grows.
    """
    at_axis = float(slope(np.zeros(1))[0])
    if not at_axis > 0:
        raise CameraError("The radius does not grow on the optical axis: these are not the values of a lens.")
    low, high = 0.0, ceiling
    for _ in range(2):
        angles = np.linspace(low, high, 513)
        with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
            folded = np.flatnonzero(~(slope(angles) > FLATTEST_SLOPE * at_axis))
        if not len(folded):
            return high
        low, high = angles[max(folded[0] - 1, 0)], angles[folded[0]]
    return float(low)
