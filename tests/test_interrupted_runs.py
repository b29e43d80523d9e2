"""A calibration that is killed, starved or filled up: words, no orphans, no half-written file, and --resume goes on."""

import json
import os
import random
import resource
import signal
import subprocess
import sys
import time
import uuid
from collections.abc import Callable
from pathlib import Path

import pytest
import yaml

from rigwake.calibration import load_calibration
from rigwake.pipeline.camera_stage import load_outcome
from rigwake.readers.trajectories import read_trajectory
from rigwake.tracks import load_tracks
from textured_room import write_room

SOURCE = Path(__file__).parent.parent / "src"
MARK = "RIGWAKE_TEST_RUN"
QUICK = ["--set", "adjustment.cross_camera=false", "--set", "tracking.max_features=120", "--jobs", "2"]

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(not Path("/proc/self/environ").exists(), reason="needs /proc"),
]


class Run:
    """A `rigwake calibrate` in a process of its own, whose children can be found."""

    def __init__(self, *words: object, limit: Callable[[], None] | None = None) -> None:
        self.mark = uuid.uuid4().hex
        self.process = subprocess.Popen(
            [sys.executable, "-m", "rigwake", "calibrate", *map(str, words), *QUICK],
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            env=os.environ | {"PYTHONPATH": str(SOURCE), MARK: self.mark, "OPENBLAS_NUM_THREADS": "1"},
            preexec_fn=limit,
            start_new_session=True,
        )

    def members(self) -> list[int]:
        """Processes of this run that are alive."""
        found = []
        for folder in Path("/proc").iterdir():
            if folder.name.isdigit():
                try:
                    mine = self.mark in (folder / "environ").read_bytes().decode(errors="replace")
                    alive = (folder / "stat").read_text().rpartition(")")[2].split()[0] != "Z"
                except OSError:
                    continue
                if mine and alive:
                    found.append(int(folder.name))
        return found

    def end(self, seconds: float = 120.0) -> tuple[int, str]:
        """Exit code, and what it said."""
        said, _ = self.process.communicate(timeout=seconds)
        return self.process.returncode, " ".join(said.replace("│", " ").split())

    def leaves_nobody(self, seconds: float = 5.0) -> bool:
        end = time.monotonic() + seconds
        while self.members() and time.monotonic() < end:
            time.sleep(0.1)
        return not self.members()


def check_files_are_whole(out: Path) -> None:
    """Everything that stands under its own name can be read."""
    for path in out.rglob("*"):
        if path.name.startswith(".") or not path.is_file():
            continue
        match path.suffix:
            case ".json" if path.parent.name == "odometry":
                load_outcome(out, path.stem)
            case ".json":
                json.loads(path.read_text())
            case ".npz" if path.parent.name == "tracks":
                load_tracks(path)
            case ".tum":
                read_trajectory(path)
            case ".yaml":
                load_calibration(path)


def numbers_of(out: Path) -> object:
    content = yaml.safe_load((out / "calibration.yaml").read_text())
    return {key: content[key] for key in ("reference", "cameras", "antenna", "joint_covariance")}


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_room(tmp_path_factory.mktemp("room") / "room.bag")


@pytest.fixture(scope="module")
def undisturbed(recording: Path) -> tuple[Path, float]:
    """The folder of an undisturbed run, and how long it took."""
    started = time.monotonic()
    out = recording.parent / "undisturbed"
    code, said = Run(recording, "-o", out).end()
    assert code == 0, said
    return out, time.monotonic() - started


def test_killed_at_random_moments_and_resumed(
    recording: Path, undisturbed: tuple[Path, float], tmp_path: Path
) -> None:
    whole, seconds = undisturbed
    out = tmp_path / "OUT"
    rng = random.Random(4)
    ways: list[signal.Signals | None] = [signal.SIGKILL, signal.SIGTERM, signal.SIGINT, None]
    for k, way in enumerate(ways):
        run = Run(recording, "-o", out, "--resume")
        time.sleep(seconds * rng.uniform(0.15, 0.75))
        if way is None:
            workers = [
                pid for pid in run.members() if b"spawn_main" in Path(f"/proc/{pid}/cmdline").read_bytes()
            ]
            way = signal.SIGKILL
            os.kill((workers or [run.process.pid])[-1], way)
        else:
            run.process.send_signal(way)
        code, said = run.end()
        assert run.leaves_nobody(), (k, run.members())
        assert "Traceback" not in said, said
        if code not in (0, -signal.SIGKILL):
            assert code in (130, 143, 1), (code, said)
            assert "--resume" in said
        check_files_are_whole(out)
        if code == 0:
            break
    code, said = Run(recording, "-o", out, "--resume").end()
    assert code == 0, said
    assert numbers_of(out) == numbers_of(whole)
    assert not list(out.rglob(".rigwake*"))


def test_files_that_may_not_grow(recording: Path, tmp_path: Path) -> None:
    size = 100_000
    out = tmp_path / "OUT"
    run = Run(recording, "-o", out, limit=lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (size, size)))
    code, said = run.end()
    assert run.leaves_nobody()
    assert code == 1, said
    assert "the file would be larger than allowed" in said
    assert "Traceback" not in said
    if out.exists():
        check_files_are_whole(out)
        assert not list(out.rglob(".rigwake*"))


def test_two_runs_in_one_folder_and_a_removed_one(recording: Path, tmp_path: Path) -> None:
    out = tmp_path / "OUT"
    first = Run(recording, "-o", out)
    while not (out / ".rigwake.lock").exists():
        time.sleep(0.05)
    code, said = Run(recording, "-o", out).end()
    assert code == 2
    assert "Another run" in said
    with recording.open("r+b") as file:  # as if the recording were still being written
        file.seek(0, os.SEEK_END)
        size = file.tell()
        file.write(b"more")
    try:
        code, said = first.end()
    finally:
        os.truncate(recording, size)
    assert code == 1, said
    assert "changed while it was read" in said
    assert first.leaves_nobody()
