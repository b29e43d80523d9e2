"""Cameras in parallel processes, with their progress told to whoever asked."""

from __future__ import annotations

import multiprocessing
import os
import queue
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ProcessPoolExecutor, wait
from functools import partial
from typing import Any

from rigwake.pipeline.camera_stage import CameraJob, CameraOutcome, process_camera

Progress = Callable[[str, str, float], None]
"""Told a camera's name, what it is doing, and which fraction of it is done."""

_SEND_EVERY = 0.01  # of a fraction


class _ProgressSender:
    """Sends progress through a queue, but not every frame of it."""

    def __init__(self, name: str, messages: Any) -> None:
        self.name = name
        self.messages = messages
        self.last = ("", -1.0)

    def __call__(self, what: str, fraction: float) -> None:
        if what != self.last[0] or fraction - self.last[1] >= _SEND_EVERY or fraction >= 1:
            self.last = (what, fraction)
            self.messages.put((self.name, what, fraction))


def _work(job: CameraJob, messages: Any) -> CameraOutcome:
    return process_camera(job, _ProgressSender(job.stream.name, messages))


def process_cameras(jobs: Sequence[CameraJob], processes: int, progress: Progress) -> list[CameraOutcome]:
    """Outcomes in the order of the jobs, from so many processes (0: one per core)."""
    workers = min(processes or os.cpu_count() or 1, len(jobs))
    if workers <= 1:
        return [process_camera(job, partial(progress, job.stream.name)) for job in jobs]
    # a fresh interpreter each: forking beside OpenCV's and numba's threads can hang
    context = multiprocessing.get_context("spawn")
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    with context.Manager() as manager, ProcessPoolExecutor(workers, mp_context=context) as pool:
        messages = manager.Queue()
        futures: list[Future[CameraOutcome]] = [pool.submit(_work, job, messages) for job in jobs]
        try:
            while wait(futures, timeout=0.2).not_done:
                _pass_on(messages, progress)
            _pass_on(messages, progress)
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            for process in multiprocessing.active_children():
                process.terminate()
            raise
        return [future.result() for future in futures]


def _pass_on(messages: Any, progress: Progress) -> None:
    while True:
        try:
            name, what, fraction = messages.get_nowait()
        except queue.Empty:
            return
        progress(name, what, fraction)
