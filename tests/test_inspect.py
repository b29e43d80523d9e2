"""`inspect` measures what is there: rates, gaps, clocks, motion, and whether it is enough."""

import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from typer.testing import CliRunner

from rigwake.cameras.models.kannala_brandt import KannalaBrandt4
from rigwake.cli.main import build_app
from rigwake.geometry import so3
from rigwake.inspection.inspection_summary import inspection_to_dict
from rigwake.inspection.picture_samples import Pictures, camera_rotation
from rigwake.inspection.readiness import judge
from rigwake.inspection.recording_inspection import inspect_recording
from rigwake.inspection.time_offsets import camera_offset, gnss_offset
from rigwake.inspection.timing import timing
from rigwake.inspection.vessel_motion import levelled_rotations, travel, turning
from rigwake.readers.open import open_recording
from rigwake.recording import CameraStream, Frame, GnssStream, ImuStream, Recording
from rigwake.report.inspection_page import inspection_page

START_NS = 1_700_000_000_000_000_000
RATE_HZ = 100


def true_rotations(times: NDArray[np.float64]) -> NDArray[np.float64]:
    """world_from_imu of a boat that turns to and fro, rolls and pitches."""
    zero = np.zeros_like(times)
    yaw = so3.exp(np.column_stack([zero, zero, 1.2 * np.sin(0.25 * times)]))
    roll = so3.exp(np.column_stack([np.radians(5) * np.sin(1.9 * times), zero, zero]))
    pitch = so3.exp(np.column_stack([zero, np.radians(3) * np.sin(1.4 * times + 1), zero]))
    return np.asarray(yaw @ pitch @ roll)


def true_positions(times: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.column_stack([4 * np.sin(0.4 * times), 3 * np.cos(0.55 * times), 0.1 * np.sin(1.7 * times)])


def simulated_imu(seconds: float = 60.0, noise: float = 1e-3) -> ImuStream:
    times = np.arange(0, seconds, 1 / RATE_HZ)
    step = 1e-3
    R = true_rotations(times)
    gyro = so3.log(np.swapaxes(true_rotations(times - step), 1, 2) @ true_rotations(times + step)) / (
        2 * step
    )
    acceleration = (
        true_positions(times + step) - 2 * true_positions(times) + true_positions(times - step)
    ) / step**2
    force = np.einsum("nji,nj->ni", R, acceleration + np.array([0, 0, 9.81]))
    rng = np.random.default_rng(0)
    return ImuStream(
        "imu",
        START_NS + np.round(times * 1e9).astype(np.int64),
        gyro + rng.normal(0, noise, gyro.shape),
        force + rng.normal(0, 10 * noise, force.shape),
    )


def test_levelled_rotations_keep_the_vertical_and_turn_as_the_boat_does() -> None:
    imu = simulated_imu()
    times = (imu.timestamps_ns - START_NS) * 1e-9
    R, truth = levelled_rotations(imu), true_rotations(times)
    tilt = np.degrees(np.arccos(np.clip(np.einsum("ni,ni->n", R[:, 2], truth[:, 2]), -1, 1)))
    assert tilt.max() < 6.0  # accelerations of the boat pull the filter
    turn = turning(imu)
    assert turn.turned_deg == pytest.approx(60 / (2 * np.pi / 0.25) * 4 * np.degrees(1.2), rel=0.1)
    assert 2.5 < turn.tilt_std_deg[0] < 5.0
    assert 1.5 < turn.tilt_std_deg[1] < 3.5


@given(offset_ms=st.integers(-400, 400), seed=st.integers(0, 2**20))
@settings(max_examples=5)
def test_camera_clock_is_recovered_within_its_sigmas(offset_ms: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    imu = simulated_imu()
    true_start = np.sort(rng.uniform(3, 56, 80))
    true_end = true_start + 0.1
    cam_from_imu = so3.exp(rng.normal(size=3))
    turns = so3.log(np.swapaxes(true_rotations(true_start), 1, 2) @ true_rotations(true_end)) @ cam_from_imu.T
    stamps = [
        START_NS + np.round((t - offset_ms * 1e-3) * 1e9).astype(np.int64) for t in (true_start, true_end)
    ]
    noisy = turns + rng.normal(0, 1e-3, turns.shape)
    pictures = Pictures(80, 80, 0, 0, 0, 100.0, stamps[0], stamps[1], noisy)
    time_offset = camera_offset("front", pictures, imu)
    assert time_offset.offset_s is not None
    assert time_offset.std_s is not None
    assert time_offset.std_s < 0.01
    assert abs(time_offset.offset_s - offset_ms * 1e-3) < max(4.5 * time_offset.std_s, 2e-3)


def test_a_clock_is_not_stated_where_the_motion_does_not_agree() -> None:
    imu = simulated_imu()
    rng = np.random.default_rng(3)
    start = START_NS + np.sort(rng.integers(3, 56, 80)) * 10**9
    pictures = Pictures(80, 80, 0, 0, 0, 100.0, start, start + 10**8, rng.normal(0, 0.02, (80, 3)))
    assert camera_offset("front", pictures, imu).offset_s is None


@pytest.mark.parametrize("offset_s", [-0.5, 0.0, 0.37])
def test_gnss_clock_is_recovered_within_its_sigmas(offset_s: float) -> None:
    imu = simulated_imu()
    times = np.arange(0.5, 59, 0.2)
    rng = np.random.default_rng(1)
    lever = np.einsum("nij,j->ni", true_rotations(times), [0.4, -0.3, 1.5])
    position = true_positions(times) + lever + rng.normal(0, 0.01, (len(times), 3))
    turned = position @ so3.exp([0, 0, 0.9]).T  # the heading at the start is unknown
    stamps = START_NS + np.round((times - offset_s) * 1e9).astype(np.int64)
    gnss = GnssStream(
        "gnss", stamps, turned, np.tile(np.eye(3) * 1e-4, (len(times), 1, 1)), (57.0, 11.0, 0.0)
    )
    time_offset = gnss_offset(gnss, imu)
    assert time_offset.offset_s is not None
    assert time_offset.std_s is not None
    assert abs(time_offset.offset_s - offset_s) < max(4 * time_offset.std_s, 0.02)
    assert time_offset.std_s < 0.2


@given(
    period_ms=st.integers(5, 200),
    lost=st.lists(st.integers(1, 98), max_size=10, unique=True),
)
@settings(max_examples=30)
def test_timing_counts_what_is_missing(period_ms: int, lost: list[int]) -> None:
    stamps = START_NS + np.arange(100) * period_ms * 10**6
    measured = timing(np.delete(stamps, lost))
    assert measured.dropped == len(lost)
    assert measured.rate_hz == pytest.approx(1e3 / period_ms)
    assert measured.jitter_ms == pytest.approx(0.0, abs=1e-6)
    assert (measured.longest_gap_s > 0) == bool(lost)


def test_travel_of_a_circle() -> None:
    times = np.arange(0, 62.8, 0.2)
    position = 10 * np.column_stack([np.cos(0.1 * times), np.sin(0.1 * times), 0 * times])
    stamps = START_NS + np.round(times * 1e9).astype(np.int64)
    path = travel(GnssStream("g", stamps, position, np.zeros((len(times), 3, 3)), (0.0, 0.0, 0.0)))
    assert path is not None
    assert path.path_m == pytest.approx(62.8, rel=0.05)
    assert path.mean_speed == pytest.approx(1.0, rel=0.03)
    assert path.extent_m == pytest.approx(20 * 2**0.5, rel=0.02)


LENS = KannalaBrandt4((120.0, 120.0, 159.5, 119.5, 0.0, 0.0, 0.0, 0.0), 320, 240, None)


def rendered(rotation: NDArray[np.float64]) -> NDArray[np.uint8]:
    """A far scene of smooth random texture, seen by a camera of this world_from_cam."""
    v, u = np.mgrid[0:240, 0:320]
    rays, _ = LENS.unproject(np.column_stack([u.ravel(), v.ravel()]).astype(float))
    world = rays @ rotation.T
    waves = np.random.default_rng(4).normal(0, 14, (40, 3))
    grey = np.nan_to_num(np.sin(world @ waves.T).sum(axis=1))
    return np.clip(128 + 12 * grey, 0, 255).astype(np.uint8).reshape(240, 320)


def test_camera_turn_is_measured_from_two_images() -> None:
    turn = np.array([0.01, -0.03, 0.02])
    start = so3.exp([0.1, 0.2, 0.3])
    measured = camera_rotation(rendered(start), rendered(start @ so3.exp(turn)), LENS)
    assert measured is not None
    assert np.abs(measured - turn).max() < 1e-3


@dataclass(frozen=True, eq=False)
class PlainFrames:
    """Frames of given grey levels; the level None cannot be decoded."""

    levels: Sequence[int | None]
    stamps: NDArray[np.int64]

    def frames(self, indices: Sequence[int] | NDArray[np.int64], *, colour: bool = False) -> Iterator[Frame]:
        for index in indices:
            level = self.levels[index]
            if level is not None:
                yield Frame(int(index), int(self.stamps[index]), np.full((240, 320), level, np.uint8))


def test_bad_pictures_are_found() -> None:
    stamps = START_NS + np.arange(40) * 10**8
    levels: list[int | None] = [100 + k for k in range(40)]
    levels[3:5], levels[10:12], levels[20:23] = [None] * 2, [2, 3], [255] * 3
    camera = CameraStream("front", stamps, PlainFrames(levels, stamps), 320, 240, LENS)
    seen = inspect_recording(Recording(Path("r"), "test", {"front": camera})).pictures["front"]
    assert (seen.sampled, seen.readable, seen.dark, seen.overexposed, seen.frozen) == (40, 38, 2, 3, 2)


def test_a_camera_that_dies_is_found_and_calm_water_is_advised_against() -> None:
    stamps = START_NS + np.arange(600) * 10**8
    levels = [100 + k % 2 for k in range(600)]
    cameras = {
        name: CameraStream(name, stamps[:count], PlainFrames(levels, stamps), 320, 240, LENS)
        for name, count in (("front", 600), ("port", 250))
    }
    calm = simulated_imu()
    calm = replace(calm, gyro=calm.gyro * [0, 0, 1], accel=np.tile([0, 0, 9.81], (len(calm.gyro), 1)))
    inspection = inspect_recording(Recording(Path("r"), "test", cameras, {"imu": calm}))
    assert any(f.sensor == "camera.port" and "records only" in f.message for f in inspection.findings)
    verdict = judge(inspection)
    assert verdict.word == "partly"
    assert any("waves" in line for line in verdict.advice)
    still = replace(calm, gyro=np.zeros_like(calm.gyro))
    verdict = judge(inspect_recording(Recording(Path("r"), "test", cameras, {"imu": still})))
    assert verdict.word == "not enough"
    assert any("Turn through" in line for line in verdict.advice)


def test_euroc_is_inspected(real_recordings: Path) -> None:
    inspection = inspect_recording(open_recording(real_recordings / "euroc_v101_micro"))
    assert inspection.timings["camera.cam0"].rate_hz == pytest.approx(20, rel=1e-3)
    assert inspection.timings["imu.imu0"].rate_hz == pytest.approx(200, rel=1e-3)
    assert inspection.timings["imu.imu0"].samples == 29120
    assert inspection.pictures["cam0"].readable == 50
    assert judge(inspection).word == "not enough"  # two and a half seconds of images
    json.dumps(inspection_to_dict(inspection, judge(inspection)), allow_nan=False)


@pytest.mark.parametrize(
    ("folder", "cameras", "frames", "rate_hz"),
    [("kitti_03_first_300", 1, 300, 10), ("kitti_00_stereo_20", 2, 20, 9.6)],
)
def test_kitti_is_inspected(
    real_recordings: Path, folder: str, cameras: int, frames: int, rate_hz: float
) -> None:
    inspection = inspect_recording(open_recording(real_recordings / folder))
    assert len(inspection.pictures) == cameras
    for key, measured in inspection.timings.items():
        assert key.startswith("camera.")
        assert measured.samples == frames
        assert measured.rate_hz == pytest.approx(rate_hz, rel=0.05)
    assert all(seen.readable == seen.sampled for seen in inspection.pictures.values())


@pytest.mark.slow
def test_husky_bag_is_inspected(real_recordings: Path) -> None:
    inspection = inspect_recording(open_recording(real_recordings / "rosbags" / "husky_imu_odom_gps.bag"))
    assert inspection.timings["imu.imu"].samples == 11865
    assert inspection.timings["imu.imu"].rate_hz == pytest.approx(30, rel=0.05)
    assert inspection.timings["pose.odom"].rate_hz == pytest.approx(10, rel=0.05)
    assert inspection.timings["gnss.gnss"].rate_hz == pytest.approx(2.5, rel=0.1)
    assert inspection.travel is not None
    odometry = inspection.recording.poses["odom"]
    assert inspection.travel.path_m == pytest.approx(odometry.path_length, rel=0.15)


@pytest.mark.slow
def test_harbour_is_enough_and_its_clocks_agree(real_recordings: Path, tmp_path: Path) -> None:
    inspection = inspect_recording(open_recording(real_recordings / "harbour_a" / "harbour_a.bag"))
    assert judge(inspection).word == "enough"
    for key in ("camera.front", "camera.left", "camera.back", "camera.right", "gnss.gps"):
        time_offset = inspection.time_offsets[key]
        assert time_offset.offset_s is not None
        assert time_offset.std_s is not None
        assert abs(time_offset.offset_s) < 4 * time_offset.std_s + 0.002  # the true offsets are zero
    assert inspection.travel is not None
    assert inspection.travel.path_m == pytest.approx(72.3, rel=0.05)
    page = inspection_page(inspection, judge(inspection))
    assert "<script src" not in page
    assert "Path of the antenna" in page


def test_the_command_prints_json_and_refuses_what_is_no_recording(
    real_recordings: Path, tmp_path: Path
) -> None:
    runner = CliRunner()
    bag = real_recordings / "rosbags" / "ardrone_imu.bag"
    page = tmp_path / "page.html"
    printed = runner.invoke(build_app(), ["inspect", str(bag), "--json", "-", "--html", str(page)])
    assert printed.exit_code == 0
    content = json.loads(printed.stdout)
    assert content["verdict"]["word"] == "not enough"
    assert content["sensors"]["imu.imu"]["samples"] == 4308
    assert "When each sensor recorded" in page.read_text()
    assert page.stat().st_size < 1e6
    table = runner.invoke(build_app(), ["inspect", str(bag)])
    assert "Not enough to calibrate" in table.stdout
    assert "next:" in table.stdout
    refused = runner.invoke(build_app(), ["inspect", str(tmp_path)])
    assert refused.exit_code != 0
    assert "is not a recording" in str(refused.exception)


def test_without_cameras_nothing_is_said_of_them() -> None:
    recording = Recording(Path("imu alone"), "folder", imus={"imu": simulated_imu(20.0)})
    checks = {c.name: c for c in judge(inspect_recording(recording)).checks}
    assert checks["cameras"].passed is False
    for name in ("intrinsics", "frame rate and length", "common time", "pictures"):
        assert checks[name].passed is None, name
        assert "no cameras" in checks[name].measured
