"""What a calibration will cost, in CPU-seconds of this machine, before it is begun."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np

from rigwake._types import Array, Indices
from rigwake.recording import CameraStream

# CPU-seconds on a machine of speed 1, from the profile of a recording of 40 s with four cameras
_START_S = 8.0  # loading, checks of the sensors, writing the report
_CAMERA_S = 2.8  # per camera: lens border, hull, turns, horizon
_FRAME_S, _MEGAPIXEL_S = 0.025, 0.020  # per frame: tracking and odometry; decoding and pyramids
_ADJUSTED_S = 0.12  # per camera and second of recording: the bundle adjustment, its rounds and checks
_ASSOCIATED_S = 11.0  # landmarks looked for in other images: bounded by the number of searches
_REFERENCE_S = 0.0245  # the trial's CPU time on the machine of speed 1
_TRIAL_PX, _TRIAL_CORNERS, _TRIAL_RUNS = 480, 300, 5


@dataclass(frozen=True)
class CalibrationCost:
    """CPU-seconds: fixed, whatever part is used, and of the chosen sections. speed: of this machine, 1 being that of
    the machine that the model was measured on."""

    fixed_s: float
    sections_s: float
    speed: float

    @property
    def total_s(self) -> float:
        """All of it."""
        return self.fixed_s + self.sections_s


def fixed_cost(cameras: Mapping[str, CameraStream], *, across_cameras: bool) -> float:
    """CPU-seconds that do not depend on how much of the recording is used."""
    work = _START_S + _CAMERA_S * len(cameras) + (_ASSOCIATED_S if across_cameras else 0.0)
    return work / machine_speed()


def stretch_costs(cameras: Mapping[str, CameraStream], spans_ns: Indices) -> Array:
    """(S,) CPU-seconds of tracking each stretch in all cameras and adjusting it."""
    costs = np.zeros(len(spans_ns))
    for camera in cameras.values():
        frames = np.diff(np.searchsorted(camera.timestamps_ns, spans_ns), axis=1)[:, 0]
        costs += frames * (_FRAME_S + _MEGAPIXEL_S * camera.width_px * camera.height_px * 1e-6)
        costs += np.diff(spans_ns, axis=1)[:, 0] * 1e-9 * _ADJUSTED_S
    return costs / machine_speed()


@lru_cache(maxsize=1)
def machine_speed() -> float:
    """How fast this machine tracks, compared with the one that the model was measured on: the best of a few trials."""
    rng = np.random.default_rng(0)
    texture = cv2.GaussianBlur(rng.integers(0, 255, (_TRIAL_PX, _TRIAL_PX), dtype=np.uint8), (0, 0), 2.0)
    moved = np.roll(texture, 3, axis=1)
    taken = []
    threads = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        for _ in range(_TRIAL_RUNS):
            begun = time.thread_time()
            corners = cv2.goodFeaturesToTrack(texture, _TRIAL_CORNERS, 0.01, 5)
            for _ in range(4):
                cv2.calcOpticalFlowPyrLK(texture, moved, corners, None, winSize=(21, 21), maxLevel=3)
            taken.append(time.thread_time() - begun)
    finally:
        cv2.setNumThreads(threads)
    return _REFERENCE_S / max(min(taken), 1e-4)
