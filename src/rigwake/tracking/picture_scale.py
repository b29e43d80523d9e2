"""At which scale pictures are followed: soft ones hold nothing in their finest pixels but noise.

A defocused, denoised or moving camera spreads every edge over several pixels. A patch of a sharp picture's size then
holds a single blob, and its registration is slow and uncertain; the same patch on the picture at half its size holds
the same texture as any sharp picture does.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from rigwake._robust import robust_std
from rigwake._types import Array, Image, Mask
from rigwake.cameras.protocol import CameraModel
from rigwake.recording import CameraStream
from rigwake.tracking.features import detect_corners

MOST_OCTAVES = 2
_SOFT = 1.7  # sharp pictures show 0.8 to 1.5; 4 is the limit of a blur that is much wider than a pixel
_LEAST_SIZE_PX = 200  # the shorter side is not reduced below
_LOOKED_AT = 5  # frames of a stream
_CORNERS = 150
_LAPLACIAN = np.outer([1, -2, 1], [1, -2, 1]).astype(np.float32)
_SLOPE_POWER = 2 * 12 / 64  # of Sobel's slopes / 8, along both axes, per variance of independent noise


class ScaledRays(Protocol):
    """What tracking needs of a lens: which pixel sees which ray (see `cameras.base.CameraModel`)."""

    def project(self, points_cam: Array) -> tuple[Array, Mask]:
        """Pixels (N, 2) and validity (N,) of points (N, 3)."""

    def unproject(self, pixels: Array) -> tuple[Array, Mask]:
        """Unit bearings (N, 3) and validity (N,) of pixels (N, 2)."""


@dataclass(frozen=True)
class ReducedRays:
    """A lens as seen on pictures of 1 / `factor` of their size (`reduced`): pixel p there is pixel `factor` p here."""

    model: CameraModel
    factor: int

    def project(self, points_cam: Array) -> tuple[Array, Mask]:
        """As the model's, in pixels of the reduced picture."""
        pixels, valid = self.model.project(points_cam)
        return pixels / self.factor, valid

    def unproject(self, pixels: Array) -> tuple[Array, Mask]:
        """As the model's, of pixels of the reduced picture."""
        return self.model.unproject(pixels * self.factor)


def reduced(image: Image, octaves: int) -> Image:
    """The picture halved so many times, smoothed before (5-tap binomial); its first pixel stays its first pixel."""
    for _ in range(octaves):
        image = np.asarray(cv2.pyrDown(image), dtype=np.uint8)
    return image


def softness(image: Image) -> float:
    """By how much the mean squared slope per pixel grows, about the strongest corners, if the picture is halved.

    0.5 for independent texture in every pixel, about 1 for sharp pictures of the world, 4 where every edge is spread
    over many pixels. Corners are looked for on the halved picture, and what noise adds to slopes is taken off. NaN if
    hardly any corners stand out of the noise.
    """
    half = reduced(image, 1)
    noise, noise_of_half = noise_std(image), noise_std(half)
    corners = detect_corners(
        half,
        np.ones(half.shape, dtype=np.bool_),
        np.empty((0, 2)),
        wanted=_CORNERS,
        cell_px=40,
        min_distance_px=6,
        min_strength=100 * max(noise_of_half, 1.5) ** 2,
    )
    if len(corners) < 10:
        return float("nan")
    x, y = corners.astype(np.int64).T
    fine = _slope_power(image, 17, noise)[2 * y, 2 * x]
    coarse = _slope_power(half, 9, min(noise_of_half, noise / 2))[y, x]
    return float(np.median(coarse / np.maximum(fine, 1e-3)))


def noise_std(image: Image) -> float:
    """Standard deviation of independent noise in an image, grey levels, by the median of what a doubled second
    difference leaves of it (Immerkaer 1996); fine texture adds to it where it covers most of the picture."""
    left = cv2.filter2D(image.astype(np.float32), -1, _LAPLACIAN)[1:-1, 1:-1]
    return robust_std(left) / 6 if left.size else 0.0


def _slope_power(image: Image, window_px: int, noise: float) -> NDArray[np.float32]:
    values = image.astype(np.float32)
    by_x, by_y = cv2.Sobel(values, -1, 1, 0) / 8, cv2.Sobel(values, -1, 0, 1) / 8
    power = cv2.boxFilter(by_x * by_x + by_y * by_y, -1, (window_px, window_px))
    return np.asarray(power - np.float32(_SLOPE_POWER * noise**2))


def octaves_to_skip(stream: CameraStream, chosen: NDArray[np.int64]) -> int:
    """How many times to halve the pictures of a stream: as long as most of a few of them are soft.

    chosen: (N,) indices of the frames that will be followed.
    """
    looked_at = np.unique(np.linspace(0, max(len(chosen) - 1, 0), _LOOKED_AT).astype(np.int64))
    images = [frame.image for frame in stream.frames(chosen[looked_at])] if len(chosen) else []
    for octaves in range(MOST_OCTAVES):
        if not images or min(images[0].shape) < 2 * _LEAST_SIZE_PX:
            return octaves
        known = [value for value in map(softness, images) if np.isfinite(value)]
        if not known or np.median(known) < _SOFT:
            return octaves
        images = [reduced(image, 1) for image in images]
    return MOST_OCTAVES
