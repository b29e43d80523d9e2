"""Every factor's derivatives against finite differences, through the same step that the solver takes."""

from collections.abc import Callable, Iterable
from dataclasses import replace

import numpy as np
import pytest

from ba_rigs import Wanted, true_problem
from rigwake.ba.solver.camera_frames import frame_poses, frames_of
from rigwake.ba.solver.imu_factors import inertial_rows
from rigwake.ba.solver.linear_factors import (
    attitude_factors,
    baseline_factor,
    camera_distance_factor,
    distance_factor,
    gnss_factors,
    lasting_error_factors,
    measured_factors,
    pose_factors,
    relative_factors,
)
from rigwake.ba.solver.normal import Factors
from rigwake.ba.solver.parameter_layout import ParameterLayout, layout_of, retract, tangent_bases
from rigwake.ba.solver.reprojection import linearise
from rigwake.ba.solver.rig_problem import (
    CameraBaseline,
    CameraDistance,
    DistanceMeasurement,
    Gravity,
    LastingErrors,
    PoseMeasurements,
    PosePrior,
    RelativeMeasurements,
    RigProblem,
    SolverOptions,
    VectorPrior,
)
from rigwake.geometry.se3 import SE3
from rigwake.recording import AttitudeStream

PLAIN = SolverOptions(loss="none", gnss_loss_scale=1e9)
EVERYTHING = frozenset({"rig_from_cam", "time_offset", "line_delay", "intrinsics"})
FEW = Wanted(cameras=2, seconds=0.6, state_hz=5.0, landmarks=20, noise_px=0.0, offsets_s=(0.013, -0.021))


def disturbed(problem: RigProblem, seed: int = 3) -> RigProblem:
    """Values off the truth, so that residuals and their second-order terms are not zero."""
    rng = np.random.default_rng(seed)
    layout = layout_of(problem)
    step = rng.normal(0, 1e-2, layout.n_columns)
    step[layout.extras_start :] = 0.0
    marks = rng.normal(0, 1e-3, (len(problem.landmarks), 3))
    return retract(problem, layout, step, marks, tangent_bases(problem.landmarks.bearings_world))


def free_rig(wanted: Wanted = FEW) -> RigProblem:
    problem = true_problem(wanted)
    cameras = tuple(replace(camera, free=EVERYTHING) for camera in problem.cameras)
    problem = replace(problem, cameras=cameras, antenna=replace(problem.antenna, free=True))
    return disturbed(replace(problem, gravity=Gravity(np.array([0.1, -0.2, -9.8]), free=True)))


def nudged(problem: RigProblem, layout: ParameterLayout, column: int, size: float) -> RigProblem:
    step = np.zeros(layout.n_columns)
    step[column] = size
    nothing = np.zeros((len(problem.landmarks), 3))
    return retract(problem, layout, step, nothing, tangent_bases(problem.landmarks.bearings_world))


def check(problem: RigProblem, build: Callable[[RigProblem, ParameterLayout], Iterable[Factors]]) -> None:
    layout, h = layout_of(problem), 1e-6
    every = list(build(problem, layout))
    assert every
    dense = [np.zeros((*factors.residuals.shape, layout.n_columns + 1)) for factors in every]
    for factors, target in zip(every, dense, strict=True):
        for row in range(len(target)):
            target[row][:, factors.columns[row]] = factors.jacobian[row]
    for column in range(layout.n_columns):
        ahead = build(nudged(problem, layout, column, h), layout)
        behind = build(nudged(problem, layout, column, -h), layout)
        for plus, minus, target in zip(ahead, behind, dense, strict=True):
            slope = (plus.residuals - minus.residuals) / (2 * h)
            scale = np.abs(target[:, :, column]).max() + np.abs(plus.residuals).max() * 1e-3 + 1e-3
            np.testing.assert_allclose(target[:, :, column], slope, atol=2e-5 * scale, rtol=1e-5)


def some_poses(problem: RigProblem) -> SE3:
    rng = np.random.default_rng(5)
    n = len(problem.states)
    return problem.states.world_from_rig.retract(rng.normal(0, 0.05, (n, 6)))


COVARIANCES = np.diag([0.01, 0.02, 0.03, 0.1, 0.2, 0.3]) ** 2


@pytest.mark.parametrize("imu", [True, False])
def test_gnss(imu: bool) -> None:
    check(free_rig(replace(FEW, imu=imu)), lambda p, layout: [gnss_factors(p, layout, PLAIN)])


def test_the_receivers_delay_and_lasting_errors() -> None:
    problem = free_rig(replace(FEW, imu=True))
    first = int(problem.states.timestamps_ns[0])
    nodes = first + np.array([0, 400_000_000, 1_000_000_000])
    errors = LastingErrors(
        nodes, np.random.default_rng(0).normal(0, 0.3, (3, 3)), np.array([0.5, 0.4, 0.8]), 20.0
    )
    delay = VectorPrior.from_std(0.0, 0.05)
    antenna = replace(problem.antenna, time_offset_s=0.004, time_offset_prior=delay, errors=errors)
    check(
        replace(problem, antenna=antenna),
        lambda p, layout: [
            gnss_factors(p, layout, PLAIN),
            *lasting_error_factors(p.antenna.errors, layout),
        ],
    )


@pytest.mark.parametrize("imu", [True, False])
def test_attitude(imu: bool) -> None:
    problem = free_rig(replace(FEW, imu=imu))
    stamps = problem.states.timestamps_ns[:-1] + 30_000_000
    measured = some_poses(problem).rotation[:-1]
    covariances = np.broadcast_to(np.diag([1.0, 4.0, 0.01]), (len(stamps), 3, 3))
    stream = AttitudeStream("ins", stamps, measured, covariances)
    check(replace(problem, attitude=stream), lambda p, layout: [attitude_factors(p, layout)])


def test_inertial() -> None:
    # the covariance follows the biases too; an iteration holds it
    def unwhitened(problem: RigProblem, layout: ParameterLayout) -> list[Factors]:
        residuals, jacobian, columns, _ = inertial_rows(problem, layout)
        return [Factors(residuals, jacobian, columns, 0.0)]

    check(free_rig(), unwhitened)


def test_poses_motions_and_distance() -> None:
    problem = free_rig()
    at = np.array([1, 3])
    problem = replace(
        problem, poses=PoseMeasurements(at, some_poses(problem)[at], np.stack([COVARIANCES, COVARIANCES]))
    )
    motion = some_poses(problem)[np.array([0, 2])].inverse() * some_poses(problem)[at]
    relative = [
        RelativeMeasurements(np.array([0, 2]), at, motion, np.stack([COVARIANCES, COVARIANCES]), camera)
        for camera in (-1, 1)
    ]
    check(
        problem,
        lambda p, layout: [
            pose_factors(p, layout),
            *(relative_factors(p, layout, one) for one in relative),
            distance_factor(p, layout, DistanceMeasurement(0, 3, 1.0, 0.1)),
        ],
    )


def test_baseline_and_priors() -> None:
    problem = free_rig()
    a, b = problem.cameras
    mean = (a.rig_from_cam.inverse() * b.rig_from_cam).retract([0.02, 0.01, -0.03, 0.1, 0.2, -0.1])
    baseline = CameraBaseline(0, 1, PosePrior(mean, np.diag([1.0, 2, 3, 4, 5, 0])))
    known = CameraDistance(0, 1, 1.3, 0.02)
    check(
        problem,
        lambda p, layout: [baseline_factor(p, layout, baseline), camera_distance_factor(p, layout, known)],
    )
    tape = PosePrior.in_axes_of_a(mean, [np.inf, 0.1, np.inf, 0.02, np.inf, 0.01])
    camera = replace(
        a,
        rig_from_cam_prior=tape,
        time_offset_prior=VectorPrior.from_std(0.0, 0.01),
        line_delay_prior=VectorPrior.from_std(1e-5, 1e-5),
        intrinsics_prior=VectorPrior.from_std(a.model.params + 0.01, 2.0),
    )
    antenna = replace(problem.antenna, prior=VectorPrior.from_std([0.0, 0.0, 1.0], 0.1))
    gravity = replace(problem.gravity, prior=VectorPrior.from_std([0.0, 0.0, -9.81], 0.1))
    problem = replace(problem, cameras=(camera, b), antenna=antenna, gravity=gravity)
    assert len(list(measured_factors(problem, layout_of(problem), PLAIN))) == 1 + 6
    check(problem, lambda p, layout: measured_factors(p, layout, PLAIN))


@pytest.mark.parametrize("imu", [True, False])
@pytest.mark.parametrize("line_delay_s", [0.0, 4e-5])
def test_reprojection(imu: bool, line_delay_s: float) -> None:
    problem = free_rig(replace(FEW, imu=imu, line_delay_s=line_delay_s))
    layout, frames = layout_of(problem), frames_of(problem)
    poses = frame_poses(problem, layout, frames)
    _, linear = linearise(problem, layout, frames, poses, PLAIN)

    def residuals(p: RigProblem) -> np.ndarray:
        # the twist that carries a rolling shutter is held within an iteration
        moved = replace(frame_poses(p, layout, frames), twist=poses.twist)
        return linearise(p, layout, frames, moved, PLAIN)[1].residuals

    for column in range(layout.n_columns):
        h = 1e-9 if column in range(*line_delay_columns(layout)) else 1e-6
        step = np.zeros(layout.n_columns)
        step[column] = 1.0
        predicted = np.einsum("mij,mj->mi", linear.by_frame, poses.moved_by(layout, step)[linear.frames])
        extras = np.where(linear.extras >= 0, step[layout.extras_start :][linear.extras], 0.0)
        predicted += np.einsum("mij,mj->mi", linear.by_extras, extras)
        plus, minus = (residuals(nudged(problem, layout, column, sign * h)) for sign in (1, -1))
        scale = np.abs(predicted).max() + 1.0
        np.testing.assert_allclose(
            predicted, (plus - minus) / (2 * h), atol=3e-5 * scale, err_msg=str(column)
        )
    bases = tangent_bases(problem.landmarks.bearings_world)
    for k in range(3):
        marks = np.zeros((len(problem.landmarks), 3))
        marks[:, k] = 1e-6
        ahead = residuals(retract(problem, layout, np.zeros(layout.n_columns), marks, bases))
        behind = residuals(retract(problem, layout, np.zeros(layout.n_columns), -marks, bases))
        np.testing.assert_allclose(linear.by_landmark[:, :, k], (ahead - behind) / 2e-6, rtol=1e-4, atol=1e-3)


def line_delay_columns(layout: ParameterLayout) -> tuple[int, int]:
    blocks = [block for (_, kind), block in layout.shared.items() if kind == "line_delay"]
    return blocks[0].start, blocks[0].stop
