"""Intrinsics refined with the rig: priors, what the motion tells, what is held, and how sure all of it is."""

from dataclasses import replace

import numpy as np
import pytest

import ba_rigs
from ba_rigs import FISHEYE, Wanted, free_cameras, true_problem
from calibration_worlds import calibrated, sail
from rigwake._types import Array
from rigwake.ba.rig.intrinsics_refinement import (
    JUDGED,
    IntrinsicsWidth,
    holding,
    intrinsics_prior,
    intrinsics_statistics,
    kept_directions,
    moved_px,
    prior_spreads_of,
    priors_of,
    with_free_intrinsics,
)
from rigwake.ba.solver.covariance import covariance_of
from rigwake.ba.solver.rig_problem import RigProblem
from rigwake.cameras.protocol import CameraModel
from rigwake.cameras.registry import CAMERA_CLASSES
from rigwake.errors import EstimationError
from rigwake.pipeline.rig_stage import _refuse_misfits
from rigwake.simulation.tracks_only import SimulatedTracks

PIXELS = np.stack(np.meshgrid(np.linspace(100, 540, 15), np.linspace(60, 420, 12)), axis=-1).reshape(-1, 2)


@pytest.mark.parametrize("model", sorted(CAMERA_CLASSES))
def test_priors_are_as_wide_as_assumed(model: str) -> None:
    lens = CAMERA_CLASSES[model](CAMERA_CLASSES[model].nominal_values(400.0, 320.0, 240.0), 640, 480)
    prior = intrinsics_prior(lens, PIXELS)
    covariance = np.linalg.inv(prior.information)
    std = dict(zip(lens.param_names, np.sqrt(np.diag(covariance)), strict=True))
    focal = [k for k, name in enumerate(lens.param_names) if name in ("fx", "fy", "mu", "mv")]
    if focal:
        assert std[lens.param_names[focal[0]]] == pytest.approx(0.005 * lens.params[focal[0]], rel=0.03)
        ratio = np.diag(covariance)[focal].sum() - 2 * covariance[focal[0], focal[1]]
        assert np.sqrt(ratio) == pytest.approx(0.001 * lens.params[focal[0]], rel=0.01)
    assert std.get("cx", std.get("u0")) == pytest.approx(3.0)
    for name in lens.fixed_by_default:
        assert std[name] < 1e-3


def test_a_boards_covariance_wins_where_it_knows() -> None:
    known = np.diag([0.1, 0.1, 0.2, 0.2, 1e-4, 1e-4, np.nan, np.nan]) ** 2
    std = np.sqrt(np.diag(np.linalg.inv(intrinsics_prior(FISHEYE, PIXELS, covariance=known).information)))
    np.testing.assert_allclose(std[:4], [0.1, 0.1, 0.2, 0.2], rtol=0.02)
    wide = np.sqrt(np.diag(np.linalg.inv(intrinsics_prior(FISHEYE, PIXELS).information)))
    np.testing.assert_allclose(std[6:], wide[6:], rtol=1e-6)


def small_rig(seconds: float) -> RigProblem:
    wanted = Wanted(cameras=2, seconds=seconds, state_hz=4.0, landmarks=60)
    return with_free_intrinsics(free_cameras(true_problem(wanted), "rig_from_cam"), {})


def test_a_long_way_round_tells_the_lens_and_a_moment_does_not() -> None:
    known_fraction = {}
    for seconds in (0.5, 12.0):
        problem = small_rig(seconds)
        kept = kept_directions(problem, covariance_of(problem), priors_of(problem))
        known_fraction[seconds] = [8 - one.untold.shape[1] for one in kept.values()]
        # the lens is right: nothing contradicts it
        assert all(one.untold.shape[1] + one.agreeing.shape[1] == 8 for one in kept.values())
    assert max(known_fraction[0.5]) < min(known_fraction[12.0]), known_fraction


class StraightAhead(ba_rigs.Path):
    """A boat that holds its course on still water."""

    def euler(self, t: Array) -> tuple[Array, Array, Array]:
        return 0 * t, 0 * t, 0 * t

    def position(self, t: Array) -> Array:
        return np.stack([1.5 * t, 0 * t, 0 * t], -1)


def test_straight_legs_in_a_narrow_field_leave_the_lens_and_name_the_turn(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(ba_rigs, "Path", StraightAhead)
    problem = free_cameras(true_problem(Wanted(cameras=1, seconds=8, state_hz=4.0)), "rig_from_cam")
    middle = np.linalg.norm(problem.observations.pixels - (320, 240), axis=1) < 120
    problem = replace(problem, observations=problem.observations.take(np.flatnonzero(middle)))
    problem = with_free_intrinsics(problem, {})
    believed, covariance = priors_of(problem), covariance_of(problem)
    name, lens = problem.cameras[0].name, problem.cameras[0].model
    kept = kept_directions(problem, covariance, believed)[name]
    assert kept.untold.shape[1] == 8
    # whatever the lens was moved by, it is put back
    off = replace(problem.cameras[0], model=lens.with_params(lens.params * 1.01))
    held = holding(replace(problem, cameras=(off,)), {name: kept.untold}, JUDGED)
    np.testing.assert_allclose(held.cameras[0].model.params, lens.params, rtol=1e-6)
    told = intrinsics_statistics(problem, covariance, {}, believed)[name]
    assert set(told["not_determined"]) == set(lens.param_names)
    assert "a turn of 60 degrees or more to both sides" in told["remedy"]
    assert np.isfinite(told["covariance"]).all()
    assert all(
        0.3 * told["prior_std"][p] < std <= 1.01 * told["prior_std"][p] for p, std in told["std"].items()
    )


def test_what_is_held_stays_and_counts_with_its_prior() -> None:
    problem = small_rig(1.5)
    believed = priors_of(problem)
    rng = np.random.default_rng(0)
    moved = tuple(
        replace(c, model=c.model.with_params(c.model.params + np.array([1, 1, 2, 2, 1e-3, 0, 0, 0])))
        for c in problem.cameras
    )
    every = {name: np.linalg.qr(rng.normal(size=(8, 8)))[0] for name in believed}
    held = holding(replace(problem, cameras=moved), every, JUDGED)
    for camera in held.cameras:
        np.testing.assert_allclose(camera.model.params, believed[camera.name].mean, atol=1e-9)
    covariance = covariance_of(held, prior_spreads=prior_spreads_of(held, believed))
    blind = covariance_of(held)
    for name, prior in believed.items():
        spread, _ = covariance.parameter(name, "intrinsics")
        scale = np.sqrt(np.diag(np.linalg.inv(prior.information)))
        np.testing.assert_allclose(
            spread / np.outer(scale, scale),
            np.linalg.inv(prior.information) / np.outer(scale, scale),
            atol=0.1,
        )
        assert np.trace(blind.parameter(name, "intrinsics")[0]) < 1e-3 * np.trace(spread)
        wider = covariance.parameter(name, "rig_from_cam")[0] - blind.parameter(name, "rig_from_cam")[0]
        assert np.linalg.eigvalsh(wider)[0] > -1e-12
        assert np.trace(wider) > 0


def test_what_is_held_counts_as_the_dense_algebra_says() -> None:
    problem = small_rig(3.0)
    believed = priors_of(problem)
    name = problem.cameras[0].name
    held = holding(problem, {name: np.linalg.qr(np.random.default_rng(1).normal(size=(8, 2)))[0]}, JUDGED)
    prior_spreads = prior_spreads_of(held, believed)
    np.testing.assert_allclose(prior_spreads[problem.cameras[1].name, "intrinsics"], 0.0, atol=1e-6)
    covariance, plain = covariance_of(held, prior_spreads=prior_spreads), covariance_of(held)
    rows = np.eye(len(plain.information))
    inverse, _ = plain.of(rows)
    reach = inverse @ plain.rows_of(name, "intrinsics").T
    expected = inverse + reach @ prior_spreads[name, "intrinsics"] @ reach.T
    found, _ = covariance.of(rows)
    scale = np.sqrt(np.diag(expected))
    np.testing.assert_allclose(found / np.outer(scale, scale), expected / np.outer(scale, scale), atol=1e-3)


def test_what_is_ignored_counts_as_an_error() -> None:
    problem = small_rig(8.0)
    sharp = replace(problem.observations, std_px=problem.observations.std_px / 1000)
    problem = replace(problem, observations=sharp)
    shift = np.array([0, 0, 0.03, -0.02, 0, 0, 0, 0])
    believed = {n: replace(p, mean=p.mean + shift) for n, p in priors_of(problem).items()}
    covariance = covariance_of(problem)
    kept = kept_directions(problem, covariance, believed)
    name = problem.cameras[0].name
    assert kept[name].untold.shape[1] + kept[name].agreeing.shape[1] == 8  # too little to follow
    ignored = {name: kept[name].ignored}
    wider = covariance_of(problem, prior_spreads=prior_spreads_of(problem, priors_of(problem), ignored))
    more = wider.parameter(name, "intrinsics")[0] - covariance.parameter(name, "intrinsics")[0]
    assert np.sqrt(more[2, 2]) == pytest.approx(0.03, rel=0.1)
    assert np.sqrt(more[3, 3]) == pytest.approx(0.02, rel=0.1)
    assert np.linalg.matrix_rank(more, tol=1e-3 * np.trace(more)) == 1


def test_a_narrow_prior_is_narrow() -> None:
    wide, narrow = (intrinsics_prior(FISHEYE, PIXELS, IntrinsicsWidth(f, c, d)).information for f, c, d in
                    ((0.01, 5.0, 0.02), (0.001, 0.5, 0.002)))  # fmt: skip
    assert np.all(np.diag(narrow) >= np.diag(wide))


def with_lenses(world: SimulatedTracks, scale: float, shift_px: float) -> SimulatedTracks:
    """The same tracks with focal lengths and centres described wrongly."""

    def wrong(model: CameraModel) -> CameraModel:
        params = model.params
        params[:2] *= scale
        params[2:4] += shift_px / np.sqrt(2)
        return type(model)(tuple(params), model.width_px, model.height_px, None)

    cameras = {n: replace(c, model=wrong(c.model)) for n, c in world.recording.cameras.items()}
    tracks = {
        n: replace(t, bearings_cam=cameras[n].model.unproject(t.pixels)[0]) for n, t in world.tracks.items()
    }
    return replace(world, recording=replace(world.recording, cameras=cameras), tracks=tracks)


@pytest.mark.slow
@pytest.mark.parametrize(("scale", "shift_px"), [(1.03, 0.0), (1.0, 8.0)])
def test_wrong_lenses_are_found_with_the_rig(scale: float, shift_px: float) -> None:
    world = sail()
    found = calibrated(with_lenses(world, scale, shift_px), "intrinsics=refine")
    for name, error in found.errors.cameras.items():
        true, lens = world.recording.cameras[name].model, found.calibration.cameras[name].model
        moved = np.linalg.norm(moved_px(true, lens, world.tracks[name].pixels), axis=1)
        assert np.sqrt(np.nanmean(moved**2)) < 0.5
        assert error.rotation_error_deg < 0.15
        assert error.nees is not None
        assert error.nees < 5 * error.nees_dof


def test_residuals_of_many_pixels_are_refused() -> None:
    fine = {"front": {"rms_px": 0.4, "noise_factor": 9.0}, "port": {"rms_px": 5.0, "noise_factor": 2.0}}
    _refuse_misfits(fine)
    with pytest.raises(EstimationError, match="residuals of 5"):
        _refuse_misfits({**fine, "stern": {"rms_px": 5.1, "noise_factor": 14.7}})
