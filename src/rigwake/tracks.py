"""The `Tracks` value: observations of the same points over time in one camera."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rigwake.errors import InputError
from rigwake.geometry.so3 import Array

Indices = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Tracks:
    """Feature observations of one camera, sorted by frame, then by track.

    camera: its name. timestamps_ns: (F,) camera clock, one per processed frame.
    frame_indices: (M,) row of `timestamps_ns` of each observation. track_ids: (M,) which point it is.
    pixels: (M, 2). bearings_cam: (M, 3) unit vectors. std_px: (M,) predicted standard deviation of a pixel
    coordinate. An observation appears at most once per (frame, track).
    """

    camera: str
    timestamps_ns: Indices
    frame_indices: Indices
    track_ids: Indices
    pixels: Array
    bearings_cam: Array
    std_px: Array

    def __post_init__(self) -> None:
        m = len(self.frame_indices)
        shapes = (self.track_ids.shape, self.pixels.shape, self.bearings_cam.shape, self.std_px.shape)
        if shapes != ((m,), (m, 2), (m, 3), (m,)):
            raise InputError(f"tracks of {self.camera}: arrays disagree in length: {shapes}")
        if m and (self.frame_indices.min() < 0 or self.frame_indices.max() >= len(self.timestamps_ns)):
            raise InputError(f"tracks of {self.camera}: frame index out of range")

    def __len__(self) -> int:
        return len(self.frame_indices)

    def take(self, index: Indices | NDArray[np.bool_]) -> Tracks:
        """The chosen observations."""
        return Tracks(
            self.camera,
            self.timestamps_ns,
            self.frame_indices[index],
            self.track_ids[index],
            self.pixels[index],
            self.bearings_cam[index],
            self.std_px[index],
        )
