"""Ranges all around at once: a sweep of spheres around the viewpoint, in equal steps of the inverse range.

For every sphere, each pixel compares what its best two cameras see there: those that look at it well and lie far apart
across the line of sight. Semi-global matching that goes all around (`sgm`) chooses the sphere.
"""

from __future__ import annotations

from collections.abc import Mapping
from itertools import combinations
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from rigwake._kernels import njit
from rigwake._types import Array, Floats, Image, Mask
from rigwake.views.attitude import LevelAttitude
from rigwake.views.depth.epipolar import MatchedPoints
from rigwake.views.depth.sgm import match_around
from rigwake.views.strips import StripGrid
from rigwake.views.surface import level_directions
from rigwake.views.surround_rig import SurroundRig

SWEEP_GRID = StripGrid(step_deg=360.0 / 768, top_deg=40.0, rows=216)
LEVELS = 64
NAMES = ("sweep", "of spheres")  # of the cameras, in `MatchedPoints`: it is another two in every pixel
_COARSE = 8  # pixels between exact projections
_KNOT = 9  # levels at which points are projected exactly
_LEAST_BASELINE_M = 0.1  # across the line of sight
_UNKNOWN, _MOST = 45, 90  # costs: where a camera does not see, and the largest of any
_LEAST_TEXTURE = 2.5  # grey levels
_LEAST_RATIO = 1.04  # of the second best
_STD_LEVELS = 0.4
_SPECKLE_PX = 30
_NO_CAMERA = -1


def swept_points(
    images: Mapping[str, Image],
    rig: SurroundRig,
    attitude: LevelAttitude,
    masks: Mapping[str, Mask] | None = None,
    nearest_m: float = 3.0,
    grid: StripGrid = SWEEP_GRID,
    levels: int = LEVELS,
) -> MatchedPoints | None:
    """Points that two cameras of a frame set see, found all around at once; None if no two see the same.

    images: by camera name. nearest_m: of the nearest sphere. The farthest is infinitely far; what is matched there has
    no range. levels: how many spheres, a multiple of 8.

    Raises ValueError for another number of levels.
    """
    if levels % (_KNOT - 1):
        raise ValueError(f"{levels} levels are not a multiple of {_KNOT - 1}.")
    there = [k for k, name in enumerate(rig.names) if name in images]
    if len(there) < 2:
        return None
    step = 1 / (nearest_m * (levels - 1))
    pictures, textures = _atlas(images, rig, there, masks)
    knots = np.linspace(0, levels, _KNOT) * step
    pixels, quality = _projected(rig, attitude, there, grid, knots)
    first, second, baseline = _best_pairs(rig, attitude, there, grid, quality)
    if (first == _NO_CAMERA).all():
        return None
    cost = np.full((grid.rows, grid.columns, levels), _UNKNOWN, np.uint8)
    texture = np.zeros((grid.rows, grid.columns), np.float32)
    _sweep(pictures, textures, pixels, first, second, cost, texture)
    level, ratio = match_around(cost)
    good = (texture > _LEAST_TEXTURE) & (ratio > _LEAST_RATIO) & (level > 0.5) & (level < levels - 1.01)
    nearest = np.clip(np.round(level), 0, levels - 1).astype(np.int64)
    # what is carried on from neighbours into a mask, or past the edge of a picture, nobody saw
    good &= np.take_along_axis(cost, nearest[..., None], axis=2)[..., 0] != _UNKNOWN
    good &= _without_speckles(np.where(good, np.round(16 * level), -16).astype(np.int16)) > 0
    inverse = level[good].astype(np.float64) * step
    directions = grid.directions()
    across = np.kron(baseline, np.ones((_COARSE, _COARSE)))[: grid.rows, : grid.columns]
    # a pixel of a sphere is worth the less, the shorter the baseline is
    std = np.maximum(_STD_LEVELS * step, 0.5 * np.deg2rad(grid.step_deg) / across[good])
    points = directions[good] / inverse[:, None]
    return MatchedPoints(
        points,
        std,
        texture[good].astype(np.float64),
        NAMES,
        _tried(directions[::2, ::2], texture[::2, ::2], attitude),
    )


def _without_speckles(levels_16: NDArray[np.int16]) -> NDArray[np.int16]:
    """Small pieces of 16ths of levels set to -16, also where the columns close into a ring."""
    wrapped = np.pad(levels_16, ((0, 0), (_SPECKLE_PX, _SPECKLE_PX)), "wrap")
    cv2.filterSpeckles(wrapped, -16, _SPECKLE_PX, 24)
    return wrapped[:, _SPECKLE_PX:-_SPECKLE_PX]


def _tried(directions: Array, texture: Floats, attitude: LevelAttitude) -> Array:
    """(M, 3) places on the water plane that two cameras look at and that have texture."""
    down = -directions[..., 2]
    chosen = (texture > _LEAST_TEXTURE) & (down > 1e-3)
    if not (np.isfinite(attitude.height_m) and attitude.height_m > 0):
        return np.zeros((0, 3))
    return np.asarray(directions[chosen] * (attitude.height_m / down[chosen])[:, None])


def _atlas(
    images: Mapping[str, Image], rig: SurroundRig, there: list[int], masks: Mapping[str, Mask] | None
) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
    """(cameras, H, W) locally normalised pictures, 0 where masked or outside, and their local deviations."""
    shapes = [images[rig.names[k]].shape for k in there]
    size = (len(there), max(s[0] for s in shapes), max(s[1] for s in shapes))
    pictures, textures = np.zeros(size, np.uint8), np.zeros(size, np.uint8)
    for at, k in enumerate(there):
        name = rig.names[k]
        image = images[name]
        grey = (cv2.cvtColor(image, cv2.COLOR_BGR2GRAY) if image.ndim == 3 else image).astype(np.float32)
        mean = cv2.blur(grey, (21, 21))
        deviation = np.sqrt(np.maximum(cv2.blur(grey**2, (21, 21)) - mean**2, 0))
        # the grid is coarser than the pictures
        scaled = 128 + 40 * (cv2.GaussianBlur(grey, (0, 0), 0.8) - mean) / (deviation + 3)
        rows, columns = grey.shape
        pictures[at, :rows, :columns] = np.clip(scaled, 1, 255)
        textures[at, :rows, :columns] = np.clip(deviation, 0, 255)
        if masks is not None and name in masks:
            pictures[at, :rows, :columns][masks[name]] = 0
            textures[at, :rows, :columns][masks[name]] = 0
    return pictures, textures


def _nodes(grid: StripGrid) -> tuple[Array, Array]:
    """Azimuths and elevations of the first pixels of blocks, one block beyond the last row; columns go around."""
    column = np.arange(-(-grid.columns // _COARSE) + 1) * _COARSE
    row = np.arange(-(-grid.rows // _COARSE) + 1) * _COARSE
    azimuth = np.deg2rad(-180.0 + (column + 0.5) * grid.step_deg)
    return azimuth, np.deg2rad(grid.top_deg - (row + 0.5) * grid.step_deg)


def _projected(
    rig: SurroundRig, attitude: LevelAttitude, there: list[int], grid: StripGrid, knots: Array
) -> tuple[NDArray[np.float32], Array]:
    """Pixels (cameras, rows, columns, knots, 2) of nodes at inverse ranges, far outside where a camera does not see
    them, and the cosine off the optical axis (cameras, rows, columns), -1 there."""
    azimuth, elevation = _nodes(grid)
    directions = level_directions(azimuth[None, :], elevation[:, None])
    points = directions[:, :, None, :] / np.maximum(knots, 1e-4)[:, None]
    cams = rig.cam_from_level(attitude.level_from_rig)
    pixels = np.empty((len(there), *points.shape[:3], 2), np.float32)
    quality = np.empty((len(there), *points.shape[:2]))
    for at, k in enumerate(there):
        points_cam = cams[k] * points.reshape(-1, 3)
        found, valid = rig.models[k].project(points_cam)
        u, v = found.T
        seen = valid & (u >= 0) & (v >= 0) & (u <= rig.models[k].width_px - 1)
        seen &= v <= rig.models[k].height_px - 1
        pixels[at] = np.where(valid[:, None], found, -1e6).reshape(*points.shape[:3], 2)
        cosine = points_cam[:, 2] / np.linalg.norm(points_cam, axis=1)
        by_knot = np.where(seen, cosine, -1.0).reshape(points.shape[:3])
        # what lies near the nearest sphere may be out of sight of both; what is far away must not be
        quality[at] = by_knot[:, :, : _KNOT // 3].min(axis=2)
    return pixels, quality


def _best_pairs(
    rig: SurroundRig, attitude: LevelAttitude, there: list[int], grid: StripGrid, quality: Array
) -> tuple[NDArray[np.int64], NDArray[np.int64], Array]:
    """(rows, columns) of blocks: the two cameras, -1 where no two see it, and their baseline across the line of
    sight in metres."""
    azimuth, elevation = _nodes(grid)
    directions = level_directions(azimuth[None, :-1], elevation[:-1, None])
    seen = quality[:, :-1, :-1]
    positions = rig.positions_level(attitude.level_from_rig)[there]
    best = np.zeros(directions.shape[:2])
    first = np.full(best.shape, _NO_CAMERA, np.int64)
    second, baseline = first.copy(), np.full(best.shape, _LEAST_BASELINE_M)
    for i, j in combinations(range(len(there)), 2):
        across = np.linalg.norm(np.cross(directions, positions[j] - positions[i]), axis=-1)
        both = np.minimum(seen[i], seen[j])
        score = np.where(
            (both > -1) & (across > _LEAST_BASELINE_M), across * (0.3 + np.maximum(both, -0.25)), 0
        )
        better = score > best
        best[better], first[better], second[better] = score[better], i, j
        baseline[better] = across[better]
    return first, second, baseline


@njit(nogil=True)
def _at_knots(pixels: Any, camera: int, row: int, column: int, knots: Any) -> None:
    """Pixels (knots, 2) of one camera at a pixel of the grid, linear between the nodes."""
    r, c = row // _COARSE, column // _COARSE
    fr = np.float32((row - r * _COARSE) / _COARSE)
    fc = np.float32((column - c * _COARSE) / _COARSE)
    one = np.float32(1)
    for k in range(_KNOT):
        for axis in range(2):
            top = pixels[camera, r, c, k, axis] * (one - fc) + pixels[camera, r, c + 1, k, axis] * fc
            low = pixels[camera, r + 1, c, k, axis] * (one - fc) + pixels[camera, r + 1, c + 1, k, axis] * fc
            knots[k, axis] = top * (one - fr) + low * fr


@njit(nogil=True, fastmath=True, error_model="numpy")
def _profile(picture: Any, columns: int, rows: int, knots: Any, per: int, values: Any) -> None:
    """Grey values (`per` from knot to knot), -1 where the picture (rows * columns,) ends or is masked."""
    one = np.uint32(1)
    below = np.uint32(columns)
    width, height = np.float32(columns - 1), np.float32(rows - 1)
    for k in range(_KNOT - 1):
        u0, v0 = knots[k, 0], knots[k, 1]
        du, dv = (knots[k + 1, 0] - u0) / np.float32(per), (knots[k + 1, 1] - v0) / np.float32(per)
        u1, v1 = u0 + np.float32(per) * du, v0 + np.float32(per) * dv
        inside = min(u0, u1) >= 0 and max(u0, u1) < width and min(v0, v1) >= 0 and max(v0, v1) < height
        for n in range(per):
            u, v = u0 + np.float32(n) * du, v0 + np.float32(n) * dv
            grey = np.float32(-1)
            if inside:
                i, j = np.int32(v), np.int32(u)
                fu, fv = u - np.float32(j), v - np.float32(i)
                at = np.uint32(i * columns + j)
                a, b = np.float32(picture[at]), np.float32(picture[at + one])
                c, d = np.float32(picture[at + below]), np.float32(picture[at + below + one])
                top = a + fu * (b - a)
                found = top + fv * (c + fu * (d - c) - top)
                grey = found if min(a, d) > 0 else grey
            values[k * per + n] = grey


@njit(nogil=True, fastmath=True)
def _compare(one: Any, other: Any, cost: Any) -> None:
    for d in range(len(cost)):
        apart = np.int32(min(abs(one[d] - other[d]), np.float32(_MOST)))
        seen = min(one[d], other[d]) >= 0
        cost[d] = np.uint8((apart - (apart == _UNKNOWN)) if seen else _UNKNOWN)  # that one says "not seen"


@njit(nogil=True)
def _sweep(
    pictures: Any, textures: Any, pixels: Any, first: Any, second: Any, cost: Any, texture: Array
) -> None:
    """Fill in the costs (rows, columns, levels) and the texture (rows, columns) that both cameras show."""
    rows, columns, levels = cost.shape
    ends = np.empty((2, _KNOT, 2), np.float32)
    values = np.empty((2, levels), np.float32)
    flat, per = pictures.reshape(len(pictures), -1), levels // (_KNOT - 1)
    for r in range(rows):
        for c in range(columns):
            i, j = first[r // _COARSE, c // _COARSE], second[r // _COARSE, c // _COARSE]
            if i < 0:
                continue
            for n, camera in enumerate((i, j)):
                _at_knots(pixels, camera, r, c, ends[n])
                _profile(flat[camera], pictures.shape[2], pictures.shape[1], ends[n], per, values[n])
            _compare(values[0], values[1], cost[r, c])
            least = np.float32(1e9)
            for n, camera in enumerate((i, j)):
                u, v = int(ends[n, 1, 0]), int(ends[n, 1, 1])
                inside = 0 <= u < textures.shape[2] and 0 <= v < textures.shape[1]
                least = min(least, np.float32(textures[camera, v, u]) if inside else np.float32(0))
            texture[r, c] = least
