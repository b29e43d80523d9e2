"""From up to scale to metres: gyro, accelerometer and GNSS against a known boat; what they refuse."""

from dataclasses import replace

import numpy as np
import pytest

from odometry_worlds import (
    ACCEL_BIAS,
    ANTENNA_RIG,
    GYRO_BIAS,
    RIG_FROM_CAM,
    TIME_OFFSET_S,
    circling,
    rig_path,
    sensors_of,
    visual_path,
)
from rigwake.errors import UnobservableError, UsageError
from rigwake.evaluation.trajectory_errors import absolute_error
from rigwake.geometry import so3
from rigwake.geometry.se3 import SE3
from rigwake.odometry.gnss import align_gnss
from rigwake.odometry.gravity_alignment import up_in_camera
from rigwake.odometry.gyro import align_gyro, camera_rotations, integrate_gyro
from rigwake.odometry.imu_alignment import align_inertial
from rigwake.odometry.metric import metric_start
from rigwake.trajectory import Trajectory


@pytest.fixture(scope="module")
def sensors():
    return sensors_of()


def test_gyro_finds_rotation_clock_and_bias(sensors):
    found = align_gyro(visual_path(), sensors[0])
    assert np.rad2deg(np.linalg.norm(so3.log(RIG_FROM_CAM.rotation.T @ found.imu_from_cam))) < 0.1
    assert found.time_offset_s == pytest.approx(TIME_OFFSET_S, abs=1e-3)
    np.testing.assert_allclose(found.gyro_bias, GYRO_BIAS, atol=5e-4)


def test_integrated_gyro_turns_as_the_rig_does(sensors):
    truth = rig_path()
    turned = integrate_gyro(sensors[0], GYRO_BIAS).at(truth.timestamps_ns)
    relative = np.swapaxes(turned[:1], 1, 2) @ turned
    expected = np.swapaxes(truth.world_from_body.rotation[:1], 1, 2) @ truth.world_from_body.rotation
    error = np.linalg.norm(so3.log(np.swapaxes(relative, 1, 2) @ expected), axis=1)
    assert np.rad2deg(error.max()) < 0.2  # random walk of 1.5e-3 rad/s white noise at 100 Hz over 30 s


def test_gyro_knows_where_up_is(sensors):
    visual = visual_path()
    found = align_gyro(visual, sensors[0])
    up = up_in_camera(sensors[0], found, visual.timestamps_ns)
    world_from_cam = rig_path().world_from_body * RIG_FROM_CAM
    np.testing.assert_allclose(np.linalg.norm(up, axis=1), 1)
    tilt = np.arccos(np.clip(np.einsum("nj,nj->n", up, world_from_cam.rotation[:, 2, :]), -1, 1))
    assert np.rad2deg(np.median(tilt)) < 2.5


def test_camera_rotations_follow_the_camera(sensors):
    visual = visual_path()
    R = camera_rotations(sensors[0], align_gyro(visual, sensors[0]), visual.timestamps_ns)
    error = so3.log(np.swapaxes(visual.world_from_body.rotation, 1, 2) @ (R[0].T @ R))
    assert np.rad2deg(np.linalg.norm(error, axis=1).max()) < 0.3


def test_a_camera_that_turns_about_one_axis_is_refused(sensors):
    stamps = visual_path().timestamps_ns
    t = (stamps - stamps[0]) * 1e-9
    yaw = so3.exp(np.outer(0.15 * t + 0.3 * np.sin(0.5 * t), [0, 0, 1]))
    imu = sensors[0]
    t_imu = (imu.timestamps_ns - stamps[0]) * 1e-9
    level = replace(imu, gyro=np.outer(0.15 + 0.15 * np.cos(0.5 * t_imu), [0.0, 0, 1]))
    only_yaw = Trajectory("front", stamps, SE3(yaw, np.zeros((len(t), 3))), is_metric=False)
    with pytest.raises(UnobservableError, match="one axis"):
        align_gyro(only_yaw, level, time_offset_s=0.0)


def test_gnss_gives_scale_world_and_antenna_and_gates_wild_fixes(sensors):
    visual, gnss = visual_path(), sensors[1]
    wild = np.arange(10, len(gnss.timestamps_ns), 25)
    positions = gnss.position_enu.copy()
    positions[wild] += [3.0, -2.0, 4.0]
    found = align_gnss(visual, replace(gnss, position_enu=positions), time_offset_s=TIME_OFFSET_S)
    assert not found.used[wild].any()
    assert found.enu_from_visual.scale == pytest.approx(1 / 0.37, rel=2e-3)
    antenna_cam = RIG_FROM_CAM.inverse() * ANTENNA_RIG
    error = found.antenna_cam - antenna_cam
    assert error @ np.linalg.solve(found.covariance[7:, 7:], error) < 16.3
    truth = rig_path().world_from_body * RIG_FROM_CAM
    metric = found.enu_from_visual.apply(visual.world_from_body)
    assert np.linalg.norm(metric.translation - truth.translation, axis=1).max() < 0.1


def test_gnss_on_a_straight_line_is_refused(sensors):
    visual = visual_path()
    straight = np.outer(np.linspace(0, 1, len(visual)), [1.0, 0, 0])
    line = replace(visual, world_from_body=SE3(np.tile(np.eye(3), (len(visual), 1, 1)), straight))
    fixes = replace(
        sensors[1], position_enu=np.outer(np.linspace(0, 9, len(sensors[1].timestamps_ns)), [1.0, 1, 0])
    )
    with pytest.raises(UnobservableError, match="straight"):
        align_gnss(line, fixes, time_offset_s=TIME_OFFSET_S)


def test_accelerometer_gives_scale_gravity_and_lever_arm(sensors):
    visual, imu = visual_path(), sensors[0]
    found = align_inertial(visual, imu, align_gyro(visual, imu))
    assert found.scale == pytest.approx(1 / 0.37, rel=0.05)
    down = (rig_path().world_from_body * RIG_FROM_CAM).rotation[0].T @ [0, 0, -1.0]
    assert np.rad2deg(np.arccos(found.gravity_visual @ down / 9.81)) < 0.5
    np.testing.assert_allclose(found.imu_cam, RIG_FROM_CAM.inverse().translation, atol=0.15)
    np.testing.assert_allclose(found.accel_bias, ACCEL_BIAS, atol=0.05)


def test_steady_motion_does_not_tell_the_scale(sensors):
    visual, imu = visual_path(), sensors[0]
    gyro = align_gyro(visual, imu)
    still = replace(visual, world_from_body=SE3(visual.world_from_body.rotation, np.zeros((len(visual), 3))))
    with pytest.raises(UnobservableError, match="scale"):
        align_inertial(still, imu, gyro)


@pytest.mark.parametrize("with_gnss", [True, False])
def test_metric_start_is_close_enough_to_adjust_from(sensors, with_gnss):
    start = metric_start(visual_path(), sensors[0], sensors[1] if with_gnss else None)
    assert start.scale_source == ("gnss" if with_gnss else "imu")
    error = RIG_FROM_CAM.local(start.rig_from_cam)
    assert np.rad2deg(np.linalg.norm(error[:3])) < 0.2
    assert np.linalg.norm(error[3:]) < 0.2
    found = absolute_error(rig_path(), start.world_from_rig, alignment="yaw", max_difference_s=0.006)
    assert found.rmse_m < (0.1 if with_gnss else 0.6)
    assert (start.antenna_rig is not None) == with_gnss


def test_segments_are_placed_by_gnss_and_left_out_without(sensors):
    visual = visual_path()
    R, c = visual.world_from_body.rotation, visual.world_from_body.translation.copy()
    half = len(visual) // 3
    turned = so3.exp(np.array([0.2, 0.4, -0.1]))
    broken = replace(
        visual,
        world_from_body=SE3(
            np.concatenate([R[:half], turned @ R[half:]]),
            np.concatenate([c[:half], 5.0 * c[half:] @ turned.T + 3.0]),
        ),
        segment_ids=np.repeat([0, 1], [half, len(visual) - half]),
    )
    both = metric_start(broken, *sensors)
    error = absolute_error(rig_path(), both.world_from_rig, alignment=None, max_difference_s=0.006)
    assert len(both.world_from_cam) == len(visual)
    assert error.rmse_m < 0.3
    alone = metric_start(broken, sensors[0])
    assert len(alone.world_from_cam) == len(visual) - half
    assert any("left out" in note for note in alone.notes)


def test_metres_need_a_sensor():
    stamps = np.arange(20) * 100_000_000
    with pytest.raises(UsageError, match="IMU or GNSS"):
        metric_start(Trajectory("front", stamps, circling(20), is_metric=False))
