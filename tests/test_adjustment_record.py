"""What the bundle adjustment leaves for the report: written from a problem, read again, bounded."""

from pathlib import Path

import numpy as np
import pytest

from ba_rigs import Wanted, true_problem
from rigwake.ba.solver.rig_problem import RigProblem
from rigwake.errors import InputError
from rigwake.pipeline import adjustment_record
from rigwake.pipeline.adjustment_record import write_adjustment
from rigwake.report.adjustment_file import read_adjustment
from rigwake.report.sensor_charts import sensor_charts


@pytest.fixture(scope="module")
def problem() -> RigProblem:
    return true_problem(Wanted(cameras=2, seconds=12, landmarks=200, gnss_std=0.02, far=20_000))


def test_sensors_at_the_truth_leave_their_noise(problem: RigProblem, tmp_path: Path) -> None:
    write_adjustment(tmp_path / "adjustment.npz", problem)
    record = read_adjustment(tmp_path / "adjustment.npz")
    for series in (record.imu_turn, record.imu_speed, record.gnss_off):
        assert series is not None
        assert series.std is not None
        assert np.sqrt(np.mean((series.values / series.std) ** 2)) == pytest.approx(1.0, abs=0.35)
        assert series.at_s[0] >= 0
        assert series.at_s[-1] == pytest.approx(12, abs=0.5)
    assert record.gyro_bias is not None
    assert record.accel_bias is not None
    assert problem.states.inertial is not None
    np.testing.assert_array_equal(record.gyro_bias.values, problem.states.inertial.gyro_bias)
    np.testing.assert_array_equal(record.accel_bias.values, problem.states.inertial.accel_bias)
    charts = sensor_charts(record)
    assert [len(charts[sensor]) for sensor in ("IMU", "GNSS")] == [4, 1]  # no errors that last


def test_landmarks_with_a_distance_are_kept_with_their_camera(problem: RigProblem, tmp_path: Path) -> None:
    write_adjustment(tmp_path / "adjustment.npz", problem)
    cloud = read_adjustment(tmp_path / "adjustment.npz").landmarks
    assert cloud is not None
    assert cloud.in_all == 200
    assert 50 < cloud.placed == len(cloud.points_world) < 200  # some are too far away
    points, seen = problem.landmarks.points_world, problem.observations
    for point, name in zip(cloud.points_world[::10], cloud.cameras[::10], strict=True):
        nearest = int(np.argmin(np.linalg.norm(points - point, axis=1)))
        np.testing.assert_allclose(points[nearest], point, rtol=1e-6, atol=1e-2)
        rows = np.flatnonzero(seen.landmark_indices == nearest)
        earliest = rows[seen.timestamps_ns[rows] == seen.timestamps_ns[rows].min()]
        assert name in {problem.cameras[k].name for k in seen.camera_indices[earliest]}


def test_the_file_is_bounded(problem: RigProblem, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(adjustment_record, "_MOST_ROWS", 7)
    monkeypatch.setattr(adjustment_record, "_MOST_LANDMARKS", 9)
    write_adjustment(tmp_path / "adjustment.npz", problem)
    record = read_adjustment(tmp_path / "adjustment.npz")
    assert record.imu_turn is not None
    assert record.landmarks is not None
    assert (len(record.imu_turn.at_s), record.imu_turn.count) == (7, len(problem.states) - 1)
    assert len(record.landmarks.points_world) == 9


def test_without_imu_and_gnss_there_are_landmarks_alone(tmp_path: Path) -> None:
    bare = true_problem(Wanted(cameras=1, seconds=4, landmarks=80, gnss_std=None, imu=False))
    write_adjustment(tmp_path / "adjustment.npz", bare)
    record = read_adjustment(tmp_path / "adjustment.npz")
    assert record.landmarks is not None
    assert sensor_charts(record) == {}


def test_arrays_of_other_shapes_are_refused(tmp_path: Path) -> None:
    """A column instead of a row would be spread out to a square of all landmarks, or of all times."""
    path, rows = tmp_path / "adjustment.npz", np.zeros((50_000, 3))
    column = np.zeros((len(rows), 1), dtype=np.int64)
    landmarks = {"camera_names": np.array(["left"]), "landmark_counts": np.array([9, 9])}
    np.savez(path, landmarks_world=rows, landmark_cameras=column, **landmarks)
    with pytest.raises(InputError, match="disagree"):
        read_adjustment(path)
    np.savez(path, gyro_bias=rows, bias_timestamps_ns=column)
    with pytest.raises(InputError, match="adjustment"):
        read_adjustment(path)
