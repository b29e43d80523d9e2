"""Landmarks across cameras and time: what one camera tracked, found again by another, or by itself after a turn.

Once a first solution says where to look, each landmark is predicted into the images of every camera that may
see it, its patch is warped as a plane that faces its viewers would be, and registered there. What agrees becomes
an observation of the same landmark: cameras without common view are then tied by the world itself, which is what
fixes vertical offsets on calm water.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, fields, replace

import numpy as np
from numpy.typing import NDArray

from rigwake.bundle.problem import Observations, RigProblem, RigSolution
from rigwake.cameras.base import Mask
from rigwake.errors import UsageError
from rigwake.geometry.interpolate import interpolate
from rigwake.geometry.se3 import SE3
from rigwake.geometry.so3 import Array
from rigwake.recording import CameraStream
from rigwake.tracking.interpolation import Coefficients, spline_coefficients
from rigwake.tracking.masks import CameraMask, beyond_lens, inside
from rigwake.tracking.registration import PatchShape, References, make_references, register
from rigwake.tracking.warps import stencil_bearings

Indices = NDArray[np.int64]
_REACH_PX = 2.5  # what one registration can bridge


@dataclass(frozen=True)
class HandOverOptions:
    """Options of the search for landmarks in other images.

    rounds: of looking and adjusting. views_per_camera: most images of one camera in which a landmark is looked
        for, spread over the time that it may be seen. max_searches: most in all.
    search_px: how far from its prediction a landmark may be.
    max_view_angle_deg, max_stretch: how differently two images may see a patch. min_gap_s: a camera looks again
        for its own landmarks only after so long. min_correlation: with the source's patch.
    """

    rounds: int = 2
    views_per_camera: int = 4
    max_searches: int = 8000
    search_px: float = 3.5
    max_view_angle_deg: float = 30.0
    max_stretch: float = 1.7
    min_gap_s: float = 4.0
    min_correlation: float = 0.93
    max_std_px: float = 0.3
    patch_radius_px: int = 8
    warp_prior_std: float = 0.1

    def __post_init__(self) -> None:
        if self.patch_radius_px < 3 or self.views_per_camera < 1 or self.max_searches < 1:
            raise UsageError("hand-over options: patches of at least 3 px, at least one view and one search.")


@dataclass(frozen=True, eq=False)
class Searches:
    """Where to look for what: S rows.

    landmarks: (S,). source_cameras, source_stamps, source_pixels, source_std_px: the observation whose patch is
    looked for. cameras, stamps: the image to look in. pixels: (S, 2) prediction. warps: (S, 2, 2) predicted
    `d pixel / d source pixel`.
    """

    landmarks: Indices
    source_cameras: Indices
    source_stamps: Indices
    source_pixels: Array
    source_std_px: Array
    cameras: Indices
    stamps: Indices
    pixels: Array
    warps: Array

    def __len__(self) -> int:
        return len(self.landmarks)

    def take(self, index: Indices | Mask) -> Searches:
        """The chosen searches."""
        return Searches(*(getattr(self, name)[index] for name in self.__dataclass_fields__))


def camera_from_world(problem: RigProblem, camera: int, stamps: Indices) -> SE3:
    """Where a camera was at stamps of its own clock, between the states: (n,) `cam_from_world`."""
    states, seen_by = problem.states, problem.cameras[camera]
    at = np.clip(
        stamps + round(seen_by.time_offset_s * 1e9), states.timestamps_ns[0], states.timestamps_ns[-1]
    )
    world_from_rig = interpolate(states.timestamps_ns, states.world_from_rig, at)
    return (world_from_rig * seen_by.rig_from_cam).inverse()


def predicted_pixels(problem: RigProblem, observations: Observations) -> Array:
    """(M, 2) where the problem's values put the landmarks of observations; NaN outside the lens."""
    points = problem.landmarks.points_world[observations.landmark_indices]
    pixels = np.full((len(observations), 2), np.nan)
    for index, camera in enumerate(problem.cameras):
        rows = np.flatnonzero(observations.camera_indices == index)
        if len(rows):
            cam_from_world = camera_from_world(problem, index, observations.timestamps_ns[rows])
            pixels[rows], _ = camera.model.project(cam_from_world * points[rows])
    return pixels


def propose_searches(
    solution: RigSolution,
    stamps: Mapping[str, Indices],
    masks: Mapping[str, CameraMask],
    options: HandOverOptions,
) -> Searches:
    """Which landmark to look for in which image, by the current solution.

    stamps: per camera, the images that may be searched (its own clock).
    """
    problem = solution.problem
    best = _best_source(problem)
    parts = [
        _visible(problem, index, stamps[camera.name], masks.get(camera.name), best, options)
        for index, camera in enumerate(problem.cameras)
        if len(stamps[camera.name])
    ]
    landmarks = np.concatenate([part[0] for part in parts])
    cameras = np.concatenate([part[1] for part in parts])
    found_stamps = np.concatenate([part[2] for part in parts])
    pixels = np.concatenate([part[3] for part in parts])
    if len(landmarks) > options.max_searches:
        # whole landmarks are kept or left, evenly over all of them
        rank = np.random.default_rng(0).permutation(len(problem.landmarks))[landmarks]
        kept = np.sort(np.argsort(rank, kind="stable")[: options.max_searches])
        landmarks, cameras, found_stamps, pixels = (
            landmarks[kept],
            cameras[kept],
            found_stamps[kept],
            pixels[kept],
        )
    source = best[landmarks]
    seen = problem.observations
    searches = Searches(
        landmarks,
        seen.camera_indices[source],
        seen.timestamps_ns[source],
        seen.pixels[source],
        seen.std_px[source],
        cameras,
        found_stamps,
        pixels,
        np.tile(np.eye(2), (len(landmarks), 1, 1)),
    )
    return _with_warps(problem, searches, options)


def _best_source(problem: RigProblem) -> Indices:
    """(L,) the observation of each landmark made from nearest, where its patch is largest."""
    seen = problem.observations
    ranges = np.empty(len(seen))
    points = problem.landmarks.points_world
    for index in range(len(problem.cameras)):
        rows = np.flatnonzero(seen.camera_indices == index)
        if len(rows):
            cam_from_world = camera_from_world(problem, index, seen.timestamps_ns[rows])
            ranges[rows] = np.linalg.norm(cam_from_world * points[seen.landmark_indices[rows]], axis=1)
    order = np.lexsort((ranges, seen.landmark_indices))
    first = np.searchsorted(seen.landmark_indices[order], np.arange(len(problem.landmarks)))
    return np.asarray(order[first])


def _visible(
    problem: RigProblem,
    camera: int,
    stamps: Indices,
    mask: CameraMask | None,
    best: Indices,
    options: HandOverOptions,
) -> tuple[Indices, Indices, Indices, Array]:
    """Landmarks, camera, stamps and predicted pixels of the images of one camera that may see a landmark."""
    seen = problem.observations
    model = problem.cameras[camera].model
    usable = ~beyond_lens(model) if mask is None else mask.usable & ~beyond_lens(model)
    points = problem.landmarks.points_world
    cam_from_world = camera_from_world(problem, camera, stamps)
    near = problem.landmarks.inverse_ranges > 1e-3
    source_centre = np.empty((len(best), 3))
    for index in range(len(problem.cameras)):
        rows = np.flatnonzero(seen.camera_indices[best] == index)
        inverse = camera_from_world(problem, index, seen.timestamps_ns[best[rows]]).inverse()
        source_centre[rows] = inverse.translation
    to_source = source_centre - points
    source_range = np.linalg.norm(to_source, axis=1)
    columns: list[tuple[Indices, Indices, Array]] = []
    margin = options.patch_radius_px + options.search_px
    for row in range(len(stamps)):
        points_cam = cam_from_world[row] * points
        pixels, valid = model.project(points_cam)
        distance = np.linalg.norm(points_cam, axis=1)
        centre = cam_from_world[row].inverse().translation
        cosine = np.einsum("ni,ni->n", centre - points, to_source) / np.maximum(
            distance * source_range, 1e-12
        )
        stretch = distance / np.maximum(source_range, 1e-12)
        valid = (
            valid & near & inside(usable, pixels) & (cosine > np.cos(np.deg2rad(options.max_view_angle_deg)))
        )
        valid &= (stretch < options.max_stretch) & (stretch > 1 / options.max_stretch)
        finite = np.nan_to_num(pixels, nan=-1.0)
        valid &= (finite > margin).all(axis=1) & (
            finite < np.array([model.width_px, model.height_px]) - 1 - margin
        ).all(axis=1)
        rows = np.flatnonzero(valid)
        columns.append((rows, np.full(len(rows), row), pixels[rows]))
    landmarks = np.concatenate([c[0] for c in columns])
    image = np.concatenate([c[1] for c in columns])
    pixels = np.concatenate([c[2] for c in columns])
    fresh = _not_seen_lately(problem, camera, landmarks, stamps[image], options)
    chosen = fresh[_spread(landmarks[fresh], image[fresh], options.views_per_camera)]
    return landmarks[chosen], np.full(len(chosen), camera), stamps[image[chosen]], pixels[chosen]


def _not_seen_lately(
    problem: RigProblem, camera: int, landmarks: Indices, stamps: Indices, options: HandOverOptions
) -> Indices:
    """Rows whose landmark this camera has not observed within `min_gap_s` of the stamp."""
    seen = problem.observations
    own = seen.camera_indices == camera
    first = np.full(len(problem.landmarks), np.iinfo(np.int64).max)
    last = np.full(len(problem.landmarks), np.iinfo(np.int64).min)
    np.minimum.at(first, seen.landmark_indices[own], seen.timestamps_ns[own])
    np.maximum.at(last, seen.landmark_indices[own], seen.timestamps_ns[own])
    gap = int(options.min_gap_s * 1e9)
    never = last[landmarks] == np.iinfo(np.int64).min
    before = stamps < np.where(never, 0, first[landmarks]) - gap
    after = stamps > np.where(never, 0, last[landmarks]) + gap
    return np.flatnonzero(never | before | after)


def _spread(landmarks: Indices, image: Indices, most: int) -> Indices:
    """Rows of at most `most` images per landmark, evenly over those that may see it."""
    order = np.lexsort((image, landmarks))
    starts = np.flatnonzero(np.diff(landmarks[order], prepend=-1))
    counts = np.diff(np.append(starts, len(order)))
    place = np.arange(len(order)) - np.repeat(starts, counts)
    total = np.repeat(counts, counts)
    # the middle of each of `most` equal parts
    step = np.maximum(total / most, 1.0)
    part = np.floor(place / step)
    middle = np.floor((part + 0.5) * step)
    return np.sort(order[(place == np.minimum(middle, total - 1)) & (part < most)])


def _with_warps(problem: RigProblem, searches: Searches, options: HandOverOptions) -> Searches:
    """Warps of patches that lie in the plane through the landmark facing halfway between both viewers."""
    points = problem.landmarks.points_world[searches.landmarks]
    warps, good = np.empty((len(searches), 2, 2)), np.zeros(len(searches), dtype=bool)
    for source in range(len(problem.cameras)):
        for target in range(len(problem.cameras)):
            rows = np.flatnonzero((searches.source_cameras == source) & (searches.cameras == target))
            if not len(rows):
                continue
            world_from_source = camera_from_world(problem, source, searches.source_stamps[rows]).inverse()
            target_from_world = camera_from_world(problem, target, searches.stamps[rows])
            stencil, valid = stencil_bearings(problem.cameras[source].model, searches.source_pixels[rows])
            rays = np.einsum("nij,nkj->nki", world_from_source.rotation, stencil)
            to_source = _unit(world_from_source.translation - points[rows])
            to_target = _unit(target_from_world.inverse().translation - points[rows])
            normal = _unit(to_source + to_target)
            depth = np.einsum("ni,ni->n", normal, points[rows] - world_from_source.translation)
            slope = np.einsum("ni,nki->nk", normal, rays)
            corners = world_from_source.translation[:, None] + rays * (depth[:, None] / slope)[:, :, None]
            corners_cam = (
                np.einsum("nij,nkj->nki", target_from_world.rotation, corners)
                + target_from_world.translation[:, None]
            )
            pixels, seen = problem.cameras[target].model.project(corners_cam.reshape(-1, 3))
            right, left, below, above = pixels.reshape(-1, 4, 2).transpose(1, 0, 2)
            warps[rows] = np.stack([right - left, below - above], axis=2) / 4.0
            good[rows] = valid & seen.reshape(-1, 4).all(axis=1)
    stretch = np.sqrt(np.abs(np.linalg.det(np.where(good[:, None, None], warps, np.eye(2)))))
    good &= (stretch < options.max_stretch) & (stretch > 1 / options.max_stretch)
    return replace(searches, warps=warps).take(np.flatnonzero(good))


def _unit(vectors: Array) -> Array:
    return np.asarray(vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-12))


def find_landmarks(
    problem: RigProblem, searches: Searches, streams: Mapping[str, CameraStream], options: HandOverOptions
) -> Observations:
    """Carry out the searches; what agrees, as observations of the landmarks searched for.

    Two passes over the images, one at a time: patches are cut out of the sources, then looked for.
    """
    shape = PatchShape.disc(options.patch_radius_px)
    references, cut = _cut_patches(problem, searches, streams, shape)
    searches = searches.take(cut)
    pixels = np.full((len(searches), 2), np.nan)
    std_px = np.full(len(searches), np.nan)

    def look(camera: int, name: str) -> None:
        rows = np.flatnonzero(searches.cameras == camera)
        for coefficients, here in _images(streams[name], searches.stamps[rows]):
            wanted = np.zeros(len(searches), dtype=bool)
            wanted[rows[here]] = True
            pixels[wanted], std_px[wanted] = _look_around(
                coefficients, references.take(wanted), shape, searches.take(wanted), options
            )

    _each_camera(problem, look)
    agreed = np.flatnonzero(np.isfinite(std_px))
    return Observations(
        searches.cameras[agreed],
        searches.stamps[agreed],
        searches.landmarks[agreed],
        pixels[agreed],
        np.hypot(std_px[agreed], searches.source_std_px[agreed]),
    )


def _cut_patches(
    problem: RigProblem, searches: Searches, streams: Mapping[str, CameraStream], shape: PatchShape
) -> tuple[References, Indices]:
    """Reference patches of the searches' sources, and which searches have one, in that order."""
    by_camera: dict[int, list[tuple[References, Indices]]] = {}

    def cut_out(camera: int, name: str) -> None:
        rows = np.flatnonzero(searches.source_cameras == camera)
        own = by_camera.setdefault(camera, [])
        for coefficients, here in _images(streams[name], searches.source_stamps[rows]):
            at = rows[here]
            made, good = make_references(coefficients, searches.source_pixels[at], shape)
            own.append((made.take(good), at[good]))

    _each_camera(problem, cut_out)
    pieces = [piece for camera in sorted(by_camera) for piece in by_camera[camera]]
    parts, cut = [part for part, _ in pieces], [rows for _, rows in pieces]
    if not parts:
        return make_references(np.zeros((16, 16), np.float32), np.empty((0, 2)), shape)[0], np.empty(
            0, np.int64
        )
    joined = References(*(np.concatenate([getattr(p, f.name) for p in parts]) for f in fields(References)))
    return joined, np.concatenate(cut)


def _each_camera(problem: RigProblem, work: Callable[[int, str], None]) -> None:
    """Cameras side by side: decoding and registration leave the interpreter to the other threads."""
    names = [camera.name for camera in problem.cameras]
    with ThreadPoolExecutor(min(os.cpu_count() or 1, len(names))) as pool:
        list(pool.map(work, range(len(names)), names))


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
    options: HandOverOptions,
) -> tuple[Array, Array]:
    """The match of each patch nearest to its prediction: pixels (n, 2) and std_px (n,), NaN where there is none.

    The search starts at the prediction, then from rings around it for those not found yet.
    """
    n = len(searches)
    pixels, std_px = np.full((n, 2), np.nan), np.full(n, np.nan)
    steps = np.arange(-_rings(options), _rings(options) + 1)
    starts = _REACH_PX * np.stack(np.meshgrid(steps, steps), axis=-1).reshape(-1, 2)
    for shift in starts[np.argsort(np.linalg.norm(starts, axis=1), kind="stable")]:
        open_rows = np.isnan(std_px)
        if not open_rows.any():
            break
        predicted = searches.pixels[open_rows]
        match = register(
            coefficients,
            references.take(open_rows),
            shape,
            predicted + shift,
            searches.warps[open_rows],
            warp_prior_std=options.warp_prior_std,
            max_shift_px=_REACH_PX,
        )
        good = match.found & (match.correlation >= options.min_correlation)
        good &= match.std_px < options.max_std_px
        good &= np.linalg.norm(match.pixels - predicted, axis=1) <= options.search_px
        rows = np.flatnonzero(open_rows)[good]
        pixels[rows], std_px[rows] = match.pixels[good], match.std_px[good]
    return pixels, std_px


def _rings(options: HandOverOptions) -> int:
    return max(int(np.ceil(options.search_px / _REACH_PX - 0.5)), 0)
