"""`calibrate`: the whole way from a recording to a rig."""

from __future__ import annotations

import platform
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from importlib.metadata import version
from pathlib import Path
from typing import Any

from numpy.linalg import LinAlgError

from rigwake import __version__
from rigwake._progress import Progress
from rigwake.ba.rig.rig_values import InitialRig
from rigwake.calibration import Calibration, save_calibration
from rigwake.config import CalibrateConfig
from rigwake.errors import InputError, RigwakeError, UnobservableError
from rigwake.fingerprint import files_changed_at, input_fingerprint, unchanged
from rigwake.monitor.knocks import knocks_inside
from rigwake.pipeline.before_start import (
    check_fields_of_view,
    check_line_delays,
    check_prior,
    check_reference,
    read_external_trajectories,
    without_cameras,
)
from rigwake.pipeline.camera_key import camera_key
from rigwake.pipeline.camera_processes import CameraRunner, process_cameras
from rigwake.pipeline.camera_stage import (
    CameraJob,
    CameraOutcome,
    load_outcome,
    odometry_file,
    stage_files,
    tracks_file,
)
from rigwake.pipeline.lens_finding import FoundLens, find_lenses
from rigwake.pipeline.out_folder import check_camera_names, check_out_folder, clear_results, used_by_one
from rigwake.pipeline.outputs import write_outputs
from rigwake.pipeline.prior import RigPrior
from rigwake.pipeline.section_stage import with_chosen_sections
from rigwake.pipeline.sensor_checks import vet_imu
from rigwake.pipeline.stage_files import StageLedger
from rigwake.pipeline.stream_selection import Selection, select
from rigwake.pipeline.vetted_rig import VettedRig, estimate_vetted_rig
from rigwake.plausibility.values import SensorCheck, checks_to_list
from rigwake.readers.open import open_recording
from rigwake.readers.topics import TopicMap
from rigwake.readers.trajectories import read_trajectory
from rigwake.recording import Recording
from rigwake.report import build_report, load_report_content
from rigwake.sections.section_words import plan_to_dict
from rigwake.tracks import Tracks, load_tracks
from rigwake.trajectory import Trajectory

_MOVED_PX = 0.5  # worth a word
_NOISY_IMU = 2.0  # times its assumed value: worth a word
_LIBRARIES = ("numpy", "scipy", "numba", "opencv-contrib-python-headless", "poselib", "rosbags")


@dataclass(frozen=True, eq=False)
class CalibrationRun:
    """A calibration and how it came about. failed: cameras that are not in it, and why."""

    calibration: Calibration
    out: Path
    failed: Mapping[str, str] = field(default_factory=dict)
    notes: tuple[str, ...] = ()
    sensor_checks: tuple[SensorCheck, ...] = ()

    @property
    def is_partial(self) -> bool:
        """Whether a camera or another sensor had to be left out."""
        return bool(self.failed) or any(check.action == "left out" for check in self.sensor_checks)


def _silent(name: str, what: str, fraction: float) -> None:
    """Progress that nobody asked for."""


@dataclass(frozen=True, eq=False)
class _Prepared:
    """What a calibration starts with, everything checked. external: trajectories of another odometry, if given.
    sections: what was chosen of a long recording, and why; empty where all is used. found: lenses from the motion."""

    path: Path
    opened: Recording
    selection: Selection
    external: Mapping[str, Trajectory] | None
    prior: RigPrior
    config: CalibrateConfig
    sections: Mapping[str, Any] = field(default_factory=dict)
    found: Mapping[str, FoundLens] = field(default_factory=dict)


def calibrate(
    recording: Path | str,
    out: Path | str,
    config: CalibrateConfig | None = None,
    *,
    topics: TopicMap | None = None,
    trajectories: Path | str | None = None,
    prior: RigPrior | None = None,
    resume: bool = False,
    force: bool = False,
    progress: Progress = _silent,
    run_cameras: CameraRunner = process_cameras,
) -> CalibrationRun:
    """Find where every camera of a recording sits and looks.

    out: folder for `calibration.yaml` and what the stages leave; see docs/calibrate.md. trajectories: a folder of
    `CAMERA.tum` made by another odometry. prior: what is known beforehand. resume: keep finished stages. force:
    replace the result of another run. run_cameras: where the camera stage runs, by default in processes here.

    Raises InputError (the recording), UsageError (the settings, or a folder that holds another result or is in use),
    UnobservableError (the motion cannot tell), EstimationError (it should, but no trustworthy answer was found),
    HostError (a process was ended from outside). Cameras that fail are left out and named.
    """
    path, out, external = Path(recording), Path(out), None if trajectories is None else Path(trajectories)
    check_out_folder(out, [path], force=force, resume=resume)
    with unchanged(path) as check_unchanged:
        prepared = _prepare(path, config or CalibrateConfig(), topics, external, prior or RigPrior())
        with used_by_one(out):
            if force:
                clear_results(out, everything=True)
            identity = input_fingerprint(path)
            provenance = _provenance(identity, prepared, topics, external)
            ledger = StageLedger(out, resume=resume)
            prepared = _with_sections(_with_found_lenses(prepared, progress), progress)
            selection, outcomes, checks = _each_camera(prepared, out, ledger, identity, progress, run_cameras)
            check_unchanged()
            estimated = _estimate(prepared, out, selection, outcomes, progress)
            check_unchanged()
            return _conclude(prepared, out, outcomes, checks, estimated, provenance, progress)


def _prepare(
    path: Path, config: CalibrateConfig, topics: TopicMap | None, external: Path | None, prior: RigPrior
) -> _Prepared:
    """Open the recording and check all that can be checked before an image is read."""
    opened = open_recording(path, topics)
    selection = select(opened, config)
    check_camera_names(selection.cameras)
    check_reference(opened, selection, config.reference)
    check_prior(prior, selection)
    check_line_delays(config, selection)
    check_fields_of_view(config, selection)
    given = None if external is None else read_external_trajectories(external, selection)
    return _Prepared(path, opened, selection, given, prior, config)


def _with_found_lenses(prepared: _Prepared, progress: Progress) -> _Prepared:
    """With `--intrinsics find`: lenses from the motion. Where none was given, it is that of the field of view."""
    if prepared.config.intrinsics != "find":
        return prepared
    lenses = find_lenses(prepared.selection, prepared.config, progress)
    cameras = {
        name: stream
        if stream.model is not None or name not in lenses.found
        # it is with this that the report compares
        else replace(stream, model=lenses.found[name].start)
        for name, stream in prepared.opened.cameras.items()
    }
    opened = replace(prepared.opened, cameras=cameras)
    return replace(prepared, opened=opened, selection=lenses.selection, found=lenses.found)


def _with_sections(prepared: _Prepared, progress: Progress) -> _Prepared:
    """Only the sections of a long recording that are worth their time; nothing else is read."""

    def tell(words: str, done: int, total: int) -> None:
        progress("rig", f"choosing sections: {words}", 0.0)

    selection, plan = with_chosen_sections(prepared.selection, prepared.config, tell)
    return replace(prepared, selection=selection, sections={} if plan is None else plan_to_dict(plan))


def _estimate(
    prepared: _Prepared, out: Path, selection: Selection, outcomes: list[CameraOutcome], progress: Progress
) -> VettedRig:
    """Initial values and the rig, of the cameras that did not fail and the sensors that agree."""
    working = _working(outcomes)
    own = _trajectories(working, out, prepared.external)
    missing = prepared.selection.cameras.keys() - own.keys()
    found = estimate_vetted_rig(
        prepared.opened,
        selection,
        {name: load_tracks(tracks_file(out, name)) for name in working},
        own,
        prepared.config,
        without_cameras(prepared.prior, missing),
        masks=out / "masks",
        external=prepared.external is not None,
        without_horizon=frozenset(o.name for o in outcomes if o.without_horizon),
        guessed=frozenset(prepared.found),
        progress=lambda words, fraction: progress("rig", words, fraction),
    )
    save_calibration(found.first.handeye, out / "initial_rig.yaml")
    return found


def _conclude(
    prepared: _Prepared,
    out: Path,
    outcomes: list[CameraOutcome],
    checks: tuple[SensorCheck, ...],
    estimated: VettedRig,
    provenance: dict[str, Any],
    progress: Progress,
) -> CalibrationRun:
    """Everything that is known of the result, written."""
    vetted, first, rig = estimated.vetted, estimated.first, estimated.rig
    selection, checks = vetted.selection, (*checks, *vetted.checks, *rig.sensor_checks)
    failed = _left_out(prepared, outcomes, estimated.own, first, rig.calibration) | {
        name.removeprefix("camera "): why
        for name, why in vetted.left_out.items()
        if name.startswith("camera ")
    }
    notes = (*selection.notes, *(f"{o.name}: {n}" for o in outcomes for n in o.notes), *first.notes)
    notes += _noisy_imu(rig.calibration) + _moved_intrinsics(rig.calibration)
    notes += _knocks(prepared.opened, rig.calibration, selection, estimated.tracks)
    calibration = replace(
        rig.calibration,
        checks={
            **rig.calibration.checks,
            "failed_cameras": failed,
            "sensor_checks": checks_to_list(checks),
            "notes": list(notes),
            **({"sections": dict(prepared.sections)} if prepared.sections else {}),
        },
        provenance={**provenance, "leader": first.reference_camera},
    )
    write_outputs(out, calibration, rig.adjusted, first, selection, rig.matches)
    progress("rig", "writing the report", 0.95)
    build_report(load_report_content(out))
    return CalibrationRun(calibration, out, failed, notes, checks)


def _knocks(
    recording: Recording, calibration: Calibration, selection: Selection, tracks: Mapping[str, Tracks]
) -> tuple[str, ...]:
    """What the monitor's statistic says of cameras that turned during the recording; nothing without IMU or tracks."""
    own = {name: tracks[name] for name in calibration.cameras if name in tracks}
    if selection.imu is None or len(own) < max(2, len(calibration.cameras)):
        return ()
    opened = replace(
        recording,
        cameras={**recording.cameras, **selection.cameras},
        imus={selection.imu.name: selection.imu},
        gnss={} if selection.gnss is None else {selection.gnss.name: selection.gnss},
    )
    try:
        return knocks_inside(calibration, opened, own)
    except (RigwakeError, LinAlgError) as error:  # the result is not written yet: nothing here may cost it
        why = getattr(error, "cause", "its tracks tell too little.")
        return (f"Whether a camera moved during the recording was not checked: {why}",)


def _each_camera(
    prepared: _Prepared,
    out: Path,
    ledger: StageLedger,
    identity: Mapping[str, Any],
    progress: Progress,
    run_cameras: CameraRunner,
) -> tuple[Selection, list[CameraOutcome], tuple[SensorCheck, ...]]:
    """Mask, tracks and odometry of every camera; those that a former run finished are read from its files.

    Before, the IMU is compared with the cameras' coarse rotations: a wrong one would spoil what follows.
    """
    selection, config, odometry = prepared.selection, prepared.config, prepared.external is None
    checks: tuple[SensorCheck, ...] = ()
    changed_at = files_changed_at(prepared.path)
    keys = {
        name: camera_key(stream, selection.imu, config, odometry, identity, changed_at)
        for name, stream in selection.cameras.items()
    }
    outcomes: dict[str, CameraOutcome] = {}
    jobs = []
    turns: Mapping[str, Trajectory] = {}
    if config.sensor_checks:
        fresh = tuple(
            name
            for name in selection.cameras
            if not ledger.is_done(f"camera {name}", keys[name], tracks_file(out, name))
        )
        progress("rig", "comparing the IMU with the cameras' turns", 0.0)
        vetted = vet_imu(selection, fresh or tuple(selection.cameras)[:1], repair=config.repair)
        selection, checks, turns = vetted.selection, vetted.checks, vetted.turns
    for name, stream in selection.cameras.items():
        if ledger.is_done(f"camera {name}", keys[name], *stage_files(out, name, odometry=odometry)):
            outcomes[name] = load_outcome(out, name)
            progress(name, "taken from the former run", 1.0)
        else:
            jobs.append(CameraJob(stream, selection.imu, out, config, odometry, turns.get(name)))

    def finished(outcome: CameraOutcome) -> None:
        outcomes[outcome.name] = outcome
        if outcome.failed is None:
            files = stage_files(out, outcome.name, odometry=odometry)
            ledger.done(f"camera {outcome.name}", keys[outcome.name], *files)

    if jobs:
        clear_results(out, everything=False)
        run_cameras(jobs, config.jobs, progress, finished)
    return selection, [outcomes[name] for name in selection.cameras], checks


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


def _trajectories(
    working: list[str], out: Path, external: Mapping[str, Trajectory] | None
) -> dict[str, Trajectory]:
    """By camera: of our own odometry, or of another's. Raises InputError if none is left."""
    if external is None:
        return {name: read_trajectory(odometry_file(out, name)).trajectory for name in working}
    found = {name: external[name] for name in working if name in external}
    if not found:
        raise InputError(
            "No camera that could be tracked has a trajectory of another odometry.",
            remedy=f"Name the files {', '.join(f'{name}.tum' for name in working)}.",
        )
    return found


def _left_out(
    prepared: _Prepared,
    outcomes: list[CameraOutcome],
    own: Mapping[str, Trajectory],
    first: InitialRig,
    calibration: Calibration,
) -> dict[str, str]:
    """Cameras that are wanted but not in the result, and why."""
    reasons = dict(prepared.selection.left_out)
    reasons |= {o.name: o.failed for o in outcomes if o.failed is not None} | dict(first.failed)
    for name in prepared.config.cameras or prepared.opened.cameras:
        if name not in calibration.cameras:
            lacks = prepared.external is not None and name not in own
            reasons.setdefault(name, "it has no trajectory" if lacks else "nothing ties it to the others")
    return {name: why for name, why in reasons.items() if name not in calibration.cameras}


def _noisy_imu(calibration: Calibration) -> tuple[str, ...]:
    """Words about an IMU whose residuals are far beyond its noise densities."""
    return tuple(
        f"imu: {sensor} noise {factor:.1f} times what was assumed (vibration, a loose mount, or wrong densities); "
        "the deviations count it"
        for sensor, factor in calibration.checks.get("imu_noise_factors", {}).items()
        if factor > _NOISY_IMU
    )


def _moved_intrinsics(calibration: Calibration) -> tuple[str, ...]:
    """Words about intrinsics that were refined by more than a little, and what the motion did not tell of them."""
    words = []
    for name, camera in calibration.cameras.items():
        found = camera.statistics.get("intrinsics")
        if not found:
            continue
        if (found["moved_rms_px"] or 0.0) > _MOVED_PX:
            words.append(
                f"{name}: the intrinsics given were refined, by {found['moved_rms_px']:.1f} px (RMS)"
            )
        if found["not_determined"]:
            names = ", ".join(found["not_determined"])
            words.append(
                f"{name}: intrinsics that the motion does not tell one by one: {names}; {found['remedy']}"
            )
    return tuple(words)


def _provenance(
    identity: Mapping[str, Any], prepared: _Prepared, topics: TopicMap | None, external: Path | None
) -> dict[str, Any]:
    used = prepared.external or {}
    return {
        "rigwake": __version__,
        "python": platform.python_version(),
        "libraries": {name: version(name) for name in _LIBRARIES},
        "inputs": [dict(identity)],
        "topics": {role: dict(names) for role, names in topics.roles.items()} if topics is not None else {},
        "prior": dict(prepared.prior.origin),
        "trajectories": {name: input_fingerprint(external / f"{name}.tum") for name in used}
        if external
        else {},
        "settings": prepared.config.model_dump(mode="json"),
    }
