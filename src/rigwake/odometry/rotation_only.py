"""A camera that only turns, or stands still: its rotations are known although its path is not."""

from __future__ import annotations

import numpy as np

from rigwake.cameras.protocol import CameraModel
from rigwake.errors import EstimationError
from rigwake.geometry.se3 import SE3
from rigwake.geometry.two_view import rotation_between, rotation_compensated_parallax
from rigwake.odometry.indexed_tracks import index_observations
from rigwake.odometry.odometry_options import OdometryOptions
from rigwake.tracks import Tracks
from rigwake.trajectory import Trajectory

_MIN_FRACTION = 0.6


def estimate_rotations(
    tracks: Tracks, camera: CameraModel, options: OdometryOptions | None = None
) -> Trajectory:
    """Rotations of every frame where one rotation explains what is seen; positions are all zero, not measured.

    Each frame is turned towards the oldest frame with which it still shares enough tracks, so that errors do not
    add up while the view stays. Raises EstimationError where a rotation does not explain the images: the camera
    moved, and `estimate_monocular` is the right tool, or nothing static is seen.
    """
    options = options or OdometryOptions()
    observations = index_observations(tracks, camera)
    frames = np.flatnonzero(np.diff(observations.frame_starts) >= options.min_inliers)
    if not len(frames):
        raise EstimationError(
            f"{tracks.camera}: no frame has enough tracks.", remedy="Check exposure and masks."
        )
    rotation = np.tile(np.eye(3), (observations.frames, 1, 1))
    anchor = int(frames[0])
    for before, frame in zip(frames[:-1].tolist(), frames[1:].tolist(), strict=True):
        if len(observations.common(anchor, frame)[0]) < 3 * options.min_inliers:
            anchor = before
        a, b = observations.common(anchor, frame)
        if len(a) < options.min_inliers:
            raise EstimationError(f"{tracks.camera}: frames {anchor} and {frame} share only {len(a)} tracks.")
        bearings = observations.bearings[a], observations.bearings[b]
        gates = options.gate_px * observations.rad_per_px[a]
        frame_from_anchor = rotation_between(*bearings, scale=float(np.median(gates)))
        agree = rotation_compensated_parallax(frame_from_anchor, *bearings) <= gates
        if agree.mean() < _MIN_FRACTION:
            raise EstimationError(
                f"{tracks.camera}: between frames {anchor} and {frame} a rotation explains only "
                f"{100 * agree.mean():.0f} % of the tracks."
            )
        rotation[frame] = rotation[anchor] @ frame_from_anchor.T
    path = SE3(rotation[frames], np.zeros((len(frames), 3)))
    return Trajectory(tracks.camera, tracks.timestamps_ns[frames], path, is_metric=False)
