"""Everything that is not a pixel: GNSS, attitude, pose and motion measurements, and priors, as linear factors.

Every function returns whitened residuals with derivatives by columns of the `ParameterLayout`. A residual of poses is
`log(measured^-1 * estimated)`: the right tangent, like every covariance here.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from rigwake._types import Array, Indices, Mask
from rigwake.ba.solver.normal import Factors
from rigwake.ba.solver.parameter_layout import ParameterLayout
from rigwake.ba.solver.preintegration import LONGEST_BRIDGE_S
from rigwake.ba.solver.rig_problem import (
    CameraBaseline,
    CameraDistance,
    DistanceMeasurement,
    LastingErrors,
    PosePrior,
    RelativeMeasurements,
    RigProblem,
    SolverOptions,
    VectorPrior,
)
from rigwake.ba.solver.robust_loss import robust
from rigwake.ba.solver.state_motion import (
    at_states,
    nearest_states,
    rig_at,
    seconds_since_start,
    state_times_s,
)
from rigwake.geometry import se3, so3
from rigwake.geometry.se3 import SE3


def measured_factors(
    problem: RigProblem, layout: ParameterLayout, options: SolverOptions
) -> Iterator[Factors]:
    """All factors of the problem but pixels and inertial ones."""
    if problem.gnss is not None:
        yield gnss_factors(problem, layout, options)
        if problem.antenna.errors is not None:
            yield from lasting_error_factors(problem.antenna.errors, layout)
    if problem.attitude is not None:
        yield attitude_factors(problem, layout)
    if problem.poses is not None:
        yield pose_factors(problem, layout)
    for relative in problem.relative:
        yield relative_factors(problem, layout, relative)
    for distance in problem.distances:
        yield distance_factor(problem, layout, distance)
    for baseline in problem.baselines:
        yield baseline_factor(problem, layout, baseline)
    for known in problem.camera_distances:
        yield camera_distance_factor(problem, layout, known)
    yield from _prior_factors(problem, layout)


def inside_states(problem: RigProblem, timestamps_ns: Indices) -> Mask:
    """Which stamps lie between the first and the last state, and not between two sections."""
    stamps = problem.states.timestamps_ns
    inside = (timestamps_ns >= stamps[0]) & (timestamps_ns <= stamps[-1])
    after = np.minimum(np.searchsorted(stamps, timestamps_ns), len(stamps) - 1)
    apart = stamps[after] - stamps[np.maximum(after - 1, 0)] > round(LONGEST_BRIDGE_S * 1e9)
    return np.asarray(inside & ~(apart & (timestamps_ns < stamps[after])))


def whitening(covariances: Array) -> Array:
    """(..., k, k) matrices W with `W^T W = covariance^-1`."""
    return np.linalg.inv(np.linalg.cholesky(covariances))


def _whitened(residuals: Array, jacobian: Array, columns: Indices, whiten: Array) -> Factors:
    r = np.einsum("nij,nj->ni", whiten, residuals)
    return Factors(r, whiten @ jacobian, columns, 0.5 * float(np.sum(r * r)))


def gnss_factors(problem: RigProblem, layout: ParameterLayout, options: SolverOptions) -> Factors:
    """Antenna positions, with Huber's loss: `world_from_rig(t + offset) * antenna + lasting error - fix`."""
    gnss, antenna = problem.gnss, problem.antenna
    assert gnss is not None
    kept, shift_ns = fixes_inside(problem)
    times = seconds_since_start(problem, gnss.timestamps_ns[kept] + shift_ns)
    times = times + (antenna.time_offset_s - shift_ns * 1e-9)
    arm = antenna.position_rig
    moving = antenna.time_offset_prior is not None
    rig = rig_at(problem, layout, times, nearest_states(problem, times), moving=moving)
    rotation = rig.world_from_body.rotation
    by_pose = np.concatenate([-rotation @ so3.hat(arm), rotation], axis=2)
    chained, columns = rig.chain(layout)
    parts, blocks = [by_pose @ chained], [columns]
    if antenna.free:
        own = layout.shared_columns("antenna", "position_rig", 3)
        parts.append(rotation)
        blocks.append(np.broadcast_to(own, (len(columns), 3)))
    if moving:
        own = layout.shared_columns("antenna", "time_offset", 1)
        parts.append(by_pose @ rig.twist[:, :, None])
        blocks.append(np.broadcast_to(own, (len(columns), 1)))
    residuals = rig.world_from_body * arm - gnss.position_enu[kept]
    if antenna.errors is not None:
        error, by_nodes, own = _lasting_error(antenna.errors, layout, gnss.timestamps_ns[kept])
        residuals = residuals + error
        parts.append(by_nodes)
        blocks.append(own)
    jacobian, columns = np.concatenate(parts, axis=2), np.concatenate(blocks, axis=1)
    plain = _whitened(residuals, jacobian, columns, whitening(gnss.covariances[kept]))
    squared = np.sum(plain.residuals**2, axis=1)
    loss, slope = robust(squared, "huber", options.gnss_loss_scale)
    root = np.sqrt(slope)
    return Factors(
        plain.residuals * root[:, None],
        plain.jacobian * root[:, None, None],
        columns,
        0.5 * float(loss.sum()),
    )


def fixes_inside(problem: RigProblem) -> tuple[Mask, int]:
    """(G,) fixes that take part, and the time offset (ns) that decides it: it stays while the estimate moves."""
    gnss, antenna = problem.gnss, problem.antenna
    assert gnss is not None
    known = antenna.time_offset_prior
    shift_ns = round(1e9 * (antenna.time_offset_s if known is None else float(known.mean[0])))
    return inside_states(problem, gnss.timestamps_ns + shift_ns), shift_ns


def _lasting_error(
    errors: LastingErrors, layout: ParameterLayout, at_ns: Indices
) -> tuple[Array, Array, Indices]:
    """The error (n, 3) at these stamps, its derivative (n, 3, 6) by the two nodes around, and their columns (n, 6)."""
    nodes = errors.timestamps_ns
    own = layout.shared_columns("antenna", "errors", 3 * len(nodes)).reshape(-1, 3)
    if len(nodes) == 1:
        by_node = np.broadcast_to(np.eye(3), (len(at_ns), 3, 3))
        return (
            np.broadcast_to(errors.values_enu, (len(at_ns), 3)),
            by_node,
            np.broadcast_to(own, (len(at_ns), 3)),
        )
    left = np.clip(np.searchsorted(nodes, at_ns, side="right") - 1, 0, len(nodes) - 2)
    fraction = (at_ns - nodes[left]) / (nodes[left + 1] - nodes[left]).astype(np.float64)
    fraction = np.clip(fraction, 0.0, 1.0)[:, None]
    error = (1 - fraction) * errors.values_enu[left] + fraction * errors.values_enu[left + 1]
    by_nodes = np.concatenate([(1 - x)[..., None] * np.eye(3) for x in (fraction, 1 - fraction)], axis=2)
    return error, by_nodes, np.concatenate([own[left], own[left + 1]], axis=1)


def lasting_error_factors(errors: LastingErrors, layout: ParameterLayout) -> Iterator[Factors]:
    """The Gauss-Markov process itself: `e_0 ~ N(0, s^2)`, `e_k - rho e_(k-1) ~ N(0, s^2 (1 - rho^2))`,
    `rho = exp(-dt / tau)`."""
    nodes, values = errors.timestamps_ns, errors.values_enu
    own = layout.shared_columns("antenna", "errors", 3 * len(nodes)).reshape(-1, 3)
    root = np.diag(1 / errors.std)
    yield _whitened(values[:1], np.eye(3)[None], own[:1], root[None])
    if len(nodes) > 1:
        rho = np.exp(-np.diff(nodes) * 1e-9 / errors.correlation_s)[:, None]
        jacobian = np.concatenate([-rho[..., None] * np.eye(3), np.tile(np.eye(3), (len(rho), 1, 1))], axis=2)
        columns = np.concatenate([own[:-1], own[1:]], axis=1)
        whiten = root / np.sqrt(1 - rho[..., None] ** 2)
        yield _whitened(values[1:] - rho * values[:-1], jacobian, columns, whiten)


def attitude_factors(problem: RigProblem, layout: ParameterLayout) -> Factors:
    """Measured rotations; heading alone is one with huge variances of roll and pitch."""
    attitude = problem.attitude
    assert attitude is not None
    kept = inside_states(problem, attitude.timestamps_ns)
    times = seconds_since_start(problem, attitude.timestamps_ns[kept])
    rig = rig_at(problem, layout, times, nearest_states(problem, times), moving=False)
    measured = attitude.world_from_body[kept]
    residuals = so3.log(np.swapaxes(measured, 1, 2) @ rig.world_from_body.rotation)
    chained, columns = rig.chain(layout)
    jacobian = so3.right_jacobian_inverse(residuals) @ chained[:, :3]
    return _whitened(residuals, jacobian, columns, whitening(attitude.covariances[kept]))


def pose_factors(problem: RigProblem, layout: ParameterLayout) -> Factors:
    """Measured poses of states."""
    poses = problem.poses
    assert poses is not None
    rig = at_states(problem, poses.state_indices)
    residuals = poses.world_from_rig.local(rig.world_from_body)
    chained, columns = rig.chain(layout)
    jacobian = se3.right_jacobian_inverse(residuals) @ chained
    return _whitened(residuals, jacobian, columns, whitening(poses.covariances))


def relative_factors(problem: RigProblem, layout: ParameterLayout, relative: RelativeMeasurements) -> Factors:
    """Measured motions of the rig, or of one camera, between two states."""
    start = at_states(problem, relative.from_states)
    end = at_states(problem, relative.to_states)
    if relative.camera_index >= 0:
        camera = problem.cameras[relative.camera_index]
        start, end = start.seen_from(camera.rig_from_cam), end.seen_from(camera.rig_from_cam)
    moved = start.world_from_body.inverse() * end.world_from_body
    residuals = relative.body_from_body.local(moved)
    outer = se3.right_jacobian_inverse(residuals)
    back = -moved.inverse().adjoint()
    (by_start, start_columns), (by_end, end_columns) = start.chain(layout), end.chain(layout)
    jacobian = np.concatenate([back @ by_start, by_end], axis=2)
    columns = np.concatenate([start_columns, end_columns], axis=1)
    if relative.camera_index >= 0 and "rig_from_cam" in camera.free:
        own = layout.shared_columns(camera.name, "rig_from_cam", 6)
        jacobian = np.concatenate([jacobian, np.eye(6) + back], axis=2)
        columns = np.concatenate([columns, np.broadcast_to(own, (len(columns), 6))], axis=1)
    return _whitened(residuals, outer @ jacobian, columns, whitening(relative.covariances))


def distance_factor(problem: RigProblem, layout: ParameterLayout, measured: DistanceMeasurement) -> Factors:
    """The distance between two states: what gives cameras alone a unit of length."""
    states = np.array([measured.from_state, measured.to_state])
    poses = problem.states.world_from_rig[states]
    step = poses.translation[1] - poses.translation[0]
    length = float(np.linalg.norm(step))
    direction = step / length
    jacobian = np.concatenate([-direction @ poses.rotation[0], direction @ poses.rotation[1]])[None, None]
    columns = layout.state_columns(states, 6)[:, 3:].reshape(1, 6)
    residuals = np.array([[length - measured.distance]])
    return _whitened(residuals, jacobian, columns, np.full((1, 1, 1), 1 / measured.std))


def baseline_factor(problem: RigProblem, layout: ParameterLayout, baseline: CameraBaseline) -> Factors:
    """A known transform between two cameras."""
    a_from_b, by_step, columns = _between(problem, layout, baseline.camera_a, baseline.camera_b)
    return _transform_prior(a_from_b, baseline.prior, by_step, columns)


def camera_distance_factor(problem: RigProblem, layout: ParameterLayout, known: CameraDistance) -> Factors:
    """A known distance between two cameras: `d |t| = (R^T t / |t|) . d`, with t, R of `a_from_b`."""
    a_from_b, by_step, columns = _between(problem, layout, known.camera_a, known.camera_b)
    length = max(float(np.linalg.norm(a_from_b.translation)), 1e-9)
    along = a_from_b.rotation.T @ a_from_b.translation / length
    residuals = np.array([[length - known.distance]])
    jacobian = (along @ by_step[3:])[None, None]
    return _whitened(residuals, jacobian, columns[None], np.full((1, 1, 1), 1 / known.std))


def _between(problem: RigProblem, layout: ParameterLayout, a: int, b: int) -> tuple[SE3, Array, Indices]:
    """`a_from_b` of two cameras, the derivative (6, 12) of its right tangent by both mountings, their columns."""
    cameras = problem.cameras[a], problem.cameras[b]
    a_from_b = cameras[0].rig_from_cam.inverse() * cameras[1].rig_from_cam
    columns = np.concatenate([layout.shared_columns(x.name, "rig_from_cam", 6) for x in cameras])
    by_step = np.concatenate([-a_from_b.inverse().adjoint(), np.eye(6)], axis=1)
    return a_from_b, by_step, columns


def _transform_prior(estimate: SE3, prior: PosePrior, by_step: Array, columns: Indices) -> Factors:
    residual = prior.mean.local(estimate)
    jacobian = se3.right_jacobian_inverse(residual) @ by_step
    return _whitened(residual[None], jacobian[None], columns[None], _root(prior.information)[None])


def _vector_prior(values: Array, prior: VectorPrior, columns: Indices) -> Factors:
    residual = np.atleast_1d(values - prior.mean)
    return _whitened(
        residual[None], np.eye(len(residual))[None], columns[None], _root(prior.information)[None]
    )


def _root(information: Array) -> Array:
    """W with `W^T W = information`, which may be singular."""
    eigenvalues, vectors = np.linalg.eigh(information)
    return np.sqrt(np.maximum(eigenvalues, 0.0))[:, None] * vectors.T


def _prior_factors(problem: RigProblem, layout: ParameterLayout) -> Iterator[Factors]:
    for camera in problem.cameras:
        if camera.rig_from_cam_prior is not None and "rig_from_cam" in camera.free:
            columns = layout.shared_columns(camera.name, "rig_from_cam", 6)
            yield _transform_prior(camera.rig_from_cam, camera.rig_from_cam_prior, np.eye(6), columns)
        for kind, value, prior in (
            ("time_offset", camera.time_offset_s, camera.time_offset_prior),
            ("line_delay", camera.line_delay_s, camera.line_delay_prior),
            ("intrinsics", camera.model.params, camera.intrinsics_prior),
        ):
            if prior is not None and kind in camera.free:
                columns = layout.shared_columns(camera.name, kind, len(prior.mean))
                yield _vector_prior(np.atleast_1d(value), prior, columns)
    for owner, kind, value, prior in (
        ("antenna", "position_rig", problem.antenna.position_rig, problem.antenna.prior),
        ("antenna", "time_offset", problem.antenna.time_offset_s, problem.antenna.time_offset_prior),
        ("gravity", "acceleration_world", problem.gravity.acceleration_world, problem.gravity.prior),
    ):
        if prior is not None and (owner, kind) in layout.shared:
            yield _vector_prior(
                np.atleast_1d(value), prior, layout.shared_columns(owner, kind, len(prior.mean))
            )


def coupled_states(problem: RigProblem) -> Indices:
    """(n, 2) pairs of states that factors tie directly, for the shape of the equations."""
    n = len(problem.states)
    neighbours = np.stack([np.arange(n - 1), np.arange(1, n)], axis=1)
    pairs = [neighbours] + [np.stack([r.from_states, r.to_states], axis=1) for r in problem.relative]
    pairs += [np.array([[d.from_state, d.to_state]]) for d in problem.distances]
    return np.concatenate(pairs).astype(np.int64)


def out_of_range_notes(problem: RigProblem) -> tuple[str, ...]:
    """What the problem's span in time leaves out."""
    notes = []
    for stream, what in ((problem.gnss, "GNSS fixes"), (problem.attitude, "attitudes")):
        if stream is not None:
            outside = int(np.sum(~inside_states(problem, stream.timestamps_ns)))
            if outside:
                notes.append(
                    f"{outside} {what} lie before the first or after the last state and are left out"
                )
    imu = problem.imu
    if imu is not None:
        times = seconds_since_start(problem, imu.timestamps_ns)
        span = state_times_s(problem)
        if times[0] > span[0] + 1e-9 or times[-1] < span[-1] - 1e-9:
            notes.append("the IMU starts after the first state or ends before the last one")
    return tuple(notes)
