"""One recording of a fleet: worked on aside, put in place when whole; what went wrong becomes words."""

from __future__ import annotations

import contextlib
import errno
import hashlib
import json
import math
import shutil
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from rigwake import __version__
from rigwake._progress import Progress
from rigwake.atomic import write_text_atomic
from rigwake.calibration import Calibration, load_calibration
from rigwake.config import CalibrateConfig
from rigwake.errors import EstimationError, HostError, InputError, RigwakeError, UnobservableError, UsageError
from rigwake.fingerprint import input_fingerprint
from rigwake.fleet.fleet_jobs import (
    NOT_OBSERVABLE,
    OUT_OF_MEMORY,
    FleetJob,
    FleetOutcome,
    failure,
    outcome_of,
)
from rigwake.fleet.resume import OUTCOME, read_outcome, renew_outcome, result_in_place, store_outcome
from rigwake.host_faults import words_of
from rigwake.pipeline.calibration_run import calibrate
from rigwake.pipeline.out_folder import used_by_one
from rigwake.readers.open import open_recording
from rigwake.readers.topics import TopicMap
from rigwake.recording import Recording

TOKEN = ".fleet-token"
_LOOK_EVERY_S = 0.5
_BAGS = (".bag", ".mcap", ".db3")
_DISK = {errno.ENOSPC: "disk full", errno.EDQUOT: "disk full", errno.EROFS: "read-only disk"}


def _silent(name: str, what: str, fraction: float) -> None:
    """Progress that nobody asked for."""


def run_one(job: FleetJob, progress: Progress = _silent) -> FleetOutcome:
    """Do the job; every error becomes an outcome. Writes nothing outside of the job's two folders.

    The result appears in `job.result_folder` when it is whole. A failure of the recording is kept there as well; one of
    the computer (disk, permissions) is not, so that the next run tries again.
    """
    begun = time.monotonic()
    try:
        check_machine(job)
        outcome = _worked(job, progress, begun)
    except Exception as fault:
        outcome = outcome_of_fault(job, fault)
    return outcome if outcome.seconds else replace(outcome, seconds=_since(begun))


def _since(begun: float) -> float:
    return round(time.monotonic() - begun, 3)


def check_machine(job: FleetJob) -> None:
    """Raises HostError where this program is another version or OUT is another folder than the client's."""
    if job.version != __version__:
        raise HostError(
            f"This worker runs rigwake {__version__}, the client {job.version}.",
            consequence="Results of two versions would be mixed; nothing was computed.",
            remedy="Install the same version on all machines and start the workers again.",
        )
    if not job.token:
        return
    try:
        seen = (Path(job.out) / TOKEN).read_text(encoding="ascii")
    except (OSError, UnicodeDecodeError):
        seen = ""
    if seen != job.token:
        raise HostError(
            f"{job.out} on this worker is not the folder of the client.",
            consequence="Results written here would be lost.",
            remedy="Give as --out a folder that all machines share under the same path.",
        )


def _worked(job: FleetJob, progress: Progress, begun: float) -> FleetOutcome:
    progress(job.name, "reading", 0.0)
    if not Path(job.recording).exists():
        raise FileNotFoundError(errno.ENOENT, "No such file", job.recording)
    content = input_fingerprint(Path(job.recording))["sha256"]
    key = hashlib.sha256(f"{content} {job.choices}".encode()).hexdigest()
    with _used_when_free(job):
        former = read_outcome(job.result_folder)
        if former is not None and former.key == key and former.recording == job.recording:
            same = replace(former, changed_at=job.changed_at, vessel=job.vessel)
            renew_outcome(job, same)
            return same
        try:
            done = replace(
                _WORK[job.verb](job, job.working_folder / "result", progress), key=key, seconds=_since(begun)
            )
        except Exception as fault:
            outcome = replace(outcome_of_fault(job, fault), key=key, seconds=_since(begun))
            if outcome.stored:
                shutil.rmtree(job.working_folder / "result", ignore_errors=True)
                store_outcome(job, outcome)
            return outcome
        with result_in_place(job, job.working_folder / "result") as folder:
            write_text_atomic(folder / OUTCOME, done.to_json() + "\n")
        return done


@contextmanager
def _used_when_free(job: FleetJob) -> Iterator[None]:
    """Wait until nobody else works on this recording, as a worker that was given up may; then keep others out."""
    with ExitStack() as held:
        while True:
            try:
                held.enter_context(used_by_one(job.working_folder))
                break
            except UsageError as error:
                if not isinstance(error.__cause__, BlockingIOError):
                    raise
                time.sleep(_LOOK_EVERY_S)
        yield
    with contextlib.suppress(OSError):
        job.working_folder.rmdir()


def _calibrated(job: FleetJob, folder: Path, progress: Progress) -> FleetOutcome:
    settings = CalibrateConfig.model_validate(json.loads(job.settings)).model_copy(update={"jobs": 1})
    topics = topics_of(job)
    run = calibrate(job.recording, folder, settings, topics=topics, resume=True, progress=progress)
    started, duration = _span(open_recording(job.recording, topics))
    missing = tuple(f"{name} is not calibrated: {why}" for name, why in run.failed.items())
    return outcome_of(
        job,
        "calibrated",
        started_ns=started,
        duration_s=duration,
        reference=run.calibration.reference,
        cameras=camera_rows(run.calibration),
        notes=(*missing, *run.notes),
    )


def camera_rows(calibration: Calibration) -> dict[str, dict[str, Any]]:
    """Mounting and uncertainty of every camera as plain values; None where unobservable."""
    rows: dict[str, dict[str, Any]] = {}
    for name, camera in calibration.cameras.items():
        rotation = camera.rig_from_cam.rotation
        known = bool(np.isfinite(rotation).all())
        rows[name] = {
            "quat_wxyz": _numbers(camera.rig_from_cam.quat_wxyz) if known else [None] * 4,
            "translation_m": _numbers(camera.rig_from_cam.translation),
            "std_rotation_deg": _numbers(camera.std_rotation_deg),
            "std_translation_m": _numbers(camera.std_translation_m),
            "time_offset_s": camera.time_offset_s,
        }
    return rows


def _numbers(values: Any) -> list[float | None]:
    return [float(v) if math.isfinite(v) else None for v in np.asarray(values, dtype=np.float64)]


def _monitored(job: FleetJob, folder: Path, progress: Progress) -> FleetOutcome:
    from rigwake.monitor.monitor_report import result_to_dict
    from rigwake.monitor.run import monitor

    recording = open_recording(job.recording, topics_of(job))
    result = monitor(load_calibration(job.calibration), recording, progress)
    folder.mkdir(parents=True, exist_ok=True)
    write_text_atomic(folder / "monitor.json", json.dumps(result_to_dict(result), indent=2, allow_nan=False))
    started, duration = _span(recording)
    cameras = {name: _verdict_row(verdict) for name, verdict in result.verdicts.items()}
    states = {row["state"] for row in cameras.values()}
    status = "suspect" if "SUSPECT" in states else "ok" if states - {"UNOBSERVABLE"} else NOT_OBSERVABLE
    return outcome_of(
        job,
        "drifted" if result.exit_code == 5 else status,
        started_ns=started,
        duration_s=duration,
        cameras=cameras,
        notes=tuple(result.notes),
    )


def _verdict_row(verdict: Any) -> dict[str, Any]:
    return {
        "state": str(verdict.state),
        "words": verdict.words,
        "size_deg": verdict.size_deg,
        "size_std_deg": verdict.size_std_deg,
    }


_WORK = {"calibrate": _calibrated, "monitor": _monitored}


def topics_of(job: FleetJob) -> TopicMap:
    """The choice of topics that travels with the job."""
    return TopicMap(MappingProxyType(json.loads(job.topics)))


def _span(recording: Recording) -> tuple[int | None, float | None]:
    """First stamp and length in seconds of the images."""
    stamps = [camera.timestamps_ns for camera in recording.cameras.values() if len(camera)]
    if not stamps:
        return None, None
    first, last = min(int(s[0]) for s in stamps), max(int(s[-1]) for s in stamps)
    return first, (last - first) * 1e-9


def outcome_of_fault(job: FleetJob, fault: BaseException) -> FleetOutcome:
    """The error as an outcome: its group, the words that a person would have seen, and whether to try again."""
    error = words_of(fault)
    if isinstance(error, UnobservableError):
        if _is_bag(job) and bag_is_cut_off(Path(job.recording), topics_of(job)):
            return failure(job, "truncated bag", f"The bag is cut off. {error}", stored=True)
        return outcome_of(job, NOT_OBSERVABLE, cause="not observable", message=str(error))
    cause, stored = _cause(job, fault, error)
    return failure(job, cause, str(error), stored=stored)


def _cause(job: FleetJob, fault: BaseException, error: RigwakeError) -> tuple[str, bool]:
    """A few words that group failures, and whether the recording would fail again."""
    for behind in (fault, fault.__cause__):
        if isinstance(behind, OSError):
            if behind.errno in _DISK:
                return _DISK[behind.errno], False
            if isinstance(behind, FileNotFoundError):
                return "missing path", False
            if isinstance(behind, PermissionError):
                return "unreadable path", False
    if isinstance(fault, MemoryError) or "No memory is left" in error.cause:
        return OUT_OF_MEMORY, True
    if isinstance(error, HostError):
        return "computer", False
    if isinstance(error, InputError):
        return _cause_of_input(job, error), True
    if isinstance(error, EstimationError):
        return "no trustworthy result", True
    if isinstance(error, UsageError):
        return "settings do not fit", True
    return "unexpected error", True


def _cause_of_input(job: FleetJob, error: InputError) -> str:
    if _is_bag(job) and bag_is_cut_off(Path(job.recording), topics_of(job)):
        return "truncated bag"
    if "is not a recording" in error.cause:
        return "not a recording"
    if "while it was read" in error.cause:
        return "changed while read"
    return "damaged bag" if "damaged" in error.cause else "unusable recording"


def _is_bag(job: FleetJob) -> bool:
    return Path(job.recording).suffix in _BAGS


def bag_is_cut_off(path: Path, topics: TopicMap) -> bool:
    """Whether the reader finds the bag cut off, or nothing in it."""
    try:
        found = open_recording(path, topics).findings
    except RigwakeError as error:
        return "cut off" in str(error)
    return any("cut off" in finding.message for finding in found)
