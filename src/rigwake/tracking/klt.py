"""Pyramidal Lucas-Kanade from one frame to the next, checked forwards and backwards.

What OpenCV's `calcOpticalFlowPyrLK` does, step for step, on pyramids that are made once per image, in compiled
loops that take 0.6 of its processor time. Source: Bouguet, *Pyramidal implementation of the affine Lucas
Kanade feature tracker* (2000).
"""

from __future__ import annotations

from math import floor, sqrt

import cv2
import numpy as np
from numba.extending import register_jitable
from numpy.typing import NDArray

from rigwake._kernels import njit
from rigwake._types import Array, Image, Mask
from rigwake.parallel import over_ranges, ranges

Pyramid = tuple[NDArray[np.float32], ...]
"""An image and its halves, quarters, ..., each with a margin around it, mirrored."""

SUMS_IN_ANY_ORDER = {"reassoc", "contract", "arcp", "nsz"}  # pixels may still be NaN
_LEAST_POINTS = 50  # that are worth a thread
_MOST_STEPS = 12
_CONVERGED_PX = 0.03
_SWINGING_PX = 0.01  # a step that takes the one before back by all but this has jumped over the minimum
_LEAST_SLOPE = 0.1  # (grey levels / px)^2, mean over the window, in the direction with the least of it


def pyramid(image: Image, window_px: int, levels: int) -> Pyramid:
    """The image (H, W) at so many scales, with a margin as wide as the window."""
    scales = [image]
    for _ in range(levels - 1):
        scales.append(np.asarray(cv2.pyrDown(scales[-1]), dtype=np.uint8))
    margin = (_padded(window_px) + 1,) * 4
    return tuple(cv2.copyMakeBorder(i, *margin, cv2.BORDER_REFLECT_101).astype(np.float32) for i in scales)


def _padded(window_px: int) -> int:
    """Columns that a window takes in memory: whole vectors of the processor, unrolled as compilers do."""
    return -(-window_px // 32) * 32


def follow(
    before: Pyramid,
    after: Pyramid,
    pixels: Array,
    predicted: Array,
    *,
    window_px: int,
    max_forward_backward_px: float,
) -> tuple[Array, Mask]:
    """Where points of one frame are in another: pixels (N, 2) and which of them (N,) can be believed.

    predicted: (N, 2) where to start looking. A point is believed when followed back from where it landed
    it returns to within `max_forward_backward_px` of its origin (Kalal et al. 2010).
    """
    start = np.ascontiguousarray(pixels, dtype=np.float64)
    landed, returned, found = predicted.astype(np.float64), start.copy(), np.ones(len(start), dtype=np.bool_)

    def work(first: int, last: int) -> None:
        own = slice(first, last)
        _lucas_kanade(before, after, start[own], landed[own], found[own], window_px)
        _lucas_kanade(after[:2], before[:2], landed[own], returned[own], found[own], window_px)

    over_ranges(ranges(np.ones(len(start)), _LEAST_POINTS), work)
    error = np.linalg.norm(returned - start, axis=1)
    return landed, found & (error <= max_forward_backward_px)


def _lucas_kanade(
    before: Pyramid, after: Pyramid, start: Array, landed: Array, found: Mask, window_px: int
) -> None:
    """Moves `landed` (N, 2) from an initial guess to where the windows about `start` are; clears `found` (N,) of those
    that are not there."""
    padded = _padded(window_px)
    for level in reversed(range(len(before))):
        _search(before[level], after[level], start, landed, found, 0.5**level, level == 0, window_px, padded)


# What it calls is inlined: a function of its own has two copies, one of them optimised again inside its caller, and
# which one runs would differ between the process that compiles and those that load, by a rounding of sums.
@njit(nogil=True, fastmath=SUMS_IN_ANY_ORDER)
def _search(  # type: ignore[no-untyped-def]
    before, after, start, landed, found, scale, finest, window_px, padded
):
    """One level; on the `finest` one, points that cannot be followed are marked as not found."""
    shape = (window_px, padded)  # beyond the window all stays zero
    window, by_x, by_y = np.zeros(shape, np.float32), np.zeros(shape, np.float32), np.zeros(shape, np.float32)
    wider = np.empty((window_px + 2, window_px + 2), np.float32)
    reach, margin = 0.5 * (window_px - 1), padded + 1
    for n in range(len(start)):
        # top left corners of the windows
        x, y = start[n, 0] * scale - reach + margin, start[n, 1] * scale - reach + margin
        if not _interpolate(before, x - 1, y - 1, wider):
            found[n] = found[n] and not finest
            continue
        xx, xy, yy = _slopes(wider, window, by_x, by_y)
        determinant = xx * yy - xy * xy
        least = 0.5 * (xx + yy - sqrt((xx - yy) ** 2 + 4 * xy * xy))
        if least < _LEAST_SLOPE * window_px**2 or determinant < 1e-12:
            found[n] = found[n] and not finest
            continue
        x, y = landed[n, 0] * scale - reach + margin, landed[n, 1] * scale - reach + margin
        last_x = last_y = 0.0
        for step in range(_MOST_STEPS):
            gx, gy, inside = _pull(after, x, y, window, by_x, by_y)
            if not inside:
                found[n] = found[n] and not finest
                break
            dx, dy = (xy * gy - yy * gx) / determinant, (xy * gx - xx * gy) / determinant
            x, y = x + dx, y + dy
            if dx * dx + dy * dy <= _CONVERGED_PX**2:
                break
            if step > 0 and abs(dx + last_x) < _SWINGING_PX and abs(dy + last_y) < _SWINGING_PX:
                x, y = x - 0.5 * dx, y - 0.5 * dy
                break
            last_x, last_y = dx, dy
        landed[n, 0], landed[n, 1] = (x + reach - margin) / scale, (y + reach - margin) / scale


@register_jitable(inline="always")
def _interpolate(image, x, y, out):  # type: ignore[no-untyped-def]
    """Bilinear samples from (x, y) on, at steps of one pixel; False if they leave the image."""
    height, width = out.shape
    if not (x >= 0 and y >= 0 and x + width < image.shape[1] and y + height < image.shape[0]):
        return False
    column, row = floor(x), floor(y)
    a, b = np.float32(x - column), np.float32(y - row)
    w00, w01 = (np.float32(1) - a) * (np.float32(1) - b), a * (np.float32(1) - b)
    w10, w11 = (np.float32(1) - a) * b, a * b
    for i in range(height):
        upper, lower = image[row + i, column:], image[row + i + 1, column:]
        for j in range(width):
            out[i, j] = w00 * upper[j] + w01 * upper[j + 1] + w10 * lower[j] + w11 * lower[j + 1]
    return True


@register_jitable(inline="always")
def _slopes(wider, window, by_x, by_y):  # type: ignore[no-untyped-def]
    """The window inside a `wider` one, its derivatives (Scharr's filter), and the sums of their products."""
    size = len(window)
    side, middle = np.float32(3 / 32), np.float32(10 / 32)
    xx = xy = yy = np.float32(0)
    for i in range(size):
        above, here, below = wider[i], wider[i + 1], wider[i + 2]
        for j in range(size):
            window[i, j] = here[j + 1]
            right, left = above[j + 2] + below[j + 2], above[j] + below[j]
            gx = side * (right - left) + middle * (here[j + 2] - here[j])
            gy = side * (below[j] + below[j + 2] - above[j] - above[j + 2])
            gy += middle * (below[j + 1] - above[j + 1])
            by_x[i, j], by_y[i, j] = gx, gy
            xx += gx * gx
            xy += gx * gy
            yy += gy * gy
    return float(xx), float(xy), float(yy)


@register_jitable(inline="always")
def _pull(image, x, y, window, by_x, by_y):  # type: ignore[no-untyped-def]
    """Sums of (image - window) times the window's derivatives, with the window laid at (x, y), and whether that is
    inside the image."""
    height, width = window.shape
    if not (x >= 0 and y >= 0 and x + width < image.shape[1] and y + height < image.shape[0]):
        return 0.0, 0.0, False
    column, row = floor(x), floor(y)
    a, b = np.float32(x - column), np.float32(y - row)
    w00, w01 = (np.float32(1) - a) * (np.float32(1) - b), a * (np.float32(1) - b)
    w10, w11 = (np.float32(1) - a) * b, a * b
    gx = gy = np.float32(0)
    for i in range(height):
        upper, lower = image[row + i, column:], image[row + i + 1, column:]
        for j in range(width):
            seen = w00 * upper[j] + w01 * upper[j + 1] + w10 * lower[j] + w11 * lower[j + 1]
            difference = seen - window[i, j]
            gx += difference * by_x[i, j]
            gy += difference * by_y[i, j]
    return float(gx), float(gy), True
