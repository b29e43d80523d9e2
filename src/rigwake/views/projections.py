"""What a pixel of a view looks at: a point in the level frame.

Panorama, cylinder and virtual camera look along rays from the viewpoint and ask a `Surface` how far; the top view and
the bowl have their own geometry. Level frame: origin in the viewpoint, x ahead, y to port, z up; azimuth 0 ahead,
positive to starboard. Pixel (0, 0) is the centre of the top-left pixel.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, Protocol

import numpy as np
from numpy.typing import NDArray

from rigwake._types import Array
from rigwake.views.attitude import LevelAttitude
from rigwake.views.surface import Surface, level_directions, water_range_m

_BOWL_STEPS = 40


class ViewProjection(Protocol):
    """Where the pixels of a view look.

    equal_angles: a pixel is about the same angle everywhere, and small; then a lookup is linear over eight of them.
    """

    equal_angles: ClassVar[bool]

    @property
    def width_px(self) -> int:
        """Width of the view."""

    @property
    def height_px(self) -> int:
        """Height of the view."""

    def points_level(self, pixels: Array, attitude: LevelAttitude, surface: Surface) -> Array:
        """(N, 3) points in the level frame, metres, that pixels (N, 2) look at; NaN where they look at nothing."""


@dataclass(frozen=True)
class EquirectangularView:
    """The whole sphere: columns are azimuths from -180 to 180 degrees, rows elevations from 90 to -90."""

    equal_angles: ClassVar[bool] = True

    width_px: int = 2048
    height_px: int = 1024

    def directions(self, pixels: Array) -> Array:
        """(N, 3) unit vectors in the level frame."""
        azimuth = (pixels[:, 0] + 0.5) / self.width_px * 2 * np.pi - np.pi
        elevation = np.pi / 2 - (pixels[:, 1] + 0.5) / self.height_px * np.pi
        return level_directions(azimuth, elevation)

    def pixels(self, azimuth: Array, elevation: Array) -> Array:
        """(N, 2) pixels of azimuths and elevations (radians)."""
        column = np.mod(azimuth + np.pi, 2 * np.pi) / (2 * np.pi) * self.width_px - 0.5
        return np.stack([column, (np.pi / 2 - elevation) / np.pi * self.height_px - 0.5], axis=-1)

    def points_level(self, pixels: Array, attitude: LevelAttitude, surface: Surface) -> Array:
        """As `ViewProjection.points_level`."""
        d = self.directions(pixels)
        return d * surface.range_m(d, attitude)[:, None]


@dataclass(frozen=True)
class CylinderView:
    """All around with upright things upright: columns are azimuths, rows tangents of the elevation."""

    equal_angles: ClassVar[bool] = True

    width_px: int = 2048
    height_px: int = 512
    top_deg: float = 30.0
    bottom_deg: float = -50.0

    def directions(self, pixels: Array) -> Array:
        """(N, 3) unit vectors in the level frame."""
        azimuth = (pixels[:, 0] + 0.5) / self.width_px * 2 * np.pi - np.pi
        top, bottom = np.tan(np.deg2rad([self.top_deg, self.bottom_deg]))
        slope = top + (pixels[:, 1] + 0.5) / self.height_px * (bottom - top)
        return level_directions(azimuth, np.arctan(slope))

    def points_level(self, pixels: Array, attitude: LevelAttitude, surface: Surface) -> Array:
        """As `ViewProjection.points_level`."""
        d = self.directions(pixels)
        return d * surface.range_m(d, attitude)[:, None]


@dataclass(frozen=True)
class VirtualCamera:
    """A level pinhole camera in the viewpoint, turned to an azimuth (positive to starboard) and an elevation."""

    equal_angles: ClassVar[bool] = False

    width_px: int = 1280
    height_px: int = 720
    azimuth_deg: float = 0.0
    elevation_deg: float = -5.0
    fov_deg: float = 90.0

    def directions(self, pixels: Array) -> Array:
        """(N, 3) unit vectors in the level frame."""
        return _turned(_pinhole_rays(self, pixels), self.azimuth_deg, self.elevation_deg)

    def points_level(self, pixels: Array, attitude: LevelAttitude, surface: Surface) -> Array:
        """As `ViewProjection.points_level`."""
        d = self.directions(pixels)
        return d * surface.range_m(d, attitude)[:, None]


@dataclass(frozen=True)
class TopDown:
    """The water from above, the bow up, starboard to the right; the viewpoint in the middle.

    radius_m: from the viewpoint to the nearer edges of the picture.
    """

    equal_angles: ClassVar[bool] = False

    width_px: int = 1000
    height_px: int = 1000
    radius_m: float = 25.0

    @property
    def px_per_m(self) -> float:
        """Pixels per metre on the water."""
        return min(self.width_px, self.height_px) / (2 * self.radius_m)

    def metres(self, pixels: Array) -> Array:
        """(N, 2) metres ahead and to port of pixels (N, 2)."""
        ahead = ((self.height_px - 1) / 2 - pixels[..., 1]) / self.px_per_m
        port = ((self.width_px - 1) / 2 - pixels[..., 0]) / self.px_per_m
        return np.stack([ahead, port], axis=-1)

    def pixels(self, metres: Array) -> Array:
        """(N, 2) pixels of metres ahead and to port (N, 2)."""
        column = (self.width_px - 1) / 2 - metres[..., 1] * self.px_per_m
        row = (self.height_px - 1) / 2 - metres[..., 0] * self.px_per_m
        return np.stack([column, row], axis=-1)

    def points_level(self, pixels: Array, attitude: LevelAttitude, surface: Surface) -> Array:
        """As `ViewProjection.points_level`; raises UsageError if the height above the water is unknown."""
        water_range_m(np.zeros((0, 3)), attitude.height_m)
        metres = self.metres(pixels)
        return np.column_stack([metres, np.full(len(metres), -attitude.height_m)])


@dataclass(frozen=True)
class Bowl:
    """The vessel seen from outside, in a bowl: flat water to `flat_m`, rising like a parabola beyond.

    The eye looks at the viewpoint from `distance_m` away, from azimuth `azimuth_deg` (180: from astern) and
    `elevation_deg` above the horizon.
    """

    equal_angles: ClassVar[bool] = False

    width_px: int = 1280
    height_px: int = 720
    azimuth_deg: float = 180.0
    elevation_deg: float = 35.0
    distance_m: float = 16.0
    fov_deg: float = 70.0
    flat_m: float = 12.0
    rise_per_m: float = 0.05

    def height_above_water(self, distance_m: Array) -> Array:
        """(N,) height of the bowl above the water at horizontal distances from the viewpoint."""
        return self.rise_per_m * np.maximum(distance_m - self.flat_m, 0.0) ** 2

    def points_level(self, pixels: Array, attitude: LevelAttitude, surface: Surface) -> Array:
        """As `ViewProjection.points_level`: where the ray from the eye last leaves the inside of the bowl."""
        water_range_m(np.zeros((0, 3)), attitude.height_m)
        back = level_directions(np.deg2rad(self.azimuth_deg), np.deg2rad(self.elevation_deg))
        eye = back * self.distance_m
        eye[2] = max(eye[2], 1.0 - attitude.height_m)
        rays = _turned(_pinhole_rays(self, pixels), self.azimuth_deg + 180.0, -self.elevation_deg)

        def inside(along: Array) -> NDArray[np.bool_]:
            points = eye + rays * along[:, None]
            out = np.hypot(points[:, 0], points[:, 1])
            return np.asarray(points[:, 2] + attitude.height_m >= self.height_above_water(out))

        near, far = np.zeros(len(rays)), np.full(len(rays), 4 * self.distance_m + 40 * self.flat_m)
        for _ in range(_BOWL_STEPS):  # the bowl is convex and the eye inside: a ray leaves it once
            middle = (near + far) / 2
            is_inside = inside(middle)
            near, far = np.where(is_inside, middle, near), np.where(is_inside, far, middle)
        return np.asarray(eye + rays * near[:, None])


def _pinhole_rays(view: VirtualCamera | Bowl, pixels: Array) -> Array:
    """(N, 3) rays of a pinhole view in level axes, as if it looked ahead and level."""
    focal = view.width_px / (2 * np.tan(np.deg2rad(view.fov_deg) / 2))
    right = (pixels[:, 0] - (view.width_px - 1) / 2) / focal
    down = (pixels[:, 1] - (view.height_px - 1) / 2) / focal
    rays = np.stack([np.ones(len(pixels)), -right, -down], axis=1)
    return np.asarray(rays / np.linalg.norm(rays, axis=1, keepdims=True))


def _turned(rays: Array, azimuth_deg: float, elevation_deg: float) -> Array:
    """Rays that looked ahead and level, turned to look elsewhere."""
    a, e = np.deg2rad([azimuth_deg, elevation_deg])
    pitch = np.array([[np.cos(e), 0, -np.sin(e)], [0, 1, 0], [np.sin(e), 0, np.cos(e)]])
    yaw = np.array([[np.cos(a), np.sin(a), 0], [-np.sin(a), np.cos(a), 0], [0, 0, 1]])
    return np.asarray(rays @ (yaw @ pitch).T)
