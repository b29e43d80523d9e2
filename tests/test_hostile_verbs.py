"""Damaged and hostile inputs given to every verb: words and a code, never a traceback, never a hang."""

import contextlib
import os
import shutil
import signal
import time
from collections.abc import Callable, Iterator
from itertools import chain
from pathlib import Path

import av
import numpy as np
import pytest

from cli_runs import commands_by_words, run, write_examples
from fuzz_inputs import BAGS, CALIBRATIONS, READ_BACK, RECORDINGS, TRAJECTORIES, FuzzInput, damages

LONGEST_S = 60  # of processor time; a calibration that begins takes some seconds
ANYHOW = "--set min_duration_s=0.1 --jobs 1 --force"

# what a verb is given; {x} is the hostile input, {o} where the result goes, others are files of `write_examples`
OF_RECORDINGS = [
    "inspect {x}",
    "convert {x} -o {o}",
    "odometry {x} --camera front -o {o}.tum --jobs 1",
    "surround {calibration} {x} -o {o}",
    "segment {x} -o {o} --method colour",
    "stixels {calibration} {x} -o {o}",
    "depth {calibration} {x} -o {o}",
    "monitor {calibration} {x}",
    "recalibrate {calibration} {x} -o {o}.yaml",
    "undistort {x} --camera front -o {o}",
    "intrinsics {x}",
]
AT_LENGTH = ["calibrate {x} -o {o} " + ANYHOW, "fleet calibrate {x} --out {o}"]
OF_CALIBRATIONS = [
    "diff {x} {calibration}",
    "diff {calibration} {x}",
    "evaluate {x} --truth {calibration}",
    "evaluate {calibration} --truth {x}",
    "export {x} --to kalibr -o {o}.yaml",
    "export {x} --to urdf -o {o}.urdf",
    "surround {x} {images} -o {o}",
    "stixels {x} {images} -o {o}",
    "monitor {x} {images}",
    "recalibrate {x} {images} -o {o}.yaml",
    "log add {o}.db {x}",
    "undistort {images}/front -o {o} --camera-file {x}",
    "inspect {images} --camera-file {x}",
    "inspect {images} --topics {x}",
    "calibrate {images} -o {o} --prior {x} " + ANYHOW,
    "calibrate {images} -o {o} --config {x}",
    "simulate {x} --show",
    "report {x}",
]
OF_TRAJECTORIES = [
    "handeye {rig_tum} {x}",
    "handeye {x} {port_tum}",
    "evaluate {x} --truth {rig_tum}",
    "evaluate {rig_tum} --truth {x}",
]
OF_WRITTEN = {
    "result folder": [
        "report {x}",
        "export {x}/calibration.yaml --to colmap -o {o}",
        "surround {x} {images} -o {o}",
    ],
    "logbook": ["log list {x}", "log show {x}", "log add {x} {calibration}", "log diff {x} 1 1"],
    "network": ["segment {images} -o {o} --onnx {x} --classes obstacle,water,sky"],
    "corners": ["intrinsics {x} --image-size 32x24"],
    "mask": ["odometry {images} --camera front -o {o}.tum --mask {x}"],
}


def commands_of(one: FuzzInput) -> list[str]:
    if one in TRAJECTORIES:
        return OF_TRAJECTORIES
    if one in CALIBRATIONS:
        return OF_CALIBRATIONS
    return OF_WRITTEN.get(one.name, []) if one in READ_BACK else OF_RECORDINGS


@contextlib.contextmanager
def alarm(seconds: int) -> Iterator[None]:
    def stop(*_: object) -> None:
        raise TimeoutError("a hang")

    before = signal.signal(signal.SIGALRM, stop)
    signal.alarm(seconds)
    try:
        yield
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, before)


def check(command: str, hostile: Path, files: dict[str, Path], told: str) -> int:
    """The code of a command, after looking at what it said."""
    out = files["here"] / "out"
    for old in files["here"].glob("out*"):
        shutil.rmtree(old, ignore_errors=True) if old.is_dir() else old.unlink()
    words = [word.format(x=hostile, o=out, **files) for word in command.split()]
    begun = time.process_time()
    with alarm(10 * LONGEST_S):
        ended = run(*words)
    assert ended.code in range(6), (told, command, ended.words)
    assert "does not know" not in ended.words, (told, command, ended.words)
    assert "fault of the program" not in ended.words, (told, command, ended.words)
    assert "Traceback" not in ended.out + ended.err, (told, command, ended.words)
    assert time.process_time() - begun < LONGEST_S, (told, command)
    return ended.code


@pytest.fixture
def files(tmp_path: Path) -> dict[str, Path]:
    av.logging.set_level(av.logging.PANIC)
    (tmp_path / "files").mkdir()
    return write_examples(tmp_path / "files")


def damaged_runs(folder: Path, files: dict[str, Path], inputs: list[FuzzInput], seed: int, count: int) -> int:
    total = 0
    for number, one in enumerate(inputs):
        place = folder / f"{number}"
        place.mkdir()
        path = one.make(place)
        rng = np.random.default_rng(seed + number)
        for _, told in damages(path, seed + number, count if commands_of(one) else 0):
            commands = commands_of(one)
            if commands is OF_RECORDINGS and rng.random() < 0.05:
                commands = AT_LENGTH
            check(commands[int(rng.integers(len(commands)))], path, files, f"{one.name}: {told}")
            total += 1
        shutil.rmtree(place)
    return total


@pytest.mark.slow
def test_every_verb_takes_damaged_inputs(tmp_path: Path, files: dict[str, Path]) -> None:
    inputs = [*RECORDINGS, *BAGS, *CALIBRATIONS, *TRAJECTORIES, *READ_BACK]
    assert damaged_runs(tmp_path, files, inputs, seed=90, count=3) > 120


def a_pipe(path: Path) -> Path:
    os.mkfifo(path)
    return path


def a_folder(path: Path) -> Path:
    path.mkdir()
    return path


def a_circle(path: Path) -> Path:
    path.symlink_to(path)
    return path


def a_sparse_file(path: Path) -> Path:
    with path.open("wb") as file:
        file.truncate(2**36)
    return path


def written(content: bytes, name: str = "x") -> Callable[[Path], Path]:
    def make(path: Path) -> Path:
        path = path.with_name(name)
        path.write_bytes(content)
        return path

    return make


HOSTILE = {
    "pipe": a_pipe,
    "device": lambda _: Path("/dev/zero"),
    "nothing": lambda path: path,
    "empty folder": a_folder,
    "circle": a_circle,
    "64 GB of nothing": a_sparse_file,
    "empty": written(b""),
    "noise": written(np.random.default_rng(0).bytes(3000)),
    "zeros": written(bytes(3000)),
    "escapes": written(b"cameras: {}\n", "\x1b[31m\x07.yaml"),
    "deep": written(b"x: " + b"[" * 20_000, "x.yaml"),
    "bag head": written(b"#ROSBAG V2.0\n", "x.bag"),
    "mcap head": written(b"\x89MCAP0\r\n", "x.mcap"),
    "database head": written(b"SQLite format 3\0", "x.db3"),
    "picture head": written(b"\xff\xd8\xff\xe0", "x.jpg"),
    "gzip head": written(b"\x1f\x8b\x08\x00", "x.bag.gz"),
    "numbers": written(b"1 2 3 4 5 6 7 8\n" * 3, "x.tum"),
    "not UTF-8": written("timestamp,x\nübel,1\n".encode("latin-1"), "x.csv"),
    "very long line": written(b"a" * 3_000_000, "x.csv"),
}
EVERY = [
    *OF_RECORDINGS,
    *AT_LENGTH[:1],
    *OF_CALIBRATIONS,
    *OF_TRAJECTORIES,
    *chain.from_iterable(OF_WRITTEN.values()),
]


@pytest.mark.parametrize("kind", HOSTILE)
def test_every_verb_refuses_what_is_no_input(tmp_path: Path, files: dict[str, Path], kind: str) -> None:
    """In turn, so that every verb meets every kind over the kinds of the table and a second run of the test."""
    hostile = HOSTILE[kind](tmp_path / "x")
    step = 6
    for command in EVERY[list(HOSTILE).index(kind) % step :: step]:
        code = check(command, hostile, files, kind)
        # an empty bag is one; settings and topics may be empty
        may_pass = (kind.endswith("head") and command.split()[0] in ("inspect", "convert")) or any(
            word in command for word in ("log ", "--topics", "--config", "--prior")
        )
        assert code != 0 or may_pass, (kind, command)


@pytest.mark.slow
@pytest.mark.parametrize("kind", HOSTILE)
def test_all_verbs_refuse_what_is_no_input(tmp_path: Path, files: dict[str, Path], kind: str) -> None:
    hostile = HOSTILE[kind](tmp_path / "x")
    for command in EVERY:
        check(command, hostile, files, kind)


def test_no_verb_is_forgotten() -> None:
    """Verbs without an input of their own: what they take is made by the program or served to it."""
    without = {"demo", "ros node", "ros convert", "fleet monitor"}
    words = {command.split()[0] for command in [*EVERY, *AT_LENGTH]}
    assert {name for name in commands_by_words() if name.split()[0] not in words} <= without
