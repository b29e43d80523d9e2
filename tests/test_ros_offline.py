"""The node without ROS: recorded ROS 1 and ROS 2 bags played through the transport that stands for ROS."""

from __future__ import annotations

import json
import shutil
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from basin_recording import basin, basin_recording
from calibrated_rigs import boat, without_vertical
from rigwake.calibration import save_calibration
from rigwake.errors import HostError
from rigwake.readers.channels import BagIndex, Encoding
from rigwake.readers.mcap_file import index_mcap
from rigwake.readers.open import open_recording
from rigwake.readers.rosbag1 import index_rosbag1
from rigwake.ros import debian_packages
from rigwake.ros.child_command import ChildCommand
from rigwake.ros.node import NodeOptions, RigwakeNode, chosen_topics
from rigwake.ros.recorder import BagRecorder
from rigwake.ros.replay_transport import ReplayTransport
from rigwake.ros.topic_watch import TopicWatch
from rigwake.ros.transport import COMPRESSED_IMAGE, IMAGE, ReceivedMessage, StatusLevel
from rigwake.writers.write import write_recording
from ros_bags import assert_same_recording

pytestmark = pytest.mark.xdist_group("ros")
IMU = "sensor_msgs/msg/Imu"


@pytest.fixture(scope="module")
def sails(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """A moment of the basin as a ROS 1 bag and as a ROS 2 bag."""
    folder = tmp_path_factory.mktemp("sails")
    recording = basin_recording(basin(seconds=1.6), folder / "memory")
    paths = {"ros1": folder / "sail.bag", "cdr": folder / "sail.mcap"}
    for path in paths.values():
        write_recording(recording, path, image_encoding="png")
    return paths


def index_of(sails: dict[str, Path], encoding: Encoding) -> BagIndex:
    return index_rosbag1(sails[encoding]) if encoding == "ros1" else index_mcap(sails[encoding])


def wait_for(condition: Callable[[], bool], seconds: float = 30.0) -> None:
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "waited too long"
        time.sleep(0.02)


@pytest.mark.parametrize("encoding", ["ros1", "cdr"])
def test_what_is_recorded_is_what_was_played_to_the_byte(
    sails: dict[str, Path], encoding: Encoding, tmp_path: Path
) -> None:
    path = sails[encoding]
    transport = ReplayTransport(index_of(sails, encoding))
    node = RigwakeNode(transport, NodeOptions(tmp_path / "out", least_free=0))
    node.step()
    assert node.record(True)[0]
    assert transport.play() > 100
    done, words = node.record(False)
    assert done, words
    played, recorded = open_recording(path), open_recording(Path(words.removeprefix("recorded ")))
    assert_same_recording(recorded, played)
    node.close()


def test_a_clock_that_jumps_back_begins_another_bag(sails: dict[str, Path], tmp_path: Path) -> None:
    transport = ReplayTransport(index_of(sails, "ros1"))
    node = RigwakeNode(transport, NodeOptions(tmp_path / "out", least_free=0))
    node.step()
    node.record(True)
    transport.play()
    transport.play()
    node.record(False)
    bags = sorted((tmp_path / "out").glob("*.bag"))
    assert len(bags) == 2
    first, second = map(open_recording, bags)
    for name, camera in first.cameras.items():
        np.testing.assert_array_equal(second.cameras[name].timestamps_ns, camera.timestamps_ns)
        assert second.cameras[name].model is not None  # lenses stand in every bag
    node._told_s = 0.0
    node.step()
    recording = next(s for s in transport.statuses if s.name == "recording")
    assert recording.values["clock_jumps"] == "1"
    node.close()


def test_a_clock_that_jumps_back_on_a_full_disk(
    sails: dict[str, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """No other bag can begin: that is said, and messages go on being received."""
    transport = ReplayTransport(index_of(sails, "ros1"))
    node = RigwakeNode(transport, NodeOptions(tmp_path / "out", least_free=0))
    node.step()
    node.record(True)
    transport.play()
    usage = shutil.disk_usage(tmp_path)
    monkeypatch.setattr(shutil, "disk_usage", lambda path: usage._replace(free=-1))
    assert transport.play() > 100
    recording = next(s for s in node.statuses(time.monotonic()) if s.name == "recording")
    assert recording.level is StatusLevel.ERROR
    assert "MiB are free" in recording.message
    node.close()


FAKE = "import sys, shutil, time, pathlib, json\n"


def fake_program(tmp_path: Path, body: str) -> tuple[str, ...]:
    script = tmp_path / "program.py"
    script.write_text(FAKE + body)
    return sys.executable, str(script)


class TestServices:
    def calibrating(
        self, sails: dict[str, Path], tmp_path: Path, body: str
    ) -> tuple[RigwakeNode, ReplayTransport]:
        save_calibration(without_vertical(boat(), "port"), tmp_path / "known.yaml")
        transport = ReplayTransport(index_of(sails, "ros1"))
        options = NodeOptions(tmp_path / "out", program=fake_program(tmp_path, body), least_free=0)
        node = RigwakeNode(transport, options)
        node.step()
        assert transport.services["calibrate"]() == (False, "nothing was recorded: call ~record first")
        assert transport.services["record"](True)[0]
        transport.play()
        return node, transport

    def said(self, node: RigwakeNode, name: str) -> str:
        return next(f"{s.level.name} {s.message}" for s in node.statuses(time.monotonic()) if s.name == name)

    def test_calibrates_in_a_child_and_publishes_what_is_known(
        self, sails: dict[str, Path], tmp_path: Path
    ) -> None:
        body = (
            "sys.stderr.write('front: tracking 40 %\\n'); sys.stderr.flush(); time.sleep(0.5)\n"
            "out = pathlib.Path(sys.argv[sys.argv.index('-o') + 1]); out.mkdir()\n"
            f"shutil.copy({str(tmp_path / 'known.yaml')!r}, out / 'calibration.yaml')\n"
        )
        node, transport = self.calibrating(sails, tmp_path, body)
        done, words = transport.services["calibrate"]()
        assert done, words
        again, why = transport.services["calibrate"]()
        assert not again
        assert "already calibrating" in why
        wait_for(lambda: "tracking 40 %" in self.said(node, "calibration"))
        wait_for(lambda: bool(transport.static))
        known = boat().cameras
        assert {parent for parent, _ in transport.static} == {boat().reference}
        for (_, child), transform in transport.static.items():
            np.testing.assert_allclose(
                transform.matrix, known[child.removesuffix("_optical_frame")].rig_from_cam.matrix, atol=1e-9
            )
        assert "port_optical_frame" not in {child for _, child in transport.static}
        assert "left out: port" in self.said(node, "calibration")
        assert self.said(node, "calibration").startswith("WARN")
        node.close()

    def test_a_failure_is_said_with_its_words(self, sails: dict[str, Path], tmp_path: Path) -> None:
        node, transport = self.calibrating(
            sails, tmp_path, "sys.stderr.write('│ The vessel never turned. │\\n'); sys.exit(3)\n"
        )
        assert transport.services["calibrate"]()[0]
        wait_for(lambda: "never turned" in self.said(node, "calibration"))
        assert self.said(node, "calibration").startswith("ERROR failed (exit code 3)")
        assert transport.services["calibrate"]()[0]  # it may be tried again
        node.close()

    def test_closing_ends_the_child(self, sails: dict[str, Path], tmp_path: Path) -> None:
        node, transport = self.calibrating(sails, tmp_path, "time.sleep(1000)\n")
        transport.services["calibrate"]()
        child = node._calibrating
        assert child is not None
        node.close()
        assert child._process.poll() is not None

    def test_the_monitor_judges_pieces(self, sails: dict[str, Path], tmp_path: Path) -> None:
        verdicts = {
            n: {"state": s, "words": "w"}
            for n, s in (("front", "OK"), ("left", "DRIFTED"), ("port", "SUSPECT"))
        }
        body = (
            "assert sys.argv[1] == 'monitor' and pathlib.Path(sys.argv[3]).is_file()\n"
            f"pathlib.Path(sys.argv[5]).write_text({json.dumps({'cameras': verdicts})!r}); sys.exit(5)\n"
        )
        save_calibration(boat(), tmp_path / "c.yaml")
        transport = ReplayTransport(index_of(sails, "ros1"))
        options = NodeOptions(
            tmp_path / "out",
            tmp_path / "c.yaml",
            monitor_s=0.01,
            program=fake_program(tmp_path, body),
            least_free=0,
        )
        node = RigwakeNode(transport, options)
        for _ in range(3):
            node._told_s = 0.0
            node.step()
            transport.play()
            time.sleep(0.02)
        wait_for(lambda: any(s.name == "camera left" for s in node.statuses(time.monotonic())))
        levels = {s.name: s.level for s in node.statuses(time.monotonic())}
        assert levels["camera front"] is StatusLevel.OK
        assert levels["camera left"] is StatusLevel.ERROR
        assert levels["camera port"] is StatusLevel.WARN
        node.close()
        assert not list((tmp_path / "out" / "monitor").iterdir())


class TestRecorder:
    def message(self, k: int = 0) -> ReceivedMessage:
        return ReceivedMessage("/imu", IMU, "ros1", k + 1, b"x" * 400)

    def test_a_full_disk_is_a_fault_and_what_was_written_is_kept(self, tmp_path: Path, monkeypatch) -> None:  # type: ignore[no-untyped-def]
        recorder = BagRecorder(tmp_path / "a.bag", "ros1", [], least_free=0)
        recorder.add(self.message())
        wait_for(lambda: recorder.written == 1)
        usage = shutil.disk_usage(tmp_path)
        monkeypatch.setattr(shutil, "disk_usage", lambda path: usage._replace(free=-1))
        for k in range(300):
            recorder.add(self.message(k))
        wait_for(lambda: bool(recorder.fault))
        with pytest.raises(HostError, match="MiB are free"):
            recorder.close()
        assert len(index_rosbag1(tmp_path / "a.bag").channels[0]) >= 1
        with pytest.raises(HostError, match="MiB are free"):
            BagRecorder(tmp_path / "b.bag", "ros1", [], least_free=0)

    def test_what_the_disk_cannot_take_is_dropped_and_counted(self, tmp_path: Path, monkeypatch) -> None:  # type: ignore[no-untyped-def]
        monkeypatch.setattr("rigwake.ros.recorder._MOST_BYTES", 1000)
        recorder = BagRecorder(tmp_path / "a.bag", "ros1", [], least_free=0)
        slow = recorder._writer.write
        recorder._writer.write = lambda *words: (time.sleep(0.01), slow(*words))
        for k in range(50):
            recorder.add(self.message(k))
        recorder.close()
        assert recorder.dropped["/imu"] > 0
        assert recorder.written + recorder.dropped["/imu"] == 50


class TestWatch:
    def imu(self, stamp_ns: int) -> bytes:
        return b"\0\0\0\0" + stamp_ns.to_bytes(8, "little") + b"\0\0\0\0"

    def test_rate_gap_silence_and_stamps(self) -> None:
        watch = TopicWatch("/imu")
        assert watch.status(0.0).message == "nothing yet"
        for k in range(50):
            watch.received(self.imu(k + 1), "ros1", 0.1 * k)
        status = watch.status(5.0)
        assert (status.level, status.message) == (StatusLevel.OK, "10.0 Hz")
        watch.received(b"", "ros1", 6.5)
        assert watch.status(6.6).level is StatusLevel.WARN
        assert watch.status(9.0).message == "silent for 2 s"
        assert watch.status(9.0).level is StatusLevel.STALE
        late = TopicWatch("/imu")
        for seconds in (5, 6, 5, 6):
            late.received(b"\0\0\0\0" + seconds.to_bytes(4, "little") + b"\0" * 8, "ros1", float(seconds))
        assert late.backwards == 1


def test_compressed_images_are_preferred() -> None:
    known = {
        "/front/image_raw": IMAGE,
        "/front/image_raw/compressed": COMPRESSED_IMAGE,
        "/left/image_raw": IMAGE,
        "/imu": IMU,
        "/chatter": "std_msgs/msg/String",
    }
    assert set(chosen_topics(known, ())) == {"/front/image_raw/compressed", "/left/image_raw", "/imu"}
    assert set(chosen_topics(known, ("/front/image_raw",))) == {"/front/image_raw"}


def test_without_ros_it_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(debian_packages, "NEEDED", ("rospy_that_is_not_there",))
    with pytest.raises(HostError, match="apt-get install python3-rospy"):
        debian_packages.provide_rospy()


def test_a_child_tells_its_progress_and_end(tmp_path: Path) -> None:
    ended: list[tuple[int, str]] = []
    child = ChildCommand(
        ["x"], lambda code, words: ended.append((code, words)), fake_program(tmp_path, "sys.exit(7)\n")
    )
    wait_for(lambda: bool(ended))
    assert ended == [(7, "")]
    child.end()
