"""Corners worth following, spread evenly over the image."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from rigwake._kernels import njit
from rigwake._types import Array, Image, Mask

_BLOCK_PX = 7  # window of the structure tensor


def corner_strength(image: Image) -> NDArray[np.float32]:
    """Smaller eigenvalue of the structure tensor, summed over 7x7 px, (grey levels / px)^2.

    `noise / sqrt(strength)` is the standard deviation, in the worse direction, of registering that window
    (Shi and Tomasi 1994).
    """
    strength = cv2.cornerMinEigenVal(image, _BLOCK_PX, ksize=3)
    # on 8-bit images cv2 divides its Sobel (8 x the gradient) by 4 * block * 255
    return np.asarray(strength * np.float32((255.0 * _BLOCK_PX / 2) ** 2))


def _rank_in_group(groups: NDArray[np.int64]) -> NDArray[np.int64]:
    """Position of each element among the elements of its group, in order of appearance."""
    if len(groups) == 0:
        return groups
    order = np.argsort(groups, kind="stable")
    sorted_groups = groups[order]
    starts = np.flatnonzero(np.r_[True, sorted_groups[1:] != sorted_groups[:-1]])
    counts = np.diff(np.r_[starts, len(groups)])
    rank = np.empty(len(groups), dtype=np.int64)
    rank[order] = np.arange(len(groups)) - np.repeat(starts, counts)
    return rank


def detect_corners(
    image: Image,
    usable: Mask,
    occupied: Array,
    *,
    wanted: int,
    cell_px: int,
    min_distance_px: int,
    min_strength: float,
    last: Mask | None = None,
    wanted_last: int = 0,
) -> Array:
    """The strongest corners away from `occupied` points, balanced over a grid: (K <= wanted, 2) whole pixels.

    image: (H, W) grey. usable: (H, W), where corners may lie. occupied: (P, 2) points already followed.
    Cells that hold the fewest points are served first; within a cell the strongest corner wins.
    last: (H, W), where corners are taken only after all others, at most `wanted_last` of them.
    """
    strength = corner_strength(image)
    peaks = (strength >= cv2.dilate(strength, np.ones((3, 3), np.uint8))) & (strength > min_strength)
    rows, columns = np.nonzero(peaks & usable)
    order = np.lexsort((columns, rows, -strength[rows, columns]))
    free = np.ones(usable.shape, dtype=np.bool_)
    _claim(
        free,
        np.rint(occupied[:, 1]).astype(np.int64),
        np.rint(occupied[:, 0]).astype(np.int64),
        min_distance_px,
    )
    order = order[_claim(free, rows[order], columns[order], min_distance_px)]
    rows, columns = rows[order], columns[order]
    candidates = np.stack([columns, rows], axis=1).astype(np.float64)
    served = balanced(candidates, occupied, image.shape[1], cell_px)
    if last is not None:
        waits = last[rows[served], columns[served]]
        served = np.r_[served[~waits], served[waits][: max(wanted_last, 0)]]
    return candidates[served[:wanted]]


@njit(nogil=True)
def _claim(free: Mask, rows: NDArray[np.int64], columns: NDArray[np.int64], reach: int) -> Mask:
    """Which points (N,), in order, find their pixel free; each claims all pixels nearer than `reach`."""
    height, width = free.shape
    claimed = np.zeros(len(rows), np.bool_)
    for i in range(len(rows)):
        y, x = rows[i], columns[i]
        if not (0 <= y < height and 0 <= x < width and free[y, x]):
            continue
        claimed[i] = True
        for v in range(max(y - reach, 0), min(y + reach + 1, height)):
            for u in range(max(x - reach, 0), min(x + reach + 1, width)):
                if (v - y) ** 2 + (u - x) ** 2 < reach * reach:
                    free[v, u] = False
    return claimed


def balanced(candidates: Array, occupied: Array, width_px: int, cell_px: int) -> NDArray[np.int64]:
    """Order (N,) in which to take candidates (N, 2), best first within a cell of the grid, so that cells fill
    evenly; `occupied` (P, 2) are points that are there already."""
    across = -(-width_px // cell_px)
    cells, taken = (
        (np.maximum(points[:, 1], 0).astype(np.int64) // cell_px) * across
        + np.clip(points[:, 0], 0, width_px - 1).astype(np.int64) // cell_px
        for points in (candidates, occupied)
    )
    size = int(max(cells.max(initial=0), taken.max(initial=0))) + 1
    rank = _rank_in_group(cells) + np.bincount(taken, minlength=size)[cells]
    return np.argsort(rank, kind="stable")
