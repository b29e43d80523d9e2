"""How the vessel moved: turning and tilting from the IMU, path and speed from GNSS."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rigwake._kernels import njit
from rigwake._types import Array, Stamps
from rigwake.recording import GnssStream, ImuStream

_SETTLING_S = 30.0  # time constant with which the filter trusts the accelerometer
_STILL_GYRO = np.radians(0.5)
_STILLEST_RATE = np.radians(1.0)
_STILL_SPEED = 0.15  # m/s
_SPEED_WINDOW_S = 1.0


@dataclass(frozen=True, eq=False)
class Turning:
    """Rotation of the body, in degrees, with series for plots.

    turned_deg: all turning about the vertical, to either side, added up; net_deg: its sum with sign.
    tilt_std_deg: standard deviation of the tilt about its larger and its smaller axis (roll and pitch, without
    knowing which way the IMU is mounted). still_fraction: of the time, turning slower than 0.5 deg/s.
    """

    turned_deg: float
    net_deg: float
    max_rate_deg_s: float
    tilt_std_deg: tuple[float, float]
    still_fraction: float
    times_ns: Stamps
    yaw_rate: Array
    tilt_deg: Array


@dataclass(frozen=True, eq=False)
class Travel:
    """Path of the antenna. speed: (M,) m/s at times_ns. still_fraction: of the time, slower than 0.15 m/s."""

    path_m: float
    extent_m: float
    mean_speed: float
    max_speed: float
    still_fraction: float
    times_ns: Stamps
    speed: Array


@njit()
def _levelled(gyro: Array, up_measured: Array, steps_s: Array, settling_s: float, R: Array) -> Array:
    """Complementary filter (Mahony et al. 2008): (N, 3, 3) `world_from_imu`, z up, heading from the gyro alone.

    `R' = R hat(w)`, and the vertical turns towards where the accelerometer has its mean. R (3, 3) is the start
    and is overwritten; up_measured (N, 3) are unit vectors.
    """
    rotations = np.empty((len(gyro), 3, 3))
    for i in range(len(gyro)):
        wx, wy, wz = gyro[i, 0] * steps_s[i], gyro[i, 1] * steps_s[i], gyro[i, 2] * steps_s[i]
        gain = min(steps_s[i] / settling_s, 1.0)
        for row in (0, 2):
            x, y, z = R[row, 0], R[row, 1], R[row, 2]
            R[row, 0] += y * wz - z * wy
            R[row, 1] += z * wx - x * wz
            R[row, 2] += x * wy - y * wx
        dot = norm = norm_z = 0.0
        for k in range(3):
            R[2, k] += gain * (up_measured[i, k] - R[2, k])
            norm_z += R[2, k] ** 2
        for k in range(3):
            R[2, k] /= max(np.sqrt(norm_z), 1e-12)  # damaged samples may cancel each other
            dot += R[0, k] * R[2, k]
        for k in range(3):
            R[0, k] -= dot * R[2, k]
            norm += R[0, k] ** 2
        for k in range(3):
            R[0, k] /= max(np.sqrt(norm), 1e-12)
        for k in range(3):
            a, b = (k + 1) % 3, (k + 2) % 3
            R[1, k] = R[2, a] * R[0, b] - R[2, b] * R[0, a]
        rotations[i] = R
    return rotations


def levelled_rotations(imu: ImuStream) -> Array:
    """(N, 3, 3) `world_from_imu` with z up; the heading is that of the integrated gyro, from an unknown start."""
    up = imu.accel / (np.linalg.norm(imu.accel, axis=1, keepdims=True) + 1e-12)
    settling = (imu.timestamps_ns - imu.timestamps_ns[0]) * 1e-9 <= _SETTLING_S
    first = up[settling].mean(axis=0)
    first = first / (np.linalg.norm(first) + 1e-12)
    sideways = np.cross(first, np.eye(3)[np.argmin(np.abs(first))])
    sideways /= np.linalg.norm(sideways)
    start = np.stack([sideways, np.cross(first, sideways), first])
    gyro = np.ascontiguousarray(imu.gyro - _gyro_bias(imu))
    return np.asarray(_levelled(gyro, up, _steps_s(imu), _SETTLING_S, start))


def _steps_s(imu: ImuStream) -> Array:
    steps_s = np.diff(imu.timestamps_ns, prepend=imu.timestamps_ns[0]) * 1e-9
    return np.minimum(steps_s, 0.1)  # a gap is not integrated over


def turning(imu: ImuStream) -> Turning:
    """Turning and tilting from gyro and accelerometer."""
    steps_s = _steps_s(imu)
    gyro = imu.gyro - _gyro_bias(imu)
    up = levelled_rotations(imu)[:, 2]
    yaw_rate = np.einsum("ni,ni->n", gyro, up)
    spread = np.linalg.eigvalsh(np.cov(up.T)) if len(up) > 1 else np.zeros(3)
    major, minor = np.degrees(np.sqrt(np.maximum(spread[[2, 1]], 0.0)))
    mean_up = up.mean(axis=0) / np.linalg.norm(up.mean(axis=0))
    smooth = _smoothed(yaw_rate, steps_s)
    slow = np.linalg.norm(gyro, axis=1) < _STILL_GYRO
    return Turning(
        turned_deg=float(np.degrees(np.sum(np.abs(smooth) * steps_s))),
        net_deg=float(np.degrees(np.sum(yaw_rate * steps_s))),
        max_rate_deg_s=float(np.degrees(np.abs(smooth).max())),
        tilt_std_deg=(float(major), float(minor)),
        still_fraction=float(np.sum(steps_s[slow]) / max(np.sum(steps_s), 1e-9)),
        times_ns=imu.timestamps_ns,
        yaw_rate=smooth,
        tilt_deg=np.degrees(np.arccos(np.clip(up @ mean_up, -1, 1))),
    )


def _gyro_bias(imu: ImuStream) -> Array:
    """About the horizontal axes the mean rate, as a boat rolls and pitches to and fro; about the vertical the
    median of the stillest tenth, where that is slower than 1 deg/s, else zero."""
    up = imu.accel.mean(axis=0)
    up = up / (np.linalg.norm(up) + 1e-12)
    mean = imu.gyro.mean(axis=0)
    horizontal = mean - up * (mean @ up)
    speed = np.linalg.norm(imu.gyro - horizontal, axis=1)
    still = float(np.median(imu.gyro[speed <= np.quantile(speed, 0.1)] @ up))
    return np.asarray(horizontal + (still if abs(still) < _STILLEST_RATE else 0.0) * up)


def _smoothed(values: Array, steps_s: Array) -> Array:
    """Moving mean over 0.5 s, so that noise and vibration do not add up to turning."""
    width = max(round(0.5 / max(float(np.median(steps_s)), 1e-4)), 1)
    if width >= len(values):
        return np.full_like(values, values.mean())
    padded = np.pad(values, (width // 2, width - 1 - width // 2), mode="edge")
    return np.convolve(padded, np.full(width, 1 / width), mode="valid")


def travel(gnss: GnssStream) -> Travel | None:
    """Path and speed over windows of a second, in which receiver noise counts less; None if too short."""
    times_s = (gnss.timestamps_ns - gnss.timestamps_ns[0]) * 1e-9
    if times_s[-1] < 2 * _SPEED_WINDOW_S:
        return None
    grid = np.arange(0.0, times_s[-1], _SPEED_WINDOW_S / 2)
    position = np.column_stack([np.interp(grid, times_s, gnss.position_enu[:, k]) for k in range(2)])
    half = round(_SPEED_WINDOW_S)
    velocity = (position[2 * half :] - position[: -2 * half]) / (2 * half * (grid[1] - grid[0]))
    speed = np.linalg.norm(velocity, axis=1)
    if len(speed) < 2:
        return None
    extent = np.ptp(position, axis=0)
    return Travel(
        path_m=float(np.sum(speed) * (grid[1] - grid[0])),
        extent_m=float(np.hypot(*extent)),
        mean_speed=float(speed.mean()),
        max_speed=float(speed.max()),
        still_fraction=float(np.mean(speed < _STILL_SPEED)),
        times_ns=gnss.timestamps_ns[0] + np.round(grid[half:-half] * 1e9).astype(np.int64),
        speed=speed,
    )
