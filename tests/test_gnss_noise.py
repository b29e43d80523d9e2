"""A receiver's white noise, lasting errors and delay: learnt within bounds, and never worse than no receiver."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from calibration_worlds import first_values, measurements, sail
from rigwake.ba.rig.assemble_problem import assemble_problem
from rigwake.ba.rig.gnss_noise import (
    _between_nodes,
    _correlation_s,
    _lasting,
    white_noise,
    with_learnt_receiver_errors,
    with_receiver_errors,
)
from rigwake.ba.rig.outlier_rounds import adjust
from rigwake.ba.rig.rig_values import AdjustmentOptions, RigMeasurements
from rigwake.ba.rig.rig_verdicts import ReferenceFrame, calibrated_cameras
from rigwake.ba.solver.covariance import covariance_of
from rigwake.ba.solver.rig_problem import LastingErrors, RigProblem
from rigwake.geometry.se3 import SE3
from rigwake.readers.truth_files import rig_in_frame
from rigwake.recording import GnssStream
from rigwake.simulation.sensors import gauss_markov
from rigwake.simulation.tracks_only import SimulatedTracks

OPTIONS = AdjustmentOptions(tracks_per_second=20)
STAMPS = np.arange(3000) * 200_000_000


@cache
def world() -> SimulatedTracks:
    return sail(features=40)


def lasting(gnss: GnssStream, seed: int, stated_m: float = 1.03) -> GnssStream:
    """The fixes with an error of 1 m that lasts 40 s, and 25 cm of white noise."""
    rng, n = np.random.default_rng(seed), len(gnss.timestamps_ns)
    error = gauss_markov(rng, n, 0.2, 1.0, 40.0) + rng.normal(0, 0.25, (n, 3))
    covariances = np.tile(np.eye(3) * stated_m**2, (n, 1, 1))
    return replace(gnss, position_enu=gnss.position_enu + error, covariances=covariances)


def problem_with(gnss: GnssStream) -> RigProblem:
    given = replace(measurements(world()), gnss=gnss)
    return assemble_problem(given, first_values(world(), seed=1), OPTIONS).problem


def test_white_noise_is_told_from_motion() -> None:
    rng = np.random.default_rng(0)
    stamps = np.arange(400) * 200_000_000
    t = stamps[:, None] * 1e-9
    moving = np.concatenate([3 * t, 10 * np.sin(t / 5), 0.2 * np.sin(2 * t)], axis=1)
    found = white_noise(stamps, moving + rng.normal(0, 0.1, moving.shape))
    np.testing.assert_allclose(found, 0.1, rtol=0.25)


def test_a_precise_receiver_has_no_lasting_errors_and_a_coarse_one_has() -> None:
    gnss = world().recording.gnss["gnss"]
    assert problem_with(gnss).antenna.errors is None
    errors = problem_with(lasting(gnss, 0)).antenna.errors
    assert errors is not None
    assert np.all((errors.std > 0.8) & (errors.std < 1.1))
    assert len(errors.timestamps_ns) <= 48


def test_what_residuals_show_is_believed_over_what_is_stated_within_bounds() -> None:
    gnss = world().recording.gnss["gnss"]
    problem = problem_with(gnss)
    body = world().recording.true_trajectories["rig"]
    assert body.duration_s > 20
    coarse = replace(problem, gnss=replace(lasting(gnss, 0), covariances=gnss.covariances))
    learnt = with_learnt_receiver_errors(coarse)
    assert learnt.antenna.errors is not None
    assert learnt.antenna.errors.std.max() > 0.3
    assert 10.0 <= learnt.antenna.errors.correlation_s <= 300.0
    again = with_receiver_errors(replace(problem, imu=None, states=replace(problem.states, inertial=None)))
    assert again.antenna.errors is None


def test_white_noise_beyond_what_is_stated_is_believed() -> None:
    gnss = world().recording.gnss["gnss"]
    noise = np.random.default_rng(0).normal(0, 0.25, gnss.position_enu.shape)
    stated = np.tile(np.eye(3) * 0.02**2, (len(noise), 1, 1))
    optimistic = replace(gnss, position_enu=gnss.position_enu + noise, covariances=stated)
    learnt = with_learnt_receiver_errors(problem_with(optimistic)).gnss
    assert learnt is not None
    assert np.sqrt(learnt.covariances[:, [0, 1], [0, 1]]).min() > 0.2


def test_the_correlation_time_is_that_of_the_errors() -> None:
    rng = np.random.default_rng(0)
    off = gauss_markov(rng, len(STAMPS), 0.2, 1.0, 40.0) + rng.normal(0, 0.05, (len(STAMPS), 3))
    found = _correlation_s(STAMPS, off, np.full(3, 0.05), np.ones(3), 20.0)
    assert 30.0 < found < 55.0
    apart = np.array([k for k in range(len(STAMPS)) if k // 100 % 4 == 0])  # 20 s of every 80
    assert 25.0 < _correlation_s(STAMPS[apart], off[apart], np.full(3, 0.05), np.ones(3), 20.0) < 65.0
    assert _correlation_s(STAMPS, off, np.full(3, 2.0), np.ones(3), 20.0) == 20.0  # all of it is white


def test_a_precise_receiver_learns_no_lasting_errors() -> None:
    white = np.random.default_rng(0).normal(0, 0.1, (len(STAMPS), 3))
    assert _lasting(STAMPS, white, np.full(3, 0.1)).max() < 0.01


def test_what_nodes_cannot_follow_is_shared_by_the_fixes_between() -> None:
    nodes, step = STAMPS[::25], 25
    process = gauss_markov(np.random.default_rng(0), len(STAMPS), 0.2, 1.0, 40.0)
    line = np.stack([np.interp(STAMPS, nodes, process[::step, k]) for k in range(3)], axis=1)
    missed = np.mean((process - line)[: nodes.size * step - step] ** 2)
    counted = _between_nodes(LastingErrors(nodes, process[::step], np.ones(3), 40.0), STAMPS)
    np.testing.assert_allclose(counted**2, missed / 2 * step, rtol=0.2)  # the best line misses half of it


def adjusted_error(world: SimulatedTracks, given: RigMeasurements) -> tuple[float, float, float]:
    """Largest position error (m), squared error over its expectation, receiver's delay (s)."""
    adjusted = adjust(assemble_problem(given, first_values(world, seed=1), OPTIONS), OPTIONS)
    problem = adjusted.solution.problem
    covariance = covariance_of(problem, clustered=True)
    found = calibrated_cameras(adjusted.solution, covariance, ReferenceFrame("imu", SE3.identity()), {}, {})
    truth = rig_in_frame(world.recording.true_rig, "imu")
    errors = [truth.cameras[n].rig_from_cam.local(c.rig_from_cam) for n, c in found.cameras.items()]
    joint = np.concatenate(errors)
    assert found.joint_covariance is not None
    nees = float(joint @ np.linalg.solve(found.joint_covariance, joint)) / len(joint)
    return max(float(np.linalg.norm(e[3:])) for e in errors), nees, problem.antenna.time_offset_s


@pytest.mark.slow
def test_a_metre_that_lasts_is_not_worse_than_no_receiver_and_a_delay_is_found() -> None:
    ratios, honest = [], []
    for seed in range(5):
        world = sail(features=60, seed=seed, scene={"seed": 4})
        given = measurements(world)
        without, _, _ = adjusted_error(world, replace(given, gnss=None))
        with_it, nees, _ = adjusted_error(world, replace(given, gnss=lasting(given.gnss, seed)))
        ratios.append(with_it / without)
        honest.append(nees)
    print(np.round(ratios, 2), np.round(honest, 2))
    assert np.median(ratios) < 1.1
    assert max(ratios) < 1.5
    assert np.mean(honest) < 2.0
    late = replace(given.gnss, timestamps_ns=given.gnss.timestamps_ns + 60_000_000)
    assert adjusted_error(world, replace(given, gnss=late))[2] == pytest.approx(-0.06, abs=0.025)
