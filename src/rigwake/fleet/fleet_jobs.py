"""What is to be done with one recording, and what came of it. Both are plain values that travel as JSON."""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields, replace
from pathlib import Path
from typing import Any

from rigwake import __version__
from rigwake.errors import InputError

DEFAULT_WORK = "rigwake.fleet.run_one:run_one"
RESULTS, WORKING = "recordings", ".work"
_LONGEST_STEM = 60

# statuses
DONE = ("calibrated", "ok", "drifted", "suspect")  # a result was written
NOT_OBSERVABLE = "not observable"
FAILED = "failed"

# causes of failures that whoever watches over the work finds out
TIME_OUT, OUT_OF_MEMORY, KILLED = "time-out", "out of memory", "killed"


@dataclass(frozen=True)
class FleetJob:
    """One recording and what to do with it.

    recording, out, calibration: absolute paths, the same on every machine. vessel: whose recording it is. verb:
    `calibrate` or `monitor`. settings: JSON of the settings, topics: JSON of role -> name -> topic. inputs_sha256: of
    other files that the result depends on (the calibration to be monitored). changed_at: hash of names, sizes and
    times of the recording's files. token: what OUT holds, so that a worker can tell that it is the same folder.
    timeout_s, memory_bytes: limits of this one job (None: none). work: `module:function` of what is called with the job
    and a progress callback.
    """

    recording: str
    out: str
    vessel: str = ""
    verb: str = "calibrate"
    settings: str = "{}"
    topics: str = "{}"
    calibration: str = ""
    inputs_sha256: str = ""
    changed_at: str = ""
    token: str = ""
    timeout_s: float | None = None
    memory_bytes: int | None = None
    version: str = __version__
    work: str = DEFAULT_WORK

    @property
    def name(self) -> str:
        """Name of the result's folder: the recording's name, and what tells it from others of that name."""
        return job_name(self.recording)

    @property
    def choices(self) -> str:
        """Hash of all that the result depends on but the recording itself."""
        words = (self.verb, self.settings, self.topics, self.inputs_sha256, self.version, self.work)
        return hashlib.sha256(json.dumps(words).encode()).hexdigest()

    @property
    def result_folder(self) -> Path:
        """Where the result is found when it is done."""
        return Path(self.out) / RESULTS / self.name

    @property
    def working_folder(self) -> Path:
        """Where it is made; used by one process at a time."""
        return Path(self.out) / WORKING / self.name

    def to_json(self) -> str:
        """One line."""
        return json.dumps(asdict(self))

    @classmethod
    def from_json(cls, line: str) -> FleetJob:
        """The inverse of `to_json`."""
        return cls(**json.loads(line))


def job_name(recording: str) -> str:
    """`harbour-1f2e3d4c` for `/boats/a/harbour.bag`."""
    stem = re.sub(r"[^A-Za-z0-9_.]+", "_", Path(recording).stem)[:_LONGEST_STEM].lstrip(".") or "recording"
    return f"{stem}-{_digest(recording)[:8]}"


def shard_of(recording: str, count: int) -> int:
    """Which of so many shards (from 1) does this recording: the same however the list changes."""
    return int(_digest(recording)[8:24], 16) % count + 1


def _digest(text: str) -> str:
    return hashlib.sha256(text.encode(errors="surrogateescape")).hexdigest()


@dataclass(frozen=True)
class FleetOutcome:
    """What came of one recording.

    status: `calibrated`, `ok`, `drifted`, `suspect` (monitor), `not observable`, `failed`. cause: of a failure, a few
    words that group failures. message: what a person would have seen. key: hash of content, settings and version.
    stored: whether it is kept so that the recording is not worked on again. started_ns, duration_s: of the recording.
    cameras: plain values by camera. seconds: of work. attempts: how often it was begun.
    """

    name: str
    recording: str
    status: str
    vessel: str = ""
    verb: str = "calibrate"
    cause: str = ""
    message: str = ""
    key: str = ""
    choices: str = ""
    changed_at: str = ""
    stored: bool = True
    started_ns: int | None = None
    duration_s: float | None = None
    reference: str = ""
    cameras: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    notes: tuple[str, ...] = ()
    seconds: float = 0.0
    attempts: int = 1

    @property
    def is_done(self) -> bool:
        """Whether there is a result."""
        return self.status in DONE

    def to_json(self) -> str:
        """One line."""
        return json.dumps(asdict(self), allow_nan=False)

    @classmethod
    def from_json(cls, line: str) -> FleetOutcome:
        """The inverse of `to_json`. Raises InputError for anything else."""
        try:
            content = json.loads(line)
            known = {f.name for f in fields(cls)}
            outcome = cls(**{key: value for key, value in content.items() if key in known})
        except (ValueError, TypeError, AttributeError) as error:
            raise InputError(f"This is no outcome of a fleet's job: {error}.") from error
        if not isinstance(outcome.cameras, dict) or not all(
            isinstance(getattr(outcome, key), str)
            for key in ("name", "recording", "status", "key", "changed_at")
        ):
            raise InputError("This is no outcome of a fleet's job.")
        return replace(outcome, notes=tuple(map(str, outcome.notes)))


def outcome_of(job: FleetJob, status: str, **values: Any) -> FleetOutcome:
    """The outcome of this job, its own values filled in."""
    return FleetOutcome(
        job.name,
        job.recording,
        status,
        vessel=job.vessel,
        verb=job.verb,
        choices=job.choices,
        changed_at=job.changed_at,
        **values,
    )


def failure(job: FleetJob, cause: str, message: str, *, stored: bool, **values: Any) -> FleetOutcome:
    """A job that failed."""
    return outcome_of(job, FAILED, cause=cause, message=message, stored=stored, **values)
