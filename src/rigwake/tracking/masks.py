"""Which pixels of a camera can hold static scene points: masks by named source."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from rigwake.cameras.base import CameraModel, Mask
from rigwake.geometry.so3 import Array


@dataclass(frozen=True, eq=False)
class CameraMask:
    """Regions of one camera that must not be used, by what they are.

    excluded: `(H, W)` bool arrays by source (`lens`, `hull`, `water`, `sky`, `file`), True where excluded.
    """

    width_px: int
    height_px: int
    excluded: Mapping[str, Mask] = field(default_factory=dict)

    @property
    def usable(self) -> Mask:
        """(H, W), True where no source excludes the pixel."""
        usable = np.ones((self.height_px, self.width_px), dtype=bool)
        for region in self.excluded.values():
            usable &= ~region
        return usable


def pixel_grid(width_px: int, height_px: int) -> Array:
    """Centres of all pixels, row by row: (H * W, 2)."""
    x, y = np.meshgrid(np.arange(width_px, dtype=np.float64), np.arange(height_px, dtype=np.float64))
    return np.stack([x.ravel(), y.ravel()], axis=1)


def beyond_lens(model: CameraModel, margin: float = np.deg2rad(1.0)) -> Mask:
    """(H, W), True where no ray of the model within `max_angle - margin` lands (margin in radians)."""
    bearings, valid = model.unproject(pixel_grid(model.width_px, model.height_px))
    valid &= np.nan_to_num(bearings[:, 2], nan=-1.0) > np.cos(min(model.max_angle - margin, np.pi))
    return np.asarray(~valid.reshape(model.height_px, model.width_px))


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
        x, y, z = up_cam.astype(np.float32)
        below = x * self._x + y * self._y + z * self._z < self._sine
        height, width = self._shape
        return np.asarray(np.repeat(np.repeat(below, 2, axis=0), 2, axis=1)[:height, :width])


def inside(usable: Mask, pixels: Array) -> Mask:
    """Which pixels (N, 2) lie on the image and where `usable` is True: (N,)."""
    height, width = usable.shape
    nearest = np.rint(np.nan_to_num(pixels, nan=-1.0)).astype(np.int64)
    x, y = nearest[:, 0], nearest[:, 1]
    on_image = (x >= 0) & (y >= 0) & (x < width) & (y < height)
    return np.asarray(on_image & usable[np.clip(y, 0, height - 1), np.clip(x, 0, width - 1)])
