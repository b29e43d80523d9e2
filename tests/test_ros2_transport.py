"""The node in ROS 2, as far as it can be run without ROS 2: the rclpy transport against a stand-in of rclpy's calls."""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np
import pytest

from basin_recording import basin, basin_recording
from calibrated_rigs import boat
from fake_rclpy import (
    DurabilityPolicy,
    FakeGraph,
    FakePublisher,
    QoSProfile,
    ReliabilityPolicy,
    install,
    settle,
)
from rigwake.calibration import save_calibration
from rigwake.errors import HostError
from rigwake.geometry import so3
from rigwake.readers.mcap_file import index_mcap
from rigwake.readers.open import open_recording
from rigwake.readers.ros_decoding import decode
from rigwake.ros.node import NodeOptions, RigwakeNode
from rigwake.ros.rclpy_transport import RclpyTransport
from rigwake.ros.transport import COMPRESSED_IMAGE, TRANSFORMS, NodeStatus, StatusLevel
from rigwake.writers.write import write_recording
from ros_bags import assert_same_recording

pytestmark = pytest.mark.xdist_group("ros")

KEPT = QoSProfile(1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
SENSOR = QoSProfile(10, ReliabilityPolicy.BEST_EFFORT)
RELIABLE = QoSProfile(10)


@pytest.fixture(scope="module")
def sail(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("ros2")
    write_recording(
        basin_recording(basin(seconds=1.6), folder / "memory"), folder / "sail.mcap", image_encoding="png"
    )
    return folder / "sail.mcap"


@pytest.fixture
def graph(monkeypatch: pytest.MonkeyPatch) -> FakeGraph:
    return install(monkeypatch)


def advertised(graph: FakeGraph, sail: Path) -> dict[str, FakePublisher]:
    """Publishers as drivers have them: images as sensor data, the rest reliable, what is sent once kept."""
    found = {}
    for channel in index_mcap(sail).channels:
        quality = SENSOR if "image" in channel.topic else RELIABLE
        if channel.topic in ("/tf_static", "/rigwake/rig"):
            quality = KEPT
        found[channel.topic] = graph.advertise(channel.topic, channel.message_type, quality)
    return found


def play(graph: FakeGraph, sail: Path, publishers: dict[str, FakePublisher], *, kept: bool) -> None:
    """Publish the bag's messages; kept: those that are sent once, or the others."""
    for channel in index_mcap(sail).channels:
        publisher = publishers[channel.topic]
        if (publisher.quality is KEPT) == kept:
            for payload in channel.payloads.read(np.arange(len(channel))):
                publisher.publish(bytes(payload))
    if not kept:
        settle(graph)


def test_a_ros2_graph_is_recorded_as_the_bag_holds_it(graph: FakeGraph, sail: Path, tmp_path: Path) -> None:
    """What was sent before the node came (transforms, the rig's own description) is in its bag as well."""
    publishers = advertised(graph, sail)
    play(graph, sail, publishers, kept=True)
    transport = RclpyTransport("rigwake", ["__name:=rig", "/a:=/b"])
    assert graph.init_args == ["rigwake", "--ros-args", "-r", "__node:=rig", "-r", "/a:=/b"]
    node = RigwakeNode(transport, NodeOptions(tmp_path / "out", least_free=0))
    node.step()
    assert graph.call("/rigwake/record", data=True)[0]
    play(graph, sail, publishers, kept=False)
    done, words = graph.call("/rigwake/record", data=False)
    assert done, words
    recorded, played = open_recording(Path(words.removeprefix("recorded "))), open_recording(sail)
    assert_same_recording(recorded, played)
    node.close()
    assert not graph.is_on


def test_transforms_and_status_are_messages_that_others_read(graph: FakeGraph, tmp_path: Path) -> None:
    save_calibration(boat(), tmp_path / "c.yaml")
    transport = RclpyTransport("rigwake")
    node = RigwakeNode(transport, NodeOptions(tmp_path / "out", tmp_path / "c.yaml", least_free=0))
    node.step()
    static = next(p for p in graph.publishers if p.topic == "/tf_static")
    assert static.quality.durability is DurabilityPolicy.TRANSIENT_LOCAL
    message = decode(static.sent[-1], TRANSFORMS, "cdr")
    assert len(message.transforms) == len(boat().cameras)
    for stamped in message.transforms:
        assert stamped.header.frame_id == "imu"
        assert stamped.header.stamp.sec * 10**9 + stamped.header.stamp.nanosec == graph.now_ns
        true = boat().cameras[stamped.child_frame_id.removesuffix("_optical_frame")].rig_from_cam
        t, q = stamped.transform.translation, stamped.transform.rotation
        np.testing.assert_allclose([t.x, t.y, t.z], true.translation, atol=1e-9)
        np.testing.assert_allclose(
            so3.matrix_from_quat_wxyz(np.array([q.w, q.x, q.y, q.z])), true.rotation, atol=1e-9
        )
    status = next(p for p in graph.publishers if p.topic == "/diagnostics")
    array = decode(status.sent[-1], "diagnostic_msgs/msg/DiagnosticArray", "cdr")
    named = {entry.name: entry for entry in array.status}
    assert named["rigwake: recording"].message == "off"
    assert {pair.key: pair.value for pair in named["rigwake: calibration"].values} == {"reference": "imu"}
    node.close()


def test_own_transforms_are_not_recorded(graph: FakeGraph, sail: Path, tmp_path: Path) -> None:
    save_calibration(boat(), tmp_path / "c.yaml")
    publishers = advertised(graph, sail)
    play(graph, sail, publishers, kept=True)
    node = RigwakeNode(
        RclpyTransport("rigwake"), NodeOptions(tmp_path / "out", tmp_path / "c.yaml", least_free=0)
    )
    node.step()
    settle(graph)
    node.record(True)
    node._take(tmp_path / "c.yaml")  # published while it listens
    play(graph, sail, publishers, kept=False)
    words = node.record(False)[1]
    recorded = open_recording(Path(words.removeprefix("recorded ")))
    assert not any("optical_frame" in child for _, child in recorded.static_transforms)
    assert recorded.static_transforms.keys() == open_recording(sail).static_transforms.keys()
    node.close()


def test_it_asks_for_no_more_than_publishers_offer(graph: FakeGraph) -> None:
    """A reliable subscription would never hear a camera that sends as best it can."""
    transport = RclpyTransport("rigwake")
    heard: list[str] = []
    for topic, qualities in {
        "/best": [SENSOR],
        "/reliable": [RELIABLE],
        "/both": [RELIABLE, SENSOR],
        "/tf_static": [KEPT],
    }.items():
        publishers = [graph.advertise(topic, "sensor_msgs/msg/Imu", quality) for quality in qualities]
        transport.subscribe(topic, "sensor_msgs/msg/Imu", lambda message: heard.append(message.topic))
        for publisher in publishers:
            publisher.publish(b"\0\1\0\0")
    settle(graph)
    assert sorted(heard) == ["/best", "/both", "/both", "/reliable", "/tf_static"]
    asked = {s.topic: s.quality for s in graph.subscriptions}
    assert asked["/reliable"].reliability is ReliabilityPolicy.RELIABLE
    assert asked["/tf_static"].durability is DurabilityPolicy.TRANSIENT_LOCAL
    assert "/gone" not in transport.topics()
    transport.close()


def test_a_picture_goes_to_those_who_look(graph: FakeGraph) -> None:
    transport = RclpyTransport("rigwake")
    assert transport.listeners("surround") == 0
    graph.outside["/rigwake/surround/compressed"] = 2
    assert transport.listeners("surround") == 2
    transport.publish_jpeg("surround", 1_700_000_000_000_000_321, "imu", b"\xff\xd8picture")
    publisher = next(p for p in graph.publishers if p.topic == "/rigwake/surround/compressed")
    message = decode(publisher.sent[-1], COMPRESSED_IMAGE, "cdr")
    assert (message.header.frame_id, message.format) == ("imu", "jpeg")
    assert (message.header.stamp.sec, message.header.stamp.nanosec) == (1_700_000_000, 321)
    assert message.data.tobytes() == b"\xff\xd8picture"
    transport.close()


def test_words_of_any_kind_are_published(graph: FakeGraph) -> None:
    transport = RclpyTransport("rigwake")
    transport.publish_status(
        [NodeStatus("caméra", StatusLevel.STALE, "ä" * 300, {"": "\n"}), NodeStatus("x", StatusLevel.OK, "")]
    )
    publisher = next(p for p in graph.publishers if p.topic == "/diagnostics")
    first, second = decode(publisher.sent[-1], "diagnostic_msgs/msg/DiagnosticArray", "cdr").status
    assert (first.name, first.message, first.level) == ("rigwake: caméra", "ä" * 300, 3)
    assert second.message == ""
    transport.close()


def test_without_ros2_it_says_what_to_do(monkeypatch: pytest.MonkeyPatch) -> None:
    import sys

    monkeypatch.setitem(sys.modules, "rclpy", None)
    begun = time.monotonic()
    with pytest.raises(HostError, match=r"setup\.bash"):
        RclpyTransport("rigwake")
    assert time.monotonic() - begun < 1.0
