"""The simulator without pictures: scenarios, sea, motion, inertial and satellite samples, tracks."""

import time

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rigwake.errors import UsageError
from rigwake.geometry import so3
from rigwake.geometry.se3 import SE3
from rigwake.simulation.scenario import (
    Imu,
    Scenario,
    Sea,
    build_scenario,
    load_scenario,
    parse_scenario,
    preset_names,
)
from rigwake.simulation.sensors import imu_mounting, simulate_imu
from rigwake.simulation.setup import Simulation, prepare
from rigwake.simulation.tracks_only import simulate_tracks
from rigwake.simulation.waves import GRAVITY, SelfMaskResponse, WaveField, build_wave_field, raft_motion


def changed(scenario: Scenario, **changes: object) -> Scenario:
    """The scenario with parts replaced, validated again; `imu__rate_hz=5` reaches into a part."""
    plain = scenario.model_dump()
    for path, value in changes.items():
        *parents, leaf = path.split("__")
        at = plain
        for parent in parents:
            at = at[int(parent) if parent.isdigit() else parent]
        at[leaf] = value
    return build_scenario(plain)


@pytest.fixture(scope="module")
def thesis() -> Scenario:
    return load_scenario("thesis")


@pytest.fixture(scope="module")
def lively(thesis: Scenario) -> Simulation:
    return prepare(changed(thesis, sea__hs_m=0.25, sea__tp_s=3.2))


@pytest.mark.parametrize("name", preset_names())
def test_presets_are_valid_and_keep_clear_of_the_quay(name: str) -> None:
    simulation = prepare(changed(load_scenario(name), duration_s=20))
    assert simulation.rig.cameras


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ({"scene__size_m": (-10, 50)}, "scene.size_m[0]"),
        ({"cameras__1__width_px": -640}, "cameras[1].width_px"),
        ({"vessel__speed": 3}, "vessel.speed: unknown key"),
        ({"duration_s": float("nan")}, "duration_s"),
        ({"cameras__0__position_m": (0.0, 0.0, 1.05)}, "cameras[0].position_m"),
        ({"cameras__2__fov_deg": 359.0, "cameras__2__params__k1": -0.05}, "cameras[2] (back)"),
        ({"cameras__0__model": "periscope"}, "periscope"),
        ({"cameras__0__params": {"fx": 1.0}}, "cameras[0]"),
        ({"cameras__1__name": "front"}, "appears twice"),
        ({"vessel__start": {"east_m": 60, "north_m": 0, "heading_deg": 0}}, "vessel.manoeuvres"),
        ({"vessel__manoeuvres": [{"type": "turn", "rate_deg_s": 3}]}, "vessel.manoeuvres[0]"),
        ({"sea__hs_m": "high"}, "sea.hs_m"),
    ],
)
def test_bad_scenarios_are_refused_by_field(thesis: Scenario, change: dict, named: str) -> None:
    with pytest.raises(UsageError) as caught:
        prepare(changed(thesis, **change))
    assert named in str(caught.value)


def test_a_missing_scenario_lists_the_presets() -> None:
    with pytest.raises(UsageError, match="thesis"):
        load_scenario("atlantis")


def test_a_scenario_may_start_from_a_preset(thesis: Scenario) -> None:
    scenario = parse_scenario("{base: thesis, name: short, duration_s: 5, sea: {hs_m: 0.1}}")
    assert (scenario.duration_s, scenario.sea.hs_m, scenario.sea.tp_s) == (5, 0.1, thesis.sea.tp_s)
    assert scenario.cameras == thesis.cameras
    with pytest.raises(UsageError, match="base"):
        parse_scenario("{base: atlantis}")


@pytest.mark.parametrize(("hs_m", "tp_s"), [(0.25, 3.2), (0.5, 4.0), (1.0, 6.0)])
def test_the_sea_has_the_asked_height_and_one_spectrum(hs_m: float, tp_s: float) -> None:
    variances = []
    for seed in range(8):
        field = build_wave_field(Sea(hs_m=hs_m, tp_s=tp_s), seed)
        variances.append(sum(float(tile.surface(7.0)[..., 0].var()) for tile in field.tiles))
    assert 4 * np.sqrt(np.mean(variances)) == pytest.approx(hs_m, rel=0.12)


def test_a_small_raft_rides_the_surface_that_is_seen() -> None:
    """One spectrum for what is seen and what moves the boat: a tiny raft follows height and slopes of the tiles."""
    field = build_wave_field(Sea(hs_m=0.4, tp_s=4.0), 3)
    long_waves = WaveField(field.tiles[:1])
    tile = field.tiles[0]
    raft = SelfMaskResponse(0.05, 0.05, (1, 1, 1), (1, 1, 1))
    for t in (0.0, 3.7):
        surface = tile.surface(t)
        cell = tile.length_m / len(surface)
        for row, column in ((0, 0), (17, 93), (200, 31)):
            at = np.array([[column * cell, row * cell, 0.0]])
            heave, roll, pitch = raft_motion(long_waves, raft, np.array([t]), at)[0]
            height, slope_x, slope_y = surface[row, column]
            assert heave == pytest.approx(height, abs=0.02)
            assert (roll, -pitch) == pytest.approx((slope_y, slope_x), abs=4e-3)


@pytest.mark.slow
@pytest.mark.parametrize(("hs_m", "tp_s", "low", "high"), [(0.25, 3.2, 1.1, 1.4), (0.5, 4.0, 1.8, 2.4)])
def test_the_boat_rolls_and_pitches_as_much_as_such_a_sea_makes_it(
    thesis: Scenario, hs_m: float, tp_s: float, low: float, high: float
) -> None:
    """RMS of roll and of pitch, degrees, over six draws of the sea of two minutes each."""
    times = np.linspace(0, 120, 1200)
    squares = [
        prepare(changed(thesis, sea__hs_m=hs_m, sea__tp_s=tp_s, seed=seed, duration_s=120)).motion.spline(
            times
        )[:, 3:5]
        ** 2
        for seed in range(6)
    ]
    roll, pitch = np.rad2deg(np.sqrt(np.mean(squares, axis=(0, 1))))
    assert low < roll < high
    assert low < pitch < high


def _integrate(
    motion_gyro: np.ndarray, accel: np.ndarray, dt: float, start: SE3, velocity: np.ndarray
) -> SE3:
    """Strapdown integration, Magnus fourth order for attitude and Simpson for position over double steps."""
    rotation, position, velocity = start.rotation.copy(), start.translation.copy(), velocity.copy()
    gravity = np.array([0, 0, -GRAVITY])
    for k in range(0, len(motion_gyro) - 2, 2):
        w0, w1, w2 = motion_gyro[k : k + 3]
        h = 2 * dt
        half = so3.exp(dt * (5 * w0 + 8 * w1 - w2) / 12 + dt**2 / 12 * np.cross(w1, w0) * -1)
        whole = so3.exp(h * (w0 + 4 * w1 + w2) / 6 - h**2 / 12 * np.cross(w2, w0) * -1)
        a0 = rotation @ accel[k] + gravity
        a1 = rotation @ half @ accel[k + 1] + gravity
        a2 = rotation @ whole @ accel[k + 2] + gravity
        position = position + h * velocity + h**2 * (a0 + 2 * a1) / 6
        velocity = velocity + h * (a0 + 4 * a1 + a2) / 6
        rotation = rotation @ whole
    return SE3(rotation, position)


def test_noise_free_inertial_samples_integrate_to_the_truth(lively: Simulation) -> None:
    rig_from_imu = lively.rig.rig_from_imu
    assert rig_from_imu is not None
    dt = 0.005
    times = np.arange(0, 40 + dt / 2, dt)
    gyro, accel = lively.motion.inertial(times, rig_from_imu)
    world_from_imu = lively.motion.world_from_rig(times) * rig_from_imu
    velocity = lively.motion.velocity_world(times[:1], rig_from_imu.translation)[0]
    reached = _integrate(gyro, accel, dt, world_from_imu[0], velocity)
    error = world_from_imu[-1].local(reached)
    assert np.rad2deg(np.linalg.norm(error[:3])) < 1e-3
    assert np.linalg.norm(error[3:]) < 0.02


def test_inertial_samples_are_derivatives_of_the_motion(lively: Simulation) -> None:
    rig_from_imu = SE3.exp(np.array([0.1, -0.2, 0.5, 0.3, -0.2, 1.3]))
    times, h = np.linspace(1, 50, 97), 1e-4
    gyro, accel = lively.motion.inertial(times, rig_from_imu)
    before, now, after = (lively.motion.world_from_rig(times + step) * rig_from_imu for step in (-h, 0.0, h))
    turned = so3.log(np.swapaxes(before.rotation, 1, 2) @ after.rotation) / (2 * h)
    pushed = (after.translation - 2 * now.translation + before.translation) / h**2 + [0, 0, GRAVITY]
    np.testing.assert_allclose(gyro, turned, atol=1e-6)
    np.testing.assert_allclose(accel, np.einsum("nji,nj->ni", now.rotation, pushed), atol=1e-5)


@pytest.mark.slow
def test_noise_levels_are_those_asked_for(thesis: Scenario) -> None:
    scenario = changed(
        thesis, duration_s=400, imu__rate_hz=100, imu__gyro_noise_density=2e-3, imu__accel_noise_density=3e-2,
        gnss__rate_hz=10, gnss__quality="rtk", tracking__features=1,
        cameras=[thesis.cameras[0].model_dump() | {"rate_hz": 1.0}],
        vessel__manoeuvres=[{"type": "turn", "rate_deg_s": 6.0, "duration_s": 60.0, "speed_mps": 2.0}],
    )  # fmt: skip
    recording = simulate_tracks(scenario).recording
    motion = prepare(scenario).motion
    imu, gnss = recording.imus["imu"], recording.gnss["gnss"]
    times = (imu.timestamps_ns - imu.timestamps_ns[0]) * 1e-9
    rig = recording.true_rig
    assert rig is not None
    assert rig.rig_from_imu is not None
    gyro, accel = motion.inertial(times, rig.rig_from_imu)
    assert (imu.gyro - gyro).std() / 10 == pytest.approx(2e-3, rel=0.05)
    assert (imu.accel - accel).std() / 10 == pytest.approx(3e-2, rel=0.05)
    antenna = motion.world_from_rig((gnss.timestamps_ns - 20 * 10**9) * 1e-9) * np.array(rig.antenna_rig)
    error = gnss.position_enu - antenna
    assert error[:, :2].std() == pytest.approx(0.02, rel=0.05)
    assert error[:, 2].std() == pytest.approx(0.032, rel=0.05)


def test_bias_walk_grows_as_asked(lively: Simulation) -> None:
    walk, duration = 1e-3, lively.motion.duration_s
    imu = Imu(rate_hz=50, gyro_noise_density=0, gyro_bias_std=0, gyro_bias_walk=walk)
    ends = []
    for seed in range(150):
        stream = simulate_imu(lively.motion, imu, 0, np.random.default_rng(seed), "")
        gyro, _ = lively.motion.inertial(stream.timestamps_ns[-1:] * 1e-9, imu_mounting(imu))
        ends.append((stream.gyro[-1:] - gyro)[0])
    assert np.std(ends) == pytest.approx(walk * np.sqrt(duration), rel=0.12)


def test_a_perfect_receiver_is_exact_and_outages_are_silent(thesis: Scenario) -> None:
    scenario = changed(thesis, gnss__quality="perfect", gnss__outages_s=[(5, 12)], duration_s=20)
    recording = simulate_tracks(scenario).recording
    gnss = recording.gnss["gnss"]
    times = (gnss.timestamps_ns - 20 * 10**9) * 1e-9
    assert not np.any((times > 5) & (times < 12))
    assert len(times) == pytest.approx(13 * 5, abs=2)
    antenna = prepare(scenario).motion.world_from_rig(times) * np.array(thesis.gnss.position_m)
    np.testing.assert_allclose(gnss.position_enu, antenna, atol=1e-12)


@settings(max_examples=6)
@given(seed=st.integers(0, 10_000), offset_ms=st.floats(-80, 80), readout_ms=st.sampled_from([0.0, 25.0]))
def test_exact_observations_are_projections_of_the_truth(
    seed: int, offset_ms: float, readout_ms: float
) -> None:
    plain = load_scenario("thesis").model_dump()
    plain |= {"seed": seed, "duration_s": 6.0}
    plain["cameras"] = [
        plain["cameras"][seed % 4] | {"time_offset_ms": offset_ms, "rolling_shutter_ms": readout_ms}
    ]
    scenario = build_scenario(plain)
    result = simulate_tracks(scenario)
    ((name, tracks),) = result.tracks.items()
    truth = result.truth[name]
    land = truth.landmark_ids >= 0
    camera = result.recording.true_rig.camera(name)
    row = np.clip(truth.pixels[land, 1], 0, 479) / 479
    times = (tracks.timestamps_ns[tracks.frame_indices[land]] - 20 * 10**9) * 1e-9
    times = times + offset_ms * 1e-3 + row * readout_ms * 1e-3
    world_from_cam = prepare(scenario).motion.world_from_rig(times) * camera.rig_from_cam
    points = world_from_cam.inverse() * result.landmarks_world[truth.landmark_ids[land]]
    pixels, valid = camera.model.project(points)
    assert valid.mean() > 0.999  # all but those on the very edge of the field of view
    np.testing.assert_allclose(pixels[valid], truth.pixels[land][valid], atol=1e-3)
    good = ~truth.is_outlier
    assert np.std((tracks.pixels - truth.pixels)[good]) == pytest.approx(0.2, rel=0.1)
    keys = tracks.frame_indices * (tracks.track_ids.max() + 1) + tracks.track_ids
    assert np.all(np.diff(keys) > 0)  # sorted by frame, then track; each at most once


def test_tracks_are_as_many_and_as_wrong_as_asked(thesis: Scenario) -> None:
    scenario = changed(thesis, tracking__outliers=0.05, tracking__water=0.0, duration_s=30)
    result = simulate_tracks(scenario)
    for name, tracks in result.tracks.items():
        assert len(tracks) / len(tracks.timestamps_ns) == pytest.approx(150, rel=0.15)
        assert result.truth[name].is_outlier.mean() == pytest.approx(0.05, abs=0.01)
        assert (result.truth[name].landmark_ids >= 0).all()


def test_the_same_seed_gives_the_same_recording(thesis: Scenario) -> None:
    scenario = changed(thesis, duration_s=4)
    first, again = simulate_tracks(scenario), simulate_tracks(scenario)
    other = simulate_tracks(changed(scenario, seed=99))
    np.testing.assert_array_equal(first.tracks["left"].pixels, again.tracks["left"].pixels)
    np.testing.assert_array_equal(
        first.recording.gnss["gnss"].position_enu, again.recording.gnss["gnss"].position_enu
    )
    assert not np.array_equal(
        first.recording.gnss["gnss"].position_enu, other.recording.gnss["gnss"].position_enu
    )


def test_a_minute_of_four_cameras_takes_less_than_two_seconds(thesis: Scenario) -> None:
    simulate_tracks(changed(thesis, duration_s=2))  # compiles
    before = time.process_time()
    simulate_tracks(thesis)
    assert time.process_time() - before < 2.0
