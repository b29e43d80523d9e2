"""Hand-eye's loops are compiled beside the cameras' work, once."""

import os
import subprocess
import sys
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import pytest

from rigwake.pipeline import camera_processes
from rigwake.pipeline.camera_processes import process_cameras
from rigwake.workers import in_background

CAMERAS = [SimpleNamespace(stream=SimpleNamespace(name=name)) for name in ("left", "right")]


@pytest.mark.slow  # compiles for half a minute
def test_a_small_problem_leaves_compiled_loops_on_disk(tmp_path: Path) -> None:
    program = (
        "from rigwake.pipeline.kernel_warmup import compile_handeye, handeye_is_compiled\n"
        "before = handeye_is_compiled(); compile_handeye(); print(before, handeye_is_compiled())"
    )
    environment = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path)}
    run = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=True, env=environment
    )
    assert run.stdout.split() == ["False", "True"]


@pytest.mark.parametrize(
    ("compiled", "processes", "asked"),
    [(False, 2, ["", "left", "right"]), (True, 2, ["left", "right"]), (False, 1, ["left", "right"])],
)
def test_compiling_is_the_first_job_where_there_are_processes(
    monkeypatch, compiled, processes, asked
) -> None:
    given, done = [], []

    def run(work, jobs, processes, progress, finished):
        given.extend("" if job is None else job.stream.name for job in jobs.values())
        results = {name: None if job is None else name for name, job in jobs.items()}
        for name, result in results.items():
            finished(name, result)
        return results

    monkeypatch.setattr(camera_processes, "run_in_processes", run)
    monkeypatch.setattr(camera_processes, "handeye_is_compiled", lambda: compiled)
    outcomes = process_cameras(CAMERAS, processes, lambda *a: None, done.append)
    assert given == asked
    assert outcomes == done == ["left", "right"]


def test_work_in_the_background_goes_on_meanwhile_and_ends_with_the_block(tmp_path: Path) -> None:
    with in_background(partial(Path.touch, tmp_path / "done")):
        assert wait_until((tmp_path / "done").exists)
    started = time.monotonic()
    with in_background(partial(time.sleep, 60)):
        pass
    assert time.monotonic() - started < 30


def wait_until(true: Callable[[], bool]) -> bool:
    patience = time.monotonic() + 60
    while not true() and time.monotonic() < patience:
        time.sleep(0.05)
    return true()
