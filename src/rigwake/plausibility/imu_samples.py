"""An IMU by itself and against a camera's coarse turns: units, axes, gravity, saturation, samples that stand still."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from rigwake._types import Array
from rigwake.errors import RigwakeError
from rigwake.plausibility.force_fit import GRAVITY
from rigwake.plausibility.turn_fit import fit_turns
from rigwake.plausibility.values import SensorCheck
from rigwake.recording import ImuStream
from rigwake.trajectory import Trajectory

_ACCEL_UNITS = {"g": GRAVITY, "milli-g": GRAVITY * 1e-3, "cm/s^2": 1e-2, "mm/s^2": 1e-3}
_UNIT_TOLERANCE = 0.08
_GRAVITY_TOLERANCE = 0.06
_HELD_RUN, _CLIPPED_RUN = 10, 3
_DISTINCT = 50  # values of an axis
_MOST_LOST = 0.2  # of the samples
_LONG_GAP_S = 0.1
_UNEXPLAINED = 0.2  # of the coarse turns; good recordings leave up to 0.1
_CLEARLY_BETTER = 0.5


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
    words = f"{count} gaps, the longest of {longest:.2f} s at {at:.1f} s; bridged by vision."
    return imu, [SensorCheck("imu", True, longest, _LONG_GAP_S, words, "", "longest gap, s")]


def _silence(imu: ImuStream, repair: bool) -> tuple[ImuStream, list[SensorCheck]]:
    """A gyroscope that says nothing."""
    spread = float(np.ptp(imu.gyro, axis=0).min()) if len(imu.gyro) else 0.0
    if spread > 0:
        return imu, []
    dead = [axis for axis, size in zip("xyz", np.ptp(imu.gyro, axis=0), strict=True) if size == 0]
    words = f"axis {', '.join(dead)} never changes."
    return imu, [SensorCheck("gyroscope", False, 0.0, 0.0, words, "Check the driver's settings.", "range")]


_WRONGS: dict[str, Callable[[Array], Array]] = {
    "its unit is deg/s": np.deg2rad,
    "its axes are left-handed (one has the wrong sign, or two are exchanged)": lambda w: w * [1.0, 1.0, -1.0],
    "its axes are left-handed (one has the wrong sign, or two are exchanged) and its unit is deg/s": lambda w: (
        np.deg2rad(w * [1.0, 1.0, -1.0])
    ),
}


def vet_turns(imu: ImuStream, turns: Mapping[str, Trajectory], *, repair: bool = True) -> VettedImu:
    """The gyroscope against coarse turns of every camera: unit and handedness.

    turns: by camera, from images alone. Only a wrong that makes most cameras agree is held against the gyroscope; what
    nothing explains is left for finer checks.
    """
    given = _unexplained(imu, turns)
    quantity = "part of the cameras' turns that it does not explain"
    if not given or float(np.median(list(given.values()))) <= _UNEXPLAINED:
        return VettedImu(imu, ())
    figure = float(np.median(list(given.values())))
    tried = {
        words: float(np.median(list(_unexplained(replace(imu, gyro=change(imu.gyro)), turns).values())))
        for words, change in _WRONGS.items()
    }
    best = min(tried, key=lambda words: tried[words])
    if tried[best] > _CLEARLY_BETTER * figure or tried[best] > 1.5 * _UNEXPLAINED:
        return VettedImu(imu, ())
    words = (
        f"it leaves {100 * figure:.0f} % of the cameras' turns unexplained; {best}: "
        f"then {100 * tried[best]:.0f} % are left"
    )
    unit_only = best == "its unit is deg/s"
    check = SensorCheck("gyroscope", False, figure, _UNEXPLAINED, f"{words}.", "", quantity)
    if unit_only and repair:
        check = replace(check, hypothesis=f"{words}. Multiplied by pi / 180.", remedy="Record in rad/s.")
        return VettedImu(replace(imu, gyro=np.deg2rad(imu.gyro)), (check.with_action("repaired"),))
    remedy = (
        "Record in rad/s."
        if unit_only
        else "Correct the IMU's axes (x, y, z right-handed, all signs as mounted)."
    )
    return VettedImu(imu, (replace(check, remedy=remedy),))


def _unexplained(imu: ImuStream, turns: Mapping[str, Trajectory]) -> dict[str, float]:
    found = {}
    for name, trajectory in turns.items():
        try:
            found[name] = fit_turns(trajectory, imu).unexplained
        except RigwakeError:
            found[name] = 1.0
    return found
