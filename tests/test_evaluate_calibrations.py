import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import typer

from rigwake.calibration import CalibratedCamera, Calibration, UnobservableDirection, save_calibration
from rigwake.cameras.registry import camera_from_params
from rigwake.cli import console
from rigwake.cli.calibrate import print_calibration
from rigwake.cli.main import build_app, main
from rigwake.errors import InputError
from rigwake.evaluation.rig_errors import compare_calibrations, evaluate_calibration
from rigwake.geometry.se3 import SE3
from rigwake.readers.truth_files import read_true_rig, rig_in_frame
from rigwake.rig import Rig, RigCamera

STD = np.array([1e-3, 2e-3, 3e-3, 0.01, 0.02, 0.03])
LENS = camera_from_params(
    "kb4", np.array([200.4, 200.4, 322.6, 236.9, -0.0115, 0.0062, -0.0034, 0.0005]), 640, 480
)
TRUE = {
    name: SE3.exp(np.array([0.1 * i, 1.2, -0.4 * i, 0.75, -0.2 * i, 1.5]))
    for i, name in enumerate(["front", "port", "aft"])
}
TRUTH = Rig("imu", {name: RigCamera(name, x, time_offset_s=0.01) for name, x in TRUE.items()})


def calibration(errors: dict[str, np.ndarray] | None = None) -> Calibration:
    errors = errors or {}
    cameras = {
        name: CalibratedCamera(
            name, x.retract(errors.get(name, np.zeros(6))), np.diag(STD**2), model=LENS, time_offset_s=0.012
        )
        for name, x in TRUE.items()
    }
    return Calibration("imu", cameras)


def test_errors_are_those_that_were_put_in() -> None:
    wrong = SE3(TRUE["front"].rotation, TRUE["front"].translation + np.array([0.01, -0.02, 0.03]))
    found = calibration()
    cameras = {**found.cameras, "front": replace(found.cameras["front"], rig_from_cam=wrong)}
    e = evaluate_calibration(replace(found, cameras=cameras), TRUTH).cameras["front"]
    np.testing.assert_allclose(e.translation_error_m, [0.01, -0.02, 0.03], atol=1e-12)
    assert e.rotation_error_deg < 1e-6
    assert e.time_offset_error_s == pytest.approx(0.002)
    turned = evaluate_calibration(calibration({"port": np.array([0, 0.01, 0, 0, 0, 0])}), TRUTH)
    assert turned.cameras["port"].rotation_error_deg == pytest.approx(np.rad2deg(0.01))
    by_pair = {(p.first, p.second): p.rotation_error_deg for p in turned.pairs}
    assert by_pair["front", "port"] == pytest.approx(np.rad2deg(0.01))
    assert by_pair["front", "aft"] < 1e-6


def test_nees_of_errors_drawn_from_the_covariance() -> None:
    rng = np.random.default_rng(0)
    draws = [
        evaluate_calibration(calibration({"front": STD * rng.normal(size=6)}), TRUTH).cameras["front"].nees
        for _ in range(400)
    ]
    assert np.mean(draws) == pytest.approx(6, abs=4 * np.sqrt(2 * 6 / 400))


def test_alignment_removes_the_motion_of_the_whole_rig() -> None:
    moved = SE3.exp(np.array([0.1, 0.2, 0.3, 1, 2, 3]))
    found = calibration()
    cameras = {n: replace(c, rig_from_cam=moved * c.rig_from_cam) for n, c in found.cameras.items()}
    errors = evaluate_calibration(replace(found, cameras=cameras), TRUTH, gauge="align")
    for e in errors.cameras.values():
        assert e.rotation_error_deg < 1e-6
        assert e.translation_error_norm_m < 1e-9
        assert e.nees is None


def test_an_unobservable_axis_has_no_error_and_does_not_count() -> None:
    lost = UnobservableDirection(np.eye(6)[5], "vertical offset of front")
    found = calibration()
    cameras = {**found.cameras, "front": replace(found.cameras["front"], unobservable=(lost,))}
    e = evaluate_calibration(replace(found, cameras=cameras), TRUTH).to_json()["cameras"]["front"]
    assert e["translation_error_m"][2] is None
    assert e["translation_error_norm_m"] is None
    assert e["nees_dof"] == 5


def test_nothing_in_common_is_refused() -> None:
    with pytest.raises(InputError, match="no camera in common"):
        evaluate_calibration(calibration(), Rig("imu", {}))
    with pytest.raises(InputError, match="different frames"):
        compare_calibrations(calibration(), replace(calibration(), reference="front"))


def test_difference_in_pixels_falls_with_range() -> None:
    a, b = calibration(), calibration({"front": np.array([0, 0, 0, 0.05, 0, 0])})
    d = compare_calibrations(a, b, (5.0, 50.0))["front"]
    np.testing.assert_allclose(np.linalg.norm(d.translation_mm), 50)
    near, far = d.shift_px[5.0], d.shift_px[50.0]
    assert far[0] == pytest.approx(near[0] / 10, rel=0.05)
    # 5 cm across the axis at 5 m is 0.01 rad: 2 px of a lens with 200 px per radian
    assert 1.0 < near[0] < 2.1
    assert d.sigmas == pytest.approx(0.05 / (0.01 * np.sqrt(2)) / np.sqrt(6), rel=1e-6)


def test_truth_files_and_frames(real_recordings: Path) -> None:
    truth = read_true_rig(real_recordings / "harbour_a/truth.yaml")
    assert list(truth.cameras) == ["front", "left", "back", "right"]
    in_imu = rig_in_frame(truth, "imu")
    expected = truth.rig_from_imu.inverse() * truth.cameras["left"].rig_from_cam
    np.testing.assert_allclose(in_imu.cameras["left"].rig_from_cam.matrix, expected.matrix, atol=1e-12)
    back = rig_in_frame(in_imu, "front").cameras["front"].rig_from_cam
    np.testing.assert_allclose(back.matrix, np.eye(4), atol=1e-12)
    np.testing.assert_allclose(rig_in_frame(truth, "imu").rig_from_imu.matrix, np.eye(4), atol=1e-12)
    with pytest.raises(InputError, match="It knows: base_link, imu, front"):
        rig_in_frame(truth, "mast")


def run(monkeypatch: pytest.MonkeyPatch, *arguments: object) -> int:
    monkeypatch.setattr("sys.argv", ["rigwake", *map(str, arguments)])
    with pytest.raises(SystemExit) as caught:
        main()
    return int(caught.value.code or 0)


def test_commands(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    a, b = tmp_path / "a.yaml", tmp_path / "b.yaml"
    save_calibration(calibration(), a)
    save_calibration(calibration({"front": 2 * STD}), b)
    assert run(monkeypatch, "evaluate", b, "--truth", a, "--json", tmp_path / "e.json") == 0
    assert "next:" in capsys.readouterr().out
    errors = json.loads((tmp_path / "e.json").read_text())["cameras"]
    assert errors["front"]["nees"] == pytest.approx(24, rel=1e-3)
    assert errors["port"]["nees"] == pytest.approx(0, abs=1e-9)
    assert run(monkeypatch, "diff", a, b, "--range", "10", "--json", tmp_path / "d.json") == 0
    shift = json.loads((tmp_path / "d.json").read_text())["cameras"]["front"]["shift_px"]
    assert list(shift) == ["10"]
    assert run(monkeypatch, "evaluate", b, "--truth", tmp_path / "no.yaml") == 1
    assert "There is no file" in capsys.readouterr().err
    assert run(monkeypatch, "evaluate", b, "--truth", a, "--gauge", "odd") == 2
    (tmp_path / "other.yaml").write_text("a: 1")
    assert run(monkeypatch, "evaluate", b, "--truth", tmp_path / "other.yaml") == 1


def test_tables_fit_a_terminal_of_80_columns(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    a, b = tmp_path / "a.yaml", tmp_path / "b.yaml"
    lost = UnobservableDirection(np.eye(6)[5], "vertical offset of front")
    moved = calibration({"port": 3 * STD})
    front = replace(moved.cameras["front"], unobservable=(lost,))
    save_calibration(calibration(), a)
    save_calibration(replace(moved, cameras={**moved.cameras, "front": front}), b)
    monkeypatch.setattr(console.out, "width", 80)
    assert run(monkeypatch, "evaluate", b, "--truth", a) == 0
    assert run(monkeypatch, "diff", a, b) == 0
    print_calibration(replace(moved, cameras={**moved.cameras, "front": front}))
    shown = [line for line in capsys.readouterr().out.splitlines() if "next:" not in line]
    assert max(map(len, shown)) <= 80
    assert "…" not in "".join(shown)
    rows = [line.split() for line in shown if line.startswith(("port", "front", "aft"))]
    assert {row[0] for row in rows} == {"front", "port", "aft"}
    assert len(rows) == 5 * 3  # evaluate, two tables of diff, two of calibrate: one line per camera each
    assert "unobservable" in "".join(shown)
    assert "nan" not in "".join(shown)


def test_every_verb_shows_an_example() -> None:
    for verb, command in typer.main.get_command(build_app()).commands.items():
        assert f"Example: [cyan]rigwake {verb}" in command.help, verb
