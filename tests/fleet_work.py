"""Work for the processes of a fleet that takes no time, hangs, dies or eats memory, as the recording's name says."""

from __future__ import annotations

import os
import signal
import time
from pathlib import Path

from rigwake._progress import Progress
from rigwake.fleet.fleet_jobs import (
    NOT_OBSERVABLE,
    FleetJob,
    FleetOutcome,
    failure,
    outcome_of,
)
from rigwake.fleet.resume import store_outcome


def null_work(job: FleetJob, progress: Progress) -> FleetOutcome:
    """Nothing, without a file."""
    return outcome_of(job, "calibrated", key=job.name, stored=False)


def work_by_name(job: FleetJob, progress: Progress) -> FleetOutcome:
    """As the name of the recording says; notes every begin in OUT/begun.txt."""
    name = Path(job.recording).stem
    with (Path(job.out) / "begun.txt").open("a") as file:
        file.write(f"{name}\n")
    progress(name, "working", 0.5)
    if name.startswith("hang"):
        time.sleep(1000)
    if name.startswith("die"):
        os.kill(os.getpid(), signal.SIGKILL)
    if name.startswith("worker"):  # takes with it whoever watches over it: the worker itself
        os.kill(os.getppid(), signal.SIGKILL)
        time.sleep(5)
    if name.startswith("eat"):
        kept = []
        while True:
            kept.append(bytearray(b"x") * (8 << 20))
            time.sleep(0.01)
    if name.startswith("slow"):
        time.sleep(0.4)
    if name.startswith("rig"):
        _calibrate_small_rig()
    done = outcome_of(job, "calibrated", key=name)
    if name.startswith("broken"):
        done = failure(job, "damaged bag", "The bag is damaged.", stored=True)
    if name.startswith("calm"):
        done = outcome_of(job, NOT_OBSERVABLE, cause="not observable", message="The vessel never turned.")
    store_outcome(job, done)
    return done


def null_line(line: str) -> str:
    """A job of JSON without a process of its own."""
    return null_work(FleetJob.from_json(line), lambda name, what, fraction: None).to_json()


def _calibrate_small_rig() -> None:
    from calibration_worlds import calibrated, sail, true_odometry

    world = sail()
    calibrated(world, trajectories=true_odometry(world, metric=True))


def rig_work(job: FleetJob, progress: Progress) -> FleetOutcome:
    """A rig of two cameras from simulated tracks: some seconds of computing, no images."""
    _calibrate_small_rig()
    return outcome_of(job, "calibrated", stored=False)
