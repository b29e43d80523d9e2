"""The level strip: all cameras resampled once into azimuth and elevation, with the horizon a straight row.

Whatever looks for water, obstacles or sky works in this one picture; only final pictures are finer.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from rigwake._types import Array, Image
from rigwake.views.attitude import LevelAttitude
from rigwake.views.surface import Surface, azimuth_elevation, level_directions
from rigwake.views.surround_rig import SurroundRig

_COARSE = 4  # pixels between exact lookups; between them the lookup is linear
_NO_CAMERA = -1
_FAR_OUTSIDE = -1e6  # a pixel: mixed with any real one it stays outside the image


@dataclass(frozen=True)
class StripGrid:
    """Equal steps of azimuth all around and of elevation from `top_deg` down.

    Column c is centred at azimuth `-180 + (c + 0.5) step_deg`, row r at elevation `top_deg - (r + 0.5) step_deg`:
    the middle column looks ahead, right of it is starboard.
    """

    step_deg: float = 0.4
    top_deg: float = 30.0
    rows: int = 190

    @property
    def columns(self) -> int:
        """Number of columns all around."""
        return round(360.0 / self.step_deg)

    @property
    def horizon_row(self) -> float:
        """Row (a fraction) of elevation zero."""
        return self.top_deg / self.step_deg - 0.5

    def azimuths(self) -> Array:
        """(columns,) radians."""
        return np.deg2rad(-180.0 + (np.arange(self.columns) + 0.5) * self.step_deg)

    def elevations(self) -> Array:
        """(rows,) radians, from the top down."""
        return np.deg2rad(self.top_deg - (np.arange(self.rows) + 0.5) * self.step_deg)

    def directions(self) -> Array:
        """(rows, columns, 3) unit vectors in the level frame."""
        return level_directions(self.azimuths()[None, :], self.elevations()[:, None])

    def pixels(self, directions_level: Array) -> Array:
        """(..., 2) columns and rows (fractions) of directions; columns lie in [-0.5, columns - 0.5)."""
        azimuth, elevation = azimuth_elevation(directions_level)
        column = np.mod(np.rad2deg(azimuth) + 180.0, 360.0) / self.step_deg - 0.5
        row = (self.top_deg - np.rad2deg(elevation)) / self.step_deg - 0.5
        return np.stack([column, row], axis=-1)


@dataclass(frozen=True, eq=False)
class LevelStrip:
    """One frame set in the level frame.

    image: (rows, columns, 3) BGR uint8, black where no camera looks. camera: (rows, columns) int8, the index of the
    camera in `names` that a pixel was taken from, -1 where there is none. attitude: what it was levelled with.
    timestamp_ns: rig clock.
    """

    grid: StripGrid
    image: Image
    camera: NDArray[np.int8]
    names: tuple[str, ...]
    attitude: LevelAttitude
    timestamp_ns: int = 0

    @property
    def is_seen(self) -> NDArray[np.bool_]:
        """(rows, columns) where some camera looks."""
        return self.camera != _NO_CAMERA


def level_strip(
    images: Mapping[str, Image],
    rig: SurroundRig,
    attitude: LevelAttitude,
    surface: Surface,
    grid: StripGrid | None = None,
    masks: Mapping[str, NDArray[np.bool_]] | None = None,
    timestamp_ns: int = 0,
) -> LevelStrip:
    """Resample a frame set into a level strip; every pixel comes from the camera that sees it nearest its axis.

    images: by camera name, (H, W) grey or (H, W, 3) BGR; cameras without one are left out.
    surface: at which range things are (parallax between the viewpoint and the cameras).
    masks: (H, W), True where a camera sees its own vessel: such pixels are not used.
    """
    grid = grid or StripGrid()
    best = np.full((grid.rows, grid.columns), -np.inf, dtype=np.float32)
    picture = np.zeros((grid.rows, grid.columns, 3), dtype=np.uint8)
    camera = np.full((grid.rows, grid.columns), _NO_CAMERA, dtype=np.int8)
    for index, strip, quality in camera_strips(images, rig, attitude, surface, grid, masks):
        better = quality > best
        best[better] = quality[better]
        picture[better] = strip[better]
        camera[better] = index
    return LevelStrip(grid, picture, camera, rig.names, attitude, timestamp_ns)


def camera_strips(
    images: Mapping[str, Image],
    rig: SurroundRig,
    attitude: LevelAttitude,
    surface: Surface,
    grid: StripGrid,
    masks: Mapping[str, NDArray[np.bool_]] | None = None,
) -> list[tuple[int, Image, NDArray[np.float32]]]:
    """Every camera's own picture in the grid: its index, (rows, columns, 3) BGR, and (rows, columns) quality.

    The quality is the cosine of the angle off the optical axis, -inf where the camera does not see.
    """
    nodes, shape = _coarse_directions(grid)
    points_level = nodes * surface.range_m(nodes, attitude)[:, None]
    found = []
    for index, cam_from_level in enumerate(rig.cam_from_level(attitude.level_from_rig)):
        image = images.get(rig.names[index])
        if image is None:
            continue
        model = rig.models[index]
        points_cam = cam_from_level * points_level
        pixels, valid = model.project(points_cam)
        cosine = points_cam[:, 2] / np.linalg.norm(points_cam, axis=1)
        pixels = np.where(valid[:, None], pixels, _FAR_OUTSIDE)
        u, v, quality = (
            _to_full(plane.reshape(shape), grid) for plane in (pixels[:, 0], pixels[:, 1], cosine)
        )
        seen = (u >= 0) & (u <= model.width_px - 1) & (v >= 0) & (v <= model.height_px - 1)
        colour = cv2.cvtColor(image, cv2.COLOR_GRAY2BGR) if image.ndim == 2 else image
        strip = cv2.remap(colour, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT)
        if masks is not None and rig.names[index] in masks:
            own = masks[rig.names[index]].astype(np.uint8)
            seen &= cv2.remap(own, u, v, cv2.INTER_NEAREST, borderMode=cv2.BORDER_CONSTANT) == 0
        found.append((index, strip, np.where(seen, quality, np.float32(-np.inf)).astype(np.float32)))
    return found


def _coarse_directions(grid: StripGrid) -> tuple[Array, tuple[int, int]]:
    """(N, 3) directions of nodes in the middle of blocks of four by four pixels, one block beyond each edge."""
    column = (np.arange(-1, -(-grid.columns // _COARSE) + 1) + 0.5) * _COARSE
    row = (np.arange(-1, -(-grid.rows // _COARSE) + 1) + 0.5) * _COARSE
    azimuth = np.deg2rad(-180.0 + column * grid.step_deg)
    elevation = np.deg2rad(grid.top_deg - row * grid.step_deg)
    nodes = level_directions(azimuth[None, :], elevation[:, None])
    return nodes.reshape(-1, 3), (len(row), len(column))


def _to_full(coarse: Array, grid: StripGrid) -> NDArray[np.float32]:
    """Linear between the nodes."""
    rows, columns = coarse.shape
    full = cv2.resize(coarse.astype(np.float32), (columns * _COARSE, rows * _COARSE))
    return np.ascontiguousarray(full[_COARSE : _COARSE + grid.rows, _COARSE : _COARSE + grid.columns])
