"""A calibration that is killed, starved or filled up: words, no orphans, no half-written file, and --resume goes on."""

import contextlib
import json
import os
import random
import resource
import shutil
import signal
import subprocess
import sys
import time
import uuid
from collections.abc import Callable, Iterator
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
    """A `rigwake` in a process of its own, whose children can be found; words: a verb and what it is given."""

    def __init__(
        self, *words: object, limit: Callable[[], object] | None = None, **environment: str | None
    ) -> None:
        self.mark = uuid.uuid4().hex
        here = os.environ | {"PYTHONPATH": str(SOURCE), MARK: self.mark, "OPENBLAS_NUM_THREADS": "1"}
        self.process = subprocess.Popen(
            [sys.executable, "-m", "rigwake", *map(str, words)],
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            errors="surrogateescape",
            env={key: value for key, value in (here | environment).items() if value is not None},
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


def calibration_of(
    recording: Path, out: Path, *words: object, limit: Callable[[], object] | None = None, **environment: str
) -> Run:
    return Run("calibrate", recording, "-o", out, *QUICK, *words, limit=limit, **environment)


def failed_in_words(run: Run, codes: tuple[int, ...], *parts: str) -> None:
    """It ended with one of these codes, said these words and a remedy, showed no traceback, and left nobody running."""
    ended, said = run.end()
    assert run.leaves_nobody(), run.members()
    assert ended in codes, said
    assert "Traceback" not in said, said
    for part in parts:
        assert part in said, said
    assert "→" in said or "->" in said, said


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
    out = recording.parent / "undisturbed_süd"
    code, said = calibration_of(recording, out, LC_ALL="C", PYTHONUTF8="0", PYTHONCOERCECLOCALE="0").end()
    assert code == 0, said
    return out, time.monotonic() - started


MOMENTS = 20
WAYS = (signal.SIGKILL, signal.SIGTERM, signal.SIGINT, None)  # None: a worker is killed


def workers_of(run: Run) -> list[int]:
    found = []
    for pid in run.members():
        with contextlib.suppress(OSError):
            if b"spawn_main" in Path(f"/proc/{pid}/cmdline").read_bytes():
                found.append(pid)
    return found


def test_killed_at_random_moments_and_resumed(
    recording: Path, undisturbed: tuple[Path, float], tmp_path: Path
) -> None:
    """Every run goes on where the last one was ended; once the result is there, the next begins anew."""
    whole, seconds = undisturbed
    rng = random.Random(4)
    results, out = 0, tmp_path / "OUT0"
    ended_early = []
    for k in range(MOMENTS):
        way = WAYS[k % len(WAYS)]
        run = calibration_of(recording, out, "--resume")
        time.sleep(seconds * rng.uniform(0.05, 0.6))
        workers = workers_of(run)
        if way is None and workers:
            os.kill(rng.choice(workers), signal.SIGKILL)
        else:
            run.process.send_signal(way or signal.SIGKILL)
        code, said = run.end()
        assert run.leaves_nobody(), (k, run.members())
        assert "Traceback" not in said, said
        check_files_are_whole(out)
        if code == 0:
            assert numbers_of(out) == numbers_of(whole)
            results, out = results + 1, tmp_path / f"OUT{k + 1}"
            continue
        ended_early.append(way)
        if code != -signal.SIGKILL:
            assert code in (130, 143, 1), (code, said)
            assert "--resume" in said
    code, said = calibration_of(recording, out, "--resume").end()
    assert code == 0, said
    assert numbers_of(out) == numbers_of(whole)
    assert not list(out.rglob(".rigwake*"))
    assert len(ended_early) > MOMENTS // 2


@pytest.mark.parametrize("size", [0, 300, 4_000, 40_000, 150_000])
def test_files_that_may_not_grow(recording: Path, tmp_path: Path, size: int) -> None:
    out = tmp_path / "OUT"
    run = calibration_of(
        recording, out, limit=lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (size, size))
    )
    if size:
        failed_in_words(run, (1,), "the file would be larger than allowed")
    else:  # not even the file that marks the folder as in use
        failed_in_words(run, (2,), "cannot be written: File too large")
    if out.exists():
        check_files_are_whole(out)
        assert not list(out.rglob(".rigwake*"))


@pytest.mark.parametrize("size", ["4k", "40k", "120k", "300k", "700k"])
def test_disks_that_are_full(recording: Path, tmp_path: Path, size: str) -> None:
    disk = tmp_path / "disk"
    disk.mkdir()
    options = ["-t", "tmpfs", "-o", f"size={size}", "tmpfs", str(disk)]
    if shutil.which("mount") is None or subprocess.run(["mount", *options], check=False).returncode:
        pytest.skip("a small disk can only be mounted by root")
    try:
        failed_in_words(calibration_of(recording, disk / "OUT"), (1,), "the disk is full")
        check_files_are_whole(disk / "OUT")
        assert not list(disk.rglob(".rigwake*"))
    finally:
        subprocess.run(["umount", str(disk)], check=False)


def test_folders_that_cannot_be_written_are_found_at_once(recording: Path) -> None:
    for out in ("/sys/rigwake_out", "/proc/rigwake_out", recording / "OUT"):
        started = time.monotonic()
        code, said = calibration_of(recording, Path(out)).end()
        assert code in (1, 2), said
        assert "Traceback" not in said
        assert str(Path(out).parent) in said
        assert "tracking" not in said
        assert time.monotonic() - started < 60


def test_a_folder_that_is_removed(recording: Path, tmp_path: Path) -> None:
    out = tmp_path / "OUT"
    run = calibration_of(recording, out)
    while not (out / "odometry").exists():
        assert run.process.poll() is None
        time.sleep(0.05)
    shutil.rmtree(out, ignore_errors=True)
    failed_in_words(run, (1,), "removed")


def test_few_open_files(recording: Path, tmp_path: Path) -> None:
    for most in (12, 20):
        run = calibration_of(
            recording,
            tmp_path / "OUT",
            limit=lambda n=most: resource.setrlimit(resource.RLIMIT_NOFILE, (n, n)),
        )
        failed_in_words(run, (1,), "too many files are open")


@contextlib.contextmanager
def read_only(folder: Path) -> Iterator[None]:
    """The folder cannot be written into, not even by root; skips where that cannot be had."""
    if os.geteuid() == 0:
        for options in (["--bind", str(folder)], ["-o", "remount,ro,bind"]):
            if subprocess.run(["mount", *options, str(folder)], check=False).returncode:
                pytest.skip("root needs the right to mount")
        try:
            yield
        finally:
            subprocess.run(["umount", str(folder)], check=False)
        return
    for path in (folder, *folder.rglob("*")):
        path.chmod(0o555 if path.is_dir() else 0o444)
    try:
        yield
    finally:
        for path in (folder, *folder.rglob("*")):
            path.chmod(0o755)


@pytest.mark.skipif(shutil.which("mount") is None, reason="needs mount")
def test_an_installation_that_cannot_be_written(recording: Path, tmp_path: Path) -> None:
    """By a user without a home."""
    installed = tmp_path / "installed"
    shutil.copytree(SOURCE, installed)
    with read_only(installed):
        with pytest.raises(OSError, match=r"Read-only|ermission"):
            (installed / "x").write_text("")
        for words in (
            ["--version"],
            ["inspect", recording],
            ["convert", recording, "-o", tmp_path / "folder"],
        ):
            run = Run(*words, HOME="/nonexistent", XDG_CACHE_HOME=None, PYTHONPATH=str(installed))
            code, said = run.end()
            assert code == 0, said
            assert "Traceback" not in said, said


def test_two_runs_in_one_folder_and_a_removed_one(recording: Path, tmp_path: Path) -> None:
    out = tmp_path / "OUT"
    first = calibration_of(recording, out)
    while not (out / ".rigwake.lock").exists():
        time.sleep(0.05)
    code, said = calibration_of(recording, out).end()
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
