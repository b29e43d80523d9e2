"""What one camera measures before any motion is estimated: its mask, its turns against the gyro, its tracks."""

from __future__ import annotations

import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from rigwake._progress import CountProgress
from rigwake._types import Array
from rigwake.errors import EstimationError, UnobservableError
from rigwake.odometry.below_horizon import HorizonChoice, look_below_horizon
from rigwake.odometry.gravity_alignment import up_in_camera
from rigwake.odometry.gyro import GyroAlignment, align_gyro, camera_rotations
from rigwake.recording import CameraStream, ImuStream
from rigwake.tracking.camera_rotations import visual_rotations
from rigwake.tracking.front_ends import track_camera
from rigwake.tracking.masks import CameraMask, lens_mask, mask_from_file
from rigwake.tracking.self_mask import find_self_mask
from rigwake.tracking.tracking_options import TrackingOptions
from rigwake.tracks import Tracks
from rigwake.trajectory import Trajectory


@dataclass(frozen=True, eq=False)
class CameraMeasurement:
    """mask: where was looked. tracks: what was followed. rotations: (F, 3, 3) of the tracks' frames by the gyro, None
    without one. notes: what was left out, and why. seconds: wall time by stage."""

    mask: CameraMask
    tracks: Tracks
    rotations: Array | None
    notes: tuple[str, ...]
    seconds: dict[str, float]


def measure_camera(
    stream: CameraStream,
    imu: ImuStream | None,
    tracking: TrackingOptions,
    progress: CountProgress,
    *,
    hull: bool = True,
    horizon: HorizonChoice = "auto",
    mask_file: Path | None = None,
    turns: Trajectory | None = None,
    track: Callable[..., Tracks] = track_camera,
) -> CameraMeasurement:
    """Mask, gyro and tracks of a camera; the gyro tells where the horizon is, and below it nothing is tracked.

    hull: look for the own boat in view. horizon: leave out what lies below it (auto: where it is water). mask_file: a
    picture of the camera's size, white where it may be used. turns: what `visual_rotations` finds, if that is known.
    track: `track_camera`, or what does the same in parts.
    A hull that is not found and a gyro that does not fit are noted and done without. Raises EstimationError where
    nothing can be tracked.
    """
    notes: list[str] = []
    marks = [time.perf_counter()]
    progress("looking for lens border and hull, comparing its turns with the gyro", 0, 1)
    with ThreadPoolExecutor(1) as beside:
        turning = beside.submit(_gyro, stream, imu, turns)
        mask = _mask(stream, hull, mask_file, notes)
        gyro, gyro_notes = turning.result()
    notes += gyro_notes
    marks.append(time.perf_counter())
    up_cam = None
    if horizon != "off" and gyro is not None and imu is not None:
        up_cam = up_in_camera(imu, gyro, stream.timestamps_ns)
        if not np.isfinite(up_cam).any():
            notes.append("the accelerometer shows no gravity: where the horizon is cannot be told")
        elif horizon == "auto":
            below = look_below_horizon(stream, up_cam, mask.usable)
            notes.append(below.words)
            up_cam = None if below.is_rigid else up_cam
    total = max(len(stream), 1)
    tracks = track(
        stream, tracking, mask, up_cam=up_cam, progress=lambda done: progress("tracking", done, total)
    )
    marks.append(time.perf_counter())
    rotations = None
    if gyro is not None and imu is not None:
        rotations = camera_rotations(imu, gyro, tracks.timestamps_ns)
    stages = ("masks and gyroscope", "tracking")
    seconds = {stage: marks[k + 1] - marks[k] for k, stage in enumerate(stages)}
    return CameraMeasurement(mask, tracks, rotations, tuple(notes), seconds)


def _mask(stream: CameraStream, hull: bool, mask_file: Path | None, notes: list[str]) -> CameraMask:
    """Lens border, what was masked by hand, and the own hull."""
    mask = lens_mask(stream)
    if mask_file is not None:
        given = mask_from_file(mask_file, mask.width_px, mask.height_px)
        mask = mask.with_region("file", ~given.usable)
    if hull:
        try:
            mask = mask.with_region("hull", find_self_mask(stream, mask.usable))
        except (UnobservableError, EstimationError) as error:
            notes.append(f"own hull not looked for: {error.cause}")
    return mask


def _gyro(
    stream: CameraStream, imu: ImuStream | None, turns: Trajectory | None
) -> tuple[GyroAlignment | None, list[str]]:
    """How camera and IMU are turned towards each other, roughly; None, and why, where that cannot be told yet."""
    if imu is None:
        return None, []
    try:
        return align_gyro(turns if turns is not None else visual_rotations(stream), imu), []
    except (UnobservableError, EstimationError) as error:
        return None, [f"tracking is not aided by the gyroscope: {error.cause}"]
