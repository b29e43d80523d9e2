"""Between which elevations, by azimuth, scenery can be seen: rays above and below need not be cast.

The scenery's triangles are gathered into upright boxes, small near the middle of the water and larger far away. What
a box hides of the horizon, seen from the camera, is bounded from its nearest and farthest points.
"""

from __future__ import annotations

import math

import numpy as np

from rigwake._types import Array, Floats
from rigwake.simulation.compiled import inlined, loop

_BINS = 2048  # a power of two
_CELL_M = 2.0
_CELL_PER_M = 0.04  # of the distance from the middle
_SLACK_M = 0.02
_STEEPEST = 1e12  # finite: times nothing it must stay a number


def gather_boxes(triangles: Floats) -> Array:
    """Boxes (B, 2, 3), lowest and highest corners, that hold all triangles (T, 3, 3)."""
    low, high = _small_pieces(triangles)
    middle = (low + high)[:, :2] / 2
    level = np.floor(np.log2(np.maximum(np.linalg.norm(middle, axis=1) * _CELL_PER_M / _CELL_M, 1.0)))
    cell = np.column_stack([level, np.floor(middle / (_CELL_M * 2 ** level[:, None]))]).astype(np.int64)
    order = np.lexsort(cell.T)
    first = np.flatnonzero(np.r_[True, np.any(np.diff(cell[order], axis=0), axis=1)])
    return np.stack(
        [np.minimum.reduceat(low[order], first), np.maximum.reduceat(high[order], first)], 1, dtype=np.float64
    )


def _small_pieces(triangles: Floats) -> tuple[Floats, Floats]:
    """Lowest and highest corners (N, 3) of the triangles, large ones cut into four until they are small."""
    lows, highs = [], []
    while len(triangles):
        low, high = triangles.min(axis=1), triangles.max(axis=1)
        size = (high - low)[:, :2].max(axis=1)
        nearest = np.linalg.norm(np.maximum(np.maximum(low, -high)[:, :2], 0), axis=1)
        large = size > _CELL_M + _CELL_PER_M * nearest
        lows.append(low[~large])
        highs.append(high[~large])
        a, b, c = np.moveaxis(triangles[large], 1, 0)
        ab, bc, ca = (a + b) / 2, (b + c) / 2, (c + a) / 2
        pieces = ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca))
        triangles = np.concatenate([np.stack(piece, axis=1) for piece in pieces])
    return np.concatenate(lows), np.concatenate(highs)


def seen_band(boxes: Array, centres: Array, depth_m: float) -> Array:
    """Tangents of elevation (2, bins), lowest and highest, between which a camera sees scenery, by azimuth.

    centres: (N, 3) where the camera is while it takes a picture. depth_m: scenery deeper than this is under water.
    """
    middle = centres.mean(axis=0)
    slack = _SLACK_M + float(np.abs(centres - middle).max())
    band = np.empty((2, _BINS))
    _widen(boxes, middle, slack, depth_m, band)
    return band


@inlined
def in_band(band: Array, dx: float, dy: float, dz: float) -> bool:
    """Whether a ray may meet scenery."""
    level = math.sqrt(dx * dx + dy * dy) + 1e-9
    at = math.floor(_turn(dx, dy) * (_BINS / 4)) & (_BINS - 1)
    return band[0, at] * level <= dz <= band[1, at] * level


@inlined
def _turn(x: float, y: float) -> float:
    """A stand-in for the azimuth that grows with it, in -2..2 for a full turn and far cheaper."""
    fraction = x / max(abs(x) + abs(y), 1e-12)
    return math.copysign(1 - fraction, y)


@loop
def _widen(boxes: Array, centre: Array, slack: float, depth_m: float, band: Array) -> None:
    band[0, :], band[1, :] = _STEEPEST, -_STEEPEST
    for i in range(len(boxes)):
        x0, x1 = boxes[i, 0, 0] - centre[0] - slack, boxes[i, 1, 0] - centre[0] + slack
        y0, y1 = boxes[i, 0, 1] - centre[1] - slack, boxes[i, 1, 1] - centre[1] + slack
        if boxes[i, 1, 2] < -depth_m:
            continue
        z0 = max(boxes[i, 0, 2], -depth_m) - centre[2] - slack
        z1 = boxes[i, 1, 2] - centre[2] + slack
        near = math.hypot(max(x0, -x1, 0.0), max(y0, -y1, 0.0))
        if near <= 0:
            band[0, :], band[1, :] = -_STEEPEST, _STEEPEST
            return
        far = math.hypot(max(-x0, x1), max(-y0, y1))
        lowest, highest = z0 / (near if z0 < 0 else far), z1 / (near if z1 > 0 else far)
        middle = _turn((x0 + x1) / 2, (y0 + y1) / 2)
        first, last = 0.0, 0.0
        for x, y in ((x0, y0), (x0, y1), (x1, y0), (x1, y1)):
            beside = (_turn(x, y) - middle + 2) % 4 - 2  # a box beside the camera spans less than half a turn
            first, last = min(first, beside), max(last, beside)
        start = math.floor((middle + first) * (_BINS / 4))
        for at in range(start, math.floor((middle + last) * (_BINS / 4)) + 1):
            k = at & (_BINS - 1)
            band[0, k], band[1, k] = min(band[0, k], lowest), max(band[1, k], highest)
