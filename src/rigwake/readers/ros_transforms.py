"""The transforms of ROS bags: /tf_static (all its latched connections) and /tf."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np

from rigwake.errors import InputError
from rigwake.geometry.se3 import SE3
from rigwake.readers.channels import Channel
from rigwake.readers.ros_decoding import decode_all
from rigwake.readers.ros_sensors import pose_trajectory
from rigwake.readers.streams import LARGEST_VALUE, unit_quaternions
from rigwake.recording import Finding
from rigwake.trajectory import Trajectory

TF = "tf2_msgs/msg/TFMessage"
_OLD_TF = "tf/msg/tfMessage"
TF_TYPES = frozenset({TF, _OLD_TF})

StaticTransforms = dict[tuple[str, str], SE3]
_STILL = 1e-9  # spread of position (m) and quaternion below which a /tf edge is a fixed joint


def read_static(channels: Iterable[Channel]) -> tuple[StaticTransforms, list[Finding]]:
    """`parent_from_child` by `(parent, child)`, of all messages; where a joint is repeated the last holds."""
    transforms: StaticTransforms = {}
    findings: list[Finding] = []
    for channel in channels:
        for _, message in decode_all(channel):
            for stamped in message.transforms:
                edge = _edge(stamped)
                try:
                    parent_from_child = _single(stamped)
                except InputError as error:
                    findings.append(Finding("warning", "tf_static", f"{edge[0]} -> {edge[1]}: {error.cause}"))
                    continue
                if edge in transforms and np.abs(transforms[edge].local(parent_from_child)).max() > 1e-6:
                    message_text = f"{edge[0]} -> {edge[1]} is given several times, differently."
                    findings.append(Finding("warning", "tf_static", f"{message_text} The last is kept."))
                transforms[edge] = parent_from_child
    return transforms, findings


def _edge(stamped: Any) -> tuple[str, str]:
    return stamped.header.frame_id.lstrip("/"), stamped.child_frame_id.lstrip("/")


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
    for channel in channels:
        for _, message in decode_all(channel):
            for stamped in message.transforms:
                edge, stamp = _edge(stamped), stamped.header.stamp
                stamps.setdefault(edge, []).append(stamp.sec * 10**9 + stamp.nanosec)
                values.setdefault(edge, []).append(_values(stamped))
    trajectories: dict[str, Trajectory] = {}
    static: StaticTransforms = {}
    findings: list[Finding] = []
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
            static[edge] = trajectory.world_from_body[0]
        else:
            trajectories[name] = trajectory
            findings += repaired
    return trajectories, static, findings
