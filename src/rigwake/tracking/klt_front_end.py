"""Corners followed by pyramidal Lucas-Kanade and registered against the patch they were first seen with."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rigwake._types import Array, Image, Mask
from rigwake.cameras.protocol import CameraModel
from rigwake.tracking.features import detect_corners
from rigwake.tracking.interpolation import Coefficients, spline_coefficients
from rigwake.tracking.klt import Pyramid, follow, pyramid
from rigwake.tracking.masks import inside
from rigwake.tracking.references import PatchShape, References, make_references, registration_bias
from rigwake.tracking.registration import register
from rigwake.tracking.tracking_options import TrackingOptions
from rigwake.tracking.warps import dominant_rotation, rotation_warps, stencil_bearings

Observed = tuple[NDArray[np.int64], Array, Array]
"""Track ids (N,), pixels (N, 2), std_px (N,) seen in one frame."""


@dataclass(frozen=True, eq=False)
class PreparedImage:
    """An image, its spline coefficients, and its pyramid."""

    image: Image
    coefficients: Coefficients
    scales: Pyramid


@dataclass(frozen=True, eq=False)
class _Live:
    """The N points that are being followed.

    warps: affine, image from reference patch; of these `rotation_parts` is what the camera's rotation explains.
    stencils, image_from_reference: bearings about the reference pixel, and the camera's rotation since.
    """

    ids: NDArray[np.int64]
    pixels: Array
    bearings: Array
    std_px: Array
    warps: Array
    rotation_parts: Array
    stencils: Array
    image_from_reference: Array
    references: References

    def take(self, index: Mask) -> _Live:
        return _Live(*(_taken(getattr(self, f.name), index) for f in fields(self)))

    def join(self, other: _Live) -> _Live:
        return _Live(*(_joined(getattr(self, f.name), getattr(other, f.name)) for f in fields(self)))


def _taken(value: Any, index: Mask) -> Any:
    return value.take(index) if isinstance(value, References) else value[index]


def _joined(first: Any, second: Any) -> Any:
    return first.join(second) if isinstance(first, References) else np.concatenate([first, second])


def _count(region: Mask | None, pixels: Array) -> int:
    return 0 if region is None else int(np.count_nonzero(inside(region, pixels)))


class KltFrontEnd:
    """Follows points through consecutive images of one camera."""

    def __init__(self, model: CameraModel, options: TrackingOptions) -> None:
        self.model = model
        self.options = options
        self.shape = PatchShape.disc(options.patch_radius_px)
        self.noise = 1.5  # grey levels, until registrations tell
        self.live: _Live | None = None
        self.last: PreparedImage | None = None
        self.next_id = 0
        self.count_detected = 0
        self.steps_since_detection = 0

    def forget(self) -> None:
        """Start anew: the next image does not continue the last one."""
        self.live = self.last = None

    def prepare(self, image: Image) -> PreparedImage:
        """What does not depend on the images before: may be called ahead of `step`, on another thread."""
        options = self.options
        scales = pyramid(image, options.window_px, options.levels)
        return PreparedImage(image, spline_coefficients(image), scales)

    def step(self, now: PreparedImage, usable: Mask, high: Mask | None = None) -> Observed:
        """Observations in the next image; `usable` (H, W) says where points may be, `high` where most is sky."""
        live = self._continue(now, usable)
        self.steps_since_detection += 1
        if live is None or self._should_detect(len(live.ids)):
            live = self._detect(now, usable, high, live)
            self.count_detected, self.steps_since_detection = len(live.ids), 0
        self.live, self.last = live, now
        return live.ids, live.pixels, live.std_px

    def _should_detect(self, count: int) -> bool:
        """Many points were lost since the last detection, or it is long ago and there is room for more."""
        options = self.options
        many_lost = count < options.redetect_below * min(self.count_detected, options.max_features)
        due = self.steps_since_detection >= options.redetect_every
        return many_lost or (due and count < options.redetect_below * options.max_features)

    def _continue(self, now: PreparedImage, usable: Mask) -> _Live | None:
        """The live points that are found in the image."""
        live, options = self.live, self.options
        if live is None or self.last is None or len(live.ids) == 0:
            return None
        predicted, believed = follow(
            self.last.scales,
            now.scales,
            live.pixels,
            live.pixels,
            window_px=options.window_px,
            max_forward_backward_px=options.max_forward_backward_px,
        )
        bearings, valid = self.model.unproject(predicted)
        kept = believed & valid
        live, predicted, bearings = live.take(kept), predicted[kept], bearings[kept]
        turned = dominant_rotation(live.bearings, bearings) @ live.image_from_reference
        rotation_parts, second_order, valid = rotation_warps(self.model, live.stencils, turned, bearings)
        seen = register(
            now.coefficients,
            live.references,
            self.shape,
            predicted,
            # what the turn does not explain (approach, slant) is expected to stay as it was
            rotation_parts @ np.linalg.solve(live.rotation_parts, live.warps),
            warp_prior_std=options.warp_prior_std,
        )
        if seen.found.any():
            self.noise = float(np.median(seen.noise[seen.found]))
        pixels = seen.pixels - registration_bias(live.references, seen.warps, second_order)
        bearings, on_lens = self.model.unproject(pixels)
        stretch = np.linalg.svd(seen.warps, compute_uv=False)
        kept = valid & on_lens & seen.found & inside(usable, pixels)
        kept &= (seen.correlation >= options.min_correlation) & (seen.std_px <= options.max_std_px)
        kept &= (stretch[:, 0] <= options.max_stretch) & (stretch[:, 1] >= 1 / options.max_stretch)
        found = _Live(
            live.ids,
            pixels,
            bearings,
            seen.std_px,
            seen.warps,
            rotation_parts,
            live.stencils,
            turned,
            live.references,
        )
        return found.take(kept)

    def _detect(self, now: PreparedImage, usable: Mask, high: Mask | None, live: _Live | None) -> _Live:
        """The live points and new corners."""
        options = self.options
        occupied = np.empty((0, 2)) if live is None else live.pixels
        corners = detect_corners(
            now.image,
            usable,
            occupied,
            wanted=options.max_features - len(occupied),
            cell_px=options.cell_px,
            min_distance_px=options.min_distance_px,
            min_strength=(self.noise / options.max_std_px) ** 2,
            last=high,
            wanted_last=round(options.max_high_fraction * options.max_features) - _count(high, occupied),
        )
        stencils, valid = stencil_bearings(self.model, corners)
        bearings, on_lens = self.model.unproject(corners)
        references, textured = make_references(now.coefficients, corners, self.shape)
        n = len(corners)
        same = np.broadcast_to(np.eye(2), (n, 2, 2))
        new = _Live(
            np.arange(self.next_id, self.next_id + n),
            corners,
            bearings,
            self.noise * references.std_per_noise(),
            same,
            same,
            stencils,
            np.broadcast_to(np.eye(3), (n, 3, 3)),
            references,
        ).take(valid & on_lens & textured)
        self.next_id += n
        return new if live is None else live.join(new)
