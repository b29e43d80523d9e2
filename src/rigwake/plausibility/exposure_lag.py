"""Images that are stamped the later the longer a frame lasts.

With automatic exposure a camera slows down when it gets dark. Many drivers stamp an image when it was read out or
arrived, so that the middle of its exposure lies before the stamp by a part of the frame's period; when the period
changes, the time offset to the IMU does too. To a fit over the whole recording that looks like a clock that drifts.
Time offsets of stretches of a second tell both apart: these follow the period, back and forth.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np
from scipy.ndimage import median_filter

from rigwake._types import Array, Indices, Stamps
from rigwake.errors import RigwakeError
from rigwake.geometry import so3
from rigwake.odometry.gyro import integrate_gyro
from rigwake.plausibility.turn_checks import EXPLAINED
from rigwake.plausibility.turn_fit import TurnFit, fit_turns
from rigwake.plausibility.values import Action, SensorCheck
from rigwake.recording import ImuStream
from rigwake.tracks import Tracks
from rigwake.trajectory import Trajectory

_Stamped = TypeVar("_Stamped", Trajectory, Tracks)

_VARIES = 0.15  # of the period, between its 5th and 95th percentile
_SMOOTHED = 5  # frames: one that is missing is not a longer exposure
_STRIDE, _STRETCH = 3, 20  # frames
_FEWEST = 6  # stretches
_STEPS, _NUDGE_S = 6, 2e-3
_SIGMAS = 5.0
_SLOPES = (0.2, 2.0)  # half a period for an exposure that fills it; read-out and transfer add to that
_BETTER = 0.7  # of what a drift of the clock leaves


@dataclass(frozen=True)
class ExposureLag:
    """By which part of a frame's period its stamp is later than the IMU's clock says, its standard deviation, and the
    shortest and longest period, seconds."""

    slope: float
    std: float
    periods_s: tuple[float, float]

    def check(self, camera: str, *, repaired: bool = True) -> SensorCheck:
        """The words for it; repaired: the stamps are corrected."""
        shortest, longest = (1e3 * period for period in self.periods_s)
        words = (
            f"its images are stamped later the longer a frame lasts, by {self.slope:.2f} ± {self.std:.2f} of its "
            f"period ({shortest:.0f} to {longest:.0f} ms: automatic exposure?)"
            + ("; the stamps are corrected for that." if repaired else ".")
        )
        remedy = "Fix the exposure time, or stamp images in the middle of their exposure."
        quantity = "part of a frame's period by which stamps are late"
        action: Action = "repaired" if repaired else "none"
        return SensorCheck(f"camera {camera}", False, self.slope, 0.0, words, remedy, quantity, action)


def frame_periods(stamps: Stamps) -> Array:
    """(N,) seconds from the frame before, smoothed over five frames; N at least 2."""
    steps = np.diff(stamps) * 1e-9
    return np.asarray(median_filter(np.concatenate([steps[:1], steps]), _SMOOTHED, mode="nearest"))


def exposure_lags(
    trajectories: Mapping[str, Trajectory], stamps: Mapping[str, Stamps], imu: ImuStream
) -> dict[str, ExposureLag]:
    """By camera whose stamps depend on the period of its frames. stamps: of all its frames."""
    found = {name: exposure_lag(path, stamps[name], imu) for name, path in trajectories.items()}
    return {name: lag for name, lag in found.items() if lag is not None}


def exposure_lag(path: Trajectory, stamps: Stamps, imu: ImuStream) -> ExposureLag | None:
    """None where periods hardly vary, or their lag is not evident or explains no more than a drift of the clock."""
    if len(stamps) < _STRETCH or len(path) < _STRETCH:
        return None
    periods = frame_periods(stamps)
    shortest, middle, longest = np.percentile(periods, [5, 50, 95])
    if longest - shortest < _VARIES * middle:
        return None
    try:
        fit = fit_turns(path, imu)
    except RigwakeError:
        return None
    if fit.unexplained > EXPLAINED:
        return None
    times, offsets, stds, rows = _offsets(path, imu, fit)
    if len(offsets) < _FEWEST:
        return None
    period = np.array([np.interp(path.timestamps_ns[r], stamps, periods).mean() for r in rows])
    by_period, by_time = (_line(x, offsets, stds) for x in (period, times))
    slope, std, left = -by_period[0], by_period[1], by_period[2]
    evident = _SLOPES[0] < slope < _SLOPES[1] and slope > _SIGMAS * std
    if not evident or left > _BETTER * by_time[2]:
        return None
    return ExposureLag(float(slope), float(std), (float(shortest), float(longest)))


def later_by(lag: ExposureLag, stamps: Stamps) -> Stamps | None:
    """(N,) nanoseconds to add to the stamps so that they lag as those of a median period do; None if they would not
    increase any more."""
    periods = frame_periods(stamps)
    moved = -np.round(1e9 * lag.slope * (periods - np.median(periods))).astype(np.int64)
    return moved if bool(np.all(np.diff(stamps + moved) > 0)) else None


def _offsets(path: Trajectory, imu: ImuStream, fit: TurnFit) -> tuple[Array, Array, Array, list[Indices]]:
    """Time offset of every stretch, its mounting and bias being those of all: times, offsets, deviations (seconds), and
    the poses."""
    stamps, R, ids = path.timestamps_ns, path.world_from_body.rotation, path.segment_ids
    assert ids is not None
    first = np.flatnonzero(ids[_STRIDE:] == ids[:-_STRIDE])
    last = first + _STRIDE
    X = fit.imu_from_cam
    seen = so3.log(X @ np.swapaxes(R[first], 1, 2) @ R[last] @ X.T)
    turned = integrate_gyro(imu, fit.gyro_bias)

    def measured(rows: Indices, offset_s: float) -> Array:
        shift = round(offset_s * 1e9)
        ends = [turned.at(stamps[at[rows]] + shift) for at in (first, last)]
        return np.asarray(fit.scale * so3.log(np.swapaxes(ends[0], 1, 2) @ ends[1]))

    found, kept = [], []
    for rows in np.array_split(np.arange(len(first)), max(len(first) // _STRETCH, 1)):
        offset = fit.time_offset_s
        error, information = np.inf, 0.0
        for _ in range(_STEPS):
            left = seen[rows] - measured(rows, offset)
            by = (measured(rows, offset + _NUDGE_S) - measured(rows, offset - _NUDGE_S)) / (2 * _NUDGE_S)
            size = np.linalg.norm(left, axis=1)
            error = max(float(np.median(size)), 1e-9)
            weights = 1 / (1 + (size / (2 * error)) ** 2)
            information = max(float(np.sum(weights[:, None] * by**2)), 1e-12)
            offset += float(np.clip(np.sum(weights[:, None] * by * left) / information, -0.05, 0.05))
        # neighbouring strides share frames; the median of a length is 1.54 deviations of an axis
        std = error / 1.54 * np.sqrt(_STRIDE / information)
        if std < 0.05:
            found.append((1e-9 * float(stamps[first[rows]].mean() - stamps[0]), offset, std))
            kept.append(first[rows])
    times, offsets, stds = np.array(found).reshape(-1, 3).T
    return times, offsets, stds, kept


def _line(x: Array, y: Array, std: Array) -> tuple[float, float, float]:
    """Slope of y over x, its deviation by the scatter about the line, and the weighted mean square that is left."""
    weights = 1 / np.maximum(std, 5e-4) ** 2
    A = np.stack([np.ones(len(x)), x - np.average(x, weights=weights)], axis=1)
    information = A.T @ (A * weights[:, None])
    at = np.linalg.lstsq(information, A.T @ (weights * y), rcond=None)[0]
    left = float(np.sum(weights * (y - A @ at) ** 2) / max(len(x) - 2, 1))
    return float(at[1]), float(np.sqrt(max(left, 1.0) / max(information[1, 1], 1e-300))), left


def restamped(stamped: _Stamped, stamps: Stamps, moved: Stamps) -> _Stamped:
    """What a camera's frames gave, its stamps moved as those of the frames are."""
    by = np.round(np.interp(stamped.timestamps_ns, stamps, moved)).astype(np.int64)
    return replace(stamped, timestamps_ns=stamped.timestamps_ns + by)
