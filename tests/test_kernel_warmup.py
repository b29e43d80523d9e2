"""Hand-eye's loops are compiled beside the cameras' work, once."""

from types import SimpleNamespace

import pytest

from rigwake.pipeline import camera_processes
from rigwake.pipeline.camera_processes import process_cameras
from rigwake.pipeline.kernel_warmup import compile_handeye, handeye_is_compiled

CAMERAS = [SimpleNamespace(stream=SimpleNamespace(name=name)) for name in ("left", "right")]


def test_a_small_problem_leaves_compiled_loops_on_disk() -> None:
    compile_handeye()
    assert handeye_is_compiled()


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
