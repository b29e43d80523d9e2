"""Heights on calm water: held while nothing tells, and never marked open where only their sum is."""

from dataclasses import replace

import numpy as np
import pytest

from calibration_worlds import first_values, measurements, sail
from rigwake.ba.rig.assemble_problem import assemble_problem
from rigwake.ba.rig.height_prior import restore_priors, with_height_prior
from rigwake.ba.rig.outlier_rounds import adjust
from rigwake.ba.rig.rig_values import AdjustmentOptions, AssembledProblem
from rigwake.ba.rig.rig_verdicts import ReferenceFrame, calibrated_cameras
from rigwake.ba.solver.covariance import covariance_of
from rigwake.ba.solver.rig_problem import CameraBaseline, PosePrior
from rigwake.geometry.se3 import SE3
from rigwake.readers.truth_files import rig_in_frame
from rigwake.simulation.tracks_only import SimulatedTracks

OPTIONS = AdjustmentOptions(state_rate_hz=3.0, tracks_per_second=8)


def assembled(world: SimulatedTracks) -> AssembledProblem:
    return assemble_problem(measurements(world), first_values(world), OPTIONS)


@pytest.fixture(scope="module")
def calm() -> SimulatedTracks:
    return sail(features=50, sea={"hs_m": 0.0})


@pytest.mark.slow
def test_heights_that_nothing_tells_are_held_near_one(calm: SimulatedTracks) -> None:
    adjusted = adjust(assembled(calm), OPTIONS)
    level = with_height_prior(adjusted.solution.problem)
    held = adjust(AssembledProblem(level, adjusted.track_cameras, adjusted.track_ids), OPTIONS)
    heights = [camera.rig_from_cam.translation[2] for camera in held.solution.problem.cameras]
    assert np.abs(heights).max() < 0.5
    assert abs(heights[0] - heights[1]) < 0.3
    freed = restore_priors(held.solution.problem, adjusted.solution.problem)
    assert all(camera.rig_from_cam_prior is None for camera in freed.cameras)


def test_heights_that_waves_tell_are_left_alone() -> None:
    adjusted = adjust(assembled(sail(features=50)), OPTIONS)
    assert with_height_prior(adjusted.solution.problem) is adjusted.solution.problem


def test_a_tape_measure_knows_better(calm: SimulatedTracks) -> None:
    problem = assembled(calm).problem
    high = SE3(np.eye(3), np.array([0.0, 0.0, 3.0]))
    tape = PosePrior.in_axes_of_a(high, [np.inf] * 5 + [0.02])
    known = replace(problem, cameras=tuple(replace(c, rig_from_cam_prior=tape) for c in problem.cameras))
    assert [c.rig_from_cam_prior for c in with_height_prior(known).cameras] == [tape, tape]


def test_rounding_does_not_open_what_cancels(calm: SimulatedTracks) -> None:
    adjusted = adjust(assembled(calm), OPTIONS)
    found = covariance_of(adjusted.solution.problem)
    names = [camera.name for camera in adjusted.solution.problem.cameras]
    # one open direction, shared by both cameras up to rounding; all else well known
    shared = sum(
        camera.rig_from_cam.rotation[2] @ found.rows_of(camera.name, "rig_from_cam")[3:]
        for camera in adjusted.solution.problem.cameras
    )
    shared = shared + 1e-9 * np.random.default_rng(0).normal(size=len(shared))
    basis, _ = np.linalg.qr(np.column_stack([shared, np.eye(len(shared))[:, 1:]]))
    fractions = np.where(np.arange(len(shared)) == 0, 0.0, 1e4)
    known = replace(found, scale=np.ones(len(shared)), directions=basis, fractions=fractions, excess=None)
    seen = calibrated_cameras(adjusted.solution, known, ReferenceFrame(names[0], None), {}, {})
    assert seen.cameras[names[1]].is_observable


@pytest.mark.slow
def test_a_height_common_to_all_cameras_is_known_between_them(calm: SimulatedTracks) -> None:
    whole = assembled(calm)
    truth = rig_in_frame(calm.recording.true_rig, "imu")
    front, left = (truth.cameras[name].rig_from_cam for name in ("front", "left"))
    known = CameraBaseline(0, 1, PosePrior.in_axes_of_a(front.inverse() * left, [np.inf] * 3 + [0.01] * 3))
    adjusted = adjust(replace(whole, problem=replace(whole.problem, baselines=(known,))), OPTIONS)
    covariance = covariance_of(adjusted.solution.problem)

    def seen_from(frame: ReferenceFrame) -> list[bool]:
        found = calibrated_cameras(adjusted.solution, covariance, frame, {}, {})
        return [bool(camera.is_observable) for camera in found.cameras.values()]

    assert seen_from(ReferenceFrame("imu", SE3.identity())) == [False, False]
    assert seen_from(ReferenceFrame("front", None)) == [True, True]
