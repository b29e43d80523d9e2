"""Which pixels of a camera can hold static scene points: masks by named source."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from rigwake.cameras.base import CameraModel, Mask


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


def pixel_grid(width_px: int, height_px: int) -> np.ndarray:
    """Centres of all pixels, row by row: (H * W, 2)."""
    x, y = np.meshgrid(np.arange(width_px, dtype=np.float64), np.arange(height_px, dtype=np.float64))
    return np.stack([x.ravel(), y.ravel()], axis=1)


def beyond_lens(model: CameraModel, margin: float = np.deg2rad(1.0)) -> Mask:
    """(H, W), True where no ray of the model within `max_angle - margin` lands (margin in radians)."""
    bearings, valid = model.unproject(pixel_grid(model.width_px, model.height_px))
    valid &= np.nan_to_num(bearings[:, 2], nan=-1.0) > np.cos(min(model.max_angle - margin, np.pi))
    return ~valid.reshape(model.height_px, model.width_px)
