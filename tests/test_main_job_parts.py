"""Steps of the main job one by one, against closed forms: what whole runs would hide in their scatter."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from ba_rigs import FISHEYE, Wanted, true_problem
from handeye_scenes import PORT, drifting, trajectory, wavy
from odometry_worlds import (
    ANTENNA_RIG,
    RIG_FROM_CAM,
    TIME_OFFSET_S,
    circling,
    fisheye,
    sensors_of,
    tracks_of,
    visual_path,
)
from rigwake.atomic import write_text_atomic
from rigwake.ba.rig.gauge import with_gauge
from rigwake.ba.rig.gnss_noise import with_receiver_errors
from rigwake.ba.rig.imu_noise import with_imu_noise
from rigwake.ba.rig.outlier_rounds import drop_outliers
from rigwake.ba.rig.split_checks import part_of, residual_statistics
from rigwake.ba.solver.covariance import RigCovariance
from rigwake.ba.solver.levenberg_marquardt import solve
from rigwake.ba.solver.rig_problem import RigProblem, RigSolution, SolverOptions
from rigwake.calibration import CalibratedCamera, Calibration
from rigwake.evaluation.rig_errors import compare_calibrations, evaluate_calibration
from rigwake.evaluation.trajectory_errors import absolute_error, associate, kitti_error, relative_error
from rigwake.exporters.export_base import refer_to_camera
from rigwake.geometry import so3
from rigwake.geometry.interpolate import interpolate
from rigwake.geometry.se3 import SE3
from rigwake.handeye.handeye_problem import HandeyeOptions
from rigwake.handeye.joint_calibration import calibrate_handeye
from rigwake.handeye.motions import (
    Mounting,
    MountingLayout,
    Sampled,
    Steps,
    TrajectoryCurve,
    linearise,
    steps_between,
)
from rigwake.handeye.noise import noise_over_steps
from rigwake.monitor.change_detection import fit_change
from rigwake.odometry.gyro import align_gyro
from rigwake.odometry.imu_alignment import align_inertial
from rigwake.odometry.metric import metric_start
from rigwake.odometry.thesis_odometry import estimate_thesis
from rigwake.pipeline.outputs import horizon_of_image, write_trajectories
from rigwake.pipeline.stage_files import StageLedger, stage_key
from rigwake.readers.trajectories import read_trajectory
from rigwake.report.extrinsics import directions, looks
from rigwake.report.picture_overlays import horizon_pixels
from rigwake.report.reduce import summarise_residuals
from rigwake.rig import Rig, RigCamera
from rigwake.sync import angular_speed
from rigwake.trajectory import Trajectory
from rigwake.writers.trajectory_writer import write_tum

SECOND = 10**9


@pytest.fixture(scope="module")
def problem() -> RigProblem:
    return true_problem(Wanted(cameras=2, seconds=8, landmarks=160, offsets_s=(0.4, -0.4), far=40))


def solution_with(problem: RigProblem, residuals_px: np.ndarray) -> RigSolution:
    """A solution whose residuals are these; nothing else of it is looked at."""
    report: Any = None
    return RigSolution(problem, residuals_px, report)


class TestStages:
    def test_a_stage_is_done_with_its_key_and_its_files_as_it_left_them(self, tmp_path: Path) -> None:
        file = tmp_path / "a.txt"
        file.write_text("left by the stage")
        StageLedger(tmp_path, resume=True).done("tracks", "key", file)
        assert StageLedger(tmp_path, resume=True).is_done("tracks", "key", file)
        assert not StageLedger(tmp_path, resume=True).is_done("tracks", "other key", file)
        assert not StageLedger(tmp_path, resume=True).is_done("rig", "key", file)
        assert not StageLedger(tmp_path, resume=False).is_done("tracks", "key", file)
        file.write_text("changed by hand")
        assert not StageLedger(tmp_path, resume=True).is_done("tracks", "key", file)

    def test_a_key_depends_on_every_part(self) -> None:
        key = stage_key("tracks", {"a": 1, "b": [2, 3]})
        assert key == stage_key("tracks", {"b": [2, 3], "a": 1})
        others = [("rig", {"a": 1, "b": [2, 3]}), ("tracks", {"a": 1, "b": [2, 4]}), ("tracks", {"a": 1})]
        assert key not in {stage_key(*parts) for parts in others}

    def test_files_are_exchanged_whole_and_only_once_they_are_on_the_disk(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        file = tmp_path / "a.txt"
        file.write_text("old")
        steps: list[str] = []
        fsync, exchange = os.fsync, Path.replace
        monkeypatch.setattr(os, "fsync", lambda descriptor: (steps.append("on disk"), fsync(descriptor)))
        monkeypatch.setattr(
            Path, "replace", lambda path, target: (steps.append("exchanged"), exchange(path, target))[1]
        )
        with file.open() as reader:
            write_text_atomic(file, "new")
            assert reader.read() == "old"  # whoever reads the old file reads it to its end
        assert file.read_text() == "new"
        assert steps[:2] == ["on disk", "exchanged"]


class TestTrajectoriesOfARun:
    def test_each_camera_is_on_its_own_clock_and_the_rig_on_its_own(
        self, problem: RigProblem, tmp_path: Path
    ) -> None:
        write_trajectories(tmp_path, problem)
        states = problem.states
        rig = read_trajectory(tmp_path / "rig.tum").trajectory
        np.testing.assert_array_equal(rig.timestamps_ns, states.timestamps_ns)
        np.testing.assert_allclose(rig.world_from_body.matrix, states.world_from_rig.matrix, atol=1e-9)
        for camera in problem.cameras:
            found = read_trajectory(tmp_path / f"{camera.name}.tum").trajectory
            offset_ns = round(camera.time_offset_s * 1e9)
            assert offset_ns != 0
            np.testing.assert_array_equal(found.timestamps_ns + offset_ns, states.timestamps_ns)
            true = states.world_from_rig.matrix @ camera.rig_from_cam.matrix
            np.testing.assert_allclose(found.world_from_body.matrix, true, atol=1e-9)


class TestPictures:
    def test_the_horizon_is_that_of_the_cameras_own_attitude(self, problem: RigProblem) -> None:
        camera, states = problem.cameras[1], problem.states
        at = len(states) // 2
        stamp = int(states.timestamps_ns[at]) - round(camera.time_offset_s * 1e9)
        pixels = horizon_of_image(problem, 1, stamp)
        bearings, _ = camera.model.unproject(pixels[np.isfinite(pixels).all(axis=1)])
        assert len(bearings) > 50
        world_from_cam = states.world_from_rig[at] * camera.rig_from_cam
        np.testing.assert_allclose((bearings @ world_from_cam.rotation.T)[:, 2], 0.0, atol=1e-6)

    def test_the_horizon_is_at_right_angles_to_up(self) -> None:
        up_cam = so3.exp(np.array([0.2, -0.4, 0.3])) @ np.array([0.0, -1.0, 0.0])
        pixels = horizon_pixels(FISHEYE, up_cam)
        inside = np.isfinite(pixels).all(axis=1)
        bearings, _ = FISHEYE.unproject(pixels[inside])
        assert 100 < inside.sum() < len(pixels)
        np.testing.assert_allclose(bearings @ up_cam, 0.0, atol=1e-7)


class TestOutlierRounds:
    def test_deviations_follow_the_spread_and_few_observations_go(self, problem: RigProblem) -> None:
        seen, rng = problem.observations, np.random.default_rng(0)
        factors = np.array([2.0, 0.5])[seen.camera_indices]
        residuals = rng.normal(size=(len(seen), 2)) * (seen.std_px * factors)[:, None]
        counts = np.bincount(seen.landmark_indices, minlength=len(problem.landmarks))
        least = int(np.median(counts))
        reduced, kept, scales, lost = drop_outliers(solution_with(problem, residuals), 100.0, least)
        np.testing.assert_allclose(scales, [2.0, 0.5], rtol=0.1)
        np.testing.assert_array_equal(kept, np.flatnonzero(counts >= least))
        assert lost.sum() == counts[counts < least].sum()
        rows = counts[seen.landmark_indices] >= least
        np.testing.assert_allclose(
            reduced.observations.std_px, (seen.std_px * scales[seen.camera_indices])[rows]
        )


class TestHalves:
    def test_a_part_holds_what_was_seen_in_its_time_on_the_rigs_clock(self, problem: RigProblem) -> None:
        seen, stamps = problem.observations, problem.states.timestamps_ns
        middle = len(stamps) // 2
        part = part_of(problem, 0, middle, 1)
        offsets_ns = np.array([round(camera.time_offset_s * 1e9) for camera in problem.cameras])
        at = seen.timestamps_ns + offsets_ns[seen.camera_indices]
        margin = int(np.median(np.diff(stamps)) // 2)
        inside = (at >= stamps[0] - margin) & (at <= stamps[middle - 1] + margin)
        assert 0 < inside.sum() < len(seen)
        np.testing.assert_array_equal(part.observations.pixels, seen.pixels[inside])

    def test_residuals_are_summed_up_by_root_mean_square_and_median(self, problem: RigProblem) -> None:
        residuals = np.zeros((len(problem.observations), 2))
        own = np.flatnonzero(problem.observations.camera_indices == 0)
        residuals[own[: len(own) // 4], 0] = 2.0
        found = residual_statistics(solution_with(problem, residuals))[problem.cameras[0].name]
        assert found["observations"] == len(own)
        assert found["rms_px"] == pytest.approx(2.0 * np.sqrt((len(own) // 4) / len(own)))
        assert found["median_px"] == 0.0


class TestSensorNoise:
    def test_gyroscope_and_accelerometer_each_by_its_own_factor(self, problem: RigProblem) -> None:
        before, after = problem.imu, with_imu_noise(problem, (2.0, 3.0)).imu
        assert before is not None
        assert after is not None
        assert after.gyro_noise_density == pytest.approx(2 * (before.gyro_noise_density or 0))
        assert after.accel_noise_density == pytest.approx(3 * (before.accel_noise_density or 0))

    def test_what_white_noise_leaves_of_the_stated_error_lasts(self) -> None:
        problem = true_problem(Wanted(cameras=1, seconds=20, landmarks=20, gnss_std=0.01))
        gnss = problem.gnss
        assert gnss is not None
        rng = np.random.default_rng(1)
        count = len(gnss.timestamps_ns)
        noisy = replace(
            gnss,
            position_enu=np.tile(gnss.position_enu[0], (count, 1)) + rng.normal(0, 0.5, (count, 3)),
            covariances=np.tile(np.eye(3), (count, 1, 1)),
        )
        errors = with_receiver_errors(replace(problem, gnss=noisy)).antenna.errors
        assert errors is not None
        assert np.all((errors.std > 0.6) & (errors.std < 1.0))


class TestLeastSquares:
    def test_residuals_stand_in_the_order_of_the_observations(self, problem: RigProblem) -> None:
        order = np.random.default_rng(0).permutation(len(problem.observations))
        shuffled = replace(problem, observations=problem.observations.take(order))
        once = SolverOptions(max_iterations=1)
        given, mixed = solve(problem, once).residuals_px, solve(shuffled, once).residuals_px
        np.testing.assert_allclose(mixed, given[order], atol=1e-6)

    def test_a_quantity_is_unobservable_if_any_open_direction_touches_it(self) -> None:
        layout: Any = None
        directions = np.eye(4)
        covariance = RigCovariance(layout, np.eye(4), np.ones(4), np.array([0.0, 0.0, 0.25, 1.0]), directions)
        found, observable = covariance.of(np.array([[1.0, 0, 1, 0], [0, 0, 1, 0], [0, 0, 1, 1]]))
        np.testing.assert_array_equal(observable, [False, True, True])
        np.testing.assert_allclose(found[1:, 1:], [[4.0, 4.0], [4.0, 5.0]])
        closed = RigCovariance(layout, np.eye(2), np.ones(2), np.array([0.25, 1.0]), np.eye(2))
        assert closed.of(np.eye(2))[1].all()


class TestGauge:
    def test_without_gnss_heading_and_place_are_held_and_the_level_is_free(self, problem: RigProblem) -> None:
        held = with_gauge(replace(problem, gnss=None)).poses
        assert held is not None
        axes = np.kron(np.eye(2), held.world_from_rig.rotation[0])
        stds = np.sqrt(np.diag(axes @ held.covariances[0] @ axes.T))
        assert (stds[:2] > 0.5).all()
        assert (stds[2:] < 1e-3).all()


class TestMetric:
    def test_a_start_is_on_the_clock_of_the_rig(self) -> None:
        imu, gnss = sensors_of()[:2]
        visual = visual_path()
        start = metric_start(visual, imu, gnss)
        assert start.time_offset_s == pytest.approx(TIME_OFFSET_S, abs=2e-3)
        moved = start.world_from_rig.timestamps_ns - start.world_from_cam.timestamps_ns
        np.testing.assert_array_equal(moved, round(start.time_offset_s * 1e9))

    def test_the_antenna_is_placed_on_the_rig_and_not_on_the_camera(self) -> None:
        imu, gnss = sensors_of()[:2]
        start = metric_start(visual_path(), imu, gnss)
        assert start.antenna_rig is not None
        off = np.abs(start.antenna_rig - ANTENNA_RIG).max()
        in_camera_axes = np.abs(RIG_FROM_CAM.inverse() * ANTENNA_RIG - ANTENNA_RIG).max()
        assert off < 0.3 < 0.5 * in_camera_axes

    def test_steps_of_the_thesis_baseline_have_their_relative_lengths(self) -> None:
        path = circling(80)
        path = path[
            np.cumsum(np.tile([1, 1, 2, 2], 12))
        ]  # the boat goes twice as fast every other half second
        tracks = tracks_of(path, fisheye(), noise_px=1e-4)
        found = estimate_thesis(tracks, fisheye())
        truth = Trajectory("front", tracks.timestamps_ns, path)
        assert absolute_error(truth, found, alignment="sim3").rmse_m < 0.05

    def test_uncertainty_does_not_depend_on_the_unit_of_the_visual_path(self) -> None:
        imu, visual = sensors_of()[0], visual_path()
        pose = visual.world_from_body
        larger = replace(visual, world_from_body=SE3(pose.rotation, 4.0 * pose.translation))
        gyro = align_gyro(visual, imu)
        one, four = align_inertial(visual, imu, gyro), align_inertial(larger, imu, gyro)
        assert four.scale == pytest.approx(one.scale / 4.0, rel=1e-3)
        np.testing.assert_allclose(four.covariance, one.covariance, rtol=0.02, atol=1e-12)


class TestSync:
    def test_speeds_stand_in_the_middle_and_nowhere_between_segments(self) -> None:
        turned = so3.exp(np.outer(0.1 * np.arange(6), [0.0, 0.0, 1.0]))
        path = Trajectory(
            "a",
            np.arange(6) * SECOND,
            SE3(turned, np.zeros((6, 3))),
            segment_ids=np.array([0, 0, 0, 1, 1, 1]),
        )
        times, speed = angular_speed(path)
        np.testing.assert_allclose(times, np.arange(5) + 0.5)
        np.testing.assert_allclose(speed, [0.1, 0.1, np.nan, 0.1, 0.1])


class TestHandeye:
    def curve(self) -> TrajectoryCurve:
        path = SE3(np.tile(np.eye(3), (5, 1, 1)), np.outer(np.arange(5.0), [1.0, 0, 0]))
        return TrajectoryCurve.of(Trajectory("a", np.arange(5) * SECOND, path))

    def test_covariances_of_increments_add_up_and_those_of_poses_are_interpolated(self) -> None:
        curve = self.curve()
        covariances = np.arange(5.0)[:, None, None] * np.eye(6)
        times = np.array([0.0, 1.25, 3.5])
        added = noise_over_steps(covariances, curve, times, absolute=False)
        # 1 of the first increment and a quarter of 2; then three quarters of 2 and half of 4 about a whole 3
        np.testing.assert_allclose(added[:, 0, 0], [1 + 0.25 * 2, 0.75 * 2 + 3 + 0.5 * 4], rtol=1e-5)
        between = noise_over_steps(covariances, curve, times, absolute=True)
        np.testing.assert_allclose(between[:, 0, 0], times, rtol=1e-5)

    def test_agreed_motions_are_without_the_references_errors(self) -> None:
        mount = SE3(so3.exp(np.array([0.3, -0.2, 0.5])), np.array([1.0, 0.5, -0.3]))
        motion = SE3(so3.exp(np.array([[0.1, 0.2, -0.1]])), np.array([[2.0, 0.1, 0.3]]))
        zero, error = np.zeros((1, 6)), np.array([[0.02, -0.01, 0.03, 0.1, 0.2, -0.1]])
        steps = Steps(motion, motion, zero, zero, np.array([True]), np.zeros(1, np.int64))
        guess = Mounting(mount, None, 0.0, np.zeros(1))
        found = linearise(steps, guess, MountingLayout(0, False, 0), error)
        agreed = mount.inverse() * motion[0] * mount * SE3.exp(-error[0])
        np.testing.assert_allclose(found.adjoints[0], agreed.inverse().adjoint(), atol=1e-12)

    def test_the_uncertainty_of_a_scale_is_relative_to_it(self) -> None:
        """A member in another unit: its factor grows, and so does the deviation of that factor."""
        rng, times = np.random.default_rng(2), np.arange(150) * 0.2
        body, member = (drifting(wavy(times) * X, 1e-3, 1e-2, rng) for X in (SE3.identity(), PORT))
        scales = []
        for unit in (1.0, 0.1):
            visual = SE3(member.rotation, unit * member.translation)
            found = calibrate_handeye(
                trajectory("rig", body, times),
                [trajectory("cam", visual, times, is_metric=False)],
                HandeyeOptions(noise="increments", time_offset=False),
            ).members["cam"]
            assert found.scale is not None
            assert found.scale_std is not None
            assert abs(found.scale * unit - 1) < 5 * found.scale_std * unit
            scales.append((found.scale, found.scale_std))
        (one, one_std), (ten, ten_std) = scales
        assert ten == pytest.approx(10 * one, rel=1e-3)
        assert ten_std == pytest.approx(10 * one_std, rel=0.05)

    def test_steps_end_where_the_member_breaks(self) -> None:
        n = 4
        poses = SE3(np.tile(np.eye(3), (n, 1, 1)), np.zeros((n, 3)))
        twists = np.arange(6.0 * n).reshape(n, 6)
        whole = Sampled(poses, twists, np.zeros(n, np.int64))
        broken = Sampled(poses, twists, np.array([0, 0, 1, 1]))
        steps = steps_between(whole, broken, absolute=False)
        np.testing.assert_array_equal(steps.valid, [True, False, True])
        np.testing.assert_array_equal(steps.twists_before, twists[:-1])
        np.testing.assert_array_equal(steps.twists_after, twists[1:])


class TestTrajectoryErrors:
    """Straight ahead at 1 m a step; the estimate turns by 1 deg a step about z, or is as long as it should not be."""

    def path(self, turn_deg: float = 0.0, stretch: float = 1.0, steps: int = 400) -> Trajectory:
        step = SE3(so3.exp(np.array([0, 0, np.deg2rad(turn_deg)])), np.array([stretch, 0.0, 0.0]))
        poses = [SE3.identity()]
        for _ in range(steps):
            poses.append(poses[-1] * step)
        matrices = np.stack([pose.matrix for pose in poses])
        return Trajectory("path", np.arange(steps + 1) * (SECOND // 10), SE3.from_matrix(matrices))

    def test_relative_errors_are_those_of_a_step(self) -> None:
        found = relative_error(self.path(), self.path(turn_deg=1.0, stretch=1.02))
        assert found.rmse_m == pytest.approx(0.02)
        assert found.rotation_rmse_deg == pytest.approx(1.0)
        assert relative_error(self.path(), self.path(stretch=1.02), step=5).rmse_m == pytest.approx(0.1)

    def test_relative_errors_are_seen_from_the_body(self) -> None:
        """Wherever both paths lie: an estimate that is turned and moved as a whole has none."""
        truth = self.path(turn_deg=2.0)
        moved = SE3(so3.exp(np.array([0.3, 0.2, 1.0])), np.array([5.0, 1.0, 2.0])) * truth.world_from_body
        found = relative_error(truth, replace(truth, world_from_body=moved))
        assert found.rmse_m < 1e-9
        assert found.rotation_rmse_deg < 1e-5

    def test_kitti_counts_per_cent_and_degrees_per_hundred_metres(self) -> None:
        found = kitti_error(self.path(), self.path(stretch=1.02), lengths_m=(100.0, 200.0))
        # the first pose beyond the length ends a stretch: 101 m stand for 100
        assert found.t_rel_percent == pytest.approx(2.0 * (101 / 100 + 201 / 200) / 2, rel=0.01)
        assert found.r_rel_deg_per_100m < 1e-6
        turned = kitti_error(self.path(), self.path(turn_deg=0.01), lengths_m=(100.0,))
        assert turned.r_rel_deg_per_100m == pytest.approx(1.01, rel=0.01)

    def test_absolute_errors_after_alignment(self) -> None:
        truth = self.path(turn_deg=2.0, steps=90)
        tilt = so3.exp(np.array([np.deg2rad(3.0), 0.0, 0.0]))
        pose = truth.world_from_body
        estimate = replace(truth, world_from_body=SE3(pose.rotation @ tilt, 2.0 * pose.translation + 7.0))
        found = absolute_error(truth, estimate, alignment="sim3")
        assert found.rmse_m < 1e-9
        assert found.scale == pytest.approx(0.5)
        assert found.rotation_rmse_deg == pytest.approx(3.0)

    def test_one_pose_far_off_counts_by_its_square(self) -> None:
        truth = self.path(steps=99)
        moved = truth.world_from_body.translation.copy()
        moved[50, 1] += 1.0
        found = absolute_error(
            truth,
            replace(truth, world_from_body=SE3(truth.world_from_body.rotation, moved)),
            alignment=None,
        )
        assert (found.rmse_m, found.mean_m) == (pytest.approx(0.1), pytest.approx(0.01))

    def test_each_pose_is_used_once_and_only_near_in_time(self) -> None:
        truth = self.path(steps=9)
        late = replace(truth, timestamps_ns=truth.timestamps_ns + np.where(np.arange(10) < 5, 4, 40) * 10**6)
        i, j = associate(truth, late, 0.01)
        np.testing.assert_array_equal(i, np.arange(5))
        np.testing.assert_array_equal(j, np.arange(5))


def rig_camera(name: str, rig_from_cam: SE3, covariance: np.ndarray, offset_s: float) -> CalibratedCamera:
    return CalibratedCamera(name, rig_from_cam, covariance, time_offset_s=offset_s, time_offset_std_s=1e-4)


class TestRigErrors:
    mount = SE3(so3.exp(np.array([0.9, -0.4, 1.3])), np.array([1.0, 2.0, -0.5]))
    covariance = np.diag(np.array([1e-3, 2e-3, 3e-3, 0.01, 0.02, 0.05]) ** 2)

    def test_nees_counts_errors_in_the_cameras_axes(self) -> None:
        """Errors along single axes of the camera, each of one deviation: NEES is their number."""
        stds = np.sqrt(np.diag(self.covariance))
        for chosen in (np.array([1, 0, 0, 0, 0, 0.0]), np.array([0, 0, 0, 0, 0, 1.0]), np.ones(6)):
            found = self.mount.retract(chosen * stds)
            calibration = Calibration("imu", {"a": rig_camera("a", found, self.covariance, 0.012)})
            truth = Rig("imu", {"a": RigCamera("a", self.mount, time_offset_s=0.01)})
            errors = evaluate_calibration(calibration, truth).cameras["a"]
            assert errors.nees == pytest.approx(chosen.sum(), rel=2e-3)
            assert errors.time_offset_error_s == pytest.approx(0.002)

    def test_differences_are_the_second_less_the_first(self) -> None:
        moved = SE3(self.mount.rotation, self.mount.translation + np.array([0.01, 0.0, -0.02]))
        first = Calibration("imu", {"a": rig_camera("a", self.mount, self.covariance, 0.001)})
        second = Calibration("imu", {"a": rig_camera("a", moved, self.covariance, 0.003)})
        found = compare_calibrations(first, second)["a"]
        np.testing.assert_allclose(found.translation_mm, [10.0, 0.0, -20.0], atol=1e-9)
        assert found.time_offset_ms == pytest.approx(2.0)


class TestExportedRigs:
    def test_a_rig_seen_from_one_of_its_cameras(self) -> None:
        first = SE3(so3.exp(np.array([0.9, -0.4, 1.3])), np.array([1.0, 2.0, -0.5]))
        second = SE3(so3.exp(np.array([-0.2, 0.7, 0.1])), np.array([-3.0, 0.4, 0.2]))
        covariance = np.eye(6) * 1e-6
        cameras = {
            "a": rig_camera("a", first, covariance, 0.0),
            "b": rig_camera("b", second, covariance, 0.0),
        }
        found = refer_to_camera(Calibration("imu", cameras), "a").cameras
        np.testing.assert_allclose(found["a"].rig_from_cam.matrix, np.eye(4), atol=1e-12)
        a_from_b = np.linalg.inv(first.matrix) @ second.matrix
        np.testing.assert_allclose(found["b"].rig_from_cam.matrix, a_from_b, atol=1e-12)


class TestReportNumbers:
    def test_residuals_are_reduced_to_root_mean_square_and_quantiles_over_time(self) -> None:
        size = np.tile(np.arange(1.0, 101.0), 2)
        arrays = {
            "residuals_px": np.stack([size, np.zeros(200)], axis=1),
            "timestamp_ns": np.repeat([0, 40 * SECOND], 100),
            "pixels": np.full((200, 2), 5.0),
            "angle_deg": np.full(200, 12.0),
        }
        found = summarise_residuals(arrays, FISHEYE)
        assert found.rms_px == pytest.approx(np.sqrt(np.mean(size**2)))
        assert np.nanmax(found.over_angle.upper) == pytest.approx(np.quantile(size, 0.9))
        assert found.over_time.at[-1] == pytest.approx(40.0, rel=0.01)
        np.testing.assert_allclose(found.image.mean_px[0, 0], [50.5, 0.0])

    def test_the_table_is_in_millimetres_with_the_deviations_of_either_direction(self) -> None:
        """The lever turns an uncertain rotation into an uncertain place of the rig, seen from the camera."""
        mount = SE3(so3.exp(np.array([0.0, 0.0, np.pi / 2])), np.array([0.0, 3.0, 0.0]))
        covariance = np.diag([1e-6, 1e-6, 4e-4, 1e-8, 1e-8, 1e-8])
        forward, backward = directions(rig_camera("a", mount, covariance, 0.0))
        assert [value.text for value in forward.position] == ["0.0", "3000.0", "0.0"]
        assert [value.text for value in backward.position] == ["−3000.0", "0.0", "0.0"]
        assert backward.position[1].std == "± 60 mm"  # 0.02 rad about z over 3 m along x
        assert forward.position[1].std == "± 0.10 mm"

    def test_a_camera_to_port_looks_left(self) -> None:
        ahead = np.array([np.cos(0.5), np.sin(0.5), 0.0])
        right = np.array([np.sin(0.5), -np.cos(0.5), 0.0])
        rotation = np.stack([right, [0.0, 0.0, -1.0], ahead], axis=1)
        camera = rig_camera("a", SE3(rotation, np.zeros(3)), np.eye(6) * 1e-6, 0.0)
        assert looks(camera, "imu").startswith("28.6° left of x, level")


class TestMonitor:
    def test_a_weak_step_is_not_called_a_ramp(self) -> None:
        """A ramp has to explain more than a step by six; here all of the step's evidence is five."""
        blocks, begin, step = 20, 12, np.array([0.0, 0.01, 0.0])
        information = 2 * 5.0 / ((blocks - begin) * step @ step)
        after = (np.arange(blocks) >= begin)[:, None]
        scores = SimpleNamespace(
            cameras=("front",),
            columns=lambda _: slice(0, 3),
            inflation=np.ones((blocks, 1)),
            H=np.tile(information * np.eye(3), (blocks, 1, 1)),
            g=after * information * step,
        )
        found: Any = SimpleNamespace(scores=scores, belief=SimpleNamespace(covariance=1e-12 * np.eye(3)))
        change = fit_change(found, 0, blocks - 1)
        assert (change.kind, change.block) == ("step", begin)
        np.testing.assert_allclose(change.rotation, step, rtol=0.02)
        assert change.evidence == pytest.approx(5.0, rel=0.02)


class TestTrajectoryFiles:
    def test_a_row_is_seconds_place_and_quaternion_with_w_last(self, tmp_path: Path) -> None:
        pose = SE3(so3.exp(np.array([[0.0, 0.0, 0.2]])), np.array([[1.0, 2.0, 3.0]]))
        write_tum(Trajectory("a", np.array([1_700_000_000_000_000_007]), pose), tmp_path / "a.tum")
        (row,) = [line for line in (tmp_path / "a.tum").read_text().splitlines() if line[0] != "#"]
        stamp, *values = row.split()
        assert stamp == "1700000000.000000007"
        np.testing.assert_allclose(
            [float(v) for v in values], [1, 2, 3, 0, 0, np.sin(0.1), np.cos(0.1)], atol=1e-11
        )

    def test_poses_between_stamps_are_on_the_way(self) -> None:
        path = SE3(so3.exp(np.array([[0.0, 0, 0], [0, 0, 0.4]])), np.array([[0.0, 0, 0], [4.0, 0, 0]]))
        between = interpolate(np.array([0, 4 * SECOND]), path, np.array([SECOND]))
        np.testing.assert_allclose(so3.log(between.rotation[0]), [0, 0, 0.1], atol=1e-12)
