"""Recordings with pictures through a fleet: results, resumed work, causes, the same bytes wherever it ran."""

from __future__ import annotations

import csv
import hashlib
import json
import sys
import types
from collections import Counter
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from basin_recording import basin, basin_recording
from calibrated_rigs import boat
from cli_runs import run
from rigwake.calibration import load_calibration, save_calibration
from rigwake.config import load_config
from rigwake.errors import UsageError
from rigwake.fleet.drift_history import DriftHistory, DriftPoint
from rigwake.fleet.fleet_jobs import FleetJob, FleetOutcome
from rigwake.fleet.recording_list import list_recordings
from rigwake.fleet.resume import read_outcome
from rigwake.fleet.run_one import check_machine, run_one
from rigwake.geometry import so3
from rigwake.pipeline.calibration_run import calibrate
from rigwake.tracks import load_tracks
from rigwake.writers.write import write_recording

pytestmark = pytest.mark.xdist_group("fleet")


@dataclass(frozen=True)
class Boats:
    folder: Path
    out: Path
    words: str
    code: int


@pytest.fixture(scope="module")
def boats(tmp_path_factory: pytest.TempPathFactory) -> Boats:
    """Two good bags of one vessel, a cut one, one that is none, one that is not there, one named twice."""
    folder = tmp_path_factory.mktemp("boats")
    write_recording(
        basin_recording(basin(), folder / "memory"), folder / "kiel" / "one.bag", image_encoding="png"
    )
    content = (folder / "kiel" / "one.bag").read_bytes()
    (folder / "kiel" / "two.bag").write_bytes(content)
    (folder / "cut.bag").write_bytes(content[:300_000])
    (folder / "none.bag").write_text("hello\n")
    (folder / "list.txt").write_text(
        "# all\nkiel/one.bag\nkiel/two.bag,kiel\ncut.bag,x\nnone.bag\ngone.bag\nkiel/../cut.bag\n\n"
    )
    ended = run("fleet", "calibrate", folder / "list.txt", "-o", folder / "out", "--jobs", 2)
    return Boats(folder, folder / "out", ended.words, ended.code)


def drift_points(outcomes: list[FleetOutcome]) -> list[DriftPoint]:
    history = DriftHistory()
    for outcome in outcomes:
        history.add(outcome)
    return history.points()


def hashes(out: Path) -> dict[str, str]:
    return {
        f"{path.parent.name}/{path.name}": hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted(out.glob("recordings/*/calibration.yaml"))
    }


@pytest.mark.slow
class TestCalibrate:
    def test_the_end_says_what_came_of_all(self, boats: Boats) -> None:
        assert "2 calibrated, 3 failed (" in boats.words
        for cause in ("1 truncated bag", "1 not a recording", "1 missing path"):
            assert cause in boats.words
        assert "fleet.html" in boats.words
        assert "named more than once" in boats.words
        assert boats.code == 4

    def test_results_are_those_of_calibrate(self, boats: Boats, tmp_path: Path) -> None:
        alone = calibrate(
            boats.folder / "kiel" / "one.bag", tmp_path / "alone", load_config(jobs=1)
        ).calibration
        (folder,) = boats.out.glob("recordings/one-*")
        assert (folder / "report.html").is_file()
        found = load_calibration(folder / "calibration.yaml")
        for name, camera in alone.cameras.items():
            assert abs(found.cameras[name].rig_from_cam.matrix - camera.rig_from_cam.matrix).max() < 1e-9

    def test_tables_hold_every_camera(self, boats: Boats) -> None:
        with (boats.out / "fleet.csv").open(newline="") as file:
            rows = list(csv.DictReader(file))
        assert Counter(row["status"] for row in rows) == Counter(calibrated=4, failed=3)
        assert {row["vessel"] for row in rows if row["status"] == "calibrated"} == {"kiel"}
        assert all(0 < float(row["std_rz_deg"]) < 0.1 for row in rows if row["camera"])
        pq = pytest.importorskip("pyarrow.parquet")
        table = pq.read_table(boats.out / "fleet.parquet").to_pylist()
        assert len(table) == len(rows)
        for row, line in zip(table, rows, strict=True):
            assert row["recording"] == line["recording"]
            assert row["x_m"] == (float(line["x_m"]) if line["x_m"] else None)

    def test_a_second_run_and_a_copy_with_another_time_compute_nothing(self, boats: Boats) -> None:
        before = hashes(boats.out)
        times = {path: path.stat().st_mtime_ns for path in boats.out.glob("recordings/*/calibration.yaml")}
        (boats.folder / "kiel" / "two.bag").touch()
        ended = run(
            "fleet", "calibrate", boats.folder / "list.txt", "-o", boats.out, "--allow-partial", "--json", "-"
        )
        assert ended.code == 0
        assert json.loads(ended.out[ended.out.index("{") :])["counts"] == {"calibrated": 2, "failed": 3}
        assert hashes(boats.out) == before
        assert {path: path.stat().st_mtime_ns for path in times} == times

    def test_dask_gives_the_same_bytes(self, boats: Boats, tmp_path: Path) -> None:
        pytest.importorskip("distributed", reason="the extra `fleet` is not installed")
        ended = run(
            "fleet", "calibrate", boats.folder / "kiel", "-o", tmp_path / "out", "--scheduler", "local:1"
        )
        assert ended.code == 0, ended.words
        assert hashes(tmp_path / "out") == hashes(boats.out)

    def test_cameras_of_one_recording_on_a_cluster(self, boats: Boats, tmp_path: Path) -> None:
        pytest.importorskip("distributed", reason="the extra `fleet` is not installed")
        bag, settings = boats.folder / "kiel" / "one.bag", load_config(jobs=1, stretch_s=10.0)
        here = calibrate(bag, tmp_path / "here", settings).calibration
        words = ("--set", "stretch_s=10", "--jobs", 1, "--scheduler", "local:1")
        ended = run("calibrate", bag, "-o", tmp_path / "there", *words)
        assert ended.code == 0, ended.words
        there = load_calibration(tmp_path / "there" / "calibration.yaml")
        for name, camera in here.cameras.items():
            first, second = (load_tracks(tmp_path / o / "tracks" / f"{name}.npz") for o in ("here", "there"))
            np.testing.assert_array_equal(first.pixels, second.pixels)  # wherever a stretch is tracked
            np.testing.assert_array_equal(first.track_ids, second.track_ids)
            assert abs(there.cameras[name].rig_from_cam.matrix - camera.rig_from_cam.matrix).max() < 1e-9
        (whole,) = boats.out.glob("recordings/one-*")
        for name, camera in load_calibration(whole / "calibration.yaml").cameras.items():
            apart = camera.rig_from_cam.inverse() * here.cameras[name].rig_from_cam
            assert abs(so3.log(apart.rotation)).max() < 5 * np.deg2rad(camera.std_rotation_deg.max())

    def test_the_same_rig_twice_is_no_drift(self, boats: Boats) -> None:
        outcomes = [o for f in boats.out.glob("recordings/*") if (o := read_outcome(f)) and o.is_done]
        points = drift_points(outcomes)
        assert len(points) == 4
        assert max(p.turned_deg for p in points) < 1e-6
        turned = replace(
            outcomes[0],
            cameras={n: {**c, "quat_wxyz": [0.99, 0.14, 0, 0]} for n, c in outcomes[0].cameras.items()},
        )
        assert any(p.is_outlier for p in drift_points([*outcomes, turned]))


class TestMonitor:
    """Against a stand-in for the monitor: what it says becomes statuses."""

    @pytest.mark.parametrize(
        ("states", "exit_code", "status"),
        [
            ({"front": "OK", "port": "OK"}, 0, "ok"),
            ({"front": "OK", "port": "DRIFTED"}, 5, "drifted"),
            ({"front": "OK", "port": "SUSPECT"}, 3, "suspect"),
            ({"front": "OK", "port": "UNOBSERVABLE"}, 3, "ok"),
            ({"front": "UNOBSERVABLE", "port": "UNOBSERVABLE"}, 3, "not observable"),
        ],
    )
    def test_states(self, states, exit_code, status, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:  # type: ignore[no-untyped-def]
        verdicts = {
            n: types.SimpleNamespace(state=s, words="w", size_deg=0.5, size_std_deg=0.1)
            for n, s in states.items()
        }
        result = types.SimpleNamespace(verdicts=verdicts, exit_code=exit_code, notes=("a note",))
        seen: list[Any] = []

        def monitor(calibration, recording, progress):  # type: ignore[no-untyped-def]
            seen.append((calibration.reference, recording.path))
            return result

        package = types.ModuleType("rigwake.monitor")
        run_module, report = (
            types.ModuleType("rigwake.monitor.run"),
            types.ModuleType("rigwake.monitor.monitor_report"),
        )
        run_module.monitor, report.result_to_dict = monitor, lambda result: {"exit_code": result.exit_code}  # type: ignore[attr-defined]
        for name, module in (("", package), (".run", run_module), (".monitor_report", report)):
            monkeypatch.setitem(sys.modules, f"rigwake.monitor{name}", module)
        nmea = tmp_path / "track.txt"
        nmea.write_text("$GPGGA,123519,4807.038,N,01131.000,E,1,08,0.9,545.4,M,46.9,M,,*47\n" * 3)
        save_calibration(boat(), tmp_path / "c.yaml")
        job = FleetJob(str(nmea), str(tmp_path / "out"), "v", "monitor", calibration=str(tmp_path / "c.yaml"))
        outcome = run_one(job)
        assert outcome.status == status, outcome.message
        assert outcome.notes == ("a note",)
        assert seen == [(boat().reference, nmea)]
        assert json.loads((job.result_folder / "monitor.json").read_text()) == {"exit_code": exit_code}
        assert [p.camera for p in drift_points([outcome])] == list(states)


class TestFaults:
    def test_a_worker_of_another_version_or_folder_computes_nothing(self, tmp_path: Path) -> None:
        recording = tmp_path / "a.bag"
        recording.write_text("x")
        job = FleetJob(str(recording), str(tmp_path / "out"))
        for wrong, said in (
            (replace(job, version="9.9"), "rigwake 9.9"),
            (replace(job, token="x"), "is not the folder"),
        ):
            outcome = run_one(wrong)
            assert (outcome.status, outcome.cause, outcome.stored) == ("failed", "computer", False)
            assert said in outcome.message.replace("the client 9.9", "rigwake 9.9")
        check_machine(job)
        assert not (tmp_path / "out").exists()

    def test_a_failure_of_the_recording_is_kept_with_its_words(self, tmp_path: Path) -> None:
        (tmp_path / "a.bag").write_text("hello")
        job = FleetJob(str(tmp_path / "a.bag"), str(tmp_path / "out"), changed_at="now")
        outcome = run_one(job)
        assert outcome.cause == "not a recording"
        assert "Known are ROS 1 bags" in outcome.message
        assert read_outcome(job.result_folder) == outcome

    def test_a_full_disk_is_not_kept_against_the_recording(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        (tmp_path / "a.bag").write_text("hello")

        def full(*_: object) -> None:
            raise OSError(28, "No space left on device", "/out/x")

        monkeypatch.setitem(sys.modules["rigwake.fleet.run_one"]._WORK, "calibrate", full)
        job = FleetJob(str(tmp_path / "a.bag"), str(tmp_path / "out"))
        outcome = run_one(job)
        assert (outcome.cause, outcome.stored) == ("disk full", False)
        assert read_outcome(job.result_folder) is None


class TestLists:
    def test_folders_patterns_and_lists(self, tmp_path: Path) -> None:
        for name in ("a/x.bag", "a/y.mcap", "b/deep/z.bag", "b/notes.md", ".hidden/q.bag"):
            (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
            (tmp_path / name).write_text("x")
        (tmp_path / "b" / "ros2").mkdir()
        (tmp_path / "b" / "ros2" / "metadata.yaml").write_text("")
        (tmp_path / "b" / "ros2" / "ros2_0.db3").write_text("")
        found, again = list_recordings([str(tmp_path)])
        assert [Path(f.path).name for f in found] == ["x.bag", "y.mcap", "z.bag", "ros2"]
        assert [f.vessel for f in found] == ["a", "a", "deep", "b"]
        assert again == 0
        pattern, again = list_recordings(
            [str(tmp_path / "*" / "*.bag"), str(tmp_path / "a" / "x.bag")], "mine"
        )
        assert [(Path(f.path).name, f.vessel) for f in pattern] == [("x.bag", "mine")]
        assert again == 1

    def test_results_are_never_taken_for_recordings(self, tmp_path: Path) -> None:
        (tmp_path / "a.bag").write_text("x")
        picture = tmp_path / "out" / "recordings" / "a-1" / "pictures" / "front" / "1.png"
        picture.parent.mkdir(parents=True)
        picture.write_bytes(b"")
        found, _ = list_recordings([str(tmp_path)], out=tmp_path / "out")
        assert [Path(f.path).name for f in found] == ["a.bag"]
        (tmp_path / "rec").mkdir()
        (tmp_path / "rec" / "imu.csv").write_text("")
        with pytest.raises(UsageError, match="lies in the recording"):
            list_recordings([str(tmp_path / "rec")], out=tmp_path / "rec" / "out")

    @pytest.mark.parametrize(
        ("content", "names"),
        [
            (b"\xef\xbb\xbfa.bag\r\nb.bag,vessel\r\n", ["a.bag", "b.bag"]),
            (b"# only\n\n  a.bag  \n", ["a.bag"]),
            (b"with, comma.bag\n", ["with, comma.bag"]),
            ("schön.bag\n".encode(), ["schön.bag"]),
        ],
    )
    def test_lines_of_lists(self, content: bytes, names: list[str], tmp_path: Path) -> None:
        (tmp_path / "with, comma.bag").write_text("x")
        (tmp_path / "list.txt").write_bytes(content)
        found, _ = list_recordings([str(tmp_path / "list.txt")])
        assert [Path(f.path).name for f in found] == names
