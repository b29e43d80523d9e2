"""One camera by itself: mask, turns, tracks, odometry. Runs in a process of its own and leaves its files."""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import cv2

from rigwake.atomic import write_text_atomic
from rigwake.config import CalibrateConfig
from rigwake.errors import RigwakeError
from rigwake.odometry.gyro import GyroAlignment, align_gyro, camera_rotations
from rigwake.odometry.level import up_in_camera
from rigwake.odometry.monocular import estimate_monocular
from rigwake.recording import CameraStream, ImuStream
from rigwake.tracking.front_ends import track_camera
from rigwake.tracking.hull import find_hull
from rigwake.tracking.masks import CameraMask, lens_mask
from rigwake.tracking.turns import visual_turns
from rigwake.writers.trajectories import write_tum

Tell = Callable[[str, float], None]
"""Told what is being done and which share of it is done."""


@dataclass(frozen=True, eq=False)
class CameraJob:
    """What a camera's process needs. odometry: whether to estimate it, or only to track."""

    stream: CameraStream
    imu: ImuStream | None
    out: Path
    config: CalibrateConfig
    odometry: bool = True


@dataclass(frozen=True)
class CameraOutcome:
    """How it went. failed: why not, or None. time_offset_s: first guess against the IMU, or None."""

    name: str
    failed: str | None
    unobservable: bool = False
    time_offset_s: float | None = None
    notes: tuple[str, ...] = ()
    counts: dict[str, Any] | None = None
    seconds: float = 0.0


def tracks_file(out: Path, camera: str) -> Path:
    """Where a camera's tracks are."""
    return out / "tracks" / f"{camera}.npz"


def odometry_file(out: Path, camera: str) -> Path:
    """Where a camera's own trajectory is."""
    return out / "odometry" / f"{camera}.tum"


def outcome_file(out: Path, camera: str) -> Path:
    """Where it says how a camera's stage went."""
    return out / "odometry" / f"{camera}.json"


def load_outcome(out: Path, camera: str) -> CameraOutcome:
    """What `process_camera` wrote."""
    content = json.loads(outcome_file(out, camera).read_text(encoding="utf-8"))
    return CameraOutcome(**{**content, "notes": tuple(content["notes"])})


def process_camera(job: CameraJob, tell: Tell) -> CameraOutcome:
    """Mask, turns, tracks and odometry of one camera; a camera that fails is an outcome, not an exception."""
    cv2.setNumThreads(1)
    started, name = time.perf_counter(), job.stream.name
    try:
        outcome = _process(job, tell)
    except RigwakeError as error:
        outcome = CameraOutcome(name, str(error), unobservable=error.exit_code == 3)
    outcome = replace(outcome, seconds=time.perf_counter() - started)
    write_text_atomic(outcome_file(job.out, name), json.dumps(asdict(outcome), indent=1) + "\n")
    return outcome


def _process(job: CameraJob, tell: Tell) -> CameraOutcome:
    stream, config = job.stream, job.config
    assert stream.model is not None
    notes: list[str] = []
    mask = _mask(job, notes, tell)
    gyro = _first_alignment(job, notes, tell)
    up_cam = None if gyro is None or job.imu is None else up_in_camera(job.imu, gyro, stream.timestamps_ns)
    total = max(len(stream), 1)
    tracks = track_camera(
        stream,
        config.tracking,
        mask,
        up_cam=up_cam,
        progress=lambda done: tell("tracking", done / total),
    )
    tracks.save(tracks_file(job.out, stream.name))
    counts: dict[str, Any] = {"tracking": asdict(tracks.report) if tracks.report else {}}
    if job.odometry:
        rotations = None
        if gyro is not None and job.imu is not None:
            rotations = camera_rotations(job.imu, gyro, tracks.timestamps_ns)
        result = estimate_monocular(
            tracks,
            stream.model,
            replace(config.odometry, seed=config.seed),
            rotations=rotations,
            progress=lambda done: tell("odometry", done / total),
        )
        write_tum(result.trajectory, odometry_file(job.out, stream.name))
        counts["odometry"] = asdict(result.counts)
    return CameraOutcome(
        stream.name, None, False, None if gyro is None else gyro.time_offset_s, tuple(notes), counts
    )


def _mask(job: CameraJob, notes: list[str], tell: Tell) -> CameraMask:
    """Lens border and own hull; saved as pictures."""
    stream = job.stream
    tell("looking for the hull", 0.0)
    mask = lens_mask(stream)
    if job.config.find_hull:
        try:
            mask = mask.with_region("hull", find_hull(stream, mask.usable))
        except RigwakeError as error:
            notes.append(f"hull not masked: {error.cause}")
    mask.save(job.out / "masks", stream.name)
    return mask


def _first_alignment(job: CameraJob, notes: list[str], tell: Tell) -> GyroAlignment | None:
    """How camera and IMU are turned towards each other, roughly; None where that cannot be told yet."""
    if job.imu is None:
        return None
    tell("comparing its turns with the gyro", 0.0)
    try:
        return align_gyro(visual_turns(job.stream), job.imu)
    except RigwakeError as error:
        notes.append(f"tracked without knowing the horizon: {error.cause}")
        return None
