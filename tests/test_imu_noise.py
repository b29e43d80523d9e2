"""IMUs that are noisier than their data sheet."""

from dataclasses import replace

import numpy as np
import pytest

from calibration_worlds import first_values, measurements, sail
from rigwake.ba.rig.assemble_problem import assemble_problem
from rigwake.ba.rig.imu_noise import imu_noise_factors, with_imu_noise
from rigwake.ba.rig.outlier_rounds import adjust
from rigwake.ba.rig.rig_values import AdjustmentOptions

OPTIONS = AdjustmentOptions(state_rate_hz=3.0, tracks_per_second=20, rounds=4)
# coarse enough for the cameras to see it between two states
COARSE = {"gyro_noise_density": 2e-3, "accel_noise_density": 0.3}


def factors_found(gyro: float, accel: float) -> dict[str, float]:
    """Of an IMU whose predict is better than its noise by these factors."""
    world = sail(features=50, imu=COARSE)
    measured = measurements(world)
    assembled = assemble_problem(measured, first_values(world), OPTIONS)
    problem = with_imu_noise(assembled.problem, (1 / gyro, 1 / accel))
    found = adjust(replace(assembled, problem=problem), OPTIONS).solution.problem
    assert problem.imu is not None
    assert found.imu is not None
    return imu_noise_factors(problem.imu, found.imu)


def test_an_honest_data_sheet_is_believed():
    assert np.allclose(list(factors_found(1, 1).values()), 1.0, atol=0.15)


@pytest.mark.parametrize(("gyro", "accel"), [(8, 1), (1, 8), (8, 8)])
def test_noise_beyond_the_data_sheet_is_found_in_the_residuals(gyro, accel):
    found = factors_found(gyro, accel)
    # the other measurements hold the states only so firmly: the factor comes out somewhat low, never high
    assert 0.5 * gyro < found["gyro"] < 1.3 * gyro
    assert 0.5 * accel < found["accel"] < 1.3 * accel


def test_without_an_imu_nothing_is_scaled():
    world = sail(features=50)
    assembled = assemble_problem(replace(measurements(world), imu=None), first_values(world), OPTIONS)
    assert with_imu_noise(assembled.problem, (3.0, 3.0)) is assembled.problem
