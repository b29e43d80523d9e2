"""Whether the assumed uncertainty is honest, and whether the start matters: Monte Carlo on simulated tracks."""

import numpy as np
import pytest
from scipy.stats import chi2

from calibration_worlds import first_values, measurements, sail
from rigwake.ba.rig.assemble_problem import assemble_problem
from rigwake.ba.rig.outlier_rounds import adjust
from rigwake.ba.rig.rig_values import AdjustmentOptions
from rigwake.ba.rig.rig_verdicts import ReferenceFrame, calibrated_cameras
from rigwake.ba.solver.covariance import covariance_of
from rigwake.calibration import Calibration
from rigwake.geometry.se3 import SE3
from rigwake.readers.truth_files import rig_in_frame
from rigwake.simulation.tracks_only import SimulatedTracks

OPTIONS = AdjustmentOptions(tracks_per_second=10)
SEEDS = 24


def calibration_from(world: SimulatedTracks, turn_deg: float, shift_m: float) -> Calibration:
    start = first_values(world, seed=1, turn_deg=turn_deg, shift_m=shift_m)
    adjusted = adjust(assemble_problem(measurements(world), start, OPTIONS), OPTIONS)
    covariance = covariance_of(adjusted.solution.problem, clustered=True)
    return calibrated_cameras(adjusted.solution, covariance, ReferenceFrame("imu", SE3.identity()), {}, {})


def nees_of(calibration: Calibration, world: SimulatedTracks) -> float:
    truth = rig_in_frame(world.recording.true_rig, "imu")
    error = np.concatenate(
        [truth.cameras[n].rig_from_cam.local(c.rig_from_cam) for n, c in calibration.cameras.items()]
    )
    assert calibration.joint_covariance is not None
    return float(error @ np.linalg.solve(calibration.joint_covariance, error))


@pytest.mark.slow
def test_the_sigmas_are_honest() -> None:
    found = []
    for seed in range(SEEDS):
        world = sail(features=60, seed=seed, scene={"seed": 4})
        found.append(nees_of(calibration_from(world, 1.0, 0.05), world))
    print("mean NEES of 12:", np.mean(found), np.round(found, 1))
    low, high = chi2.ppf([0.025, 0.975], 12 * SEEDS) / SEEDS
    assert low < np.mean(found) < high


@pytest.mark.slow
def test_a_start_off_by_20_degrees_and_half_a_metre_ends_in_the_same_rig() -> None:
    world = sail(features=80)
    near = calibration_from(world, 0.5, 0.02)
    far = calibration_from(world, 20.0 / np.sqrt(3), 0.5 / np.sqrt(3))
    for name, camera in near.cameras.items():
        whitened = np.linalg.solve(
            np.linalg.cholesky(camera.covariance), camera.rig_from_cam.local(far.cameras[name].rig_from_cam)
        )
        assert np.abs(whitened).max() < 0.5
