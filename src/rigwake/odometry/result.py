"""What odometry returns."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rigwake._types import Array, Indices
from rigwake.trajectory import Trajectory


@dataclass(frozen=True)
class OdometryCounts:
    """What happened on the way.

    frames: in the tracks; placed: with a pose; keyframes: adjusted in windows; segments: unbroken pieces;
    lost: frames with observations that could not be placed; empty: frames without observations (black, repeated).
    landmarks, observations, inliers: in the final map. inlier_rms_px: of the inliers' residuals.
    """

    frames: int
    placed: int
    keyframes: int
    segments: int
    lost: int
    empty: int
    landmarks: int
    observations: int
    inliers: int
    inlier_rms_px: float
    seconds: float


@dataclass(frozen=True, eq=False)
class OdometryLandmarks:
    """Points of the map: the tracks they belong to (L,), where they are (L, 3), and in whose segment (L,)."""

    track_ids: Indices
    points_world: Array
    segment_ids: Indices

    def __len__(self) -> int:
        return len(self.track_ids)


@dataclass(frozen=True, eq=False)
class OdometryResult:
    """One camera's motion.

    trajectory: `world_from_cam` of every placed frame, up to scale (one unknown unit per segment) unless
    it says metric. frame_indices: (N,) rows of `Tracks.timestamps_ns` of its poses.
    inliers: (M,) which rows of the given `Tracks` agree with the map.
    """

    trajectory: Trajectory
    frame_indices: Indices
    landmarks: OdometryLandmarks
    inliers: NDArray[np.bool_]
    counts: OdometryCounts
