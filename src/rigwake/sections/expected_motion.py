"""How the rig moved, roughly, from gyroscope, accelerometer and GNSS alone: before a single picture is tracked."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import gaussian_filter1d

from rigwake._types import Array, Indices
from rigwake.ba.rig.gnss_noise import white_noise
from rigwake.geometry.interpolate import interpolate
from rigwake.geometry.se3 import SE3
from rigwake.inspection.vessel_motion import levelled_rotations
from rigwake.recording import GnssStream, ImuStream
from rigwake.trajectory import Trajectory

_GRID_HZ = 5.0
_LEAST_SMOOTHING_S, _MOST_SMOOTHING_S = 0.5, 4.0
_WANTED_SPEED_STD = 0.05  # m/s: positions are smoothed until noise makes no more speed than this
_ASSUMED_SPEED = 1.5  # m/s, without GNSS
_LEAST_SPEED = 0.2  # m/s: below it, the course says nothing about the heading


@dataclass(frozen=True, eq=False)
class ExpectedMotion:
    """world_from_rig: the rig's trajectory, z up, at `_GRID_HZ` (heading from an unknown start where there is an IMU).
    velocity_world: (N, 3). up_rig: (3,) the mean direction of up in rig axes."""

    world_from_rig: Trajectory
    velocity_world: Array
    up_rig: Array

    def at(self, timestamps_ns: Indices) -> tuple[SE3, Array]:
        """Poses and velocities (n, 3) at stamps within the span."""
        path = self.world_from_rig
        stamps = np.clip(timestamps_ns, path.timestamps_ns[0], path.timestamps_ns[-1])
        since = (path.timestamps_ns - path.timestamps_ns[0]) * 1e-9
        wanted = (stamps - path.timestamps_ns[0]) * 1e-9
        velocity = np.stack([np.interp(wanted, since, v) for v in self.velocity_world.T], axis=1)
        return interpolate(path.timestamps_ns, path.world_from_body, stamps), velocity


def expected_motion(imu: ImuStream | None, gnss: GnssStream | None) -> ExpectedMotion | None:
    """The motion that an IMU, a receiver or both tell; None without both, or where they are too short.

    Attitude is the IMU's (a complementary filter), else the course over ground; positions are the smoothed fixes,
    else a straight way at walking speed: without GNSS nothing cheap tells the path.
    """
    streams = [stream for stream in (imu, gnss) if stream is not None]
    if not streams or min(len(stream.timestamps_ns) for stream in streams) < 10:
        return None
    first = max(int(stream.timestamps_ns[0]) for stream in streams)
    last = min(int(stream.timestamps_ns[-1]) for stream in streams)
    if last - first < 2e9:
        return None
    stamps = np.arange(first, last, round(1e9 / _GRID_HZ))
    if imu is not None:
        every = SE3(levelled_rotations(imu), np.zeros((len(imu.gyro), 3)))
        rotation = interpolate(imu.timestamps_ns, every, stamps).rotation
    if gnss is not None:
        position = _smoothed_positions(gnss, stamps)
        velocity = np.gradient(position, 1 / _GRID_HZ, axis=0)
    else:
        # forward: any level axis of the rig will do, as nobody knows yet where the bow is
        forward = rotation[:, :, 0] * [1.0, 1.0, 0.0]
        norm = np.linalg.norm(forward, axis=1, keepdims=True)
        velocity = _ASSUMED_SPEED * forward / np.maximum(norm, 1e-6)
        position = np.cumsum(velocity, axis=0) / _GRID_HZ
    if imu is None:
        rotation = _course_rotations(velocity)
    up = rotation[:, 2].mean(axis=0)
    path = Trajectory("rig", stamps, SE3(rotation, position))
    return ExpectedMotion(path, velocity, up / max(float(np.linalg.norm(up)), 1e-9))


def _smoothed_positions(gnss: GnssStream, stamps: Indices) -> Array:
    """(N, 3) fixes averaged over so long that their noise does not look like motion."""
    since, wanted = (gnss.timestamps_ns - stamps[0]) * 1e-9, (stamps - stamps[0]) * 1e-9
    noise = float(white_noise(gnss.timestamps_ns, gnss.position_enu)[:2].max())
    rate_hz = 1 / max(float(np.median(np.diff(since))), 1e-3)
    # a Gaussian of width s leaves noise / sqrt(3.5 rate s) in positions, and about 1 / s of that in speeds
    width_s = (noise / (_WANTED_SPEED_STD * np.sqrt(3.5 * rate_hz))) ** (2 / 3)
    width_s = float(np.clip(width_s, _LEAST_SMOOTHING_S, _MOST_SMOOTHING_S))
    on_grid = np.stack([np.interp(wanted, since, axis) for axis in gnss.position_enu.T], axis=1)
    return np.asarray(gaussian_filter1d(on_grid, width_s * _GRID_HZ, axis=0, mode="nearest"))


def _course_rotations(velocity: Array) -> Array:
    """(N, 3, 3) level, x ahead; while standing still the heading stays."""
    moving = np.linalg.norm(velocity[:, :2], axis=1) > _LEAST_SPEED
    heading = np.unwrap(np.arctan2(velocity[moving, 1], velocity[moving, 0]))
    at = np.flatnonzero(moving)
    filled = np.interp(np.arange(len(velocity)), at, heading) if len(at) else np.zeros(len(velocity))
    cos, sin, none, one = np.cos(filled), np.sin(filled), np.zeros(len(filled)), np.ones(len(filled))
    rows = [np.stack([cos, -sin, none], 1), np.stack([sin, cos, none], 1), np.stack([none, none, one], 1)]
    return np.stack(rows, axis=1)
