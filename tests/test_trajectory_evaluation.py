"""A trajectory against a known one: what a known error must give, and the page."""

import numpy as np
import pytest

from cli_runs import run, write_trajectories
from rigwake.evaluation.trajectory_evaluation import evaluate_trajectory, usual_alignment
from rigwake.geometry.se3 import SE3
from rigwake.readers.trajectories import read_trajectory
from rigwake.report.trajectory_page import trajectory_page
from rigwake.trajectory import Trajectory


@pytest.fixture
def truth(tmp_path) -> Trajectory:
    write_trajectories(tmp_path)
    return read_trajectory(tmp_path / "rig.tum").trajectory


def test_another_origin_and_scale_are_fitted(truth):
    moved = SE3.exp(np.array([0.1, 0.2, 2.0, 5.0, -3.0, 1.0])) * truth.world_from_body
    small = Trajectory("found", truth.timestamps_ns, SE3(moved.rotation, 0.5 * moved.translation))
    whole = Trajectory("found", truth.timestamps_ns, moved)
    assert evaluate_trajectory(truth, whole).absolute.rmse_m < 1e-9
    assert evaluate_trajectory(truth, whole, alignment=None).absolute.rmse_m > 1
    fitted = evaluate_trajectory(truth, small, alignment="sim3")
    assert fitted.absolute.scale == pytest.approx(2.0)
    assert fitted.position_error_m.max() < 1e-9
    assert fitted.relative is not None
    assert fitted.relative.rmse_m < 1e-9
    assert evaluate_trajectory(truth, small).absolute.rmse_m > 0.1


def test_a_known_error_is_found(truth):
    rng = np.random.default_rng(1)
    noise = np.zeros((len(truth), 6))
    noise[:, :3] = np.deg2rad(0.5) * rng.standard_normal((len(truth), 3))
    turned = truth.world_from_body * SE3.exp(noise)
    found = evaluate_trajectory(truth, Trajectory("found", truth.timestamps_ns, turned))
    assert found.absolute.rotation_rmse_deg == pytest.approx(0.5 * np.sqrt(3), rel=0.1)
    assert found.absolute.rmse_m < 1e-6
    assert found.kitti is None
    assert found.to_json()["kitti"] is None


def test_kitti_measures_a_wrong_scale(truth):
    straight = np.stack([np.arange(len(truth)) * 1.0, np.zeros(len(truth)), np.zeros(len(truth))], axis=1)
    known = Trajectory("t", truth.timestamps_ns, SE3(truth.world_from_body.rotation, straight))
    longer = Trajectory("f", truth.timestamps_ns, SE3(truth.world_from_body.rotation, 1.02 * straight))
    found = evaluate_trajectory(known, longer, alignment=None)
    assert found.kitti is not None
    assert found.kitti.t_rel_percent == pytest.approx(2.0, rel=0.02)
    assert found.kitti.r_rel_deg_per_100m < 1e-6


def test_the_page_shows_both_paths_and_loads_nothing(truth):
    page = trajectory_page(evaluate_trajectory(truth, truth), "found<.tum", "truth.tum")
    assert page.count("<svg") == 3
    assert "found&lt;.tum" in page
    assert "http" not in page.replace("http://www.w3.org", "").replace("http-equiv", "")
    assert "<script" not in page


def test_up_to_scale_is_aligned_with_scale(truth):
    assert usual_alignment(truth) == "se3"
    assert (
        usual_alignment(Trajectory("t", truth.timestamps_ns, truth.world_from_body, is_metric=False))
        == "sim3"
    )


def test_the_verb_says_the_figures(truth, tmp_path):
    ended = run(
        "evaluate", tmp_path / "port.tum", "--truth", tmp_path / "port.tum", "--html", tmp_path / "e.html"
    )
    assert ended.code == 0
    assert "ATE, RMS" in ended.out
    assert "0.0000 m" in ended.out
    assert (tmp_path / "e.html").is_file()
