"""Water and sky: what moves by itself or has nothing to hold on to."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from rigwake._types import Array, Image, Mask
from rigwake.cameras.protocol import CameraModel
from rigwake.tracking.masks import pixel_grid

_SMOOTH = 6  # grey levels between neighbours, after a little blur
_HIGH = float(np.sin(np.deg2rad(15.0)))  # quays, houses and trees end below, unless one is beside them
_NEAR_TOP = 0.05  # of the sine of the elevation


class HorizonMask:
    """What lies below the horizon, frame by frame.

    On open water that is the water, which moves: corners on it are not static points.
    """

    def __init__(self, model: CameraModel, margin: float = np.deg2rad(0.5)) -> None:
        """margin: radians above the horizon that are left out with it, for errors of the attitude."""
        self._shape = (model.height_px, model.width_px)
        rows, columns = -(-model.height_px // 2), -(-model.width_px // 2)
        bearings, _ = model.unproject(2 * pixel_grid(columns, rows) + 0.5)
        planes = np.nan_to_num(bearings, nan=0.0).astype(np.float32).T
        self._x, self._y, self._z = (np.ascontiguousarray(p).reshape(rows, columns) for p in planes)
        self._sine = np.float32(np.sin(margin))

    def below(self, up_cam: Array) -> Mask:
        """(H, W), True below the horizon (in steps of 2 px); `up_cam` (3,) is the unit vector against gravity in
        camera axes."""
        return self._full_size(self._height(up_cam) < self._sine)

    def high(self, up_cam: Array) -> Mask:
        """(H, W), True more than 15 degrees above the horizon, where most of what is seen is sky (in steps of 2 px).

        Clouds have corners but no parallax: they tell nothing of the way, and the wind moves them.
        """
        return self._full_size(self._height(up_cam) > _HIGH)

    def _height(self, up_cam: Array) -> NDArray[np.float32]:
        """Sine of the elevation of every second pixel."""
        x, y, z = up_cam.astype(np.float32)
        return np.asarray(x * self._x + y * self._y + z * self._z)

    def _full_size(self, half: NDArray[Any]) -> NDArray[Any]:
        height, width = self._shape
        whole = (2 * half.shape[1], 2 * half.shape[0])
        values = half.view(np.uint8) if half.dtype == np.bool_ else half  # cv2 knows no booleans
        full = cv2.resize(values, whole, interpolation=cv2.INTER_NEAREST)
        return np.asarray(full[:height, :width]).view(half.dtype)

    def sky(self, image: Image, up_cam: Array) -> Mask:
        """(H, W), True where smooth image above the horizon reaches up to the zenith or the image's edge.

        image: (H, W) grey. Clouds are smooth enough; what stands before the sky and all it encloses is kept.
        """
        soft = cv2.GaussianBlur(image, (0, 0), 1.5)
        slope = cv2.morphologyEx(soft, cv2.MORPH_GRADIENT, np.ones((3, 3), np.uint8))
        smooth = (slope <= _SMOOTH) & ~self.below(up_cam)
        _, labels = cv2.connectedComponents(smooth.astype(np.uint8), connectivity=4)
        top = np.where(smooth, self._full_size(self._height(up_cam)), -1.0)
        highest = np.full(int(labels.max()) + 1, -1.0)
        np.maximum.at(highest, labels.ravel(), top.ravel())
        reaches_top = highest >= top.max() - _NEAR_TOP
        reaches_top[0] = False
        return np.asarray(reaches_top[labels])
