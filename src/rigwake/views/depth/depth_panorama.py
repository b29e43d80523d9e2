"""Ranges all around in the grid of the level strip: matched on what stands, the plane on water, nothing in the sky."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from rigwake._types import Array, Image, Mask
from rigwake.views.attitude import LevelAttitude
from rigwake.views.depth.epipolar import MatchedPoints, epipolar_pairs, match_pair
from rigwake.views.depth.motion import Earlier, moved_points
from rigwake.views.depth.sweep import swept_points
from rigwake.views.scene.segmentation import OBSTACLE, WATER, Labels
from rigwake.views.strips import StripGrid
from rigwake.views.surface import SHELL_M, WaterAndDepth
from rigwake.views.surround_rig import SurroundRig

NONE, PLANE, MATCHED = 0, 1, 2  # sources
_AGREE = 3.0  # standard deviations within which points of one pixel belong together
_NEARER = 0.75  # of the weight of a pixel's points lies farther than the group that counts
_FILL_PX = 2  # holes between splatted points that are filled, in pixels of the strip
_SPREAD_PX = 5  # window in which ranges are compared
_STEP = 4.0  # how much a jump of the range within it takes off the confidence
_NEAREST_INVERSE = 10.0  # 1/m, nearer than anything
_FULL_TEXTURE = 12.0  # grey levels, at which a match is as sure as it can be


@dataclass(frozen=True, eq=False)
class DepthPanorama:
    """range_m, sigma_m: (rows, columns) along the ray from the viewpoint, NaN where unknown. confidence: (rows,
    columns) in 0..1. source: (rows, columns) uint8: 0 none, 1 water plane, 2 matched."""

    grid: StripGrid
    range_m: Array
    sigma_m: Array
    confidence: Array
    source: NDArray[np.uint8]
    timestamp_ns: int = 0

    def inverse_horizontal(self) -> tuple[Array, Array]:
        """(rows, columns) matched inverse horizontal distances and standard deviations for stixels, NaN elsewhere."""
        cosine = np.cos(self.grid.elevations())[:, None]
        matched = self.source == MATCHED
        with np.errstate(invalid="ignore", divide="ignore"):
            inverse = np.where(matched, 1 / (self.range_m * cosine), np.nan)
            std = np.where(matched, self.sigma_m / (self.range_m**2 * cosine), np.nan)
        return inverse, std

    def surface(self, shell_m: float = SHELL_M) -> WaterAndDepth:
        """As a surface that views can be drawn on."""
        top, step = np.deg2rad(self.grid.top_deg), np.deg2rad(self.grid.step_deg)
        return WaterAndDepth(self.range_m, float(top), float(step), shell_m)


def matched_points(
    images: Mapping[str, Image],
    rig: SurroundRig,
    attitude: LevelAttitude,
    masks: Mapping[str, Mask] | None = None,
    nearest_m: float = 3.0,
    earlier: Earlier | None = None,
    sweeps: bool = False,
) -> list[MatchedPoints]:
    """What every two cameras of a frame set see in common, and with `earlier` what each sees now and saw then.

    sweeps: a sweep of spheres in place of matching every two cameras: one pass, in coarser steps.
    """
    found: list[MatchedPoints | None]
    if sweeps:
        found = [swept_points(images, rig, attitude, masks, nearest_m)]
    else:
        pairs = epipolar_pairs(rig, attitude)
        found = [match_pair(pair, images, rig, attitude, masks, nearest_m) for pair in pairs]
    by_motion = [] if earlier is None else moved_points(images, earlier, rig, attitude, masks, nearest_m)
    return [points for points in found if points is not None] + by_motion


def fuse_depth(
    matched: Sequence[MatchedPoints],
    labels: Labels,
    grid: StripGrid,
    attitude: LevelAttitude,
    timestamp_ns: int = 0,
) -> DepthPanorama:
    """Matched points of all pairs and the water plane in one panorama.

    Of several ranges in a pixel the nearest group counts: what is farther is seen past it by another camera.
    """
    inverse, std, texture, hits = _splatted(matched, grid)
    obstacle = labels.classes == OBSTACLE
    known = np.isfinite(inverse) & obstacle
    inverse, std, texture = _filled(inverse, std, texture, known, obstacle)
    known = np.isfinite(inverse) & obstacle
    rows, columns = grid.rows, grid.columns
    range_m, sigma_m = np.full((rows, columns), np.nan), np.full((rows, columns), np.nan)
    confidence, source = np.zeros((rows, columns)), np.zeros((rows, columns), np.uint8)
    range_m[known] = 1 / inverse[known]
    sigma_m[known] = std[known] / inverse[known] ** 2
    relative = sigma_m[known] / range_m[known]
    sure = np.clip(texture[known] / _FULL_TEXTURE, 0.3, 1) * np.where(hits[known] > 0, 1.0, 0.6)
    step = _spread(inverse, known)[known] / inverse[known]
    confidence[known] = sure * np.exp(-2 * relative - _STEP * step)
    source[known] = MATCHED
    down = -np.sin(grid.elevations())
    if np.isfinite(attitude.height_m) and attitude.height_m > 0:
        water = (labels.classes == WATER) & (down > 1e-3)[:, None]
        plane = np.broadcast_to((attitude.height_m / np.maximum(down, 1e-3))[:, None], water.shape)
        slope = np.broadcast_to(
            (1 / np.maximum(np.tan(np.arcsin(np.clip(down, 1e-3, 1))), 1e-3))[:, None], water.shape
        )
        relative_std = np.hypot(slope * attitude.tilt_std, attitude.height_std_m / attitude.height_m)
        range_m[water], source[water] = plane[water], PLANE
        sigma_m[water] = (plane * relative_std)[water]
        confidence[water] = (np.exp(-2 * relative_std) * labels.probability[0])[water]
    return DepthPanorama(grid, range_m, sigma_m, confidence, source, timestamp_ns)


def _splatted(matched: Sequence[MatchedPoints], grid: StripGrid) -> tuple[Array, Array, Array, Array]:
    """Inverse range, deviation, texture and number of points of every pixel (rows, columns)."""
    size = grid.rows * grid.columns
    inverse, std = np.full(size, np.nan), np.full(size, np.nan)
    texture, hits = np.zeros(size), np.zeros(size)
    matched = [m for m in matched if len(m.texture)]  # at night nothing is matched
    if matched:
        points = np.concatenate([m.points_level for m in matched])
        deviation = np.concatenate([m.inverse_std for m in matched])
        contrast = np.concatenate([m.texture for m in matched])
        distance = np.linalg.norm(points, axis=1)
        at = np.round(grid.pixels(points / distance[:, None])).astype(np.int64)
        inside = (at[:, 1] >= 0) & (at[:, 1] < grid.rows)
        pixel = (at[:, 1] * grid.columns + at[:, 0] % grid.columns)[inside]
        value, deviation, contrast = 1 / distance[inside], deviation[inside], contrast[inside]
        weight = contrast / deviation**2
        with np.errstate(invalid="ignore", divide="ignore"):
            nearer = _weighted_quantile(value, contrast / deviation, pixel, size)
            near = np.abs(value - nearer[pixel]) < _AGREE * deviation
            total = np.bincount(pixel[near], weight[near], size)
            inverse = np.bincount(pixel[near], (weight * value)[near], size) / total
            std = np.bincount(pixel[near], (weight * deviation)[near], size) / total
            texture = np.bincount(pixel[near], (weight * contrast)[near], size) / total
        hits = np.bincount(pixel[near], minlength=size).astype(np.float64)
    shape = (grid.rows, grid.columns)
    return (
        inverse.reshape(shape),
        std.reshape(shape),
        np.nan_to_num(texture).reshape(shape),
        hits.reshape(shape),
    )


def _weighted_quantile(value: Array, weight: Array, pixel: NDArray[np.int64], size: int) -> Array:
    """(size,) of the values (N,) in each pixel, the one that so much of the weight does not exceed; the nearer of two
    groups has the larger values."""
    order = np.lexsort((value, pixel))
    total = np.concatenate([[0.0], np.cumsum(weight[order])])
    ends = np.searchsorted(pixel[order], np.arange(size + 1))
    wanted = total[ends[:-1]] + _NEARER * np.diff(total[ends])
    chosen = np.clip(np.searchsorted(total[1:], wanted), 0, max(len(value) - 1, 0))
    return np.where(np.diff(ends) > 0, value[order][chosen], np.nan)


def _spread(inverse: Array, known: NDArray[np.bool_]) -> Array:
    """(rows, columns) largest less least of the known values around: large where one range ends and the next begins,
    where most wrong matches are."""
    window = np.ones((_SPREAD_PX, _SPREAD_PX), np.uint8)
    most = cv2.dilate(np.where(known, inverse, 0.0), window)
    return np.asarray(most - cv2.erode(np.where(known, inverse, _NEAREST_INVERSE), window))


def _filled(
    inverse: Array, std: Array, texture: Array, known: NDArray[np.bool_], wanted: NDArray[np.bool_]
) -> tuple[Array, Array, Array]:
    """Small holes filled with the mean around them, half as certain."""
    size = (2 * _FILL_PX + 1, 2 * _FILL_PX + 1)
    weight = cv2.blur(known.astype(np.float64), size)
    hole = wanted & ~known & (weight > 0.25)
    filled = []
    for plane, factor in ((inverse, 1.0), (std, 2.0), (texture, 0.5)):
        around = cv2.blur(np.where(known, plane, 0.0), size)
        plane = np.where(known, plane, np.nan)
        plane[hole] = factor * around[hole] / weight[hole]
        filled.append(plane)
    return filled[0], filled[1], filled[2]
