"""Millions of observations, reduced to what a page can show: maps over the image, curves over angle and time."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from rigwake._types import Array
from rigwake.cameras.protocol import CameraModel

MAP_COLUMNS, MAP_ROWS = 24, 18
ANGLE_STEP_DEG = 5.0
TIME_BINS = 80
HISTOGRAM_BINS, HISTOGRAM_PX = 30, 1.5
SCATTER_CELLS = 25
FEWEST = 10
"""Bins with fewer observations than this show nothing."""


@dataclass(frozen=True, eq=False)
class ImageMap:
    """Observations per cell of an image, and their mean residual: (rows, columns[, 2]); NaN where too few."""

    width_px: int
    height_px: int
    counts: Array
    mean_px: Array | None = None


@dataclass(frozen=True, eq=False)
class BinnedCurve:
    """Quantiles of the size of residuals in bins: at (B,), median and 90 % (B,), counts (B,)."""

    at: Array
    median: Array
    upper: Array
    counts: Array


@dataclass(frozen=True, eq=False)
class ResidualSummary:
    """Reprojection residuals of one camera: counts, sizes, and where and when they are large.

    histogram_px: middles of bins of the size; histogram: (bins,) counts, the last bin takes what is larger.
    scatter: counts over a square of side 2 * reach_px about zero, u to the right and v down; beyond: those outside.
    """

    count: int
    rms_px: float
    median_px: float
    image: ImageMap
    over_angle: BinnedCurve
    over_time: BinnedCurve
    histogram_px: Array
    histogram: Array
    scatter: ImageMap
    reach_px: float
    beyond: int


@dataclass(frozen=True, eq=False)
class TrackSummary:
    """Tracks of one camera: counts, coverage of the image, observations per second, lengths in frames."""

    frames: int
    tracks: int
    observations: int
    median_length: float
    duration_s: float
    image: ImageMap
    per_frame_at_s: Array
    per_frame: Array
    report: Mapping[str, Any]


def summarise_residuals(arrays: Mapping[str, np.ndarray], lens: CameraModel | None) -> ResidualSummary:
    """Of the arrays `timestamp_ns`, `pixels`, `residuals_px`, `angle_deg` of one camera."""
    residuals = arrays["residuals_px"].astype(np.float64)
    finite = np.isfinite(residuals).all(axis=1)
    residuals = residuals[finite]
    size = np.linalg.norm(residuals, axis=1)
    seconds = _seconds(arrays["timestamp_ns"][finite])
    angle = arrays["angle_deg"][finite]
    angle_edges = np.arange(0.0, np.nanmax(angle, initial=1.0) + ANGLE_STEP_DEG, ANGLE_STEP_DEG)
    time_edges = np.linspace(0.0, max(float(seconds.max(initial=0.0)), 1e-3), TIME_BINS + 1)
    width = HISTOGRAM_PX / HISTOGRAM_BINS
    bins = np.minimum(size / width, HISTOGRAM_BINS - 1).astype(np.int64)
    scatter, reach, beyond = _scatter(residuals)
    return ResidualSummary(
        count=len(size),
        rms_px=float(np.sqrt(np.mean(size**2))) if len(size) else float("nan"),
        median_px=float(np.median(size)) if len(size) else float("nan"),
        image=map_over_image(arrays["pixels"][finite], lens, residuals),
        over_angle=_curve(angle, size, angle_edges),
        over_time=_curve(seconds, size, time_edges),
        histogram_px=np.asarray((np.arange(HISTOGRAM_BINS) + 0.5) * width),
        histogram=np.bincount(bins, minlength=HISTOGRAM_BINS).astype(np.float64),
        scatter=scatter,
        reach_px=reach,
        beyond=beyond,
    )


def _scatter(residuals: Array) -> tuple[ImageMap, float, int]:
    """Counts of residuals (N, 2) over a square about zero that 98 % of their coordinates lie in, its half side, and
    how many lie outside."""
    reach = max(float(np.quantile(np.abs(residuals), 0.98)), 1e-3) if len(residuals) else 1.0
    cell = np.floor((residuals / reach + 1) / 2 * SCATTER_CELLS).astype(np.int64)
    inside = ((cell >= 0) & (cell < SCATTER_CELLS)).all(axis=1)
    flat = cell[inside, 1] * SCATTER_CELLS + cell[inside, 0]
    counts = np.bincount(flat, minlength=SCATTER_CELLS**2).astype(np.float64)
    square = counts.reshape(SCATTER_CELLS, SCATTER_CELLS)
    return ImageMap(SCATTER_CELLS, SCATTER_CELLS, square), reach, int((~inside).sum())


def summarise_tracks(arrays: Mapping[str, np.ndarray], lens: CameraModel | None) -> TrackSummary:
    """Of the arrays of a tracks file, bearings excepted."""
    frames, ids = arrays["frame_indices"], arrays["track_ids"]
    stamps = arrays["timestamps_ns"]
    seconds = _seconds(stamps)
    per_frame = np.bincount(frames, minlength=len(stamps)) if len(frames) else np.zeros(len(stamps), int)
    _, lengths = np.unique(ids, return_counts=True)
    thinned = np.unique(np.linspace(0, max(len(stamps) - 1, 0), 300).astype(int))
    report = str(arrays["report"])
    return TrackSummary(
        frames=len(stamps),
        tracks=len(lengths),
        observations=len(frames),
        median_length=float(np.median(lengths)) if len(lengths) else 0.0,
        duration_s=float(seconds.max(initial=0.0)),
        image=map_over_image(arrays["pixels"], lens, None),
        per_frame_at_s=seconds[thinned] if len(stamps) else seconds,
        per_frame=per_frame[thinned].astype(np.float64) if len(stamps) else seconds,
        report=json.loads(report) if report else {},
    )


def _seconds(stamps_ns: np.ndarray) -> Array:
    return (stamps_ns - stamps_ns.min()) * 1e-9 if len(stamps_ns) else np.zeros(0)


def map_over_image(pixels: np.ndarray, lens: CameraModel | None, residuals: Array | None) -> ImageMap:
    """Counts per cell of pixels (N, 2) and, if given, mean residuals (N, 2). lens: whose image size it is; None: as
    large as the pixels reach."""
    if lens is not None:
        width_px, height_px = lens.width_px, lens.height_px
    else:
        width_px, height_px = (int(x) + 1 for x in np.nanmax(pixels, axis=0, initial=1.0))
    column = ((pixels[:, 0] + 0.5) * MAP_COLUMNS / width_px).astype(np.int64)
    row = ((pixels[:, 1] + 0.5) * MAP_ROWS / height_px).astype(np.int64)
    inside = (column >= 0) & (column < MAP_COLUMNS) & (row >= 0) & (row < MAP_ROWS)
    cell, cells = (row * MAP_COLUMNS + column)[inside], MAP_ROWS * MAP_COLUMNS
    counts = np.bincount(cell, minlength=cells).astype(np.float64)
    shape = (MAP_ROWS, MAP_COLUMNS)
    if residuals is None:
        return ImageMap(width_px, height_px, counts.reshape(shape))
    sums = [np.bincount(cell, residuals[inside, k], minlength=cells) for k in (0, 1)]
    enough = counts >= FEWEST
    mean = np.stack([np.where(enough, s / np.maximum(counts, 1), np.nan) for s in sums], axis=-1)
    return ImageMap(width_px, height_px, counts.reshape(shape), mean.reshape(*shape, 2))


def _curve(at: np.ndarray, size: Array, edges: Array) -> BinnedCurve:
    """Median and 90 % of `size` between the edges: one sort, then slices."""
    known = np.isfinite(at)
    at, size = at[known], size[known]
    order = np.argsort(at, kind="stable")
    starts = np.searchsorted(at[order], edges)
    size = size[order]
    quantiles = np.full((len(edges) - 1, 2), np.nan)
    counts = np.diff(starts)
    for k in np.flatnonzero(counts >= FEWEST):
        quantiles[k] = np.quantile(size[starts[k] : starts[k + 1]], (0.5, 0.9))
    return BinnedCurve(
        (edges[:-1] + edges[1:]) / 2, quantiles[:, 0], quantiles[:, 1], counts.astype(np.float64)
    )
