"""Jobs on a Dask cluster (extra `fleet`). Tasks carry paths, never frames; a watched process does them."""

from __future__ import annotations

import contextlib
import logging
import os
import queue
import secrets
import threading
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

from rigwake import __version__
from rigwake.atomic import write_text_atomic
from rigwake.errors import HostError, UsageError
from rigwake.fleet.fleet_jobs import KILLED, FleetJob, FleetOutcome, failure
from rigwake.fleet.task_process import TaskProcess

_CONNECT_S = 10.0
_WORKERS_S = 60.0
_LOOK_EVERY_S = 1.0
_IDLE: list[TaskProcess] = []  # of this worker: kept from task to task
_IDLE_LOCK = threading.Lock()


def attend_on_worker(line: str) -> str:
    """Runs on a worker: one job, from and to a line of JSON."""
    with _IDLE_LOCK:
        process = _IDLE.pop() if _IDLE else TaskProcess()
    try:
        return process.attend(FleetJob.from_json(line)).to_json()
    finally:
        with _IDLE_LOCK:
            _IDLE.append(process)


def machine_words(out: str, token_file: str) -> tuple[str, str]:
    """Runs on a worker: its version, and what it finds in a file of OUT."""
    try:
        return __version__, (Path(out) / token_file).read_text(encoding="ascii")
    except (OSError, UnicodeDecodeError):
        return __version__, ""


def check_workers(seen: dict[str, Any], token: str, out: Path) -> None:
    """Raises HostError for workers of another version, and for those that see another OUT.

    seen: by address, what `machine_words` gave, or the exception that it raised.
    """
    for address, words in seen.items():
        if not isinstance(words, (tuple, list)):
            raise HostError(
                f"The worker {address} cannot run rigwake's fleet: {str(words)[:200]}.",
                consequence="Nothing was computed.",
                remedy=f"Install rigwake[fleet] {__version__} on it, the same as here, and start it again.",
            )
        version, found = words
        if version != __version__:
            raise HostError(
                f"The worker {address} runs rigwake {version}, this is {__version__}.",
                consequence="Results of two versions would be mixed; nothing was computed.",
                remedy="Install the same version on all machines and start the workers again.",
            )
        if found != token:
            raise HostError(
                f"The worker {address} does not see {out}.",
                consequence="What it writes would be lost; nothing was computed.",
                remedy="Give as --out a folder that all machines share under the same path.",
            )


@contextlib.contextmanager
def dask_client(scheduler: str) -> Iterator[Any]:
    """A client of `tcp://HOST:PORT`, or of `local:N`, N workers of its own on this machine.

    Raises UsageError for other words, HostError where the package or the scheduler is missing.
    """
    try:
        import dask
        import distributed
    except ImportError as error:
        raise HostError(
            "The package `distributed` is not installed.",
            consequence="Work cannot be sent to a cluster; the pool on this machine works without (--jobs).",
            remedy="pip install 'rigwake[fleet]'",
        ) from error
    kind, _, rest = scheduler.partition(":")
    if kind == "local" and rest.isdigit() and int(rest) > 0:
        # a lost worker makes suspects of all its tasks; they are tried again alone
        with dask.config.set({"distributed.scheduler.allowed-failures": 0}):
            cluster = distributed.LocalCluster(
                n_workers=int(rest),
                threads_per_worker=1,
                dashboard_address="127.0.0.1:0",
                memory_limit=0,
                silence_logs=logging.CRITICAL,
            )
            with cluster, distributed.Client(cluster) as client:
                yield client
        return
    if kind not in ("tcp", "tls", "ucx", "ws", "wss") or not rest.startswith("//"):
        raise UsageError(
            f"--scheduler {scheduler[:80]!r} is no address.", remedy="Give tcp://HOST:PORT or local:N."
        )
    try:
        client = distributed.Client(scheduler, timeout=_CONNECT_S)
    except (OSError, TimeoutError, ValueError) as error:
        raise HostError(
            f"No scheduler answers at {scheduler}.",
            consequence="Nothing was computed.",
            remedy="Start one with `dask scheduler`, check the address and the firewall, or leave --scheduler out.",
        ) from error
    with client:
        yield client


class DaskRunner:
    """See `FleetRunner`: jobs as tasks of a client."""

    def __init__(self, client: Any) -> None:
        self._client = client
        self._done: queue.Queue[tuple[FleetJob, Any]] = queue.Queue()
        self._threads = 1

    def check(self, out: Path, token_file: str, token: str) -> None:
        """Raises HostError where no worker comes, or one is not fit for the work."""
        try:
            self._client.wait_for_workers(1, timeout=_WORKERS_S)
        except TimeoutError as error:
            raise HostError(
                f"The scheduler has no workers after {_WORKERS_S:.0f} s.",
                consequence="Nothing was computed.",
                remedy="Start some with `dask worker tcp://HOST:PORT`, on machines that see the recordings.",
            ) from error
        seen = self._client.run(machine_words, str(out), token_file, on_error="return")
        check_workers(seen, token, out)

    def slots(self) -> int:
        """See `FleetRunner.slots`."""
        with contextlib.suppress(Exception):  # none for a moment, while workers start again
            self._threads = max(sum(self._client.nthreads().values()), 1)
        return self._threads

    def submit(self, job: FleetJob) -> None:
        """See `FleetRunner.submit`."""
        future = self._client.submit(
            attend_on_worker, job.to_json(), key=f"rigwake-{job.name}-{job.choices[:16]}", pure=False
        )
        future.add_done_callback(lambda future: self._done.put((job, future)))

    def next_outcome(self) -> tuple[FleetJob, FleetOutcome]:
        """See `FleetRunner.next_outcome`. Raises HostError when the scheduler is gone."""
        while True:
            with contextlib.suppress(queue.Empty):
                job, future = self._done.get(timeout=_LOOK_EVERY_S)
                return job, self._outcome(job, future)

    def _outcome(self, job: FleetJob, future: Any) -> FleetOutcome:
        from distributed.scheduler import KilledWorker

        error = future.exception() if future.status == "error" else None
        if isinstance(error, KilledWorker):
            return failure(
                job,
                KILLED,
                "The worker that worked on it was lost, as when it is ended or its machine is.",
                stored=False,
            )
        if error is not None:
            raise error
        if future.status != "finished":
            raise scheduler_lost()
        return FleetOutcome.from_json(future.result())


def scheduler_lost() -> HostError:
    """The error when nobody answers any more."""
    return HostError(
        "The scheduler was lost.",
        consequence="What was finished is kept.",
        remedy="Start it again, and run the same command: it goes on with what is left.",
    )


def cameras_on_cluster(scheduler: str) -> Callable[..., list[Any]]:
    """In place of `process_cameras`: the cameras of one recording as tasks of a cluster, one per camera and stretch.

    The folder of the result must be shared; streams travel as paths and read their images where they are worked on.
    """

    def run(
        jobs: Sequence[Any],
        processes: int,
        progress: Callable[[str, str, float], None],
        finished: Callable[[Any], None] = lambda outcome: None,
    ) -> list[Any]:
        from distributed import CancelledError, as_completed
        from distributed.scheduler import KilledWorker

        with dask_client(scheduler) as client:
            _check_shared(DaskRunner(client), jobs[0].out.resolve())
            futures = {client.submit(_camera, job, pure=False): job.stream.name for job in jobs}
            for name in futures.values():
                progress(name, "on the cluster", 0.0)
            outcomes = {}
            for future in as_completed(futures):
                name = futures[future]
                try:
                    outcomes[name] = future.result()
                except KilledWorker as error:
                    raise HostError(
                        f"The worker that worked on camera {name} was lost.",
                        consequence="What was finished before is kept.",
                        remedy="Start the workers again, with more memory, and run again with --resume.",
                    ) from error
                except CancelledError as error:
                    raise scheduler_lost() from error
                progress(name, "done", 1.0)
                finished(outcomes[name])
        return [outcomes[job.stream.name] for job in jobs]

    return run


def _check_shared(runner: DaskRunner, out: Path) -> None:
    """Raises HostError where a worker is of another version or sees another folder."""
    file, token = out / f".cluster-{os.getpid()}", secrets.token_hex(16)
    write_text_atomic(file, token)
    try:
        runner.check(out, file.name, token)
    finally:
        file.unlink(missing_ok=True)


def _camera(job: Any) -> Any:
    """Runs on a worker: one camera, its stretches as tasks of their own."""
    from rigwake.pipeline.camera_stage import process_camera

    return process_camera(job, _no_progress, _stretches_on_cluster)


def _stretches_on_cluster(work: Callable[[Any], Any], stretches: Sequence[Any]) -> list[Any]:
    if len(stretches) == 1:
        return [work(stretches[0])]
    from distributed import worker_client

    with worker_client() as client:  # this task waits, and lets the worker do others meanwhile
        return list(client.gather(client.map(work, stretches, pure=False)))


def _no_progress(*_: Any) -> None:
    """Progress on a cluster is told per camera, when it is done."""
