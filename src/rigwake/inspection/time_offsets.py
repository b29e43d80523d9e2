"""Offsets between the clocks of sensors, from motion that both of them feel."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from rigwake._types import Array, Stamps
from rigwake.geometry.so3 import nearest_rotation
from rigwake.inspection.picture_samples import Pictures
from rigwake.inspection.vessel_motion import levelled_rotations
from rigwake.recording import GnssStream, ImuStream

SEARCH_S = 1.0
_MIN_EXPLAINED = 0.5  # of the variance; below, the lag is chance
_MIN_PAIRS = 20
_STRETCH_S = 2.0
_MIN_STRETCHES = 4


@dataclass(frozen=True)
class SensorTimeOffset:
    """`t_imu = t_sensor + offset_s`, its standard deviation, and the fraction of the motion that agrees there.

    offset_s and std_s are None where the motion does not tell; `why` says so.
    """

    sensor: str
    offset_s: float | None
    std_s: float | None
    explained: float
    why: str = ""


def _refined(lags: Array, squares: Array, times: Array, sensor: str, total: float) -> SensorTimeOffset:
    """The lag of the least sum of squares, to a fraction of a step.

    squares: (lags, samples) squared residuals; times: (samples,). The standard deviation is the larger of what
    the curvature says and of the jackknife over stretches of time (neighbouring residuals share their causes).
    """
    cost = squares.sum(axis=1)
    best = int(np.argmin(cost))
    explained = 1 - float(cost[best]) / max(total, 1e-30)
    if explained < _MIN_EXPLAINED:
        return SensorTimeOffset(
            sensor, None, None, explained, "its motion does not match the IMU's at any offset"
        )
    if best in (0, len(lags) - 1):
        return SensorTimeOffset(
            sensor, None, None, explained, f"the offset is beyond {abs(lags[best]):.1f} s"
        )
    step = float(lags[1] - lags[0])
    offset, curvature = _parabola(lags, cost)
    std = step * float(np.sqrt(2 * cost[best] / max(squares.shape[1] - 4, 1) / curvature))
    _, stretch = np.unique((times - times.min()) // _STRETCH_S, return_inverse=True)
    parts = np.stack([squares[:, stretch == k].sum(axis=1) for k in range(stretch.max() + 1)])
    if len(parts) >= _MIN_STRETCHES:
        without = np.array([_parabola(lags, cost - part)[0] for part in parts])
        spread = np.sum((without - without.mean()) ** 2) * (len(parts) - 1) / len(parts)
        std = max(std, float(np.sqrt(spread)))
    return SensorTimeOffset(sensor, offset, std, explained)


def _parabola(lags: Array, cost: Array) -> tuple[float, float]:
    """Position of the minimum by a parabola through the lowest three, and its second difference."""
    best = int(np.clip(np.argmin(cost), 1, len(lags) - 2))
    below, centre, above = (float(c) for c in cost[best - 1 : best + 2])
    curvature = max(below - 2 * centre + above, 1e-30)
    shift = float(np.clip(0.5 * (below - above) / curvature, -1, 1))
    return float(lags[best]) + shift * float(lags[1] - lags[0]), curvature


def _mean_rates(imu: ImuStream) -> Callable[[Array, Array], Array]:
    """Mean angular rate between two times (seconds since the IMU's first sample), from the gyro's integral."""
    times = (imu.timestamps_ns - imu.timestamps_ns[0]) * 1e-9
    steps = np.diff(times)[:, None] * (imu.gyro[1:] + imu.gyro[:-1]) / 2
    angle = np.vstack([np.zeros(3), np.cumsum(steps, axis=0)])

    def rates(start: Array, end: Array) -> Array:
        gained = _interpolated(end, times, angle) - _interpolated(start, times, angle)
        return np.asarray(gained / (end - start)[:, None])

    return rates


def camera_offset(camera: str, pictures: Pictures, imu: ImuStream) -> SensorTimeOffset:
    """Offset of a camera's clock: at each lag the rotation and bias that best turn gyro rates into image
    rates are solved (Wahba), and the lag of the smallest residual wins."""
    start, end = (_since(stamps, imu) for stamps in (pictures.start_ns, pictures.end_ns))
    length = (imu.timestamps_ns[-1] - imu.timestamps_ns[0]) * 1e-9
    inside = (start > SEARCH_S) & (end < length - SEARCH_S)
    if inside.sum() < _MIN_PAIRS:
        return SensorTimeOffset(camera, None, None, 0.0, "too few frames could be compared with the IMU")
    start, end = start[inside], end[inside]
    measured = pictures.rotations[inside] / (end - start)[:, None]
    measured = measured - np.median(measured, axis=0)
    rates = _mean_rates(imu)
    lags = np.arange(-SEARCH_S, SEARCH_S + 1e-9, 0.01)
    weights = np.ones(len(measured))
    for _ in range(3):
        fits = [_rotation_residuals(measured, rates(start + lag, end + lag), weights) for lag in lags]
        squares = np.array([weights * np.sum(r**2, axis=1) for r in fits])
        best = np.linalg.norm(fits[int(np.argmin(squares.sum(axis=1)))], axis=1)
        weights = 1 / (1 + (best / (2 * np.median(best) + 1e-12)) ** 2) ** 2
    total = float(np.sum(weights * np.sum(measured**2, axis=1)))
    return _refined(lags, squares, start, camera, total)


def _rotation_residuals(measured: Array, gyro: Array, weights: Array) -> Array:
    a = measured - np.average(measured, axis=0, weights=weights)
    b = gyro - np.average(gyro, axis=0, weights=weights)
    R = nearest_rotation((weights[:, None] * a).T @ b)
    return np.asarray(a - b @ R.T)


def _since(stamps: Stamps, imu: ImuStream) -> Array:
    return np.asarray((stamps - imu.timestamps_ns[0]) * 1e-9)


def gnss_offset(gnss: GnssStream, imu: ImuStream) -> SensorTimeOffset:
    """Offset of a receiver's clock: second differences of its positions over half a second, against the
    accelerometer's twice integrated over the same.

    `D (c, s) = A + (second difference of R) r + B b + slow tilt`: D the positions' differences, turned by the
    unknown start of the heading (c, s); A the levelled accelerations under a triangular kernel; r the lever arm
    of the antenna; b the accelerometer's bias; and what gravity adds spuriously through a slow error of the tilt. At
    each lag these linear unknowns are solved, and the smallest residual wins. Sections are solved by themselves,
    as the heading drifts.
    """
    times = (gnss.timestamps_ns - imu.timestamps_ns[0]) * 1e-9
    imu_times = (imu.timestamps_ns - imu.timestamps_ns[0]) * 1e-9
    first = max(times[0], imu_times[0] + SEARCH_S) + 2 * _SPAN_S
    last = min(times[-1], imu_times[-1] - SEARCH_S) - 2 * _SPAN_S
    if last - first < 10.0:
        return SensorTimeOffset(gnss.name, None, None, 0.0, "too short, or not at the time of the IMU")
    step = max(float(np.median(np.diff(times))), 0.1)
    lags = np.arange(-SEARCH_S, SEARCH_S + 1e-9, 0.02)
    inertial = _InertialPath.of(imu)
    squares, times_used, total = [], [], 0.0
    sections = min(max(int((last - first) / _SECTION_S), 1), _MAX_SECTIONS)
    for start in np.linspace(first, max(last - _SECTION_S, first), sections):
        at = np.arange(start, min(start + _SECTION_S, last), step)
        moved = _second_difference(lambda t: _interpolated(t, times, gnss.position_enu), at)
        fits = [_inertial_residual(moved, inertial, at + lag) for lag in lags]
        squares.append(np.array([left for left, _ in fits]))
        total += fits[int(np.argmin(squares[-1].sum(axis=1)))][1]
        times_used.append(at)
    return _refined(lags, np.hstack(squares), np.concatenate(times_used), gnss.name, total)


_SPAN_S = 0.5
_SECTION_S = 40.0
_MAX_SECTIONS = 4


@dataclass(frozen=True, eq=False)
class _InertialPath:
    """Twice-integrated columns (N, 3, k) of what moves the antenna, at times (N,): acceleration, bias; and the
    rotations themselves for the lever arm."""

    times: Array
    integrals: Array
    rotations: Array

    @classmethod
    def of(cls, imu: ImuStream) -> _InertialPath:
        times = np.asarray((imu.timestamps_ns - imu.timestamps_ns[0]) * 1e-9)
        R = levelled_rotations(imu)
        force = np.einsum("nij,nj->ni", R, imu.accel)
        force = force - force.mean(axis=0)
        columns = np.concatenate([force[:, :, None], R], axis=2)
        steps = np.diff(times, prepend=times[0])[:, None, None]
        speeds = np.cumsum(columns * steps, axis=0)
        return cls(times, np.cumsum(speeds * steps, axis=0), R)


def _interpolated(at: Array, times: Array, values: Array) -> Array:
    """Linear interpolation of values (N, ...) at other times, held constant outside."""
    after = np.clip(np.searchsorted(times, at), 1, len(times) - 1)
    fraction = np.clip((at - times[after - 1]) / (times[after] - times[after - 1]), 0.0, 1.0)
    fraction = fraction.reshape(-1, *[1] * (values.ndim - 1))
    return np.asarray((1 - fraction) * values[after - 1] + fraction * values[after])


def _second_difference(values_at: Callable[[Array], Array], at: Array) -> Array:
    return np.asarray(values_at(at + _SPAN_S) - 2 * values_at(at) + values_at(at - _SPAN_S))


def _inertial_residual(moved: Array, inertial: _InertialPath, at: Array) -> tuple[Array, float]:
    """Squared residual of the linear fit at each of these times, and the sum of squares of what it explains."""
    integrals = _second_difference(lambda t: _interpolated(t, inertial.times, inertial.integrals), at)
    lever = _second_difference(lambda t: _interpolated(t, inertial.times, inertial.rotations), at)
    accelerations, bias = integrals[:, :, 0], integrals[:, :, 1:]
    zero = np.zeros(len(at))
    cosine = np.stack([moved[:, 0], moved[:, 1], zero], axis=1)
    sine = np.stack([-moved[:, 1], moved[:, 0], zero], axis=1)
    columns = [cosine[:, :, None], sine[:, :, None], -lever, -bias, _slow_tilt(at)]
    rows = np.concatenate(columns, axis=2).reshape(3 * len(at), -1)
    target = (accelerations - np.stack([zero, zero, moved[:, 2]], axis=1)).ravel()
    solution = np.linalg.lstsq(rows, target, rcond=1e-6)[0]
    left = (target - rows @ solution).reshape(-1, 3)
    return np.sum(left**2, axis=1), float(np.sum(target**2))


def _slow_tilt(at: Array) -> Array:
    """(N, 3, 6) horizontal accelerations that a tilt error lets gravity add spurious: constant, linear, quadratic."""
    t = (at - at.mean()) / max(float(np.ptp(at)), 1e-9)
    columns = np.zeros((len(at), 3, 6))
    for power in range(3):
        columns[:, 0, 2 * power] = columns[:, 1, 2 * power + 1] = t**power
    return columns
