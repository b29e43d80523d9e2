"""What goes wrong with a receiver's heights and stamps: the few wrongs are tried, and that which agrees is named."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from rigwake._robust import robust_std
from rigwake._types import Array
from rigwake.errors import UnobservableError
from rigwake.plausibility.receiver_fit import ReceiverFit, fit_receiver
from rigwake.plausibility.values import SensorCheck
from rigwake.recording import GnssStream
from rigwake.trajectory import Trajectory

_FOOT = 0.3048
_WINDOW_S = 8.0  # what changes more slowly in a height may be the path's drift or the receiver's
_OFF, _CLEARLY_BETTER = 3.0, 0.5
_LEAST_M = 0.03
_FEWEST, _LEAST_JUMP_M, _JUMP_STDS, _LONGEST_STEP_S = 12, 0.5, 8.0, 5.0
_DIGIT_STEPS, _LEAST_DIGIT_M, _FEWEST_MOVED = 1.5, 0.01, 5
_STANDING = 0.2  # of the heave that the path shows
_LEAP_SECONDS = {
    18.0: "GPS time was taken for UTC (18 s ahead)",
    -18.0: "UTC was taken for GPS time (18 s behind)",
    37.0: "TAI was taken for UTC (37 s ahead)",
    -37.0: "UTC was taken for TAI (37 s behind)",
    19.0: "TAI was taken for GPS time (19 s ahead)",
    -19.0: "GPS time was taken for TAI (19 s behind)",
}
_QUARTER_S, _MOST_ZONE_S = 900.0, 14 * 3600.0


def check_heights(
    gnss: GnssStream, path: Trajectory, time_offset_s: float, given: ReceiverFit
) -> SensorCheck | None:
    """Heights that do not heave as the path does: in feet, with the sign reversed, or not at all; else None.

    Only changes within seconds are compared, and only where they are well above the noise: what the same fixes and the
    same path show in the plane.
    """
    times = gnss.timestamps_ns[given.rows].astype(np.float64) * 1e-9
    quick = _within(given.residuals, times)
    stated = float(np.sqrt(np.median(gnss.covariances[given.rows, 2, 2])))
    noise = max(stated, 1.5 * robust_std(quick[:, :2]), _LEAST_M)
    off = robust_std(quick[:, 2:])
    if not off > _OFF * noise:
        return None
    left = {}
    for words, factor in {
        "they are in feet": _FOOT,
        "their sign is reversed (down taken for up)": -1.0,
        "they are in feet, and their sign is reversed": -_FOOT,
    }.items():
        fixes = gnss.position_enu * [1.0, 1.0, factor]
        fit = fit_receiver(path, gnss, fixes, time_offset_s=time_offset_s)
        left[words] = robust_std(
            _within(fit.residuals, gnss.timestamps_ns[fit.rows].astype(np.float64) * 1e-9)[:, 2:]
        )
    best = min(left, key=lambda words: left[words])
    heights = _within(gnss.position_enu[given.rows], times)[:, 2:]
    if left[best] < _CLEARLY_BETTER * off:
        words = f"{best}: its heights lie {off:.2f} m off the cameras' path as recorded, {left[best]:.2f} m corrected."
    elif robust_std(heights) < _STANDING * off:
        words = f"its heights stand still while the vessel heaves by {off:.2f} m."
    else:
        return None
    remedy = "Record heights in metres, up; or leave the receiver out (--set gnss=false)."
    return SensorCheck(
        f"gnss {gnss.name}", False, off, _OFF * noise, words, remedy, "heave beside the path's, m"
    )


def rows_of_one_level(gnss: GnssStream, given: ReceiverFit) -> NDArray[np.bool_]:
    """(G,) fixes without those whose heights lie elsewhere, between jumps, than those of the longest stretch."""
    p, seconds = gnss.position_enu[:, 2], np.diff(gnss.timestamps_ns) * 1e-9
    kept = np.ones(len(p), dtype=bool)
    if len(p) < _FEWEST:
        return kept
    speed = np.diff(p) / np.maximum(seconds, 1e-3)
    nearby = np.array([np.median(speed[max(k - 4, 0) : k + 5]) for k in range(len(speed))])
    excess = np.where(seconds > _LONGEST_STEP_S, 0.0, np.abs(np.diff(p) - nearby * seconds))
    moved = np.abs(np.diff(p))
    moved = moved[moved > _LEAST_DIGIT_M]
    digit = float(np.median(moved)) if len(moved) >= _FEWEST_MOVED else 0.0  # heights may be in whole metres
    limit = max(_LEAST_JUMP_M, _JUMP_STDS * robust_std(excess - np.median(excess)), _DIGIT_STEPS * digit)
    stretch = np.concatenate([[0], np.cumsum(excess > limit)])
    of_rows = stretch[given.rows]
    counts = np.bincount(of_rows, minlength=int(stretch[-1]) + 1)
    levels = {
        s: float(np.median(given.residuals[of_rows == s, 2])) for s in np.flatnonzero(counts >= 3).tolist()
    }
    if len(levels) < 2:
        return kept
    base = levels[int(np.argmax(counts))]
    alike = [s for s, level in levels.items() if abs(level - base) < limit / 2]
    return np.isin(stretch, alike) if len(alike) < len(levels) else kept


def _within(values: Array, times: Array) -> Array:
    """(N, k) values less their mean over the seconds around each."""
    first = np.searchsorted(times, times - _WINDOW_S / 2)
    last = np.searchsorted(times, times + _WINDOW_S / 2, side="right")
    sums = np.concatenate([np.zeros((1, values.shape[1])), np.cumsum(values, axis=0)])
    return np.asarray(values - (sums[last] - sums[first]) / (last - first)[:, None])


def clock_confusion(
    gnss: GnssStream, path: Trajectory, time_offset_s: float, left: float | None
) -> tuple[str, float] | None:
    """Which clock was taken for another, in words, and what is left of the distance to the path then, metres.

    left: what is left as recorded, or None where the stamps do not overlap the path's at all: then time zones are
    tried too.
    """
    zone = 0.0
    if left is None:
        middle = float(path.timestamps_ns[0] + path.timestamps_ns[-1]) / 2 * 1e-9 + time_offset_s
        apart = float(gnss.timestamps_ns[0] + gnss.timestamps_ns[-1]) / 2 * 1e-9 - middle
        zone = round(apart / _QUARTER_S) * _QUARTER_S
        zone = zone if abs(zone) <= _MOST_ZONE_S else 0.0
    found: dict[float, float] = {}
    for seconds in (zone, *(zone + leap for leap in _LEAP_SECONDS)):
        if left is not None and seconds == 0:
            continue
        moved = replace(gnss, timestamps_ns=gnss.timestamps_ns - round(seconds * 1e9))
        try:
            fit = fit_receiver(path, moved, moved.position_enu, time_offset_s=time_offset_s)
        except UnobservableError:
            continue
        if fit.path_m > 20 * fit.rms:
            found[seconds + fit.lag_s] = fit.rms
    if not found:
        return None
    best = min(found, key=lambda seconds: found[seconds])
    if left is not None and found[best] > 0.35 * left:
        return None
    leap = min((0.0, *_LEAP_SECONDS), key=lambda seconds: abs(best - zone - seconds))
    words = [f"local time was taken for UTC ({zone / 3600:+g} h)"] if zone else []
    words += [_LEAP_SECONDS[leap]] if leap else []
    return ", ".join(words) or f"its stamps are {best:.1f} s off", found[best]
