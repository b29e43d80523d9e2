"""The real monitor where it runs unattended: over a fleet's recordings, and in the node."""

from __future__ import annotations

import csv
import shutil
import time
from pathlib import Path

import numpy as np
import pytest

from basin_recording import OFFSETS_MS, basin, basin_recording
from cli_runs import run
from rigwake.calibration import CalibratedCamera, Calibration, save_calibration
from rigwake.geometry import so3
from rigwake.geometry.se3 import SE3
from rigwake.readers.rosbag1 import index_rosbag1
from rigwake.ros.node import NodeOptions, RigwakeNode
from rigwake.ros.replay_transport import ReplayTransport
from rigwake.ros.transport import NodeStatus, StatusLevel
from rigwake.simulation.setup import Simulation
from rigwake.writers.write import write_recording

pytestmark = [pytest.mark.slow, pytest.mark.xdist_group("fleet")]


def calibration_of(simulated: Simulation, left_turned_deg: float) -> Calibration:
    """The true rig, but for the camera `left`, turned about the vertical of its picture."""
    assert simulated.rig.rig_from_imu is not None
    cameras = {}
    for name, camera in simulated.rig.cameras.items():
        imu_from_cam = simulated.rig.rig_from_imu.inverse() * camera.rig_from_cam
        turn = so3.exp(np.deg2rad([0, left_turned_deg if name == "left" else 0.0, 0]))
        cameras[name] = CalibratedCamera(
            name,
            SE3(imu_from_cam.rotation @ turn, imu_from_cam.translation),
            np.diag([1e-4] * 3 + [4e-3] * 3) ** 2,
            model=camera.model,
            time_offset_s=OFFSETS_MS[name] * 1e-3,
            time_offset_std_s=1e-4,
        )
    return Calibration("imu", cameras)


@pytest.fixture(scope="module")
def harbour(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Half a minute of the basin as recordings of two vessels, and their calibrations: one is a degree off."""
    folder = tmp_path_factory.mktemp("harbour")
    simulated = basin(seconds=32.0)
    for vessel in ("kiel", "bremen"):
        (folder / vessel).mkdir()
        (folder / "calibrations").mkdir(exist_ok=True)
        save_calibration(
            calibration_of(simulated, 1.0 if vessel == "bremen" else 0.0),
            folder / "calibrations" / f"{vessel}.yaml",
        )
    write_recording(
        basin_recording(simulated, folder / "memory"), folder / "kiel" / "sail.bag", image_encoding="png"
    )
    shutil.copy(folder / "kiel" / "sail.bag", folder / "bremen" / "sail.bag")
    return folder


def test_a_fleet_names_the_camera_that_moved(harbour: Path) -> None:
    (harbour / "short.bag").write_bytes((harbour / "kiel" / "sail.bag").read_bytes()[:400_000])
    (harbour / "list.csv").write_text("kiel/sail.bag\nbremen/sail.bag\nshort.bag,kiel\n")
    words = (
        *("fleet", "monitor", harbour / "list.csv", "--calibration", harbour / "calibrations"),
        *("--out", harbour / "out", "--jobs", 1),
    )
    ended = run(*words)
    assert ended.code == 5, ended.words
    assert "1 ok, 1 drifted" in ended.words
    assert "1 failed (1 truncated bag)" in ended.words
    with (harbour / "out" / "fleet.csv").open(newline="") as file:
        rows = {(row["vessel"], row["camera"]): row for row in csv.DictReader(file)}
    assert {rows["kiel", name]["state"] for name in OFFSETS_MS} == {"OK"}
    assert rows["bremen", "left"]["state"] == "DRIFTED"
    assert rows["bremen", "front"]["state"] != "DRIFTED"
    assert float(rows["bremen", "left"]["size_deg"]) == pytest.approx(1.0, abs=0.15)
    page = (harbour / "out" / "fleet.html").read_text()
    assert "Cameras that moved" in page
    assert "DRIFTED" in page
    before = {p: p.stat().st_mtime_ns for p in (harbour / "out" / "recordings").glob("*/monitor.json")}
    assert run(*words).code == 5
    assert {p: p.stat().st_mtime_ns for p in before} == before  # nothing was computed again


def test_the_node_says_it_on_diagnostics(harbour: Path, tmp_path: Path) -> None:
    transport = ReplayTransport(index_rosbag1(harbour / "bremen" / "sail.bag"))
    calibration = harbour / "calibrations" / "bremen.yaml"
    node = RigwakeNode(transport, NodeOptions(tmp_path / "out", calibration, monitor_s=0.01, least_free=0))

    def step() -> dict[str, NodeStatus]:
        node._told_s = float("-inf")
        node.step()
        return {status.name: status for status in transport.statuses}

    step()
    transport.play()
    time.sleep(0.02)
    step()  # the piece is judged from now on
    end = time.monotonic() + 240
    while "camera left" not in (seen := step()):
        assert time.monotonic() < end, seen
        assert "monitor" not in seen, seen["monitor"]
        time.sleep(0.2)
    assert seen["camera left"].level is StatusLevel.ERROR
    assert seen["camera left"].message.startswith("DRIFTED: ")
    assert seen["camera front"].level is not StatusLevel.ERROR
    node.close()
