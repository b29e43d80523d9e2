"""Inertial, satellite and pose topics of ROS bags as streams."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from rigwake._types import Array, Stamps
from rigwake.errors import InputError
from rigwake.geometry import so3
from rigwake.geometry.geodesy import enu_from_lla
from rigwake.geometry.se3 import SE3
from rigwake.readers.channels import Channel
from rigwake.readers.ros_decoding import decode_all, stamped_rows, trailing_doubles
from rigwake.readers.streams import LARGEST_VALUE, symmetric_psd, unit_quaternions, usable_rows
from rigwake.recording import AttitudeStream, Finding, GnssStream, ImuStream
from rigwake.trajectory import Trajectory

IMU, FIX = "sensor_msgs/msg/Imu", "sensor_msgs/msg/NavSatFix"
STANDARD_GRAVITY = 9.80665
_UNKNOWN_GNSS_VARIANCE = 25.0  # m^2, an unaided receiver; used where a fix states no covariance
_NO_FIX = -1

Findings = tuple[Finding, ...]


def read_imu(name: str, channel: Channel) -> tuple[ImuStream, AttitudeStream | None, Findings]:
    """IMU samples, and the attitude they carry if the driver marks it as present.

    REP-145: a first orientation covariance of -1 says that there is no orientation. Raises InputError if no
    sample can be read.
    """
    payloads = list(channel.payloads.read(range(len(channel))))
    stamped = stamped_rows(name, channel, payloads)
    values = trailing_doubles([payloads[row] for row in stamped.rows], 37, channel.encoding)
    gyro, accel = values[:, 13:16], values[:, 25:28]
    rows, repaired = usable_rows(name, stamped.timestamps_ns, gyro, accel)
    if not len(rows):
        raise InputError(f"{channel.topic} holds no readable IMU sample.")
    stream = ImuStream(
        name, stamped.timestamps_ns[rows], gyro[rows], accel[rows], channel.topic, stamped.frame_id
    )
    findings = (*stamped.findings, *repaired)
    return stream, _attitude(stream, values[rows, :4], values[rows, 4:13].reshape(-1, 3, 3)), findings


def _attitude(stream: ImuStream, quat_xyzw: Array, covariances: Array) -> AttitudeStream | None:
    if np.isnan(unit_quaternions(quat_xyzw)).any() or not covariances[0, 0, 0] >= 0:
        return None
    if np.ptp(quat_xyzw, axis=0).max() == 0:  # never filled in: identity all along
        return None
    rotations = so3.matrix_from_quat_wxyz(np.roll(quat_xyzw, 1, axis=1))
    # the message states covariances about the fixed axes of the world; ours are about body axes
    body = np.swapaxes(rotations, 1, 2) @ symmetric_psd(covariances, np.radians(5.0) ** 2) @ rotations
    return AttitudeStream(stream.name, stream.timestamps_ns, rotations, body, stream.topic, stream.frame_id)


def read_fix(name: str, channel: Channel) -> tuple[GnssStream, Findings]:
    """Satellite positions in the plane tangent at the first fix. Raises InputError if there is none."""
    stamped = stamped_rows(name, channel)
    messages = dict(decode_all(channel))
    kept = [at for at, row in enumerate(stamped.rows) if row in messages]
    fixes = [messages[stamped.rows[at]] for at in kept]
    valid = np.array([fix.status.status != _NO_FIX for fix in fixes], dtype=bool)
    lla = np.array([(fix.latitude, fix.longitude, fix.altitude) for fix in fixes]).reshape(-1, 3)
    plausible = (np.abs(lla[:, 0]) <= 90) & (np.abs(lla[:, 1]) <= 360)
    lla[~(valid & plausible)] = np.nan
    rows, repaired = usable_rows(name, stamped.timestamps_ns[kept], lla)
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
        symmetric_psd(covariances, _UNKNOWN_GNSS_VARIANCE),
        origin,
        topic=channel.topic,
        frame_id=stamped.frame_id,
    )
    findings = [*stamped.findings, *repaired]
    if unknown.any():
        message = f"{int(unknown.sum())} fixes state no covariance; 5 m per axis is assumed."
        findings.append(Finding("note", name, message))
    return stream, tuple(findings)


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
    payloads = list(channel.payloads.read(range(len(channel))))
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
