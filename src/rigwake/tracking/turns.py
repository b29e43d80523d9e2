"""How a camera turns, from image to image, before anything else is known about it.

A few corners, the rotation most of them agree on, nothing kept: enough to find out how camera and IMU are turned
towards each other and by how much their clocks differ, and so where the horizon is, before tracking starts.
"""

from __future__ import annotations

import numpy as np

from rigwake.cameras.base import CameraModel, Mask
from rigwake.errors import EstimationError, UsageError
from rigwake.geometry.se3 import SE3
from rigwake.geometry.so3 import Array
from rigwake.recording import CameraStream, Image
from rigwake.tracking.features import detect_corners
from rigwake.tracking.klt import follow
from rigwake.tracking.masks import beyond_lens
from rigwake.tracking.warps import dominant_rotation
from rigwake.trajectory import Trajectory

_CORNERS = 120
_MIN_MATCHES = 12
_MAX_GAP_S = 0.5


def visual_turns(stream: CameraStream, *, frames: int = 150) -> Trajectory:
    """A trajectory whose rotations are the camera's turns, and whose positions are all zero.

    frames: at most so many, in a row, from the middle of the recording. It drifts by degrees, and points on the
    hull or on water pull it a little: good to a degree, not to be calibrated from. Segments end where images
    show too little. Raises UsageError without a model, EstimationError when hardly any image can be compared.
    """
    if stream.model is None:
        raise UsageError(
            f"camera {stream.name} has no intrinsics.", remedy="Calibrate one with `rigwake intrinsics`."
        )
    count = min(frames, len(stream))
    start = (len(stream) - count) // 2
    usable = ~beyond_lens(stream.model)
    stamps: list[int] = []
    rotations, segments = [np.eye(3)], [0]
    before: Image | None = None
    for frame in stream.frames(np.arange(start, start + count)):
        if before is not None:
            near = (frame.timestamp_ns - stamps[-1]) * 1e-9 <= _MAX_GAP_S
            turn = _turn(before, frame.image, stream.model, usable) if near else None
            rotations.append(rotations[-1] @ (np.eye(3) if turn is None else turn.T))
            segments.append(segments[-1] + (turn is None))
        before = frame.image
        stamps.append(frame.timestamp_ns)
    if len(stamps) - len(set(segments)) < _MIN_MATCHES:
        raise EstimationError(
            f"camera {stream.name}: hardly any two images could be compared.",
            remedy="Look at the images: black, covered, or at too low a rate?",
        )
    matrices = np.array(rotations)
    return Trajectory(
        stream.name,
        np.array(stamps, dtype=np.int64),
        SE3(matrices, np.zeros((len(stamps), 3))),
        segment_ids=np.array(segments, dtype=np.int64),
    )


def _turn(before: Image, after: Image, model: CameraModel, usable: Mask) -> Array | None:
    """Rotation `after_from_before` (3, 3) that most corners agree on; None with too few of them."""
    corners = detect_corners(
        before,
        usable,
        np.empty((0, 2)),
        wanted=_CORNERS,
        cell_px=64,
        min_distance_px=12,
        min_strength=400.0,
    )
    landed, believed = follow(
        before, after, corners, corners, window_px=21, levels=4, max_forward_backward_px=0.5
    )
    bearings_before, valid = model.unproject(corners)
    bearings_after, still_valid = model.unproject(landed)
    good = believed & valid & still_valid
    if good.sum() < _MIN_MATCHES:
        return None
    return dominant_rotation(bearings_before[good], bearings_after[good])
