"""The baseline: frame-to-frame odometry without a map, as the project's thesis baseline did it.

Essential matrix between neighbouring frames, step length from the ratio of the sizes of scenes triangulated from
neighbouring pairs, a complementary filter that mixes in the gyroscope's turn, a moving average over the result. No
map and no adjustment: every step's error stays, above all in scale. Every table shows it beside the real method.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from rigwake._types import Array, Indices
from rigwake.cameras.protocol import CameraModel
from rigwake.errors import EstimationError, UsageError
from rigwake.geometry import so3
from rigwake.geometry.ransac import Budget
from rigwake.geometry.se3 import SE3, stack
from rigwake.geometry.triangulation import triangulate_midpoint
from rigwake.geometry.two_view import TwoView, relative_pose
from rigwake.odometry.indexed_tracks import IndexedTracks, index_observations
from rigwake.tracks import Tracks
from rigwake.trajectory import Trajectory

_MIN_SHARED = 8
_MIN_PARALLAX = np.deg2rad(0.1)


@dataclass(frozen=True)
class ThesisOptions:
    """Options of the baseline.

    seed: of RANSAC. gate_px: inlier gate. gamma: weight of the gyroscope's turn against the camera's, 0 to 1.
    smooth_frames: width of the moving average over positions; 1 is none.
    """

    seed: int = 0
    gate_px: float = 1.0
    gamma: float = 0.0
    smooth_frames: int = 1

    def __post_init__(self) -> None:
        if not 0 <= self.gamma <= 1:
            raise UsageError(f"gamma must lie between 0 and 1, not {self.gamma}.")
        if self.smooth_frames < 1 or self.smooth_frames % 2 == 0:
            raise UsageError(f"smooth_frames must be odd and positive, not {self.smooth_frames}.")


@dataclass(frozen=True, eq=False)
class _Step:
    """Motion between neighbouring frames with unit translation, and how far its points are from either frame."""

    second_from_first: SE3
    tracks: Indices
    ranges_first: Array
    ranges_second: Array


def estimate_thesis(
    tracks: Tracks,
    camera: CameraModel,
    options: ThesisOptions | None = None,
    *,
    rotations: Array | None = None,
) -> Trajectory:
    """Frame-to-frame trajectory up to one scale, every frame with observations a pose.

    rotations: (F, 3, 3) `gyro_world_from_cam`, mixed in with weight gamma. A pair of frames that shows no motion
    repeats the last step's turn and does not move. Raises EstimationError when no pair gives a motion.
    """
    options = options or ThesisOptions()
    observations = index_observations(tracks, camera)
    frames = np.flatnonzero(np.diff(observations.frame_starts) >= _MIN_SHARED)
    rng = np.random.default_rng(options.seed)
    poses, previous, length, found = [SE3.identity()], None, 1.0, 0
    for first, second in pairwise(frames):
        step = _step(observations, int(first), int(second), options, rng)
        if step is None:
            poses.append(poses[-1])
            previous = None
            continue
        found += 1
        length *= _relative_scale(previous, step)
        turn = _filtered(step.second_from_first.rotation, rotations, int(first), int(second), options.gamma)
        motion = SE3(turn, length * step.second_from_first.translation).inverse()
        poses.append(poses[-1] * motion)
        previous = step
    if found == 0:
        raise EstimationError(
            f"{tracks.camera}: no two neighbouring frames share enough tracks.",
            remedy="Check masks, exposure and texture.",
        )
    path = stack(poses)
    path = SE3(path.rotation, _moving_average(path.translation, options.smooth_frames))
    return Trajectory(tracks.camera, tracks.timestamps_ns[frames], path, is_metric=False)


def _step(
    observations: IndexedTracks, first: int, second: int, options: ThesisOptions, rng: np.random.Generator
) -> _Step | None:
    a, b = observations.common(first, second)
    if len(a) < _MIN_SHARED:
        return None
    gate = options.gate_px * float(np.median(observations.rad_per_px[a]))
    bearings = observations.bearings[a], observations.bearings[b]
    try:
        view: TwoView = relative_pose(*bearings, max_angle=gate, rng=rng, budget=Budget(max_trials=200))
    except EstimationError:
        return None
    good = view.inliers & (view.parallax > _MIN_PARALLAX)
    if good.sum() < _MIN_SHARED:
        return None
    points = triangulate_midpoint(view.second_from_first, bearings[0][good], bearings[1][good])
    near, far = np.linalg.norm(points, axis=1), np.linalg.norm(view.second_from_first * points, axis=1)
    fixed = np.isfinite(near) & (near > 0) & (far > 0)
    return _Step(view.second_from_first, observations.track[a][good][fixed], near[fixed], far[fixed])


def _relative_scale(previous: _Step | None, step: _Step) -> float:
    """How much longer this step is than the last: median ratio over points that both triangulated.

    Both measure the points' ranges from the frame they share, each in the length of its own step.
    """
    if previous is None:
        return 1.0
    _, i, j = np.intersect1d(previous.tracks, step.tracks, assume_unique=True, return_indices=True)
    if len(i) < _MIN_SHARED:
        return 1.0
    return float(np.clip(np.median(previous.ranges_second[i] / step.ranges_first[j]), 0.1, 10.0))


def _filtered(turn: Array, rotations: Array | None, first: int, second: int, gamma: float) -> Array:
    """Complementary filter: the camera's turn, moved by the fraction gamma towards the gyroscope's."""
    if rotations is None or gamma == 0:
        return turn
    gyro = rotations[second].T @ rotations[first]
    return np.asarray(turn @ so3.exp(gamma * so3.log(turn.T @ gyro)))


def _moving_average(positions: Array, width: int) -> Array:
    if width == 1:
        return positions
    padded = np.pad(positions, ((width // 2, width // 2), (0, 0)), mode="edge")
    kernel = np.full(width, 1 / width)
    return np.stack([np.convolve(column, kernel, mode="valid") for column in padded.T], axis=1)
