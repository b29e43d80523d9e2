"""A camera's turns against the gyroscope's: mounting, bias, time offset, scale and clock drift in one fit.

Over strides of about half a second the camera turned by `V` and the gyroscope by `G`; with the rotation
`X = imu_from_cam`, `log(G^T X V X^T)` is noise if both are right. Scale and clock drift are unknowns here although
neither belongs to a sensor that works: what they come out as tells what is wrong.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from rigwake._robust import robust_std
from rigwake._types import Array, Stamps
from rigwake.errors import UnobservableError
from rigwake.geometry import so3
from rigwake.geometry.se3 import SE3
from rigwake.odometry.gyro import integrate_gyro
from rigwake.recording import ImuStream
from rigwake.sync import estimate_time_offset
from rigwake.trajectory import Trajectory

_STRIDE_S = 0.5
_FEWEST = 15  # strides
_FREE = 9  # rotation, bias, time offset, log scale, drift
_STEPS = np.array([1e-5] * 6 + [1e-3, 1e-4, 1e-5])  # of the numerical derivatives


@dataclass(frozen=True, eq=False)
class TurnFit:
    """How a camera's turns compare with the gyroscope's.

    imu_from_cam (3, 3). gyro_bias (3,) rad/s. time_offset_s: `t_imu = t_cam + time_offset_s` in the middle.
    scale: the camera's turns over the gyroscope's, 1 where both are right. drift: seconds that the camera's clock
    loses against the IMU's per second. covariance (9, 9): of `[rotation, bias, time offset, log scale, drift]`; the
    errors of neighbouring strides are counted as one.
    rotation_std: of the worst known axis of `imu_from_cam`, radians: large where the turns were about one axis only.
    residuals (N, 3): rotation vectors in IMU axes of the strides from `start_ns` to `end_ns` (N,), camera clock.
    segments (N,): of the camera's trajectory. camera_turns (N, 3): rotation vectors of the strides, camera axes.
    """

    imu_from_cam: Array
    gyro_bias: Array
    time_offset_s: float
    scale: float
    drift: float
    covariance: Array
    rotation_std: float
    residuals: Array
    camera_turns: Array
    start_ns: Stamps
    end_ns: Stamps
    segments: NDArray[np.int64]

    def offsets_ns(self, stamps: Stamps) -> Stamps:
        """(N,) what to add to stamps of the camera's clock, by time offset and drift."""
        middle = int(self.start_ns[len(self.start_ns) // 2])
        return np.round(1e9 * self.time_offset_s + self.drift * (stamps - middle)).astype(np.int64)

    @property
    def std(self) -> Array:
        """(9,) standard deviations of the unknowns."""
        return np.sqrt(np.maximum(np.diag(self.covariance), 0.0))

    @property
    def rms(self) -> float:
        """Robust size of a residual per axis, radians."""
        return robust_std(self.residuals)

    @property
    def unexplained(self) -> float:
        """Part of the camera's turning that the gyroscope does not explain, 0 to 1 (robust)."""
        turned = np.linalg.norm(self.camera_turns - np.median(self.camera_turns, axis=0), axis=1)
        left = np.linalg.norm(self.residuals, axis=1)
        return float(min(np.mean(np.minimum(left, 3 * np.median(left))) / max(turned.mean(), 1e-9), 1.0))


def fit_turns(
    trajectory: Trajectory, imu: ImuStream, *, time_offset_s: float | None = None, stride_s: float = _STRIDE_S
) -> TurnFit:
    """Fit a camera's turns to the gyroscope's by Gauss-Newton with Cauchy's loss.

    trajectory: rotations of `world_from_cam`, with segments. time_offset_s: initial guess, else found by correlating
    angular speeds. Directions that the turns do not tell stay at zero. Raises UnobservableError where
    fewer than 15 strides overlap the IMU, or speeds of turning match at no time offset.
    """
    if time_offset_s is None:
        turned = integrate_gyro(imu)
        body = SE3(turned.rotation, np.zeros((len(turned.rotation), 3)))
        time_offset_s = estimate_time_offset(
            Trajectory(imu.name, imu.timestamps_ns, body), trajectory
        ).offset_s
    strides = _strides(trajectory, imu, time_offset_s, stride_s)
    return _minimise(strides, imu, time_offset_s)


def camera_as_gyroscope(trajectory: Trajectory) -> ImuStream:
    """A camera's turns as rates between its images, so that without a gyroscope others can be compared with it."""
    stamps, R = trajectory.timestamps_ns, trajectory.world_from_body.rotation
    turns = so3.log(np.swapaxes(R[:-1], 1, 2) @ R[1:])
    ids = trajectory.segment_ids
    assert ids is not None
    turns[np.diff(ids) != 0] = 0.0
    seconds = np.diff(stamps)[:, None] * 1e-9
    rates = turns / seconds
    # constant between images: a sample just after one of them and one just before the next
    edge = np.minimum(np.diff(stamps) // 100, 1_000_000)
    at = np.stack([stamps[:-1] + edge, stamps[1:] - edge], axis=1).reshape(-1)
    gyro = np.repeat(rates, 2, axis=0)
    return ImuStream(trajectory.name, at, gyro, np.zeros_like(gyro))


@dataclass(frozen=True, eq=False)
class _Strides:
    start_ns: Stamps
    end_ns: Stamps
    turns: Array
    segments: NDArray[np.int64]


def _strides(trajectory: Trajectory, imu: ImuStream, offset_s: float, stride_s: float) -> _Strides:
    """Motions over about `stride_s`, one after the other, within segments and within the IMU's span."""
    stamps, ids = trajectory.timestamps_ns, trajectory.segment_ids
    assert ids is not None
    margin = round(0.05e9)
    on_imu = stamps + round(offset_s * 1e9)
    inside = (on_imu > imu.timestamps_ns[0] + margin) & (on_imu < imu.timestamps_ns[-1] - margin)
    pairs: list[tuple[int, int]] = []
    begin = 0
    for k in range(1, len(stamps)):
        broken = ids[k] != ids[begin] or stamps[k] - stamps[begin] > 2 * stride_s * 1e9
        if broken or not inside[begin]:
            begin = k
        elif stamps[k] - stamps[begin] >= 0.99 * stride_s * 1e9:
            if inside[k]:
                pairs.append((begin, k))
            begin = k
    if len(pairs) < _FEWEST:
        raise UnobservableError(
            f"{trajectory.name}: only {len(pairs)} turns of {stride_s:g} s fall into the time that {imu.name} covers."
        )
    a, b = np.array(pairs).T
    R = trajectory.world_from_body.rotation
    return _Strides(stamps[a], stamps[b], np.swapaxes(R[a], 1, 2) @ R[b], ids[a])


def _minimise(strides: _Strides, imu: ImuStream, offset_s: float) -> TurnFit:
    middle = int(strides.start_ns[len(strides.start_ns) // 2])
    ages = ((strides.start_ns - middle) * 1e-9, (strides.end_ns - middle) * 1e-9)
    seconds = ((strides.end_ns - strides.start_ns) * 1e-9)[:, None]

    turned = integrate_gyro(imu)

    @lru_cache(8)  # most derivatives change neither
    def integrated(lag_s: float, drift: float) -> Array:
        ends = [
            turned.at(stamps + np.round((lag_s + drift * age) * 1e9).astype(np.int64))
            for stamps, age in zip((strides.start_ns, strides.end_ns), ages, strict=True)
        ]
        return so3.log(np.swapaxes(ends[0], 1, 2) @ ends[1])

    def gyro_turns(x: Array) -> Array:
        """Rotation vectors: the bias over half a second is small enough to be taken off a turn as a whole."""
        turns = integrated(float(x[6]), float(x[8]))
        return np.asarray(np.exp(x[7]) * (turns - x[3:6] * seconds))

    def residuals(x: Array, X: Array) -> Array:
        return so3.log(so3.exp(-gyro_turns(x)) @ X @ strides.turns @ X.T)

    x = np.zeros(_FREE)
    x[6] = offset_s
    rotations_cam = so3.log(strides.turns)
    X = rotation_between(rotations_cam, gyro_turns(x))
    information, error = np.eye(_FREE), residuals(x, X)
    weights = np.ones(len(error))
    for _ in range(12):
        error = residuals(x, X)
        J = _derivatives(residuals, x, X)
        size = np.linalg.norm(error, axis=1)
        weights = 1 / (1 + (size / max(2.0 * float(np.median(size)), 1e-9)) ** 2)
        information = np.einsum("nir,n,nis->rs", J, weights, J)
        # a bias of 0.1 rad/s, a scale of 30 %, a drift of 1 % are the most that is looked for
        prior = np.zeros(_FREE)
        noise = float(np.median(size)) ** 2 / 2.4
        prior[3:6], prior[7], prior[8] = noise / 0.1**2, noise / 0.3**2, noise / 0.01**2
        gradient = np.einsum("nir,n,ni->r", J, weights, error) + prior * np.concatenate([np.zeros(3), x[3:]])
        step = -np.linalg.lstsq(information + np.diag(prior), gradient, rcond=1e-12)[0]
        step[6] = np.clip(step[6], -0.2, 0.2)
        X, x = so3.exp(step[:3]) @ X, x + np.concatenate([np.zeros(3), step[3:]])
        if np.abs(step / _STEPS).max() < 0.5:
            break
    error = residuals(x, X)
    covariance = _clustered(_derivatives(residuals, x, X), error, weights, information + np.diag(prior))
    weakest = float(np.linalg.eigvalsh(information[:3, :3])[0])
    rotation_std = robust_std(error) / np.sqrt(max(weakest, 1e-12))
    return TurnFit(
        X, x[3:6], float(x[6]), float(np.exp(x[7])), float(x[8]), covariance, rotation_std, error, rotations_cam,
        strides.start_ns, strides.end_ns, strides.segments,
    )  # fmt: skip


def _derivatives(residuals, x: Array, X: Array) -> Array:  # type: ignore[no-untyped-def]
    """(N, 3, 9) by central differences."""
    columns = []
    for k in range(_FREE):
        step = np.zeros(_FREE)
        step[k] = _STEPS[k]
        ahead, behind = (
            residuals(x + sign * np.concatenate([np.zeros(3), step[3:]]), so3.exp(sign * step[:3]) @ X)
            for sign in (1.0, -1.0)
        )
        columns.append((ahead - behind) / (2 * _STEPS[k]))
    return np.stack(columns, axis=-1)


def _clustered(J: Array, error: Array, weights: Array, information: Array) -> Array:
    """Covariance by the scatter of the scores of four neighbouring strides each (errors of vision last)."""
    scores = np.einsum("nir,n,ni->nr", J, weights, error)
    sums = np.add.reduceat(scores, np.arange(0, len(scores), 4), axis=0)
    inverse = np.linalg.pinv(information, rcond=1e-12, hermitian=True)
    return np.asarray(inverse @ (sums.T @ sums) @ inverse)


def rotation_between(rotations_cam: Array, rotations_imu: Array) -> Array:
    """The rotation `imu_from_cam` that best maps rotation vectors onto rotation vectors, robustly."""
    weights, X = np.ones(len(rotations_cam)), np.eye(3)
    for _ in range(6):
        X = so3.nearest_rotation((rotations_imu * weights[:, None]).T @ rotations_cam)
        size = np.linalg.norm(rotations_cam @ X.T - rotations_imu, axis=1)
        weights = 1 / (1 + (size / max(float(np.median(size)), 1e-9)) ** 2)
    return X
