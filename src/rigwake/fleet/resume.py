"""Outcomes on disk, beside the results: what is there is not worked on again."""

from __future__ import annotations

import contextlib
import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from rigwake.atomic import write_text_atomic
from rigwake.errors import InputError
from rigwake.fleet.fleet_jobs import FleetJob, FleetOutcome

OUTCOME = "outcome.json"
_MOST_BYTES = 16 << 20


def read_outcome(folder: Path) -> FleetOutcome | None:
    """The outcome in a result's folder; None where there is none, or none that can be read."""
    path = folder / OUTCOME
    try:
        if path.stat().st_size > _MOST_BYTES:
            return None
        return FleetOutcome.from_json(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, InputError):
        return None


def finished_outcome(job: FleetJob) -> FleetOutcome | None:
    """What a former run has left for this job, if its recording, settings and version are still the same."""
    former = read_outcome(job.result_folder)
    if former is None or former.recording != job.recording or former.choices != job.choices:
        return None
    return former if job.changed_at and former.changed_at == job.changed_at else None


def store_outcome(job: FleetJob, outcome: FleetOutcome) -> None:
    """Put an outcome without a result in place of what is there. Raises OSError."""
    with result_in_place(job) as folder:
        write_text_atomic(folder / OUTCOME, outcome.to_json() + "\n")


def renew_outcome(job: FleetJob, outcome: FleetOutcome) -> None:
    """Replace only the outcome of a result that stays. Raises OSError."""
    write_text_atomic(job.result_folder / OUTCOME, outcome.to_json() + "\n")


@contextmanager
def result_in_place(job: FleetJob, made: Path | None = None) -> Iterator[Path]:
    """A folder that takes the place of the job's result when the block ends well.

    made: a folder that holds the result already, on the same disk. Others see the old result or the new one.
    """
    working, target = job.working_folder, job.result_folder
    folder = made or working / f"failure-{os.getpid()}"
    folder.mkdir(parents=True, exist_ok=True)
    yield folder
    target.parent.mkdir(parents=True, exist_ok=True)
    aside = working / f"former-{os.getpid()}"
    for _ in range(5):  # another may put one there between the two
        with contextlib.suppress(FileNotFoundError):
            target.rename(aside)
        try:
            folder.rename(target)
            break
        except OSError:
            shutil.rmtree(aside, ignore_errors=True)
            if not target.exists():
                raise
    else:
        folder.rename(target)
    shutil.rmtree(aside, ignore_errors=True)
    with contextlib.suppress(OSError):
        working.rmdir()
