"""How noisy an IMU really is: data sheets know nothing of vibration, scale errors and aliasing."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from rigwake._robust import MAD_TO_STD
from rigwake.ba.solver.imu_factors import inertial_rows
from rigwake.ba.solver.parameter_layout import layout_of
from rigwake.ba.solver.rig_problem import RigProblem, RigSolution
from rigwake.recording import ImuStream

_FEWEST = 20  # intervals between states


def imu_noise_scales(solution: RigSolution) -> tuple[float, float]:
    """How much the residuals of gyroscope and accelerometer exceed what their densities predict; 1 or more.

    The robust spread of the whitened changes of rotation and of velocity between neighbouring states. Residuals
    below the assumed values say little, since the states follow the IMU where nothing else holds
    them: they change nothing.
    """
    problem = solution.problem
    if problem.imu is None or len(problem.states) <= _FEWEST:
        return 1.0, 1.0
    residuals, _, _, covariances = inertial_rows(problem, layout_of(problem))
    whitened = np.abs(residuals) / np.sqrt(np.einsum("nii->ni", covariances))
    turn, speed = (MAD_TO_STD * float(np.median(whitened[:, rows])) for rows in (slice(0, 3), slice(3, 6)))
    return max(turn, 1.0), max(speed, 1.0)


def with_imu_noise(problem: RigProblem, scales: tuple[float, float]) -> RigProblem:
    """The problem with the densities of gyroscope and accelerometer scaled."""
    imu = problem.imu
    if imu is None or imu.gyro_noise_density is None or imu.accel_noise_density is None:
        return problem
    gyro, accel = imu.gyro_noise_density * scales[0], imu.accel_noise_density * scales[1]
    return replace(problem, imu=replace(imu, gyro_noise_density=gyro, accel_noise_density=accel))


def imu_noise_factors(assumed: ImuStream | None, found: ImuStream | None) -> dict[str, float]:
    """How many times noisier than assumed `gyro` and `accel` were found to be; empty where nothing was assumed."""
    if assumed is None or found is None:
        return {}
    pairs = {
        "gyro": (assumed.gyro_noise_density, found.gyro_noise_density),
        "accel": (assumed.accel_noise_density, found.accel_noise_density),
    }
    return {name: b / a for name, (a, b) in pairs.items() if a is not None and b is not None}
