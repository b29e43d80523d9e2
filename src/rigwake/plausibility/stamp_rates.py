"""Stamps that claim a wrong rate: which factor of an IMU's stamps makes its turns those of a camera."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from rigwake._types import Stamps
from rigwake.errors import RigwakeError
from rigwake.geometry.se3 import SE3
from rigwake.odometry.gyro import integrate_gyro
from rigwake.plausibility.turn_fit import fit_turns
from rigwake.recording import ImuStream
from rigwake.sync import angular_speed, estimate_time_offset
from rigwake.trajectory import Trajectory

_MOST = 5.0
_WINDOW_S = 25.0
_STEP = 0.02  # between rates that are tried: over half the window, turns slip by a quarter of a second
_TURNING = np.deg2rad(3.0)  # rad/s, by which the speed of turning varies, for turns to be known again
_REFINED = 3
_COARSE_S = 0.05  # between the poses that are compared at every rate


def with_rate(imu: ImuStream, rate: float) -> ImuStream:
    """The IMU with `rate` seconds for every second of its stamps, from its first sample on."""
    return replace(imu, timestamps_ns=_at_rate(imu.timestamps_ns, rate))


def _at_rate(stamps: Stamps, rate: float) -> Stamps:
    return np.asarray(stamps[0] + np.round((stamps - stamps[0]) * rate).astype(np.int64))


def rate_of_stamps(imu: ImuStream, trajectory: Trajectory) -> float | None:
    """Seconds of the camera's clock per second of the IMU's stamps, 0.2 to 5; None where no rate makes them match."""
    path = _middle(trajectory)
    if not (varies(path) and len(imu.timestamps_ns) > 10):
        return None
    coarse = max(1, int(_COARSE_S * 1e9 / max(float(np.median(np.diff(imu.timestamps_ns))), 1.0)))
    turned, stamps = turns_of(imu).world_from_body[::coarse], imu.timestamps_ns[::coarse]
    steps = int(np.log(_MOST) / _STEP)
    evidence = {}
    for k in range(-steps, steps + 1):
        rate = float(np.exp(k * _STEP))
        body = Trajectory(imu.name, _at_rate(stamps, rate), turned)
        try:
            found = estimate_time_offset(body, path)
        except RigwakeError:
            continue
        evidence[rate] = -found.overlap_s * np.log1p(-(min(found.correlation, 1 - 1e-9) ** 2))
    if not evidence:
        return None
    rate = max(evidence, key=lambda r: evidence[r])
    try:
        for _ in range(_REFINED):
            rate /= 1 + fit_turns(path, with_rate(imu, rate)).drift
    except RigwakeError:
        return None
    return rate


def turns_of(imu: ImuStream) -> Trajectory:
    """The gyroscope's turns as a trajectory whose positions are all zero."""
    rotation = integrate_gyro(imu).rotation
    return Trajectory(imu.name, imu.timestamps_ns, SE3(rotation, np.zeros((len(rotation), 3))))


def varies(trajectory: Trajectory) -> bool:
    """Whether the speed of turning varies by so much over half seconds that it can be known again."""
    period = float(np.median(np.diff(trajectory.timestamps_ns))) * 1e-9 if len(trajectory) > 2 else 1.0
    stride = max(1, round(0.5 / max(period, 1e-3)))
    if len(trajectory) < 30 or len(trajectory) < 20 * stride:
        return False
    _, speed = angular_speed(trajectory, stride)
    known = speed[np.isfinite(speed)]
    return bool(len(known) >= 20 and np.std(np.clip(known, *np.quantile(known, [0.02, 0.98]))) > _TURNING)


def _middle(trajectory: Trajectory) -> Trajectory:
    """The middle of it: over longer times finer rates would have to be tried."""
    times = trajectory.times_s
    inside = np.abs(times - (times[0] + times[-1]) / 2) <= _WINDOW_S / 2
    return trajectory.take(np.flatnonzero(inside))
