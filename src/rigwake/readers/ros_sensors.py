"""Satellite and pose topics of ROS bags as streams."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from rigwake._types import Array, Stamps
from rigwake.errors import InputError
from rigwake.geometry.se3 import SE3
from rigwake.readers.channels import Channel
from rigwake.readers.gnss_fixes import gnss_stream_of_fixes
from rigwake.readers.ros_decoding import (
    MAX_SENSOR_BYTES,
    decode_all,
    stamped_rows,
    trailing_doubles,
    whole_payloads,
)
from rigwake.readers.streams import LARGEST_VALUE, unit_quaternions, usable_rows
from rigwake.recording import Finding, GnssStream
from rigwake.trajectory import Trajectory

FIX = "sensor_msgs/msg/NavSatFix"
_NO_FIX = -1

Findings = tuple[Finding, ...]


def read_fix(name: str, channel: Channel) -> tuple[GnssStream, Findings]:
    """Satellite positions in the plane tangent at the first fix. Raises InputError if there is none.

    Fixes without an altitude (2-D) keep their horizontal position; their height is unknown, which is said by its
    variance. A latitude and longitude of exactly zero is a receiver that has no position yet.
    """
    stamped = stamped_rows(name, channel)
    messages = dict(decode_all(channel, MAX_SENSOR_BYTES))
    kept = [at for at, row in enumerate(stamped.rows) if row in messages]
    fixes = [messages[stamped.rows[at]] for at in kept]
    there = np.array([fix.status.status != _NO_FIX for fix in fixes], dtype=bool)
    lla = np.array([(fix.latitude, fix.longitude, fix.altitude) for fix in fixes]).reshape(-1, 3)
    covariances = np.array([fix.position_covariance for fix in fixes]).reshape(-1, 3, 3)
    unknown = np.array([fix.position_covariance_type == 0 for fix in fixes], dtype=bool)
    covariances[unknown] = 0.0
    stream, findings = gnss_stream_of_fixes(
        name,
        stamped.timestamps_ns[kept][there],
        lla[there],
        covariances[there],
        topic=channel.topic,
        frame_id=stamped.frame_id,
    )
    counted = (
        (int((~there).sum()), "messages say that there is no fix; they were dropped."),
        (int((unknown & there).sum()), "fixes state no covariance; 5 m per axis is assumed."),
    )
    remarks = [Finding("note", name, f"{count} {words}") for count, words in counted if count]
    return stream, (*stamped.findings, *findings, *remarks)


_VELOCITY_NUMBERS = {"geometry_msgs/msg/TwistStamped": 6, "geometry_msgs/msg/TwistWithCovarianceStamped": 42}
VELOCITY_TYPES = frozenset(_VELOCITY_NUMBERS)


def with_velocity(gnss: GnssStream, channels: Mapping[str, Channel]) -> GnssStream:
    """The fixes with the velocities (east, north, up) that a receiver publishes beside them with the same stamps.

    As NMEA and u-blox drivers do: `vel` or `velocity` in the namespace of the fix.
    """
    beside = gnss.topic.rpartition("/")[0]
    for topic in (f"{beside}/vel", f"{beside}/velocity", f"{gnss.topic}_velocity", f"{beside}/fix_velocity"):
        channel = channels.get(topic)
        if channel is None or channel.message_type not in VELOCITY_TYPES:
            continue
        payloads = whole_payloads(channel)
        stamped = stamped_rows(topic, channel, payloads)
        count = _VELOCITY_NUMBERS[channel.message_type]
        values = trailing_doubles([payloads[row] for row in stamped.rows], count, channel.encoding)[:, :3]
        by_stamp = dict(zip(stamped.timestamps_ns.tolist(), values, strict=True))
        found = [by_stamp.get(stamp) for stamp in gnss.timestamps_ns.tolist()]
        matching = np.array([np.full(3, np.nan) if v is None else v for v in found]).reshape(-1, 3)
        if (np.abs(matching) < LARGEST_VALUE).all():
            return replace(gnss, velocity_enu=matching)
    return gnss


# How many float64 a pose message ends in: position, quaternion xyzw[, covariance (36)[, twist and covariance (42)]]
_POSE_NUMBERS = {
    "nav_msgs/msg/Odometry": 85,
    "geometry_msgs/msg/PoseWithCovarianceStamped": 43,
    "geometry_msgs/msg/PoseStamped": 7,
    "geometry_msgs/msg/TransformStamped": 7,
}
POSE_TYPES = frozenset(_POSE_NUMBERS)


def read_poses(name: str, channel: Channel) -> tuple[Trajectory, Findings]:
    """A trajectory from a pose topic, metric. Raises InputError if no pose can be read."""
    payloads = whole_payloads(channel)
    stamped = stamped_rows(name, channel, payloads)
    count = _POSE_NUMBERS[channel.message_type]
    values = trailing_doubles([payloads[row] for row in stamped.rows], count, channel.encoding)
    quat_wxyz = values[:, [6, 3, 4, 5]]
    trajectory, findings = pose_trajectory(name, stamped.timestamps_ns, values[:, :3], quat_wxyz)
    if count > 7:
        order = np.argsort(stamped.timestamps_ns, kind="stable")
        rows = order[np.searchsorted(stamped.timestamps_ns[order], trajectory.timestamps_ns)]
        stated = values[rows, 7:43].reshape(-1, 6, 6)
        trajectory = replace(
            trajectory,
            covariances=tangent_covariances(stated, trajectory.world_from_body),
            covariance_kind="poses",
        )
    return trajectory, (*stamped.findings, *findings)


def pose_trajectory(
    name: str, timestamps_ns: Stamps, position: Array, quat_wxyz: Array
) -> tuple[Trajectory, Findings]:
    """A trajectory from raw poses, repaired. Raises InputError if none is usable."""
    quat_wxyz = unit_quaternions(quat_wxyz)
    rows, findings = usable_rows(name, timestamps_ns, position, quat_wxyz)
    if not len(rows):
        raise InputError(f"{name} holds no readable pose.")
    world_from_body = SE3.from_quat_wxyz(quat_wxyz[rows], position[rows])
    return Trajectory(name, timestamps_ns[rows], world_from_body), findings


def tangent_covariances(stated: Array, world_from_body: SE3) -> Array | None:
    """From ROS (position then rotation, about the fixed axes of the world) to our right tangent
    `[rotation, translation]` in body axes: `B^T C B` with `B = blockdiag(R, R)`. None if not stated.

    A pose `R exp(d_r)`, `p + R d_t` deviates by `R d_r` and `R d_t` in world axes, so `d = R^T (...)`.
    """
    if not (np.abs(stated) < LARGEST_VALUE).all() or not (np.einsum("nii->ni", stated) > 0).all():
        return None
    swapped = np.roll(stated, (3, 3), axis=(1, 2))
    B = np.zeros((len(stated), 6, 6))
    B[:, :3, :3] = B[:, 3:, 3:] = world_from_body.rotation
    return np.asarray(np.swapaxes(B, 1, 2) @ ((swapped + np.swapaxes(swapped, 1, 2)) / 2) @ B)
