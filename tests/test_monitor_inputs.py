"""What cannot be monitored is refused before any work, in words; and the verbs' exit codes."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from monitor_worlds import Watch, watch
from rigwake.calibration import Calibration, UnobservableDirection, load_calibration, save_calibration
from rigwake.cli.log import parse_time
from rigwake.cli.main import build_app
from rigwake.errors import InputError, UnobservableError, UsageError
from rigwake.geometry import so3
from rigwake.geometry.se3 import SE3
from rigwake.logbook.store import Logbook
from rigwake.monitor.kept_result import recalibrate_with_log
from rigwake.monitor.knocks import knocks_inside
from rigwake.monitor.monitor_page import render_page
from rigwake.monitor.monitor_report import logged_verdicts, result_to_dict, verdict_line
from rigwake.monitor.recalibration import Recalibration, _shift, recalibrate
from rigwake.monitor.run import CameraVerdict, monitor
from rigwake.monitor.states import CameraState
from rigwake.monitor.thresholds import Thresholds
from rigwake.monitor.vessel_rig import prepare_rig
from rigwake.simulation.track_stream import MountFault


@pytest.fixture(scope="module")
def world() -> Watch:
    return watch(
        "eights",
        70.0,
        seed=7,
        cameras=3,
        fault=MountFault("left", 30.0, turned_rad=np.deg2rad([0.3, 0, 0.4])),
    )


def test_another_vessel_is_refused_before_any_work(world: Watch) -> None:
    other = replace(world.recording, cameras={f"mast_{n}": c for n, c in world.recording.cameras.items()})
    with pytest.raises(InputError, match="not of the calibrated vessel: there is no camera front"):
        monitor(world.calibration, other)
    front = world.recording.cameras["front"]
    larger = replace(front, width_px=1280, height_px=960, model=None)
    other = replace(world.recording, cameras={**world.recording.cameras, "front": larger})
    with pytest.raises(InputError, match="front has 1280x960 pixels, not 560x420"):
        monitor(world.calibration, other)
    assert front.model is not None
    lens = front.model.with_params(front.model.params * 1.01)
    other = replace(world.recording, cameras={**world.recording.cameras, "front": replace(front, model=lens)})
    with pytest.raises(InputError, match="lens of front differs"):
        monitor(world.calibration, other)


def test_what_is_missing_is_told(world: Watch) -> None:
    with pytest.raises(InputError, match="no IMU"):
        monitor(world.calibration, replace(world.recording, imus={}))
    one = replace(world.calibration, cameras={"front": world.calibration.cameras["front"]})
    with pytest.raises(UnobservableError, match="Only 1 camera"):
        monitor(one, world.recording)
    imu = world.recording.imus["imu"]
    back = imu.timestamps_ns.copy()
    back[100] = back[50]
    with pytest.raises(InputError, match="runs back"):
        monitor(world.calibration, replace(world.recording, imus={"imu": replace(imu, timestamps_ns=back)}))
    short = replace(imu, timestamps_ns=imu.timestamps_ns[:1500], gyro=imu.gyro[:1500], accel=imu.accel[:1500])
    with pytest.raises(UnobservableError, match="15 s"):
        monitor(world.calibration, replace(world.recording, imus={"imu": short}))
    with pytest.raises(InputError, match="in the frame of front"):
        monitor(replace(world.calibration, reference="front"), world.recording)


def test_a_calibration_in_the_frame_of_the_base_gives_the_same(world: Watch) -> None:
    base_from_imu = SE3(so3.exp(np.array([0.02, -0.3, 1.0])), np.array([0.4, -0.2, 1.1]))
    frame = world.recording.imus["imu"].frame_id
    recording = replace(world.recording, static_transforms={("base_link", frame): base_from_imu})
    cameras = {
        name: replace(c, rig_from_cam=base_from_imu * c.rig_from_cam)
        for name, c in world.calibration.cameras.items()
    }
    prepared = prepare_rig(replace(world.calibration, reference="base_link", cameras=cameras), recording)
    for name, camera in prepared.rig.cameras.items():
        expected = world.calibration.cameras[name].rig_from_cam
        np.testing.assert_allclose(camera.rig_from_cam.matrix, expected.matrix, atol=1e-12)


def test_numbers_that_the_calibration_lacks(world: Watch) -> None:
    front = world.calibration.cameras["front"]
    blind = UnobservableDirection(np.eye(6)[0], "turn of front")
    without = replace(world.calibration.cameras["left"], unobservable=(blind,))
    loose = replace(front, unobservable=(UnobservableDirection(np.eye(6)[5], "height of front"),))
    changed = replace(
        world.calibration, cameras={**world.calibration.cameras, "left": without, "front": loose}
    )
    prepared = prepare_rig(changed, world.recording)
    assert list(prepared.rig.cameras) == ["front", "back"]
    assert "left" in prepared.left_out
    assert np.isfinite(prepared.rig.cameras["front"].rig_from_cam.translation).all()


def test_a_knock_inside_the_recording_that_was_calibrated(world: Watch) -> None:
    """Half a degree after 30 s, held against the calibration of the time before."""
    (sentence,) = knocks_inside(world.calibration, world.recording, world.tracks)
    assert sentence.startswith("left: it turned on its mount by about 0.")
    assert "30 to 40 s after the start" in sentence
    assert "--duration" in sentence


def test_standstill_tells_axes_and_what_would_help() -> None:
    still = watch("standstill", 30.0, hs_m=0.02, cameras=2)
    result = monitor(still.calibration, still.recording, tracks=still.tracks)
    assert result.exit_code == 3
    for verdict in result.verdicts.values():
        assert verdict.state is CameraState.UNOBSERVABLE
        assert "the vertical" in verdict.words
        assert "no way made" in verdict.words
        assert "what helps: sailing" in verdict.words
    assert result_to_dict(result)["cues"]["overlap"]["words"] == "overlap: saw nothing"
    assert all(cue.words in render_page(result, still.recording) for cue in result.cues.values())


def test_the_logbook_follows_a_recalibration(
    world: Watch, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """RECALIBRATING while a camera is measured; then the new calibration is in force and OK, or all is as before."""
    log, starts = tmp_path / "vessel.db", np.array([10**10, 2 * 10**10, 3 * 10**10])
    drifted = CameraVerdict("left", CameraState.DRIFTED, np.full(3, 0.02), "0.50 ± 0.02 deg (step)")
    judgement = SimpleNamespace(
        alarms=(
            SimpleNamespace(
                camera="left",
                explanations=(SimpleNamespace(cause="rotation"),),
                change=SimpleNamespace(kind="step"),
            ),
        ),
        scores=SimpleNamespace(starts_ns=starts),
    )
    result: Any = SimpleNamespace(verdicts={"left": drifted}, blamed=("left",), judgement=judgement)
    monkeypatch.setattr("rigwake.monitor.recalibration._blamed", lambda r: ("left", r.judgement.alarms[0]))

    def states() -> list[str]:
        with Logbook(log) as book:
            return [v.state for v in book.verdicts("left")]

    def refused(*_: object) -> Recalibration:
        assert states()[-1] == "RECALIBRATING"
        raise UnobservableError("Too little motion.")

    def measured(*_: object) -> Recalibration:
        assert states()[-1] == "RECALIBRATING"
        left = replace(world.calibration.cameras["left"], time_offset_std_s=0.5)
        new = replace(world.calibration, cameras={**world.calibration.cameras, "left": left})
        return Recalibration(new, "left", np.zeros(3), np.eye(3) * 1e-8, 3, np.zeros(3), int(starts[1]))

    written: list[Calibration] = []
    monkeypatch.setattr("rigwake.monitor.kept_result.recalibrate", refused)
    with pytest.raises(UnobservableError):
        recalibrate_with_log(world.calibration, world.recording, result, log, written.append)
    assert states() == ["RECALIBRATING", "DRIFTED"]
    assert not written
    monkeypatch.setattr("rigwake.monitor.kept_result.recalibrate", measured)
    recalibrate_with_log(world.calibration, world.recording, result, log, written.append)
    assert states()[2:] == ["RECALIBRATING", "OK"]
    with Logbook(log) as book:
        assert [entry.supersedes for entry in book.calibrations()] == [None, 1]
        assert book.verdicts("left")[-1].calibration_id == book.at(int(starts[1])).id == 2


@pytest.mark.slow
def test_from_alarm_to_new_calibration_and_logbook(world: Watch, tmp_path: Path) -> None:
    result = monitor(world.calibration, world.recording, tracks=world.tracks)
    assert result.blamed == ("left",)
    assert result.exit_code == 5
    verdict = result.verdicts["left"]
    assert verdict.size_deg is not None
    assert abs(verdict.size_deg - 0.5) < 0.1  # three cameras, thirty seconds: 0.03 deg
    line = verdict_line(verdict, "rigwake recalibrate c.yaml r.bag -o NEW.yaml")
    assert line.startswith("left  DRIFTED  0.")
    assert "(step); run: rigwake recalibrate" in line
    assert result.verdicts["front"].words.startswith("to 0.")
    content = result_to_dict(result)
    assert content["cameras"]["left"]["state"] == "DRIFTED"
    found = recalibrate(world.calibration, result)
    old, new = world.calibration.cameras["left"].rig_from_cam, found.calibration.cameras["left"].rig_from_cam
    turn = so3.log(new.rotation @ old.rotation.T)
    error = turn - np.deg2rad([0.3, 0, 0.4])
    assert np.rad2deg(np.linalg.norm(error)) < 0.1
    assert error @ np.linalg.solve(found.covariance, error) < 20
    assert not found.shift.any()  # it turned about its optical centre
    save_calibration(found.calibration, tmp_path / "new.yaml")
    again = load_calibration(tmp_path / "new.yaml")
    with Logbook(tmp_path / "vessel.db", create=True) as book:
        first = book.add(world.calibration, 1)
        assert verdict.since_ns is not None
        second = book.add(again, verdict.since_ns)
        book.add_verdicts(first, logged_verdicts(result, Path("r.bag")))
        assert book.at(verdict.since_ns + 1).id == second
        assert book.at(verdict.since_ns - 1).id == first
        assert {v.state for v in book.verdicts("left")} == {"DRIFTED"}
    after = monitor(found.calibration, world.recording, tracks=world.tracks)
    assert after.verdicts["front"].state in (CameraState.OK, CameraState.UNOBSERVABLE)
    with pytest.raises(UsageError, match="blamed"):
        recalibrate(world.calibration, replace(result, verdicts={"front": result.verdicts["front"]}))


def test_a_shift_is_measured_where_the_motion_shows_it(world: Watch) -> None:
    """Along the bow after minutes of figure eights; along other directions the place stays."""
    scores = world.scores()
    many = scores.take(np.tile(np.arange(1, 3), 20))  # before the camera moved, as often as needed
    known = SimpleNamespace(
        monitored=prepare_rig(world.calibration, world.recording), thresholds=Thresholds()
    )
    at = many.columns(1, 1)
    moved = replace(many, g=0.08 * many.H[:, :, at.start])
    found = _shift(moved, "left", known)  # type: ignore[arg-type]
    assert found is not None
    assert abs(found.shift[0] - 0.08) < 0.01  # what lies along unseen directions stays out
    assert found.directions.shape[1] < 3 or np.linalg.norm(found.shift[1:]) < 0.03
    assert _shift(replace(many, g=0 * many.g), "left", known) is None  # type: ignore[arg-type]


def test_truncated_and_empty_calibrations_exit_with_one(tmp_path: Path, world: Watch) -> None:
    good = tmp_path / "good.yaml"
    save_calibration(world.calibration, good)
    text = good.read_text()
    for k, content in enumerate((text[: len(text) // 2], "", "\0" * 400)):
        bad = tmp_path / f"bad{k}.yaml"
        bad.write_text(content)
        outcome = CliRunner().invoke(build_app(), ["monitor", str(bad), str(tmp_path)])
        assert isinstance(outcome.exception, InputError), k


def test_log_verb(tmp_path: Path, world: Watch) -> None:
    file, book = tmp_path / "c.yaml", tmp_path / "vessel.db"
    save_calibration(world.calibration, file)
    app, run = build_app(), CliRunner()

    def log(*arguments: str) -> str:
        outcome = run.invoke(app, ["log", *arguments])
        assert outcome.exit_code == 0, outcome.exception
        return outcome.output

    log("add", str(book), str(file), "--from", "2026-05-01T08:00")
    turned = replace(world.calibration, checks={"again": 1})
    save_calibration(turned, file)
    log("add", str(book), str(file), "--from", "2026-06-01T08:00", "--note", "after the storm")
    assert "after the storm" in log("list", str(book))
    assert "calibration 1" in log("at", str(book), "2026-05-20T00:00:00")
    log("show", str(book), "2", "-o", str(tmp_path / "two.yaml"))
    assert load_calibration(tmp_path / "two.yaml").checks == {"again": 1}
    assert "0.0000" in log("diff", str(book), "1", "2")
    log("plot", str(book), "-o", str(tmp_path / "page.html"))
    assert "Turned since" in (tmp_path / "page.html").read_text()
    log("export", str(book), "-o", str(tmp_path / "copy.db"))
    with Logbook(tmp_path / "copy.db") as copied:
        assert len(copied.calibrations()) == 2
    assert isinstance(run.invoke(app, ["log", "burn", str(book)]).exception, UsageError)
    assert isinstance(run.invoke(app, ["log", "at", str(book)]).exception, UsageError)
    assert isinstance(run.invoke(app, ["log", "at", str(book), "yesterday"]).exception, UsageError)


def test_times() -> None:
    assert parse_time("1970-01-01T00:00:01.5") == 1_500_000_000
    assert parse_time("1970-01-01T01:00:00+01:00") == 0
    assert parse_time("12") == 12
