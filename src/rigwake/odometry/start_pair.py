"""Where to start: the pair of frames from which a map is best built."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rigwake._types import Array, Indices
from rigwake.errors import EstimationError
from rigwake.geometry.se3 import SE3
from rigwake.geometry.triangulation import triangulate_rays
from rigwake.geometry.two_view import (
    TwoView,
    relative_pose,
    relative_pose_known_rotation,
    rotation_between,
    rotation_compensated_parallax,
)
from rigwake.odometry.indexed_tracks import IndexedTracks
from rigwake.odometry.odometry_options import OdometryOptions

_ANCHORS = 24  # frames tried as the first of a pair
_PARTNERS = 8  # frames tried with each
_TRIED = 6  # best candidates whose geometry is estimated


@dataclass(frozen=True, eq=False)
class StartPair:
    """Two frames, their relative pose (unit baseline), and how many points they triangulate well."""

    first: int
    second: int
    view: TwoView
    score: int


def _partners(observations: IndexedTracks, first: int, last: int, needed: int) -> list[int]:
    """Frames after `first` that share enough tracks with it, spread over the reachable range."""
    tracks = observations.track[observations.of_frame(first)]
    ends = observations.track_starts[tracks + 1] - 1
    final_frame = np.sort(observations.frame[observations.by_track[ends]])[::-1]
    if len(final_frame) < needed:
        return []
    reach = min(int(final_frame[needed - 1]), last)
    return sorted(set(np.linspace(first + 1, reach, _PARTNERS).astype(int))) if reach > first else []


def _candidates(
    observations: IndexedTracks, first: int, last: int, options: OdometryOptions, rotations: Array | None
) -> list[tuple[float, int, int]]:
    """(score, first, second) of pairs with parallax, best first: median parallax times root of shared tracks."""
    needed = 3 * options.min_inliers
    found = []
    for anchor in np.unique(np.linspace(first, last - 1, _ANCHORS).astype(int)):
        for partner in _partners(observations, int(anchor), last, needed):
            a, b = observations.common(int(anchor), partner)
            if len(a) < needed:
                continue
            first_bearings, second_bearings = observations.bearings[a], observations.bearings[b]
            R = _rotation(rotations, int(anchor), partner, first_bearings, second_bearings)
            parallax = float(np.median(rotation_compensated_parallax(R, first_bearings, second_bearings)))
            if parallax > options.min_parallax_stds * float(np.median(observations.angle_std[a])):
                found.append((min(parallax, 0.15) * np.sqrt(len(a)), int(anchor), partner))
    return sorted(found, reverse=True)


def _rotation(rotations: Array | None, first: int, second: int, a: Array, b: Array) -> Array:
    """second_from_first: measured by the gyroscope, else what explains most of the two views."""
    return rotations[second].T @ rotations[first] if rotations is not None else rotation_between(a, b)


def _evaluate(
    observations: IndexedTracks,
    first: int,
    second: int,
    options: OdometryOptions,
    rotations: Array | None,
    rng: np.random.Generator,
) -> StartPair:
    a, b = observations.common(first, second)
    bearings = observations.bearings[a], observations.bearings[b]
    gate = options.gate_px * float(np.median(observations.rad_per_px[a]))
    view = relative_pose(*bearings, max_angle=gate, rng=rng)
    if rotations is not None:
        # the gyro's mounting is known to a degree or so only: what it finds must explain more than vision alone
        R = rotations[second].T @ rotations[first]
        aided = relative_pose_known_rotation(R, *bearings, max_angle=gate, rng=rng)
        view = aided if aided.inliers.sum() > view.inliers.sum() else view
    good = view.inliers & (view.parallax > options.min_parallax_stds * observations.angle_std[a])
    fraction = float(view.inliers.mean())
    return StartPair(first, second, view, int(good.sum() * (fraction > options.min_inlier_fraction)))


def choose_start(
    observations: IndexedTracks,
    first: int,
    last: int,
    options: OdometryOptions,
    rng: np.random.Generator,
    rotations: Array | None = None,
) -> StartPair:
    """The pair of frames in `first..last` (inclusive) that triangulates most points with enough parallax.

    rotations: (F, 3, 3) `gyro_world_from_cam` if an IMU tells, else the five-point solver finds the rotation.
    Raises EstimationError where no pair has parallax: a camera that only turns, or stands still.
    """
    pairs = _candidates(observations, first, last, options, rotations)[:_TRIED]
    tried = [_evaluate(observations, i, j, options, rotations, rng) for _, i, j in pairs]
    best = max(tried, key=lambda pair: pair.score, default=None)
    if best is None or best.score < options.min_inliers:
        if (
            rotations is not None
        ):  # a camera that is turned towards the IMU otherwise than thought misleads them
            return choose_start(observations, first, last, options, rng)
        raise EstimationError(
            f"{observations.tracks.camera}: no two frames between {first} and {last} see enough of the same points "
            "from different places.",
            consequence="The camera's motion cannot be started there.",
            remedy="The camera must move sideways to what it sees; check masks and that tracks are long enough.",
        )
    return best


def start_points(observations: IndexedTracks, pair: StartPair) -> tuple[Indices, Array]:
    """Track numbers and points (in the first camera's frame) of the pair's inliers."""
    a, b = observations.common(pair.first, pair.second)
    a, b = a[pair.view.inliers], b[pair.view.inliers]
    first_from_second: SE3 = pair.view.second_from_first.inverse()
    origins = np.zeros((2 * len(a), 3))
    origins[1::2] = first_from_second.translation
    directions = np.empty_like(origins)
    directions[0::2] = observations.bearings[a]
    directions[1::2] = observations.bearings[b] @ first_from_second.rotation.T
    found = triangulate_rays(origins, directions, np.arange(0, 2 * len(a) + 1, 2))
    stds = observations.angle_std[a]
    good = found.ahead & (found.max_parallax > 5 * stds) & np.isfinite(found.points).all(1)
    return observations.track[a][good], found.points[good]
