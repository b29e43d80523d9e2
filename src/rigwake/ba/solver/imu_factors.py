"""Inertial factors: the motion between neighbouring states against what the IMU says, and how biases wander.

Source: Forster et al. (2017), eq. 37, 45 and 48; velocities and positions are compared in the axes of the
earlier state. Samples are integrated anew at the current biases, so no first-order bias update is needed.
"""

from __future__ import annotations

import numpy as np

from rigwake._types import Array, Indices
from rigwake.ba.solver.linear_factors import whitening
from rigwake.ba.solver.normal import Factors
from rigwake.ba.solver.parameter_layout import ParameterLayout
from rigwake.ba.solver.preintegration import LONGEST_BRIDGE_S, Preintegrated, imu_noise, preintegrate
from rigwake.ba.solver.rig_problem import RigProblem
from rigwake.ba.solver.state_motion import state_times_s
from rigwake.geometry import so3


def inertial_factors(problem: RigProblem, layout: ParameterLayout) -> Factors:
    """One factor of 15 rows `[rotation, velocity, position, gyro bias, accel bias]` per pair of neighbours.

    Neighbours further apart than `LONGEST_BRIDGE_S` belong to different sections: the first nine rows are empty.
    """
    residuals, jacobian, columns, covariance = inertial_rows(problem, layout)
    whiten = whitening(covariance)
    # from one section to the next only the biases are known to be related
    apart = np.diff(problem.states.timestamps_ns) > round(LONGEST_BRIDGE_S * 1e9)
    whiten[apart, :9] = 0.0
    r = np.einsum("nij,nj->ni", whiten, residuals)
    return Factors(r, whiten @ jacobian, columns, 0.5 * float(np.sum(r * r)))


def inertial_rows(problem: RigProblem, layout: ParameterLayout) -> tuple[Array, Array, Indices, Array]:
    """Unwhitened residuals (n, 15), derivatives (n, 15, 33) by columns (n, 33), and covariances (n, 15, 15)."""
    values, times = problem.states.inertial, state_times_s(problem)
    assert problem.imu is not None
    assert values is not None
    earlier, dt = np.arange(len(times) - 1), np.diff(times)
    moved = preintegrate(problem, times[:-1], times[1:], earlier)
    residuals, jacobian = _motion_rows(problem, values.velocity_world, moved, dt)
    noise, covariance = imu_noise(problem.imu), np.zeros((len(dt), 15, 15))
    covariance[:, :9, :9] = moved.covariance
    biases = ((9, values.gyro_bias, noise.gyro_walk), (12, values.accel_bias, noise.accel_walk))
    for row, bias, walk in biases:
        rows = slice(row, row + 3)
        residuals[:, rows] = np.diff(bias, axis=0)
        jacobian[:, rows, rows] = -np.eye(3)
        jacobian[:, rows, row + 15 : row + 18] = np.eye(3)
        covariance[:, rows, rows] = np.eye(3) * walk**2 * dt[:, None, None]
    gravity = np.broadcast_to(layout.shared_columns("gravity", "acceleration_world", 3), (len(dt), 3))
    states = [layout.state_columns(earlier + k, 15) for k in (0, 1)]
    return residuals, jacobian, np.concatenate([*states, gravity], axis=1), covariance


def _motion_rows(
    problem: RigProblem, velocity: Array, moved: Preintegrated, dt: Array
) -> tuple[Array, Array]:
    """Unwhitened residuals (n, 15) and derivatives (n, 15, 33), the first nine rows filled."""
    gravity = problem.gravity.acceleration_world
    a, b = problem.states.world_from_rig[:-1], problem.states.world_from_rig[1:]
    to_a = np.swapaxes(a.rotation, 1, 2)
    h = dt[:, None]
    speed_change = np.einsum("nij,nj->ni", to_a, np.diff(velocity, axis=0) - gravity * h)
    path = b.translation - a.translation - velocity[:-1] * h - 0.5 * gravity * h**2
    offset = np.einsum("nij,nj->ni", to_a, path)
    turned = to_a @ b.rotation
    n = len(dt)
    residuals, jacobian = np.zeros((n, 15)), np.zeros((n, 15, 33))
    residuals[:, :3] = so3.log(np.swapaxes(moved.rotation, 1, 2) @ turned)
    residuals[:, 3:6] = speed_change - moved.velocity
    residuals[:, 6:9] = offset - moved.position
    inverse = so3.right_jacobian_inverse(residuals[:, :3])
    jacobian[:, :3, :3] = -inverse @ np.swapaxes(turned, 1, 2)
    jacobian[:, :3, 15:18] = inverse
    # log(Exp(-x) E) = log(E) - J_l^-1(log E) x for a step x of the preintegrated rotation
    jacobian[:, :3, 9:12] = -so3.left_jacobian_inverse(residuals[:, :3]) @ moved.rotation_by_gyro_bias
    jacobian[:, 3:6, :3] = so3.hat(speed_change)
    jacobian[:, 3:6, 6:9], jacobian[:, 3:6, 21:24] = -to_a, to_a
    jacobian[:, 3:6, 9:12] = -moved.velocity_by_gyro_bias
    jacobian[:, 3:6, 12:15] = -moved.velocity_by_accel_bias
    jacobian[:, 3:6, 30:] = -to_a * dt[:, None, None]
    jacobian[:, 6:9, :3], jacobian[:, 6:9, 3:6] = so3.hat(offset), -np.eye(3)
    jacobian[:, 6:9, 6:9] = -to_a * dt[:, None, None]
    jacobian[:, 6:9, 18:21] = turned
    jacobian[:, 6:9, 9:12] = -moved.position_by_gyro_bias
    jacobian[:, 6:9, 12:15] = -moved.position_by_accel_bias
    jacobian[:, 6:9, 30:] = -0.5 * to_a * dt[:, None, None] ** 2
    return residuals, jacobian
