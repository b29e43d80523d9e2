"""Landmarks across cameras and time: what one camera tracked, found again by another, or by itself after a turn.

Once a first solution says where to look (`search_proposals.py`), each patch is looked for and registered there. What
agrees
becomes an observation of the same landmark: cameras without common view are then tied by the world itself, which is
what fixes vertical offsets on calm water.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import fields

import numpy as np

from rigwake._types import Array, Indices
from rigwake.ba.rig.search_proposals import AssociationOptions, Searches
from rigwake.ba.solver.rig_problem import Observations
from rigwake.parallel import over_ranges
from rigwake.recording import CameraStream
from rigwake.tracking.interpolation import Coefficients, spline_coefficients
from rigwake.tracking.references import PatchShape, References, make_references, registration_bias
from rigwake.tracking.registration import register

_REACH_PX = 2.5  # what one registration can bridge


def find_landmarks(
    names: Sequence[str],
    searches: Searches,
    streams: Mapping[str, CameraStream],
    options: AssociationOptions,
) -> Observations:
    """Carry out the searches; what agrees, as observations of the landmarks searched for.

    names: of the cameras that the searches count.

    Two passes over the images, one at a time: patches are cut out of the sources, then looked for.
    """
    shape = PatchShape.disc(options.patch_radius_px)
    references, cut = _cut_patches(names, searches, streams, shape)
    searches = searches.take(cut)
    pixels = np.full((len(searches), 2), np.nan)
    std_px = np.full(len(searches), np.nan)

    def look(camera: int, stream: CameraStream) -> None:
        rows = np.flatnonzero(searches.cameras == camera)
        for coefficients, here in _images(stream, searches.stamps[rows]):
            wanted = np.zeros(len(searches), dtype=bool)
            wanted[rows[here]] = True
            own, patches = searches.take(wanted), references.take(wanted)
            pixels[wanted], std_px[wanted] = _look_around(coefficients, patches, shape, own, options)
            pixels[wanted] -= registration_bias(patches, own.warps, own.second_order)

    _each_camera(names, streams, look)
    agreed = np.flatnonzero(np.isfinite(std_px))
    return Observations(
        searches.cameras[agreed],
        searches.stamps[agreed],
        searches.landmarks[agreed],
        pixels[agreed],
        np.hypot(std_px[agreed], searches.source_std_px[agreed]),
    )


def _cut_patches(
    names: Sequence[str], searches: Searches, streams: Mapping[str, CameraStream], shape: PatchShape
) -> tuple[References, Indices]:
    """Reference patches of the searches' sources, and which searches have one, in that order."""
    by_camera: dict[int, list[tuple[References, Indices]]] = {}

    def cut_out(camera: int, stream: CameraStream) -> None:
        rows = np.flatnonzero(searches.source_cameras == camera)
        own = by_camera.setdefault(camera, [])
        for coefficients, here in _images(stream, searches.source_stamps[rows]):
            at = rows[here]
            made, good = make_references(coefficients, searches.source_pixels[at], shape)
            own.append((made.take(good), at[good]))

    _each_camera(names, streams, cut_out)
    pieces = [piece for camera in sorted(by_camera) for piece in by_camera[camera]]
    parts, cut = [part for part, _ in pieces], [rows for _, rows in pieces]
    if not parts:
        return make_references(np.zeros((16, 16), np.float32), np.empty((0, 2)), shape)[0], np.empty(
            0, np.int64
        )
    joined = References(*(np.concatenate([getattr(p, f.name) for p in parts]) for f in fields(References)))
    return joined, np.concatenate(cut)


def _each_camera(
    names: Sequence[str], streams: Mapping[str, CameraStream], work: Callable[[int, CameraStream], None]
) -> None:
    """Cameras side by side: decoding and registration leave the interpreter to the other threads."""

    def one(first: int, last: int) -> None:
        for camera in range(first, last):
            work(camera, streams[names[camera]])

    over_ranges(np.arange(len(names) + 1), one)


def _images(stream: CameraStream, stamps: Indices) -> Iterator[tuple[Coefficients, Indices]]:
    """Spline coefficients of each image that is wanted, with the rows that want it."""
    if not len(stamps):
        return
    wanted, inverse = np.unique(stamps, return_inverse=True)
    index = np.searchsorted(stream.timestamps_ns, wanted)
    for frame in stream.frames(index):
        row = int(np.searchsorted(index, frame.index))
        yield spline_coefficients(frame.image), np.flatnonzero(inverse == row)


def _look_around(
    coefficients: Coefficients,
    references: References,
    shape: PatchShape,
    searches: Searches,
    options: AssociationOptions,
) -> tuple[Array, Array]:
    """The match of each patch nearest to its prediction: pixels (n, 2) and std_px (n,), NaN where there is none.

    The search starts at the prediction, then from rings around it for those not found yet.
    """
    steps = np.arange(-_rings(options), _rings(options) + 1)
    shifts = _REACH_PX * np.stack(np.meshgrid(steps, steps), axis=-1).reshape(-1, 2)
    shifts = shifts[np.argsort(np.linalg.norm(shifts, axis=1), kind="stable")]
    n, starts = len(searches), len(shifts)
    # all at once: a call for every ring would cost more than the registrations
    each = np.repeat(np.arange(n), starts)
    match = register(
        coefficients,
        references.take(each),
        shape,
        searches.pixels[each] + np.tile(shifts, (n, 1)),
        searches.warps[each],
        warp_prior_std=options.warp_prior_std,
        max_shift_px=_REACH_PX,
    )
    good = match.found & (match.correlation >= options.min_correlation)
    good &= match.std_px < options.max_std_px
    good &= np.linalg.norm(match.pixels - searches.pixels[each], axis=1) <= options.search_px
    good = good.reshape(n, starts)
    first = np.arange(n) * starts + good.argmax(axis=1)
    agreed = np.asarray(good.any(axis=1))
    pixels = np.where(agreed[:, None], match.pixels[first], np.nan)
    return pixels, np.where(agreed, match.std_px[first], np.nan)


def _rings(options: AssociationOptions) -> int:
    return max(int(np.ceil(options.search_px / _REACH_PX - 0.5)), 0)
