"""From the channels of a ROS bag to a `Recording`: which topic is which sensor, by type and by name."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from rigwake.cameras.formats.camera_info import camera_from_info
from rigwake.cameras.protocol import CameraModel
from rigwake.errors import CameraError, InputError, UsageError
from rigwake.geometry.se3 import SE3
from rigwake.readers.channels import BagIndex, Channel, HeldPayloads
from rigwake.readers.chunks import ChunkedPayloads, read_together
from rigwake.readers.images import ImageSize
from rigwake.readers.ros_decoding import HEADER_BYTES, decode_all, has_standard_type, stamped_rows
from rigwake.readers.ros_frames import COMPRESSED, IMAGE_TYPES, RosFrames, first_image_size
from rigwake.readers.ros_sensors import FIX, IMU, POSE_TYPES, read_fix, read_imu, read_poses
from rigwake.readers.ros_transforms import TF_TYPES, read_moving, read_static
from rigwake.readers.streams import time_order
from rigwake.readers.topics import TopicMap, camera_base, sensor_names
from rigwake.recording import (
    AttitudeStream,
    CameraStream,
    Finding,
    GnssStream,
    ImuStream,
    Recording,
)
from rigwake.trajectory import Trajectory

_INFO = "sensor_msgs/msg/CameraInfo"
MAX_SENSOR_BYTES = 2**20
"""A message of a sensor other than a camera that is larger is damage."""
_ROLE_TYPES = {"camera": IMAGE_TYPES, "imu": {IMU}, "gnss": {FIX}, "pose": POSE_TYPES}


@dataclass
class _RosStreams:
    """Sensors gathered while going through the topics."""

    cameras: dict[str, CameraStream] = field(default_factory=dict)
    imus: dict[str, ImuStream] = field(default_factory=dict)
    gnss: dict[str, GnssStream] = field(default_factory=dict)
    attitudes: dict[str, AttitudeStream] = field(default_factory=dict)
    poses: dict[str, Trajectory] = field(default_factory=dict)
    static_transforms: dict[tuple[str, str], SE3] = field(default_factory=dict)
    findings: list[Finding] = field(default_factory=list)
    headers: dict[str, list[bytes]] = field(default_factory=dict)


def recording_from_bag(path: Path, bag: BagIndex, topics: TopicMap) -> Recording:
    """Everything the bag holds that rigwake understands; what is left out or repaired is in `findings`.

    Raises UsageError if `topics` names one that is not there or has a wrong type.
    """
    found = _RosStreams(findings=list(bag.findings))
    usable = {c.topic: c for c in bag.channels if len(c) and has_standard_type(c)}
    for channel in bag.channels:
        if channel.topic not in usable and len(channel) and channel.message_type in _all_types():
            message = f"{channel.topic}: {channel.message_type} is not the standard message; it is left out."
            found.findings.append(Finding("warning", channel.topic, message))
    usable = _held_where_packed(usable, found)
    readers: Mapping[str, Callable[[str, Channel], None]] = {
        "camera": lambda name, channel: _add_camera(name, channel, usable, found),
        "imu": lambda name, channel: _add_imu(name, channel, found),
        "gnss": lambda name, channel: _add_fix(name, channel, found),
        "pose": lambda name, channel: _add_poses(name, channel, found),
    }
    _add_transforms(list(usable.values()), found)
    for role, add in readers.items():
        for name, channel in _channels_of(role, usable, topics).items():
            try:
                add(name, channel)
            except (InputError, CameraError) as error:
                found.findings.append(Finding("error", name, f"left out: {error.cause}"))
    return Recording(
        path,
        bag.kind,
        found.cameras,
        found.imus,
        found.gnss,
        found.attitudes,
        found.poses,
        found.static_transforms,
        findings=tuple(found.findings),
    )


def _held_where_packed(usable: Mapping[str, Channel], found: _RosStreams) -> dict[str, Channel]:
    """Of a packed bag all messages but images, and the headers of images, read in one pass over its chunks."""
    packed = {
        topic: channel.payloads
        for topic, channel in usable.items()
        if isinstance(channel.payloads, ChunkedPayloads) and channel.payloads.is_packed
    }
    are_images = {topic: usable[topic].message_type in IMAGE_TYPES for topic in packed}
    understood = [t for t in packed if usable[t].message_type in _all_types() | {_INFO} | TF_TYPES]
    wanted = [(packed[t], HEADER_BYTES if are_images[t] else MAX_SENSOR_BYTES) for t in understood]
    held = dict(usable)
    for topic, messages in zip(understood, read_together(wanted), strict=True):
        if are_images[topic]:
            found.headers[topic] = messages
        else:
            held[topic] = replace(usable[topic], payloads=HeldPayloads(messages))
    return held


def _all_types() -> set[str]:
    return {message_type for types in _ROLE_TYPES.values() for message_type in types}


def _channels_of(role: str, usable: Mapping[str, Channel], topics: TopicMap) -> dict[str, Channel]:
    types = _ROLE_TYPES[role]
    candidates = {topic: c for topic, c in usable.items() if c.message_type in types}
    chosen = topics.chosen(role)
    if chosen is None:
        if role == "camera":
            candidates = _one_topic_per_camera(candidates)
        names = sensor_names(list(candidates), role)
        return {names[topic]: channel for topic, channel in candidates.items()}
    missing = [topic for topic in chosen.values() if topic not in candidates]
    if missing:
        raise UsageError(
            f"No topic {missing[0]!r} that could be a {role} in this recording.",
            remedy=f"It has: {', '.join(candidates) or 'none of this type'}.",
        )
    return {name: candidates[topic] for name, topic in chosen.items()}


def _one_topic_per_camera(images: Mapping[str, Channel]) -> dict[str, Channel]:
    """Of several image topics of one camera (raw, compressed, rectified) the fullest, then the least treated."""
    groups: dict[str, list[Channel]] = {}
    for topic, channel in images.items():
        if "depth" not in topic.lower().split("/")[-1]:
            groups.setdefault(camera_base(topic), []).append(channel)

    def preference(channel: Channel) -> tuple[int, bool, bool, str]:
        rectified = "rect" in channel.topic
        return (-len(channel), rectified, channel.message_type == COMPRESSED, channel.topic)

    best = [min(group, key=preference) for group in groups.values()]
    return {channel.topic: channel for channel in sorted(best, key=lambda c: c.topic)}


def _add_camera(name: str, channel: Channel, usable: Mapping[str, Channel], found: _RosStreams) -> None:
    stamped = stamped_rows(name, channel, found.headers.get(channel.topic))
    order, repaired = time_order(name, stamped.timestamps_ns)
    if not len(order):
        raise InputError(f"{channel.topic} has no readable message.")
    rows, stamps = stamped.rows[order], stamped.timestamps_ns[order]
    size = first_image_size(channel, rows)
    model, remark = _camera_model(name, channel, usable, size)
    found.findings += [*stamped.findings, *repaired, *remark]
    found.cameras[name] = CameraStream(
        name,
        stamps,
        RosFrames(channel, rows, stamps, size),
        size.width_px,
        size.height_px,
        model,
        channel.topic,
        stamped.frame_id,
    )


def _camera_model(
    name: str, channel: Channel, usable: Mapping[str, Channel], size: ImageSize
) -> tuple[CameraModel | None, Sequence[Finding]]:
    topic = f"{camera_base(channel.topic)}/camera_info"
    infos = usable.get(topic)
    if infos is None or infos.message_type != _INFO:
        message = f"no camera_info (looked for {topic}): intrinsics must be given."
        return None, [Finding("warning", name, message)]
    for _, info in decode_all(infos):
        return model_from_info(name, info, size)
    return None, [Finding("warning", name, f"no message of {topic} can be read.")]


def model_from_info(name: str, info: Any, size: ImageSize) -> tuple[CameraModel | None, Sequence[Finding]]:
    """The lens of a CameraInfo message (ROS 1 or 2), or None and why the message cannot be used."""
    if (info.width, info.height) not in ((0, 0), size):
        message = (
            f"camera_info is for {info.width} x {info.height}, images are {size.width_px} x {size.height_px}: "
            "its intrinsics are not used."
        )
        return None, [Finding("error", name, message)]
    D, K = (info.D, info.K) if hasattr(info, "D") else (info.d, info.k)  # capitals in ROS 1 only
    try:
        return camera_from_info(info.distortion_model, D, K, *size), []
    except CameraError as error:
        return None, [Finding("warning", name, f"camera_info is not usable: {error.cause}")]


def _add_imu(name: str, channel: Channel, found: _RosStreams) -> None:
    stream, attitude, findings = read_imu(name, channel)
    found.imus[name] = stream
    if attitude is not None:
        found.attitudes[name] = attitude
    found.findings += findings


def _add_fix(name: str, channel: Channel, found: _RosStreams) -> None:
    found.gnss[name], findings = read_fix(name, channel)
    found.findings += findings


def _add_transforms(channels: Sequence[Channel], found: _RosStreams) -> None:
    static = [c for c in channels if c.message_type in TF_TYPES and c.topic.endswith("tf_static")]
    moving = [c for c in channels if c.message_type in TF_TYPES and not c.topic.endswith("tf_static")]
    transforms, findings = read_static(static)
    found.poses, never_moving, moving_findings = read_moving(moving)
    found.static_transforms = never_moving | transforms
    found.findings += [*findings, *moving_findings]


def _add_poses(name: str, channel: Channel, found: _RosStreams) -> None:
    found.poses[name], findings = read_poses(name, channel)
    found.findings += findings
