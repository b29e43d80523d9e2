"""Corners followed by pyramidal Lucas-Kanade and registered against the patch they were first seen with."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from rigwake._tables import join_rows, take_rows
from rigwake._types import Array, Image, Mask
from rigwake.cameras.protocol import CameraModel
from rigwake.tracking.features import detect_corners
from rigwake.tracking.gates import StreamQuality, believed, gate_ratios, largest_std_px
from rigwake.tracking.interpolation import Coefficients, spline_coefficients
from rigwake.tracking.klt import Pyramid, follow, pyramid
from rigwake.tracking.masks import inside
from rigwake.tracking.picture_scale import ReducedRays, reduced
from rigwake.tracking.references import PatchShape, References, make_references, registration_bias
from rigwake.tracking.registration import Registration, register
from rigwake.tracking.tracking_options import TrackingOptions
from rigwake.tracking.warps import dominant_rotation, rotation_warps, stencil_bearings

Observed = tuple[NDArray[np.int64], Array, Array]
"""Track ids (N,), pixels (N, 2), std_px (N,) seen in one frame."""

_RENEWED = 2.5
"""By how much a position is worse than predicted whose patch does not fit one frame later: the misfit has begun to
draw it. Measured 1.6 on rendered quays and 2.4 on a wall that is run at."""


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
    anchor_std_px: Array
    warps: Array
    rotation_parts: Array
    stencils: Array
    image_from_reference: Array
    references: References
    ages: NDArray[np.int64]
    gate_ratios: Array

    def take(self, index: Mask | NDArray[np.int64]) -> _Live:
        return take_rows(self, index)

    def join(self, other: _Live) -> _Live:
        return join_rows([self, other])


def reduced_options(options: TrackingOptions, factor: int) -> TrackingOptions:
    """The options in pixels of pictures of 1 / `factor` of their size; windows and patches keep their pixels."""
    return replace(options, cell_px=max(options.cell_px // factor, 8), max_std_px=options.max_std_px / factor)


def _count(region: Mask | None, pixels: Array) -> int:
    return 0 if region is None else int(np.count_nonzero(inside(region, pixels)))


class KltFrontEnd:
    """Follows points through consecutive images of one camera."""

    def __init__(self, model: CameraModel, options: TrackingOptions, octaves: int = 0) -> None:
        self.factor = 2**octaves
        self.rays = ReducedRays(model, self.factor)
        self.options = reduced_options(options, self.factor)
        self.octaves = octaves
        self.shape = PatchShape.disc(options.patch_radius_px)
        self.shown = StreamQuality()
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
        image = reduced(image, self.octaves)
        scales = pyramid(image, options.window_px, options.levels)
        return PreparedImage(image, spline_coefficients(image), scales)

    def step(self, now: PreparedImage, usable: Mask, high: Mask | None = None) -> Observed:
        """Observations in the next image; `usable` (H, W) says where points may be, `high` where most is sky."""
        step = self.factor
        usable, high = usable[::step, ::step], None if high is None else high[::step, ::step]
        live = self._continue(now, usable)
        self.steps_since_detection += 1
        if live is None or self._should_detect(len(live.ids)):
            live = self._detect(now, usable, high, live)
            self.count_detected, self.steps_since_detection = len(live.ids), 0
        self.live, self.last = live, now
        return live.ids, live.pixels * step, live.std_px * step

    def _should_detect(self, count: int) -> bool:
        """Many points were lost since the last detection, or it is long ago and there is room for more."""
        options = self.options
        below = options.redetect_below + (1 - options.redetect_below) * 0.7 * self.shown.haste
        many_lost = count < below * min(self.count_detected, options.max_features)
        due = self.steps_since_detection >= options.redetect_every
        return many_lost or (due and count < options.redetect_below * options.max_features)

    def _continue(self, now: PreparedImage, usable: Mask) -> _Live | None:
        """The live points that are found in the image."""
        live, options = self.live, self.options
        if live is None or self.last is None or len(live.ids) == 0:
            return None
        predicted, followed = follow(
            self.last.scales,
            now.scales,
            live.pixels,
            live.pixels,
            window_px=options.window_px,
            max_forward_backward_px=options.max_forward_backward_px,
        )
        bearings, valid = self.rays.unproject(predicted)
        kept = followed & valid
        if not kept.any():
            return None
        live, predicted, bearings = live.take(kept), predicted[kept], bearings[kept]
        turn = dominant_rotation(live.bearings, bearings)
        found, seen, good = self._register(now, live, predicted, bearings, turn)
        if seen.found.any():
            self.noise = float(np.median(seen.noise[seen.found]))
        fresh = seen.found & (live.ages == 0)
        self.shown = self.shown.with_residuals(seen.noise[fresh] ** 2, seen.std_px[fresh])
        good &= believed(seen, self.shown, options)
        found = replace(found, gate_ratios=gate_ratios(seen, self.shown, options))
        self.shown = self.shown.with_losses(~good[live.ages > 0])
        # only a position that was still good is handed on, the better the longer patches serve
        lost = ~good & (live.ages > 0) & (live.gate_ratios < self.shown.haste)
        found = found.take(good)
        if lost.any():
            renewed, textured = self._renewed(self.last, live.take(lost))
            predicted, bearings = predicted[lost][textured], bearings[lost][textured]
            again, seen, good = self._register(now, renewed, predicted, bearings, turn)
            again = replace(again, gate_ratios=gate_ratios(seen, self.shown, options))
            again = again.take(good & believed(seen, self.shown, options))
            found = found.join(again)
            found = found.take(np.argsort(found.ids))
        limit = 3 * largest_std_px(self.shown, options)  # of what renewed patches have added up
        return found.take(inside(usable, found.pixels) & (found.std_px <= limit))

    def _renewed(self, last: PreparedImage, live: _Live) -> tuple[_Live, Mask]:
        """The points with the last image's patch about them as reference, those (N,) of them that have texture."""
        references, textured = make_references(last.coefficients, live.pixels, self.shape)
        stencils, valid = stencil_bearings(self.rays, live.pixels)
        n, textured = len(live.ids), textured & valid
        same = np.broadcast_to(np.eye(2), (n, 2, 2))
        of_last_patch = np.sqrt(np.maximum(live.std_px**2 - live.anchor_std_px**2, 0.0))
        renewed = replace(
            live,
            anchor_std_px=np.hypot(live.anchor_std_px, _RENEWED * of_last_patch),
            warps=same,
            rotation_parts=same,
            stencils=stencils,
            image_from_reference=np.broadcast_to(np.eye(3), (n, 3, 3)),
            references=references,
            ages=np.zeros(n, np.int64),
        )
        return renewed.take(textured), textured

    def _register(
        self, now: PreparedImage, live: _Live, predicted: Array, bearings: Array, turn: Array
    ) -> tuple[_Live, Registration, Mask]:
        """The points as found in the image near `predicted` (N, 2), how well, and which of them (N,) the lens shows.

        bearings: (N, 3) of `predicted`. turn: of the camera since the last image.
        """
        turned = turn @ live.image_from_reference
        rotation_parts, second_order, valid = rotation_warps(self.rays, live.stencils, turned, bearings)
        seen = register(
            now.coefficients,
            live.references,
            self.shape,
            predicted,
            # what the turn does not explain (approach, slant) is expected to stay as it was
            rotation_parts @ np.linalg.solve(live.rotation_parts, live.warps),
            warp_prior_std=self.options.warp_prior_std,
            noise_variance=self.shown.variance,
        )
        pixels = seen.pixels - registration_bias(live.references, seen.warps, second_order)
        bearings, on_lens = self.rays.unproject(pixels)
        found = replace(
            live,
            pixels=pixels,
            bearings=bearings,
            std_px=np.hypot(live.anchor_std_px, seen.std_px),
            warps=seen.warps,
            rotation_parts=rotation_parts,
            image_from_reference=turned,
            ages=live.ages + 1,
        )
        return found, seen, valid & on_lens

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
            min_strength=(self.noise / largest_std_px(self.shown, options)) ** 2,
            last=high,
            wanted_last=round(options.max_high_fraction * options.max_features) - _count(high, occupied),
        )
        stencils, valid = stencil_bearings(self.rays, corners)
        bearings, on_lens = self.rays.unproject(corners)
        references, textured = make_references(now.coefficients, corners, self.shape)
        n = len(corners)
        same = np.broadcast_to(np.eye(2), (n, 2, 2))
        new = _Live(
            np.arange(self.next_id, self.next_id + n),
            corners,
            bearings,
            self.noise * references.std_per_noise(),
            np.zeros(n),
            same,
            same,
            stencils,
            np.broadcast_to(np.eye(3), (n, 3, 3)),
            references,
            np.zeros(n, np.int64),
            np.zeros(n),
        ).take(valid & on_lens & textured)
        self.next_id += n
        return new if live is None else live.join(new)
