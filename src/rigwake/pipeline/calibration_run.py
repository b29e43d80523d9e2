"""`calibrate`: the whole way from a recording to a rig."""

from __future__ import annotations

import platform
from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from importlib.metadata import version
from pathlib import Path
from typing import Any

from rigwake import __version__
from rigwake.ba.rig.initialisation import InitialRig
from rigwake.calibration import Calibration, save_calibration
from rigwake.config import CalibrateConfig
from rigwake.errors import InputError, UnobservableError
from rigwake.fingerprint import input_fingerprint
from rigwake.pipeline.camera_processes import Progress, process_cameras
from rigwake.pipeline.camera_stage import (
    CameraJob,
    CameraOutcome,
    load_outcome,
    odometry_file,
    outcome_file,
    tracks_file,
)
from rigwake.pipeline.outputs import write_outputs
from rigwake.pipeline.prior import RigPrior
from rigwake.pipeline.rig_stage import estimate_rig, initialise_rig
from rigwake.pipeline.stage_files import StageLedger, stage_key
from rigwake.pipeline.stream_selection import Selection, select
from rigwake.readers.open import open_recording
from rigwake.readers.topics import TopicMap
from rigwake.readers.trajectories import read_trajectory
from rigwake.report import build_report, load_report_content
from rigwake.tracks import load_tracks
from rigwake.trajectory import Trajectory

_NOISY_IMU = 2.0  # times its assumed value: worth a word
_LIBRARIES = ("numpy", "scipy", "numba", "opencv-contrib-python-headless", "poselib", "rosbags")


@dataclass(frozen=True, eq=False)
class CalibrationRun:
    """A calibration and how it came about. failed: cameras that are not in it, and why."""

    calibration: Calibration
    out: Path
    failed: Mapping[str, str] = field(default_factory=dict)
    notes: tuple[str, ...] = ()


def _silent(name: str, what: str, fraction: float) -> None:
    """Progress that nobody asked for."""


def calibrate(
    recording: Path | str,
    out: Path | str,
    config: CalibrateConfig | None = None,
    *,
    topics: TopicMap | None = None,
    trajectories: Path | str | None = None,
    prior: RigPrior | None = None,
    resume: bool = False,
    progress: Progress = _silent,
) -> CalibrationRun:
    """Find where every camera of a recording sits and looks.

    out: folder for `calibration.yaml` and what the stages leave; see docs/calibrate.md. trajectories: a folder of
    `CAMERA.tum` made by another odometry. prior: what is known beforehand. resume: keep finished stages.

    Raises InputError (the recording), UsageError (the settings), UnobservableError (the motion cannot tell),
    EstimationError (it should, but no trustworthy answer was found). Cameras that fail are left out and named.
    """
    config, prior, out = config or CalibrateConfig(), prior or RigPrior(), Path(out)
    opened = open_recording(recording, topics)
    selection = select(opened, config)
    ledger = StageLedger(out, resume=resume)
    outcomes = _each_camera(selection, Path(recording), out, config, ledger, trajectories is None, progress)
    working = _working(outcomes)
    tracks = {name: load_tracks(tracks_file(out, name)) for name in working}
    first = initialise_rig(selection, _trajectories(working, out, trajectories), config, prior)
    save_calibration(first.handeye, out / "initial_rig.yaml")
    rig = estimate_rig(
        opened,
        selection,
        tracks,
        first,
        config,
        prior,
        masks=out / "masks",
        progress=lambda words, fraction: progress("rig", words, fraction),
    )
    failed = {o.name: o.failed for o in outcomes if o.failed is not None} | dict(first.failed)
    notes = (*selection.notes, *(f"{o.name}: {n}" for o in outcomes for n in o.notes), *first.notes)
    notes += _noisy_imu(rig.calibration)
    calibration = replace(
        rig.calibration,
        checks={**rig.calibration.checks, "failed_cameras": failed, "notes": list(notes)},
        provenance=_provenance(Path(recording), config, first),
    )
    write_outputs(out, calibration, rig.adjusted, first, selection, rig.matches)
    progress("rig", "writing the report", 0.95)
    build_report(load_report_content(out))
    return CalibrationRun(calibration, out, failed, notes)


def _each_camera(
    selection: Selection,
    recording: Path,
    out: Path,
    config: CalibrateConfig,
    ledger: StageLedger,
    odometry: bool,
    progress: Progress,
) -> list[CameraOutcome]:
    """Mask, tracks and odometry of every camera; those that a former run finished are read from its files."""
    settings = config.model_dump(
        include={"tracking", "odometry", "find_self_mask", "seed", "start_s", "duration_s", "imu"}
    )
    input_hash = input_fingerprint(recording)
    # what another version left may lack what this one reads
    written = [__version__, *(part.name for part in fields(CameraOutcome))]
    keys = {name: stage_key(input_hash, name, settings, odometry, written) for name in selection.cameras}
    outcomes: dict[str, CameraOutcome] = {}
    jobs = []
    for name, stream in selection.cameras.items():
        files = [outcome_file(out, name), tracks_file(out, name)] + (
            [odometry_file(out, name)] if odometry else []
        )
        if ledger.is_done(f"camera {name}", keys[name], *files):
            outcomes[name] = load_outcome(out, name)
            progress(name, "taken from the former run", 1.0)
        else:
            jobs.append(CameraJob(stream, selection.imu, out, config, odometry))
    for outcome in process_cameras(jobs, config.jobs, progress) if jobs else ():
        outcomes[outcome.name] = outcome
        if outcome.failed is None:
            ledger.done(f"camera {outcome.name}", keys[outcome.name])
    return [outcomes[name] for name in selection.cameras]


def _working(outcomes: list[CameraOutcome]) -> list[str]:
    """Cameras that did not fail; raises if none is left."""
    working = [o.name for o in outcomes if o.failed is None]
    if working:
        return working
    reasons = " ".join(f"{o.name}: {(o.failed or '').removeprefix(f'{o.name}: ')}" for o in outcomes)
    raise UnobservableError(
        f"No camera's motion could be estimated. {reasons}",
        remedy="Record land with texture in view, while the vessel moves and turns; see `rigwake inspect`.",
    )


def _trajectories(working: list[str], out: Path, external: Path | str | None) -> dict[str, Trajectory]:
    """By camera: of our own odometry, or from a folder of another's."""
    if external is None:
        return {name: read_trajectory(odometry_file(out, name)).trajectory for name in working}
    folder = Path(external)
    found = {
        name: read_trajectory(path, name=name).trajectory
        for name in working
        for path in [folder / f"{name}.tum"]
        if path.is_file()
    }
    if not found:
        raise InputError(
            f"{folder} holds no trajectory of any camera.",
            remedy=f"Name the files {', '.join(f'{name}.tum' for name in working)}.",
        )
    return found


def _noisy_imu(calibration: Calibration) -> tuple[str, ...]:
    """Words about an IMU whose residuals are far beyond its noise densities."""
    return tuple(
        f"imu: {sensor} noise {factor:.1f} times what was assumed (vibration, a loose mount, or wrong densities); "
        "the deviations count it"
        for sensor, factor in calibration.checks.get("imu_noise_factors", {}).items()
        if factor > _NOISY_IMU
    )


def _provenance(recording: Path, config: CalibrateConfig, first: InitialRig) -> dict[str, Any]:
    return {
        "rigwake": __version__,
        "python": platform.python_version(),
        "libraries": {name: version(name) for name in _LIBRARIES},
        "inputs": [input_fingerprint(recording)],
        "settings": config.model_dump(mode="json"),
        "leader": first.reference_camera,
    }
