"""The own hull, found as what stays put in the image while the boat turns."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from rigwake._types import Mask
from rigwake.errors import EstimationError, UnobservableError
from rigwake.recording import CameraStream
from rigwake.tracking.masks import beyond_image_circle, shrunk

_STEADY_FRACTION = 0.6  # of the gradient's power over time; random directions give 1 / frames
_MIN_GRADIENT = 1.5  # grey levels per px, of the mean over time: far above what noise leaves
_CLOSE_FRACTION = 0.015  # gaps of an outline up to this fraction of the image height are closed
_SMALL_FRACTION = 3e-4  # of the image: smaller regions are not hull
_ISLAND_FRACTION = 2e-2  # of the image: smaller gaps inside the hull belong to it
_MAX_FRACTION = 0.6  # of the textured part of the image that may stand still
_BORDER_PX = 6  # the edge of the image circle stands still, too


def find_self_mask(stream: CameraStream, usable: Mask, *, frames: int = 60, margin_px: int = 4) -> Mask:
    """(H, W), True where the own boat is in view.

    usable: (H, W), False beyond the lens. frames: how many, spread over the recording, are compared.
    margin_px: by how much the region is widened.

    At each pixel the fraction |mean gradient|^2 / mean |gradient|^2 over time is near 1 for an edge that stays put,
    even while the light on it changes, and small where edges pass by: a skyline or glitter is always of one
    sign, but only now and then there. Steady edges are
    closed to outlines, and the outlines filled. Raises EstimationError if hardly any frame can be read, and
    UnobservableError if most of the image stands still: then the boat did not turn, and all would be hull.
    """
    usable = usable & ~beyond_image_circle(stream)  # its outline stands still, too
    steady, textured = _steady_edges(stream, frames)
    inner = shrunk(usable, _BORDER_PX)
    textured &= inner
    if (steady & textured).sum() > _MAX_FRACTION * textured.sum():
        raise UnobservableError(
            f"{stream.name}: most of the image stands still.",
            consequence="What belongs to the own boat cannot be told from the scene.",
            remedy="Use a part of the recording in which the boat turns, or give a mask file.",
        )
    reach = max(int(_CLOSE_FRACTION * stream.height_px), 2)
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * reach + 1, 2 * reach + 1))
    # what lies beyond the lens or the image closes the outline of a hull that runs out of view
    edges = np.pad((steady & inner).astype(np.uint8), reach)
    closed = cv2.morphologyEx(edges, cv2.MORPH_CLOSE, disc)[reach:-reach, reach:-reach]
    outlines, _ = cv2.findContours(closed, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    large = [o for o in outlines if cv2.contourArea(o) > _SMALL_FRACTION * closed.size]
    hull = np.zeros(closed.shape, np.uint8)
    cv2.drawContours(hull, large, -1, 1, cv2.FILLED)
    hull = _grown(hull, 2 * _BORDER_PX) * ~inner | hull  # towards the border, where edges were not looked at
    rest, labels, statistics, _ = cv2.connectedComponentsWithStats(((hull == 0) & usable).astype(np.uint8))
    for island in range(1, rest):
        if statistics[island, cv2.CC_STAT_AREA] < _ISLAND_FRACTION * hull.size:
            hull[labels == island] = 1
    return np.asarray(_grown(hull, margin_px) > 0)


def _grown(region: NDArray[np.uint8], by_px: int) -> NDArray[np.uint8]:
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * by_px + 1, 2 * by_px + 1))
    return np.asarray(cv2.dilate(region, disc), dtype=np.uint8)


def _steady_edges(stream: CameraStream, frames: int) -> tuple[Mask, Mask]:
    """Where the gradient stays the same over time, and where there is a gradient at all."""
    indices = np.unique(np.linspace(0, len(stream) - 1, frames).astype(np.int64))
    shape = (stream.height_px, stream.width_px)
    total_x, total_y, power = (np.zeros(shape, np.float32) for _ in range(3))
    count = 0
    for frame in stream.frames(indices):
        soft = cv2.GaussianBlur(frame.image, (0, 0), 1.0).astype(np.float32)
        by_x, by_y = (
            cv2.Sobel(soft, cv2.CV_32F, 1, 0, scale=1 / 8),
            cv2.Sobel(soft, cv2.CV_32F, 0, 1, scale=1 / 8),
        )
        total_x += by_x
        total_y += by_y
        power += by_x * by_x + by_y * by_y
        count += 1
    if count < 10:
        raise EstimationError(
            f"{stream.name}: only {count} images could be read.",
            consequence="They do not tell what stays put.",
            remedy="Give a mask file, or a longer recording.",
        )
    lasting = total_x**2 + total_y**2
    steady = (lasting > _STEADY_FRACTION * power * count) & (lasting > (_MIN_GRADIENT * count) ** 2)
    return np.asarray(steady), np.asarray(power > _MIN_GRADIENT**2 * count)
