"""Cameras in parallel processes, with their progress told to whoever asked."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence

from rigwake._progress import Progress
from rigwake.pipeline.camera_stage import CameraJob, CameraOutcome, process_camera
from rigwake.pipeline.kernel_warmup import compile_handeye, handeye_is_compiled
from rigwake.workers import WorkerReport, run_in_processes

Finished = Callable[[CameraOutcome], None]
CameraRunner = Callable[[Sequence[CameraJob], int, Progress, Finished], list[CameraOutcome]]
"""What does the camera stage: `process_cameras`, or a cluster."""

_COMPILING = "compiled loops (first use)"
_SEND_EVERY = 0.01  # of a fraction


class _ProgressSender:
    """Passes progress on, but not every frame of it."""

    def __init__(self, name: str, report_stage: WorkerReport) -> None:
        self.name = name
        self.report_stage = report_stage
        self.last = ("", -1.0)

    def __call__(self, what: str, fraction: float) -> None:
        if what != self.last[0] or fraction - self.last[1] >= _SEND_EVERY or fraction >= 1:
            self.last = (what, fraction)
            self.report_stage(self.name, what, fraction)


def _work(job: CameraJob | None, report_stage: WorkerReport) -> CameraOutcome | None:
    """A camera, or None: the loops that the rig estimate needs are compiled."""
    if job is None:
        compile_handeye()
        return None
    return process_camera(job, _ProgressSender(job.stream.name, report_stage))


def process_cameras(
    jobs: Sequence[CameraJob],
    processes: int,
    progress: Progress,
    finished: Callable[[CameraOutcome], None] = lambda outcome: None,
) -> list[CameraOutcome]:
    """Outcomes in the order of the jobs, from so many processes (0: one per core).

    finished: called with every outcome as soon as it is there. Raises HostError when a process is ended from outside.
    """
    by_name: dict[str, CameraJob | None] = {}
    if min(processes or os.cpu_count() or 1, len(jobs)) > 1 and not handeye_is_compiled():
        by_name[_COMPILING] = None  # first: meanwhile one camera compiles what all cameras need
    by_name |= {job.stream.name: job for job in jobs}

    def one_finished(_: str, outcome: CameraOutcome | None) -> None:
        if outcome is not None:
            finished(outcome)

    outcomes = run_in_processes(_work, by_name, processes, progress, one_finished)
    return [outcome for outcome in outcomes.values() if outcome is not None]
