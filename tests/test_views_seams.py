"""Seams, blame, colours, height above the water and the horizon, in a world that is known exactly."""

import numpy as np
import pytest

from rigwake._types import Image
from rigwake.errors import EstimationError
from rigwake.views import height as height_module
from rigwake.views.attitude import LevelAttitude
from rigwake.views.colour import (
    ColourModel,
    ColourSamples,
    GainSmoother,
    colour_samples,
    fit_colour,
    half_field,
)
from rigwake.views.frames import FrameSet, place
from rigwake.views.height import edges_below_things, estimate_height, height_from_contacts
from rigwake.views.horizon import horizon_attitude
from rigwake.views.ripples import height_of_ripples
from rigwake.views.seam_blame import blame_cameras
from rigwake.views.seam_report import seams_of
from rigwake.views.seams import SeamMatches, SeamMeter, overlapping_pairs
from rigwake.views.surface import Surface, WaterAndShell, WaterAndStixels
from rigwake.views.surround_rig import SurroundRig
from view_scenes import HEIGHT_M, attitude, four_cameras, photograph, water_and_ring

RIG = four_cameras()
STAND = attitude(3.0, -2.0)


def ring(radius_m: float) -> WaterAndStixels:
    return WaterAndStixels(np.full((360, 1), radius_m), np.full((360, 1), 4.0))


class Worlds(dict):  # type: ignore[type-arg]
    """Photographs by the ring's radius, taken when first asked for."""

    def __missing__(self, radius_m: float) -> dict[str, Image]:
        self[radius_m] = photograph(RIG, STAND, water_and_ring(radius_m, is_mottled=True))
        return self[radius_m]


@pytest.fixture(scope="module")
def worlds() -> Worlds:
    return Worlds()


def frame_set(images: dict[str, Image]) -> FrameSet:
    stack = np.zeros((4, 480, 640, 3), dtype=np.uint8)
    for index, name in enumerate(RIG.names):
        place(stack[index], images[name])
    return FrameSet(0, RIG.names, stack, {}, np.zeros(4))


def matches(images: dict[str, Image], rig: SurroundRig, surface: Surface) -> list[SeamMatches]:
    return SeamMeter(rig).measure(frame_set(images), STAND, surface)


def test_four_seams_lie_between_neighbours() -> None:
    pairs = overlapping_pairs(RIG, STAND)
    assert [(a, b) for a, b, _, _ in pairs] == [(0, 1), (0, 3), (1, 2), (2, 3)]
    assert np.allclose(np.abs(np.rad2deg([p[2] for p in pairs])), [45, 45, 135, 135], atol=3)


@pytest.mark.parametrize("radius_m", [30.0, pytest.param(10.0, marks=pytest.mark.slow)])
def test_true_calibration_and_range_leave_no_misalignment(worlds, radius_m: float) -> None:
    found = seams_of(RIG.names, matches(worlds[radius_m], RIG, ring(radius_m)))
    far = seams_of(RIG.names, matches(worlds[radius_m], RIG, WaterAndShell(60.0)))
    for seam, fixed in zip(found, far, strict=True):
        assert seam.matches > 20
        assert seam.median_px < 0.7
        assert seam.range_m == pytest.approx(radius_m, rel=0.08)
        parallax = np.hypot(1.0, 0.95) * abs(1 / radius_m - 1 / 60) * 326
        assert fixed.median_px == pytest.approx(parallax, rel=0.35)


@pytest.mark.parametrize(
    ("name", "axis"),
    [
        ("left", 2),
        *(pytest.param(*p, marks=pytest.mark.slow) for p in (("back", 0), ("right", 2), ("front", 0))),
    ],
)
def test_turned_camera_is_blamed(worlds, name: str, axis: int) -> None:
    """One degree, which is 5.7 px; the surface is a shell that does not fit exactly."""
    turn = tuple(1.0 if k == axis else 0.0 for k in range(3))
    rig = four_cameras({name: turn})
    surface = WaterAndShell(25.0)
    blames = blame_cameras(rig, STAND, surface, matches(worlds[30.0], rig, surface))
    assert [b.name for b in blames if b.is_to_blame] == [name]
    assert {b.name: b.size_deg for b in blames}[name] == pytest.approx(1.0, abs=0.35)


@pytest.mark.slow
def test_nobody_is_blamed_without_a_fault(worlds) -> None:
    for surface in (ring(30.0), WaterAndShell(25.0)):
        blames = blame_cameras(RIG, STAND, surface, matches(worlds[30.0], RIG, surface))
        assert not any(b.is_to_blame for b in blames)
        assert max(b.size_deg for b in blames) < 0.3
    assert blame_cameras(RIG, STAND, WaterAndShell(), []) == []


def exposed(images: dict[str, Image], gains: np.ndarray, vignetting: np.ndarray) -> dict[str, Image]:
    """What cameras of other exposure behind vignetting lenses would have recorded."""
    model = ColourModel(np.zeros((4, 3)), vignetting)
    result = {}
    for index, (name, image) in enumerate(images.items()):
        u, v = np.meshgrid(np.arange(640.0), np.arange(480.0))
        bearings, valid = RIG.models[index].unproject(np.stack([u.ravel(), v.ravel()], axis=1))
        angle = np.arccos(np.clip(np.where(valid, bearings[:, 2], 0), -1, 1)).reshape(480, 640)
        light = 0.72 * image * gains[index] / model.shading(angle / half_field(RIG, index))[..., None]
        result[name] = np.clip(np.round(light), 0, 255).astype(np.uint8)
    return result


@pytest.mark.slow
def test_gains_and_vignetting_are_found_and_undone(worlds) -> None:
    """Fitted on one scene, judged on another."""
    rng = np.random.default_rng(4)
    gains = rng.uniform(0.7, 1.3, (4, 3))
    gains /= np.exp(np.log(gains).mean(axis=0))
    vignetting = np.array([0.1, -0.5, 0.1])
    used = exposed(worlds[10.0], gains, vignetting)
    model = fit_colour(colour_samples(used, RIG, STAND), 4)
    assert np.abs(np.log(model.gains * gains)).max() < 0.04
    held_out = exposed(worlds[30.0], gains, vignetting)
    surface = ring(30.0)
    found = SeamMeter(RIG, model).measure(frame_set(held_out), STAND, surface)
    raw, left = [m.difference_raw for m in found], [m.difference for m in found]
    assert np.mean(left) <= 1.0
    assert np.mean(raw) / np.mean(left) >= 15


@pytest.mark.slow
def test_gains_follow_an_exposure_slowly(worlds) -> None:
    start = ColourModel(np.zeros((4, 3)), np.zeros(3), 1)
    smoother = GainSmoother(start, time_constant_s=1.0)
    gains = np.ones((4, 3))
    gains[1] = 0.8
    dark = exposed(worlds[30.0], gains, np.zeros(3))
    smoother.update(dark, RIG, STAND, 0)
    first = smoother.model.gains[1] / smoother.model.gains[3]
    for k in range(1, 15):
        smoother.update(dark, RIG, STAND, k * 4 * 10**8)
    last = smoother.model.gains[1] / smoother.model.gains[3]
    assert np.all(first < 1.2)
    assert np.allclose(last, 1.25, atol=0.04)
    alone = GainSmoother(start)
    assert alone.update({"front": dark["front"]}, RIG, STAND, 0) is start
    with pytest.raises(ValueError, match=r".+"):
        ColourSamples.joined([])


@pytest.fixture(scope="module")
def striped() -> dict[str, Image]:
    return photograph(RIG, STAND, water_and_ring(14.0))


@pytest.mark.slow
def test_height_above_the_water_within_two_percent(striped) -> None:
    distances, depressions = edges_below_things(striped, RIG, STAND)
    found = height_from_contacts(distances, depressions)
    assert found.height_m == pytest.approx(HEIGHT_M, rel=0.02)
    assert found.contacts > 200


def test_height_needs_contacts_that_agree() -> None:
    rng = np.random.default_rng(7)
    distance = rng.uniform(5, 30, 400)
    true = np.arctan2(2.1, distance) * rng.normal(1, 0.01, 400)
    wrong = rng.uniform(0.03, 0.4, 400)
    mixed = np.where(rng.random(400) < 0.6, true, wrong)
    assert height_from_contacts(distance, mixed).height_m == pytest.approx(2.1, rel=0.02)
    with pytest.raises(EstimationError, match="Only 20"):
        height_from_contacts(distance[:20], true[:20])
    with pytest.raises(EstimationError, match="do not agree"):
        height_from_contacts(distance, rng.uniform(0.02, 1.2, 400))


@pytest.mark.slow
def test_horizon_levels_an_unknown_attitude() -> None:
    """Open water: the quay is too far away to be seen."""
    guess = attitude(0.0, 0.0)
    found = horizon_attitude(photograph(RIG, STAND, water_and_ring(3000.0)), RIG, guess)
    assert found is not None
    assert found.source == "horizon"
    assert np.allclose(found.roll_pitch, STAND.roll_pitch, atol=np.deg2rad(0.4))
    flat = {name: np.full((480, 640, 3), 90, np.uint8) for name in RIG.names}
    assert horizon_attitude(flat, RIG, guess) is None


def test_the_height_on_which_ripples_agree() -> None:
    rng = np.random.default_rng(4)
    surface, mirrored = 2.1 + rng.normal(0, 0.1, 5000), rng.uniform(0.4, 12.0, 5000)
    height, points = height_of_ripples([surface, mirrored])
    assert height == pytest.approx(2.1, rel=0.02)
    assert 3500 < points < 6500
    heaving = [2.1 * rise + rng.normal(0, 0.04, count) for rise, count in ((0.96, 5000), (1.04, 2500))]
    assert height_of_ripples(heaving)[0] == pytest.approx(2.1, rel=0.01)
    with pytest.raises(EstimationError, match="one height"):
        height_of_ripples([surface, 1.6 * surface[:4000]])
    with pytest.raises(EstimationError, match="too little"):
        height_of_ripples([surface[:800]])


class Level:
    """A leveller that knows the attitude."""

    def at(self, timestamp_ns: int, images: object = None) -> LevelAttitude:
        return STAND


def test_why_the_ripples_tell_no_height_is_said(monkeypatch: pytest.MonkeyPatch) -> None:
    distance = np.linspace(5, 20, 200)
    contacts = distance, np.arctan2(HEIGHT_M, distance)
    monkeypatch.setattr(height_module, "ripple_heights", lambda *_: np.full(10, HEIGHT_M))
    monkeypatch.setattr(height_module, "edges_below_things", lambda *_: contacts)
    frames = frame_set({name: np.zeros((480, 640, 3), np.uint8) for name in RIG.names})
    found = estimate_height(RIG, [frames], Level())  # type: ignore[arg-type]
    assert not found.by_ripples
    assert found.height_m == pytest.approx(HEIGHT_M, rel=0.01)
    assert "too little of the water" in found.why_not_ripples
    monkeypatch.setattr(height_module, "edges_below_things", lambda *_: (distance[:3], contacts[1][:3]))
    with pytest.raises(EstimationError, match=r"too little of the water.*Only 3 level edges"):
        estimate_height(RIG, [frames], Level())  # type: ignore[arg-type]
