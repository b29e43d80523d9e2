"""Corners worth following, spread evenly over the image."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from rigwake.cameras.base import Mask
from rigwake.geometry.so3 import Array
from rigwake.recording import Image

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
) -> Array:
    """The strongest corners away from `occupied` points, balanced over a grid: (K <= wanted, 2) whole pixels.

    image: (H, W) grey. usable: (H, W), where corners may lie. occupied: (P, 2) points already followed.
    Cells that hold the fewest points are served first; within a cell the strongest corner wins.
    """
    strength = corner_strength(image)
    size = 2 * min_distance_px + 1
    peaks = strength >= cv2.dilate(strength, np.ones((size, size), np.uint8))
    peaks &= usable & (strength > min_strength)
    if len(occupied):
        free = np.full(usable.shape, 255, np.uint8)
        for x, y in np.rint(occupied).astype(int):
            cv2.circle(free, (int(x), int(y)), min_distance_px, 0, -1)
        peaks &= free > 0
    rows, columns = np.nonzero(peaks)
    order = np.lexsort((columns, rows, -strength[rows, columns]))
    rows, columns = rows[order], columns[order]

    cells_across = -(-image.shape[1] // cell_px)
    cells = (rows // cell_px) * cells_across + columns // cell_px
    rank = _rank_in_group(cells.astype(np.int64))
    if len(occupied):
        inside = np.clip(np.rint(occupied).astype(int), 0, np.array(image.shape[::-1]) - 1)
        taken = np.bincount(
            (inside[:, 1] // cell_px) * cells_across + inside[:, 0] // cell_px,
            minlength=cells_across * (-(-image.shape[0] // cell_px)),
        )
        rank = rank + taken[cells]
    chosen = np.argsort(rank, kind="stable")[:wanted]
    return np.stack([columns[chosen], rows[chosen]], axis=1).astype(np.float64)
