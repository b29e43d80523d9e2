"""Stixels: every column of a level strip cut into water, upright obstacles and sky, with ranges.

The best cut of a column is found exactly, by dynamic programming over all cuts. A piece costs a constant, the negative
logarithms of its class probabilities, and, if it is an obstacle, the disagreement between the ranges matched in it and
the range at which its foot meets the water. An obstacle is upright: one horizontal distance from foot to top.
Source of the method: Hernandez-Juarez et al. (2019), *Slanted Stixels* (here without the slant: the ground is water).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from rigwake._types import Array
from rigwake.errors import UsageError
from rigwake.views.attitude import LevelAttitude
from rigwake.views.scene.segmentation import NOT_SEEN, OBSTACLE, SKY, WATER, Labels
from rigwake.views.scene.stixel_cut import cut_columns
from rigwake.views.strips import StripGrid
from rigwake.views.surface import SHELL_M, WaterAndStixels

KINDS = ("water", "obstacle", "sky")
_EVIDENCE = 0.5  # of the class probabilities, for the same reason
_EDGE_STD = np.deg2rad(0.15)  # of a contact with the water that the segmentation is sure of
_EDGE_PER_ROW = 0.3  # more, in rows, for every row around it that the segmentation is not sure of
_UNSURE = 0.6  # difference of two probabilities
_AROUND_ROWS = 11
_CORRELATED = (
    3.0  # matches in one window share their error: the cut counts them as so many times less certain
)
_MEDIAN_STD = 0.5  # of the median of several matches of several pairs, in deviations of one
_SHAPE_STD = 0.008  # of a range: what stands in a column is not flat and upright
_FOOT_ROWS = 6  # matches so far up from the foot give the range: banks and boats lean away higher up
_APART = (
    2.5  # standard deviations between contact and match, beyond which their difference is the uncertainty
)
_LEAST = 1e-3  # probability
_FAR_INVERSE_M = 1 / 2000.0
_FAR_AWAY_M = 500.0  # cameras of one vessel see what is farther in the same direction


@dataclass(frozen=True)
class Stixel:
    """One piece of one column. bearing_deg: to starboard of ahead. bottom_deg, top_deg: elevations. range_m,
    range_std_m: horizontal distance from the viewpoint, NaN for sky and where nothing tells it; water: at its far end.
    stands_in_water: whether its foot is seen in the water. probability: mean of its class."""

    bearing_deg: float
    width_deg: float
    kind: str
    bottom_deg: float
    top_deg: float
    range_m: float
    range_std_m: float
    stands_in_water: bool
    probability: float


@dataclass(frozen=True, eq=False)
class StixelWorld:
    """All pieces of one strip, by column from the left, in each from the bottom up.

    column, bottom, top, kind: (N,) with rows `top` (included) to `bottom` (excluded) of the grid. inverse_m,
    inverse_std: (N,) inverse horizontal distance and its standard deviation, NaN where unknown. stands: (N,) bool.
    probability: (N,). height_m: of the viewpoint above the water.
    """

    grid: StripGrid
    column: NDArray[np.int32]
    bottom: NDArray[np.int32]
    top: NDArray[np.int32]
    kind: NDArray[np.uint8]
    inverse_m: Array
    inverse_std: Array
    stands: NDArray[np.bool_]
    probability: Array
    height_m: float
    timestamp_ns: int = 0

    def __len__(self) -> int:
        return len(self.column)

    def range_m(self) -> tuple[Array, Array]:
        """(N,) horizontal distances and their standard deviations."""
        with np.errstate(divide="ignore", invalid="ignore"):
            distance = 1 / np.maximum(self.inverse_m, _FAR_INVERSE_M)
            return distance, self.inverse_std * distance**2

    def stixels(self) -> Iterator[Stixel]:
        """One by one."""
        distance, std = self.range_m()
        step, top_deg = self.grid.step_deg, self.grid.top_deg
        for k in range(len(self)):
            yield Stixel(
                float(-180 + (self.column[k] + 0.5) * step),
                step,
                KINDS[self.kind[k]],
                float(top_deg - self.bottom[k] * step),
                float(top_deg - self.top[k] * step),
                float(distance[k]),
                float(std[k]),
                bool(self.stands[k]),
                float(self.probability[k]),
            )

    def free_range_m(self, farthest_m: float = 100.0) -> Array:
        """(columns,) how far the water is free from the viewpoint, at most `farthest_m`; NaN where no water is seen and
        no obstacle's distance is known."""
        free = np.full(self.grid.columns, np.nan)
        distance, _ = self.range_m()
        obstacle = (self.kind == OBSTACLE) & np.isfinite(distance)
        nearest = np.full(self.grid.columns, np.inf)
        np.minimum.at(nearest, self.column[obstacle], distance[obstacle])
        free[self.column[self.kind == WATER]] = farthest_m
        known = np.isfinite(nearest)
        free[known] = np.minimum(nearest[known], farthest_m)
        return free

    def free_polygon(self, farthest_m: float = 100.0) -> Array:
        """(columns, 2) metres ahead and to port: the outline of the free water (zero where nothing is known)."""
        free = np.nan_to_num(self.free_range_m(farthest_m))
        azimuth = self.grid.azimuths()
        return np.stack([free * np.cos(azimuth), -free * np.sin(azimuth)], axis=1)

    def surface(self, shell_m: float = SHELL_M, layers: int = 3) -> WaterAndStixels:
        """The nearest obstacles of every column, as a surface that views can be drawn on: those of unknown distance at
        `shell_m`, what is neither obstacle nor near water (clouds, the horizon) far away."""
        distance_m = np.full((self.grid.columns, layers), np.nan)
        top_m, bottom_m = np.full_like(distance_m, np.nan), np.zeros_like(distance_m)
        distance = np.where(np.isfinite(self.inverse_m), self.range_m()[0], shell_m)
        used = np.zeros(self.grid.columns, int)
        near = np.flatnonzero((self.kind == OBSTACLE) & (distance < _FAR_AWAY_M))
        for k in near[np.argsort(distance[near], kind="stable")]:
            c = self.column[k]
            if used[c] < layers:
                elevation = np.deg2rad(
                    self.grid.top_deg - np.array([self.top[k], self.bottom[k]]) * self.grid.step_deg
                )
                heights = self.height_m + distance[k] * np.tan(elevation)
                distance_m[c, used[c]] = distance[k]
                top_m[c, used[c]] = np.inf if self.top[k] == 0 else heights[0]
                bottom_m[c, used[c]] = 0.0 if self.stands[k] else max(float(heights[1]), 0.0)
                used[c] += 1
        return WaterAndStixels(distance_m, top_m, bottom_m, max(shell_m, _FAR_AWAY_M))


def find_stixels(
    labels: Labels,
    grid: StripGrid,
    attitude: LevelAttitude,
    inverse_m: Array | None = None,
    inverse_std: Array | None = None,
    contact_shift_deg: Array | None = None,
    contact_std_deg: float | None = None,
    timestamp_ns: int = 0,
) -> StixelWorld:
    """Stixels of a segmented level strip.

    inverse_m, inverse_std: (rows, columns) inverse horizontal distances that were matched, NaN where none. They count
    only in obstacles. contact_shift_deg: (rows, columns) how much lower than the row's lower edge a foot there is, from
    the native picture. contact_std_deg: of a contact.
    Raises UsageError if the height above the water is not known.
    """
    height = attitude.height_m
    if not np.isfinite(height) or height <= 0:
        raise UsageError(
            "The height of the cameras above the water is not known.",
            consequence="A foot in the water has no distance.",
            remedy="Give it: --height-m METRES (mean height of the cameras above the water).",
        )
    columns = labels.classes.shape[1]
    contact, contact_std = _contacts(labels, grid, attitude, contact_shift_deg, contact_std_deg)
    count, cut = _cheapest_cut(labels, grid, contact, contact_std, inverse_m, inverse_std)
    column = np.repeat(np.arange(columns), count).astype(np.int32)
    pieces = np.concatenate([cut[c, : count[c]] for c in range(columns)]) if count.any() else np.zeros((0, 4))
    bottom, top, kind = (pieces[:, k].astype(np.int64) for k in range(3))
    stands = pieces[:, 3] > 0
    foot = (contact[bottom, column], contact_std[bottom, column])
    inverse, inverse_sd = _ranges(
        bottom, top, column, stands & (kind == OBSTACLE), foot, inverse_m, inverse_std
    )
    inverse[kind == SKY], inverse_sd[kind == SKY] = np.nan, np.nan
    far_end = kind == WATER
    inverse[far_end] = contact[top[far_end], column[far_end]]
    inverse_sd[far_end] = contact_std[top[far_end], column[far_end]]
    total = np.concatenate(
        [np.zeros((3, 1, columns)), np.cumsum(labels.probability, axis=1, dtype=np.float64)], axis=1
    )
    mean = (total[kind, bottom, column] - total[kind, top, column]) / np.maximum(bottom - top, 1)
    return StixelWorld(
        grid, column, bottom.astype(np.int32), top.astype(np.int32), kind.astype(np.uint8), inverse, inverse_sd,
        stands, mean, height, timestamp_ns,
    )  # fmt: skip


def _contacts(
    labels: Labels,
    grid: StripGrid,
    attitude: LevelAttitude,
    shift_deg: Array | None,
    std_deg: float | None,
) -> tuple[Array, Array]:
    """(rows + 1, columns) inverse distance of a foot at each row edge, and its standard deviation."""
    rows, columns = labels.classes.shape
    height, height_std = attitude.height_m, attitude.height_std_m
    edges = np.deg2rad(grid.top_deg - np.arange(rows + 1) * grid.step_deg)[:, None]
    depression = -np.broadcast_to(edges, (rows + 1, columns)).copy()
    if shift_deg is not None:
        depression[1:] += np.deg2rad(shift_deg)
    slope = np.tan(np.clip(depression, 0.0, 1.5))
    edge_std = _edge_std(labels, grid) if std_deg is None else np.deg2rad(std_deg)
    angle_std = np.hypot(edge_std, attitude.tilt_std)
    contact = slope / height
    return contact, np.hypot((1 + slope**2) * angle_std / height, contact * height_std / height)


def _cheapest_cut(
    labels: Labels,
    grid: StripGrid,
    contact: Array,
    contact_std: Array,
    inverse_m: Array | None,
    inverse_std: Array | None,
) -> tuple[Any, Any]:
    """As `cut_columns`, of all columns of a strip."""
    rows, columns = labels.classes.shape
    cost = -_EVIDENCE * np.log(np.maximum(labels.probability, _LEAST))
    weight, value = np.zeros((rows, columns)), np.zeros((rows, columns))
    if inverse_m is not None and inverse_std is not None:
        known = np.isfinite(inverse_m) & np.isfinite(inverse_std) & (inverse_std > 0)
        weight[known] = 1 / np.square(_CORRELATED * inverse_std[known])
        value[known] = inverse_m[known]
    seen = labels.classes != NOT_SEEN
    lowest = np.where(seen.any(axis=0), rows - np.argmax(seen[::-1], axis=0), 0)
    highest = np.where(seen.any(axis=0), np.argmax(seen, axis=0), 0)
    by_column = [np.ascontiguousarray(plane.T) for plane in (weight, value, contact, contact_std)]
    return cut_columns(
        np.ascontiguousarray(np.moveaxis(cost, -1, 0), dtype=np.float64),
        *by_column,
        lowest.astype(np.int64),
        highest.astype(np.int64),
        int(np.ceil(grid.horizon_row)),
    )


def _edge_std(labels: Labels, grid: StripGrid) -> Array:
    """(rows + 1, columns) standard deviation, radians, of a contact at each row edge: larger where obstacle and water
    pass into each other slowly."""
    unsure = (np.abs(labels.probability[OBSTACLE] - labels.probability[WATER]) < _UNSURE).astype(np.float32)
    around = cv2.boxFilter(unsure, -1, (1, _AROUND_ROWS), normalize=False, borderType=cv2.BORDER_REPLICATE)
    around = np.concatenate([around[:1], around])
    return np.asarray(_EDGE_STD + _EDGE_PER_ROW * np.deg2rad(grid.step_deg) * around, np.float64)


def _ranges(
    bottom: NDArray[np.int64],
    top: NDArray[np.int64],
    column: NDArray[np.int32],
    stands: NDArray[np.bool_],
    foot: tuple[Array, Array],
    inverse_m: Array | None,
    inverse_std: Array | None,
) -> tuple[Array, Array]:
    """(N,) inverse distances and deviations of pieces: the contact with the water and the median of the matches just
    above the foot (as one measurement: their errors are one another's), weighted by variance."""
    w_foot = np.where(stands, 1 / np.square(foot[1]), 0.0)
    matched, w_match = np.zeros(len(bottom)), np.zeros(len(bottom))
    if inverse_m is not None and inverse_std is not None:
        rows = bottom[:, None] - 1 - np.arange(_FOOT_ROWS)[None, :]
        inside = rows >= top[:, None]
        rows = np.maximum(rows, 0)
        values = np.where(inside, inverse_m[rows, column[:, None]], np.nan)
        deviations = np.where(inside, inverse_std[rows, column[:, None]], np.nan)
        some = np.isfinite(values).any(axis=1)
        matched[some] = np.nanmedian(values[some], axis=1)
        scatter = np.nanmax(np.abs(values[some] - matched[some, None]), axis=1) / 2
        one = np.hypot(np.nanmedian(deviations[some], axis=1), scatter)
        w_match[some] = 1 / (np.square(_MEDIAN_STD * one) + np.square(_SHAPE_STD * matched[some]))
    total = w_foot + w_match
    with np.errstate(invalid="ignore", divide="ignore"):
        inverse = np.where(
            total > 0, (w_foot * np.where(stands, foot[0], 0) + w_match * matched) / total, np.nan
        )
        std = np.where(total > 0, 1 / np.sqrt(total), np.nan)
        both = (w_foot > 0) & (w_match > 0)
        apart = np.abs(foot[0] - matched)
        far = both & (apart > _APART * np.sqrt(1 / w_foot + 1 / w_match))
        std[far] = np.maximum(std[far], apart[far] / 2)
    return inverse, std
