"""ROS 1 bags and ROS 2 bags (sqlite3, MCAP) from a `Recording`, streamed in the order of time."""

from __future__ import annotations

import heapq
import tempfile
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import lz4.frame
import numpy as np
from rosbags.rosbag1 import Writer as Rosbag1Writer
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Rosbag2Writer

from rigwake._types import Image
from rigwake.atomic import atomic_path
from rigwake.cameras.formats.camera_info import CameraInfo, info_from_camera
from rigwake.errors import CameraError, UsageError
from rigwake.readers.channels import Encoding
from rigwake.readers.ros_decoding import typestore
from rigwake.readers.topics import camera_base
from rigwake.recording import AttitudeStream, CameraStream, Finding, GnssStream, ImuStream, Recording
from rigwake.trajectory import Trajectory
from rigwake.writers.ros_encoding import MessageFactory

ImageEncoding = Literal["jpeg", "png", "raw"]
NAMESPACE = "/wamv/sensors"
_COMPRESSION = {"lz4": Rosbag1Writer.CompressionFormat.LZ4, "bz2": Rosbag1Writer.CompressionFormat.BZ2}

_Message = tuple[int, str, bytes]  # log time, topic, bytes


@dataclass(frozen=True)
class _Topic:
    """One topic to be written: its type, and its messages in the order of time."""

    name: str
    message_type: str
    messages: Iterator[_Message]
    latched: bool = False


def write_rosbag1(
    recording: Recording,
    path: Path,
    image_encoding: ImageEncoding = "jpeg",
    compression: Literal["none", "lz4", "bz2"] = "none",
) -> tuple[Finding, ...]:
    """Write a ROS 1 bag; returns what could not be written into it. The file is whole or not there."""
    topics, findings = _topics(recording, MessageFactory("ros1"), image_encoding)
    with atomic_path(path) as temporary:
        temporary.unlink()  # the writer refuses an existing file
        writer = Rosbag1Writer(temporary)
        if compression != "none":
            writer.set_compression(_COMPRESSION[compression])
        if compression == "lz4":
            writer.compressor = _ros_lz4
        _write(writer, topics, "ros1")
    return findings


def _ros_lz4(content: bytes) -> bytes:
    """LZ4 as ROS reads it: its library knows neither linked blocks nor frames that state their size."""
    packed = lz4.frame.compress(content, block_linked=False, content_checksum=True, store_size=False)
    return bytes(packed)


def write_rosbag2(
    recording: Recording,
    path: Path,
    image_encoding: ImageEncoding = "jpeg",
    storage: Literal["sqlite3", "mcap"] = "mcap",
) -> tuple[Finding, ...]:
    """Write a ROS 2 bag folder, or a single MCAP file where `path` ends in `.mcap`.

    Returns what could not be written into it. Raises UsageError if a folder of this name exists.
    """
    path = Path(path)
    if path.is_dir():
        raise UsageError(f"{path} exists.", remedy="Choose another name, or remove it first.")
    path.parent.mkdir(parents=True, exist_ok=True)
    topics, findings = _topics(recording, MessageFactory("cdr"), image_encoding)
    plugin = StoragePlugin.MCAP if storage == "mcap" else StoragePlugin.SQLITE3
    with tempfile.TemporaryDirectory(dir=path.parent, prefix=f".{path.stem}-") as temporary:
        folder = Path(temporary) / path.stem
        _write(Rosbag2Writer(folder, version=9, storage_plugin=plugin), topics, "cdr")
        written = folder / f"{folder.name}.mcap" if path.suffix == ".mcap" else folder
        written.replace(path)
    return findings


def _write(writer: AbstractContextManager[Any], topics: list[_Topic], encoding: Encoding) -> None:
    store = typestore(encoding)
    with writer as bag:
        connections = {}
        for topic in topics:
            latching = {"latching": 1} if encoding == "ros1" and topic.latched else {}
            connections[topic.name] = bag.add_connection(
                topic.name, topic.message_type, typestore=store, **latching
            )
        for stamp, name, payload in heapq.merge(*(topic.messages for topic in topics), key=lambda m: m[0]):
            bag.write(connections[name], stamp, payload)


def _topics(
    recording: Recording, factory: MessageFactory, image_encoding: ImageEncoding
) -> tuple[list[_Topic], tuple[Finding, ...]]:
    topics: list[_Topic] = []
    findings: list[Finding] = []
    for camera in recording.cameras.values():
        topics += _camera_topics(camera, factory, image_encoding, findings)
    for imu in recording.imus.values():
        topics.append(_imu_topic(imu, recording.attitudes.get(imu.name), factory))
    for gnss in recording.gnss.values():
        topics.append(_fix_topic(gnss, factory))
        if gnss.velocity_enu is not None:
            findings.append(Finding("note", gnss.name, "velocities are not written into bags."))
    topics += [_pose_topic(name, poses, factory) for name, poses in recording.poses.items()]
    if recording.static_transforms:
        first_ns = min(_first_stamps(recording), default=0)
        edges = dict(recording.static_transforms)
        messages = iter([(first_ns, "/tf_static", factory.transforms(first_ns, edges))])
        topics.append(_Topic("/tf_static", "tf2_msgs/msg/TFMessage", messages, latched=True))
    return topics, tuple(findings)


def _first_stamps(recording: Recording) -> Iterator[int]:
    for streams in (recording.cameras, recording.imus, recording.gnss, recording.poses):
        yield from (int(s.timestamps_ns[0]) for s in streams.values() if len(s.timestamps_ns))


def _name(topic: str, otherwise: str) -> str:
    return topic if topic.startswith("/") else otherwise


def _rows(name: str, message_type: str, stamps: list[int], build: Callable[[int], bytes]) -> _Topic:
    return _Topic(name, message_type, ((stamp, name, build(row)) for row, stamp in enumerate(stamps)))


def _imu_topic(imu: ImuStream, attitude: AttitudeStream | None, factory: MessageFactory) -> _Topic:
    if attitude is not None and not np.array_equal(attitude.timestamps_ns, imu.timestamps_ns):
        attitude = None
    return _rows(
        _name(imu.topic, f"{NAMESPACE}/imu/{imu.name}/data"),
        "sensor_msgs/msg/Imu",
        imu.timestamps_ns.tolist(),
        lambda row: factory.imu(imu, row, attitude),
    )


def _fix_topic(gnss: GnssStream, factory: MessageFactory) -> _Topic:
    return _rows(
        _name(gnss.topic, f"{NAMESPACE}/gps/{gnss.name}/fix"),
        "sensor_msgs/msg/NavSatFix",
        gnss.timestamps_ns.tolist(),
        lambda row: factory.fix(gnss, row),
    )


def _pose_topic(name: str, trajectory: Trajectory, factory: MessageFactory) -> _Topic:
    stamps = trajectory.timestamps_ns.tolist()
    poses, covariances = trajectory.world_from_body, trajectory.covariances
    topic = f"/poses/{name}"
    if covariances is not None and trajectory.covariance_kind == "poses":
        return _rows(
            topic,
            "geometry_msgs/msg/PoseWithCovarianceStamped",
            stamps,
            lambda row: factory.pose_with_covariance(stamps[row], "world", poses[row], covariances[row]),
        )
    return _rows(
        topic,
        "geometry_msgs/msg/PoseStamped",
        stamps,
        lambda row: factory.pose(stamps[row], "world", poses[row]),
    )


def _camera_topics(
    camera: CameraStream, factory: MessageFactory, image_encoding: ImageEncoding, findings: list[Finding]
) -> list[_Topic]:
    base = camera_base(_name(camera.topic, f"{NAMESPACE}/cameras/{camera.name}_camera/image_raw"))
    name = f"{base}/image_raw" if image_encoding == "raw" else f"{base}/image_raw/compressed"
    kind = "sensor_msgs/msg/Image" if image_encoding == "raw" else "sensor_msgs/msg/CompressedImage"
    messages = (
        (stamp, name, factory.image(stamp, camera.frame_id, image, image_encoding))
        for stamp, image in _images(camera)
    )
    topics = [_Topic(name, kind, messages)]
    info = _info(camera, findings)
    if info is not None:
        topics.append(
            _rows(
                f"{base}/camera_info",
                "sensor_msgs/msg/CameraInfo",
                stamps := camera.timestamps_ns.tolist(),
                lambda row: factory.camera_info(stamps[row], camera.frame_id, info),
            )
        )
    return topics


def _info(camera: CameraStream, findings: list[Finding]) -> CameraInfo | None:
    if camera.model is None:
        return None
    try:
        return info_from_camera(camera.model)
    except CameraError as error:
        findings.append(Finding("warning", camera.name, f"no camera_info is written: {error.cause}"))
        return None


def is_grey(camera: CameraStream) -> bool:
    """Whether the camera's first readable image has three equal channels."""
    for frame in camera.frames(colour=True):
        image = frame.image
        return bool((image[..., 0] == image[..., 1]).all() and (image[..., 1] == image[..., 2]).all())
    return True


def _images(camera: CameraStream) -> Iterator[tuple[int, Image]]:
    for frame in camera.frames(colour=not is_grey(camera)):
        yield frame.timestamp_ns, frame.image
