"""One camera by itself: mask, turns, tracks, odometry. Runs in a process of its own and leaves its files."""

from __future__ import annotations

import json
import time
import traceback
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from rigwake._progress import StageProgress
from rigwake.atomic import write_text_atomic
from rigwake.calibration.yaml_file import plain
from rigwake.config import CalibrateConfig
from rigwake.errors import HostError, InputError, RigwakeError
from rigwake.odometry.bridged import frames_not_tracked
from rigwake.odometry.measure import measure_camera
from rigwake.odometry.monocular import estimate_monocular
from rigwake.recording import CameraStream, ImuStream
from rigwake.tracking.front_ends import track_camera
from rigwake.tracking.hull_picture import save_hull_picture
from rigwake.tracking.stretches import MapStretches, track_in_stretches
from rigwake.trajectory import Trajectory
from rigwake.writers.trajectory_writer import write_tum


@dataclass(frozen=True, eq=False)
class CameraJob:
    """What a camera's process needs. odometry: whether to estimate it, or only to track. turns: coarse ones, if
    they are known already."""

    stream: CameraStream
    imu: ImuStream | None
    out: Path
    config: CalibrateConfig
    odometry: bool = True
    turns: Trajectory | None = None


@dataclass(frozen=True)
class CameraOutcome:
    """How it went. failed: why not, or None. without_horizon: nothing could be followed above the horizon that the IMU
    tells, and what lies below it was followed too: good to say why, not to be calibrated from."""

    name: str
    failed: str | None
    unobservable: bool = False
    notes: tuple[str, ...] = ()
    counts: dict[str, Any] | None = None
    seconds: float = 0.0
    without_horizon: bool = False


def tracks_file(out: Path, camera: str) -> Path:
    """Where a camera's tracks are."""
    return out / "tracks" / f"{camera}.npz"


def odometry_file(out: Path, camera: str) -> Path:
    """Where a camera's own trajectory is."""
    return out / "odometry" / f"{camera}.tum"


def outcome_file(out: Path, camera: str) -> Path:
    """Where it says how a camera's stage went."""
    return out / "odometry" / f"{camera}.json"


def stage_files(out: Path, camera: str, *, odometry: bool) -> list[Path]:
    """All files that the stage of a camera leaves."""
    files = [outcome_file(out, camera), tracks_file(out, camera), out / "masks" / f"{camera}.png"]
    return files + ([odometry_file(out, camera)] if odometry else [])


def load_outcome(out: Path, camera: str) -> CameraOutcome:
    """What `process_camera` wrote. Raises InputError."""
    path = outcome_file(out, camera)
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        return CameraOutcome(**{**content, "notes": tuple(map(str, content["notes"]))})
    except (OSError, ValueError, KeyError, TypeError, RecursionError) as error:
        raise InputError(
            f"{path} does not say how the stage of {camera} went ({type(error).__name__}: {error}).",
            remedy="Run the command again without --resume.",
        ) from error


def process_camera(
    job: CameraJob, report_stage: StageProgress, map_stretches: MapStretches = map
) -> CameraOutcome:
    """Mask, turns, tracks and odometry of one camera; a camera that fails is an outcome, not an exception.

    map_stretches: where the stretches of a long recording are tracked, by default here.
    """
    cv2.setNumThreads(1)
    started, name = time.perf_counter(), job.stream.name
    try:
        outcome = _process(job, report_stage, map_stretches)
    except HostError:
        raise  # not the camera's fault: all stop
    except RigwakeError as error:
        outcome = CameraOutcome(name, str(error), unobservable=error.exit_code == 3)
        if job.imu is not None and job.config.sensor_checks:
            outcome = _once_more(job, report_stage, map_stretches, outcome)
    except (ArithmeticError, IndexError, ValueError, np.linalg.LinAlgError) as error:
        # a fault of the program on this camera's data: the others are calibrated all the same
        where = traceback.extract_tb(error.__traceback__)[-1]
        what = f"{type(error).__name__}: {error} ({Path(where.filename).name}:{where.lineno})"
        outcome = CameraOutcome(name, f"{name}: a fault of the program, please report it: {what}")
    outcome = replace(outcome, seconds=time.perf_counter() - started)
    write_text_atomic(
        outcome_file(job.out, name), json.dumps(plain(asdict(outcome)), indent=1, allow_nan=False) + "\n"
    )
    return outcome


def _once_more(
    job: CameraJob, report_stage: StageProgress, map_stretches: MapStretches, failed: CameraOutcome
) -> CameraOutcome:
    """What the images show without the IMU's horizon, which mirrored pictures put the wrong way up."""
    try:
        return replace(_process(job, report_stage, map_stretches, horizon=False), without_horizon=True)
    except RigwakeError:
        return failed


def _process(
    job: CameraJob, report_stage: StageProgress, map_stretches: MapStretches, *, horizon: bool = True
) -> CameraOutcome:
    stream, config = job.stream, job.config
    assert stream.model is not None

    def progress(stage: str, done: int, total: int) -> None:
        report_stage(stage, done / max(total, 1))

    measured = measure_camera(
        stream,
        job.imu,
        config.tracking,
        progress,
        hull=config.find_self_mask,
        horizon=config.horizon if horizon else "off",
        turns=job.turns,
        track=track_camera
        if config.stretch_s is None
        else partial(track_in_stretches, stretch_s=config.stretch_s, map_stretches=map_stretches),
    )
    measured.mask.save(job.out / "masks", stream.name)
    if measured.mask.excluded.get("hull", np.zeros(1, dtype=bool)).any():
        save_hull_picture(stream, job.out / "masks")
    tracks = measured.tracks
    tracks.save(tracks_file(job.out, stream.name))
    counts: dict[str, Any] = {"tracking": asdict(tracks.report) if tracks.report else {}}
    if job.odometry:
        result = estimate_monocular(
            tracks,
            stream.model,
            replace(config.odometry, seed=config.seed),
            rotations=measured.rotations,
            progress=lambda done: progress("odometry", done, len(stream)),
        )
        write_tum(result.trajectory, odometry_file(job.out, stream.name))
        counts["odometry"] = asdict(result.counts)
    notes = (*measured.notes, *frames_not_tracked(tracks))
    return CameraOutcome(stream.name, None, notes=notes, counts=counts)
