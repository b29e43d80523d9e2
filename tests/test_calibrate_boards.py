"""Camera, camera and IMU from board corners, in the solver of the rig; figures of `benchmarks/imu_board.py`."""

import runpy
from pathlib import Path

import pytest

BENCHMARK = runpy.run_path(str(Path(__file__).parent.parent / "benchmarks" / "imu_board.py"))


@pytest.mark.slow
def test_two_cameras_and_an_imu_before_a_board(real_recordings):
    adjusted = BENCHMARK["calibrate_boards"](real_recordings)
    off = BENCHMARK["degrees_and_mm"]
    cameras = {camera.name: camera for camera in adjusted.solution.problem.cameras}
    for name, published in BENCHMARK["PUBLISHED"].items():
        degrees, millimetres = off(published.inverse() * cameras[name].rig_from_cam)
        assert degrees < 0.3
        assert millimetres < 5.0
        assert abs(cameras[name].time_offset_s) < 1e-3
    pair = cameras["cam0"].rig_from_cam.inverse() * cameras["cam1"].rig_from_cam
    degrees, millimetres = off(BENCHMARK["EUROC_CAM0_FROM_CAM1"].inverse() * pair)
    assert degrees < 0.05
    assert millimetres < 3.0
