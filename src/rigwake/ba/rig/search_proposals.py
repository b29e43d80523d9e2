"""Where to look for which landmark: predictions of landmarks into the images of every camera, by the current rig.

A landmark may show in another camera, or in the same one after a turn. Its patch is warped as a plane that faces
both viewers halfway would be. `association.py` carries the searches out.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields, replace

import numpy as np

from rigwake._tables import take_rows
from rigwake._types import Array, Indices, Mask
from rigwake.ba.solver.rig_problem import Observations, RigProblem
from rigwake.cameras.protocol import CameraModel
from rigwake.errors import UsageError
from rigwake.geometry.interpolate import interpolate
from rigwake.geometry.se3 import SE3
from rigwake.parallel import over_ranges
from rigwake.tracking.masks import inside

_STENCIL_PX = 2.0
_STENCIL = _STENCIL_PX * np.array([[x, y] for y in (-1, 0, 1) for x in (-1, 0, 1)])  # row by row
_PAIRS_AT_ONCE = 1_000_000  # of images and landmarks, to bound memory
_REACH_COLUMNS = 2700  # of the normal equations: a minute of states with an IMU
_NEAR = 1e-3  # 1 / metres: what lies further away says nothing about where cameras are


@dataclass(frozen=True)
class AssociationOptions:
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
            raise UsageError(
                "cross-camera association options: patches of at least 3 px, at least one view and one search."
            )


@dataclass(frozen=True, eq=False)
class Searches:
    """Where to look for what: S rows.

    landmarks: (S,). source_cameras, source_stamps, source_pixels, source_std_px: the observation whose patch is
    looked for. cameras, stamps: the image to look in. pixels: (S, 2) prediction. warps: (S, 2, 2) predicted
    `d pixel / d source pixel`. second_order: (S, 2, 3) its second derivatives, by xx, xy and yy.
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
    second_order: Array

    def __len__(self) -> int:
        return len(self.landmarks)

    def take(self, index: Indices | Mask) -> Searches:
        """The chosen searches."""
        return take_rows(self, index)


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
    problem: RigProblem,
    stamps: Mapping[str, Indices],
    usable: Mapping[str, Mask],
    options: AssociationOptions,
) -> Searches:
    """Which landmark to look for in which image, by the values of a problem.

    stamps: per camera, the images that may be searched (its own clock). usable: per camera, the pixels (H, W) that
    show something.
    """
    source, parts = _best_source(problem), {}

    def look(first: int, last: int) -> None:
        for camera in range(first, last):
            name = problem.cameras[camera].name
            parts[camera] = _of_camera(problem, camera, stamps[name], usable[name], source, options)

    over_ranges(np.arange(len(problem.cameras) + 1), look)
    every = [parts[camera] for camera in sorted(parts)]
    searches = Searches(*(np.concatenate([getattr(p, f.name) for p in every]) for f in fields(Searches)))
    if len(searches) > options.max_searches:
        # whole landmarks are kept or left, evenly over all of them
        rank = np.random.default_rng(0).permutation(len(problem.landmarks))[searches.landmarks]
        searches = searches.take(np.sort(np.argsort(rank, kind="stable")[: options.max_searches]))
    return with_warps(problem, searches, options)


def _best_source(problem: RigProblem) -> Indices:
    """(L,) the observation of each landmark made from nearest, where its patch is largest."""
    observations = problem.observations
    ranges = np.empty(len(observations))
    points = problem.landmarks.points_world
    for index in range(len(problem.cameras)):
        rows = np.flatnonzero(observations.camera_indices == index)
        if len(rows):
            cam_from_world = camera_from_world(problem, index, observations.timestamps_ns[rows])
            ranges[rows] = np.linalg.norm(
                cam_from_world * points[observations.landmark_indices[rows]], axis=1
            )
    order = np.lexsort((ranges, observations.landmark_indices))
    first = np.searchsorted(observations.landmark_indices[order], np.arange(len(problem.landmarks)))
    return np.asarray(order[first])


def _of_camera(
    problem: RigProblem,
    camera: int,
    stamps: Indices,
    usable: Mask,
    source: Indices,
    options: AssociationOptions,
) -> Searches:
    """Searches in the images of one camera, their warps still the identity."""
    image, landmarks, pixels = _visible(problem, camera, stamps, usable, source, options)
    fresh = _not_seen_lately(problem, camera, landmarks, stamps[image], options)
    chosen = fresh[_spread(landmarks[fresh], image[fresh], options.views_per_camera)]
    landmarks, observations = landmarks[chosen], problem.observations
    at = source[landmarks]
    return Searches(
        landmarks,
        observations.camera_indices[at],
        observations.timestamps_ns[at],
        observations.pixels[at],
        observations.std_px[at],
        np.full(len(chosen), camera),
        stamps[image[chosen]],
        pixels[chosen],
        np.tile(np.eye(2), (len(chosen), 1, 1)),
        np.zeros((len(chosen), 2, 3)),
    )


def _visible(
    problem: RigProblem,
    camera: int,
    stamps: Indices,
    usable: Mask,
    source: Indices,
    options: AssociationOptions,
) -> tuple[Indices, Indices, Array]:
    """Which images of a camera (indices into `stamps`) may see which landmarks about as their sources do, and at
    which pixels.

    A landmark is looked for within so many states of where it was first seen: what ties states that are far apart
    makes time and memory of the adjustment grow with the square of the recording's length.
    """
    model, points = problem.cameras[camera].model, problem.landmarks.points_world
    cam_from_world = camera_from_world(problem, camera, stamps)
    centres = cam_from_world.inverse().translation
    near = np.flatnonzero(problem.landmarks.inverse_ranges > _NEAR)
    sources, margin = _source_centres(problem, source), options.patch_radius_px + options.search_px
    last = np.array([model.width_px, model.height_px]) - 1 - margin
    reach = _REACH_COLUMNS // (6 if problem.imu is None else 15)
    states_of_images = np.searchsorted(problem.states.timestamps_ns, stamps)
    states_of_near = _first_states(problem)[near]
    found = [(np.empty(0, np.int64), np.empty(0, np.int64), np.empty((0, 2)))]
    step = max(_PAIRS_AT_ONCE // max(len(near), 1), 1)
    for begin in range(0, len(stamps), step):
        # distances and angles first: they leave few to project
        images = states_of_images[begin : begin + step]
        within = (states_of_near >= images.min() - reach) & (states_of_near <= images.max() + reach)
        some, states = near[within], states_of_near[within]
        alike = _seen_alike(points[some], sources[some], centres[begin : begin + step], options)
        alike &= np.abs(images[:, None] - states) <= reach
        row, which = np.nonzero(alike)
        row, landmarks = row + begin, some[which]
        rotation = cam_from_world.rotation[row]
        points_cam = np.einsum("nij,nj->ni", rotation, points[landmarks] - centres[row])
        pixels, valid = model.project(points_cam)
        valid &= inside(usable, pixels)
        valid[valid] = ((pixels[valid] > margin) & (pixels[valid] < last)).all(axis=1)
        found.append((row[valid], landmarks[valid], pixels[valid]))
    image, landmarks, pixels = (np.concatenate(part) for part in zip(*found, strict=True))
    return image, landmarks, pixels


def _first_states(problem: RigProblem) -> Indices:
    """(L,) the state at which each landmark was first seen."""
    observations, count = problem.observations, len(problem.states)
    first = np.full(len(problem.landmarks), count)
    np.minimum.at(
        first,
        observations.landmark_indices,
        np.searchsorted(problem.states.timestamps_ns, observations.timestamps_ns),
    )
    return first


def _seen_alike(points: Array, sources: Array, centres: Array, options: AssociationOptions) -> Mask:
    """(K, N) whether points (N, 3) are seen from `centres` (K, 3) from about where their `sources` (N, 3) are, in
    direction and in distance."""
    to_source = sources - points
    source_range = np.maximum(np.linalg.norm(to_source, axis=1), 1e-12)
    to_source /= source_range[:, None]
    # relative to one of them, products instead of differences lose no digits
    origin = centres[0]
    points, centres = points - origin, centres - origin
    products = np.einsum("ki,ni->kn", centres, points)
    squared = np.sum(centres**2, axis=1)[:, None] + np.sum(points**2, axis=1) - 2 * products
    distance = np.sqrt(np.maximum(squared, 0.0))
    along = np.einsum("ki,ni->kn", centres, to_source) - np.sum(points * to_source, axis=1)
    stretch = distance / source_range
    alike = (stretch < options.max_stretch) & (stretch > 1 / options.max_stretch)
    return np.asarray(alike & (along > np.cos(np.deg2rad(options.max_view_angle_deg)) * distance))


def _source_centres(problem: RigProblem, source: Indices) -> Array:
    """(L, 3) where the camera was that each landmark's patch is taken from."""
    observations, centres = problem.observations, np.empty((len(source), 3))
    for index in range(len(problem.cameras)):
        rows = np.flatnonzero(observations.camera_indices[source] == index)
        cam_from_world = camera_from_world(problem, index, observations.timestamps_ns[source[rows]])
        centres[rows] = cam_from_world.inverse().translation
    return centres


def _not_seen_lately(
    problem: RigProblem, camera: int, landmarks: Indices, stamps: Indices, options: AssociationOptions
) -> Indices:
    """Rows whose landmark this camera has not observed within `min_gap_s` of the stamp."""
    observations = problem.observations
    own = observations.camera_indices == camera
    first = np.full(len(problem.landmarks), np.iinfo(np.int64).max)
    last = np.full(len(problem.landmarks), np.iinfo(np.int64).min)
    np.minimum.at(first, observations.landmark_indices[own], observations.timestamps_ns[own])
    np.maximum.at(last, observations.landmark_indices[own], observations.timestamps_ns[own])
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


def with_warps(problem: RigProblem, searches: Searches, options: AssociationOptions) -> Searches:
    """Warps and bends of patches that lie in the plane through the landmark facing halfway between both viewers."""
    mapped = np.full((len(searches), 9, 2), np.nan)
    for source in range(len(problem.cameras)):
        for target in range(len(problem.cameras)):
            rows = np.flatnonzero((searches.source_cameras == source) & (searches.cameras == target))
            if len(rows):
                mapped[rows] = _mapped(problem, searches.take(rows), source, target)
    return warped(searches, mapped, options)


def warped(searches: Searches, mapped: Array, options: AssociationOptions) -> Searches:
    """The searches with the warps of their mapped stencils (S, 9, 2), without those that are not seen alike."""
    grid = mapped.reshape(-1, 3, 3, 2)
    left, right, above, below = grid[:, 1, 0], grid[:, 1, 2], grid[:, 0, 1], grid[:, 2, 1]
    twice_centre = 2 * grid[:, 1, 1]
    warps = np.stack([right - left, below - above], axis=2) / (2 * _STENCIL_PX)
    twisted = (grid[:, 2, 2] + grid[:, 0, 0] - grid[:, 2, 0] - grid[:, 0, 2]) / 4
    curved = np.stack([right + left - twice_centre, twisted, below + above - twice_centre], axis=2)
    good: Mask = np.asarray(np.isfinite(mapped).all(axis=(1, 2)))
    stretch = np.sqrt(np.abs(np.linalg.det(np.where(good[:, None, None], warps, np.eye(2)))))
    good &= (stretch < options.max_stretch) & (stretch > 1 / options.max_stretch)
    return replace(searches, warps=warps, second_order=curved / _STENCIL_PX**2).take(np.flatnonzero(good))


def _mapped(problem: RigProblem, searches: Searches, source: int, target: int) -> Array:
    """Stencils of searches of one camera in another, mapped."""
    return map_stencils(
        searches.source_pixels,
        problem.landmarks.points_world[searches.landmarks],
        (problem.cameras[source].model, problem.cameras[target].model),
        camera_from_world(problem, source, searches.source_stamps).inverse(),
        camera_from_world(problem, target, searches.stamps),
    )


def map_stencils(
    source_pixels: Array,
    points_world: Array,
    models: tuple[CameraModel, CameraModel],
    world_from_source: SE3,
    target_from_world: SE3,
) -> Array:
    """(S, 9, 2) where the 3 x 3 stencils about the source pixels come to lie in the target's images; NaN outside.

    source_pixels: (S, 2). points_world: (S, 3), through which planes go that face halfway between both viewers.
    models: of the source and of the target.
    """
    stencil = (source_pixels[:, None] + _STENCIL).reshape(-1, 2)
    bearings, _ = models[0].unproject(stencil)
    rays = np.einsum("nij,nkj->nki", world_from_source.rotation, bearings.reshape(-1, 9, 3))
    to_source = _unit(world_from_source.translation - points_world)
    to_target = _unit(target_from_world.inverse().translation - points_world)
    normal = _unit(to_source + to_target)
    depth = np.einsum("ni,ni->n", normal, points_world - world_from_source.translation)
    slope = np.einsum("ni,nki->nk", normal, rays)
    corners = world_from_source.translation[:, None] + rays * (depth[:, None] / slope)[:, :, None]
    corners_cam = np.einsum("nij,nkj->nki", target_from_world.rotation, corners)
    corners_cam += target_from_world.translation[:, None]
    pixels, _ = models[1].project(corners_cam.reshape(-1, 3))
    return pixels.reshape(-1, 9, 2)


def _unit(vectors: Array) -> Array:
    return np.asarray(vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-12))
