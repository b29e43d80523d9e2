"""Where the horizon stands in a camera's picture: its elevation over the azimuths that the camera sees."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from rigwake._types import Array, Image, Mask
from rigwake.cameras.protocol import CameraModel

_REACH_DEG, _STEP_DEG = 2.5, 0.05  # of the elevations searched, about the level
_COLUMN_DEG = 1.0
_LEAST_REACH_DEG = 24.0  # of azimuths, for the line's slope to be told
_EDGE_DEG, _EDGE_PX = 0.3, 1.5  # over which brightness above and below is compared: the larger
_LEAST_LIGHT = 25.0  # grey levels of the mean: less is night
_LEAST_CONTRAST = 6.0  # grey levels across the line
_AGREE_DEG, _AGREE_PX = 0.12, 0.4  # so far may a column's edge lie from the line: a shore is not straight
_LEAST_AGREEING = 0.7  # part of the columns
_ROUNDS = 6


@dataclass(frozen=True, eq=False)
class HorizonLine:
    """Elevation of the line straight ahead of the camera and at its left side, radians: `e = ahead cos a + side sin a`.

    std: (2,) of both, as the columns' scatter tells.
    """

    ahead: float
    side: float
    std: Array


class HorizonSearch:
    """Finds the line in pictures of one camera. masked: (H, W) pixels that are not used, such as the own hull."""

    def __init__(self, model: CameraModel, rig_from_cam_rotation: Array, masked: Mask | None = None) -> None:
        self._model, self._mounted, self._masked = model, rig_from_cam_rotation, masked
        pixel_deg = _pixel_deg(model)
        self._edge_deg = max(_EDGE_DEG, _EDGE_PX * pixel_deg)
        self._agree = np.deg2rad(max(_AGREE_DEG, _AGREE_PX * pixel_deg))
        reach = _REACH_DEG + self._edge_deg
        self._elevations = np.deg2rad(np.arange(-reach, reach + _STEP_DEG / 2, _STEP_DEG))
        self._azimuths = np.deg2rad(np.arange(-89.0, 89.1, _COLUMN_DEG))

    def find(self, picture: Image, up_rig: Array) -> HorizonLine | None:
        """The line in a picture (H, W) of grey levels, None where no straight edge goes across it.

        up_rig: (3,) as far as known, to a degree.
        """
        if float(picture.mean()) < _LEAST_LIGHT:
            return None
        strip, seen = self._strip(picture, up_rig)
        columns, elevation = _edges(strip, seen, self._elevations, self._edge_deg)
        return fit_line(self._azimuths[columns], elevation, self._agree)

    def _strip(self, picture: Image, up_rig: Array) -> tuple[Array, Mask]:
        """Grey levels by elevation (rows, upwards) and azimuth, and which columns are seen whole."""
        ahead, side = level_axes(self._mounted, up_rig)
        azimuth, elevation = self._azimuths, self._elevations
        level = np.cos(azimuth)[:, None] * ahead + np.sin(azimuth)[:, None] * side
        bearings = np.cos(elevation)[:, None, None] * level + np.sin(elevation)[:, None, None] * up_rig
        pixels, valid = self._model.project(bearings.reshape(-1, 3) @ self._mounted)
        height, width = picture.shape
        with np.errstate(invalid="ignore"):
            inside = valid & (pixels >= 1).all(axis=1)
            inside &= (pixels[:, 0] <= width - 2) & (pixels[:, 1] <= height - 2)
        pixels = np.where(inside[:, None], pixels, 0.0)
        if self._masked is not None:
            at = np.round(pixels).astype(np.int64)
            inside &= ~self._masked[at[:, 1], at[:, 0]]
        shape = len(elevation), len(azimuth)
        maps = pixels.astype(np.float32).reshape(*shape, 2)
        strip = cv2.remap(picture, maps, None, cv2.INTER_LINEAR).astype(np.float64)
        return strip, np.asarray(inside.reshape(shape).all(axis=0), dtype=bool)


def _pixel_deg(model: CameraModel) -> float:
    """How wide a pixel is on the optical axis."""
    d_point = model.project_with_jacobians(np.array([[0.0, 0.0, 1.0]])).d_point[0]
    return float(np.rad2deg(1 / np.sqrt(max(abs(np.linalg.det(d_point[:, :2])), 1e-6))))


def level_axes(rig_from_cam_rotation: Array, up_rig: Array) -> tuple[Array, Array]:
    """Level unit vectors (3,) ahead of a camera and at its left, in rig axes."""
    axis = rig_from_cam_rotation[:, 2]
    ahead = axis - (axis @ up_rig) * up_rig
    ahead = ahead / max(float(np.linalg.norm(ahead)), 1e-6)
    return ahead, np.cross(up_rig, ahead)


def _edges(strip: Array, seen: Mask, elevations: Array, edge_deg: float) -> tuple[Mask, Array]:
    """Which columns have an edge, bright above and dark below or the other way round as most have it, and at which
    elevation (radians), to a fraction of a row."""
    half = max(round(edge_deg / _STEP_DEG), 1)
    sums = np.concatenate([np.zeros((1, strip.shape[1])), np.cumsum(strip, axis=0)])
    middle = np.arange(half, len(strip) - half)
    above = (sums[middle + half + 1] - sums[middle + 1]) / half
    below = (sums[middle] - sums[middle - half]) / half
    contrast = above - below
    if not seen.any():
        return seen, np.empty(0)
    strongest = np.take_along_axis(contrast, np.abs(contrast).argmax(axis=0)[None], axis=0)[0]
    sign = 1.0 if np.median(strongest[seen]) >= 0 else -1.0
    contrast = sign * contrast
    best = contrast.argmax(axis=0)
    column = np.arange(strip.shape[1])
    inner = np.clip(best, 1, len(contrast) - 2)
    before, peak, after = (contrast[inner + d, column] for d in (-1, 0, 1))
    bend = before - 2 * peak + after
    shift = np.where(bend < 0, 0.5 * (before - after) / np.minimum(bend, -1e-9), 0.0)
    used = seen & (contrast[best, column] >= _LEAST_CONTRAST) & (best == inner)
    row = middle[inner] + np.clip(shift, -0.5, 0.5)
    elevation = elevations[0] + row * (elevations[1] - elevations[0])
    return used, elevation[used]


def fit_line(azimuth: Array, elevation: Array, limit: float) -> HorizonLine | None:
    """The line through most of the columns (N,) radians; None where too few agree to `limit`, or all lie close
    together."""
    if len(azimuth) < _LEAST_REACH_DEG / _COLUMN_DEG:
        return None
    A = np.stack([np.cos(azimuth), np.sin(azimuth)], axis=1)
    line = np.array([float(np.median(elevation)), 0.0])
    for _ in range(_ROUNDS):
        scale = max(limit / 2, 1.5 * float(np.median(np.abs(elevation - A @ line))))
        weight = 1 / (1 + ((elevation - A @ line) / scale) ** 2) ** 2
        line = np.linalg.lstsq(A * np.sqrt(weight)[:, None], elevation * np.sqrt(weight), rcond=None)[0]
    residual = elevation - A @ line
    agree = np.abs(residual) <= limit
    reach = azimuth[agree]
    if agree.mean() < _LEAST_AGREEING or np.ptp(reach) < np.deg2rad(_LEAST_REACH_DEG):
        return None
    noise = float(residual[agree].std()) + 1e-5
    covariance = noise**2 * np.linalg.inv(A[agree].T @ A[agree])
    return HorizonLine(float(line[0]), float(line[1]), np.sqrt(np.diag(covariance)))
