"""Small inputs of kinds that users of other tools reported, where a collection of them stands beside the project."""

import os
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest

from rigwake.errors import EstimationError
from rigwake.exporters import read_calibration
from rigwake.geometry import so3
from rigwake.geometry.se3 import SE3
from rigwake.handeye.handeye_problem import HandeyeOptions, in_one_unit
from rigwake.handeye.joint_calibration import calibrate_handeye
from rigwake.readers.open import open_recording
from rigwake.readers.topics import TopicMap
from rigwake.readers.trajectories import read_trajectory
from rigwake.recording import static_transform

X = SE3.from_quat_wxyz([0.458483, -0.450887, 0.583192, -0.496368], [0.8, -0.45, 1.2])


@pytest.fixture(scope="module")
def cases() -> Path:
    """RIGWAKE_CASES, or ../shared/cases beside the project; else skip."""
    beside = Path(__file__).resolve().parent.parent.parent / "shared" / "cases"
    folder = Path(os.environ.get("RIGWAKE_CASES", beside))
    if not folder.is_dir():
        pytest.skip("no collection of cases here: set RIGWAKE_CASES to its folder")
    return folder


def case(cases: Path, number: int) -> Path:
    (folder,) = cases.glob(f"{number:02d}_*")
    return folder


TRAJECTORIES = [
    *((1, "cam.tum"), (2, "cam.tum"), (3, "cam.csv"), (6, "cam.txt"), (9, "cam_mm.tum"), (11, "c200.tum")),
    *((4, name) for name in ("cam_ms.tum", "cam_us.tum", "cam_orbslam3.txt", "cam_savetxt_ns.txt")),
    *((5, name) for name in ("ov_estimate.txt", "vio.csv", "vins_loop.csv", "okvis.csv", "echo_p.csv")),
    *((5, name) for name in ("kitti360_poses.txt", "t_4x4.txt")),
    *((38, "held.tum"), (39, "nan60.tum")),
]


@pytest.mark.slow
@pytest.mark.parametrize(("number", "name"), TRAJECTORIES)
def test_mountings_of_other_tools_trajectories(cases: Path, number: int, name: str) -> None:
    folder = case(cases, number)
    reference = read_trajectory(folder / "ref.tum").trajectory
    member, _ = in_one_unit(reference, read_trajectory(folder / name).trajectory)
    (camera,) = calibrate_handeye(reference, [member]).members.values()
    turned = so3.log(X.rotation.T @ camera.rig_from_cam.rotation)
    assert np.degrees(np.linalg.norm(turned)) < 0.01
    np.testing.assert_allclose(camera.rig_from_cam.translation, X.translation, atol=0.015)
    if name != "kitti360_poses.txt":  # frame numbers: its clock starts at 0
        assert camera.time_offset_s == pytest.approx(0.0, abs=1e-3)


def test_two_boats(cases: Path) -> None:
    folder = case(cases, 8)
    one, other = (read_trajectory(folder / f"{name}.tum").trajectory for name in ("ref", "other"))
    with pytest.raises(EstimationError, match="one rigid body"):
        calibrate_handeye(one, [other], HandeyeOptions(time_offset=False))


@pytest.mark.parametrize("name", ["bom", "comment", "cut", "prefix", "tag", "ubx"])
def test_nmea_as_logged(cases: Path, name: str) -> None:
    gnss = open_recording(case(cases, 28) / f"{name}.nmea").gnss["gnss"]
    assert len(gnss.timestamps_ns) == 20
    np.testing.assert_allclose(gnss.position_enu[-1, :2], [2.52, 2.11], atol=0.01)


@pytest.mark.parametrize("name", ["a", "b"])
def test_nmea_dates(cases: Path, name: str) -> None:
    stamps = open_recording(case(cases, 27) / f"{name}.nmea").gnss["gnss"].timestamps_ns
    assert datetime.fromtimestamp(int(stamps[0]) // 10**9, UTC) == datetime(
        2023, 11, 14, 23, 59, 58, tzinfo=UTC
    )


@pytest.mark.parametrize(
    ("name", "count", "std_m"), [("hdop", 20, 5.0), ("two", 20, 0.012), ("dr", 17, 0.012), ("rtk", 20, 0.012)]
)
def test_nmea_qualities(cases: Path, name: str, count: int, std_m: float) -> None:
    gnss = open_recording(case(cases, 29) / f"{name}.nmea").gnss["gnss"]
    assert len(gnss.timestamps_ns) == count
    assert np.sqrt(gnss.covariances[0, 0, 0]) == pytest.approx(std_m)
    assert np.abs(np.diff(gnss.position_enu, axis=0)).max() < 1.0


@pytest.mark.parametrize(
    ("path", "span_s"),
    [
        *((f"32_names_that_are_stamps/{form}", 0.3) for form in ("seconds", "ms", "prefix", "sec_nsec")),
        ("32_names_that_are_stamps/counter16", 0.9),
        ("31_h264_avi/rec", 29 / 30),
        ("33_kalibr_bagextractor/rec", 0.3),
        ("34_lens_file_cannot_be_given/rec", 0.9),
        ("36_folder_image_types/rec", 0.9),
    ],
)
def test_folders(cases: Path, path: str, span_s: float) -> None:
    recording = open_recording(cases / path)
    (camera,) = recording.cameras.values()
    stamps = camera.timestamps_ns
    assert (stamps[-1] - stamps[0]) * 1e-9 == pytest.approx(span_s, abs=2e-3)
    assert len(list(camera.frames())) == len(camera) == (30 if "avi" in path else 10)
    if "kalibr" in path:
        imu = recording.imus["imu0"]
        assert len(imu.timestamps_ns) == 130
        np.testing.assert_allclose([imu.gyro[0, 2], imu.accel[0, 2]], [0.3, 9.81])
    if "lens" in path:
        assert camera.model is not None


@pytest.mark.parametrize(("name", "count", "last_en"), [("altnan", 50, (32.485, 54.535)), ("zero", 45, None)])
def test_fixes_without_height_or_position(
    cases: Path, name: str, count: int, last_en: tuple[float, float] | None
) -> None:
    """Without a height the plane may lie anywhere between 0 and 40 m: 0.2 mm east, which rounds to 32.48 or 32.49."""
    gnss = open_recording(case(cases, 26) / f"{name}.bag").gnss["gnss"]
    assert len(gnss.timestamps_ns) == count
    if last_en is None:
        np.testing.assert_allclose(gnss.origin_lla, (53.54005, 9.98005, 40.0))
    else:
        np.testing.assert_allclose(gnss.position_enu[-1, :2], last_en, atol=1e-3)
        assert (gnss.covariances[:, 2, 2] > 1e5).all()


@pytest.mark.parametrize("name", ["gnss", "imu_cam"])
def test_a_clock_that_was_set(cases: Path, name: str) -> None:
    recording = open_recording(case(cases, 40) / f"{name}.bag")
    assert any("stamps jump by 1.7e+09 s" in f.message for f in recording.findings)
    for stream in [*recording.cameras.values(), *recording.imus.values(), *recording.gnss.values()]:
        assert np.ptp(stream.timestamps_ns) * 1e-9 == pytest.approx(27, abs=0.3)


CAMERAS = {
    "12_camera_info_of_common_drivers/oak_rgb.bag": {"oak": (8, (100, 100, 80, 60))},
    "12_camera_info_of_common_drivers/openni.bag": {"camera": (8, (100, 100, 80, 60))},
    "12_camera_info_of_common_drivers/realsense_color.bag": {"camera": (8, (100, 100, 80, 60))},
    "12_camera_info_of_common_drivers/realsense_infra1.bag": {"infra1": (8, (100, 100, 80, 60))},
    "12_camera_info_of_common_drivers/usb_cam_ros2.bag": {"image_raw": (8, (100, 100, 80, 60))},
    "12_camera_info_of_common_drivers/zed_raw.bag": {"left_raw": (8, (100, 100, 80, 60))},
    "13_depth_taken_for_camera/rs.bag": dict.fromkeys(("color", "infra1", "infra2"), (8, (100, 100, 80, 60))),
    "14_two_cameras_become_one/two.bag": dict.fromkeys(("color", "rgb"), (8, (100, 100, 80, 60))),
    "15_rectified_images/rect.bag": {"front": (8, (88, 89, 79, 61))},
    "16_binning_and_roi/bin2.bag": {"front": (5, (100, 100, 79.75, 59.75))},
    "16_binning_and_roi/roi.bag": {"front": (5, (200, 200, 80, 60))},
    "17_camera_info_changes/k0_then.bag": {"front": (8, (100, 100, 80, 60))},
    "17_camera_info_changes/zoom.bag": {"front": (8, None)},
    **{
        f"18_image_encodings/{name}.bag": {"front": (count, (100, 100, 80, 60))}
        for name, count in (("jpeg_padded", 3), ("mono16_12bit", 6), ("nv12", 6), ("uyvy", 6), ("yuy2", 6))
    },
    "20_rosbag2_no_metadata/rec": {"front": (20, (100, 100, 80, 60))},
    "21_mcap_message_compression/r2mz": {"front": (20, (100, 100, 80, 60))},
    "22_same_topic_two_types/tt.bag": {"front": (10, (100, 100, 80, 60))},
    "37_driver_restarted/aba.bag": {"front": (10, (100, 100, 80, 60))},
}
SAID = {
    "zoom": "its lens changes",
    "tt": "of two types",
    "rec": "metadata.yaml is missing",
    "rs": "holds distances",
}


@pytest.mark.parametrize("path", CAMERAS)
def test_cameras_of_bags(cases: Path, path: str) -> None:
    recording = open_recording(cases / path)
    assert sorted(recording.cameras) == sorted(CAMERAS[path])
    for name, (count, lens) in CAMERAS[path].items():
        camera = recording.cameras[name]
        levels = [frame.image.mean() for frame in camera.frames()]
        assert len(levels) == len(camera) == count
        assert levels[0] == pytest.approx(139.3, abs=0.5)
        assert (camera.model is None) == (lens is None)
        if lens is not None and camera.model is not None:
            assert camera.model.params[:4] == pytest.approx(lens)
            assert not camera.model.params[4:].any()
    said = " ".join(finding.message for finding in recording.findings)
    assert SAID.get(Path(path).stem, "") in said
    assert "time goes back" not in said


def test_halves_of_an_imu_and_transforms(cases: Path) -> None:
    imu = open_recording(case(cases, 23) / "split.bag").imus["imu"]
    assert len(imu.timestamps_ns) == 596
    assert imu.accel[0, 2] == pytest.approx(9.81)
    for name, expected in (("chain", (1, 0, 2)), ("slash", (1, 0, 0))):
        recording = open_recording(case(cases, 30) / f"{name}.bag")
        found = static_transform(recording, "base_link", recording.imus["imu"].frame_id)
        assert found is not None
        np.testing.assert_allclose(found.translation, expected)


def test_a_lens_is_handed_over(cases: Path) -> None:
    folder = case(cases, 34)
    assert open_recording(folder / "k0.bag").camera("front").model is None
    topics = TopicMap.from_options((), None, [f"front={folder / 'front.yaml'}"])
    assert open_recording(folder / "k0.bag", topics).camera("front").model is not None


def test_units_of_a_header(cases: Path) -> None:
    (imu,) = open_recording(case(cases, 25) / "rec").imus.values()
    np.testing.assert_allclose(imu.gyro[:, 2], np.radians(0.1))
    np.testing.assert_allclose(imu.accel[:, 2], 9.80665)


def test_camchains(cases: Path) -> None:
    folder = case(cases, 35)
    reference = read_calibration(folder / "ref.yaml")
    for name in ("sci.yaml", "partial.yaml", "camchain.txt", "lens.yaml"):
        calibration = read_calibration(folder / name)
        for camera, expected in zip(calibration.cameras.values(), reference.cameras.values(), strict=True):
            np.testing.assert_allclose(camera.rig_from_cam.matrix, expected.rig_from_cam.matrix, atol=1e-9)
    assert read_calibration(folder / "sci.yaml").camera("cam0").time_offset_s == -1e-5
