"""Faults that once passed without a word: each is named by its sensor, and what is right is not accused."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from rigwake.geometry import so3
from rigwake.geometry.se3 import SE3
from rigwake.pipeline import sensor_checks
from rigwake.plausibility import force_fit, turn_checks
from rigwake.plausibility.coarse_turns import vet_turns
from rigwake.plausibility.force_checks import check_forces, compare_forces
from rigwake.plausibility.force_fit import ForceEquations
from rigwake.plausibility.gyro_axes import check_axes
from rigwake.plausibility.imu_samples import vet_samples
from rigwake.plausibility.jitter_checks import check_jitter
from rigwake.plausibility.lens_checks import check_lenses
from rigwake.plausibility.lens_fit import LensFit, fit_lens
from rigwake.plausibility.receiver_checks import VettedReceiver
from rigwake.plausibility.receiver_fit import ReceiverFit
from rigwake.plausibility.receiver_repeats import repeated_rows, with_rounding
from rigwake.plausibility.receiver_wrongs import rows_of_one_level
from rigwake.plausibility.stamp_rates import rate_of_stamps
from rigwake.plausibility.turn_checks import check_mounts, mount_change
from rigwake.recording import GnssStream, ImuStream
from rigwake.tracking.camera_rotations import _from_the_middle
from rigwake.tracking.front_ends import _TrackingRun
from test_plausibility import drifting, fits, gnss, imu, paths, vetted, world, wrong


def forces(change: Callable[[np.ndarray], np.ndarray]) -> str:
    stream = replace(imu(), accel=change(imu().accel.copy()))
    return wrong(check_forces(compare_forces(paths(), stream, fits(imu()))))["accelerometer"]


def with_axis(values: np.ndarray, axis: int, given: np.ndarray | float) -> np.ndarray:
    values = values.copy()
    values[:, axis] = given
    return values


def noise(size: float) -> np.ndarray:
    return np.random.default_rng(0).normal(0, size, len(imu().accel))


@pytest.mark.parametrize("rate", [1.1, 0.5])
def test_stamps_that_claim_a_wrong_rate_are_named_with_the_right_one(rate: float) -> None:
    stream = replace(imu(), timestamps_ns=drifting(imu().timestamps_ns, rate - 1))
    assert rate_of_stamps(stream, paths()["front"]) == pytest.approx(1 / rate, rel=1e-3)
    words = wrong(vet_turns(stream, {"front": paths()["front"]}).checks)["imu"]
    assert f"{rate:.3f} times" in words
    assert "100.0 Hz" in words


def test_a_bias_beyond_any_gyroscope_is_named_and_one_of_a_cheap_one_taken_off() -> None:
    one = {"front": paths()["front"]}
    huge = vet_turns(replace(imu(), gyro=imu().gyro + np.array([0.5, 0.1, -0.5])), one)
    assert "41 deg/s" in wrong(huge.checks)["gyroscope"]
    cheap = vet_turns(replace(imu(), gyro=imu().gyro + np.array([0.15, 0.05, -0.15])), one)
    assert [check.action for check in cheap.checks] == ["repaired"]
    assert np.abs(np.mean(cheap.imu.gyro - imu().gyro, axis=0)).max() < 0.02


@pytest.mark.parametrize(("axis", "gain"), [(0, 0.0), (2, 1.3)])
def test_an_axis_of_the_gyroscope_is_not_the_fault_of_every_camera(axis: int, gain: float) -> None:
    shown = gain * imu().gyro[:, axis] + noise(0.002)
    checks = check_axes(fits(replace(imu(), gyro=with_axis(imu().gyro, axis, shown))))
    assert f"its {'xyz'[axis]} axis shows {gain:.2f}" in wrong(checks)["gyroscope"]
    assert not check_axes(fits(imu()))
    assert not check_axes(fits(imu(calm=True), paths(calm=True)))


def test_a_camera_with_a_wrong_lens_says_nothing_of_the_axes(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[set[str]] = []
    monkeypatch.setattr(sensor_checks, "check_axes", lambda found: asked.append(set(found)) or ())
    monkeypatch.setattr(sensor_checks, "check_lenses", lambda *_: ())
    models = {name: camera.model for name, camera in world().recording.cameras.items()}
    right = LensFit(1.0, np.zeros(2), 1e-8 * np.eye(3), 0.2, 0.2, 30)
    lenses = {"front": replace(right, scale=1.2), "left": right}
    sensor_checks.compare_sensors(imu(), {}, models, paths(), lenses=lenses, repair=True)
    assert asked == [{"left"}]


def test_where_no_camera_keeps_its_mounting_it_is_the_imu() -> None:
    gyro = imu().gyro.copy()
    half = len(gyro) // 2
    gyro[half:] = gyro[half:] @ so3.exp(np.array([0.05, 0.0, 0.1])).T
    assert set(wrong(check_mounts(fits(replace(imu(), gyro=gyro))))) == {"imu"}


def test_dead_axes_are_named_and_those_that_stand_still_for_a_while_bridged() -> None:
    dead = vet_samples(replace(imu(), accel=with_axis(imu().accel, 0, 0.0)))
    assert "axis x never changes" in wrong(dead.checks)["accelerometer"]
    stopped = imu().gyro.copy()
    stopped[800:1200, 1] = stopped[800, 1]
    still = vet_samples(replace(imu(), gyro=stopped))
    assert any("axis y repeats" in c.hypothesis and c.action == "repaired" for c in still.checks)
    coarse = replace(imu(), gyro=np.round(imu().gyro, 2), accel=np.round(imu().accel, 1))
    assert not any("repeats" in c.hypothesis for c in vet_samples(coarse).checks)


def test_stamps_in_bunches_are_no_gaps_to_bridge() -> None:
    t = imu().timestamps_ns
    bunched = t[np.arange(len(t)) // 20 * 20] + np.arange(len(t)) % 20 * 100_000
    assert "come in bunches" in wrong(vet_samples(replace(imu(), timestamps_ns=bunched)).checks)["imu"]


def test_an_axis_a_bias_or_a_delay_of_the_accelerometer_is_named() -> None:
    assert "y axis shows 0.0" in forces(lambda a: with_axis(a, 1, noise(0.02)))
    assert "y axis shows 1.9" in forces(lambda a: a * [1.0, 2.0, 1.0])
    assert "its bias is (1.9" in forces(lambda a: a + np.array([2.0, 0.0, 0.0]))
    assert "0.3 s too late" in forces(lambda a: np.concatenate([a[:30], a[:-30]]))
    assert "0.1 s too early" in forces(lambda a: np.concatenate([a[10:], a[-10:]]))
    biased = check_forces(
        compare_forces(paths(), replace(imu(), accel=imu().accel + np.array([0.9, 0.0, 0.0])), fits(imu()))
    )
    assert [c.agrees for c in biased] == [True]
    assert "its bias is 0." in biased[0].hypothesis
    small = replace(imu(), accel=np.concatenate([imu().accel[:2], imu().accel[:-2]]))
    assert not wrong(check_forces(compare_forces(paths(), small, fits(imu()))))


def with_heights(change: Callable[[np.ndarray], np.ndarray]) -> VettedReceiver:
    p = gnss().position_enu.copy()
    p[:, 2] = change(p[:, 2])
    return vetted(replace(gnss(), position_enu=p))


def test_heights_in_feet_upside_down_or_not_measured() -> None:
    for words, change in (("in feet", lambda z: z / 0.3048), ("sign is reversed", np.negative)):
        found = with_heights(change)
        assert found.gnss is None
        assert words in wrong(found.checks)["gnss gnss"]
    flat = with_heights(np.zeros_like)
    assert [c.action for c in flat.checks if c.hypothesis] == ["repaired"]
    assert flat.gnss is not None
    assert flat.gnss.covariances[:, 2, 2].min() > 1000


def test_heights_that_jump_keep_the_longest_stretch() -> None:
    jumped = gnss().position_enu + np.outer(np.arange(len(gnss().position_enu)) > 90, [0, 0, 2.0])
    found = vetted(replace(gnss(), position_enu=jumped))
    assert found.gnss is not None
    assert len(found.gnss.timestamps_ns) == 91
    assert any("heights jump" in c.hypothesis and c.action == "repaired" for c in found.checks)


def test_heights_in_whole_metres_do_not_jump() -> None:
    p = gnss().position_enu
    n = len(p)
    fit = ReceiverFit(1.0, 0.0, 0.0, 0.0, np.zeros((n, 3)), np.arange(n), 0.1, 100.0, np.zeros(2))
    coarse = p.copy()
    coarse[:, 2] = np.round(0.8 * np.sin(np.arange(n) / 9))
    off = replace(fit, residuals=coarse * [0.0, 0.0, 1.0])
    assert rows_of_one_level(replace(gnss(), position_enu=coarse), off).all()
    coarse[n // 3 :, 2] += 5.0
    off = replace(fit, residuals=coarse * [0.0, 0.0, 1.0])
    assert 0.6 < rows_of_one_level(replace(gnss(), position_enu=coarse), off).mean() < 0.7


@pytest.mark.parametrize("times", [2, 5])
def test_fixes_that_are_sent_again_count_once(times: int) -> None:
    given = gnss()
    step = int(np.median(np.diff(given.timestamps_ns))) // times
    again = replace(
        given,
        timestamps_ns=(given.timestamps_ns[:, None] + step * np.arange(times)).reshape(-1),
        position_enu=np.repeat(given.position_enu, times, axis=0),
        covariances=np.repeat(given.covariances, times, axis=0),
        velocity_enu=None,
    )
    found = vetted(again)
    assert found.gnss is not None
    assert set(given.timestamps_ns) >= set(found.gnss.timestamps_ns[:-times].tolist())
    assert any("repeat the one before" in c.hypothesis and c.action == "repaired" for c in found.checks)


def test_coarse_digits_of_a_slow_vessel_are_no_fixes_sent_again() -> None:
    seconds = np.arange(0, 120, 0.2)[:, None]
    way = np.concatenate(
        [0.4 * seconds + 3 * np.sin(seconds / 20), 0.3 * seconds, 0.1 * np.sin(seconds)], axis=1
    )
    coarse = np.round(way / [0.11, 0.185, 0.1]) * [0.11, 0.185, 0.1]
    slow = GnssStream(
        "gnss", np.arange(600) * 200_000_000, coarse, np.tile(np.eye(3), (600, 1, 1)), (54.0, 10.0, 0.0)
    )
    assert (np.diff(coarse, axis=0) == 0).all(axis=1).mean() > 0.1
    assert not repeated_rows(slow).any()
    again = np.repeat(way[::5], 5, axis=0) * 5  # fine digits, a fix a second sent five times
    assert repeated_rows(replace(slow, position_enu=again)).mean() > 0.7


def test_rounded_fixes_have_the_noise_of_their_last_digit() -> None:
    given = gnss()
    assert with_rounding(given)[1] == 0
    coarse = replace(given, position_enu=np.round(given.position_enu / [0.6, 1.1, 0.1]) * [0.6, 1.1, 0.1])
    found, digit = with_rounding(coarse)
    assert digit == pytest.approx(1.1)
    wider = found.covariances - given.covariances
    assert wider[0] == pytest.approx(np.diag([1.1**2 / 12, 1.1**2 / 12, 0.0]))
    assert any("rounded to 1.10 m" in c.hypothesis and c.agrees for c in vetted(coarse).checks)


@pytest.mark.parametrize("rate_hz", [6.0, 30.0])
def test_coarse_turns_last_however_many_pictures_there_are(rate_hz: float) -> None:
    stamps = np.round(np.arange(1000) * 1e9 / rate_hz).astype(np.int64)
    chosen = _from_the_middle(stamps, 150)
    assert len(chosen) == 150
    assert (stamps[chosen[-1]] - stamps[chosen[0]]) * 1e-9 > 14
    assert 0 <= chosen[0] + chosen[-1] - 999 + 3 <= 6
    assert len(_from_the_middle(stamps[:40], 150)) == (40 if rate_hz == 6.0 else 14)


def test_the_time_of_a_change_is_found_in_long_recordings_too(monkeypatch: pytest.MonkeyPatch) -> None:
    path = paths()["front"]
    rotation = path.world_from_body.rotation.copy()
    rotation[len(path) // 3 :] = rotation[len(path) // 3 :] @ so3.exp(np.array([0.0, 0.0, 0.9]))
    segments = (np.arange(len(path)) >= len(path) // 3).astype(
        np.int64
    )  # lost in between: no stride shows the knock
    changed = replace(
        path, world_from_body=SE3(rotation, path.world_from_body.translation), segment_ids=segments
    )
    fit = fits(imu(), {"front": changed})["front"]
    fine = mount_change(fit)
    monkeypatch.setattr(turn_checks, "_MOST_SPLITS", 5)
    coarse = mount_change(fit)
    assert fine is not None
    assert coarse is not None
    assert coarse.at_ns == fine.at_ns


def test_forces_of_long_recordings_are_sampled(monkeypatch: pytest.MonkeyPatch) -> None:
    fit = fits(imu())["front"]
    whole = ForceEquations(paths()["front"], imu(), fit).solve(np.eye(3))
    monkeypatch.setattr(force_fit, "_MOST", 40)
    some = ForceEquations(paths()["front"], imu(), fit)
    assert len(some.force) == 40
    assert some.solve(np.eye(3)).scale == pytest.approx(whole.scale, rel=0.05)


def test_a_receiver_that_never_moves_is_left_out() -> None:
    found = vetted(replace(gnss(), position_enu=np.zeros_like(gnss().position_enu)))
    assert found.gnss is None
    assert "the same to the last digit" in wrong(found.checks)["gnss gnss"]


@pytest.mark.parametrize(
    ("late_s", "words"),
    [
        (18.0, "GPS time was taken for UTC"),
        (37.0, "TAI was taken for UTC"),
        (7200.0, "(+2 h)"),
        (3e5, "before or after"),
    ],
)
def test_stamps_of_another_clock_are_named(late_s: float, words: str) -> None:
    given: GnssStream = gnss()
    found = vetted(replace(given, timestamps_ns=given.timestamps_ns + round(late_s * 1e9)))
    assert found.gnss is None
    assert words in wrong(found.checks)["gnss gnss"]


def test_pictures_shown_again_later_are_repeated_ones() -> None:
    run = _TrackingRun()
    rng = np.random.default_rng(0)
    pictures = [rng.integers(0, 255, (40, 60), dtype=np.uint8) for _ in range(4)]
    assert [run.judge(p) for p in (*pictures, *pictures[1:3], pictures[3])] == ["usable"] * 4 + [
        "repeated"
    ] * 3


@pytest.mark.parametrize(("size_s", "agrees"), [(0.0, True), (0.008, True), (0.03, False)])
def test_stamps_that_jitter_are_named(size_s: float, agrees: bool) -> None:
    front = paths()["front"]
    off = np.random.default_rng(1).normal(0, size_s, len(front))
    stamps = np.maximum.accumulate(front.timestamps_ns + np.round(off * 1e9).astype(np.int64))
    shaken = {**paths(), "front": replace(front, timestamps_ns=stamps + np.arange(len(stamps)))}
    checks = check_jitter(shaken, imu(), fits(imu(), shaken))
    assert [c.sensor for c in checks] == (["camera front"] if size_s else [])
    assert all(c.agrees == agrees and c.statistic == pytest.approx(size_s, rel=0.4) for c in checks)


def test_stamps_of_all_cameras_in_steps_may_be_the_fault_of_the_imu() -> None:
    coarse = {
        n: replace(p, timestamps_ns=p.timestamps_ns // 70_000_000 * 70_000_000) for n, p in paths().items()
    }
    checks = check_jitter(coarse, imu(), fits(imu(), coarse))
    assert [c.sensor for c in checks] == ["imu"]
    assert not checks[0].agrees


def test_a_camera_that_the_gyroscope_explains_less_than_the_others_is_odd() -> None:
    good = fits(imu())["front"]
    rng = np.random.default_rng(0)
    size = 0.25 * np.linalg.norm(good.camera_turns, axis=1).mean()
    poor = replace(good, residuals=rng.normal(0, size, good.residuals.shape))
    assert 0.15 < poor.unexplained < 0.5
    assert set(sensor_checks._odd_ones({"front": poor, "left": good, "right": good})) == {"front"}
    assert not sensor_checks._odd_ones({"front": poor, "left": poor})
    assert not sensor_checks._odd_ones({"front": good, "left": good})


def test_a_focal_length_that_grows_is_named() -> None:
    seen, lens = world().tracks["front"], world().recording.cameras["front"].model
    assert lens is not None
    centre = lens.project(np.array([[0.0, 0.0, 1.0]]))[0][0]
    when = seen.frame_indices / seen.frame_indices.max()
    breathing = replace(seen, pixels=centre + (seen.pixels - centre) * (1 + 0.03 * when)[:, None])
    for tracks, agrees in ((seen, True), (breathing, False)):
        fitted = {"front": replace(fit_lens(seen, lens, paths()["front"]), refined_rms_px=0.05)}
        checks = check_lenses(fitted, {"front": tracks}, {"front": lens}, paths())
        assert checks[0].agrees == agrees
    assert "its focal length changes" in checks[0].hypothesis


def test_a_rate_is_not_looked_for_where_nothing_turns() -> None:
    still: ImuStream = replace(imu(), gyro=imu().gyro * 1e-3)
    path = paths()["front"]
    assert rate_of_stamps(still, path.take(np.arange(20))) is None
