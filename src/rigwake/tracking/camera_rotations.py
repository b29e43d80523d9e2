"""How a camera turns, from image to image, before anything else is known about it.

A few corners, the rotation most of them agree on, nothing kept: enough to find out how camera and IMU are turned
towards each other and by how much their clocks differ, and so where the horizon is, before tracking starts.
"""

from __future__ import annotations

from functools import partial
from itertools import pairwise

import numpy as np

from rigwake._types import Array, Image, Indices, Mask, Stamps
from rigwake.errors import EstimationError, UsageError
from rigwake.geometry.se3 import SE3
from rigwake.parallel import in_order
from rigwake.recording import CameraStream, Frame
from rigwake.tracking.features import detect_corners
from rigwake.tracking.klt import follow, pyramid
from rigwake.tracking.masks import beyond_lens
from rigwake.tracking.picture_scale import ReducedRays, reduced
from rigwake.tracking.warps import dominant_rotation
from rigwake.trajectory import Trajectory

_CORNERS = 120
_MIN_MATCHES = 12
_WINDOW_PX, _LEVELS = 21, 4  # of the search
_MAX_GAP_S = 0.5
_LEAST_STEP_S = 0.1  # between pictures that are compared: at 30 a second, 150 in a row would be five seconds
_WIDEST_PX = 1000  # larger pictures are halved: a degree shows in small ones too


def visual_rotations(stream: CameraStream, *, frames: int = 150) -> Trajectory:
    """A trajectory whose rotations are the camera's turns, and whose positions are all zero.

    frames: at most so many, up to ten a second, from the middle of the recording. It drifts by degrees, and points on
    the hull or on water pull it a little: good to a degree, not to be calibrated from. Segments end where images
    show too little. Raises UsageError without a model, EstimationError when hardly any image can be compared.
    """
    if stream.model is None:
        raise UsageError(
            f"camera {stream.name} has no intrinsics.", remedy="Calibrate one with `rigwake intrinsics`."
        )
    chosen = _from_the_middle(stream.timestamps_ns, frames)
    octaves = 0
    while stream.width_px / 2**octaves > _WIDEST_PX:
        octaves += 1
    usable = ~beyond_lens(stream.model)[:: 2**octaves, :: 2**octaves]
    stamps: list[int] = []
    rotations, segments = [np.eye(3)], [0]
    pairs = pairwise(stream.frames(chosen))
    turn_of = partial(_turn, rays=ReducedRays(stream.model, 2**octaves), octaves=octaves, usable=usable)
    for before_ns, after_ns, turn in in_order(turn_of, pairs):
        rotations.append(rotations[-1] @ (np.eye(3) if turn is None else turn.T))
        segments.append(segments[-1] + (turn is None))
        stamps += [after_ns] if stamps else [before_ns, after_ns]
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


def _from_the_middle(stamps: Stamps, frames: int) -> Indices:
    """At most so many frames around the middle one, up to ten a second."""
    period = float(np.median(np.diff(stamps))) * 1e-9 if len(stamps) > 1 else 1.0
    step = max(1, int(_LEAST_STEP_S / max(period, 1e-3) + 0.1))
    count = min(frames, -(-len(stamps) // step))
    start = (len(stamps) - 1 - step * (count - 1)) // 2
    return np.arange(start, start + step * count, step)


def _turn(
    pair: tuple[Frame, Frame], rays: ReducedRays, octaves: int, usable: Mask
) -> tuple[int, int, Array | None]:
    """Stamps of two frames, and the rotation `after_from_before` (3, 3) that most corners agree on; None with too few
    of them, and across a gap."""
    before, after = pair
    near = (after.timestamp_ns - before.timestamp_ns) * 1e-9 <= _MAX_GAP_S
    turn = None
    if near:
        turn = _rotation(reduced(before.image, octaves), reduced(after.image, octaves), rays, usable)
    return before.timestamp_ns, after.timestamp_ns, turn


def _rotation(before: Image, after: Image, rays: ReducedRays, usable: Mask) -> Array | None:
    corners = detect_corners(
        before,
        usable,
        np.empty((0, 2)),
        wanted=_CORNERS,
        cell_px=64,
        min_distance_px=12,
        min_strength=400.0,
    )
    scales, later = (pyramid(image, _WINDOW_PX, _LEVELS) for image in (before, after))
    landed, believed = follow(
        scales, later, corners, corners, window_px=_WINDOW_PX, max_forward_backward_px=0.5
    )
    bearings_before, valid = rays.unproject(corners)
    bearings_after, still_valid = rays.unproject(landed)
    good = believed & valid & still_valid
    if good.sum() < _MIN_MATCHES:
        return None
    return dominant_rotation(bearings_before[good], bearings_after[good])
