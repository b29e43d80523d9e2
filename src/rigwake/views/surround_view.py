"""From frame sets to pictures of one view."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from rigwake._types import Array, Floats, Image
from rigwake.views.attitude import LevelAttitude
from rigwake.views.colour import ColourModel, half_field
from rigwake.views.compose import compose
from rigwake.views.frames import FrameSet
from rigwake.views.lookup import CoarseLookup, coarse_maps, extended_pixels
from rigwake.views.projections import ViewProjection
from rigwake.views.surface import Surface, level_directions
from rigwake.views.surround_rig import SurroundRig
from rigwake.views.weights import FEATHER_DEG, CameraQuality, camera_quality


@dataclass
class SurroundView:
    """Draws one view of a rig; keeps the lookup as long as attitude and surface stay the same objects.

    masks: (H, W) by camera name, True where a camera sees its own vessel and that must not be shown.
    colour: gains and vignetting, or None to show the pictures as they are.
    known_quality: of the rig's cameras, if another view has it already.
    """

    rig: SurroundRig
    projection: ViewProjection
    masks: Mapping[str, NDArray[np.bool_]] | None = None
    colour: ColourModel | None = None
    feather_deg: float = FEATHER_DEG
    known_quality: CameraQuality | None = None
    quality: CameraQuality = field(init=False)
    _lookup: CoarseLookup | None = field(init=False, default=None)
    _made_for: tuple[LevelAttitude, Surface] | None = field(init=False, default=None)
    _shading: Floats | None = field(init=False, default=None)
    _shading_of: ColourModel | None = field(init=False, default=None)
    _angles: list[tuple[Array, tuple[Array, Array]]] = field(init=False, default_factory=list)

    def __post_init__(self) -> None:
        self.quality = self.known_quality or camera_quality(self.rig, self.masks)

    def lookup(self, attitude: LevelAttitude, surface: Surface) -> CoarseLookup:
        """Where the pixels of the view come from."""
        made_for = self._made_for
        if (
            self._lookup is None
            or made_for is None
            or made_for[0] is not attitude
            or made_for[1] is not surface
        ):
            self._lookup = coarse_maps(
                self.rig, attitude, self.projection, surface, self.quality, self.feather_deg
            )
            self._made_for = (attitude, surface)
            self._shading_of = None
        return self._lookup

    def picture(
        self, frames: FrameSet, attitude: LevelAttitude, surface: Surface, out: Image | None = None
    ) -> Image:
        """(H, W, 3) BGR. Cameras that are missing are replaced by their neighbours where these see."""
        full = self.lookup(attitude, surface)
        lookup = full.without(frames.is_missing, self.feather_deg)
        gains, shading = None, None
        if self.colour is not None:
            gains = self.colour.gains
            if self._shading is None or self._shading_of is not self.colour:
                self._shading, self._shading_of = self._shading_at(full, self.colour), self.colour
            shading = self._shading
        return compose(frames.stack, lookup, self.quality.usable, gains, shading, out)

    def _shading_at(self, lookup: CoarseLookup, colour: ColourModel) -> Floats | None:
        if not np.any(colour.vignetting):
            return None
        if not self._angles:
            self._angles = [_angle_table(self.rig, c) for c in range(len(self.rig))]
        shading = np.ones(lookup.weights.shape, dtype=np.float32)
        for camera, (centre, table) in enumerate(self._angles):
            radius = np.hypot(*(lookup.pixels[camera] - centre).transpose(2, 0, 1))
            angle = np.interp(radius, table[0], table[1])
            shading[camera] = colour.shading(angle / half_field(self.rig, camera))
        return shading

    def missing_sectors(
        self, frames: FrameSet, attitude: LevelAttitude, surface: Surface
    ) -> NDArray[np.int8]:
        """(H, W) index of the missing camera that would have shown a pixel, -1 elsewhere."""
        full = self.lookup(attitude, surface)
        best = np.where(full.weights.max(axis=0) > 0, full.weights.argmax(axis=0), -1)
        lost = np.isin(best, np.flatnonzero(frames.is_missing))
        nodes = np.where(lost, best, -1).astype(np.int8)
        rows, columns = np.arange(full.height_px) // 8, np.arange(full.width_px) // 8
        return np.asarray(nodes[rows[:, None], columns[None, :]])

    def blind_azimuths_deg(
        self, frames: FrameSet | None, attitude: LevelAttitude
    ) -> list[tuple[float, float]]:
        """Sectors (from, to) in degrees to starboard in which no camera sees the horizon."""
        return blind_sectors(self.rig, attitude, self.quality, None if frames is None else frames.is_missing)


def _angle_table(rig: SurroundRig, camera: int) -> tuple[Array, tuple[Array, Array]]:
    """Principal point, and the angle off the axis by distance from it (mean of four directions)."""
    model = rig.models[camera]
    centre = model.project(np.array([[0.0, 0.0, 1.0]]))[0][0]
    angles = np.linspace(0, model.max_angle - 1e-6, 60)
    radii = []
    for x, y in ((1, 0), (-1, 0), (0, 1), (0, -1)):
        points = np.stack([x * np.sin(angles), y * np.sin(angles), np.cos(angles)], axis=1)
        radii.append(np.linalg.norm(model.project(points)[0] - centre, axis=1))
    return centre, (np.maximum.accumulate(np.nan_to_num(np.mean(radii, axis=0))), angles)


def blind_sectors(
    rig: SurroundRig,
    attitude: LevelAttitude,
    quality: CameraQuality,
    missing: NDArray[np.bool_] | None = None,
    elevation_deg: float = -3.0,
) -> list[tuple[float, float]]:
    """Sectors of azimuth (from, to), degrees to starboard, that no camera sees just below the horizon."""
    azimuth = np.deg2rad(np.arange(-180.0, 180.0, 0.5))
    points = 1000.0 * level_directions(azimuth, np.full_like(azimuth, np.deg2rad(elevation_deg)))
    seen = np.zeros(len(azimuth), dtype=np.bool_)
    for index, cam_from_level in enumerate(rig.cam_from_level(attitude.level_from_rig)):
        if missing is not None and missing[index]:
            continue
        pixels = np.round(extended_pixels(rig.models[index], cam_from_level * points)).astype(np.int64)
        height, width = quality.usable.shape[1:]
        inside = (pixels >= 0).all(axis=1) & (pixels[:, 0] < width) & (pixels[:, 1] < height)
        u, v = np.where(inside[:, None], pixels, 0).T
        seen |= inside & (quality.usable[index, v, u] > 0)
    if seen.all():
        return []
    if not seen.any():
        return [(-180.0, 180.0)]
    return _runs(~seen, np.rad2deg(azimuth))


def _runs(blind: NDArray[np.bool_], azimuth_deg: Array) -> list[tuple[float, float]]:
    """Contiguous runs around the circle; a run across astern is given as one, its end beyond 180."""
    start = int(np.flatnonzero(~blind)[0])
    rolled, step = np.roll(blind, -start), float(azimuth_deg[1] - azimuth_deg[0])
    edges = np.flatnonzero(np.diff(np.concatenate([[0], rolled.astype(np.int8), [0]])))
    runs = []
    for first, last in edges.reshape(-1, 2):
        begin = float(azimuth_deg[(start + first) % len(blind)])
        runs.append((begin, begin + step * float(last - first)))
    return runs
