"""What every camera model offers.

Pixel (0, 0) is the centre of the top-left pixel. The camera frame is optical: x right, y down, z forward.
Nothing assumes z > 0: a 190-degree lens sees behind its own image plane.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, Protocol, runtime_checkable

from rigwake._types import Array, Mask


@dataclass(frozen=True, eq=False)
class Projection:
    """Pixels of points, with derivatives.

    pixels: (N, 2), NaN where not valid. valid: (N,).
    d_point: (N, 2, 3) derivative of the pixel by the point in the camera frame; zero where not valid.
    d_params: (N, 2, P) derivative of the pixel by `CameraModel.params`; zero where not valid.
    """

    pixels: Array
    valid: Mask
    d_point: Array
    d_params: Array


@runtime_checkable
class CameraModel(Protocol):
    """A lens: which pixel sees which ray. Implementations are frozen dataclasses."""

    model: ClassVar[str]
    """Name in files and options: `kb4`, `mei`, `pinhole`, ..."""

    @property
    def param_names(self) -> tuple[str, ...]:
        """Names of `params`, in order: `("fx", "fy", "cx", "cy", "k1", ...)`."""

    @property
    def params(self) -> Array:
        """(P,) parameter values."""

    @property
    def width_px(self) -> int:
        """Image width."""

    @property
    def height_px(self) -> int:
        """Image height."""

    @property
    def max_angle(self) -> float:
        """Largest angle off the optical axis (radians) at which the model holds; may exceed pi/2."""

    def with_params(self, params: Array) -> CameraModel:
        """The same lens with other parameter values."""

    def project(self, points_cam: Array) -> tuple[Array, Mask]:
        """Pixels (N, 2) and validity (N,) of points (N, 3) at any depth, including z <= 0.

        Valid: within `max_angle` and not at the origin; whether the pixel lies inside the image is not asked.
        """

    def project_with_jacobians(self, points_cam: Array) -> Projection:
        """As `project`, with derivatives by the point and by the parameters."""

    def unproject(self, pixels: Array) -> tuple[Array, Mask]:
        """Unit bearings (N, 3) (NaN where not valid) and validity (N,) of pixels (N, 2)."""
