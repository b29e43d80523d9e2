"""What the light came from: how far away the surface is that a direction from the viewpoint meets.

Cameras a metre apart see near things in different directions. A view that knows the range puts them together; the
better the range, the better the seam. Ranges are metres along the ray from the viewpoint, in the level frame.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Protocol, runtime_checkable

import numpy as np

from rigwake._types import Array, Image
from rigwake.errors import UsageError
from rigwake.views.attitude import LevelAttitude
from rigwake.views.surround_rig import SurroundRig

SHELL_M = 40.0
_NEAREST_M = 0.3  # no surface is nearer than this to the viewpoint


@runtime_checkable
class Surface(Protocol):
    """The range of what is seen in a direction."""

    def range_m(self, directions_level: Array, attitude: LevelAttitude) -> Array:
        """(N,) metres from the viewpoint along unit vectors (N, 3) in the level frame; finite and positive."""


class SurfaceSource(Protocol):
    """Gives a surface for every frame set: what stands on the water moves."""

    def surface(
        self, images: Mapping[str, Image], rig: SurroundRig, attitude: LevelAttitude, timestamp_ns: int
    ) -> Surface:
        """The surface at the time of these pictures ((H, W, 3) BGR, by camera name)."""


@dataclass(frozen=True, eq=False)
class FixedSurface:
    """The same surface for every frame set."""

    fixed: Surface

    def surface(
        self, images: Mapping[str, Image], rig: SurroundRig, attitude: LevelAttitude, timestamp_ns: int
    ) -> Surface:
        """As `SurfaceSource.surface`."""
        return self.fixed


def azimuth_elevation(directions_level: Array) -> tuple[Array, Array]:
    """Azimuths (radians, 0 ahead, positive to starboard) and elevations of directions (..., 3)."""
    x, y, z = np.moveaxis(np.asarray(directions_level, dtype=np.float64), -1, 0)
    return np.arctan2(-y, x), np.arctan2(z, np.hypot(x, y))


def level_directions(azimuth: Array, elevation: Array) -> Array:
    """(..., 3) unit vectors in the level frame of azimuths and elevations (radians), broadcast."""
    azimuth, elevation = np.broadcast_arrays(azimuth, elevation)
    c = np.cos(elevation)
    return np.stack([c * np.cos(azimuth), -c * np.sin(azimuth), np.sin(elevation)], axis=-1)


def water_range_m(directions_level: Array, height_m: float) -> Array:
    """(N,) ranges of the water plane, `height_m` below the viewpoint; infinite at and above the horizon.

    Raises UsageError if the height is unknown.
    """
    if not np.isfinite(height_m) or height_m <= 0:
        raise UsageError(
            "The height of the cameras above the water is not known.",
            consequence="Nothing tells how far away the water is.",
            remedy="Give it: --height-m METRES (mean height of the cameras above the water).",
        )
    down = -np.asarray(directions_level, dtype=np.float64)[..., 2]
    with np.errstate(divide="ignore"):
        return np.asarray(np.where(down > 1e-9, height_m / np.maximum(down, 1e-9), np.inf))


def _cosines(directions_level: Array) -> Array:
    """(N,) cosines of the elevation, away from zero: a cylinder has no range at the zenith."""
    return np.maximum(np.hypot(directions_level[..., 0], directions_level[..., 1]), 0.05)


@dataclass(frozen=True)
class Shell:
    """A vertical cylinder all around, and no water: for a height that nobody knows."""

    shell_m: float = SHELL_M

    def range_m(self, directions_level: Array, attitude: LevelAttitude) -> Array:
        """As `Surface.range_m`."""
        return np.asarray(self.shell_m / _cosines(np.asarray(directions_level)))


@dataclass(frozen=True)
class WaterAndShell:
    """The water plane, out to a vertical cylinder of radius `shell_m` that stands on it."""

    shell_m: float = SHELL_M

    def range_m(self, directions_level: Array, attitude: LevelAttitude) -> Array:
        """As `Surface.range_m`; raises UsageError if the height is unknown."""
        d = np.asarray(directions_level, dtype=np.float64)
        water = water_range_m(d, attitude.height_m)
        return np.maximum(np.minimum(water, self.shell_m / _cosines(d)), _NEAREST_M)


@dataclass(frozen=True, eq=False)
class WaterAndStixels:
    """Water with upright obstacles on it, in layers, and a shell behind them.

    distance_m: (A, L) horizontal distance from the viewpoint to the obstacle in each of A equal sectors of azimuth
    and L layers, NaN where there is none; sector k is centred at azimuth `-pi + (k + 0.5) 2 pi / A`.
    top_m: (A, L) height of its top above the water; infinite where it fills what can be seen.
    bottom_m: (A, L) height of its foot above the water (0: it stands in it).
    """

    distance_m: Array
    top_m: Array
    bottom_m: Array | None = None
    shell_m: float = SHELL_M
    _order: Array = field(init=False, repr=False, default_factory=lambda: np.zeros(0))

    def __post_init__(self) -> None:
        if self.distance_m.shape != self.top_m.shape or self.distance_m.ndim != 2:
            raise ValueError("distance_m and top_m must have the same shape (sectors, layers)")
        object.__setattr__(self, "_order", np.argsort(self.distance_m, axis=1))  # NaN last

    def range_m(self, directions_level: Array, attitude: LevelAttitude) -> Array:
        """As `Surface.range_m`; the nearest layer that the ray meets counts."""
        d = np.asarray(directions_level, dtype=np.float64)
        azimuth, _ = azimuth_elevation(d)
        sectors = len(self.distance_m)
        sector = np.floor((azimuth + np.pi) / (2 * np.pi) * sectors).astype(np.int64) % sectors
        cosine = _cosines(d)
        slope = d[..., 2] / cosine
        result = WaterAndShell(self.shell_m).range_m(d, attitude)
        order = self._order.astype(np.int64)
        bottom = np.zeros_like(self.top_m) if self.bottom_m is None else self.bottom_m
        for layer in range(
            self.distance_m.shape[1] - 1, -1, -1
        ):  # far to near: the near one has the last word
            column = order[sector, layer]
            distance = self.distance_m[sector, column]
            height = attitude.height_m + distance * slope  # above the water, where the ray meets the obstacle
            with np.errstate(invalid="ignore"):
                met = (height >= bottom[sector, column]) & (height <= self.top_m[sector, column])
            result = np.where(met, distance / cosine, result)
        return np.maximum(result, _NEAREST_M)


@dataclass(frozen=True, eq=False)
class WaterAndDepth:
    """Ranges measured per direction, with the water and a shell where nothing was measured.

    panorama_m: (H, W) ranges from the viewpoint, NaN where unknown. Columns are equal steps of azimuth from -pi to pi,
    rows equal steps of elevation from `top_elevation` down (radians); pixels are centred half a step inside.
    """

    panorama_m: Array
    top_elevation: float
    step: float
    shell_m: float = SHELL_M

    def range_m(self, directions_level: Array, attitude: LevelAttitude) -> Array:
        """As `Surface.range_m`."""
        d = np.asarray(directions_level, dtype=np.float64)
        azimuth, elevation = azimuth_elevation(d)
        rows, columns = self.panorama_m.shape
        column = np.floor((azimuth + np.pi) / (2 * np.pi) * columns).astype(np.int64) % columns
        row = np.floor((self.top_elevation - elevation) / self.step).astype(np.int64)
        inside = (row >= 0) & (row < rows)
        measured = np.where(inside, self.panorama_m[np.clip(row, 0, rows - 1), column], np.nan)
        other = WaterAndShell(self.shell_m).range_m(d, attitude)
        return np.maximum(np.where(np.isfinite(measured), measured, other), _NEAREST_M)
