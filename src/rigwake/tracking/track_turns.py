"""How a camera turns from frame to frame, by its tracks: for lenses that are still too wrong for odometry."""

from __future__ import annotations

import numpy as np

from rigwake._types import Array
from rigwake.geometry.se3 import SE3
from rigwake.tracking.warps import dominant_rotation
from rigwake.tracks import Tracks
from rigwake.trajectory import Trajectory

_MIN_MATCHES = 12


def turns_of_tracks(tracks: Tracks) -> Trajectory:
    """A trajectory whose rotations are those that most tracks agree on from frame to frame, its positions all zero.

    Segments end where two frames share fewer than 12 tracks. It drifts, as every motion but the turn pulls it a little.
    """
    starts = np.searchsorted(tracks.frame_indices, np.arange(len(tracks.timestamps_ns) + 1))
    rotations, segments = [np.eye(3)], [0]
    for k in range(1, len(tracks.timestamps_ns)):
        turn = _turn(tracks, slice(starts[k - 1], starts[k]), slice(starts[k], starts[k + 1]))
        rotations.append(rotations[-1] @ (np.eye(3) if turn is None else turn.T))
        segments.append(segments[-1] + (turn is None))
    return Trajectory(
        tracks.camera,
        tracks.timestamps_ns,
        SE3(np.array(rotations), np.zeros((len(rotations), 3))),
        segment_ids=np.array(segments, dtype=np.int64),
    )


def _turn(tracks: Tracks, before: slice, after: slice) -> Array | None:
    _, i, j = np.intersect1d(
        tracks.track_ids[before], tracks.track_ids[after], assume_unique=True, return_indices=True
    )
    if len(i) < _MIN_MATCHES:
        return None
    return dominant_rotation(tracks.bearings_cam[before][i], tracks.bearings_cam[after][j])
