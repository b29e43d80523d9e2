"""Small ROS bags of any layout, for the readers' tests; written with the package rosbags."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rosbags.rosbag1 import Writer as Rosbag1Writer
from rosbags.rosbag2 import CompressionFormat, StoragePlugin
from rosbags.rosbag2 import Writer as Rosbag2Writer

from rigwake.readers.ros_decoding import typestore
from rigwake.recording import Recording

START_NS = 1_700_000_000_000_000_000
WIDTH, HEIGHT = 16, 12
K = [20.0, 0, 8, 0, 21, 6, 0, 0, 1]


def picture(seed: int = 0, height: int = HEIGHT, width: int = WIDTH) -> NDArray[np.uint8]:
    return np.random.default_rng(seed).integers(20, 230, (height, width), dtype=np.uint8)


class SmallBag:
    """A bag that is being written: `with SmallBag(path) as bag: bag.image("/front/image_raw", 0.0)`."""

    def __init__(self, path: Path, ros: int = 1, storage: str = "sqlite3", **options: Any) -> None:
        self.ros = ros
        self.store = typestore("ros1" if ros == 1 else "cdr")
        if ros == 1:
            self.writer: Any = Rosbag1Writer(path)
            if "compression" in options:
                self.writer.set_compression(options["compression"])
        else:
            plugin = StoragePlugin.MCAP if storage == "mcap" else StoragePlugin.SQLITE3
            self.writer = Rosbag2Writer(path, version=9, storage_plugin=plugin)
            if "mode" in options:
                self.writer.set_compression(options["mode"], CompressionFormat.ZSTD)
        self.connections: dict[Any, Any] = {}

    def __enter__(self) -> SmallBag:
        self.writer.open()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.writer.close()

    def make(self, name: str, *fields: Any) -> Any:
        return self.store.types[name](*fields)

    def header(self, at_s: float, frame: str) -> Any:
        stamp = self.make("builtin_interfaces/msg/Time", *divmod(START_NS + round(at_s * 1e9), 10**9))
        return self.make("std_msgs/msg/Header", *([0] if self.ros == 1 else []), stamp, frame)

    def write(
        self, topic: str, kind: str, message: Any, at_s: float, publisher: int = 0, log_s: float | None = None
    ) -> None:
        key = topic, kind, publisher if self.ros == 1 else 0  # rosbags writes one publisher per ROS 2 topic
        if key not in self.connections:
            options = {"callerid": f"/node{publisher}"} if self.ros == 1 else {}
            self.connections[key] = self.writer.add_connection(topic, kind, typestore=self.store, **options)
        serialise = self.store.serialize_ros1 if self.ros == 1 else self.store.serialize_cdr
        log_ns = START_NS + round((at_s if log_s is None else log_s) * 1e9)
        self.writer.write(self.connections[key], log_ns, bytes(serialise(message, kind)))

    def image(
        self,
        topic: str,
        at_s: float,
        pixels: NDArray[Any] | None = None,
        encoding: str = "mono8",
        step: int | None = None,
        size: tuple[int, int] = (WIDTH, HEIGHT),
        frame: str = "cam",
        **options: Any,
    ) -> None:
        pixels = picture(height=size[1], width=size[0]) if pixels is None else pixels
        content = np.frombuffer(np.ascontiguousarray(pixels).tobytes(), np.uint8)
        step = len(content) // size[1] if step is None else step
        header = self.header(at_s, frame)
        kind = "sensor_msgs/msg/Image"
        big = int(options.pop("big_endian", False))
        message = self.make(kind, header, size[1], size[0], encoding, big, step, content)
        self.write(topic, kind, message, at_s, **options)

    def compressed(
        self,
        topic: str,
        at_s: float,
        encoded: bytes,
        layout: str = "jpeg",
        frame: str = "cam",
        **options: Any,
    ) -> None:
        kind = "sensor_msgs/msg/CompressedImage"
        content = np.frombuffer(encoded, np.uint8)
        self.write(topic, kind, self.make(kind, self.header(at_s, frame), layout, content), at_s, **options)

    def info(
        self,
        topic: str,
        at_s: float = 0.0,
        size: tuple[int, int] = (WIDTH, HEIGHT),
        matrix: Sequence[float] = K,
        D: Sequence[float] = (),
        model: str = "plumb_bob",
        P: Sequence[float] | None = None,
        binning: tuple[int, int] = (0, 0),
        roi: tuple[int, int, int, int] = (0, 0, 0, 0),
        frame: str = "cam",
    ) -> None:
        P = [*matrix[:3], 0, *matrix[3:6], 0, *matrix[6:], 0] if P is None else P
        x, y, width, height = roi
        region = self.make("sensor_msgs/msg/RegionOfInterest", x, y, height, width, False)
        arrays = [np.array(values, float) for values in (D, matrix, np.eye(3).ravel(), P)]
        kind = "sensor_msgs/msg/CameraInfo"
        header = self.header(at_s, frame)
        message = self.make(kind, header, size[1], size[0], model, *arrays, *binning, region)
        self.write(topic, kind, message, at_s)

    def camera(self, topic: str, info: str | None = None, frames: int = 3, **options: Any) -> None:
        """A few images, and one camera_info on the topic `info`."""
        for number in range(frames):
            self.image(topic, 0.1 * number, **options)
        if info is not None:
            self.info(info, frame=options.get("frame", "cam"))

    def imu(
        self,
        topic: str,
        at_s: float,
        gyro: Sequence[float] = (0.1, 0.2, 0.3),
        accel: Sequence[float] = (0.0, 0.1, 9.8),
        frame: str = "imu",
        absent: tuple[bool, bool] = (False, False),
        **options: Any,
    ) -> None:
        unknown = np.array([-1.0, *[0.0] * 8])
        covariances = [unknown if missing else np.zeros(9) for missing in absent]
        vectors = [self.make("geometry_msgs/msg/Vector3", *map(float, v)) for v in (gyro, accel)]
        quaternion = self.make("geometry_msgs/msg/Quaternion", 0.0, 0.0, 0.0, 1.0)
        kind = "sensor_msgs/msg/Imu"
        message = self.make(
            kind,
            self.header(at_s, frame),
            quaternion,
            unknown,
            vectors[0],
            covariances[0],
            vectors[1],
            covariances[1],
        )
        self.write(topic, kind, message, at_s, **options)

    def fix(self, topic: str, at_s: float, lla: Sequence[float], status: int = 0, **options: Any) -> None:
        kind = "sensor_msgs/msg/NavSatFix"
        state = self.make("sensor_msgs/msg/NavSatStatus", status, 1)
        covariance = np.diag([1.0, 1, 4]).ravel()
        message = self.make(kind, self.header(at_s, "gps"), state, *map(float, lla), covariance, 2)
        self.write(topic, kind, message, at_s, **options)

    def transform(
        self,
        topic: str,
        edge: tuple[str, str],
        position: Sequence[float],
        at_s: float = 0.0,
        publisher: int = 0,
        quat_xyzw: Sequence[float] = (0, 0, 0, 1),
    ) -> None:
        vector = self.make("geometry_msgs/msg/Vector3", *map(float, position))
        rotation = self.make("geometry_msgs/msg/Quaternion", *map(float, quat_xyzw))
        inner = self.make("geometry_msgs/msg/Transform", vector, rotation)
        stamped = self.make("geometry_msgs/msg/TransformStamped", self.header(at_s, edge[0]), edge[1], inner)
        kind = "tf2_msgs/msg/TFMessage"
        self.write(topic, kind, self.make(kind, [stamped]), at_s, publisher=publisher)


def assert_same_recording(recorded: Recording, played: Recording) -> None:
    """The same cameras, stamps, lenses and pictures, the same IMU, the same transforms."""
    assert set(recorded.cameras) == set(played.cameras)
    for name, camera in played.cameras.items():
        again = recorded.cameras[name]
        np.testing.assert_array_equal(again.timestamps_ns, camera.timestamps_ns)
        assert again.model == camera.model
        for ours, theirs in zip(again.frames(), camera.frames(), strict=True):
            np.testing.assert_array_equal(ours.image, theirs.image)
    (imu,), (true,) = recorded.imus.values(), played.imus.values()
    np.testing.assert_array_equal(imu.gyro, true.gyro)
    assert recorded.static_transforms.keys() == played.static_transforms.keys()
