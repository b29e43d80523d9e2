"""The solver: recovery inside bounds, agreement with dense algebra, what cannot be determined, wrong input."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from ba_rigs import FISHEYE, START_NS, Wanted, free_cameras, started_off, true_problem
from rigwake.ba.solver.covariance import covariance_of
from rigwake.ba.solver.envelope import Envelope, NotPositiveDefiniteError, cholesky
from rigwake.ba.solver.extrapolation import extrapolated
from rigwake.ba.solver.levenberg_marquardt import equations_of, linearised, solve, structure_of
from rigwake.ba.solver.normal import NormalEquations, ReducedEquations
from rigwake.ba.solver.parameter_layout import layout_of
from rigwake.ba.solver.rig_problem import (
    BundleCamera,
    DistanceMeasurement,
    Landmarks,
    Observations,
    PosePrior,
    RigProblem,
    RigSolution,
    SolverOptions,
    States,
)
from rigwake.ba.solver.robust_loss import Loss, robust
from rigwake.ba.solver.schur import landmark_steps
from rigwake.errors import EstimationError, UsageError
from rigwake.geometry.se3 import SE3

OFFSETS = (0.015, -0.02, 0.005, -0.01)
INERTIAL = Wanted(seconds=12.0, state_hz=2.5, landmarks=60, offsets_s=OFFSETS)
POSES_ONLY = Wanted(seconds=8.0, landmarks=60, imu=False)


def inertial_rig(wanted: Wanted = INERTIAL) -> RigProblem:
    problem = free_cameras(true_problem(wanted), "rig_from_cam", "time_offset")
    return replace(problem, antenna=replace(problem.antenna, free=True))


def shared_errors(truth: RigProblem, solution: RigSolution) -> tuple[np.ndarray, np.ndarray]:
    """Errors of all free camera and antenna parameters, and their covariance."""
    found = covariance_of(solution.problem)
    errors, rows = [], []
    for mine, true in zip(solution.problem.cameras, truth.cameras, strict=True):
        if "rig_from_cam" in mine.free:
            errors.append(true.rig_from_cam.local(mine.rig_from_cam))
            rows.append(found.rows_of(mine.name, "rig_from_cam"))
        if "time_offset" in mine.free:
            errors.append(np.array([mine.time_offset_s - true.time_offset_s]))
            rows.append(found.rows_of(mine.name, "time_offset"))
    if truth.antenna.free:
        errors.append(solution.problem.antenna.position_rig - truth.antenna.position_rig)
        rows.append(found.rows_of("antenna", "position_rig"))
    covariance, observable = found.of(np.concatenate(rows))
    assert observable.all()
    return np.concatenate(errors), covariance


def test_a_rig_with_imu_and_gnss_is_recovered_within_its_own_sigmas() -> None:
    truth = inertial_rig()
    solution = solve(started_off(truth, 0))
    assert solution.report.converged
    for mine, true in zip(solution.problem.cameras, truth.cameras, strict=True):
        error = true.rig_from_cam.local(mine.rig_from_cam)
        assert np.rad2deg(np.linalg.norm(error[:3])) < 0.15
        assert np.linalg.norm(error[3:]) < 0.04
        assert abs(mine.time_offset_s - true.time_offset_s) < 2e-3
    errors, covariance = shared_errors(truth, solution)
    assert np.all(np.abs(errors) < 4 * np.sqrt(np.diag(covariance)))
    assert errors @ np.linalg.solve(covariance, errors) < 62  # 31 degrees of freedom, 99.9 %


@pytest.mark.slow
def test_sigmas_are_honest() -> None:
    scores, of_states = [], []
    for seed in range(20):
        truth = inertial_rig(replace(INERTIAL, seed=seed))
        solution = solve(started_off(truth, seed))
        errors, covariance = shared_errors(truth, solution)
        scores.append(errors @ np.linalg.solve(covariance, errors))
        states = covariance_of(solution.problem, states=True).state_covariances
        assert states is not None
        middle = len(states) // 2
        off = truth.states.world_from_rig.local(solution.problem.states.world_from_rig)[middle]
        of_states.append(off @ np.linalg.solve(states[middle, :6, :6], off))
    # chi-squared, means of 20: 31 +- 1.8 and 6 +- 0.8, within three of these
    assert 25.6 < np.mean(scores) < 36.4
    assert 3.7 < np.mean(of_states) < 8.3


def test_cameras_and_gnss_without_imu() -> None:
    truth = free_cameras(true_problem(POSES_ONLY), "rig_from_cam")
    first = replace(truth.cameras[0], free=frozenset())
    truth = replace(truth, cameras=(first, *truth.cameras[1:]), gnss=None)
    exact = replace(truth.states, fixed=np.arange(len(truth.states)) == 0)
    far_apart = np.linalg.norm(np.diff(exact.world_from_rig.translation[[0, -1]], axis=0))
    scale = DistanceMeasurement(0, len(exact) - 1, float(far_apart), 1e-4)
    truth = replace(truth, states=exact, distances=(scale,))
    solution = solve(started_off(truth, 1))
    assert solution.report.converged
    kept = solution.problem.states.world_from_rig[0]
    np.testing.assert_array_equal(kept.translation, truth.states.world_from_rig[0].translation)
    errors, covariance = shared_errors(truth, solution)
    assert errors @ np.linalg.solve(covariance, errors) < 42  # 18 degrees of freedom, 99.9 %
    assert np.abs(errors).max() < 0.02


@pytest.mark.parametrize("loss", ["huber", "cauchy", "tukey"])
def test_outliers_do_little(loss: Loss) -> None:
    truth = free_cameras(true_problem(replace(POSES_ONLY, cameras=2)), "rig_from_cam")
    truth = replace(truth, cameras=(replace(truth.cameras[0], free=frozenset()), truth.cameras[1]))
    rng = np.random.default_rng(0)
    pixels = truth.observations.pixels.copy()
    wild = rng.random(len(pixels)) < 0.05
    pixels[wild] += rng.uniform(-40, 40, (wild.sum(), 2))
    spoiled = replace(truth, observations=replace(truth.observations, pixels=pixels))
    errors = {}
    for name in ("none", loss):
        solution = solve(spoiled, SolverOptions(loss=name))
        error = truth.cameras[1].rig_from_cam.local(solution.problem.cameras[1].rig_from_cam)
        errors[name] = np.linalg.norm(error)
    assert errors[loss] < 0.03
    assert errors[loss] < errors["none"] / 3


def test_losses_touch_least_squares_at_zero_and_have_their_slope() -> None:
    squared, h = np.linspace(0.01, 30.0, 50), 1e-6
    for loss in ("none", "huber", "cauchy", "tukey"):
        value, slope = robust(squared, loss, 2.0)
        numeric = (robust(squared + h, loss, 2.0)[0] - robust(squared - h, loss, 2.0)[0]) / (2 * h)
        np.testing.assert_allclose(slope, numeric, atol=1e-6)
        assert robust(np.array([1e-8]), loss, 2.0)[0][0] == pytest.approx(1e-8, rel=1e-6)
        assert np.all(np.diff(value) >= 0)


def dense_step(problem: RigProblem) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Gauss-Newton step of columns and landmarks by dense algebra, and by the solver's own parts."""
    options = SolverOptions(loss="none", gnss_loss_scale=1e9)
    structure = structure_of(problem)
    layout, linear = structure.layout, linearised(problem, structure, options)
    o, n = linear.observations, layout.n_columns
    m, marks = len(o.frames), len(problem.landmarks)
    J, r = np.zeros((2 * m, n + 3 * marks)), o.residuals.reshape(-1)
    for column in range(n):
        unit = np.zeros(n)
        unit[column] = 1.0
        moved = np.einsum("mij,mj->mi", o.by_frame, linear.poses.moved_by(layout, unit)[o.frames])
        extras = np.where(o.extras >= 0, unit[layout.extras_start :][o.extras], 0.0)
        J[:, column] = (moved + np.einsum("mij,mj->mi", o.by_extras, extras)).reshape(-1)
    owner = np.repeat(np.arange(marks), np.diff(o.landmark_starts))
    for row in range(m):
        J[2 * row : 2 * row + 2, n + 3 * owner[row] : n + 3 * owner[row] + 3] = o.by_landmark[row]
    for factors in linear.factors:
        for residual, jacobian, columns in zip(
            factors.residuals, factors.jacobian, factors.columns, strict=True
        ):
            rows = np.zeros((len(residual), n + 3 * marks))
            rows[:, columns[columns >= 0]] = jacobian[:, columns >= 0]
            J, r = np.vstack([J, rows]), np.concatenate([r, residual])
    expected = np.linalg.lstsq(J, -r, rcond=1e-13)[0]
    equations, reduced = equations_of(linear, structure, damping=0.0)
    step = equations.factorise().step()
    frames = linear.poses.moved_by(layout, step)
    by_marks = landmark_steps(o, reduced, frames, step[layout.extras_start :])
    return expected[:n], step, expected[n:], by_marks.reshape(-1)


@pytest.mark.parametrize("imu", [True, False])
def test_a_step_is_that_of_dense_least_squares(imu: bool) -> None:
    wanted = Wanted(
        cameras=2, seconds=2.4, landmarks=25, imu=imu, far=40.0, offsets_s=OFFSETS if imu else (0.0,)
    )
    everything = ("rig_from_cam", "intrinsics", *(("time_offset", "line_delay") if imu else ()))
    problem = free_cameras(true_problem(wanted), *everything)
    mounts = tuple(
        replace(c, rig_from_cam_prior=PosePrior.in_axes_of_a(c.rig_from_cam, [0.1] * 6))
        for c in problem.cameras
    )
    problem = started_off(replace(problem, cameras=mounts), 2, rotation=0.005, translation=0.01)
    expected, step, expected_marks, marks = dense_step(problem)
    np.testing.assert_allclose(step, expected, atol=1e-4 * np.abs(expected).max())
    np.testing.assert_allclose(marks, expected_marks, atol=1e-4 * np.abs(expected_marks).max())


def test_frames_on_a_state_and_between_states_give_the_dense_schur_complement() -> None:
    """Without an IMU the reference camera's frames lie on states, the others' between two."""
    wanted = Wanted(cameras=2, seconds=1.6, landmarks=20, imu=False, far=40.0, gnss_std=None)
    problem = true_problem(wanted)
    free = replace(problem.cameras[1], free=frozenset({"rig_from_cam", "time_offset"}), time_offset_s=0.03)
    problem = replace(problem, cameras=(problem.cameras[0], free))
    structure = structure_of(problem)
    layout, linear = structure.layout, linearised(problem, structure, SolverOptions(loss="none"))
    assert np.any(linear.poses.states[:, 0] != linear.poses.states[:, 1])
    assert np.any(linear.poses.states[:, 0] == linear.poses.states[:, 1])
    o, n = linear.observations, layout.n_columns
    by_column = np.stack([linear.poses.moved_by(layout, unit) for unit in np.eye(n)], axis=-1)
    J = o.by_frame @ by_column[o.frames]
    dense = np.einsum("mia,mib->ab", J, J)
    for start, stop in pairwise(o.landmark_starts):
        marks = o.by_landmark[start:stop].reshape(-1, 3)
        if len(marks):
            coupling = J[start:stop].reshape(-1, n).T @ marks
            dense -= coupling @ np.linalg.solve(marks.T @ marks, coupling.T)
    equations, _ = equations_of(linear, structure, damping=0.0)
    held = layout.n_state_columns
    found = np.zeros((n, n))
    for i in range(len(structure.shape.first)):
        rows = structure.shape.rows(equations.states, i)
        top, left = i * structure.shape.tile, structure.shape.first[i] * structure.shape.tile
        found[top : top + len(rows), left : left + rows.shape[1]] = rows
    found[held:, :held], found[held:, held:] = equations.border.T, equations.corner
    found = np.tril(found) + np.tril(found, -1).T
    scale = 1 / np.sqrt(np.maximum(np.diag(dense), 1e-12))
    np.testing.assert_allclose(found * np.outer(scale, scale), dense * np.outer(scale, scale), atol=1e-6)
    assert np.linalg.eigvalsh(found * np.outer(scale, scale))[0] > -1e-8


def test_envelope_cholesky_is_dense_cholesky() -> None:
    rng = np.random.default_rng(4)
    n, unit = 90, 6
    first = np.maximum(np.arange(n) // unit - rng.integers(0, 5, n), 0) * unit
    first[-unit:] = 0  # a revisit: the last state meets the first
    shape = Envelope.of_first_columns(first, unit, tile_rows=18)
    L = np.tril(rng.normal(size=(n, n)))
    L[np.diag_indices(n)] = 3 + rng.random(n)
    for i in range(len(shape.first)):
        L[i * shape.tile : (i + 1) * shape.tile, : shape.first[i] * shape.tile] = 0.0
    A, values = L @ L.T, np.zeros(shape.offsets[-1])
    for i in range(len(shape.first)):
        row = shape.rows(values, i)
        row[:] = A[i * shape.tile : i * shape.tile + len(row), shape.first[i] * shape.tile :][
            :, : row.shape[1]
        ]
    factor, right = cholesky(shape, values), rng.normal(size=(n, 3))
    np.testing.assert_allclose(factor.backward(factor.forward(right)), np.linalg.solve(A, right), rtol=1e-8)
    values[shape.diagonal()] -= 1e3
    with pytest.raises(NotPositiveDefiniteError):
        cholesky(shape, values)


def test_gnss_alone_leaves_the_axes_of_the_rig_open() -> None:
    problem = free_cameras(true_problem(replace(POSES_ONLY, arm=(0.0, 0.0, 0.0))), "rig_from_cam")
    solution = solve(problem)
    found = covariance_of(solution.problem)
    assert len(found.unobservable) == 3
    covariance, observable = found.parameter("cam2", "rig_from_cam")
    assert not observable[:3].any()
    assert np.isnan(covariance[:3]).all()
    between = found.rows_of("cam1", "rig_from_cam") - 0.0
    a_from_b = solution.problem.cameras[0].rig_from_cam.inverse() * solution.problem.cameras[1].rig_from_cam
    between -= a_from_b.inverse().adjoint() @ found.rows_of("cam0", "rig_from_cam")
    relative, known = found.of(between)  # camera to camera is determined all the same
    assert known.all()
    assert np.rad2deg(np.sqrt(np.diag(relative))[:3]).max() < 0.05
    with_arm = replace(solution.problem, antenna=replace(solution.problem.antenna, free=True))
    assert len(covariance_of(with_arm).unobservable) == 6
    assert len(covariance_of(free_cameras(true_problem(INERTIAL), "rig_from_cam")).unobservable) == 0


def test_a_parameter_that_was_held_has_no_covariance() -> None:
    with pytest.raises(UsageError, match="was not estimated"):
        covariance_of(true_problem(replace(POSES_ONLY, cameras=1))).parameter("cam0", "rig_from_cam")


def test_rolling_shutter_read_out_is_found() -> None:
    wanted = replace(INERTIAL, cameras=2, line_delay_s=5e-5, seconds=8.0)
    truth = free_cameras(true_problem(wanted), "rig_from_cam", "line_delay")
    solution = solve(started_off(truth, 5))
    found = covariance_of(solution.problem)
    for camera in solution.problem.cameras:
        sigma = np.sqrt(found.parameter(camera.name, "line_delay")[0][0, 0])
        assert sigma < 1.5e-5
        assert abs(camera.line_delay_s - 5e-5) < 4 * sigma


def test_points_at_infinity_are_no_trouble() -> None:
    truth = true_problem(replace(POSES_ONLY, far=1e6))
    started = started_off(truth, 6)
    flat = replace(
        started, landmarks=replace(started.landmarks, inverse_ranges=np.full(len(truth.landmarks), 1e-9))
    )
    solution = solve(flat)
    assert solution.report.converged
    assert solution.report.final_cost < 1.1 * len(truth.observations)
    assert np.isfinite(solution.problem.landmarks.points_world).all()
    near = np.linalg.norm(truth.landmarks.points_world, axis=1) < 60
    off = np.linalg.norm(
        (solution.problem.landmarks.points_world - truth.landmarks.points_world)[near], axis=1
    )
    assert np.median(off) < 0.2


def test_beyond_the_rim_the_residual_goes_on_smoothly() -> None:
    azimuth = np.linspace(0, 2 * np.pi, 9)
    limit = FISHEYE.max_angle

    def at(angle: float) -> np.ndarray:
        return np.stack(
            [np.sin(angle) * np.cos(azimuth), np.sin(angle) * np.sin(azimuth), np.full(9, np.cos(angle))], 1
        )

    observed, _ = FISHEYE.project(at(limit - 0.001))
    inside, _ = FISHEYE.project(at(limit - 1e-9))
    view = extrapolated(FISHEYE, observed, 3.0 * at(limit - 1e-9))
    np.testing.assert_allclose(view.pixels, inside, atol=1e-3)
    lengths = [
        np.linalg.norm(extrapolated(FISHEYE, observed, at(limit + off)).pixels - observed, axis=1)
        for off in (0.01, 0.1, 0.5, 1.0)
    ]
    assert np.all(np.diff(lengths, axis=0) > 0)
    y, h = at(limit + 0.2) * 2.5, 1e-6
    exact = extrapolated(FISHEYE, observed, y).d_point
    for k in range(3):
        step = np.eye(3)[k] * h
        ahead, behind = (extrapolated(FISHEYE, observed, y + sign * step).pixels for sign in (1, -1))
        np.testing.assert_allclose(exact[:, :, k], (ahead - behind) / (2 * h), atol=1e-4)


def test_a_solve_repeats_to_the_bit() -> None:
    problem = started_off(inertial_rig(replace(INERTIAL, cameras=2, seconds=4.0)), 7)
    a, b = solve(problem), solve(problem)
    np.testing.assert_array_equal(
        a.problem.states.world_from_rig.translation, b.problem.states.world_from_rig.translation
    )
    assert a.report == b.report


def test_contradictions_are_refused() -> None:
    problem = true_problem(replace(POSES_ONLY, cameras=1, seconds=1.0))
    seen = problem.observations
    with pytest.raises(UsageError, match="landmark that the problem does not have"):
        replace(problem, landmarks=problem.landmarks.take(np.arange(3)))
    with pytest.raises(UsageError, match="camera that the problem does not have"):
        replace(problem, cameras=())
    with pytest.raises(UsageError, match="velocities and biases"):
        replace(problem, imu=true_problem(replace(INERTIAL, seconds=1.0, cameras=1)).imu)
    with pytest.raises(UsageError, match="strictly increasing"):
        States(np.array([1, 1]), SE3.identity((2,)))
    with pytest.raises(UsageError, match="coincide"):
        Landmarks.from_points(np.zeros((1, 3)), np.zeros(3))
    with pytest.raises(UsageError, match="same name"):
        replace(problem, cameras=(problem.cameras[0], problem.cameras[0]))
    with pytest.raises(UsageError, match="No camera 'mast'"):
        problem.camera_index("mast")
    assert len(seen.take(np.arange(4))) == 4


def test_states_alone_need_no_observations() -> None:
    camera = BundleCamera("front", FISHEYE, SE3.identity())
    states = States(START_NS + np.arange(3), SE3.identity((3,)), fixed=np.array([True, False, False]))
    nothing = Landmarks(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0))
    problem = RigProblem(states, (camera,), nothing, Observations.empty())
    assert layout_of(problem).n_columns == 18
    assert solve(problem).report.final_cost == 0.0


def test_a_negative_eigenvalue_is_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    problem = free_cameras(true_problem(replace(POSES_ONLY, seconds=2.0, cameras=2)), "rig_from_cam")
    honest = NormalEquations.factorise

    def wrong(equations: NormalEquations) -> ReducedEquations:
        reduced = honest(equations)
        return replace(reduced, shared=reduced.shared - 0.9 * np.diag(np.diag(equations.corner)))

    monkeypatch.setattr(NormalEquations, "factorise", wrong)
    with pytest.raises(EstimationError, match="negative eigenvalue"):
        covariance_of(problem)
