"""Other tools read what we write, and we read what other tools write."""

import subprocess
from pathlib import Path

import cv2
import mcap.reader
import mcap.writer
import numpy as np
import pytest
from rosbags.highlevel import AnyReader
from rosbags.rosbag1 import Writer as Rosbag1Writer

from rigwake.geometry.se3 import SE3
from rigwake.readers.open import open_recording
from rigwake.readers.ros_decoding import typestore
from rigwake.recording import static_transform
from rigwake.writers.ros_encoding import MessageFactory
from rigwake.writers.rosbag import _Topic, _write, write_rosbag1
from rigwake.writers.write import write_recording
from test_writers import FRAMES, small_recording

ROS_PYTHON, ROSBAG = "/usr/bin/python3", "/usr/bin/rosbag"  # Debian's python3-rosbag


@pytest.fixture(scope="session")
def ros1() -> None:
    """Skips where the real ROS 1 tools are not installed."""
    if not Path(ROSBAG).is_file():
        pytest.skip("ROS 1 is not here: apt-get install python3-rosbag python3-sensor-msgs python3-tf2-msgs")


def run(*command: str) -> str:
    finished = subprocess.run(command, capture_output=True, text=True, timeout=60)
    assert finished.returncode == 0, finished.stdout + finished.stderr
    return finished.stdout


@pytest.mark.usefixtures("ros1")
@pytest.mark.parametrize(
    "compression",
    ["none", pytest.param("lz4", marks=pytest.mark.slow), pytest.param("bz2", marks=pytest.mark.slow)],
)
def test_real_rosbag_accepts_a_written_bag(tmp_path: Path, compression: str) -> None:
    path = tmp_path / "rec.bag"
    write_rosbag1(small_recording(), path, "raw", compression)  # type: ignore[arg-type]
    information = run(ROS_PYTHON, ROSBAG, "info", str(path))
    assert "sensor_msgs/CameraInfo" in information
    assert "/wamv/sensors/imu/imu/data" in information
    run(ROS_PYTHON, ROSBAG, "check", str(path))
    count = (
        "import rosbag, sys\n"
        "bag = rosbag.Bag(sys.argv[1])\n"
        "print(sum(1 for t, m, s in bag.read_messages() if m._type == 'sensor_msgs/Image' and m.height == 32))"
    )
    assert int(run(ROS_PYTHON, "-c", count, str(path))) == 2 * FRAMES


@pytest.mark.parametrize(
    ("file_format", "name"), [("ros1", "rec.bag"), ("ros2", "rec"), ("mcap", "rec.mcap")]
)
def test_rosbags_reads_a_written_bag(tmp_path: Path, file_format: str, name: str) -> None:
    written = small_recording()
    write_recording(written, tmp_path / name, file_format=file_format, image_encoding="raw")  # type: ignore[arg-type]
    store = typestore("ros1" if file_format == "ros1" else "cdr")
    with AnyReader([tmp_path / name], default_typestore=store) as reader:
        imus = [
            reader.deserialize(payload, connection.msgtype)
            for connection, _, payload in reader.messages()
            if connection.msgtype == "sensor_msgs/msg/Imu"
        ]
    assert len(imus) == 70
    gyro = [[m.angular_velocity.x, m.angular_velocity.y, m.angular_velocity.z] for m in imus]  # type: ignore[attr-defined]
    assert np.array_equal(gyro, written.imus["imu"].gyro)


def test_the_mcap_library_reads_a_written_file(tmp_path: Path) -> None:
    path = tmp_path / "rec.mcap"
    write_recording(small_recording(), path)
    with path.open("rb") as file:
        topics = [channel.topic for _, channel, _ in mcap.reader.make_reader(file).iter_messages()]
    assert topics.count("/wamv/sensors/cameras/front_camera/image_raw/compressed") == FRAMES


@pytest.mark.parametrize("compression", list(mcap.writer.CompressionType))
@pytest.mark.parametrize("chunked", [True, False])
def test_ros1_mcap_of_the_mcap_library_is_read(
    tmp_path: Path, compression: mcap.writer.CompressionType, chunked: bool
) -> None:
    imu, factory = small_recording().imus["imu"], MessageFactory("ros1")
    path = tmp_path / "rec.mcap"
    with path.open("wb") as file:
        writer = mcap.writer.Writer(file, chunk_size=5000, compression=compression, use_chunking=chunked)
        writer.start("ros1", "test")
        schema = writer.register_schema("sensor_msgs/Imu", "ros1msg", b"")
        channel = writer.register_channel("/imu/data", "ros1", schema)
        for row, stamp in enumerate(imu.timestamps_ns.tolist()):
            writer.add_message(channel, stamp, factory.imu(imu, row, None), stamp)
        writer.finish()
    again = open_recording(path)
    assert again.findings == ()
    assert np.array_equal(again.imus["imu"].accel, imu.accel)
    assert np.array_equal(again.imus["imu"].timestamps_ns, imu.timestamps_ns)


def test_static_transforms_of_several_latched_connections_form_a_chain(tmp_path: Path) -> None:
    rng = np.random.default_rng(2)
    chain = ["base_link", "post", "arm", "front_camera", "front_optical"]
    links = [SE3.exp(rng.normal(size=6)) for _ in chain[1:]]
    factory, path = MessageFactory("ros1"), tmp_path / "tf.bag"
    store = typestore("ros1")
    with Rosbag1Writer(path) as bag:
        for row, (parent, child, link) in enumerate(zip(chain, chain[1:], links, strict=False)):
            connection = bag.add_connection(
                "/tf_static", "tf2_msgs/msg/TFMessage", typestore=store, callerid=f"/node{row}", latching=1
            )
            bag.write(connection, 10**9 + row, factory.transforms(10**9, {(parent, child): link}))
    recording = open_recording(path)
    assert len(recording.static_transforms) == 4
    whole = links[0] * links[1] * links[2] * links[3]
    found = static_transform(recording, "base_link", "front_optical")
    back = static_transform(recording, "front_optical", "base_link")
    assert found is not None
    assert back is not None
    assert np.abs(found.local(whole)).max() < 1e-12
    assert np.abs((found * back).log()).max() < 1e-12
    assert static_transform(recording, "base_link", "elsewhere") is None


@pytest.mark.parametrize(
    ("encoding", "code", "channels"),
    [
        ("mono8", None, 1),
        ("bgr8", None, 3),
        ("rgb8", cv2.COLOR_RGB2BGR, 3),
        ("bgra8", cv2.COLOR_BGRA2BGR, 4),
        ("bayer_rggb8", cv2.COLOR_BayerBG2BGR, 1),
        ("bayer_grbg8", cv2.COLOR_BayerGB2BGR, 1),
        ("mono16", None, 1),
    ],
)
def test_raw_encodings_are_read(tmp_path: Path, encoding: str, code: int | None, channels: int) -> None:
    rng = np.random.default_rng(0)
    pixels = rng.integers(0, 256, (32, 48, channels), np.uint8).squeeze()
    store = typestore("ros1")
    stamp = store.types["builtin_interfaces/msg/Time"](5, 7)
    header = store.types["std_msgs/msg/Header"](0, stamp, "optical")
    stored = pixels if encoding != "mono16" else (pixels.astype("<u2") * 256 + 77).view(np.uint8)
    padded = np.hstack([stored.reshape(32, -1), np.zeros((32, 5), np.uint8)])  # rows may be padded
    name = "sensor_msgs/msg/Image"
    message = store.types[name](header, 32, 48, encoding, 0, padded.shape[1], padded.ravel())
    payload = bytes(store.serialize_ros1(message, name))
    topic = _Topic("/c/image_raw", name, iter([(9, "/c/image_raw", payload)]))
    _write(Rosbag1Writer(tmp_path / "r.bag"), [topic], "ros1")
    (frame,) = open_recording(tmp_path / "r.bag").camera("c").frames(colour=True)
    expected = cv2.cvtColor(pixels, code) if code is not None else pixels
    if channels == 1 and code is None:
        expected = cv2.cvtColor(pixels, cv2.COLOR_GRAY2BGR)
    assert np.array_equal(frame.image, expected)
    assert frame.timestamp_ns == 5_000_000_007
