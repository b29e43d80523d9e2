"""Thousands of damaged files of every format: each is read, or refused by an error of rigwake's own, in bounded time
and memory. `fuzz_inputs.py` says how; it runs in a process of its own, so that a crash and a hang are seen as such."""

import contextlib
import json
import os
import stat
import subprocess
import sys
from pathlib import Path

import pytest

from fuzz_inputs import CALIBRATIONS, INPUTS, MEMORY_BYTES, RECORDINGS, TRAJECTORIES, FuzzInput
from rigwake.errors import RigwakeError

HERE = Path(__file__).parent
LONGEST_S = 570.0


def failures(folder: Path, seed: int, count: int) -> tuple[int, list[str]]:
    """How many damaged inputs were read, and what went wrong."""
    command = [sys.executable, str(HERE / "fuzz_inputs.py"), str(folder), str(seed), str(count)]
    paths = [str(HERE.parent / "src"), str(HERE), os.environ.get("PYTHONPATH", "")]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(paths), "OPENBLAS_NUM_THREADS": "1"}
    try:
        done = subprocess.run(
            command, env=environment, capture_output=True, text=True, timeout=LONGEST_S, check=False
        )
    except subprocess.TimeoutExpired:
        return 0, [f"a hang at {(folder / 'last').read_text()}"]
    lines = [json.loads(line) for line in done.stdout.splitlines() if line.startswith("{")]
    total = sum(line.get("total", 0) for line in lines)
    wrong = [
        f"{x['input']}: {x['damage']} ({x['seconds']:.1f} s)\n{x['failure']}" for x in lines if "input" in x
    ]
    if done.returncode != 0:
        last = (folder / "last").read_text() if (folder / "last").exists() else "its start"
        wrong.append(f"exit code {done.returncode} at {last}\n{done.stderr[-2000:]}")
    return total, wrong


def test_some_damaged_inputs_are_read_or_refused(tmp_path: Path) -> None:
    total, wrong = failures(tmp_path / "fuzz", seed=1, count=2)
    assert not wrong, "\n".join(wrong[:10])
    assert total == 2 * len(INPUTS)


@pytest.mark.slow
def test_thousands_of_damaged_inputs_are_read_or_refused(tmp_path: Path) -> None:
    total, wrong = failures(tmp_path / "fuzz", seed=1000, count=300)
    assert not wrong, "\n".join(wrong[:10])
    assert total >= 10_000


SLOW = ("export mrcal", "export opencv", "export basalt")  # the lens is fitted by another


@pytest.mark.parametrize(
    "one",
    [
        pytest.param(one, id=one.name, marks=[pytest.mark.slow] if one.name in SLOW else [])
        for one in [*TRAJECTORIES, *RECORDINGS, *CALIBRATIONS]
    ],
)
def test_pipes_and_devices_are_refused_at_once(tmp_path: Path, one: FuzzInput) -> None:
    """A pipe that nobody writes to blocks whoever opens it."""
    path = one.make(tmp_path)
    one.read(path)  # it is valid before
    files = [path] if path.is_file() else [f for f in sorted(path.rglob("*")) if f.is_file()][:12]
    for file in files:
        file.rename(tmp_path / "kept")
        os.mkfifo(file)
        with contextlib.suppress(RigwakeError):
            one.read(path)
        assert stat.S_ISFIFO(file.stat().st_mode)
        file.unlink()
        (tmp_path / "kept").rename(file)
    assert MEMORY_BYTES == 2**30
