"""An IMU by itself: unit of the force, gravity, saturation, samples and axes that stand still."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from rigwake._types import Array
from rigwake.plausibility.force_fit import GRAVITY
from rigwake.plausibility.values import SensorCheck
from rigwake.recording import ImuStream

_ACCEL_UNITS = {"g": GRAVITY, "milli-g": GRAVITY * 1e-3, "cm/s^2": 1e-2, "mm/s^2": 1e-3}
_UNIT_TOLERANCE = 0.08
_GRAVITY_TOLERANCE = 0.06
_HELD_RUN, _CLIPPED_RUN = 10, 3
_DISTINCT = 50  # values of an axis
_MOST_LOST = 0.2  # of the samples
_LONG_GAP_S, _MANY_GAPS = 0.1, 20
# of one axis: so long, and so many times the usual run of equal values, which a coarse converter repeats too
_STILL_S, _STILL_RUNS = 1.0, 30.0


@dataclass(frozen=True, eq=False)
class VettedImu:
    """The IMU to use, and the checks made: those with the action `repaired` are in it."""

    imu: ImuStream
    checks: tuple[SensorCheck, ...]


def vet_samples(imu: ImuStream, *, repair: bool = True) -> VettedImu:
    """Check and, if wanted, repair what an IMU's own samples tell: unit of the force, samples clipped or held."""
    checks = []
    for step in (_force_unit, _lost_samples, _gaps, _silence):
        imu, found = step(imu, repair)
        checks += found
    return VettedImu(imu, tuple(checks))


def _force_unit(imu: ImuStream, repair: bool) -> tuple[ImuStream, list[SensorCheck]]:
    force = float(np.median(np.linalg.norm(imu.accel, axis=1)))
    lasting = float(np.linalg.norm(np.median(imu.accel, axis=0)))
    quantity = "median specific force over gravity"
    known = {
        unit: factor
        for unit, factor in _ACCEL_UNITS.items()
        if abs(force * factor / GRAVITY - 1) < _UNIT_TOLERANCE and lasting > 0.5 * force
    }
    ratio = force / GRAVITY
    if known:
        unit, factor = next(iter(known.items()))
        check = SensorCheck(
            "accelerometer",
            False,
            ratio,
            1.0,
            f"it shows {force:.3g} where gravity is 9.81 m/s^2: its unit is {unit}"
            + (f"; multiplied by {factor:.6g}." if repair else "."),
            "Record in m/s^2.",
            quantity,
        )
        if not repair:
            return imu, [check]
        return replace(imu, accel=imu.accel * factor), [check.with_action("repaired")]
    if force < 0.6 * GRAVITY and lasting < 0.3 * GRAVITY:
        words = f"it shows {force:.2f} m/s^2 at the median, gravity is 9.81: gravity was taken out."
        return imu, [
            SensorCheck(
                "accelerometer", False, ratio, 1.0, words,
                "Record the specific force as measured (linear acceleration plus gravity).", quantity,
            )
        ]  # fmt: skip
    agrees = abs(ratio - 1) < _GRAVITY_TOLERANCE
    words = "" if agrees else (
        f"it shows {force:.2f} m/s^2 at the median, gravity is 9.81: its scale is wrong by {100 * (ratio - 1):+.1f} %."
    )  # fmt: skip
    remedy = "" if agrees else "Calibrate the accelerometer, or check its unit and range."
    return imu, [SensorCheck("accelerometer", agrees, ratio, 1.0, words, remedy, quantity)]


def _lost_samples(imu: ImuStream, repair: bool) -> tuple[ImuStream, list[SensorCheck]]:
    """Samples that were clipped at the range, or held while nothing came: taken out and bridged."""
    checks, lost = [], np.zeros(len(imu.timestamps_ns), dtype=bool)
    held = _runs((np.diff(imu.gyro, axis=0) == 0).all(axis=1) & (np.diff(imu.accel, axis=0) == 0).all(axis=1))
    for name, signal in (("gyroscope", imu.gyro), ("accelerometer", imu.accel)):
        clipped = _clipped(signal)
        if clipped.any():
            limit = float(np.abs(signal[clipped]).max())
            words = f"{int(clipped.sum())} samples are clipped at {limit:.3g}: its range is too small"
            checks.append(_loss(name, clipped, words, repair, "Use a larger range."))
            lost |= clipped
        for axis, still in _still_axes(imu, signal).items():
            words = (
                f"axis {axis} repeats {int(still.sum())} samples to the last digit while the others change"
            )
            checks.append(_loss(name, still, words, repair, "Check the driver and the cable."))
            lost |= still
    stuck = held >= _HELD_RUN
    if stuck.any():
        words = f"{int(stuck.sum())} samples repeat the one before to the last digit"
        checks.append(_loss("imu", stuck, words, repair, "Check the driver and the cable."))
        lost |= stuck
    if not repair or not lost.any() or lost.mean() > _MOST_LOST:
        return imu, checks
    kept = ~lost
    stamps, gyro, accel = imu.timestamps_ns[kept], imu.gyro[kept], imu.accel[kept]
    return replace(imu, timestamps_ns=stamps, gyro=gyro, accel=accel), checks


def _loss(sensor: str, lost: NDArray[np.bool_], words: str, repair: bool, remedy: str) -> SensorCheck:
    bearable = bool(lost.mean() <= _MOST_LOST)
    ending = "; they were taken out and bridged by vision." if repair and bearable else "."
    check = SensorCheck(
        sensor, False, float(lost.mean()), 0.0, words + ending, remedy, "fraction of the samples"
    )
    return check.with_action("repaired") if repair and bearable else check


def _clipped(signal: Array) -> NDArray[np.bool_]:
    """(N,) samples at the largest or smallest value of an axis, in runs of three or more.

    A coarse converter repeats its values too: at a limit there are far more than at the value next to it.
    """
    found = np.zeros(len(signal), dtype=bool)
    for axis in range(3):
        x = signal[:, axis]
        values, counts = np.unique(x, return_counts=True)
        if len(values) < _DISTINCT:
            continue
        for extreme, count, beside in (
            (values[0], counts[0], counts[1]),
            (values[-1], counts[-1], counts[-2]),
        ):
            if count < 3 * beside + 5:
                continue
            at = np.isclose(x, extreme, rtol=1e-9, atol=0.0)
            if extreme == 0 or at.sum() < 5 or at.all():
                continue
            found |= at & (_runs(at[1:] & at[:-1]) >= _CLIPPED_RUN - 1)
    return found


def _runs(same: NDArray[np.bool_]) -> NDArray[np.int64]:
    """(N + 1,) for each sample the length of the run of `same` (N,) steps that it belongs to."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], same.astype(np.int8), [0]])))
    lengths = np.zeros(len(same) + 1, dtype=np.int64)
    for first, last in zip(edges[::2], edges[1::2], strict=True):
        lengths[first + 1 : last + 1] = last - first
    return lengths


def _gaps(imu: ImuStream, repair: bool) -> tuple[ImuStream, list[SensorCheck]]:
    steps = np.diff(imu.timestamps_ns) * 1e-9
    if not len(steps):
        return imu, []
    longest, usual = float(steps.max()), float(np.median(steps))
    if longest < max(_LONG_GAP_S, 5 * usual):
        return imu, []
    at = (imu.timestamps_ns[int(steps.argmax())] - imu.timestamps_ns[0]) * 1e-9
    count = int(np.sum(steps > max(_LONG_GAP_S, 5 * usual)))
    lost = float(steps[steps > max(_LONG_GAP_S, 5 * usual)].sum() / steps.sum())
    if count >= _MANY_GAPS and lost > 0.5:
        words = (
            f"its stamps come in bunches ({count} gaps of {longest:.2f} s at most are {100 * lost:.0f} % of the time): "
            "they say when samples arrived, not when they were measured, or most samples are lost."
        )
        remedy = "Stamp samples when they are taken."
        return imu, [SensorCheck("imu", False, lost, 0.5, words, remedy, "part of the time in gaps")]
    words = f"{count} gaps, the longest of {longest:.2f} s at {at:.1f} s; bridged by vision."
    return imu, [SensorCheck("imu", True, longest, _LONG_GAP_S, words, "", "longest gap, s")]


def _still_axes(imu: ImuStream, signal: Array) -> dict[str, NDArray[np.bool_]]:
    """By name of an axis that stands still for a while, not always, although the others go on: its samples (N,)."""
    found = {}
    same = np.diff(signal, axis=0) == 0
    rate = 1e9 / max(float(np.median(np.diff(imu.timestamps_ns))), 1.0) if len(same) else 1.0
    for axis, name in enumerate("xyz"):
        if same[:, axis].all():
            continue  # always: see `_silence`
        runs = _runs(same[:, axis])
        usual = float(np.mean(runs[runs < runs.max()])) + 1.0 if (runs < runs.max()).any() else np.inf
        still = runs >= max(_STILL_S * rate, _STILL_RUNS * usual)
        others = np.delete(same, axis, axis=1)[still[1:]]
        if still.any() and len(others) and others.mean(axis=0).min() < 0.5:
            found[name] = still
    return found


def _silence(imu: ImuStream, repair: bool) -> tuple[ImuStream, list[SensorCheck]]:
    """Axes that say nothing at all."""
    checks = []
    for name, signal in (("gyroscope", imu.gyro), ("accelerometer", imu.accel)):
        spread = np.ptp(signal, axis=0) if len(signal) else np.ones(3)
        if spread.min() == 0:
            dead = ", ".join(axis for axis, size in zip("xyz", spread, strict=True) if size == 0)
            words = f"axis {dead} never changes: it is {float(signal[0, int(spread.argmin())]):.3g} in every sample."
            checks.append(SensorCheck(name, False, 0.0, 0.0, words, "Check the driver's settings.", "range"))
    return imu, checks
