"""Which camera shows what: a quality for every pixel of a camera, and blending weights from them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from rigwake._types import Floats
from rigwake.cameras.protocol import CameraModel
from rigwake.tracking.masks import pixel_grid
from rigwake.views.surround_rig import SurroundRig

FEATHER_DEG = 3.0  # half width of the blend between neighbouring cameras
_STEP = 4  # pixels of the image per pixel of the quality
_BORDER = 0.05  # of the image's smaller side: the quality falls to zero over so much towards an edge
_LENS_MARGIN = 0.01  # radians, of the edge of the lens


@dataclass(frozen=True, eq=False)
class CameraQuality:
    """How well each camera shows what its pixels look at.

    quality: per camera, (H/4, W/4) float32 in steps of 4 px: falls with the angle off the axis, and to zero at the
    edges of the image, of the lens and of the own hull. usable: (C, Hmax, Wmax) uint8, 1 where a pixel may be shown.
    """

    quality: tuple[Floats, ...]
    usable: NDArray[np.uint8]


def camera_quality(rig: SurroundRig, masks: Mapping[str, NDArray[np.bool_]] | None = None) -> CameraQuality:
    """Quality of every camera of a rig. masks: (H, W) by name, True where the camera sees its own vessel."""
    masks = masks or {}
    height, width = max(m.height_px for m in rig.models), max(m.width_px for m in rig.models)
    usable = np.zeros((len(rig), height, width), dtype=np.uint8)
    qualities = []
    for index, (name, model) in enumerate(zip(rig.names, rig.models, strict=True)):
        quality, is_usable = _one_camera(model, masks.get(name))
        usable[index, : model.height_px, : model.width_px] = is_usable
        qualities.append(quality)
    return CameraQuality(tuple(qualities), usable)


def _one_camera(model: CameraModel, mask: NDArray[np.bool_] | None) -> tuple[Floats, NDArray[np.uint8]]:
    rows, columns = -(-model.height_px // _STEP), -(-model.width_px // _STEP)
    bearings, valid = model.unproject(_STEP * pixel_grid(columns, rows) + (_STEP - 1) / 2)
    angle = np.arccos(np.clip(np.where(valid, bearings[:, 2], -1.0), -1, 1)).reshape(rows, columns)
    seen = valid.reshape(rows, columns) & (angle < model.max_angle - _LENS_MARGIN)
    usable = np.kron(seen.astype(np.uint8), np.ones((_STEP, _STEP), np.uint8))
    usable = np.ascontiguousarray(usable[: model.height_px, : model.width_px])
    if mask is not None:
        usable[mask] = 0
    usable[:, -1] = 0  # interpolation reads the next column and row
    usable[-1] = 0
    framed = cv2.copyMakeBorder(usable, 1, 1, 1, 1, cv2.BORDER_CONSTANT, value=0)
    distance = cv2.distanceTransform(framed, cv2.DIST_L2, 3)[1:-1, 1:-1]
    small = cv2.resize(distance, (columns, rows), interpolation=cv2.INTER_AREA)
    border = max(_BORDER * min(model.height_px, model.width_px), 4.0)
    ramp = np.clip(small / border, 0.0, 1.0)
    quality = (1.05 - angle / np.pi) * ramp * ramp * (3 - 2 * ramp)
    return quality.astype(np.float32), usable


def sampled_quality(quality: Floats, pixels: Floats) -> Floats:
    """(R, K) quality at pixels (R, K, 2) of the full image; zero outside."""
    scaled = (pixels - (_STEP - 1) / 2) / _STEP
    return cv2.remap(
        quality,
        np.ascontiguousarray(scaled[..., 0]),
        np.ascontiguousarray(scaled[..., 1]),
        cv2.INTER_LINEAR,
        borderMode=cv2.BORDER_CONSTANT,
    )


def blending_weights(quality: Floats, feather_deg: float = FEATHER_DEG) -> Floats:
    """(C, R, K) weights that sum to one (or are all zero) from qualities (C, R, K).

    The best camera has it alone, but for a band of `feather_deg` to both sides of where two are equally good.
    """
    best = quality.max(axis=0)
    band = np.float32(max(feather_deg, 1e-3) / 90.0)
    weights = np.clip(quality - best + band, 0.0, None) * (quality > 0)
    total = weights.sum(axis=0)
    return np.asarray(weights / np.where(total > 0, total, 1.0), dtype=np.float32)
