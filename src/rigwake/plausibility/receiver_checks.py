"""A GNSS receiver, judged by the cameras' path: axes, scale, delay, jumps, fixes that stand still, outliers."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from rigwake._robust import robust_std
from rigwake._types import Array
from rigwake.errors import UnobservableError
from rigwake.plausibility.receiver_fit import (
    MAX_LAG_S,
    ReceiverFit,
    axis_confusions,
    fit_receiver,
    frozen_rows,
)
from rigwake.plausibility.receiver_repeats import never_moves, repeated_rows, with_rounding, without_heights
from rigwake.plausibility.receiver_wrongs import check_heights, clock_confusion, rows_of_one_level
from rigwake.plausibility.values import SensorCheck
from rigwake.recording import GnssStream
from rigwake.trajectory import Trajectory

_DRIFT = 0.01  # of the path: what a camera's own path may be off
_DRIFT_WITHOUT_IMU = 0.12  # the same of vision alone, whose scale and heading wander
_STDS = 4.0
_CLEARLY_BETTER = 0.35
_RAN_AWAY = 0.6  # what a drift leaves of the residuals, at most, to count as one
_DELAY_S, _DELAY_SIGMAS, _DELAY_KNOWN_S = 0.05, 4.0, 0.15
_OUTLIER_STDS = 8.0
_LEAST_JUMP_M, _JUMP_STDS = 0.5, 8.0
_FEWEST = 12
_STANDING_S, _LEAST_WAY_M = 2.0, 0.8
_LONGEST_STEP_S = 5.0
_LOOK = "Check its positions on a map, its stamps and its antenna; or leave it out (--set gnss=false)."
_REPEATS = "Check the receiver: it repeats its last fix."


@dataclass(frozen=True, eq=False)
class VettedReceiver:
    """The fixes to use (None: none), the delay found beyond the IMU's clock, the last fit, and the checks."""

    gnss: GnssStream | None
    delay_s: float
    fit: ReceiverFit | None
    checks: tuple[SensorCheck, ...]


def vet_receiver(
    gnss: GnssStream,
    path: Trajectory,
    time_offset_s: float,
    *,
    level: bool,
    inertial_scale: tuple[float, float] | None = None,
    repair: bool = True,
) -> VettedReceiver:
    """Compare a receiver with a camera's path, leave out fixes that cannot be right, and name what is wrong.

    path: one segment, level if `level` (else the sense of rotation cannot be told), up to scale. time_offset_s: of the
    camera to the IMU. inertial_scale: metres per unit of the path by the accelerometer, and how far it may be off,
    relative to it.
    """
    sensor = f"gnss {gnss.name}"
    checks: list[SensorCheck] = []
    if (unusable := _unusable(gnss, path, time_offset_s)) is not None:
        return VettedReceiver(None, 0.0, None, (unusable,))
    gnss, found = _without_repeats(gnss, repair)
    checks += found
    given = len(gnss.timestamps_ns)
    try:
        gnss, found = _without_frozen(gnss, path, time_offset_s, repair)
        checks += found
        gnss, found = _without_standing(gnss, path, time_offset_s, repair)
        checks += found
        gnss, found = _without_jumps(gnss, path, time_offset_s, repair)
        checks += found
        gnss, found = _without_height_jumps(gnss, path, time_offset_s, repair) if level else (gnss, [])
        checks += found
        fit = fit_receiver(path, gnss, gnss.position_enu, time_offset_s=time_offset_s)
    except UnobservableError as error:
        if 2 * len(gnss.timestamps_ns) < given:
            words = f"only {len(gnss.timestamps_ns)} of its {given} fixes are left that may be right: too few to judge."
            few = SensorCheck(sensor, False, len(gnss.timestamps_ns), given / 2, words, _LOOK, "fixes left")
            return VettedReceiver(None, 0.0, None, (*checks, few))
        return VettedReceiver(gnss, 0.0, None, (*checks, SensorCheck(sensor, True, 0.0, 0.0, error.cause)))
    expected = _expected(gnss, fit, level)
    quantity = "horizontal distance of fixes to the cameras' path, m"
    if fit.rms > expected:
        words, remedy = _confusion(gnss, path, time_offset_s, fit) if level else ("", "")
        words = words or (
            f"its fixes lie {fit.rms:.2f} m (per axis) off the path that cameras and IMU see, where at most "
            f"{expected:.2f} m is to be expected"
        )
        remedy = remedy or _LOOK
        check = SensorCheck(sensor, False, fit.rms, expected, f"{words}.", remedy, quantity)
        return VettedReceiver(None, 0.0, fit, (*checks, check))
    if level and (away := _running_away(gnss, path, time_offset_s, fit)) is not None:
        return VettedReceiver(None, 0.0, fit, (*checks, away))
    if level and (heights := check_heights(gnss, path, time_offset_s, fit)) is not None:
        return VettedReceiver(None, 0.0, fit, (*checks, heights))
    ratio = 1.0 if inertial_scale is None else fit.scale / inertial_scale[0]
    if inertial_scale is not None and abs(ratio - 1) > inertial_scale[1] + 5 * fit.scale_std:
        words = f"its distances are {ratio:.3f} times those by the accelerometer."
        check = SensorCheck(
            sensor, False, ratio, 1.0, words, "Check the unit and datum of its positions.",
            "scale against the accelerometer",
        )  # fmt: skip
        return VettedReceiver(None, 0.0, fit, (*checks, check))
    gnss, found = _without_outliers(gnss, fit, repair)
    checks += found
    # a path that drifts without an IMU fits almost any delay: that is no knowledge of one
    known = fit.lag_std_s < _DELAY_KNOWN_S and abs(fit.lag_s) < MAX_LAG_S
    late = known and abs(fit.lag_s) > max(_DELAY_S, _DELAY_SIGMAS * fit.lag_std_s)
    words = (
        f"its fixes are {1e3 * fit.lag_s:+.0f} ± {1e3 * fit.lag_std_s:.0f} ms late; estimated with the rig."
        if late
        else ""
    )
    checks.append(SensorCheck(sensor, True, fit.rms, expected, words, "", quantity))
    return VettedReceiver(gnss, fit.lag_s if late else 0.0, fit, tuple(checks))


def _expected(gnss: GnssStream, fit: ReceiverFit, level: bool) -> float:
    """Horizontal distance per axis that the stated covariance and the drift of a camera's path allow, metres.

    Without an IMU (not `level`) a camera's rotations and scale drift as well.
    """
    stated = float(np.sqrt(np.median(gnss.covariances[:, [0, 1], [0, 1]])))
    return _STDS * stated + (_DRIFT if level else _DRIFT_WITHOUT_IMU) * fit.path_m + 0.1


def _running_away(
    gnss: GnssStream, path: Trajectory, time_offset_s: float, given: ReceiverFit
) -> SensorCheck | None:
    """What is wrong with fixes that run away from the path steadily, by more than both may drift; else None.

    Heading, scale and delay of the path give way to a drift in part, so that what is left may look like little.
    """
    fit = fit_receiver(path, gnss, gnss.position_enu, time_offset_s=time_offset_s, with_drift=True)
    times = gnss.timestamps_ns[fit.rows]
    seconds = float(times[-1] - times[0]) * 1e-9
    off, expected = float(np.linalg.norm(fit.drift_mps)) * seconds, 2 * _expected(gnss, fit, level=True)
    if off < expected or fit.rms > _RAN_AWAY * given.rms:
        return None
    words = f"its fixes run away from the cameras' path by {off / seconds:.2f} m/s, {off:.1f} m in all."
    remedy = "Check its reception and its mode; or leave it out (--set gnss=false)."
    return SensorCheck(f"gnss {gnss.name}", False, off, expected, words, remedy, "drift of the fixes, m")


def _confusion(
    gnss: GnssStream, path: Trajectory, time_offset_s: float, given: ReceiverFit
) -> tuple[str, str]:
    """What makes the fixes agree with the path, in words, and the remedy; nothing where nothing does."""
    left: dict[str, float] = {}
    for words, positions in axis_confusions(gnss).items():
        try:
            left[words] = fit_receiver(path, gnss, positions, time_offset_s=time_offset_s).rms
        except UnobservableError:
            continue
    clock = clock_confusion(gnss, path, time_offset_s, given.rms)
    if clock is not None:
        left[clock[0]] = clock[1]
    if not left:
        return "", ""
    best = min(left, key=lambda words: left[words])
    if left[best] > _CLEARLY_BETTER * given.rms:
        return "", ""
    # with a heading that is free, one mirrored axis is as good as two that are exchanged
    alike = " or ".join(sorted(words for words in left if left[words] < 1.2 * left[best] + 0.005))
    words = f"{alike}: its fixes lie {given.rms:.2f} m off the cameras' path as recorded, {left[best]:.2f} m corrected"
    if clock is not None and best == clock[0]:
        return words, "Correct its stamps."
    return words, "Correct the order and signs of its coordinates."


def _unusable(gnss: GnssStream, path: Trajectory, time_offset_s: float) -> SensorCheck | None:
    """Fixes that are all one position, or of another time altogether."""
    sensor, quantity = f"gnss {gnss.name}", "seconds between its fixes and the cameras' path"
    if never_moves(gnss):
        words = f"all its {len(gnss.position_enu)} fixes are the same to the last digit."
        return SensorCheck(sensor, False, 1.0, 0.0, words, _REPEATS, "fraction of the fixes")
    at = gnss.timestamps_ns - round(time_offset_s * 1e9)
    if not len(at):
        return None
    apart = max(int(at[0]) - int(path.timestamps_ns[-1]), int(path.timestamps_ns[0]) - int(at[-1])) * 1e-9
    if apart <= 0:
        return None
    clock = clock_confusion(gnss, path, time_offset_s, None)
    words = (
        f"{clock[0]}: corrected, its fixes lie {clock[1]:.2f} m off the cameras' path."
        if clock is not None
        else f"its stamps lie {apart:.0f} s before or after everything that the cameras saw."
    )
    return SensorCheck(sensor, False, apart, 0.0, words, "Correct its stamps.", quantity)


def _without_repeats(gnss: GnssStream, repair: bool) -> tuple[GnssStream, list[SensorCheck]]:
    """Without fixes that were sent again under a new stamp, which count once, and heights that are one number."""
    checks: list[SensorCheck] = []
    flat = without_heights(gnss)
    if flat is not None:
        words = "all its heights are the same: it does not measure them; they have no weight."
        remedy = "Set the receiver to three dimensions."
        check = SensorCheck(f"gnss {gnss.name}", False, 0.0, 0.0, words, remedy, "range of its heights, m")
        gnss, checks = (flat, [check.with_action("repaired")]) if repair else (gnss, [check])
    repeated = repeated_rows(gnss)
    gnss, digit = with_rounding(gnss)
    if digit > 0:
        words = f"its positions are rounded to {digit:.2f} m, which counts as noise."
        remedy = "Record all digits."
        checks.append(
            SensorCheck(
                f"gnss {gnss.name}", True, digit, 0.0, words, remedy, "last digit of its positions, m"
            )
        )
    if not repeated.any():
        return gnss, checks
    words = f"{int(repeated.sum())} of {len(repeated)} fixes repeat the one before to the last digit"
    gnss, found = _reduced(gnss, ~repeated, words, _REPEATS, repair)
    return gnss, [*checks, *found]


def _without_frozen(
    gnss: GnssStream, path: Trajectory, time_offset_s: float, repair: bool
) -> tuple[GnssStream, list[SensorCheck]]:
    """Without fixes that repeat the one before to the last digit while the path goes on: a vessel may lie still."""
    frozen = frozen_rows(gnss)
    if not frozen.any():
        return gnss, []
    moving = take_fixes(gnss, ~frozen)
    fit = fit_receiver(path, moving, moving.position_enu, time_offset_s=time_offset_s)
    expected = moving.position_enu[fit.rows, :2] - fit.residuals[:, :2]
    times = moving.timestamps_ns[fit.rows]
    starts = np.flatnonzero(frozen & ~np.concatenate([[False], frozen[:-1]]))
    for first in starts.tolist():
        last = first + int(np.argmin(np.append(frozen[first:], False)))
        before = np.searchsorted(times, gnss.timestamps_ns[first]) - 1
        after = np.searchsorted(times, gnss.timestamps_ns[last - 1])
        inside = before >= 0 and after < len(times)
        if inside and np.linalg.norm(expected[after] - expected[before]) < _LEAST_WAY_M:
            frozen[first:last] = False
    if not frozen.any():
        return gnss, []
    at = (gnss.timestamps_ns[int(np.argmax(frozen))] - gnss.timestamps_ns[0]) * 1e-9
    words = f"{int(frozen.sum())} fixes from {at:.1f} s on repeat the one before to the last digit"
    return _reduced(gnss, ~frozen, words, _REPEATS, repair)


def _without_standing(
    gnss: GnssStream, path: Trajectory, time_offset_s: float, repair: bool
) -> tuple[GnssStream, list[SensorCheck]]:
    """Without fixes that stay where they are, but for noise, while the path goes on."""
    fit = fit_receiver(path, gnss, gnss.position_enu, time_offset_s=time_offset_s)
    fixes = gnss.position_enu[fit.rows, :2]
    expected = fixes - fit.residuals[:, :2]
    times = (gnss.timestamps_ns[fit.rows] - gnss.timestamps_ns[0]) * 1e-9
    standing = np.zeros(len(fixes), dtype=bool)
    ahead = np.searchsorted(times, times + _STANDING_S)
    for k, j in enumerate(ahead):
        if j >= len(times):
            break
        way = float(np.linalg.norm(expected[j] - expected[k]))
        held = float(np.linalg.norm(fixes[j] - fixes[k])) < 0.1 * way
        if held and way > max(_LEAST_WAY_M, 6 * _white_noise(gnss)):
            standing[k : j + 1] = True
    if standing.mean() > 0.6 or not standing.any():
        return gnss, []
    kept = np.ones(len(gnss.timestamps_ns), dtype=bool)
    kept[fit.rows[standing]] = False
    begin = times[int(np.argmax(standing))]
    words = f"{int(standing.sum())} fixes from {begin:.1f} s on stand still while the cameras move"
    return _reduced(gnss, kept, words, _REPEATS, repair)


def _white_noise(gnss: GnssStream) -> float:
    """Standard deviation per axis of what changes from fix to fix, by third differences, metres."""
    third = np.diff(gnss.position_enu[:, :2], n=3, axis=0)
    return robust_std(third) / np.sqrt(20.0) if len(third) else 0.0


def _reduced(
    gnss: GnssStream, kept: NDArray[np.bool_], words: str, remedy: str, repair: bool
) -> tuple[GnssStream, list[SensorCheck]]:
    ending = "; they were left out." if repair else "."
    lost = float(np.mean(~kept))
    check = SensorCheck(
        f"gnss {gnss.name}", False, lost, 0.0, words + ending, remedy, "fraction of the fixes"
    )
    if not repair:
        return gnss, [check]
    return take_fixes(gnss, kept), [check.with_action("repaired")]


def take_fixes(gnss: GnssStream, kept: NDArray[np.bool_]) -> GnssStream:
    """The chosen fixes."""
    velocity = None if gnss.velocity_enu is None else gnss.velocity_enu[kept]
    return replace(
        gnss,
        timestamps_ns=gnss.timestamps_ns[kept],
        position_enu=gnss.position_enu[kept],
        covariances=gnss.covariances[kept],
        velocity_enu=velocity,
    )


def _without_jumps(
    gnss: GnssStream, path: Trajectory, time_offset_s: float, repair: bool
) -> tuple[GnssStream, list[SensorCheck]]:
    """The longest stretch between jumps that the path does not share."""
    steps = np.diff(gnss.position_enu[:, :2], axis=0)
    seconds = np.diff(gnss.timestamps_ns)[:, None] * 1e-9
    if len(steps) < _FEWEST:
        return gnss, []
    velocity = steps / np.maximum(seconds, 1e-3)
    # a vessel's velocity changes by little from fix to fix; noise is in the median
    nearby = np.array([np.median(velocity[max(k - 4, 0) : k + 5], axis=0) for k in range(len(steps))])
    excess = np.linalg.norm(steps - nearby * seconds, axis=1)
    # over a long gap, as between sections of a recording, nobody knows the velocity
    excess[seconds[:, 0] > _LONGEST_STEP_S] = 0.0
    noise = robust_std(excess - np.median(excess))
    limit = max(_LEAST_JUMP_M, _JUMP_STDS * noise)
    jumps = np.flatnonzero(excess > limit)
    if not len(jumps):
        return gnss, []
    stretch = np.zeros(len(gnss.timestamps_ns), dtype=np.int64)
    stretch[jumps + 1] = 1
    stretch = np.cumsum(stretch)
    kept = _levels_alike(gnss, path, time_offset_s, stretch, max(limit, 3 * noise))
    if kept.all():
        return gnss, []
    first = int(jumps[0])
    at = (gnss.timestamps_ns[first + 1] - gnss.timestamps_ns[0]) * 1e-9
    words = (
        f"it jumps by {excess[first]:.1f} m at {at:.1f} s ({len(jumps)} jumps) where the cameras' path does not; "
        f"{int((~kept).sum())} fixes do not belong to its longest stretch"
    )
    return _reduced(gnss, kept, words, "Check the reception, or the receiver's change of mode.", repair)


def _without_height_jumps(
    gnss: GnssStream, path: Trajectory, time_offset_s: float, repair: bool
) -> tuple[GnssStream, list[SensorCheck]]:
    """The longest stretch between jumps of the height, and stretches as high."""
    fit = fit_receiver(path, gnss, gnss.position_enu, time_offset_s=time_offset_s)
    kept = rows_of_one_level(gnss, fit)
    if kept.all():
        return gnss, []
    words = f"its heights jump: {int((~kept).sum())} fixes lie higher or lower than its longest stretch"
    return _reduced(gnss, kept, words, "Check the reception, or the receiver's change of mode.", repair)


def _levels_alike(
    gnss: GnssStream, path: Trajectory, time_offset_s: float, stretch: NDArray[np.int64], limit: float
) -> NDArray[np.bool_]:
    """(G,) fixes of the longest stretch, and those of others that lie as far from the path as it does."""
    counts = np.bincount(stretch)
    longest = stretch == int(np.argmax(counts))
    try:
        fit = fit_receiver(
            path, take_fixes(gnss, longest), gnss.position_enu[longest], time_offset_s=time_offset_s
        )
        whole = fit_receiver(path, gnss, gnss.position_enu, time_offset_s=time_offset_s, with_lag=False)
    except UnobservableError:
        return longest
    if whole.rms < 1.5 * fit.rms + 0.02 * limit and np.abs(whole.residuals[:, :2]).max() < limit:
        return np.ones(len(stretch), dtype=bool)
    off: Array = np.full(len(stretch), np.inf)
    # the whole fit is bent by the jumps: stretches are judged against the one around the longest
    medians = {
        s: np.median(whole.residuals[np.isin(whole.rows, np.flatnonzero(stretch == s)), :2], axis=0)
        for s in range(len(counts))
        if np.isin(whole.rows, np.flatnonzero(stretch == s)).sum() >= 3
    }
    base = medians.get(int(np.argmax(counts)))
    for s, level in medians.items():
        if base is not None:
            off[stretch == s] = float(np.linalg.norm(level - base))
    return np.asarray(longest | (off < 0.5 * limit))


def _without_outliers(
    gnss: GnssStream, fit: ReceiverFit, repair: bool
) -> tuple[GnssStream, list[SensorCheck]]:
    """Without single fixes far from the path."""
    far = np.linalg.norm(fit.residuals[:, :2], axis=1)
    limit = max(_OUTLIER_STDS * fit.rms, _LEAST_JUMP_M)
    bad = far > limit
    if not bad.any():
        return gnss, []
    kept = np.ones(len(gnss.timestamps_ns), dtype=bool)
    kept[fit.rows[bad]] = False
    words = f"{int(bad.sum())} fixes lie up to {far.max():.1f} m off the path"
    return _reduced(gnss, kept, words, "Check the reception.", repair)
