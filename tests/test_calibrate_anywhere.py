"""Rigs of four to six cameras anywhere on the boat, with clocks apart and poor satellites: simulated tracks."""

import numpy as np
import pytest
from scipy.stats import chi2

from calibration_worlds import calibrated, first_values, measurements
from rigwake.ba.rig.assemble_problem import assemble_problem
from rigwake.ba.rig.outlier_rounds import adjust
from rigwake.ba.rig.rig_values import AdjustmentOptions
from rigwake.ba.rig.rig_verdicts import ReferenceFrame, calibrated_cameras
from rigwake.ba.solver.covariance import covariance_of
from rigwake.calibration import Calibration
from rigwake.geometry.se3 import SE3
from rigwake.readers.truth_files import rig_in_frame
from rigwake.rig import Rig
from rigwake.simulation.scenario import build_scenario, load_scenario
from rigwake.simulation.tracks_only import SimulatedTracks, simulate_tracks

SEEDS = 20
FEW = AdjustmentOptions(tracks_per_second=8)
LENSES = (185.0, 190.0, 195.0)


def rig_anywhere(seed: int, features: int) -> SimulatedTracks:
    """A minute of turns both ways on waves: 4 to 6 lenses of 185 to 195 degrees, up to 3 m and more apart, looking
    anywhere, clocks up to 20 ms off, GNSS good to a metre."""
    rng = np.random.default_rng(seed)
    document = load_scenario("demo").model_dump()
    shape = document["cameras"][0]
    cameras = []
    for number in range(int(rng.integers(4, 7))):
        sideways = rng.uniform(-180, 180)
        cameras.append(
            shape
            | {
                "name": f"cam{number}",
                "position_m": rng.uniform([-1.8, -1.2, 1.3], [1.8, 1.2, 2.6]).round(3).tolist(),
                "yaw_deg": sideways,
                "pitch_deg": rng.uniform(-5, 30),
                "roll_deg": rng.uniform(-10, 10),
                "fov_deg": float(rng.choice(LENSES)),
                "time_offset_ms": rng.uniform(-20, 20),
            }
        )
    turns = document["vessel"]["manoeuvres"]
    document |= {
        "seed": seed,
        "scene": document["scene"] | {"seed": 4},
        "duration_s": 56.0,
        "cameras": cameras,
    }
    document["vessel"] |= {"manoeuvres": [*turns, *turns]}
    document["gnss"] |= {"quality": "standalone"}
    document["tracking"] |= {"features": features, "landmarks": 800, "outliers": 0.01, "water": 0.02}
    return simulate_tracks(build_scenario(document, "test"))


def adjusted_from_near(world: SimulatedTracks) -> Calibration:
    """The rig adjusted from a start about a degree and 5 cm off."""
    adjusted = adjust(assemble_problem(measurements(world), first_values(world, seed=1), FEW), FEW)
    covariance = covariance_of(adjusted.solution.problem, clustered=True)
    return calibrated_cameras(adjusted.solution, covariance, ReferenceFrame("imu", SE3.identity()), {}, {})


def nees_of(found: Calibration, truth: Rig) -> tuple[float, int]:
    """Of all cameras together, and its degrees of freedom."""
    error = np.concatenate(
        [truth.cameras[n].rig_from_cam.local(c.rig_from_cam) for n, c in found.cameras.items()]
    )
    assert found.joint_covariance is not None
    return float(error @ np.linalg.solve(found.joint_covariance, error)), len(error)


@pytest.mark.slow
def test_the_sigmas_of_rigs_anywhere_are_honest() -> None:
    total, freedom = 0.0, 0
    for seed in range(SEEDS):
        world = rig_anywhere(seed, features=40)
        nees, n = nees_of(adjusted_from_near(world), rig_in_frame(world.recording.true_rig, "imu"))
        print(seed, "NEES", round(nees, 1), "of", n)
        total, freedom = total + nees, freedom + n
    low, high = chi2.ppf([0.025, 0.975], freedom) / freedom
    print("NEES / freedom", total / freedom, "interval", low, high)
    assert low < total / freedom < high


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 1])
def test_rigs_anywhere_are_found_without_a_first_guess(seed: int) -> None:
    world = rig_anywhere(seed, features=220)
    found = calibrated(world)
    assert not found.failed
    for name, errors in found.errors.cameras.items():
        camera = found.calibration.cameras[name]
        shift = np.abs(errors.translation_error_m)
        print(name, errors.rotation_error_deg, shift, camera.std_translation_m)
        assert errors.rotation_error_deg < 0.1
        assert shift.max() < 0.05
        assert (shift < 3 * camera.std_translation_m).all()
        true_offset = world.recording.true_rig.cameras[name].time_offset_s
        assert camera.time_offset_s == pytest.approx(true_offset, abs=1e-3)
