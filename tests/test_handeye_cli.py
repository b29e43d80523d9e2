"""`rigwake handeye` end to end: files in, json and calibration out, exit codes."""

import json
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from handeye_scenes import PORT, planar, standstill, wavy
from rigwake.calibration import CalibratedCamera, load_calibration
from rigwake.calibration.rig_calibration import UnobservableDirection
from rigwake.cli.main import main
from rigwake.geometry.se3 import SE3
from rigwake.handeye.handeye_problem import HandeyeResult
from rigwake.readers.open import open_recording
from rigwake.writers import trajectory_writer

TIMES = np.arange(200) * 0.1


def write_tum(path: Path, poses: SE3, offset_s: float = 0.0) -> Path:
    q = poses.quat_wxyz
    rows = np.column_stack([TIMES + offset_s, poses.translation, q[:, 1:], q[:, 0]])
    np.savetxt(path, rows, fmt="%.12f")
    return path


@pytest.fixture
def run(monkeypatch, capsys):
    """Runs the verb in this process: (exit code, standard output)."""

    def call(*arguments) -> tuple[int, str]:
        monkeypatch.setattr(sys, "argv", ["rigwake", "handeye", *map(str, arguments)])
        with pytest.raises(SystemExit) as ended:
            main()
        return int(ended.value.code or 0), capsys.readouterr().out

    return call


def test_result_in_json_and_calibration(tmp_path, run):
    rig = write_tum(tmp_path / "rig.tum", wavy(TIMES))
    port = write_tum(tmp_path / "port.tum", wavy(TIMES) * PORT, offset_s=300.0)
    code, printed = run(rig, port, "--json", tmp_path / "out.json", "-o", tmp_path / "calibration.yaml")
    assert code == 0
    assert "next:" in printed
    content = json.loads((tmp_path / "out.json").read_text())
    member = content["members"]["port"]
    assert content["reference"] == "rig"
    assert member["time_offset_s"] == pytest.approx(-300, abs=1e-6)
    assert member["ref_from_member"]["translation_m"] == pytest.approx(PORT.translation, abs=1e-6)
    assert abs(np.dot(member["ref_from_member"]["quat_wxyz"], PORT.quat_wxyz)) == pytest.approx(1)
    assert member["unobservable"] == []
    camera = load_calibration(tmp_path / "calibration.yaml").camera("port")
    assert np.abs(PORT.local(camera.rig_from_cam)).max() < 1e-6


def test_provenance_identifies_the_inputs(tmp_path, run):
    rig = write_tum(tmp_path / "rig.tum", wavy(TIMES))
    port = write_tum(tmp_path / "port.tum", wavy(TIMES) * PORT)
    for output in ("first.yaml", "second.yaml"):
        assert run(rig, port, "-o", tmp_path / output)[0] == 0
        write_tum(port, wavy(TIMES) * PORT * PORT)
    first, second = (
        load_calibration(tmp_path / name).provenance["inputs"] for name in ("first.yaml", "second.yaml")
    )
    assert [one["path"] for one in first] == ["rig.tum", "port.tum"]
    assert first[0] == second[0]
    assert first[1]["sha256"] != second[1]["sha256"]


def test_pose_topic_of_a_bag(tmp_path, run, real_recordings):
    """A camera bolted to a real robot that drives on a plane, the robot's odometry in a bag."""
    bag, topic = real_recordings / "rosbags" / "husky_imu_odom_gps.bag", "/husky_velocity_controller/odom"
    odometry = open_recording(bag).poses["odom"]
    camera = replace(odometry, name="port", world_from_body=odometry.world_from_body * PORT, covariances=None)
    file, output = tmp_path / "port.tum", tmp_path / "calibration.yaml"
    trajectory_writer.write_tum(camera, file)
    assert run(f"{bag}:/no/such/topic", file)[0] == 2
    code, printed = run(f"{bag}:{topic}", file, "--json", "-", "-o", output)
    assert code == 0
    offset = json.loads(printed)["members"]["port"]["ref_from_member"]["translation_m"]
    assert offset[:2] == pytest.approx(PORT.translation[:2], abs=1e-3)
    assert offset[2] is None
    assert load_calibration(output).provenance["inputs"][0]["topic"] == topic


def test_open_axis_is_null_and_named(tmp_path, run):
    rig = write_tum(tmp_path / "rig.tum", planar(TIMES))
    port = write_tum(tmp_path / "port.tum", planar(TIMES) * PORT)
    code, printed = run(rig, port, "--json", "-", "--no-time-offset")
    assert code == 0
    member = json.loads(printed)["members"]["port"]
    assert member["ref_from_member"]["translation_m"][2] is None
    assert member["std"]["translation_m"][2] is None
    assert None not in member["ref_from_member"]["translation_m"][:2]
    assert member["time_offset_s"] is None
    assert "offset along z of rig" in member["unobservable"][0]["words"]


def test_exit_codes(tmp_path, run):
    still = write_tum(tmp_path / "still.tum", standstill(TIMES))
    other = write_tum(tmp_path / "other.tum", standstill(TIMES))
    assert run(still, other)[0] == 3
    assert run(still, other, "--noise", "loud")[0] == 2
    assert run(still, tmp_path / "missing.tum")[0] == 1


def test_what_determines_nothing_ends_with_exit_code_3(tmp_path, run, monkeypatch):
    """One axis of a rotation alone is no number: files hold null, and the exit code says so."""
    one_axis = CalibratedCamera(
        "port",
        SE3.identity(),
        np.eye(6),
        unobservable=tuple(UnobservableDirection(axis, "open", "Turn.") for axis in np.eye(6)[1:]),
    )
    assert not one_axis.has_figures
    assert replace(one_axis, unobservable=one_axis.unobservable[2:]).has_figures
    there, empty = {"port": SE3.identity()}, {"port": np.empty((0, 2))}
    nothing = HandeyeResult(
        "rig", {"port": one_axis}, there, np.eye(6), empty, "increments", 5, 0, 3, converged=True
    )
    monkeypatch.setattr("rigwake.pipeline.handeye_run.calibrate_handeye", lambda *_: nothing)
    rig = write_tum(tmp_path / "rig.tum", wavy(TIMES))
    code, _ = run(rig, rig, "--json", tmp_path / "out.json")
    assert code == 3
    assert (
        json.loads((tmp_path / "out.json").read_text())["members"]["port"]["std"]["translation_m"]
        == [None] * 3
    )
