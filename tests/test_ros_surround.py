"""The node's surround view: drawn of the newest images while somebody looks, with the cameras' own names."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from basin_recording import OFFSETS_MS, basin, basin_recording
from rigwake.calibration import CalibratedCamera, Calibration, save_calibration
from rigwake.readers.open import open_recording
from rigwake.readers.rosbag1 import index_rosbag1
from rigwake.readers.topics import camera_base
from rigwake.ros.node import NodeOptions, RigwakeNode
from rigwake.ros.replay_transport import ReplayTransport
from rigwake.ros.surround_stream import SurroundPainter
from rigwake.ros.transport import COMPRESSED_IMAGE, IMAGE, NodeStatus, ReceivedMessage, StatusLevel
from rigwake.views.frames import frame_sets
from rigwake.views.levelling import Leveller
from rigwake.views.present import Decoration, Presenter
from rigwake.views.projections import CylinderView
from rigwake.views.surface import SHELL_M, Shell
from rigwake.views.surround_rig import surround_rig
from rigwake.views.surround_view import SurroundView
from rigwake.writers.write import write_recording

pytestmark = pytest.mark.xdist_group("ros")


@pytest.fixture(scope="module")
def sail(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """A moment of the basin as a ROS 1 bag, and the true rig as its calibration."""
    folder = tmp_path_factory.mktemp("surround")
    simulated = basin(seconds=1.6)
    write_recording(basin_recording(simulated, folder / "memory"), folder / "sail.bag", image_encoding="png")
    cameras = {
        name: CalibratedCamera(
            name, c.rig_from_cam, np.eye(6) * 1e-8, model=c.model, time_offset_s=OFFSETS_MS[name] * 1e-3
        )
        for name, c in simulated.rig.cameras.items()
    }
    save_calibration(Calibration("imu", cameras), folder / "calibration.yaml")
    return folder / "sail.bag", folder / "calibration.yaml"


def images_of(bag: Path) -> dict[str, list[tuple[int, ReceivedMessage]]]:
    """Stamps and messages of every camera, by its name."""
    found = {}
    for channel in index_rosbag1(bag).channels:
        if channel.message_type in (IMAGE, COMPRESSED_IMAGE):
            name = camera_base(channel.topic).rpartition("/")[2]
            stamps = open_recording(bag).cameras[name].timestamps_ns.tolist()
            payloads = channel.payloads.read(np.arange(len(channel)))
            found[name] = [
                (stamp, ReceivedMessage(channel.topic, channel.message_type, "ros1", 0, bytes(payload)))
                for stamp, payload in zip(stamps, payloads, strict=True)
            ]
    return found


def wait_for(condition: Callable[[], bool], seconds: float = 30.0) -> None:
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "waited too long"
        time.sleep(0.02)


@pytest.mark.slow
def test_it_is_the_panorama_that_surround_draws(sail: tuple[Path, Path]) -> None:
    bag, calibration = sail
    painter = SurroundPainter(calibration)
    frames = painter.newest(images_of(bag))
    assert frames is not None
    assert not frames.missing
    drawn = cv2.imdecode(np.frombuffer(painter.jpeg(frames), np.uint8), cv2.IMREAD_COLOR)

    recording, simulated = open_recording(bag), basin(seconds=1.6)
    rig = surround_rig(
        Calibration(
            "imu",
            {
                n: CalibratedCamera(
                    n, c.rig_from_cam, np.eye(6), model=c.model, time_offset_s=OFFSETS_MS[n] * 1e-3
                )
                for n, c in simulated.rig.cameras.items()
            },
        ).rig
    )
    last = [
        recording.cameras[n].timestamps_ns[-1] + round(t * 1e9)
        for n, t in zip(rig.names, rig.time_offsets_s, strict=True)
    ]
    assert frames.timestamp_ns == min(last)  # the newest time that both cameras have reached
    (expected,) = frame_sets(recording.cameras, rig, [frames.timestamp_ns])
    attitude = Leveller(rig, "").at(expected.timestamp_ns, expected.images(rig))
    view = SurroundView(rig, CylinderView(1600, 500, 32.0, -42.0))
    wanted = Presenter(view, Decoration()).picture(expected, attitude, Shell(SHELL_M))
    assert drawn.shape == wanted.shape
    assert drawn.std() > 20
    assert np.abs(drawn.astype(float) - wanted).mean() < 4.0  # JPEG
    assert painter.newest(images_of(bag)) is None  # never the same picture twice


def test_only_what_is_shown_is_decoded_and_damage_is_named(sail: tuple[Path, Path]) -> None:
    bag, calibration = sail
    images = images_of(bag)
    damaged = {
        name: [(stamp, message._replace(payload=message.payload[:300])) for stamp, message in kept[:-1]]
        + kept[-1:]
        for name, kept in images.items()
    }
    assert SurroundPainter(calibration).newest({n: damaged[n][-1:] for n in damaged}) is not None
    front = {"front": images["front"], "left": damaged["left"][:-1]}
    frames = SurroundPainter(calibration).newest(front)
    assert frames is not None
    assert set(frames.missing) == {"left"}
    frames = SurroundPainter(calibration).newest({"front": images["front"]})
    assert frames is not None
    assert dict(frames.missing) == {"left": "not received"}
    assert SurroundPainter(calibration).newest({}) is None


class TestInTheNode:
    def node(
        self, sail: tuple[Path, Path], tmp_path: Path, calibration: Path | None
    ) -> tuple[RigwakeNode, ReplayTransport]:
        transport = ReplayTransport(index_rosbag1(sail[0]))
        node = RigwakeNode(
            transport, NodeOptions(tmp_path / "out", calibration, surround_hz=50, least_free=0)
        )
        return node, transport

    def step(self, node: RigwakeNode) -> None:
        node._told_s = float("-inf")
        node.step()

    def status(self, node: RigwakeNode) -> NodeStatus | None:
        return next((s for s in node.statuses(time.monotonic()) if s.name == "surround"), None)

    def test_nothing_is_drawn_while_nobody_looks(self, sail: tuple[Path, Path], tmp_path: Path) -> None:
        node, transport = self.node(sail, tmp_path, sail[1])
        self.step(node)
        transport.play()
        assert self.status(node) is None
        transport.listening["surround"] = 1
        self.step(node)
        transport.play()
        wait_for(lambda: bool(transport.images))
        name, stamp, jpeg = transport.images[-1]
        assert name == "surround"
        stamps = np.concatenate([c.timestamps_ns for c in open_recording(sail[0]).cameras.values()])
        assert stamps.min() - 30_000_000 <= stamp <= stamps.max() + 30_000_000
        assert cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_COLOR).shape == (500, 1600, 3)
        wait_for(lambda: (s := self.status(node)) is not None and s.message.startswith("drawn in"))
        transport.listening["surround"] = 0
        self.step(node)
        drawn = len(transport.images)
        transport.play()
        status = self.status(node)
        assert status is not None
        assert status.message == "nobody looks"
        node.close()
        assert len(transport.images) <= drawn + 1  # one may have been on its way

    def test_what_hinders_it_is_said(self, sail: tuple[Path, Path], tmp_path: Path) -> None:
        node, transport = self.node(sail, tmp_path, None)
        transport.listening["surround"] = 1
        self.step(node)
        status = self.status(node)
        assert status is not None
        assert (status.level, status.message) == (StatusLevel.WARN, "there is no calibration yet")
        other = Calibration(
            "imu",
            {
                "mast": CalibratedCamera(
                    "mast", next(iter(basin(1.0).rig.cameras.values())).rig_from_cam, np.eye(6)
                )
            },
        )
        save_calibration(other, tmp_path / "other.yaml")
        node._take(tmp_path / "other.yaml")
        self.step(node)
        transport.play()
        wait_for(lambda: (s := self.status(node)) is not None and "no lens for mast" in s.message)
        node.close()
        assert not transport.images
