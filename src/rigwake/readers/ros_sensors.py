"""Satellite and pose topics of ROS bags as streams."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from rigwake._types import Array, Stamps
from rigwake.errors import InputError
from rigwake.geometry.geodesy import enu_from_lla
from rigwake.geometry.se3 import SE3
from rigwake.readers.channels import Channel
from rigwake.readers.ros_decoding import (
    MAX_SENSOR_BYTES,
    decode_all,
    stamped_rows,
    trailing_doubles,
    whole_payloads,
)
from rigwake.readers.streams import LARGEST_VALUE, symmetric_psd, unit_quaternions, usable_rows
from rigwake.recording import Finding, GnssStream
from rigwake.trajectory import Trajectory

FIX = "sensor_msgs/msg/NavSatFix"
STANDARD_GRAVITY = 9.80665
_UNKNOWN_GNSS_VARIANCE = 25.0  # m^2, an unaided receiver; used where a fix states no covariance
_UNKNOWN_HEIGHT_VARIANCE = 1e6  # m^2
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
    lla = np.array([(fix.latitude, fix.longitude, fix.altitude) for fix in fixes]).reshape(-1, 3)
    without = np.array([fix.status.status == _NO_FIX for fix in fixes], dtype=bool)
    null_island = (lla[:, :2] == 0).all(axis=1) & ~without
    plausible = (np.abs(lla[:, 0]) <= 90) & (np.abs(lla[:, 1]) <= 360)
    flat = np.isnan(lla[:, 2]) & plausible
    lla[flat, 2] = float(np.median(lla[~flat & plausible, 2])) if (~flat & plausible).any() else 0.0
    dropped = without | null_island
    good = np.flatnonzero(~dropped)
    lla[~plausible] = np.nan
    usable, repaired = usable_rows(name, stamped.timestamps_ns[kept][good], lla[good])
    rows = good[usable]
    if not len(rows):
        raise InputError(f"{channel.topic} holds no valid fix.")
    covariances = np.array([fixes[row].position_covariance for row in rows]).reshape(-1, 3, 3)
    unknown = np.array([fixes[row].position_covariance_type == 0 for row in rows])
    covariances[unknown] = 0.0
    origin = (float(lla[rows[0], 0]), float(lla[rows[0], 1]), float(lla[rows[0], 2]))
    stream = GnssStream(
        name,
        stamped.timestamps_ns[kept][rows],
        enu_from_lla(lla[rows], origin),
        _covariances(covariances, flat[rows]),
        origin,
        topic=channel.topic,
        frame_id=stamped.frame_id,
    )
    counted = (
        ("note", int(without.sum()), "messages say that there is no fix; they were dropped."),
        (
            "warning",
            int(null_island.sum()),
            "fixes lie at latitude and longitude 0: no position yet; dropped.",
        ),
        ("warning", int(flat[rows].sum()), "fixes have no altitude: their height is unknown."),
        ("note", int(unknown.sum()), "fixes state no covariance; 5 m per axis is assumed."),
    )
    remarks = [Finding(severity, name, f"{count} {words}") for severity, count, words in counted if count]
    return stream, (*stamped.findings, *repaired, *remarks)


def _covariances(stated: Array, flat: NDArray[np.bool_]) -> Array:
    """(N, 3, 3) with unknown ones replaced, and heights that are unknown marked so."""
    horizontal = stated[flat].copy()
    horizontal[:, 2, :] = horizontal[:, :, 2] = 0.0
    horizontal[:, 2, 2] = _UNKNOWN_HEIGHT_VARIANCE
    covariances = stated.copy()
    covariances[flat] = horizontal
    covariances = symmetric_psd(covariances, _UNKNOWN_GNSS_VARIANCE)
    covariances[flat, 2, 2] = _UNKNOWN_HEIGHT_VARIANCE
    return covariances


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
