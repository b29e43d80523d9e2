"""Pyramidal Lucas-Kanade from one frame to the next, checked forwards and backwards."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from rigwake.cameras.base import Mask
from rigwake.geometry.so3 import Array
from rigwake.recording import Image


def follow(
    before: Image,
    after: Image,
    pixels: Array,
    predicted: Array,
    *,
    window_px: int,
    levels: int,
    max_forward_backward_px: float,
) -> tuple[Array, Mask]:
    """Where points of one frame are in another: pixels (N, 2) and which of them (N,) can be believed.

    predicted: (N, 2) where to start looking. A point is believed when followed back from where it landed
    it returns to within `max_forward_backward_px` of its origin (Kalal et al. 2010).
    """
    if len(pixels) == 0:
        return np.empty((0, 2)), np.empty(0, dtype=bool)
    start = pixels.astype(np.float32)
    # cv2 writes its answer into the fourth argument, too
    landed, found = _lucas_kanade(before, after, start, predicted.astype(np.float32), window_px, levels)
    returned, found_back = _lucas_kanade(after, before, landed, start.copy(), window_px, min(levels, 2))
    error = np.linalg.norm(returned - start, axis=1)
    believed = found & found_back & (error <= max_forward_backward_px)
    return landed.astype(np.float64), believed


def _lucas_kanade(
    before: Image,
    after: Image,
    start: NDArray[np.float32],
    guess: NDArray[np.float32],
    window_px: int,
    levels: int,
) -> tuple[NDArray[np.float32], Mask]:
    landed, found, _ = cv2.calcOpticalFlowPyrLK(
        before,
        after,
        start,
        guess,
        winSize=(window_px, window_px),
        maxLevel=levels - 1,
        criteria=(cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 12, 0.03),
        flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
    )
    return np.asarray(landed, dtype=np.float32), np.asarray(found[:, 0] > 0)
