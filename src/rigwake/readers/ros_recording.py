"""From the channels of a ROS bag to a `Recording`: which topic is which sensor, by type and by name."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

from rigwake.errors import CameraError, InputError, UsageError
from rigwake.geometry.se3 import SE3
from rigwake.readers.camera_info_choice import INFO, MAX_INFO_BYTES
from rigwake.readers.channels import BagIndex, Channel, HeldPayloads
from rigwake.readers.chunks import ChunkedPayloads, read_together
from rigwake.readers.printable import printable
from rigwake.readers.rig_description import (
    MAX_TEXT_BYTES,
    RIG_TOPIC,
    TRUTH_PREFIX,
    RigDescription,
    description_of_text,
    with_description,
)
from rigwake.readers.ros_cameras import read_cameras_of_bag
from rigwake.readers.ros_decoding import HEADER_BYTES, MAX_SENSOR_BYTES, decode_all, has_standard_type
from rigwake.readers.ros_frames import IMAGE_TYPES
from rigwake.readers.ros_imus import IMU, read_imus
from rigwake.readers.ros_sensors import (
    FIX,
    POSE_TYPES,
    VELOCITY_TYPES,
    read_fix,
    read_poses,
    with_velocity,
)
from rigwake.readers.ros_transforms import MAX_TF_BYTES, TF_TYPES, read_transforms
from rigwake.readers.topics import TopicMap, distinct_names, sensor_names
from rigwake.recording import (
    AttitudeStream,
    CameraStream,
    Finding,
    GnssStream,
    ImuStream,
    Recording,
)
from rigwake.trajectory import Trajectory

_STRING = "std_msgs/msg/String"
_ROLE_TYPES = {"camera": IMAGE_TYPES, "imu": {IMU}, "gnss": {FIX}, "pose": POSE_TYPES}
_UNDERSTOOD = frozenset().union(*_ROLE_TYPES.values(), {INFO}, TF_TYPES, VELOCITY_TYPES)


def is_read(topic: str, message_type: str) -> bool:
    """Whether `recording_from_bag` makes anything of such a topic; message_type: `package/msg/Name`."""
    return message_type in _UNDERSTOOD or (topic == RIG_TOPIC and message_type == _STRING)


@dataclass
class _RosStreams:
    """Sensors gathered while going through the topics."""

    cameras: dict[str, CameraStream] = field(default_factory=dict)
    imus: dict[str, ImuStream] = field(default_factory=dict)
    gnss: dict[str, GnssStream] = field(default_factory=dict)
    attitudes: dict[str, AttitudeStream] = field(default_factory=dict)
    poses: dict[str, Trajectory] = field(default_factory=dict)
    truth: dict[str, Trajectory] = field(default_factory=dict)
    static_transforms: dict[tuple[str, str], SE3] = field(default_factory=dict)
    findings: list[Finding] = field(default_factory=list)
    headers: dict[str, list[bytes]] = field(default_factory=dict)


def recording_from_bag(path: Path, bag: BagIndex, topics: TopicMap) -> Recording:
    """Everything the bag holds that rigwake understands; what is left out or repaired is in `findings`.

    Raises UsageError if `topics` names one that is not there or has a wrong type.
    """
    found = _RosStreams(
        findings=[replace(f, sensor=printable(f.sensor), message=printable(f.message)) for f in bag.findings]
    )
    usable = _held_where_packed(_usable_channels(bag, found), found)
    description = _description_inside(usable, found)
    truth = {topic: c for topic, c in usable.items() if topic.startswith(TRUTH_PREFIX)}
    usable = {topic: c for topic, c in usable.items() if topic not in truth}
    chosen = {role: _channels_of(role, usable, topics, description) for role in _ROLE_TYPES}
    moving, found.static_transforms, findings = read_transforms(usable.values())
    found.poses |= moving
    found.cameras, camera_findings = read_cameras_of_bag(usable, found.headers, topics, description)
    found.imus, found.attitudes, imu_findings = read_imus(chosen["imu"], found.static_transforms)
    found.findings += [*findings, *camera_findings, *imu_findings]
    for name, channel in chosen["gnss"].items():
        _try(name, channel, found, _add_fix)
    found.gnss = {name: with_velocity(fixes, usable) for name, fixes in found.gnss.items()}
    for name, channel in chosen["pose"].items():
        _try(name, channel, found, _add_poses)
    for topic, channel in truth.items():
        _try(
            description.name_of("truth", topic, topic.removeprefix(TRUTH_PREFIX)), channel, found, _add_truth
        )
    recording = Recording(
        path,
        bag.kind,
        found.cameras,
        found.imus,
        found.gnss,
        found.attitudes,
        found.poses,
        found.static_transforms,
        true_trajectories=found.truth,
        findings=tuple(found.findings),
    )
    return with_description(recording, description)


def _description_inside(usable: Mapping[str, Channel], found: _RosStreams) -> RigDescription:
    """What a bag that rigwake wrote says of itself."""
    channel = usable.get(RIG_TOPIC)
    if channel is None or channel.message_type != _STRING:
        return RigDescription()
    for _, message in decode_all(channel, MAX_TEXT_BYTES):
        try:
            return description_of_text(message.data)
        except InputError as error:
            found.findings.append(Finding("warning", RIG_TOPIC, error.cause))
    return RigDescription()


def _try(
    name: str, channel: Channel, found: _RosStreams, add: Callable[[str, Channel, _RosStreams], None]
) -> None:
    try:
        add(name, channel, found)
    except (InputError, CameraError) as error:
        found.findings.append(Finding("error", name, f"left out: {error.cause}"))


def _usable_channels(bag: BagIndex, found: _RosStreams) -> dict[str, Channel]:
    """By topic, those that hold messages of a standard type. Of a topic with several types that are understood
    the one with the most messages; the others are named."""
    usable: dict[str, Channel] = {}
    for given in bag.channels:
        channel = replace(given, topic=printable(given.topic), message_type=printable(given.message_type))
        topic = channel.topic
        if not len(channel):
            continue
        if not has_standard_type(channel):
            if any(_resembles(channel.message_type, known) for known in _UNDERSTOOD):
                message = f"{topic}: {channel.message_type} is not the standard message; it is left out."
                found.findings.append(Finding("warning", topic, message))
            continue
        other = usable.get(topic)
        if other is None:
            usable[topic] = channel
            continue
        kept, dropped = (channel, other) if _weight(channel) > _weight(other) else (other, channel)
        usable[topic] = kept
        if dropped.message_type in _UNDERSTOOD:
            message = (
                f"{topic} holds messages of two types: the {len(kept)} {kept.message_type} are used, the "
                f"{len(dropped)} {dropped.message_type} are left out."
            )
            found.findings.append(Finding("warning", topic, message))
    return usable


def _resembles(message_type: str, known: str) -> bool:
    """Whether a type is this one but for two letters, or cut off: then its name was damaged."""
    if 4 < len(message_type) < len(known) and known.startswith(message_type):
        return True
    different = sum(a != b for a, b in zip(message_type, known, strict=False))
    return different <= 2 and abs(len(message_type) - len(known)) <= 2


def _weight(channel: Channel) -> tuple[bool, int]:
    return channel.message_type in _UNDERSTOOD, len(channel)


def _held_where_packed(usable: Mapping[str, Channel], found: _RosStreams) -> dict[str, Channel]:
    """Of a packed bag all messages but images, and the headers of images, read in one pass over its chunks."""
    packed: dict[Path, list[tuple[str, ChunkedPayloads]]] = {}
    for topic, channel in usable.items():
        payloads = channel.payloads
        if (
            isinstance(payloads, ChunkedPayloads)
            and payloads.is_packed
            and channel.message_type in _UNDERSTOOD
        ):
            packed.setdefault(payloads.path, []).append((topic, payloads))
    held = dict(usable)
    for members in packed.values():
        wanted = [(payloads, _limit_bytes(usable[topic])) for topic, payloads in members]
        for (topic, _), messages in zip(members, read_together(wanted), strict=True):
            if usable[topic].message_type in IMAGE_TYPES:
                found.headers[topic] = messages
            else:
                held[topic] = replace(usable[topic], payloads=HeldPayloads(messages))
    return held


def _limit_bytes(channel: Channel) -> int:
    """More of a message of this type is not held in memory."""
    if channel.message_type in IMAGE_TYPES:
        return HEADER_BYTES
    if channel.message_type in (INFO, _STRING):
        return MAX_INFO_BYTES if channel.message_type == INFO else MAX_TEXT_BYTES
    return MAX_TF_BYTES if channel.message_type in TF_TYPES else MAX_SENSOR_BYTES


def names_in_role(role: str, topics: Sequence[str], description: RigDescription) -> dict[str, str]:
    """Names of sensors by topic: what the recording says of itself, else as recognised from the topics."""
    given = sensor_names(topics, role)
    if role == "imu":  # an attitude without rates travels as the same type
        given = {topic: description.name_of("attitude", topic, name) for topic, name in given.items()}
    return distinct_names({topic: description.name_of(role, topic, n) for topic, n in given.items()})


def _channels_of(
    role: str, usable: Mapping[str, Channel], topics: TopicMap, description: RigDescription
) -> dict[str, Channel]:
    types = _ROLE_TYPES[role]
    candidates = {topic: c for topic, c in usable.items() if c.message_type in types}
    chosen = topics.chosen(role)
    if chosen is None:
        names = names_in_role(role, list(candidates), description)
        return {names[topic]: channel for topic, channel in candidates.items()}
    missing = [topic for topic in chosen.values() if topic not in candidates]
    if missing:
        raise UsageError(
            f"No topic {missing[0]!r} that could be a {role} in this recording.",
            remedy=f"It has: {', '.join(candidates) or 'none of this type'}.",
        )
    return {name: candidates[topic] for name, topic in chosen.items()}


def _add_fix(name: str, channel: Channel, found: _RosStreams) -> None:
    found.gnss[name], findings = read_fix(name, channel)
    found.findings += findings


def _add_poses(name: str, channel: Channel, found: _RosStreams) -> None:
    found.poses[name], findings = read_poses(name, channel)
    found.findings += findings


def _add_truth(name: str, channel: Channel, found: _RosStreams) -> None:
    found.truth[name], findings = read_poses(name, channel)
    found.findings += findings
