"""Lenses that are wrong: moved to where tracks and gyroscope want them, refined with the rig, or refused."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from ba_rigs import Wanted, free_cameras, true_problem
from calibration_worlds import own_odometry, sail
from camera_lenses import LENSES, rays_within, reach_of
from rigwake.ba.rig.intrinsics_refinement import moved_px, priors_of, with_free_intrinsics
from rigwake.ba.rig.rig_values import AdjustedRig
from rigwake.ba.rig.uncontradicted_lenses import hold_uncontradicted, judge_lenses
from rigwake.ba.solver.levenberg_marquardt import solve
from rigwake.ba.solver.rig_problem import RigProblem
from rigwake.cameras.moved_lens import moved_lens
from rigwake.config import load_config
from rigwake.errors import InputError
from rigwake.pipeline.lens_mending import mend_lenses
from rigwake.pipeline.prior import RigPrior
from rigwake.pipeline.stream_selection import select
from rigwake.pipeline.vetted_rig import VettedRig, estimate_vetted_rig
from rigwake.simulation.tracks_only import SimulatedTracks


@pytest.mark.parametrize("name", sorted(LENSES))
def test_a_lens_is_enlarged_about_its_centre_and_moved(name: str) -> None:
    lens, shift = LENSES[name], np.array([4.0, -7.0])
    rays = rays_within(0.9 * reach_of(lens), 200)
    before, seen = lens.project(rays)
    after, still = moved_lens(lens, 1.03, shift).project(rays)
    both = seen & still
    assert both.sum() > 0.9 * seen.sum()
    centre = lens.project(np.array([[0.0, 0.0, 1.0]]))[0]
    np.testing.assert_allclose(after[both], (centre + 1.03 * (before - centre) + shift)[both], atol=1e-6)


def small_rig() -> RigProblem:
    wanted = Wanted(cameras=2, seconds=8.0, state_hz=4.0, landmarks=60)
    return with_free_intrinsics(free_cameras(true_problem(wanted), "rig_from_cam"), {})


def adjusted(problem: RigProblem) -> AdjustedRig:
    nothing = np.empty(0, np.int64)
    return AdjustedRig(solve(problem), nothing, nothing, {}, {})


def test_lenses_that_nothing_contradicts_are_fixed_while_landmarks_are_associated() -> None:
    problem = small_rig()
    believed = priors_of(problem)
    held = hold_uncontradicted(adjusted(problem), believed)
    for camera in held.solution.problem.cameras:
        assert "intrinsics" not in camera.free
        np.testing.assert_array_equal(camera.model.params, believed[camera.name].mean)
    judged = judge_lenses(held, believed)
    for camera in judged.solution.problem.cameras:
        assert "intrinsics" in camera.free  # for the covariance
        np.testing.assert_array_equal(camera.model.params, believed[camera.name].mean)
    assert judged.solution.residuals_px is held.solution.residuals_px  # no other optimum was looked for


def test_a_wrong_lens_is_followed_and_the_right_one_stays() -> None:
    problem = small_rig()
    first, second = problem.cameras
    wrong = replace(first, model=moved_lens(first.model, 1.003, (2.0, 0.0)))
    off = with_free_intrinsics(replace(problem, cameras=(wrong, second)), {})
    believed = priors_of(off)
    judged = judge_lenses(hold_uncontradicted(adjusted(off), believed), believed)
    pixels = problem.observations.pixels[problem.observations.camera_indices == 0]
    found = judged.solution.problem.cameras
    left = np.linalg.norm(moved_px(first.model, found[0].model, pixels), axis=1)
    given = np.linalg.norm(moved_px(first.model, wrong.model, pixels), axis=1)
    assert np.nanmean(left) < 0.15 * np.nanmean(given)
    np.testing.assert_allclose(found[1].model.params, second.model.params, atol=1e-9)


def with_wrong_lens(world: SimulatedTracks, cameras: tuple[str, ...], scale: float) -> SimulatedTracks:
    streams, tracks = dict(world.recording.cameras), dict(world.tracks)
    for name in cameras:
        lens = moved_lens(streams[name].model, scale, (5.0, -5.0))
        bearings, seen = lens.unproject(tracks[name].pixels)
        streams[name] = replace(streams[name], model=lens)
        tracks[name] = replace(tracks[name], bearings_cam=bearings).take(np.flatnonzero(seen))
    return replace(world, recording=replace(world.recording, cameras=streams), tracks=tracks)


def calibrated(world: SimulatedTracks, *settings: str) -> VettedRig:
    config = load_config(None, ("adjustment.cross_camera=false", *settings))
    selection, motions = select(world.recording, config), own_odometry(world)
    return estimate_vetted_rig(
        world.recording, selection, world.tracks, motions, config, RigPrior(), masks=Path("nowhere")
    )


@pytest.mark.slow
@pytest.mark.parametrize(("cameras", "scale"), [(("front",), 1.03), (("front", "left"), 0.97)])
def test_a_lens_far_off_is_refined_and_said_or_refused_where_it_is_fixed(
    cameras: tuple[str, ...], scale: float
) -> None:
    true = sail()
    world = with_wrong_lens(true, cameras, scale)
    found = calibrated(world)
    mended = {check.sensor for check in found.vetted.checks if check.action == "repaired"}
    assert mended == {f"camera {name}" for name in cameras}
    assert not found.vetted.left_out
    for name, lens in found.rig.lenses.items():
        left = np.linalg.norm(
            moved_px(true.recording.cameras[name].model, lens, true.tracks[name].pixels), axis=1
        )
        assert np.sqrt(np.nanmean(left**2)) < 0.4
    if len(cameras) == 1:
        assert set(calibrated(world, "intrinsics=fixed").vetted.left_out) == {"camera front"}
    else:
        with pytest.raises(InputError, match="does not fit its own tracks"):
            calibrated(world, "intrinsics=fixed")


@pytest.mark.slow
def test_lenses_that_are_right_stay() -> None:
    world = sail()
    config = load_config(None)
    motions = own_odometry(world)
    same = mend_lenses(select(world.recording, config), world.tracks, motions, config.odometry)
    assert not same.moved
    assert not same.checks
    assert all(same.trajectories[name] is motions[name] for name in motions)
