"""The careful way for stills: seams along a graph cut, and multi-band blending across them (OpenCV's `cv2.detail`)."""

from __future__ import annotations

import cv2
import numpy as np

from rigwake._types import Image
from rigwake.views.attitude import LevelAttitude
from rigwake.views.frames import FrameSet
from rigwake.views.surface import Surface
from rigwake.views.surround_view import SurroundView
from rigwake.views.weights import blending_weights

_BANDS = 5
_SEAM_SCALE = 4  # seams are sought in a picture so many times smaller
_WRAP_PX = 128  # a panorama is continued so far beyond its ends, so that they meet
_BAND_DEG = 14.0  # seams are sought within this angle of where two cameras are equally good


def blended_still(
    view: SurroundView, frames: FrameSet, attitude: LevelAttitude, surface: Surface, wraps: bool
) -> Image:
    """(H, W, 3) BGR view of one frame set. wraps: the left and right edges of the view meet.

    A seam may move within a band around the place where two cameras are equally good, to where they differ least.
    """
    lookup = view.lookup(attitude, surface)
    there = np.flatnonzero(~frames.is_missing)
    quality = np.where(frames.is_missing[:, None, None], np.float32(0), lookup.quality)
    band = blending_weights(quality, _BAND_DEG)
    size = (lookup.width_px, lookup.height_px)
    pictures, masks = [], []
    for camera in there:
        names = {n: "left out" for k, n in enumerate(view.rig.names) if k != camera}
        alone = FrameSet(frames.timestamp_ns, frames.names, frames.stack, names, frames.offsets_s)
        picture = view.picture(alone, attitude, surface)
        allowed = _full(band[camera], size) > 0
        pictures.append(picture)
        masks.append(((picture.max(axis=2) > 0) & allowed).astype(np.uint8) * 255)
    if len(pictures) < 2:
        return view.picture(frames, attitude, surface)
    if wraps:
        pictures = [_wrapped(p) for p in pictures]
        masks = [_wrapped(m) for m in masks]
    masks = _cut(pictures, masks)
    height, width = masks[0].shape
    blender = cv2.detail.MultiBandBlender()
    blender.setNumBands(_BANDS)
    blender.prepare((0, 0, width, height))
    for picture, mask in zip(pictures, masks, strict=True):
        blender.feed(picture.astype(np.int16), mask, (0, 0))
    result, shown = blender.blend(None, None)
    blended = np.where(shown[..., None] > 0, np.clip(result, 0, 255), 0).astype(np.uint8)
    return np.ascontiguousarray(blended[:, _WRAP_PX:-_WRAP_PX] if wraps else blended)


def _full(nodes: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Values of nodes every 8 px in full resolution."""
    step = np.array([[1 / 8, 0, 0], [0, 1 / 8, 0]])
    return cv2.warpAffine(nodes, step, size, flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP)


def _wrapped(picture: np.ndarray) -> np.ndarray:
    return np.concatenate([picture[:, -_WRAP_PX:], picture, picture[:, :_WRAP_PX]], axis=1)


def _cut(pictures: list[Image], masks: list[np.ndarray]) -> list[np.ndarray]:
    """Masks that hardly overlap any more, cut where the pictures differ least."""
    height, width = masks[0].shape
    small = (width // _SEAM_SCALE, height // _SEAM_SCALE)
    floats = [cv2.resize(p, small, interpolation=cv2.INTER_AREA).astype(np.float32) for p in pictures]
    rough = [cv2.resize(m, small, interpolation=cv2.INTER_NEAREST) for m in masks]
    finder = cv2.detail.GraphCutSeamFinder("COST_COLOR")
    cut = finder.find(floats, [(0, 0)] * len(floats), rough)
    result = []
    for mask, piece in zip(masks, cut, strict=True):
        grown = cv2.dilate(
            np.asarray(piece.get() if hasattr(piece, "get") else piece), np.ones((3, 3), np.uint8)
        )
        result.append(cv2.resize(grown, (width, height), interpolation=cv2.INTER_LINEAR) & mask)
    return result
