"""All jobs through any runner, a window of them at a time; those that killed a worker again, alone."""

from __future__ import annotations

import contextlib
import queue
import threading
from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from typing import Protocol

from rigwake.errors import HostError
from rigwake.fleet.fleet_jobs import KILLED, OUT_OF_MEMORY, TIME_OUT, FleetJob, FleetOutcome
from rigwake.fleet.resume import store_outcome
from rigwake.fleet.task_process import TaskProcess

_WINDOW = 4  # jobs handed out per slot: enough that no worker waits, few enough that a lost one costs little
_LOOK_EVERY_S = 1.0
RECORDED = (TIME_OUT, OUT_OF_MEMORY, KILLED)
FATAL = ("disk full", "read-only disk")


class FleetRunner(Protocol):
    """Where jobs are done."""

    def slots(self) -> int:
        """How many jobs are done at the same time, now."""

    def submit(self, job: FleetJob) -> None:
        """Begin with a job, or put it in line."""

    def next_outcome(self) -> tuple[FleetJob, FleetOutcome]:
        """Wait for any submitted job. A lost worker is an outcome with the cause `killed`."""


def run_jobs(
    jobs: Iterable[FleetJob],
    runner: FleetRunner,
    finished: Callable[[FleetOutcome], None],
    *,
    retries: int = 1,
) -> None:
    """Do all jobs; `finished` is told every outcome, once per job.

    Jobs are drawn as slots become free, so that any number of them takes little memory. A job whose worker was lost may
    be innocent: it is tried again, `retries` times, when nothing else runs. Raises HostError when the disk of the
    results is full; what was done is kept.
    """
    coming = iter(jobs)
    suspects: list[FleetJob] = []
    waiting = 0
    full: FleetOutcome | None = None
    while True:
        while full is None and waiting < _WINDOW * max(runner.slots(), 1):
            job = next(coming, None)
            if job is None:
                break
            runner.submit(job)
            waiting += 1
        if not waiting:
            break
        job, outcome = runner.next_outcome()
        waiting -= 1
        if outcome.cause == KILLED and retries > 0:
            suspects.append(job)
            continue
        full = outcome if outcome.cause in FATAL else full
        finished(_recorded(job, outcome))
    if full is not None:
        raise HostError(
            f"The results cannot be written: {full.cause}. {full.message}",
            consequence="No more recordings were begun; finished results are kept.",
            remedy="Free some space and run the same command again: it goes on with what is left.",
        )
    for job in suspects:
        finished(_recorded(job, _alone(job, runner, retries)))


def _alone(job: FleetJob, runner: FleetRunner, retries: int) -> FleetOutcome:
    attempt = 1
    while True:
        attempt += 1
        runner.submit(job)
        _, outcome = runner.next_outcome()
        if outcome.cause != KILLED or attempt > retries:
            return replace(outcome, attempts=attempt)


def _recorded(job: FleetJob, outcome: FleetOutcome) -> FleetOutcome:
    """What the watchers found out is kept beside the results, so that the next run does not fall for it again."""
    if outcome.cause not in RECORDED or outcome.stored:
        return outcome
    kept = replace(outcome, stored=True)
    try:
        store_outcome(job, kept)
    except OSError:
        return outcome
    return kept


class LocalPool:
    """Processes on this machine, one job each at a time."""

    def __init__(self, processes: int) -> None:
        self._jobs: queue.Queue[FleetJob | None] = queue.Queue()
        self._done: queue.Queue[tuple[FleetJob, FleetOutcome | BaseException]] = queue.Queue()
        self._processes = [TaskProcess() for _ in range(processes)]
        self._threads = [
            threading.Thread(target=self._serve, args=(process,), daemon=True, name="fleet")
            for process in self._processes
        ]
        for thread in self._threads:
            thread.start()

    def slots(self) -> int:
        """See `FleetRunner.slots`."""
        return len(self._processes)

    def submit(self, job: FleetJob) -> None:
        """See `FleetRunner.submit`."""
        self._jobs.put(job)

    def next_outcome(self) -> tuple[FleetJob, FleetOutcome]:
        """See `FleetRunner.next_outcome`."""
        while True:
            with contextlib.suppress(queue.Empty):  # wakes up, so that Ctrl-C is heard
                job, outcome = self._done.get(timeout=_LOOK_EVERY_S)
                if isinstance(outcome, BaseException):
                    raise outcome
                return job, outcome

    def _serve(self, process: TaskProcess) -> None:
        while (job := self._jobs.get()) is not None:
            try:
                self._done.put((job, process.attend(job)))
            except BaseException as error:  # raised where outcomes are awaited
                self._done.put((job, error))

    def close(self) -> None:
        """End the processes, also in the middle of a job."""
        with contextlib.suppress(queue.Empty):
            while True:
                self._jobs.get_nowait()
        for _ in self._threads:
            self._jobs.put(None)
        for process in self._processes:
            process.end()


@contextlib.contextmanager
def local_pool(processes: int) -> Iterator[LocalPool]:
    """A pool that is gone at the end of the block."""
    pool = LocalPool(processes)
    try:
        yield pool
    finally:
        pool.close()
