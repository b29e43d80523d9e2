"""The transforms of ROS bags: /tf_static (all its latched connections) and /tf."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any, NamedTuple

import numpy as np

from rigwake.errors import InputError
from rigwake.geometry.se3 import SE3
from rigwake.readers.channels import Channel
from rigwake.readers.printable import printable
from rigwake.readers.ros_decoding import decode_all
from rigwake.readers.ros_sensors import pose_trajectory
from rigwake.readers.streams import LARGEST_VALUE, unit_quaternions
from rigwake.recording import Finding
from rigwake.trajectory import Trajectory

TF = "tf2_msgs/msg/TFMessage"
_OLD_TF = "tf/msg/tfMessage"
TF_TYPES = frozenset({TF, _OLD_TF})

MAX_TF_BYTES = 2**20
"""A message of transforms that is larger is damage."""

StaticTransforms = dict[tuple[str, str], SE3]
_STILL = 1e-9  # spread of position (m) and quaternion below which a /tf edge is a fixed joint


class _Joint(NamedTuple):
    """One transform of a message, and when it was recorded."""

    log_time_ns: int
    stamped: Any


def read_transforms(
    channels: Iterable[Channel],
) -> tuple[dict[str, Trajectory], StaticTransforms, list[Finding]]:
    """Trajectories of joints that move, by `parent/child`; `parent_from_child` of fixed ones; what was repaired.

    As tf2 has it: a frame has one parent, and what was recorded last about it holds. Joints of /tf that never move
    are fixed; about those /tf_static has the last word.
    """
    tf = [c for c in channels if c.message_type in TF_TYPES]
    static, findings = read_static([c for c in tf if c.topic.endswith("tf_static")])
    moving, still, more = read_moving([c for c in tf if not c.topic.endswith("tf_static")])
    children = {child for _, child in static}
    fixed = {edge: joint for edge, joint in still.items() if edge[1] not in children}
    return moving, fixed | static, [*findings, *more]


def _joints(channels: Iterable[Channel]) -> tuple[list[_Joint], list[Finding]]:
    """The transforms of all messages of all channels, in the order of recording; how many cannot be read."""
    joints, findings = [], []
    for channel in channels:
        read = 0
        for row, message in decode_all(channel, MAX_TF_BYTES):
            joints += [_Joint(int(channel.log_times_ns[row]), stamped) for stamped in message.transforms]
            read += 1
        if read < len(channel):
            words = f"{len(channel) - read} of {len(channel)} messages are damaged; they were dropped."
            findings.append(Finding("warning", channel.topic, words))
    return sorted(joints, key=lambda joint: joint.log_time_ns), findings


def read_static(channels: Iterable[Channel]) -> tuple[StaticTransforms, list[Finding]]:
    """`parent_from_child` by `(parent, child)`: of each child what was recorded last, whatever its parent."""
    newest: dict[str, tuple[str, SE3]] = {}
    changed: dict[str, str] = {}
    joints, findings = _joints(channels)
    for joint in joints:
        parent, child = _edge(joint.stamped)
        if parent == child:
            findings.append(Finding("warning", "tf_static", f"{child} is its own parent; left out."))
            continue
        try:
            parent_from_child = _single(joint.stamped)
        except InputError as error:
            findings.append(Finding("warning", "tf_static", f"{parent} -> {child}: {error.cause}"))
            continue
        if child in newest:
            former, former_from_child = newest[child]
            if former != parent:
                changed[child] = f"{child} has two parents, {former} and {parent}; the last recorded is kept."
            elif np.abs(former_from_child.local(parent_from_child)).max() > 1e-6:
                changed[child] = f"{parent} -> {child} is given several times, differently. The last is kept."
        newest[child] = parent, parent_from_child
    findings += [Finding("warning", "tf_static", message) for message in changed.values()]
    return {(parent, child): joint for child, (parent, joint) in newest.items()}, findings


def _edge(stamped: Any) -> tuple[str, str]:
    return printable(stamped.header.frame_id).lstrip("/"), printable(stamped.child_frame_id).lstrip("/")


def _values(stamped: Any) -> tuple[float, ...]:
    position, q = stamped.transform.translation, stamped.transform.rotation
    return position.x, position.y, position.z, q.w, q.x, q.y, q.z


def _single(stamped: Any) -> SE3:
    values = np.array(_values(stamped))
    if not (np.abs(values) < LARGEST_VALUE).all() or np.isnan(unit_quaternions(values[None, 3:])).any():
        raise InputError("the transform is not finite or its quaternion not of unit length; it is left out.")
    return SE3.from_quat_wxyz(values[3:], values[:3])


def read_moving(
    channels: Iterable[Channel],
) -> tuple[dict[str, Trajectory], StaticTransforms, list[Finding]]:
    """Trajectories of /tf, one per joint, named `parent/child`; joints that never move are static."""
    stamps: dict[tuple[str, str], list[int]] = {}
    values: dict[tuple[str, str], list[tuple[float, ...]]] = {}
    parents: dict[str, str] = {}
    joints, findings = _joints(channels)
    for joint in joints:
        edge, stamp = _edge(joint.stamped), joint.stamped.header.stamp
        stamps.setdefault(edge, []).append(stamp.sec * 10**9 + stamp.nanosec)
        values.setdefault(edge, []).append(_values(joint.stamped))
        parents[edge[1]] = edge[0]
    trajectories: dict[str, Trajectory] = {}
    static: StaticTransforms = {}
    for edge, rows in values.items():
        array = np.array(rows)
        name = "/".join(edge)
        try:
            trajectory, repaired = pose_trajectory(
                name, np.array(stamps[edge], dtype=np.int64), array[:, :3], array[:, 3:]
            )
        except InputError as error:
            findings.append(Finding("warning", name, error.cause))
            continue
        if np.ptp(array, axis=0).max() < _STILL:
            if parents[edge[1]] == edge[0]:
                static[edge] = trajectory.world_from_body[0]
        else:
            trajectories[name] = trajectory
            findings += repaired
    return trajectories, static, findings
