"""Where in which camera the pixels of a view come from: a lookup on a grid of 8 pixels, interpolated between."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from rigwake._types import Array, Floats
from rigwake.cameras.protocol import CameraModel
from rigwake.views.attitude import LevelAttitude
from rigwake.views.projections import ViewProjection
from rigwake.views.surface import Surface
from rigwake.views.surround_rig import SurroundRig
from rigwake.views.weights import FEATHER_DEG, CameraQuality, blending_weights, sampled_quality

STEP = 8
_FAR_OUTSIDE = -1e5
_NOT_IN_SIGHT = 16_000.0  # pixels


@dataclass(frozen=True, eq=False)
class CoarseLookup:
    """Pixels and weights of every camera at the nodes of a grid of 8 px over the view.

    pixels: (C, R, K, 2) float32, outside the image where a camera does not see. quality, weights: (C, R, K) float32;
    weights sum to one or are zero. Node (r, k) sits at pixel (8 k, 8 r) of the view. bends: (C, R, K, 4) second
    differences (`node_bends`), or (0, 0, 0, 0) if positions are linear between nodes.
    """

    width_px: int
    height_px: int
    pixels: Floats
    quality: Floats
    weights: Floats
    bends: Floats

    def without(self, missing: NDArray[np.bool_], feather_deg: float = FEATHER_DEG) -> CoarseLookup:
        """The same lookup with the cameras (C,) left out that are missing."""
        if not missing.any():
            return self
        quality = np.where(missing[:, None, None], np.float32(0), self.quality)
        return replace(self, weights=blending_weights(quality, feather_deg))


def view_nodes(width_px: int, height_px: int) -> tuple[Array, tuple[int, int]]:
    """(N, 2) pixels of the nodes, row by row, and the numbers of rows and columns; the last ones lie outside."""
    columns = np.arange(-(-width_px // STEP) + 1) * float(STEP)
    rows = np.arange(-(-height_px // STEP) + 1) * float(STEP)
    grid = np.stack(np.meshgrid(columns, rows), axis=-1).reshape(-1, 2)
    return grid, (len(rows), len(columns))


def coarse_maps(
    rig: SurroundRig,
    attitude: LevelAttitude,
    projection: ViewProjection,
    surface: Surface,
    quality: CameraQuality,
    feather_deg: float = FEATHER_DEG,
) -> CoarseLookup:
    """The lookup of a view at one attitude and one surface.

    Raises UsageError if the surface needs the height above the water and it is unknown.
    """
    nodes, shape = view_nodes(projection.width_px, projection.height_px)
    points_level = projection.points_level(nodes, attitude, surface)
    pixels = np.empty((len(rig), *shape, 2), dtype=np.float32)
    qualities = np.empty((len(rig), *shape), dtype=np.float32)
    for index, cam_from_level in enumerate(rig.cam_from_level(attitude.level_from_rig)):
        points_cam = points_level @ cam_from_level.rotation.T + cam_from_level.translation
        pixels[index] = extended_pixels(rig.models[index], points_cam).reshape(*shape, 2)
        qualities[index] = sampled_quality(quality.quality[index], pixels[index])
    weights = blending_weights(qualities, feather_deg)
    bends = np.zeros((0, 0, 0, 0), np.float32) if projection.equal_angles else node_bends(pixels)
    return CoarseLookup(projection.width_px, projection.height_px, pixels, qualities, weights, bends)


def extended_pixels(model: CameraModel, points_cam: Array) -> Array:
    """(N, 2) pixels of points; a little beyond the edge of the lens they go on linearly with the angle.

    So a cell of the grid that the edge of the lens crosses can be interpolated; what lies beyond the edge is not shown.
    Far outside, and for points that are not finite, the pixel lies far outside the image.
    """
    pixels, valid = model.project(points_cam)
    lost = ~valid
    pixels[lost] = _FAR_OUTSIDE
    points = points_cam[lost]
    norm = np.linalg.norm(points, axis=1)
    with np.errstate(invalid="ignore", divide="ignore"):
        angle = np.arccos(np.clip(points[:, 2] / norm, -1, 1))
    limit = model.max_angle - 1e-6
    near = np.flatnonzero(angle < model.max_angle + 0.3)
    if not len(near):
        return np.asarray(pixels)
    across = points[near, :2] / np.maximum(np.hypot(points[near, 0], points[near, 1]), 1e-12)[:, None]
    edge = np.column_stack([np.sin(limit) * across, np.full(len(near), np.cos(limit))])
    at_edge, held = model.project(edge)
    centre = model.project(np.array([[0.0, 0.0, 1.0]]))[0]
    beyond = centre + (at_edge - centre) * (angle[near] / limit)[:, None]
    rows = np.flatnonzero(lost)[near]
    pixels[rows[held]] = beyond[held]
    return np.asarray(pixels)


def interpolated_pixels(lookup: CoarseLookup, camera: int, at: Array) -> Array:
    """(N, 2) pixels of a camera at pixels (N, 2) of the view, as `compose` interpolates them."""
    nodes = lookup.pixels[camera].astype(np.float64)
    x, y = at[:, 0] / STEP, at[:, 1] / STEP
    j = np.clip(np.floor(x).astype(int), 0, nodes.shape[1] - 2)
    i = np.clip(np.floor(y).astype(int), 0, nodes.shape[0] - 2)
    fx, fy = (x - j)[:, None], (y - i)[:, None]
    top = nodes[i, j] * (1 - fx) + nodes[i, j + 1] * fx
    bottom = nodes[i + 1, j] * (1 - fx) + nodes[i + 1, j + 1] * fx
    result = top * (1 - fy) + bottom * fy
    if len(lookup.bends):
        bends = lookup.bends[camera, i, j].astype(np.float64)
        result = result + bends[:, :2] * fx * (fx - 1) / 2 + bends[:, 2:] * fy * (fy - 1) / 2
    return np.asarray(result)


def node_bends(pixels: Floats) -> Floats:
    """(C, R, K, 4) second differences of nodes (C, R, K, 2): u and v along a row, u and v down a column.

    Means over the four nodes around a cell; zero at the edges of the view and where a node lies far outside the image.
    """
    bends = np.zeros((*pixels.shape[:3], 4), dtype=np.float32)
    for axis, part in ((2, slice(0, 2)), (1, slice(2, 4))):
        nodes = np.moveaxis(pixels, axis, 1)
        mean = (nodes[:, :-3] - nodes[:, 1:-2] - nodes[:, 2:-1] + nodes[:, 3:]) / 2
        near = (np.abs(nodes[..., 0]) < _NOT_IN_SIGHT) & (np.abs(nodes[..., 1]) < _NOT_IN_SIGHT)
        whole = near[:, :-3] & near[:, 1:-2] & near[:, 2:-1] & near[:, 3:]
        np.moveaxis(bends, axis, 1)[:, 1:-2, :, part] = np.where(whole[..., None], mean, 0.0)
    return bends
