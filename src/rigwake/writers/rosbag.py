"""ROS 1 bags and ROS 2 bags (sqlite3, MCAP) from a `Recording`, streamed in the order of time."""

from __future__ import annotations

import heapq
import re
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

from rigwake.atomic import atomic_path
from rigwake.cameras.formats.camera_info import ROS_LENSES, info_of_any_camera
from rigwake.errors import UsageError
from rigwake.readers.channels import Encoding
from rigwake.readers.rig_description import RIG_TOPIC, TRUTH_PREFIX
from rigwake.readers.ros_decoding import typestore
from rigwake.readers.topics import camera_base
from rigwake.recording import AttitudeStream, CameraStream, Finding, GnssStream, ImuStream, Recording
from rigwake.trajectory import Trajectory
from rigwake.writers.encoded_images import ImageEncoding, encoded_images, is_grey, lossy_remark
from rigwake.writers.rig_text import describe, json_text
from rigwake.writers.ros_encoding import MessageFactory

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
    places = _places(recording, image_encoding)
    for camera in recording.cameras.values():
        topics += _camera_topics(camera, places["cameras", camera.name], factory, image_encoding)
        findings += lossy_remark(camera, image_encoding)
        if camera.model is not None and camera.model.model not in ROS_LENSES:
            words = (
                f"ROS has no name for a {camera.model.model} lens: camera_info calls it so, which ROS's own programs "
                f"refuse; rigwake reads it from there and from {RIG_TOPIC}."
            )
            findings.append(Finding("note", camera.name, words))
    for imu in recording.imus.values():
        attitude = _same_rows(imu, recording.attitudes.get(imu.name))
        topics.append(_imu_topic(imu, places["imus", imu.name], attitude, factory))
    for attitude in recording.attitudes.values():
        if ("attitudes", attitude.name) in places:
            topics.append(_attitude_topic(attitude, places["attitudes", attitude.name], factory))
    for gnss in recording.gnss.values():
        topics += _gnss_topics(gnss, places["gnss", gnss.name], factory)
    for kind, trajectories in (("poses", recording.poses), ("truth", recording.true_trajectories)):
        for name, poses in trajectories.items():
            topics.append(_pose_topic(places[kind, name], poses, factory))
            findings += _unwritten_of_poses(name, poses)
    first_ns = min(_first_stamps(recording), default=0)
    if recording.static_transforms:
        edges = dict(recording.static_transforms)
        messages = iter([(first_ns, "/tf_static", factory.transforms(first_ns, edges))])
        topics.append(_Topic("/tf_static", "tf2_msgs/msg/TFMessage", messages, latched=True))
    content = describe(recording, places, transforms=False)
    if content:
        text = iter([(first_ns, RIG_TOPIC, factory.text(json_text(content)))])
        topics.append(_Topic(RIG_TOPIC, "std_msgs/msg/String", text, latched=True))
    return topics, tuple(findings)


def _places(recording: Recording, image_encoding: ImageEncoding) -> dict[tuple[str, str], str]:
    """The topic of every sensor: its own where it has one that no other takes, else one made from its name."""
    suffix = "image_raw" if image_encoding == "raw" else "image_raw/compressed"
    places: dict[tuple[str, str], str] = {}

    def place(kind: str, name: str, own: str, otherwise: str) -> None:
        wanted = own if own.startswith("/") else otherwise
        candidates = (wanted, otherwise, *(f"{otherwise}_{number}" for number in range(2, 1000)))
        places[kind, name] = next(topic for topic in candidates if topic not in places.values())

    for name, camera in recording.cameras.items():
        own = f"{camera_base(camera.topic)}/{suffix}" if camera.topic.startswith("/") else ""
        place("cameras", name, own, f"{NAMESPACE}/cameras/{_token(name)}_camera/{suffix}")
    for name, imu in recording.imus.items():
        place("imus", name, imu.topic, f"{NAMESPACE}/imu/{_token(name)}/data")
    for name, attitude in recording.attitudes.items():
        imu_of_same_rows = recording.imus.get(name)
        if imu_of_same_rows is None or _same_rows(imu_of_same_rows, attitude) is None:
            place("attitudes", name, attitude.topic, f"{NAMESPACE}/attitude/{_token(name)}")
    for name, gnss in recording.gnss.items():
        place("gnss", name, gnss.topic, f"{NAMESPACE}/gps/{_token(name)}/fix")
    for name in recording.poses:
        place("poses", name, "", f"/poses/{_token(name)}")
    for name in recording.true_trajectories:
        place("truth", name, "", f"{TRUTH_PREFIX}{_token(name)}")
    return places


def _token(name: str) -> str:
    """The name as a part of a topic: ROS allows letters, digits and underscores, not a digit at first."""
    token = re.sub(r"[^A-Za-z0-9_]", "_", name)
    return token if token[:1].isalpha() else f"s{token}"


def _same_rows(imu: ImuStream, attitude: AttitudeStream | None) -> AttitudeStream | None:
    """The attitude, if it can travel in the messages of this IMU."""
    if attitude is None or not np.array_equal(attitude.timestamps_ns, imu.timestamps_ns):
        return None
    return attitude


def _unwritten_of_poses(name: str, poses: Trajectory) -> list[Finding]:
    lost = []
    if poses.covariances is not None and poses.covariance_kind != "poses":
        lost.append("covariances of its increments")
    if poses.segment_ids is not None and poses.segment_ids.any():
        lost.append("its segments")
    return [Finding("note", name, f"bags cannot hold {' and '.join(lost)}: left out.")] if lost else []


def _first_stamps(recording: Recording) -> Iterator[int]:
    sensors = (recording.cameras, recording.imus, recording.gnss, recording.attitudes, recording.poses)
    for streams in sensors:
        yield from (int(s.timestamps_ns[0]) for s in streams.values() if len(s.timestamps_ns))


def _rows(name: str, message_type: str, stamps: list[int], build: Callable[[int], bytes]) -> _Topic:
    return _Topic(name, message_type, ((stamp, name, build(row)) for row, stamp in enumerate(stamps)))


def _imu_topic(
    imu: ImuStream, topic: str, attitude: AttitudeStream | None, factory: MessageFactory
) -> _Topic:
    stamps = imu.timestamps_ns.tolist()
    return _rows(topic, "sensor_msgs/msg/Imu", stamps, lambda row: factory.imu(imu, row, attitude))


def _attitude_topic(attitude: AttitudeStream, topic: str, factory: MessageFactory) -> _Topic:
    stamps = attitude.timestamps_ns.tolist()
    return _rows(topic, "sensor_msgs/msg/Imu", stamps, lambda row: factory.attitude(attitude, row))


def _gnss_topics(gnss: GnssStream, topic: str, factory: MessageFactory) -> list[_Topic]:
    stamps = gnss.timestamps_ns.tolist()
    topics = [_rows(topic, "sensor_msgs/msg/NavSatFix", stamps, lambda row: factory.fix(gnss, row))]
    if gnss.velocity_enu is not None:
        kind, beside = "geometry_msgs/msg/TwistStamped", f"{topic}_velocity"
        topics.append(_rows(beside, kind, stamps, lambda row: factory.velocity(gnss, row)))
    return topics


def _pose_topic(topic: str, trajectory: Trajectory, factory: MessageFactory) -> _Topic:
    stamps = trajectory.timestamps_ns.tolist()
    poses, covariances = trajectory.world_from_body, trajectory.covariances
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
    camera: CameraStream, topic: str, factory: MessageFactory, image_encoding: ImageEncoding
) -> list[_Topic]:
    kind = "sensor_msgs/msg/Image" if image_encoding == "raw" else "sensor_msgs/msg/CompressedImage"
    topics = [_Topic(topic, kind, _image_messages(camera, topic, factory, image_encoding))]
    if camera.model is not None:
        info = info_of_any_camera(camera.model)
        stamps = camera.timestamps_ns.tolist()
        topics.append(
            _rows(
                f"{camera_base(topic)}/camera_info",
                "sensor_msgs/msg/CameraInfo",
                stamps,
                lambda row: factory.camera_info(stamps[row], camera.frame_id, info),
            )
        )
    return topics


def _image_messages(
    camera: CameraStream, topic: str, factory: MessageFactory, image_encoding: ImageEncoding
) -> Iterator[_Message]:
    if image_encoding == "raw":
        for frame in camera.frames(colour=not is_grey(camera)):
            yield (
                frame.timestamp_ns,
                topic,
                factory.raw_image(frame.timestamp_ns, camera.frame_id, frame.image),
            )
        return
    for stamp, encoded in encoded_images(camera, image_encoding):
        yield stamp, topic, factory.encoded_image(stamp, camera.frame_id, encoded)
