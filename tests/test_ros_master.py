"""The node in a real ROS 1 graph: rosmaster on loopback, `rosbag play`, tf2, diagnostics, and what breaks on board."""

from __future__ import annotations

import subprocess
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import psutil
import pytest

from basin_recording import basin, basin_recording
from calibrated_rigs import boat
from cli_runs import run
from rigwake.calibration import CalibratedCamera, Calibration, load_calibration, save_calibration
from rigwake.config import load_config
from rigwake.geometry import so3
from rigwake.pipeline.calibration_run import calibrate
from rigwake.readers.open import open_recording
from rigwake.recording import Recording
from rigwake.tracks import load_tracks
from rigwake.writers.write import write_recording
from ros_graph import PLAYER, RosGraph, missing

pytestmark = [pytest.mark.slow, pytest.mark.xdist_group("ros")]


@pytest.fixture(scope="module")
def ros() -> None:
    why = missing() or ("" if PLAYER.exists() else str(PLAYER))
    if why:
        pytest.skip(f"ROS 1 is not installed here: {why} (python3-rospy, python3-tf2-ros, python3-rosbag)")


@pytest.fixture
def graph(ros: None, tmp_path: Path) -> Iterator[RosGraph]:
    opened = RosGraph(tmp_path)
    yield opened
    opened.close()


@pytest.fixture(scope="module")
def bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("bag")
    write_recording(basin_recording(basin(), folder / "memory"), folder / "sail.bag", image_encoding="png")
    return folder / "sail.bag"


def until(look: Callable[[], Any], wanted: Callable[[Any], bool], seconds: float = 60.0) -> Any:
    end = time.monotonic() + seconds
    while not wanted(seen := look()):
        assert time.monotonic() < end, seen
        time.sleep(0.3)
    return seen


def test_played_recorded_calibrated_published(graph: RosGraph, bag: Path, tmp_path: Path) -> None:
    """What comes through ROS calibrates as the file does: the same tracks to the bit, the same rig; tf2 finds it."""
    graph.start_node("--out", tmp_path / "out")
    assert graph.look("record", "on")[0]
    player = graph.play(bag, "--wait-for-subscribers", "--delay=1", "--rate=2")
    player.wait(120)
    time.sleep(1.0)
    seen = graph.look("diagnostics")
    assert "messages" in seen["recording"][1]
    assert seen["recording"][2]["dropped"] == "0"
    assert any(
        (name.endswith("image_raw/compressed") and "rate_hz" in v[2]) or v[0] == 3 for name, v in seen.items()
    )
    done, words = graph.look("calibrate")
    assert done, words
    again, why = graph.look("calibrate")
    assert (again, "already calibrating" in why) == (False, True)
    until(
        lambda: graph.look("diagnostics")["calibration"], lambda s: "on /tf_static" in s[1] or s[0] == 2, 180
    )
    (recorded,) = (tmp_path / "out").glob("*.bag")
    assert_same_recording(open_recording(recorded), open_recording(bag))
    (result,) = (tmp_path / "out").glob("*_calibration")
    found = load_calibration(result / "calibration.yaml")
    offline = calibrate(bag, tmp_path / "offline", load_config(jobs=1)).calibration
    for name, camera in offline.cameras.items():
        ours, theirs = (load_tracks(f / "tracks" / f"{name}.npz") for f in (result, tmp_path / "offline"))
        np.testing.assert_array_equal(ours.pixels, theirs.pixels)
        np.testing.assert_allclose(
            found.cameras[name].rig_from_cam.matrix, camera.rig_from_cam.matrix, atol=1e-9
        )
        quat, place = graph.look("tf", found.reference, f"{name}_optical_frame")
        np.testing.assert_allclose(place, camera.rig_from_cam.translation, atol=1e-6)
        np.testing.assert_allclose(
            so3.matrix_from_quat_wxyz(np.array(quat)), camera.rig_from_cam.rotation, atol=1e-6
        )


def assert_same_recording(ours: Recording, theirs: Recording) -> None:
    """Every sensor as the file has it: lenses to how far they reach, stamps, samples, noise."""
    for name, camera in theirs.cameras.items():
        np.testing.assert_array_equal(ours.cameras[name].timestamps_ns, camera.timestamps_ns)
        assert ours.cameras[name].model == camera.model
    for name, imu in theirs.imus.items():
        np.testing.assert_array_equal(ours.imus[name].timestamps_ns, imu.timestamps_ns)
        assert ours.imus[name].gyro_noise_density == imu.gyro_noise_density
    for name, fixes in theirs.gnss.items():
        np.testing.assert_array_equal(ours.gnss[name].position_enu, fixes.position_enu)


def test_survives_a_master_restart_and_a_camera_that_dies_and_returns(
    graph: RosGraph, bag: Path, tmp_path: Path
) -> None:
    save_calibration(boat(), tmp_path / "c.yaml")
    graph.start_node("--out", tmp_path / "out", "--calibration", tmp_path / "c.yaml")
    assert graph.look("record", "on")[0]
    graph.end(graph.master)
    time.sleep(1.5)
    graph.start_master()
    name = next(iter(boat().cameras))
    quat, _ = until(
        lambda: _tf(graph, boat().reference, f"{name}_optical_frame"), lambda t: t is not None, 30
    )
    np.testing.assert_allclose(
        so3.matrix_from_quat_wxyz(np.array(quat)), boat().cameras[name].rig_from_cam.rotation, atol=1e-6
    )
    counts = []
    for _ in range(2):
        player = graph.play(bag, "--delay=3", "--duration=4")  # dies, and returns with the next
        player.wait(60)
        counts.append(int(graph.look("diagnostics")["recording"][2]["messages"]))
    assert 0 < counts[0] < counts[1]
    silent = until(
        lambda: graph.look("diagnostics"),
        lambda s: any(v[0] == 3 and "silent" in v[1] for v in s.values()),
        20,
    )
    assert any(name.endswith("compressed") for name in silent)
    assert graph.look("record", "off")[0]


def _tf(graph: RosGraph, parent: str, child: str) -> Any:
    try:
        return graph.look("tf", parent, child)
    except RuntimeError:
        return None


def test_whoever_looks_gets_the_surround_view(graph: RosGraph, bag: Path, tmp_path: Path) -> None:
    """Another node subscribes, and a panorama comes; before, nothing was drawn."""
    simulated = basin()
    cameras = {
        name: CalibratedCamera(name, c.rig_from_cam, np.eye(6) * 1e-8, model=c.model)
        for name, c in simulated.rig.cameras.items()
    }
    save_calibration(Calibration("base_link", cameras), tmp_path / "c.yaml")
    graph.start_node("--out", tmp_path / "out", "--calibration", tmp_path / "c.yaml")
    assert graph.look("record", "off")[0]  # it is there
    graph.play(bag, "--loop", "--delay=1")
    assert "surround" not in graph.look("diagnostics")
    frame_id, stamp_ns, kind, jpeg = graph.look("surround")
    assert (frame_id, kind) == ("base_link", "jpeg")
    stamps = open_recording(bag).cameras["front"].timestamps_ns
    assert stamps[0] - 10**8 <= stamp_ns <= stamps[-1] + 10**8
    picture = cv2.imdecode(np.frombuffer(bytes.fromhex(jpeg), np.uint8), cv2.IMREAD_COLOR)
    assert picture.shape == (500, 1600, 3)
    assert picture.std() > 20
    assert "rigwake/surround/compressed" not in str(graph.look("diagnostics"))  # it does not record itself


def test_a_clock_that_jumps_back(graph: RosGraph, bag: Path, tmp_path: Path) -> None:
    """use_sim_time, and a bag played twice: two bags, each whole in itself."""
    set_param = "import rosgraph; rosgraph.Master('/x').setParam('use_sim_time', True)"
    graph.start("/usr/bin/python3", "-c", set_param).wait(20)
    graph.start_node("--out", tmp_path / "out", "--record")
    time.sleep(5.0)
    for _ in range(2):
        graph.play(bag, "--clock", "--delay=3", "--duration=5").wait(60)
    time.sleep(1.0)
    assert graph.look("record", "off")[0]
    bags = sorted((tmp_path / "out").glob("*.bag"))
    assert len(bags) >= 2
    lengths = [_stamps(path) for path in bags if _stamps(path) is not None]
    assert len(lengths) >= 2
    for stamps in lengths:
        assert (np.diff(stamps) > 0).all()


def _stamps(path: Path) -> Any:
    cameras = open_recording(path).cameras
    return next(iter(cameras.values())).timestamps_ns if cameras else None


def test_memory_is_flat_while_it_records(graph: RosGraph, bag: Path, tmp_path: Path) -> None:
    """A short form of the soak in benchmarks/ros_soak.py."""
    node = graph.start_node("--out", tmp_path / "out", "--record")
    time.sleep(4.0)
    player = graph.play(bag, "--loop", "--rate=3")
    time.sleep(8.0)
    before = psutil.Process(node.pid).memory_info().rss
    time.sleep(12.0)
    after = psutil.Process(node.pid).memory_info().rss
    graph.end(player)
    assert after - before < 20 << 20


def test_the_launch_file_starts_it(graph: RosGraph, tmp_path: Path) -> None:
    import sys

    import rigwake

    package = Path(rigwake.__file__).parent / "ros" / "rigwake_ros"
    graph.start(
        "/usr/bin/python3",
        "/usr/bin/roslaunch",
        package / "launch" / "rigwake.launch",
        f"out:={tmp_path / 'out'}",
        f"python:={sys.executable}",
        ROS_PACKAGE_PATH=f"{package.parent}:/usr/share",
    )
    assert "recording" in until(lambda: _diagnostics(graph), bool, 60)


def _diagnostics(graph: RosGraph) -> Any:
    try:
        return graph.look("diagnostics")
    except (RuntimeError, subprocess.TimeoutExpired):
        return None


def test_without_a_master_it_says_so(ros: None, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("ROS_MASTER_URI", "http://127.0.0.1:9")
    done = run("ros", "node", "--out", tmp_path / "out")
    assert done.code == 1
    assert "No ROS master answers at http://127.0.0.1:9" in done.words
