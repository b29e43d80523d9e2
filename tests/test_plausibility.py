"""Sensors against each other: what is wrong is named, what is right is not accused."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from calibration_worlds import STILL_WATER, sail
from rigwake.errors import InputError
from rigwake.geometry import so3
from rigwake.geometry.se3 import SE3
from rigwake.plausibility import receiver_checks
from rigwake.plausibility.coarse_turns import vet_turns
from rigwake.plausibility.force_checks import check_forces, compare_forces
from rigwake.plausibility.force_fit import ForceEquations
from rigwake.plausibility.imu_samples import vet_samples
from rigwake.plausibility.lens_checks import check_lenses, fit_lenses
from rigwake.plausibility.noise_bounds import check_imu_noise
from rigwake.plausibility.picture_checks import check_pictures
from rigwake.plausibility.receiver_checks import vet_receiver
from rigwake.plausibility.receiver_fit import ReceiverFit, fit_receiver, level_path
from rigwake.plausibility.turn_checks import check_clocks, check_mounts, check_scale
from rigwake.plausibility.turn_fit import TurnFit, camera_as_gyroscope, fit_turns
from rigwake.plausibility.values import SensorCheck, checks_to_list, disagreeing, refuse
from rigwake.recording import GnssStream, ImuStream
from rigwake.simulation.sensors import gauss_markov
from rigwake.simulation.tracks_only import SimulatedTracks
from rigwake.tracks import TrackingReport, Tracks
from rigwake.trajectory import Trajectory

NOISE_RAD, NOISE_M = 2e-4, 0.005


@cache
def world(calm: bool = False) -> SimulatedTracks:
    sea = {"sea": STILL_WATER} if calm else {}
    return sail(cameras=("front", "left"), features=60, tracking={"noise_px": 0.08}, **sea)


@cache
def paths(calm: bool = False, seed: int = 0) -> dict[str, Trajectory]:
    """What an odometry would report: the truth in a unit of its own, with a little noise of each pose."""
    found, rng = {}, np.random.default_rng(seed)
    for name, tracks in world(calm).tracks.items():
        true = world(calm).recording.true_trajectories[name].world_from_body
        path = true[0].inverse() * true
        n = len(path.translation)
        turned = path.rotation @ so3.exp(rng.normal(0, NOISE_RAD, (n, 3)))
        moved = (path.translation + rng.normal(0, NOISE_M, (n, 3))) / 5.0
        found[name] = Trajectory(name, tracks.timestamps_ns, SE3(turned, moved), is_metric=False)
    return found


def imu(calm: bool = False) -> ImuStream:
    return world(calm).recording.imus["imu"]


def fits(stream: ImuStream, trajectories: dict[str, Trajectory] | None = None) -> dict[str, TurnFit]:
    return {name: fit_turns(path, stream) for name, path in (trajectories or paths()).items()}


def wrong(checks: tuple[SensorCheck, ...]) -> dict[str, str]:
    return {check.sensor: check.hypothesis for check in disagreeing(checks)}


def drifting(stamps: np.ndarray, rate: float) -> np.ndarray:
    return stamps[0] + np.round((stamps - stamps[0]) * (1 + rate)).astype(np.int64)


BOTH = frozenset({"front", "left"})


def test_turns_tell_scale_lag_and_drift_within_their_sigmas() -> None:
    stream = replace(imu(), gyro=imu().gyro * 1.02, timestamps_ns=imu().timestamps_ns + 120_000_000)
    for name, path in paths().items():
        drifted = replace(path, timestamps_ns=drifting(path.timestamps_ns, 5e-4))
        fit = fit_turns(drifted, stream)
        off = np.array([np.log(fit.scale) + np.log(1.02), fit.drift + 5e-4])
        assert np.all(np.abs(off) < 4 * fit.std[[7, 8]] + 1e-5), name
        assert abs(fit.time_offset_s - 0.12) < 0.01


@pytest.mark.parametrize("calm", [False, True])
def test_a_good_imu_is_not_accused(calm: bool) -> None:
    found = fits(imu(calm), paths(calm))
    checks, factor = check_scale(found, BOTH)
    assert factor is None
    forces = check_forces(compare_forces(paths(calm), imu(calm), found))
    everything = (
        *vet_samples(imu(calm)).checks,
        *vet_turns(imu(calm), paths(calm)).checks,
        *checks,
        *check_clocks(found),
        *check_mounts(found),
        *forces,
    )
    assert not wrong(everything)
    assert not any(check.action == "repaired" for check in everything)


def test_a_gyroscope_off_by_three_percent_is_corrected_by_what_cameras_agree_on() -> None:
    checks, factor = check_scale(fits(replace(imu(), gyro=1.03 * imu().gyro)), BOTH)
    assert "scale" in wrong(checks)["gyroscope"]
    assert factor == pytest.approx(1 / 1.03, abs=5e-4)


@pytest.mark.parametrize(("focal_std", "blamed"), [(0.02, "do not tell which"), (0.002, "scale is wrong")])
def test_a_camera_whose_lens_is_not_known_does_not_accuse_the_gyroscope_alone(
    focal_std: float, blamed: str
) -> None:
    found = fits(replace(imu(), gyro=1.03 * imu().gyro))
    checks, factor = check_scale({"left": found["left"]}, BOTH, {"left": focal_std})
    assert blamed in wrong(checks)["gyroscope"]
    assert factor is None


def test_one_camera_with_another_scale_is_the_camera() -> None:
    found = fits(imu())
    off = {**found, "left": replace(found["left"], scale=1.03), "right": found["front"]}
    checks, factor = check_scale(off, BOTH | {"right"})
    assert set(wrong(checks)) == {"camera left"}
    assert factor is None


def test_clocks_that_drift_are_those_of_the_camera_or_of_the_imu() -> None:
    front = replace(paths()["front"], timestamps_ns=drifting(paths()["front"].timestamps_ns, 1e-3))
    assert set(wrong(check_clocks(fits(imu(), {**paths(), "front": front})))) == {"camera front"}
    fast = replace(imu(), timestamps_ns=drifting(imu().timestamps_ns, 1e-3))
    assert set(wrong(check_clocks(fits(fast)))) == {"imu"}


@pytest.mark.parametrize("knock_deg", [0.4, 1.0, 5.0])
def test_a_knock_is_found_with_its_time(knock_deg: float) -> None:
    path = paths()["front"]
    at = path.timestamps_ns[len(path) // 2]
    rotation = path.world_from_body.rotation.copy()
    late = path.timestamps_ns > at
    rotation[late] = rotation[late] @ so3.exp(np.deg2rad(knock_deg) * np.array([0.6, 0.0, 0.8]))
    knocked = replace(path, world_from_body=SE3(rotation, path.world_from_body.translation))
    words = wrong(check_mounts(fits(imu(), {**paths(), "front": knocked})))
    assert set(words) == {"camera front"}
    seconds = (at - path.timestamps_ns[0]) * 1e-9
    assert any(f"at {seconds + d / 10:.1f} s" in words["camera front"] for d in range(-8, 9))


def test_cameras_exchanged_halfway_are_named_together() -> None:
    a, b = paths()["front"], paths()["left"]
    half = len(a) // 2
    ids = np.repeat([0, 1], [half, len(a) - half])

    def spliced(first: Trajectory, second: Trajectory) -> Trajectory:
        rotation = np.concatenate(
            [first.world_from_body.rotation[:half], second.world_from_body.rotation[half:]]
        )
        poses = SE3(rotation, first.world_from_body.translation)
        return replace(first, world_from_body=poses, segment_ids=ids)

    words = wrong(check_mounts(fits(imu(), {"front": spliced(a, b), "left": spliced(b, a)})))
    assert "it and left are exchanged" in words["camera front"]


def test_without_a_gyroscope_another_camera_serves() -> None:
    fit = fit_turns(paths()["left"], camera_as_gyroscope(paths()["front"]))
    assert fit.unexplained < 0.05
    assert abs(fit.scale - 1) < 0.01


def test_units_are_repaired_and_axes_refused() -> None:
    in_g = vet_samples(replace(imu(), accel=imu().accel / 9.80665))
    assert in_g.checks[0].action == "repaired"
    np.testing.assert_allclose(in_g.imu.accel, imu().accel)
    assert wrong(vet_samples(replace(imu(), accel=imu().accel / 9.80665), repair=False).checks)
    degrees = vet_turns(replace(imu(), gyro=np.rad2deg(imu().gyro)), paths())
    assert degrees.checks[0].action == "repaired"
    np.testing.assert_allclose(degrees.imu.gyro, imu().gyro)
    flipped = vet_turns(replace(imu(), gyro=imu().gyro * [1, 1, -1]), paths())
    assert "left-handed" in wrong(flipped.checks)["gyroscope"]
    without_gravity = vet_samples(replace(imu(), accel=imu().accel - [0, 0, 9.81]))
    assert "gravity" in wrong(without_gravity.checks)["accelerometer"]


def test_clipped_and_held_samples_are_taken_out() -> None:
    limit = np.quantile(np.abs(imu().gyro), 0.97)
    clipped = vet_samples(replace(imu(), gyro=np.clip(imu().gyro, -limit, limit)))
    assert any("clipped" in check.hypothesis for check in clipped.checks)
    assert len(clipped.imu.gyro) < len(imu().gyro)
    gyro, accel = imu().gyro.copy(), imu().accel.copy()
    gyro[500:600], accel[500:600] = gyro[500], accel[500]
    held = vet_samples(replace(imu(), gyro=gyro, accel=accel))
    assert any("repeat" in check.hypothesis for check in held.checks)
    assert any("gaps" in check.hypothesis for check in held.checks)


@pytest.mark.parametrize(
    "axes", [np.diag([1.0, 1, -1]), np.diag([-1.0, 1, 1]), np.eye(3)[[1, 0, 2]], np.eye(3)[[1, 2, 0]]]
)
def test_the_axes_of_the_accelerometer_are_named(axes: np.ndarray) -> None:
    stream = replace(imu(), accel=imu().accel @ axes.T)
    verdicts = compare_forces(paths(), stream, fits(imu()))
    assert verdicts
    for verdict in verdicts.values():
        np.testing.assert_array_equal(verdict.best.axes, axes.T)
    assert "accelerometer" in wrong(check_forces(verdicts))


def test_a_reversed_accelerometer_and_mirrored_pictures_are_told_apart() -> None:
    found = fits(imu())
    reversed_sign = compare_forces(paths(), replace(imu(), accel=-imu().accel), found)
    assert "sign is reversed" in wrong(check_forces(reversed_sign))["accelerometer"]
    flip = np.diag([-1.0, 1, 1])
    path = paths()["front"]
    poses = SE3(flip @ path.world_from_body.rotation @ flip, path.world_from_body.translation @ flip)
    mirrored = {**paths(), "front": replace(path, world_from_body=poses), "back": paths()["left"]}
    verdicts = compare_forces(mirrored, imu(), fits(imu(), mirrored))
    assert set(wrong(check_forces(verdicts))) == {"camera front"}


def gnss() -> GnssStream:
    return world().recording.gnss["gnss"]


@cache
def level() -> tuple[Trajectory, float, float]:
    path = paths()["front"]
    turns = fit_turns(path, imu())
    force = ForceEquations(path, imu(), turns).solve(np.eye(3))
    return level_path(path, force.gravity), turns.time_offset_s, force.scale


def vetted(receiver: GnssStream):
    path, offset_s, scale = level()
    return vet_receiver(receiver, path, offset_s, level=True, inertial_scale=(scale, 0.1))


def test_a_good_receiver_is_not_accused_whatever_its_grade() -> None:
    assert not wrong(vetted(gnss()).checks)
    rng = np.random.default_rng(0)
    lasting = np.cumsum(rng.normal(0, 0.07, gnss().position_enu.shape), axis=0)
    coarse = replace(
        gnss(),
        position_enu=gnss().position_enu + lasting,
        covariances=np.tile(np.eye(3), (len(lasting), 1, 1)),
    )
    found = vetted(coarse)
    assert found.gnss is not None
    assert not any(check.action == "repaired" for check in found.checks)


def test_exchanged_coordinates_are_named() -> None:
    p, (latitude, longitude, height) = gnss().position_enu, gnss().origin_lla
    swapped = p.copy()
    swapped[:, 0], swapped[:, 1] = (
        p[:, 1] * np.cos(np.deg2rad(longitude)),
        p[:, 0] / np.cos(np.deg2rad(latitude)),
    )
    receiver = replace(gnss(), position_enu=swapped, origin_lla=(longitude, latitude, height))
    found = vetted(receiver)
    assert found.gnss is None
    assert "latitude and longitude are exchanged" in wrong(found.checks)["gnss gnss"]
    ned = vetted(replace(gnss(), position_enu=p[:, [1, 0, 2]] * [1, 1, -1]))
    assert ned.gnss is None


def test_fixes_that_run_away_steadily_are_named_and_those_that_wander_are_not() -> None:
    seconds = (gnss().timestamps_ns - gnss().timestamps_ns[0])[:, None] * 1e-9
    away = vetted(replace(gnss(), position_enu=gnss().position_enu + seconds * [0.0, 0.2, 0.0]))
    assert away.gnss is None
    assert "run away from the cameras' path by 0.20 m/s" in wrong(away.checks)["gnss gnss"]
    for seed in range(4):
        lasting = gauss_markov(np.random.default_rng(seed), len(seconds), 0.2, 1.0, 40.0)
        stated = np.tile(np.eye(3) * 1.06, (len(seconds), 1, 1))
        wandering = replace(gnss(), position_enu=gnss().position_enu + lasting, covariances=stated)
        assert not wrong(vetted(wandering).checks)


@pytest.mark.parametrize("late_s", [0.2, 1.0, -0.5])
def test_the_delay_of_a_receiver_is_measured(late_s: float) -> None:
    found = vetted(replace(gnss(), timestamps_ns=gnss().timestamps_ns + round(late_s * 1e9)))
    assert found.delay_s == pytest.approx(late_s, abs=0.02)


@pytest.mark.parametrize(("lag_s", "std_s"), [(2.0, 0.4), (3.0, 0.01)])
def test_a_delay_that_nobody_knows_is_not_told(
    monkeypatch: pytest.MonkeyPatch, lag_s: float, std_s: float
) -> None:
    """A path that drifts, as a camera's without an IMU, fits almost any delay; the longest looked for is none."""

    def lagging(*args: object, **kwargs: object) -> ReceiverFit:
        return replace(fit_receiver(*args, **kwargs), lag_s=lag_s, lag_std_s=std_s)  # type: ignore[arg-type]

    monkeypatch.setattr(receiver_checks, "fit_receiver", lagging)
    found = vetted(gnss())
    assert found.delay_s == 0.0
    assert not any("late" in check.hypothesis for check in found.checks)


def test_fixes_that_stand_still_jump_or_lie_far_off_are_left_out() -> None:
    rng = np.random.default_rng(1)
    for spoil in ("frozen", "frozen with noise", "jump", "jump and back", "outliers"):
        p = gnss().position_enu.copy()
        bad = np.zeros(len(p), dtype=bool)
        if spoil.startswith("frozen"):
            bad[41:80] = True
            p[bad] = p[40] + (rng.normal(0, 0.01, (39, 3)) if "noise" in spoil else 0)
        elif spoil.startswith("jump"):
            bad[slice(90, None) if spoil == "jump" else slice(60, 90)] = True
            p[bad] += [1.5, 1.0, 0]
        else:
            bad[5::13] = True
            p[bad] += rng.choice([-1, 1], (bad.sum(), 1)) * [3.0, 4.0, 0]
        found = vetted(replace(gnss(), position_enu=p))
        assert found.gnss is not None, spoil
        kept = np.isin(gnss().timestamps_ns, found.gnss.timestamps_ns)
        assert kept[bad].mean() < 0.1, spoil
        assert kept[~bad].mean() > 0.8, spoil


def test_one_fix_far_off_leaves_the_others_their_weight() -> None:
    path, offset_s, _ = level()
    p = gnss().position_enu.copy()
    clean = fit_receiver(path, gnss(), p, time_offset_s=offset_s)
    p[len(p) // 2] += [60.0, -80.0, 0.0]
    off = fit_receiver(path, gnss(), p, time_offset_s=offset_s)
    assert abs(off.scale / clean.scale - 1) < 0.01
    assert off.scale_std < 1.5 * clean.scale_std


def test_a_coarse_converter_is_not_a_clipped_one() -> None:
    coarse = replace(imu(), gyro=np.round(imu().gyro, 2))
    assert not any("clipped" in check.hypothesis for check in vet_samples(coarse).checks)


def test_distances_that_are_wrong_are_named() -> None:
    found = vetted(replace(gnss(), position_enu=3.28 * gnss().position_enu))
    assert "distances" in wrong(found.checks)["gnss gnss"]


def with_lens(factor: float = 1.0, shift_px: float = 0.0) -> tuple[dict[str, Tracks], dict]:
    models = {name: world().recording.cameras[name].model for name in world().tracks}
    params = models["front"].params * np.array([factor, factor, 1, 1, 1, 1, 1, 1])
    params[2] += shift_px
    return dict(world().tracks), {**models, "front": models["front"].with_params(params)}


@pytest.mark.parametrize(("factor", "shift_px"), [(1.0, 0.0), (1.03, 0.0), (1.0, 10.0)])
def test_a_lens_is_judged_by_its_own_tracks(factor: float, shift_px: float) -> None:
    tracks, models = with_lens(factor, shift_px)
    found = fit_lenses(tracks, models, paths())
    assert found["front"].scale == pytest.approx(1 / factor, abs=0.008)
    assert found["front"].shift_px[0] == pytest.approx(-shift_px, abs=1.2)
    expected = set() if factor == 1 and shift_px == 0 else {"camera front"}
    assert set(wrong(check_lenses(found, tracks, models, paths()))) == expected


def test_frozen_pictures_are_told_with_their_time() -> None:
    front = world().tracks["front"]
    counted = TrackingReport(168, 140, 0, 28, 0, 10, 100, 1.0)
    stamps = front.timestamps_ns[front.frame_indices]
    middle = int(front.timestamps_ns[len(front.timestamps_ns) // 2])
    kept = np.abs(stamps - middle) > 2_000_000_000
    checks = check_pictures(
        {"front": replace(front.take(kept), report=counted), "left": world().tracks["left"]}
    )
    assert [check.sensor for check in checks] == ["camera front"]
    assert "28 of 168" in checks[0].hypothesis
    assert "from 11.8 s to 16.2 s" in checks[0].hypothesis


def test_noise_beyond_physics_is_a_fault() -> None:
    stated = {"gyro": 1.7e-4, "accel": 2e-3}
    assert not wrong(check_imu_noise({"gyro": 5.0, "accel": 20.0}, stated))
    assert set(wrong(check_imu_noise({"gyro": 117.0, "accel": 61.0}, stated))) == {
        "gyroscope",
        "accelerometer",
    }


def test_refusing_names_sensor_and_remedy_and_checks_survive_their_file() -> None:
    checks = (
        SensorCheck("gnss gps", False, 3.0, float("nan"), "it is stuck.", "Restart it.", "m"),
        SensorCheck("imu", False, 1.0, 0.0, "held.", action="repaired"),
    )
    with pytest.raises(InputError, match=r"gnss gps: it is stuck.*Restart it"):
        refuse(checks)
    stuck, held = checks_to_list(checks)
    assert SensorCheck(**held) == checks[1]
    assert stuck["expected"] is None
    assert stuck["hypothesis"] == "it is stuck."
    refuse(checks[1:])


def test_offsets_follow_the_drift() -> None:
    none, stamps = np.zeros((3, 3)), 10**9 * np.arange(5)
    fit = TurnFit(np.eye(3), np.zeros(3), 0.02, 1.0, 1e-4, np.eye(9), 0.0, none, none, stamps, stamps, stamps)
    np.testing.assert_array_equal(fit.offsets_ns(stamps), 20_000_000 + 100_000 * np.arange(-2, 3))
