"""A fleet's run: which jobs are left, where they are done, what came of all, and the tables."""

from __future__ import annotations

import contextlib
import os
import secrets
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path

from rigwake.atomic import write_text_atomic
from rigwake.errors import UsageError
from rigwake.fingerprint import files_changed_at
from rigwake.fleet.collect import Tables, write_tables
from rigwake.fleet.dask_run import DaskRunner, dask_client
from rigwake.fleet.fleet_jobs import FAILED, FleetJob, FleetOutcome, failure, shard_of
from rigwake.fleet.resume import finished_outcome
from rigwake.fleet.run_jobs import FleetRunner, local_pool, run_jobs
from rigwake.fleet.run_one import TOKEN, outcome_of_fault


@dataclass(frozen=True)
class FleetPlan:
    """How a fleet is worked on.

    scheduler: `tcp://..`, `local:N`, or empty for processes of this machine, `processes` of them. shard: (i, n) to do
    only every n-th recording. retry_failed: failures of former runs are tried again.
    """

    out: Path
    scheduler: str = ""
    processes: int = 1
    retries: int = 1
    shard: tuple[int, int] | None = None
    retry_failed: bool = False


@dataclass(frozen=True)
class FleetResult:
    """counts: recordings by status. causes: failures by cause. done_before: taken from former runs. tables: files."""

    counts: Counter[str]
    causes: Counter[str]
    done_before: int
    tables: Tables

    @property
    def total(self) -> int:
        """Of all recordings."""
        return sum(self.counts.values())


Told = Callable[[int, int, str], None]
"""Told how many are done, of how many, and the counts in words."""


def run_fleet(
    jobs: Sequence[FleetJob], plan: FleetPlan, told: Told = lambda done, total, words: None
) -> FleetResult:
    """Do every job that is not done yet, and write the tables of all.

    jobs: with paths, without `changed_at` and `token`, which are filled in here. Raises UsageError where OUT cannot be
    used, HostError where scheduler, workers or disk fail; what was finished is kept.
    """
    mine = [
        job for job in jobs if plan.shard is None or shard_of(job.recording, plan.shard[1]) == plan.shard[0]
    ]
    out = plan.out.resolve()
    token = _token(out)
    counts: Counter[str] = Counter()
    causes: Counter[str] = Counter()
    loose: dict[str, FleetOutcome] = {}  # those that are not kept beside the results
    before = 0

    def finished(outcome: FleetOutcome) -> None:
        counts[outcome.status] += 1
        if outcome.status == FAILED:
            causes[outcome.cause] += 1
        if not outcome.stored:
            loose[outcome.name] = outcome
        told(sum(counts.values()), len(mine), counts_in_words(counts))

    def left() -> Iterator[FleetJob]:
        nonlocal before
        for job in mine:
            known = _begun(job, token)
            if isinstance(known, FleetJob):
                former = finished_outcome(known)
                if former is None or (plan.retry_failed and former.status == FAILED):
                    yield known
                    continue
                before += 1
                known = former
            finished(known)

    try:
        first = next(coming := left(), None)
        if first is not None:
            with ExitStack() as opened:
                runner = _runner(plan, opened, out, token)
                run_jobs(_with_first(first, coming), runner, finished, retries=plan.retries)
    finally:
        with contextlib.suppress(OSError):
            (out / ".work").rmdir()
        tables = write_tables(out, mine, loose, plan.shard)
    return FleetResult(counts, causes, before, tables)


def _with_first(first: FleetJob, others: Iterator[FleetJob]) -> Iterator[FleetJob]:
    yield first
    yield from others


def _begun(job: FleetJob, token: str) -> FleetJob | FleetOutcome:
    """The job with the state of its recording, or its failure where the recording cannot even be looked at."""
    path = Path(job.recording)
    try:
        if not path.exists():
            return failure(
                job, "missing path", f"There is no file or folder {path}. Check the path.", stored=False
            )
        if path.is_file() and not os.access(path, os.R_OK):
            return failure(
                job, "unreadable path", f"{path} cannot be read. Change its permissions.", stored=False
            )
        return replace(job, changed_at=files_changed_at(path), token=token)
    except OSError as error:
        return outcome_of_fault(job, error)


def _token(out: Path) -> str:
    """What stands in OUT, so that every worker can tell that it sees the same folder. Raises UsageError."""
    path = out / TOKEN
    try:
        out.mkdir(parents=True, exist_ok=True)
        with contextlib.suppress(OSError, UnicodeDecodeError):
            known = path.read_text(encoding="ascii")
            if len(known) == 32:  # other shards use it at the same time
                return known
        token = secrets.token_hex(16)
        write_text_atomic(path, token)
        return path.read_text(encoding="ascii")
    except OSError as error:
        raise UsageError(
            f"{out} cannot be written: {error.strerror}.",
            consequence="Nothing was computed.",
            remedy="Choose another folder with --out, or change its permissions.",
        ) from error


def _runner(plan: FleetPlan, opened: ExitStack, out: Path, token: str) -> FleetRunner:
    if not plan.scheduler:
        return opened.enter_context(local_pool(plan.processes or os.cpu_count() or 1))
    runner = DaskRunner(opened.enter_context(dask_client(plan.scheduler)))
    runner.check(out, TOKEN, token)
    return runner


def counts_in_words(counts: Counter[str], causes: Counter[str] | None = None) -> str:
    """`187 calibrated, 9 not observable, 4 failed (2 truncated bags, 1 time-out, 1 out of memory)`."""
    order = ("calibrated", "ok", "suspect", "drifted", "not observable", FAILED)
    parts = [f"{counts[status]} {status}" for status in order if counts[status]]
    if causes and counts[FAILED]:
        parts[-1] += f" ({', '.join(_counted(n, cause) for cause, n in causes.most_common())})"
    return ", ".join(parts) or "nothing done"


_COUNTED = ("bag", "path", "time-out", "error", "result", "recording")


def _counted(number: int, cause: str) -> str:
    return f"{number} {cause}{'s' if number > 1 and cause.endswith(_COUNTED) else ''}"
