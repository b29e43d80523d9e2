"""Work in processes of their own, which end when the process that started them ends, however that happens."""

from __future__ import annotations

import contextlib
import ctypes
import multiprocessing
import os
import queue
import signal
import sys
import threading
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from multiprocessing.connection import wait as wait_for_end
from typing import Any, TypeVar

from rigwake.errors import HostError

Job = TypeVar("Job")
Result = TypeVar("Result")
WorkerReport = Callable[..., None]
"""Told any plain values by a worker; called in the process that started it."""

_LOOK_EVERY_S = 0.2
_PATIENCE_S = 2.0  # with a worker that was asked to end
_PR_SET_PDEATHSIG = 1  # linux/prctl.h

_messages: Any = None  # of this worker: where it tells its progress


def run_in_processes(
    work: Callable[[Job, WorkerReport], Result],
    jobs: Mapping[str, Job],
    processes: int,
    progress: WorkerReport,
    finished: Callable[[str, Result], None] = lambda name, result: None,
) -> dict[str, Result]:
    """`work(job, progress)` of every job by name, in at most so many processes (0: one per core) at a time.

    work: a function of a module. finished: called here as soon as a job is done. An exception of one job ends the
    others and is raised here. Raises HostError when a process is ended from outside.
    """
    workers = min(processes or os.cpu_count() or 1, len(jobs))
    results: dict[str, Result] = {}
    if workers <= 1:
        for name, job in jobs.items():
            results[name] = work(job, progress)
            finished(name, results[name])
        return results
    # a fresh interpreter each: forking beside OpenCV's and numba's threads can hang
    context = multiprocessing.get_context("spawn")
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    messages = context.Queue()
    pool = ProcessPoolExecutor(
        workers, mp_context=context, initializer=_begin_worker, initargs=(messages, os.getpid())
    )
    try:
        with _main_module_stays_here():
            names = {pool.submit(_in_worker, work, job): name for name, job in jobs.items()}
        _follow(names, messages, progress, results, finished)
        pool.shutdown()
        _pass_on(messages, progress)  # what was told at the very end
    except BaseException as error:
        _end(pool)
        if isinstance(error, BrokenProcessPool | BrokenPipeError):  # the latter of one that had just begun
            raise _worker_lost([name for name in jobs if name not in results]) from error
        raise
    finally:
        messages.close()
        messages.cancel_join_thread()
    return {name: results[name] for name in jobs}


@contextlib.contextmanager
def in_background(work: Callable[[], object]) -> Iterator[None]:
    """`work()` in a process of its own, meanwhile, with low priority; ended when the block is left."""
    process = multiprocessing.get_context("spawn").Process(
        target=_beside, args=(work, os.getpid()), daemon=True
    )
    with _main_module_stays_here():
        process.start()
    try:
        yield
    finally:
        process.terminate()
        process.join(_PATIENCE_S)
        if process.is_alive():
            process.kill()


def _beside(work: Callable[[], object], parent: int) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    _end_with_parent(parent)
    if hasattr(os, "nice"):
        os.nice(5)
    work()


@contextlib.contextmanager
def _main_module_stays_here() -> Iterator[None]:
    """Workers started within do not run the caller's script again, so that it needs no `if __name__ == "__main__"`.

    A spawned process imports the main module by its file or its spec; all that workers run here is in modules of
    this package.
    """
    module = sys.modules["__main__"]
    kept = {name: getattr(module, name) for name in ("__file__", "__spec__") if hasattr(module, name)}
    try:
        for name in kept:
            setattr(module, name, None)
        yield
    finally:
        for name, value in kept.items():
            setattr(module, name, value)


def _follow(
    names: dict[Future[Result], str],
    messages: Any,
    progress: WorkerReport,
    results: dict[str, Result],
    finished: Callable[[str, Result], None],
) -> None:
    """Pass on what the workers tell and return, until all are done."""
    open_futures = set(names)
    while open_futures:
        done, open_futures = wait(open_futures, timeout=_LOOK_EVERY_S, return_when=FIRST_COMPLETED)
        _pass_on(messages, progress)
        for future in sorted(done, key=lambda f: f.exception() is not None):  # results first
            results[names[future]] = future.result()
            finished(names[future], results[names[future]])


def _pass_on(messages: Any, progress: WorkerReport) -> None:
    with contextlib.suppress(queue.Empty):
        while True:
            progress(*messages.get_nowait())


def _end(pool: ProcessPoolExecutor) -> None:
    """End the workers, those that do not listen by force."""
    processes = list((getattr(pool, "_processes", None) or {}).values())
    pool.shutdown(wait=False, cancel_futures=True)
    for process in processes:
        process.terminate()
    for process in processes:
        process.join(_PATIENCE_S)
        if process.is_alive():
            process.kill()
            process.join(_PATIENCE_S)


def _worker_lost(names: list[str]) -> HostError:
    return HostError(
        f"A process that worked on {', '.join(names)} was ended from outside.",
        consequence="Usually the system had no memory left. What was finished before is kept.",
        remedy="Close other programs or use fewer processes (`--jobs 1`), and run again with --resume.",
    )


def _begin_worker(messages: Any, parent: int) -> None:
    """Runs first in every worker."""
    global _messages
    _messages = messages
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches all: the parent decides
    _end_with_parent(parent)


def _end_with_parent(parent: int) -> None:
    """Make sure that this process does not outlive the one that started it, even where that is killed."""
    if sys.platform == "linux":
        with contextlib.suppress(OSError, AttributeError):
            ctypes.CDLL(None, use_errno=True).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL, 0, 0, 0)
    above = multiprocessing.parent_process()
    if above is None or (os.name == "posix" and os.getppid() != parent):
        os._exit(1)

    def watch() -> None:
        wait_for_end([above.sentinel])
        os._exit(1)

    threading.Thread(target=watch, name="parent", daemon=True).start()


def _in_worker(work: Callable[[Job, WorkerReport], Result], job: Job) -> Result:
    return work(job, _tell_parent)


def _tell_parent(*message: Any) -> None:
    _messages.put(message)
