"""Which way is up, from the IMU alone: gravity outlasts waves and manoeuvres."""

from __future__ import annotations

import numpy as np
from scipy.ndimage import uniform_filter1d

from rigwake._types import Array, Stamps
from rigwake.odometry.gyro import GyroAlignment, integrate_gyro
from rigwake.recording import ImuStream

_LEAST_GRAVITY = (
    5.0  # m/s^2 in the mean: with less, gravity was taken out of the recording, or it is in units of g
)
_WINDOW_S = 20.0  # a turn at 2 m/s moves the mean over so long by about a degree at the most


def up_directions(imu: ImuStream, gyro_bias: Array) -> Array:
    """(N, 3) unit vectors against gravity in IMU axes at its samples, good to about a degree; NaN without gravity.

    The specific force, turned into the axes of the start by the integrated gyro, is averaged over a moving
    window in which accelerations of the vessel cancel: its velocity changes by a few m/s at most.
    """
    turned = integrate_gyro(imu, gyro_bias).rotation
    force_start = np.einsum("nij,nj->ni", turned, imu.accel)
    rate_hz = 1e9 / float(np.median(np.diff(imu.timestamps_ns)))
    mean = uniform_filter1d(force_start, max(int(_WINDOW_S * rate_hz), 1), axis=0, mode="nearest")
    up = np.einsum("nji,nj->ni", turned, mean)
    size = np.linalg.norm(up, axis=1, keepdims=True)
    known = size > _LEAST_GRAVITY
    return np.asarray(np.where(known, up / np.where(known, size, 1.0), np.nan))


def up_in_camera(imu: ImuStream, alignment: GyroAlignment, timestamps_ns: Stamps) -> Array:
    """(F, 3) unit vectors against gravity in the camera's axes at stamps of its own clock; NaN outside the IMU's."""
    on_imu = timestamps_ns + round(alignment.time_offset_s * 1e9)
    times = (imu.timestamps_ns - imu.timestamps_ns[0]) * 1e-9
    at = (on_imu - imu.timestamps_ns[0]) * 1e-9
    up_imu = up_directions(imu, alignment.gyro_bias)
    up = np.stack([np.interp(at, times, up_imu[:, k], left=np.nan, right=np.nan) for k in range(3)], axis=1)
    up_cam = up @ alignment.imu_from_cam
    return np.asarray(up_cam / np.linalg.norm(up_cam, axis=1, keepdims=True))
