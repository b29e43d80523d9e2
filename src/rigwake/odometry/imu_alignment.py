"""A visual trajectory and an IMU: scale, gravity, accelerometer bias, and where the IMU is, in one linear solve."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from rigwake._types import Array
from rigwake.ba.solver.preintegration import preintegrate
from rigwake.ba.solver.rig_problem import InertialStates, Landmarks, Observations, RigProblem, States
from rigwake.errors import UnobservableError
from rigwake.geometry.interpolate import interpolate
from rigwake.geometry.se3 import SE3
from rigwake.odometry.gyro import GyroAlignment
from rigwake.recording import ImuStream
from rigwake.trajectory import Trajectory

GRAVITY = 9.81
_STEP_S = (
    0.5  # short enough for the bias to be constant, long enough for the noise of positions to matter less
)
_LEVER_STD_M = 3.0
_ACCEL_BIAS_STD = 0.2
_MAX_SCALE_STD = 0.3


def with_noise(imu: ImuStream) -> ImuStream:
    """The stream with densities of a MEMS sensor of the middle class (EuRoC's ADIS16448) where it names none."""
    return replace(
        imu,
        gyro_noise_density=imu.gyro_noise_density or 1.7e-4,
        accel_noise_density=imu.accel_noise_density or 2.0e-3,
        gyro_bias_walk=imu.gyro_bias_walk or 2.0e-5,
        accel_bias_walk=imu.accel_bias_walk or 3.0e-3,
    )


@dataclass(frozen=True, eq=False)
class InertialAlignment:
    """What the accelerometer tells of one segment.

    scale: metres per visual unit. gravity_visual: (3,) m/s^2 in the visual world. imu_cam: (3,) the IMU's position
    in the camera's frame, metres. accel_bias: (3,) IMU axes. covariance: (10, 10) of
    `[scale relative to itself, gravity, imu_cam, accel_bias]`, scaled by the residuals.
    """

    scale: float
    gravity_visual: Array
    imu_cam: Array
    accel_bias: Array
    covariance: Array


def align_inertial(
    trajectory: Trajectory, imu: ImuStream, gyro: GyroAlignment, *, scale: float | None = None
) -> InertialAlignment:
    """Scale, gravity, lever arm and accelerometer bias from preintegrated motions between neighbouring times.

    With positions `x_i = s c_i + R_i l` of the IMU and increments over (0, 1) and (1, 2), the velocity is
    eliminated (Mur-Artal and Tardos, *Visual-inertial monocular SLAM with map reuse*, 2017, eq. 18, with the lever
    arm and the bias as further unknowns; both are linear):

        (x2 - x1)/dt12 - (x1 - x0)/dt01 - g (dt01 + dt12)/2 = R0 dv01 - R0 dp01/dt01 + R1 dp12/dt12

    trajectory: one segment of `world_from_cam`. scale: known (held), or estimated if None.
    Weak priors keep the lever arm within metres and the bias within its data sheet; gravity has its length.
    Raises UnobservableError if the scale cannot be told: without acceleration there is none.
    """
    times_ns = _spaced_times(trajectory, imu, gyro.time_offset_s)
    poses = interpolate(trajectory.timestamps_ns, trajectory.world_from_body, times_ns)
    A, b = _equations(poses, times_ns, imu, gyro)
    unit = max(float(np.abs(trajectory.world_from_body.translation).max()), 1e-12)
    x, covariance = _solve(A, b, scale, unit)
    relative_std = float(np.sqrt(covariance[0, 0])) / abs(x[0]) if x[0] != 0 else np.inf
    if scale is None and (x[0] <= 0 or relative_std > _MAX_SCALE_STD):
        raise UnobservableError(
            f"{trajectory.name}: the accelerometer does not tell the scale (uncertain by "
            f"{100 * min(relative_std, 99.0):.0f} %).",
            consequence="The trajectory stays up to scale.",
            remedy="Record with GNSS, or with more acceleration: turns, stops, waves.",
        )
    covariance = covariance.copy()
    covariance[0] /= x[0]
    covariance[:, 0] /= x[0]
    return InertialAlignment(float(x[0]), x[1:4], x[4:7], x[7:10], covariance)


def _spaced_times(trajectory: Trajectory, imu: ImuStream, offset_s: float) -> NDArray[np.int64]:
    """Regular times, camera clock, inside both the trajectory and the IMU's span."""
    shift, margin = round(offset_s * 1e9), 20_000_000
    first = max(int(trajectory.timestamps_ns[0]), int(imu.timestamps_ns[0]) - shift + margin)
    last = min(int(trajectory.timestamps_ns[-1]), int(imu.timestamps_ns[-1]) - shift - margin)
    times = np.arange(first, last, round(_STEP_S * 1e9))
    if len(times) < 8:
        raise UnobservableError(
            f"{trajectory.name}: {max(last - first, 0) * 1e-9:.1f} s together with {imu.name} are too short.",
            remedy="Record at least several seconds.",
        )
    return times


def _equations(
    poses: SE3, times_ns: NDArray[np.int64], imu: ImuStream, gyro: GyroAlignment
) -> tuple[Array, Array]:
    """Rows (N - 2, 3, 10) and right-hand sides (N - 2, 3) of the linear system, in visual-world axes."""
    n = len(times_ns)
    zeros = np.zeros((n, 3))
    world_from_imu = poses.rotation @ gyro.imu_from_cam.T
    states = States(
        times_ns + round(gyro.time_offset_s * 1e9),
        SE3(world_from_imu, zeros),
        InertialStates(zeros, np.tile(gyro.gyro_bias, (n, 1)), zeros),
    )
    problem = RigProblem(
        states, (), Landmarks(zeros[:0], zeros[:0], zeros[:0, 0]), Observations.empty(), imu=with_noise(imu)
    )
    seconds = (times_ns - times_ns[0]) * 1e-9
    moved = preintegrate(problem, seconds[:-1], seconds[1:], np.arange(n - 1))
    dt = np.diff(seconds)[:, None]
    R0, R1 = world_from_imu[:-2], world_from_imu[1:-1]
    d0, d1 = dt[:-1], dt[1:]
    A = np.zeros((n - 2, 3, 10))
    for column, values in ((slice(0, 1), poses.translation[:, :, None]), (slice(4, 7), poses.rotation)):
        step = np.diff(values, axis=0) / dt[:, :, None]
        A[:, :, column] = np.diff(step, axis=0)
    A[:, :, 1:4] = -0.5 * (d0 + d1)[:, :, None] * np.eye(3)
    by_bias = moved.velocity_by_accel_bias, moved.position_by_accel_bias
    A[:, :, 7:] = -(
        R0 @ (by_bias[0][:-1] - by_bias[1][:-1] / d0[:, :, None]) + R1 @ by_bias[1][1:] / d1[:, :, None]
    )
    b = np.einsum("nij,nj->ni", R0, moved.velocity[:-1] - moved.position[:-1] / d0)
    b += np.einsum("nij,nj->ni", R1, moved.position[1:] / d1)
    return A, b


def _solve(A: Array, b: Array, scale: float | None, unit: float) -> tuple[Array, Array]:
    """Robust least squares with the priors; gravity is pulled onto its sphere by relinearising it."""
    free_scale = scale is None
    x: Array = np.zeros(10)
    x[0] = scale if scale is not None else 0.0
    x[1:4] = np.array([0.0, 0.0, -GRAVITY])
    weights, sigma = np.ones(len(b)), 1.0
    H = np.eye(10)
    for iteration in range(15):
        H, g = np.zeros((10, 10)), np.zeros(10)
        weighted = A * (weights / sigma**2)[:, None, None]
        H += np.einsum("nir,nis->rs", weighted, A)
        g += np.einsum("nir,ni->r", weighted, b)
        H[range(4, 7), range(4, 7)] += _LEVER_STD_M**-2.0
        H[range(7, 10), range(7, 10)] += _ACCEL_BIAS_STD**-2.0
        H[0, 0] += 1e-12  # keeps a camera without any motion solvable: its scale comes out as unknown
        if not free_scale:
            H[0, 0] += 1e12 * unit**2
            g[0] += 1e12 * unit**2 * x[0]
        if iteration > 1:  # |g| = 9.81, linearised about the present direction
            direction = x[1:4] / np.linalg.norm(x[1:4])
            H[1:4, 1:4] += 1e8 * np.outer(direction, direction)
            g[1:4] += 1e8 * GRAVITY * direction
        x = np.asarray(np.linalg.solve(H, g))
        residuals = np.linalg.norm(A @ x - b, axis=1)
        sigma = max(1.48 * float(np.median(residuals)) / np.sqrt(3), 1e-6)
        weights = 1 / (1 + (residuals / (3 * sigma)) ** 2)
    return x, np.asarray(np.linalg.inv(H))
