"""The logbook: what it acknowledged stays, whatever happens; what is not right is refused in words."""

from __future__ import annotations

import random
import shutil
import signal
import sqlite3
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from rigwake.calibration import CalibratedCamera, Calibration
from rigwake.cameras.registry import camera_from_dict
from rigwake.errors import InputError, RigwakeError, UsageError
from rigwake.geometry import so3
from rigwake.geometry.se3 import SE3
from rigwake.logbook.logbook_page import render_history
from rigwake.logbook.store import Logbook, LoggedVerdict
from rigwake.logbook.vessel_fingerprint import VesselFingerprint, fingerprint_of_calibration


def calibration(
    turn_deg: float = 0.0, names: tuple[str, ...] = ("front", "left"), fx: float = 200.0
) -> Calibration:
    model = camera_from_dict(
        {
            "model": "kb4",
            "width_px": 640,
            "height_px": 480,
            "params": {
                "fx": fx,
                "fy": 200.0,
                "cx": 320,
                "cy": 240,
                "k1": 0.0,
                "k2": 0.0,
                "k3": 0.0,
                "k4": 0.0,
            },
            "max_angle_deg": 92,
        }
    )
    cameras = {
        name: CalibratedCamera(
            name,
            SE3(so3.exp(np.deg2rad([turn_deg, 0, 0])), np.array([k, 0.0, 1.0])),
            np.eye(6) * 1e-6,
            model=model,
        )
        for k, name in enumerate(names)
    }
    return Calibration("imu", cameras)


def verdict(k: int, words: str = "to 0.05 deg") -> LoggedVerdict:
    return LoggedVerdict("front", "OK", None, None, words, f"{k}.bag", k, k + 1, evidence={"k": k})


def test_validity_follows_the_entries(tmp_path: Path) -> None:
    with Logbook(tmp_path / "vessel.db", create=True) as book:
        june, august = book.add(calibration(0.0), 100), book.add(calibration(0.5), 300)
        july = book.add(calibration(0.2), 200, "refitted")
        assert [(e.id, e.valid_from_ns, e.valid_to_ns) for e in book.calibrations()] == [
            (june, 100, 200),
            (july, 200, 300),
            (august, 300, None),
        ]
        assert book.at(299).id == july
        assert book.add(calibration(0.5), 999) == august  # the very same again
        with pytest.raises(UsageError, match="valid at that time"):
            book.at(99)
        with pytest.raises(UsageError, match="same time"):
            book.add(calibration(0.7), 200)
        with pytest.raises(UsageError, match="no calibration 9"):
            book.load(9)
        loaded = book.load(july)
    np.testing.assert_allclose(
        loaded.cameras["left"].rig_from_cam.rotation, calibration(0.2).cameras["left"].rig_from_cam.rotation
    )


def test_verdicts_and_page(tmp_path: Path) -> None:
    with Logbook(tmp_path / "vessel.db", create=True) as book:
        number = book.add(calibration(), 10**18)
        book.add(calibration(0.3), 10**18 + 10**15)
        drifted = replace(
            verdict(5, "<script>"), state="DRIFTED", size_deg=0.4, begin_ns=10**18, end_ns=10**18 + 5
        )
        book.add_verdicts(number, [verdict(1), drifted])
        assert [v.state for v in book.verdicts("front")] == ["OK", "DRIFTED"]
        assert not book.verdicts("left")
        page = render_history(book)
        with pytest.raises(RigwakeError):  # no such calibration: nothing of the batch is kept
            book.add_verdicts(77, [verdict(8)])
        assert len(book.verdicts()) == 2
    assert "<script>" not in page
    assert "DRIFTED" in page
    assert "<svg" in page


def test_another_vessel_is_refused(tmp_path: Path) -> None:
    with Logbook(tmp_path / "vessel.db", create=True) as book:
        book.add(calibration(), 1)
        with pytest.raises(InputError, match="another vessel: there is no camera left"):
            book.add(calibration(names=("front", "right")), 2)
        with pytest.raises(InputError, match="lens of front differs"):
            book.add(calibration(fx=204.0), 2)
        assert len(book.calibrations()) == 1


def test_fingerprints() -> None:
    mine = fingerprint_of_calibration(calibration())
    assert VesselFingerprint.from_json(mine.to_json()) == mine
    assert mine.digest == fingerprint_of_calibration(calibration(turn_deg=3.0)).digest
    more = fingerprint_of_calibration(calibration(names=("front", "left", "mast")))
    assert not mine.differences(more)
    assert more.differences(mine)
    unknown = fingerprint_of_calibration(
        replace(calibration(), cameras={n: replace(c, model=None) for n, c in calibration().cameras.items()})
    )
    assert not mine.differences(unknown)


def test_a_file_from_a_newer_version_is_left_alone(tmp_path: Path) -> None:
    path = tmp_path / "vessel.db"
    with Logbook(path, create=True) as book:
        book.add(calibration(), 1)
    with sqlite3.connect(path) as db:
        db.execute("PRAGMA user_version = 99")
    db.close()
    with pytest.raises(InputError, match="version 99"):
        Logbook(path)


@pytest.mark.parametrize(
    "content", [b"not a database at all, but long enough to be one" * 30, b"SQLite format 3\0" + b"\0" * 500]
)
def test_other_files_are_refused(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "vessel.db"
    path.write_bytes(content)
    with pytest.raises(RigwakeError) as caught:
        Logbook(path, create=True)
    assert caught.value.consequence
    assert path.read_bytes() == content


def test_another_programs_database_is_left_alone(tmp_path: Path) -> None:
    path = tmp_path / "other.db"
    with sqlite3.connect(path) as db:
        db.execute("CREATE TABLE mine (x)")
    db.close()
    with pytest.raises(InputError, match="not a rigwake logbook"):
        Logbook(path, create=True)


def test_missing_and_unwritable_places_are_told(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no logbook"):
        Logbook(tmp_path / "none.db")
    with pytest.raises(RigwakeError, match="cannot be written or opened"):
        Logbook(tmp_path / "no folder" / "vessel.db", create=True)


def test_a_full_disk_says_so(tmp_path: Path) -> None:
    with Logbook(tmp_path / "vessel.db", create=True) as book:
        number = book.add(calibration(), 1)
        pages = book._db.execute("PRAGMA page_count").fetchone()[0]
        book._db.execute(f"PRAGMA max_page_count = {pages}")
        with pytest.raises(RigwakeError, match="is full"):
            book.add_verdicts(number, [verdict(k, "w" * 3000) for k in range(50)])
        book._db.execute("PRAGMA max_page_count = 1000000")
        assert not book.verdicts()
        book.add_verdicts(number, [verdict(1)])


def test_tampered_text_is_noticed(tmp_path: Path) -> None:
    with Logbook(tmp_path / "vessel.db", create=True) as book:
        number = book.add(calibration(), 1)
        book._db.execute("UPDATE calibration SET document = replace(document, 'front', 'stern')")
        with pytest.raises(InputError, match="checksum"):
            book.load(number)


def test_a_copy_taken_while_others_write_opens(tmp_path: Path) -> None:
    path = tmp_path / "vessel.db"
    with Logbook(path, create=True) as book, Logbook(path) as other:
        number = book.add(calibration(), 1)
        book._db.execute("BEGIN IMMEDIATE")
        book._db.execute("UPDATE calibration SET note = 'half'")
        other.copy_to(tmp_path / "copy.db")
        for part in ("", "-wal"):  # and a plain copy of the files
            shutil.copy(f"{path}{part}", tmp_path / f"plain.db{part}")
        book._db.execute("ROLLBACK")
    for name in ("copy.db", "plain.db"):
        with Logbook(tmp_path / name) as copied:
            assert [(e.id, e.note) for e in copied.calibrations()] == [(number, "")]


_WRITER = """
import sys
from rigwake.logbook.store import Logbook, LoggedVerdict
path, name, count = sys.argv[1], sys.argv[2], int(sys.argv[3])
with Logbook(path) as book:
    for k in range(count):
        pair = [LoggedVerdict("front", "OK", None, None, part, name, k, k) for part in ("first", "second")]
        book.add_verdicts(1, pair)
        print(k, flush=True)
"""


def crash_round(path: Path, writers: int, each: int, rng: random.Random) -> int:
    """Processes write pairs, one of them is killed; every acknowledged pair is there, and no half of one.

    A copy is taken meanwhile, which opens and holds no half either. How many writes were acknowledged.
    """
    running = [
        subprocess.Popen(
            [sys.executable, "-c", _WRITER, str(path), f"w{w}", str(each)], stdout=subprocess.PIPE, text=True
        )
        for w in range(writers)
    ]
    killed = rng.randrange(writers)
    victim = running[killed].stdout
    assert victim is not None
    seen = sum(
        1 for _ in zip(range(rng.randint(1, each // 2)), victim, strict=False)
    )  # in the middle of its work
    running[killed].send_signal(signal.SIGKILL)
    with Logbook(path) as book:
        book.copy_to(path.with_name(f"{path.stem}-copy.db"))
    acknowledged = {f"w{w}": len(p.communicate(timeout=300)[0].split()) for w, p in enumerate(running)}
    acknowledged[f"w{killed}"] += seen
    assert running[killed].returncode == -signal.SIGKILL
    with Logbook(path) as book:
        found = book.verdicts()
        assert book._db.execute("PRAGMA integrity_check").fetchone()[0] == "ok"
    with Logbook(path.with_name(f"{path.stem}-copy.db")) as copied:
        assert len(copied.verdicts()) % 2 == 0
        assert copied._db.execute("PRAGMA integrity_check").fetchone()[0] == "ok"
    for name, count in acknowledged.items():
        first = {v.begin_ns for v in found if v.recording == name and v.words == "first"}
        second = {v.begin_ns for v in found if v.recording == name and v.words == "second"}
        assert first == second  # nothing half-written
        assert first >= set(range(count))  # nothing acknowledged is lost
    assert all(acknowledged[f"w{w}"] == each for w in range(writers) if w != killed)
    return sum(acknowledged.values())


@pytest.mark.slow
def test_writers_that_are_killed_lose_nothing_acknowledged(tmp_path: Path) -> None:
    """Eight processes, a thousand writes, one killed at random; a few rounds here, twenty in a long run."""
    rng = random.Random(3)
    for k in range(3):
        path = tmp_path / f"vessel{k}.db"
        with Logbook(path, create=True) as book:
            book.add(calibration(), 1)
        crash_round(path, 8, 125, rng)
