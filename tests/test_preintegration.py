"""Preintegration against noise-free truth, gtsam, itself backwards, and finite differences."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml

from ba_rigs import ACCEL_NOISE, GYRO_NOISE, stamps
from ba_rigs import Path as BoatPath
from rigwake.ba.solver.imu_factors import inertial_rows
from rigwake.ba.solver.parameter_layout import layout_of
from rigwake.ba.solver.preintegration import Preintegrated, preintegrate
from rigwake.ba.solver.rig_problem import InertialStates, Landmarks, Observations, RigProblem, States
from rigwake.errors import UsageError
from rigwake.geometry import so3
from rigwake.geometry.se3 import SE3
from rigwake.recording import ImuStream

NO_MARKS = Landmarks(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0))


def problem_of(timestamps_ns: np.ndarray, poses: SE3, velocity: np.ndarray, imu: ImuStream) -> RigProblem:
    zeros = np.zeros((len(poses), 3))
    states = States(timestamps_ns, poses, InertialStates(velocity, zeros, zeros))
    return RigProblem(states, (), NO_MARKS, Observations.empty(), imu=imu)


def boat(noise: float = 0.0, seed: int = 0, rate_hz: float = 100.0) -> RigProblem:
    path, rng = BoatPath(), np.random.default_rng(seed)
    t = np.arange(-0.0037, 3.0, 1 / rate_hz)
    gyro, accel = path.imu(t)
    gyro = gyro + noise * rng.normal(0, GYRO_NOISE * np.sqrt(rate_hz), gyro.shape)
    accel = accel + noise * rng.normal(0, ACCEL_NOISE * np.sqrt(rate_hz), accel.shape)
    imu = ImuStream("imu", stamps(t), gyro, accel, "", "", GYRO_NOISE, ACCEL_NOISE, 2e-5, 3e-4)
    at = np.arange(0.0, 2.9, 0.4)
    return problem_of(stamps(at), path.world_from_rig(at), path.velocity(at), imu)


def test_noise_free_motion_is_followed() -> None:
    problem = boat()
    residuals, _, _, covariance = inertial_rows(problem, layout_of(problem))
    sigmas = np.sqrt(np.einsum("nii->ni", covariance))[:, :9]
    assert np.abs(residuals[:, :9] / sigmas).max() < 0.15
    assert np.abs(residuals[:, :3]).max() < 5e-6


def test_followed_on_a_recording_of_an_independent_simulator(real_recordings: Path) -> None:
    folder = real_recordings / "harbour_a"
    truth = yaml.safe_load((folder / "truth.yaml").read_text())["imu"]
    rows = np.loadtxt(folder / "truth_imu.csv", delimiter=",", skiprows=1)
    tum = np.loadtxt(folder / "truth_base.tum")
    base_from_imu = SE3.from_quat_wxyz(
        truth["base_from_imu"]["quat_wxyz"], truth["base_from_imu"]["translation_m"]
    )
    path = SE3.from_quat_wxyz(tum[:, [7, 4, 5, 6]], tum[:, 1:4]) * base_from_imu
    noise = (truth["gyro_noise_density"], truth["accel_noise_density"])
    walks = (truth["gyro_bias_random_walk"], truth["accel_bias_random_walk"])
    nanoseconds = np.round(rows[:, 0] * 1e9).astype(np.int64)
    imu = ImuStream("imu", nanoseconds, rows[:, 1:4], rows[:, 4:7], "", "", *noise, *walks)
    at, p = np.arange(10, len(tum) - 10, 40), path.translation
    velocity = (8 * (p[at + 1] - p[at - 1]) - (p[at + 2] - p[at - 2])) / 0.12
    problem = problem_of(np.round(tum[at, 0] * 1e9).astype(np.int64), path[at], velocity, imu)
    residuals, _, _, covariance = inertial_rows(problem, layout_of(problem))
    sigmas = np.sqrt(np.einsum("nii->ni", covariance))[:, :9]
    assert (
        np.sqrt(np.mean((residuals[:, :9] / sigmas) ** 2)) < 0.05
    )  # integration is 20 times below the noise
    assert np.abs(residuals[:, :9].mean(axis=0) / sigmas.mean(axis=0)).max() < 0.01  # and does not add up


def increments(problem: RigProblem, start: float, end: float) -> Preintegrated:
    return preintegrate(problem, np.array([start]), np.array([end]), np.array([0]))


def test_backwards_is_the_inverse() -> None:
    problem = boat(noise=1.0)
    there, back = increments(problem, 0.3141, 0.7777), increments(problem, 0.7777, 0.3141)
    np.testing.assert_allclose(there.rotation @ back.rotation, np.eye(3)[None], atol=1e-12)
    # velocity gained one way is lost the other way, in the axes of the other end
    np.testing.assert_allclose(back.velocity[0], -back.rotation[0] @ there.velocity[0], atol=2e-5)


def test_pieces_make_the_whole() -> None:
    problem = boat(noise=1.0)
    a, b, whole = (increments(problem, *span) for span in ((0.1, 0.5), (0.5, 1.2), (0.1, 1.2)))
    np.testing.assert_allclose(a.rotation[0] @ b.rotation[0], whole.rotation[0], atol=1e-5)
    position = a.position[0] + a.velocity[0] * 0.7 + a.rotation[0] @ b.position[0]
    np.testing.assert_allclose(position, whole.position[0], atol=1e-5)


def test_bias_derivatives() -> None:
    problem, h = boat(noise=1.0), 1e-6
    inertial = problem.states.inertial
    assert inertial is not None
    base = increments(problem, 0.123, 0.9)
    for k in range(3):
        step = np.zeros((len(problem.states), 3))
        step[:, k] = h
        for name in ("gyro_bias", "accel_bias"):
            ahead, behind = (
                increments(
                    replace(
                        problem,
                        states=replace(problem.states, inertial=replace(inertial, **{name: sign * step})),
                    ),
                    0.123,
                    0.9,
                )
                for sign in (1, -1)
            )
            if name == "gyro_bias":
                turned = so3.log(np.swapaxes(behind.rotation, 1, 2) @ ahead.rotation)[0] / (2 * h)
                np.testing.assert_allclose(base.rotation_by_gyro_bias[0, :, k], turned, atol=1e-7)
                expected = (base.velocity_by_gyro_bias, base.position_by_gyro_bias)
            else:
                expected = (base.velocity_by_accel_bias, base.position_by_accel_bias)
            for derivative, what in zip(expected, ("velocity", "position"), strict=True):
                slope = (getattr(ahead, what) - getattr(behind, what))[0] / (2 * h)
                np.testing.assert_allclose(derivative[0, :, k], slope, atol=1e-7)


def test_agrees_with_gtsam_at_a_high_rate() -> None:
    gtsam = pytest.importorskip("gtsam")
    # gtsam holds a sample over its interval: at 2 kHz, with samples in mid-interval, the two must meet
    problem, rate = boat(rate_hz=2000.0), 2000.0
    imu = problem.imu
    assert imu is not None
    settings = gtsam.PreintegrationParams.MakeSharedU(9.81)
    settings.setGyroscopeCovariance(np.eye(3) * GYRO_NOISE**2)
    settings.setAccelerometerCovariance(np.eye(3) * ACCEL_NOISE**2)
    settings.setIntegrationCovariance(np.zeros((3, 3)))
    theirs = gtsam.PreintegratedImuMeasurements(settings, gtsam.imuBias.ConstantBias())
    times = (imu.timestamps_ns - problem.states.timestamps_ns[0]) * 1e-9
    used = np.flatnonzero((times > 0.5) & (times < 1.0))
    for k in used:
        theirs.integrateMeasurement(imu.accel[k], imu.gyro[k], 1 / rate)
    ours = increments(problem, times[used[0]] - 0.5 / rate, times[used[-1]] + 0.5 / rate)
    np.testing.assert_allclose(ours.rotation[0], theirs.deltaRij().matrix(), atol=5e-6)
    np.testing.assert_allclose(ours.position[0], theirs.deltaPij(), atol=2e-4)
    np.testing.assert_allclose(ours.velocity[0], theirs.deltaVij(), atol=1e-3)
    order = [0, 1, 2, 6, 7, 8, 3, 4, 5]  # gtsam: rotation, position, velocity
    covariance = theirs.preintMeasCov()[np.ix_(order, order)]
    sigmas = np.sqrt(np.diag(covariance))
    difference = (ours.covariance[0] - covariance) / np.outer(sigmas, sigmas)
    assert np.abs(difference).max() < 0.03


def test_covariance_is_what_noise_does() -> None:
    exact = increments(boat(), 0.2, 0.9)
    draws = []
    for seed in range(60):
        noisy = increments(boat(noise=1.0, seed=seed), 0.2, 0.9)
        turned = so3.log(np.swapaxes(exact.rotation, 1, 2) @ noisy.rotation)[0]
        draws.append(
            np.concatenate(
                [turned, (noisy.velocity - exact.velocity)[0], (noisy.position - exact.position)[0]]
            )
        )
    nees = [d @ np.linalg.solve(exact.covariance[0], d) for d in draws]
    assert 9 * 0.75 < np.mean(nees) < 9 * 1.25  # 60 draws of chi-squared with 9: mean 9 +- 0.55


def test_a_gap_widens() -> None:
    problem = boat()
    imu = problem.imu
    assert imu is not None
    times = (imu.timestamps_ns - problem.states.timestamps_ns[0]) * 1e-9
    kept = (times < 1.0) | (times > 1.3)
    holed = replace(
        problem,
        imu=replace(imu, timestamps_ns=imu.timestamps_ns[kept], gyro=imu.gyro[kept], accel=imu.accel[kept]),
    )
    whole, hole = increments(problem, 0.9, 1.4), increments(holed, 0.9, 1.4)
    error = so3.log(np.swapaxes(whole.rotation, 1, 2) @ hole.rotation)[0]
    before, after = (np.sqrt(np.diag(found.covariance[0])) for found in (whole, hole))
    assert np.all(after[:3] > 3 * before[:3])
    assert np.all(np.abs(error) < 3 * after[:3])


def test_unknown_noise_is_refused() -> None:
    problem = boat()
    assert problem.imu is not None
    silent = replace(problem, imu=replace(problem.imu, gyro_bias_walk=None))
    with pytest.raises(UsageError, match="gyro_bias_walk"):
        increments(silent, 0.0, 1.0)
