"""Level frame, surfaces and level strips."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from calibrated_rigs import boat, without_vertical
from rigwake.errors import InputError, UsageError
from rigwake.geometry import so3
from rigwake.geometry.se3 import SE3
from rigwake.readers.trajectories import read_trajectory
from rigwake.readers.truth_files import read_true_rig
from rigwake.recording import ImuStream
from rigwake.trajectory import Trajectory
from rigwake.views import attitude as levelling
from rigwake.views.strips import StripGrid, camera_strips, level_strip
from rigwake.views.surface import (
    Shell,
    Surface,
    WaterAndDepth,
    WaterAndShell,
    WaterAndStixels,
    azimuth_elevation,
    level_directions,
)
from rigwake.views.surround_rig import surround_rig
from view_scenes import HEIGHT_M, attitude, four_cameras, photograph, water_and_ring

ANGLES = st.floats(-20, 20)


@given(ANGLES, ANGLES)
@settings(max_examples=30)
def test_level_frame_has_z_up_and_x_ahead(roll: float, pitch: float) -> None:
    stand = attitude(roll, pitch)
    R = stand.level_from_rig
    assert np.allclose(R @ R.T, np.eye(3), atol=1e-12)
    ahead = R @ [1.0, 0.0, 0.0]
    assert abs(ahead[1]) < 1e-12
    assert ahead[0] > 0
    assert np.allclose(np.rad2deg(stand.roll_pitch), [roll, pitch], atol=1e-9)


def test_azimuth_is_positive_to_starboard() -> None:
    starboard, port, up = np.array([[0.0, -1, 0], [0, 1, 0], [0, 0, 1]])
    azimuth, elevation = azimuth_elevation(np.array([starboard, port, up]))
    assert np.allclose(azimuth[:2], [np.pi / 2, -np.pi / 2])
    assert np.allclose(elevation, [0, 0, np.pi / 2])
    assert np.allclose(level_directions(np.array(np.pi / 2), np.array(0.0)), starboard)


@given(st.floats(-170, 170), st.floats(-44, 29))
@settings(max_examples=30)
def test_strip_pixels_and_directions_are_inverse(azimuth_deg: float, elevation_deg: float) -> None:
    grid = StripGrid()
    column, row = grid.pixels(level_directions(np.deg2rad(azimuth_deg), np.deg2rad(elevation_deg)))
    at = np.array([round(float(row)), round(float(column))])
    centre = grid.directions()[at[0], at[1]]
    assert np.allclose(grid.pixels(centre), at[::-1], atol=1e-6)
    assert abs(row - at[0]) <= 0.5


def test_water_shell_and_obstacles_meet_without_a_gap() -> None:
    stand = attitude()
    azimuth = np.full(400, 0.3)
    elevation = np.linspace(-1.2, 0.5, 400)
    directions = level_directions(azimuth, elevation)
    water_shell = WaterAndShell(40.0).range_m(directions, stand)
    points = directions * water_shell[:, None]
    on_water = np.abs(points[:, 2] + HEIGHT_M) < 1e-9
    on_shell = np.abs(np.hypot(points[:, 0], points[:, 1]) - 40.0) < 1e-9
    assert (on_water | on_shell).all()
    assert np.abs(np.diff(water_shell)).max() < 4.0  # no jump where the one ends

    distance, top = np.full((360, 2), np.nan), np.full((360, 2), np.nan)
    distance[:, 0], top[:, 0] = 25.0, 6.0
    distance[:, 1], top[:, 1] = 8.0, 1.0
    layered = WaterAndStixels(distance, top).range_m(directions, stand)
    points = directions * layered[:, None]
    out = np.hypot(points[:, 0], points[:, 1])
    above = points[:, 2] + HEIGHT_M
    wet = np.abs(above) < 1e-9
    assert (wet | np.isclose(out, 8.0) | np.isclose(out, 25.0) | np.isclose(out, 40.0)).all()
    assert out[wet].max() <= 25.0 + 1e-9  # no water is seen behind the far obstacle
    assert (above[np.isclose(out, 8.0)] <= 1.0).all()
    assert out[np.argmin(np.abs(elevation - np.arctan2(-HEIGHT_M + 2, 25)))] == pytest.approx(25.0)


def test_every_surface_is_finite_and_positive_everywhere() -> None:
    rng = np.random.default_rng(3)
    directions = rng.normal(size=(500, 3))
    directions = np.vstack(
        [directions / np.linalg.norm(directions, axis=1, keepdims=True), np.eye(3), -np.eye(3)]
    )
    depth = np.where(rng.random((190, 900)) < 0.5, 20.0, np.nan)
    surfaces: list[Surface] = [
        Shell(),
        WaterAndShell(),
        WaterAndStixels(np.full((90, 1), 9.0), np.full((90, 1), np.inf)),
        WaterAndDepth(depth, np.deg2rad(30), np.deg2rad(0.4)),
    ]
    for surface in surfaces:
        ranges = surface.range_m(directions, attitude())
        assert np.isfinite(ranges).all()
        assert (ranges > 0).all()


def test_unknown_height_is_asked_for() -> None:
    with pytest.raises(UsageError, match="--height-m"):
        WaterAndShell().range_m(np.array([[1.0, 0, 0]]), attitude(height_m=np.nan))
    assert Shell().range_m(np.array([[1.0, 0, 0]]), attitude(height_m=np.nan)) == pytest.approx(40.0)


def test_strip_shows_the_world_where_it_is() -> None:
    """Rolled and pitched, the strip equals the world seen from the viewpoint."""
    rig, stand = four_cameras(), attitude(6.0, -4.0)
    world = water_and_ring(12.0)
    images = photograph(rig, stand, world)
    grid = StripGrid(step_deg=0.8, rows=75)
    ring = WaterAndStixels(np.full((360, 1), 12.0), np.full((360, 1), 4.0))
    strip = level_strip(images, rig, stand, ring, grid, timestamp_ns=7)
    directions = grid.directions().reshape(-1, 3)
    expected = world(np.zeros_like(directions), directions).reshape(grid.rows, grid.columns, 3)
    band = slice(12, 60)  # away from edges that the lookup smooths
    error = np.abs(strip.image.astype(float) - expected)[band]
    assert strip.is_seen[band].all()
    assert np.median(error) < 2.0
    assert set(np.unique(strip.camera[band])) == {0, 1, 2, 3}
    shell = level_strip(images, rig, stand, WaterAndShell(40.0), grid)
    assert np.mean(np.abs(shell.image.astype(float) - expected)[band]) > 2 * error.mean()


def test_strip_leaves_out_masks_and_missing_cameras() -> None:
    rig, stand = four_cameras(), attitude()
    images = {name: np.full((480, 640), 90, np.uint8) for name in rig.names}
    grid = StripGrid(step_deg=1.6, rows=47)
    mask = {"front": np.ones((480, 640), dtype=np.bool_)}
    for strip in (
        level_strip(images, rig, stand, WaterAndShell(), grid, mask),
        level_strip({n: i for n, i in images.items() if n != "front"}, rig, stand, WaterAndShell(), grid),
    ):
        assert 0 not in strip.camera
        assert (strip.image[~strip.is_seen] == 0).all()
    assert [i for i, _, _ in camera_strips(images, rig, stand, WaterAndShell(), grid)] == [0, 1, 2, 3]


def test_unobservable_parts_of_a_rig_are_said() -> None:
    rig = surround_rig(without_vertical(boat("base_link"), "port").rig)
    assert len(rig) == 4
    assert "port" in rig.notes[0]
    assert np.isfinite(rig.viewpoint_rig).all()
    calibration = boat("front")
    assert np.allclose(
        surround_rig(calibration.rig).forward_rig,
        calibration.rig.cameras["front"].rig_from_cam.rotation[:, 2],
    )
    with pytest.raises(UsageError, match="no lens"):
        surround_rig(boat("base_link", lens=None).rig)


def waving_imu(bias: np.ndarray, tilt: np.ndarray, duration_s: float = 40.0) -> tuple[ImuStream, np.ndarray]:
    """A vessel in waves that turns; `tilt` (2,) mounts the IMU askew. Returns true `world_from_imu`."""
    rate, rng = 100.0, np.random.default_rng(5)
    times = np.arange(0, duration_s, 1 / rate)
    roll, pitch = 0.06 * np.sin(2 * np.pi * times / 3.2), 0.04 * np.sin(2 * np.pi * times / 2.7 + 1)
    yaw = 0.5 * np.sin(2 * np.pi * times / 25)
    zero = np.zeros_like(times)
    R = (
        so3.exp(np.stack([zero, zero, yaw], 1))
        @ so3.exp(np.stack([zero, pitch, zero], 1))
        @ so3.exp(np.stack([roll, zero, zero], 1))
        @ so3.exp(np.array([tilt[0], tilt[1], 0.0]))
    )
    rate_body = so3.log(np.swapaxes(R[:-1], 1, 2) @ R[1:]) * rate
    gyro = np.vstack([rate_body, rate_body[-1:]])
    gyro[1:] = 0.5 * (gyro[1:] + gyro[:-1])
    sway = 0.4 * np.sin(2 * np.pi * times / 3.2)[:, None] * np.array([0.3, 1.0, 0.5])
    accel = np.einsum("nji,nj->ni", R, np.array([0, 0, 9.81]) + sway)
    noise = rng.normal(0, [[0.002] * 3], gyro.shape)
    stamps = (times * 1e9).astype(np.int64) + 10**18
    return ImuStream("imu", stamps, gyro + bias + noise, accel + rng.normal(0, 0.02, accel.shape)), R


def test_imu_attitude_is_good_to_half_a_degree_whatever_the_bias() -> None:
    bias = np.array([0.012, -0.009, 0.004])
    imu, R = waving_imu(bias, np.array([0.05, -0.03]))
    assert np.abs(levelling.gyro_bias(imu)[:2] - bias[:2]).max() < 2e-3
    rig = four_cameras()
    track = levelling.track_from_imu(imu, SE3.identity(), rig)
    up = track.level_from_rig[:, 2]
    error = np.rad2deg(np.arccos(np.clip(np.sum(up * R[:, 2], axis=1), -1, 1)))
    assert np.median(error) < 0.5
    assert error.max() < 1.5
    askew = levelling.track_from_imu(imu, SE3(so3.exp([0.05, -0.03, 0.0]), np.zeros(3)), rig)
    level = askew.level_from_rig[:, 2] @ so3.exp([0.05, -0.03, 0.0])
    assert np.allclose(level, up, atol=1e-9)


def test_track_between_and_beyond_its_times() -> None:
    stamps = np.array([0, 10**9, 2 * 10**9], dtype=np.int64)
    R = so3.exp(np.array([[0.0, 0, 0], [0.2, 0, 0], [0.0, 0.1, 0]]))
    poses = SE3(R, np.array([[0.0, 0, 0], [1, 0, 0.2], [2, 0, 0]]))
    rig = four_cameras()
    track = levelling.track_from_trajectory(Trajectory("rig", stamps, poses), rig).with_height(1.9, 0.02)
    half = track.at(5 * 10**8)
    assert half.roll_pitch[0] == pytest.approx(0.1, abs=1e-3)
    assert track.at(-(10**9)).roll_pitch == pytest.approx((0.0, 0.0), abs=1e-9)
    assert track.at(10**9).height_m - track.at(0).height_m == pytest.approx(
        (R[1] @ rig.viewpoint_rig)[2] - rig.viewpoint_rig[2] + 0.2, abs=1e-9
    )
    assert track.covers(2 * 10**9)
    assert not track.covers(4 * 10**9)


def test_a_vertical_direction_ahead_is_refused() -> None:
    with pytest.raises(InputError, match="nearly vertical"):
        levelling.level_rotation(np.array([1.0, 0, 0.05]), np.array([1.0, 0, 0]))
    camera_frame = replace(four_cameras(), forward_rig=np.array([0.0, 0, 1.0]))
    stand = levelling.unlevelled(camera_frame)
    assert np.allclose(stand.level_from_rig[2], [0, -1, 0])
    assert stand.source == "none"


def test_harbour_imu_levels_like_the_truth(real_recordings: Path) -> None:
    """The independent simulator's IMU, its biases included, against its true poses."""
    path = real_recordings / "harbour_a"
    if not path.is_dir():
        pytest.skip("harbour_a is not here")
    table = np.loadtxt(path / "truth_imu.csv", delimiter=",", skiprows=1)
    stamps = np.round(table[:, 0] * 1e9).astype(np.int64)
    imu = ImuStream("imu", stamps, table[:, 1:4] + table[:, 7:10], table[:, 4:7] + table[:, 10:13])
    base = read_trajectory(path / "truth_base.tum").trajectory
    rig_from_imu = read_true_rig(path / "truth.yaml").rig_from_imu
    assert rig_from_imu is not None
    rig = four_cameras()
    track = levelling.track_from_imu(imu, rig_from_imu, rig)
    truth = levelling.track_from_trajectory(base, rig)
    errors = [
        np.rad2deg(np.arccos(np.clip(track.at(t).level_from_rig[2] @ truth.at(t).level_from_rig[2], -1, 1)))
        for t in stamps[::50]
    ]
    assert np.median(errors) < 0.8
    assert np.max(errors) < 1.5
