"""Folder formats and logs: EuRoC and TUM-VI, KITTI odometry and raw, plain folders, videos, NMEA."""

import pickle
from pathlib import Path

import av
import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pyproj import Transformer

from rigwake.geometry import so3
from rigwake.geometry.geodesy import enu_from_lla, lla_from_enu
from rigwake.geometry.se3 import SE3
from rigwake.readers.open import open_recording
from rigwake.readers.stamp_units import stamps_from_text
from rigwake.readers.streams import time_order, unit_quaternions
from rigwake.writers.folders import write_folder


def test_euroc_holds_the_published_rig(real_recordings: Path) -> None:
    recording = open_recording(real_recordings / "euroc_v101_micro")
    assert recording.kind == "euroc folder"
    assert {name: len(camera) for name, camera in recording.cameras.items()} == {"cam0": 50, "cam1": 50}
    assert recording.true_rig is not None
    between = (
        recording.true_rig.camera("cam0").rig_from_cam.inverse()
        * recording.true_rig.camera("cam1").rig_from_cam
    )
    assert np.linalg.norm(between.translation) == pytest.approx(0.110, abs=0.001)  # the stereo baseline
    imu = recording.imus["imu0"]
    assert imu.gyro_noise_density == 1.6968e-4
    assert imu.accel_bias_walk == 3e-3
    model = recording.camera("cam0").model
    assert model is not None
    assert model.params[:4].tolist() == [458.654, 457.296, 367.215, 248.375]


def test_kitti_stereo_baseline_and_truth(real_recordings: Path) -> None:
    recording = open_recording(real_recordings / "kitti_00_stereo_20")
    assert recording.true_rig is not None
    assert recording.true_rig.camera("image_1").rig_from_cam.translation == pytest.approx(
        [0.5372, 0, 0], abs=1e-4
    )
    assert len(recording.true_trajectories["image_0"]) == 20
    frames = list(pickle.loads(pickle.dumps(recording.camera("image_1"))).frames([0, 19]))
    assert [frame.image.shape for frame in frames] == [(376, 1241)] * 2


def write_png(path: Path, level: int = 100) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(path), np.full((24, 40), level, np.uint8))


def test_kitti_raw_drive(tmp_path: Path) -> None:
    drive = tmp_path / "2011_09_26" / "drive_0001_sync"
    stamps = [f"2011-09-26 13:02:25.{k}00000000" for k in range(5)]
    for camera in ("image_00", "image_01"):
        for k in range(5):
            write_png(drive / camera / "data" / f"{k:010d}.png", 50 + k)
        (drive / camera / "timestamps.txt").write_text("\n".join(stamps) + "\n")
    (drive / "oxts" / "data").mkdir(parents=True)
    (drive / "oxts" / "timestamps.txt").write_text("\n".join(stamps) + "\n")
    for k in range(5):
        values = np.zeros(30)
        values[:6] = 49.0, 8.4 + 1e-5 * k, 110.0, 0.01, -0.02, 0.5
        values[6:11] = 1.0, 2.0, 0, 0, 0.1
        values[11:14], values[17:20], values[23] = [0.1, 0.2, 9.8], [0.01, 0.02, 0.03], 0.05
        (drive / "oxts" / "data" / f"{k:010d}.txt").write_text(" ".join(f"{value:.12f}" for value in values))
    identity = "1 0 0 0 1 0 0 0 1"
    projections = [f"30 0 20 {offset} 0 30 12 0 0 0 1 0" for offset in (0, -15)]
    (drive.parent / "calib_cam_to_cam.txt").write_text(
        f"R_rect_00: {identity}\nP_rect_00: {projections[0]}\nP_rect_01: {projections[1]}\ncalib_time: 09-Jan-2012\n"
    )
    axes = "0 -1 0 0 0 -1 1 0 0"  # camera axes of the vehicle's
    (drive.parent / "calib_velo_to_cam.txt").write_text(f"R: {axes}\nT: 0 0 0\n")
    (drive.parent / "calib_imu_to_velo.txt").write_text(f"R: {identity}\nT: 0 0 -0.5\n")
    recording = open_recording(drive)
    assert recording.kind == "kitti raw"
    assert recording.findings == ()
    camera = recording.camera("image_01")
    assert camera.timestamps_ns[1] - camera.timestamps_ns[0] == 10**8
    assert int(camera.timestamps_ns[0]) == 1_317_042_145_000_000_000
    assert recording.true_rig is not None
    # 0.5 m to the right of the first camera is -y of the vehicle; the velodyne sits 0.5 m below the IMU's origin
    assert recording.true_rig.camera("image_01").rig_from_cam.translation == pytest.approx([0, -0.5, 0.5])
    assert recording.imus["oxts"].gyro[0].tolist() == [0.01, 0.02, 0.03]
    assert recording.gnss["oxts"].velocity_enu is not None
    assert recording.gnss["oxts"].velocity_enu[0].tolist() == [2.0, 1.0, 0.1]
    assert recording.gnss["oxts"].position_enu[4, 0] == pytest.approx(4 * 0.731, rel=0.01)
    expected = so3.exp([0, 0, 0.5]) @ so3.exp([0, -0.02, 0]) @ so3.exp([0.01, 0, 0])
    assert np.allclose(recording.attitudes["oxts"].world_from_body[0], expected)


def test_tum_vi_folder_takes_its_lenses_from_the_kalibr_chain(tmp_path: Path) -> None:
    for k in range(3):
        write_png(tmp_path / "mav0" / "cam0" / "data" / f"{10**18 + k}.png")
    rows = "".join(f"{10**18 + k},{10**18 + k}.png\n" for k in range(3))
    (tmp_path / "mav0" / "cam0" / "data.csv").write_text("#timestamp [ns],filename\n" + rows)
    (tmp_path / "dso").mkdir()
    cam_from_imu = SE3.exp([0.1, 0.2, 0.3, 1.0, 2.0, 3.0])
    (tmp_path / "dso" / "camchain.yaml").write_text(
        "cam0:\n  camera_model: pinhole\n  intrinsics: [30, 31, 20, 12]\n  distortion_model: equidistant\n"
        "  distortion_coeffs: [0.01, 0.02, 0.0, 0.0]\n  resolution: [40, 24]\n"
        f"  T_cam_imu: {cam_from_imu.matrix.tolist()}\n"
    )
    recording = open_recording(tmp_path)
    camera = recording.camera("cam0")
    assert camera.model is not None
    assert camera.model.model == "kb4"
    assert camera.timestamps_ns.tolist() == [10**18, 10**18 + 1, 10**18 + 2]
    assert recording.true_rig is not None
    assert np.abs(recording.true_rig.camera("cam0").rig_from_cam.local(cam_from_imu.inverse())).max() < 1e-9


def write_video(path: Path, levels: list[int], rate: int = 10) -> None:
    with av.open(str(path), "w") as container:
        stream = container.add_stream("mpeg4", rate=rate)
        stream.width, stream.height, stream.pix_fmt, stream.gop_size = 64, 48, "yuv420p", 12
        for level in levels:
            picture = av.VideoFrame.from_ndarray(np.full((48, 64, 3), level, np.uint8), format="bgr24")
            container.mux(stream.encode(picture))
        container.mux(stream.encode())


def test_a_video_is_read_in_order_and_at_random(tmp_path: Path) -> None:
    levels = [30 + 37 * k % 190 for k in range(100)]  # neighbours differ by tens
    write_video(tmp_path / "port.mp4", levels)
    recording = open_recording(tmp_path)
    camera = recording.camera("port")
    assert len(camera) == 100
    assert camera.timestamps_ns[:3].tolist() == [0, 10**8, 2 * 10**8]
    measured = [frame.image.mean() for frame in camera.frames(colour=True)]
    assert np.abs(np.array(measured) - levels).max() < 15
    some = list(pickle.loads(pickle.dumps(camera)).frames([2, 3, 90, 99]))
    assert [frame.index for frame in some] == [2, 3, 90, 99]
    assert [frame.image.mean() for frame in some] == pytest.approx(
        [levels[k] for k in (2, 3, 90, 99)], abs=15
    )
    assert some[0].image.shape == (48, 64)


def test_a_video_takes_its_stamps_from_a_table(tmp_path: Path) -> None:
    write_video(tmp_path / "port.mp4", [50] * 10)
    stamps = [1_700_000_000_000_000_000 + k * 10**8 for k in range(10)]
    (tmp_path / "port_timestamps.csv").write_text("timestamp_ns\n" + "\n".join(map(str, stamps)) + "\n")
    assert open_recording(tmp_path).camera("port").timestamps_ns.tolist() == stamps


def checked(sentence: str) -> str:
    checksum = 0
    for character in sentence:
        checksum ^= ord(character)
    return f"${sentence}*{checksum:02X}\r\n"


def test_nmea_log_over_midnight(tmp_path: Path) -> None:
    path = tmp_path / "log.nmea"
    lines = [
        checked("GPRMC,235958.00,A,5741.4,N,01154.0,E,2.0,90.0,311223,,,A"),
        checked("GPGGA,235959.00,5741.4000,N,01154.0000,E,4,12,0.7,2.0,M,38.0,M,,"),
        checked("GPGST,235959.00,0.1,0.1,0.1,0.0,0.02,0.01,0.05"),
        checked("HEHDT,90.0,T"),
        checked("GPGGA,000000.50,5741.4006,N,01154.0000,E,4,12,0.7,2.0,M,38.0,M,,"),
        "$GPGGA,000001.50,5741.4006,N*00\r\n",
        checked("GPGGA,000002.00,,,,,0,,,,M,,M,,"),
        checked("GPRMC,000001.00,A,5741.4,N,01154.0,E,2.0,90.0,010124,,,A"),
    ]
    path.write_text("".join(lines))
    recording = open_recording(path)
    gnss = recording.gnss["gnss"]
    assert gnss.timestamps_ns.tolist() == [1_704_067_199_000_000_000, 1_704_067_200_500_000_000]
    assert gnss.origin_lla == pytest.approx((57.69, 11.9, 40.0))
    assert gnss.position_enu[1] == pytest.approx([0, 1.114, 0], abs=0.01)
    assert np.sqrt(np.diag(gnss.covariances[0])) == pytest.approx([0.01, 0.02, 0.05])
    heading = recording.attitudes["heading"]
    assert np.allclose(heading.world_from_body[0], np.eye(3), atol=1e-12)  # heading 90 deg is east
    assert any("damaged" in finding.message for finding in recording.findings)


@given(
    latitude=st.floats(-89, 89),
    longitude=st.floats(-180, 180),
    height=st.floats(-100, 5000),
    offset=st.tuples(st.floats(-1e4, 1e4), st.floats(-1e4, 1e4), st.floats(-500, 500)),
)
@settings(max_examples=40)
def test_geodesy_round_trip(
    latitude: float, longitude: float, height: float, offset: tuple[float, float, float]
) -> None:
    origin = (latitude, longitude, height)
    there = lla_from_enu(np.array(offset), origin)
    assert np.abs(enu_from_lla(there, origin)[0] - offset).max() < 1e-5
    assert np.abs(enu_from_lla([origin], origin)).max() < 1e-6
    assert enu_from_lla([(latitude, longitude, height + 3)], origin)[0] == pytest.approx([0, 0, 3], abs=1e-5)


@pytest.mark.parametrize(
    "origin", [(0.0, 0.0, 0.0), (53.5, 9.9, 40.0), (-77.8, 166.7, 2800.0), (90.0, 0.0, 0.0)]
)
def test_geodesy_agrees_with_proj(origin: tuple[float, float, float]) -> None:
    """To a micrometre over 200 km around."""
    proj = Transformer.from_pipeline(
        "+proj=pipeline +step +proj=unitconvert +xy_in=deg +xy_out=rad +step +proj=cart +ellps=WGS84 +step "
        "+proj=topocentric +ellps=WGS84 +lat_0={!r} +lon_0={!r} +h_0={!r}".format(*origin)
    )
    position = np.random.default_rng(3).normal(size=(40, 3)) * [1e5, 1e5, 1e3]
    there = lla_from_enu(position, origin)
    by_proj = np.column_stack(proj.transform(there[:, 1], there[:, 0], there[:, 2]))
    assert np.abs(by_proj - position).max() < 1e-6
    assert np.abs(enu_from_lla(there, origin) - by_proj).max() < 1e-6


@given(st.lists(st.integers(0, 50), min_size=1, max_size=30))
@settings(max_examples=60)
def test_time_order_sorts_and_says_so(stamps: list[int]) -> None:
    order, findings = time_order("imu", np.array(stamps, dtype=np.int64))
    assert np.array(stamps)[order].tolist() == sorted(set(stamps))
    assert bool(findings) == (stamps != sorted(set(stamps)))


@pytest.mark.parametrize(
    ("text", "unit", "expected"),
    [
        ("1700000000.123456789", "", 1_700_000_000_123_456_789),
        ("1700000000123", "", 1_700_000_000_123_000_000),
        ("1700000000123456", "", 1_700_000_000_123_456_000),
        ("1700000000123456789", "", 1_700_000_000_123_456_789),
        ("1.5", "ms", 1_500_000),
        ("12", "ns", 12),
        ("nan", "", -1),
        ("1e400", "", -1),
        ("-3", "s", -1),
        ("noon", "", -1),
    ],
)
def test_stamps_of_any_unit_are_exact(text: str, unit: str, expected: int) -> None:
    assert stamps_from_text([text], unit).tolist() == [expected]


def test_quaternions_that_are_none_become_nan() -> None:
    given_quaternions = np.array(
        [[1, 0, 0, 0], [0, 0, 0, 0], [1e300, 0, 0, 0], [np.nan, 0, 0, 1], [0.6, 0.8, 0, 0]]
    )
    assert np.isnan(unit_quaternions(given_quaternions)).any(axis=1).tolist() == [
        False,
        True,
        True,
        True,
        False,
    ]


@pytest.mark.parametrize(
    ("settings", "gyro"),
    [
        ("imu: {gyro_noise_density: 2e-4, accel_noise_density: 0.003}", 2e-4),
        ("imu: {gyroscope_noise_density: 0.0002, accelerometer_noise_density: 3.0e-3, rate: 100}", 2e-4),
        ("imu: {imu: {gyro_noise_density: 0.0002, accel_noise_density: 0.003}, imu_port: {}}", 2e-4),
        ("imu: {imu_port: {gyro_noise_density: 0.0002}}", None),
        ("cameras: {}", None),
    ],
)
def test_the_imu_noise_of_rig_yaml_is_read(tmp_path: Path, settings: str, gyro: float | None) -> None:
    (tmp_path / "imu.csv").write_text(
        "timestamp_ns,gyro_x,gyro_y,gyro_z,accel_x,accel_y,accel_z\n0,0,0,0,0,0,9.8\n10000000,0,0,0,0,0,9.8\n"
    )
    (tmp_path / "rig.yaml").write_text(settings + "\n")
    recording = open_recording(tmp_path)
    assert recording.imus["imu"].gyro_noise_density == gyro
    assert recording.imus["imu"].accel_noise_density == (None if gyro is None else 0.003)
    write_folder(recording, tmp_path / "copy")
    assert open_recording(tmp_path / "copy").imus["imu"].gyro_noise_density == gyro


def test_settings_that_nobody_reads_are_named(tmp_path: Path) -> None:
    (tmp_path / "imu.csv").write_text(
        "timestamp_ns,gyro_x,gyro_y,gyro_z,accel_x,accel_y,accel_z\n0,0,0,0,0,0,9.8\n10000000,0,0,0,0,0,9.8\n"
    )
    (tmp_path / "rig.yaml").write_text("cameras: {}\nimu: {gyro_density: 1.0}\nnoise: {gyro: 1}\n")
    messages = " ".join(finding.message for finding in open_recording(tmp_path).findings)
    assert "gyro_density" in messages
    assert "noise not read" in messages
    (tmp_path / "rig.yaml").write_text("imu: {gyro_noise_density: -1.0}\n")
    (tmp_path / "gnss.csv").write_text(
        "timestamp_ns,latitude,longitude,altitude\n0,57,11,0\n1000000000,57,11,0\n"
    )
    assert "positive" in " ".join(finding.message for finding in open_recording(tmp_path).findings)
