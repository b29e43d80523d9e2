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
from rigwake.handeye.handeye_result import HandeyeOptions
from rigwake.handeye.joint_calibration import calibrate_handeye
from rigwake.handeye.one_body import in_one_unit
from rigwake.readers.open import open_recording
from rigwake.readers.trajectories import read_trajectory

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


@pytest.mark.parametrize(
    ("name", "count", "last_en"), [("altnan", 50, (32.485, 54.535)), ("zero", 45, None)]
)
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
