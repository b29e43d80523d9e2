"""A few dozen sampled frames per camera: exposure, frozen images, and how the camera turned between frames."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np

from rigwake._types import Array, Image, Stamps
from rigwake.cameras.protocol import CameraModel
from rigwake.geometry import so3
from rigwake.recording import CameraStream, EncodedFrameSource, Frame

BURSTS, BURST_FRAMES = 5, 12
MOST_CHECKED_FRAMES = 4000
"""Of a whole recording: their bytes are read, at some hundred megabytes per second."""
_DARK_LEVEL, _BRIGHT_LEVEL = 8, 250
_BRIGHT_FRACTION = 0.5
_MAX_WIDTH_PX = 480  # wider images are followed at a smaller size
_CORNERS = 250
_MIN_POINTS = 30
_MAX_RESIDUAL = np.radians(1.0)


@dataclass(frozen=True, eq=False)
class Pictures:
    """What sampled frames show.

    sampled, readable: frames asked for and decoded. dark, overexposed, frozen: of the readable; frozen means
    equal to the frame before it to the last bit. mean_level: 0 to 255.
    start_ns, end_ns: (M,) of frame pairs; rotations: (M, 3) rotation vectors `cam_start_from_cam_end`, radians.
    """

    sampled: int
    readable: int
    dark: int
    overexposed: int
    frozen: int
    mean_level: float
    start_ns: Stamps
    end_ns: Stamps
    rotations: Array


def sampled_indices(count: int) -> list[range]:
    """Bursts of consecutive frames, spread evenly over the recording."""
    if count <= BURSTS * BURST_FRAMES:
        return [range(count)]
    starts = np.linspace(0, count - BURST_FRAMES, BURSTS).astype(int)
    return [range(start, start + BURST_FRAMES) for start in starts]


def look_at_pictures(camera: CameraStream, advance: Callable[[int], None]) -> Pictures:
    """Sample frames of a camera; `advance` is called with the number of frames done."""
    sampled, levels, dark, bright, frozen = 0, [], 0, 0, 0
    starts, ends, turns = [], [], []
    for burst in sampled_indices(len(camera)):
        before: Frame | None = None
        sampled += len(burst)
        for frame in camera.frames(list(burst)):
            level = float(frame.image.mean())
            levels.append(level)
            dark += level < _DARK_LEVEL
            bright += float(np.mean(frame.image >= _BRIGHT_LEVEL)) > _BRIGHT_FRACTION
            if before is not None and np.array_equal(before.image, frame.image):
                frozen += 1
            elif before is not None and camera.model is not None and frame.index == before.index + 1:
                turn = camera_rotation(before.image, frame.image, camera.model)
                if turn is not None:
                    starts.append(before.timestamp_ns)
                    ends.append(frame.timestamp_ns)
                    turns.append(turn)
            before = frame
        advance(len(burst))
    return Pictures(
        sampled,
        len(levels),
        int(dark),
        int(bright),
        frozen,
        float(np.mean(levels)) if levels else float("nan"),
        np.array(starts, dtype=np.int64),
        np.array(ends, dtype=np.int64),
        np.array(turns).reshape(-1, 3),
    )


def unreadable_frames(camera: CameraStream, most: int) -> tuple[int, int]:
    """How many frames that lie encoded in the recording have no whole image, of how many that were looked at.

    At most so many are, spread over the recording; none of a source that is not encoded. Pixels are not decoded.
    """
    if not (isinstance(camera.source, EncodedFrameSource) and camera.source.is_encoded and len(camera)):
        return 0, 0
    chosen = np.unique(np.linspace(0, len(camera) - 1, most).astype(np.int64))
    whole = sum(1 for _ in camera.source.encoded_frames(chosen))
    return len(chosen) - whole, len(chosen)


def camera_rotation(first: Image, second: Image, model: CameraModel) -> Array | None:
    """Rotation vector `cam_first_from_cam_second` from corners followed by KLT; None if too few hold.

    Translation is neglected: between neighbouring frames the far scene moves by rotation.
    """
    scale = min(1.0, _MAX_WIDTH_PX / first.shape[1])
    if scale < 1:
        first, second = (
            cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
            for image in (first, second)
        )
    corners = cv2.goodFeaturesToTrack(first, _CORNERS, 0.01, 10)
    if corners is None or len(corners) < _MIN_POINTS:
        return None
    moved, found, _ = cv2.calcOpticalFlowPyrLK(first, second, corners, None, winSize=(15, 15), maxLevel=3)
    kept = found.ravel() == 1
    pixels = [
        ((points.reshape(-1, 2)[kept] + 0.5) / scale - 0.5).astype(np.float64) for points in (corners, moved)
    ]
    bearings, valid = zip(*(model.unproject(p) for p in pixels), strict=True)
    both = valid[0] & valid[1]
    if both.sum() < _MIN_POINTS:
        return None
    return _robust_rotation(bearings[0][both], bearings[1][both])


def _robust_rotation(a: Array, b: Array) -> Array | None:
    """Rotation vector of R with `a ~ R b` for most bearings: Wahba's problem, reweighted (Geman-McClure)."""
    weights = np.ones(len(a))
    R = np.eye(3)
    for scale in (0.05, 0.02, 0.01, 0.005, 0.005):
        R = so3.nearest_rotation((weights[:, None] * a).T @ b)
        error = np.linalg.norm(a - b @ R.T, axis=1)
        weights = 1 / (1 + (error / scale) ** 2) ** 2
    if np.median(error) > _MAX_RESIDUAL or np.sum(error < _MAX_RESIDUAL) < _MIN_POINTS:
        return None
    return so3.log(R)
