"""Where the rig was at any time, as a function of the states, with derivatives.

Three ways: at a state's own stamp; propagated from the nearest state by the IMU (exact, whatever the offset);
or, without an IMU, interpolated between the two neighbouring states (rotation along the geodesic, position
linearly).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from rigwake._types import Array, Indices
from rigwake.ba.solver.parameter_layout import ParameterLayout
from rigwake.ba.solver.preintegration import preintegrate
from rigwake.ba.solver.rig_problem import RigProblem
from rigwake.geometry import so3
from rigwake.geometry.interpolate import nearest_indices
from rigwake.geometry.se3 import SE3

_SAME_TIME_S = 1e-6  # a stamp within a microsecond of a state's is that state's


@dataclass(frozen=True, eq=False)
class TimedPoses:
    """`world_from_body` at n times, and what it depends on.

    by_states: (n, s, 6, w) derivative of the right tangent by the first w columns of `states` (n, s).
    by_shared: (n, 6, k) derivative by the columns `shared` (n, k), -1 where there is none.
    twist: (n, 6) velocity in the body's own axes, `[angular, linear]`: the derivative by time.
    """

    world_from_body: SE3
    states: Indices
    by_states: Array
    shared: Indices
    by_shared: Array
    twist: Array

    def with_shared(self, jacobian: Array, columns: Indices) -> TimedPoses:
        """The same poses depending on further shared parameters: (n, 6, k) or (6, k), and (k,) columns."""
        n, k = len(self.states), len(columns)
        return replace(
            self,
            by_shared=np.concatenate([self.by_shared, np.broadcast_to(jacobian, (n, 6, k))], axis=2),
            shared=np.concatenate([self.shared, np.broadcast_to(columns, (n, k))], axis=1),
        )

    def seen_from(self, body_from_other: SE3) -> TimedPoses:
        """The poses of another frame fixed to the body: `world_from_body * body_from_other`."""
        adjoint = body_from_other.inverse().adjoint()
        return replace(
            self,
            world_from_body=self.world_from_body * body_from_other,
            by_states=adjoint @ self.by_states,
            by_shared=adjoint @ self.by_shared,
            twist=self.twist @ adjoint.T,
        )

    def chain(self, layout: ParameterLayout) -> tuple[Array, Indices]:
        """All derivatives side by side (n, 6, q), and their columns (n, q)."""
        n, neighbours, _, width = self.by_states.shape
        by_states = np.moveaxis(self.by_states, 1, 2).reshape(n, 6, neighbours * width)
        columns = layout.state_columns(self.states, width).reshape(n, neighbours * width)
        return (
            np.concatenate([by_states, self.by_shared], axis=2),
            np.concatenate([columns, self.shared], axis=1),
        )

    def moved_by(self, layout: ParameterLayout, step: Array) -> Array:
        """(n, 6) tangents that a step of all columns causes."""
        jacobian, columns = self.chain(layout)
        return np.einsum("nij,nj->ni", jacobian, np.where(columns >= 0, step[columns], 0.0))


def state_times_s(problem: RigProblem) -> Array:
    """(N,) seconds of the states since the first one."""
    return seconds_since_start(problem, problem.states.timestamps_ns)


def seconds_since_start(problem: RigProblem, timestamps_ns: Indices) -> Array:
    """Seconds since the first state: integers are subtracted before the conversion."""
    return np.asarray((timestamps_ns - problem.states.timestamps_ns[0]) * 1e-9)


def nearest_states(problem: RigProblem, times_s: Array) -> Indices:
    """(n,) index of the state nearest in time."""
    return nearest_indices(state_times_s(problem), times_s)


def rig_at(
    problem: RigProblem, layout: ParameterLayout, times_s: Array, states: Indices, moving: bool
) -> TimedPoses:
    """Poses of the rig at `times_s` (n,) on the rig clock, seconds since the first state.

    states: (n,) state from which each is reached (`nearest_states`), held while times shift during a solve.
    moving: whether the times themselves depend on unknowns, or may differ from the states'.
    """
    if problem.imu is not None:
        return _propagated(problem, layout, times_s, states)
    if not moving and np.all(np.abs(times_s - state_times_s(problem)[states]) < _SAME_TIME_S):
        return at_states(problem, states)
    return _interpolated(problem, times_s)


def at_states(problem: RigProblem, states: Indices) -> TimedPoses:
    """Poses of the rig at its states (n,)."""
    poses = problem.states.world_from_rig[states]
    n = len(states)
    by_states = np.broadcast_to(np.eye(6), (n, 1, 6, 6))
    return TimedPoses(poses, states[:, None], by_states, *_nothing_shared(n), np.zeros((n, 6)))


def _nothing_shared(n: int) -> tuple[Indices, Array]:
    return np.zeros((n, 0), dtype=np.int64), np.zeros((n, 6, 0))


def _interpolated(problem: RigProblem, times_s: Array) -> TimedPoses:
    stamps = state_times_s(problem)
    left = np.clip(np.searchsorted(stamps, times_s, side="right") - 1, 0, len(stamps) - 2)
    span = stamps[left + 1] - stamps[left]
    fraction = ((times_s - stamps[left]) / span)[:, None]
    a, b = problem.states.world_from_rig[left], problem.states.world_from_rig[left + 1]
    turn = so3.log(np.swapaxes(a.rotation, -1, -2) @ b.rotation)
    part = so3.exp(fraction * turn)
    rotation = a.rotation @ part
    inverse = np.swapaxes(rotation, -1, -2)
    jacobian = np.zeros((len(times_s), 2, 6, 6))
    by_turn = fraction[..., None] * so3.right_jacobian(fraction * turn)
    jacobian[:, 0, :3, :3] = np.swapaxes(part, -1, -2) - by_turn @ so3.left_jacobian_inverse(turn)
    jacobian[:, 1, :3, :3] = by_turn @ so3.right_jacobian_inverse(turn)
    jacobian[:, 0, 3:, 3:] = (1 - fraction)[..., None] * (inverse @ a.rotation)
    jacobian[:, 1, 3:, 3:] = fraction[..., None] * (inverse @ b.rotation)
    step = b.translation - a.translation
    twist = np.concatenate([turn, np.einsum("nij,nj->ni", inverse, step)], axis=1) / span[:, None]
    poses = SE3(rotation, a.translation + fraction * step)
    states = np.stack([left, left + 1], axis=1)
    return TimedPoses(poses, states, jacobian, *_nothing_shared(len(states)), twist)


def _propagated(problem: RigProblem, layout: ParameterLayout, times_s: Array, states: Indices) -> TimedPoses:
    """Strapdown navigation from the state to the time, forwards or backwards (Forster et al. 2017, eq. 32)."""
    values = problem.states.inertial
    assert values is not None
    start = state_times_s(problem)[states]
    moved = preintegrate(problem, start, times_s, states)
    dt = (times_s - start)[:, None]
    origin, velocity = problem.states.world_from_rig[states], values.velocity_world[states]
    gravity = problem.gravity.acceleration_world
    rotation = origin.rotation @ moved.rotation
    translation = origin * moved.position + velocity * dt + 0.5 * gravity * dt**2
    back = np.swapaxes(moved.rotation, -1, -2)
    to_body = np.swapaxes(rotation, -1, -2)
    jacobian = np.zeros((len(times_s), 1, 6, 15))
    jacobian[:, 0, :3, :3] = back
    jacobian[:, 0, :3, 9:12] = moved.rotation_by_gyro_bias
    jacobian[:, 0, 3:, :3] = -back @ so3.hat(moved.position)
    jacobian[:, 0, 3:, 3:6] = back
    jacobian[:, 0, 3:, 6:9] = dt[..., None] * to_body
    jacobian[:, 0, 3:, 9:12] = back @ moved.position_by_gyro_bias
    jacobian[:, 0, 3:, 12:15] = back @ moved.position_by_accel_bias
    speed = velocity + gravity * dt + np.einsum("nij,nj->ni", origin.rotation, moved.velocity)
    twist = np.concatenate([moved.final_rate, np.einsum("nij,nj->ni", to_body, speed)], axis=1)
    poses = TimedPoses(
        SE3(rotation, translation), states[:, None], jacobian, *_nothing_shared(len(states)), twist
    )
    if not problem.gravity.free:
        return poses
    by_gravity = np.zeros((len(states), 6, 3))
    by_gravity[:, 3:] = 0.5 * dt[..., None] ** 2 * to_body
    return poses.with_shared(by_gravity, layout.shared_columns("gravity", "acceleration_world", 3))
