"""The accelerometer against gravity and vision: which axes, signs and unit make it agree.

With a camera's positions `c` up to scale, its rotations, and `R` of the IMU, second differences over half a second
obey, whatever the path,

    s D2 c + D2 R l = K * (R (P a - b)) + g h^2

where `K` is the triangle of width h that a second difference makes of an acceleration, and scale s, gravity g, lever
arm l and bias b are linear unknowns. P is what the accelerometer's axes, signs and unit are suspected to be; every P is
tried, and the one that leaves least is right. Nothing but the bias is believed beforehand: g may have any length.
"""

from __future__ import annotations

from copy import copy
from dataclasses import dataclass, replace
from itertools import permutations, product

import numpy as np

from rigwake._types import Array, Stamps
from rigwake.errors import UnobservableError
from rigwake.geometry.interpolate import interpolate
from rigwake.odometry.gyro import integrate_gyro
from rigwake.plausibility.turn_fit import TurnFit
from rigwake.recording import ImuStream
from rigwake.trajectory import Trajectory

GRAVITY = 9.80665
_H_S = 0.5
_BIAS_STD, _LEVER_STD = 0.3, 5.0
_FEWEST, _MOST = 16, 1200  # windows; of a long recording so many, spread over it, tell as much as is asked
_DELAY_STEP_S, _DELAY_STD_S = 0.05, 1.0
_ALIKE = 8  # neighbouring windows whose errors count as one
_MEDIAN_LENGTH = {2: 1.18, 3: 1.54}  # of vectors whose components have a standard deviation of one


@dataclass(frozen=True, eq=False)
class ForceFit:
    """How the specific force compares with vision, for one suspected reading of the axes.

    axes: (3, 3) P. scale: metres per visual unit, with scale_std relative to it. gravity: (3,) m/s^2 in the visual
    world. left: root mean square of what is not explained, m/s^2. moved: that of the accelerations themselves without
    gravity, m/s^2: what there is to explain. bias: (3,) m/s^2, as read, with bias_std of its worst known axis.
    """

    axes: Array
    scale: float
    scale_std: float
    gravity: Array
    left: float
    moved: float
    bias: Array
    bias_std: Array


@dataclass(frozen=True, eq=False)
class AxisFit:
    """One axis of the accelerometer against the rest: what it shows of what it should (slope, 1 where it is right, with
    slope_std), the root mean square of what it should show, and what the others leave unexplained, m/s^2."""

    slope: float
    slope_std: float
    told: float
    left: float


def signed_permutations() -> tuple[Array, ...]:
    """All 48 ways to exchange and flip three axes, the identity first."""
    found = []
    for order in permutations(range(3)):
        for signs in product((1.0, -1.0), repeat=3):
            axes = np.zeros((3, 3))
            axes[range(3), order] = signs
            found.append(axes)
    return tuple(found)


class ForceEquations:
    """The linear system of one camera's main segment, made once and solved for every suspected reading.

    Raises UnobservableError where the segment and the IMU share less than about nine seconds.
    """

    def __init__(self, trajectory: Trajectory, imu: ImuStream, turns: TurnFit) -> None:
        path = longest_segment(trajectory)
        on_imu = path.timestamps_ns + turns.offsets_ns(path.timestamps_ns)
        first = max(int(on_imu[0]), int(imu.timestamps_ns[0])) + round((_H_S + 0.05) * 1e9)
        last = min(int(on_imu[-1]), int(imu.timestamps_ns[-1])) - round((_H_S + 0.05) * 1e9)
        centres = np.arange(first, last, round(0.5 * _H_S * 1e9))
        if len(centres) < _FEWEST:
            raise UnobservableError(f"{trajectory.name}: too short together with {imu.name}.")
        if len(centres) > _MOST:
            centres = centres[np.linspace(0, len(centres) - 1, _MOST).astype(np.int64)]
        h = round(_H_S * 1e9)
        shift = turns.offsets_ns(centres - round(turns.time_offset_s * 1e9))
        at = [
            interpolate(path.timestamps_ns, path.world_from_body, centres + k * h - shift) for k in (-1, 0, 1)
        ]
        self.unit = max(float(np.abs(path.world_from_body.translation).max()), 1e-12)
        rate = replace(imu, gyro=imu.gyro * turns.scale)
        turned = integrate_gyro(rate, turns.gyro_bias * turns.scale)
        imu_from_cam = turns.imu_from_cam
        # rotations of the IMU in the visual world: by the gyroscope, anchored to vision in the middle
        self.to_world = np.swapaxes(turned.at(centres), 1, 2)
        self.world_from_imu = at[1].rotation @ imu_from_cam.T
        self.to_world = self.world_from_imu @ self.to_world
        self.path_term = (at[0].translation - 2 * at[1].translation + at[2].translation) / _H_S**2
        self.lever_term = (at[0].rotation - 2 * at[1].rotation + at[2].rotation) / _H_S**2
        self.imu, self.start_from_imu, self.centres = imu, turned.rotation, centres
        self._integrals(imu, turned.rotation, centres)

    def ahead(self, seconds: float) -> ForceEquations:
        """The same with forces that were measured so much later than their stamps say."""
        times = (self.imu.timestamps_ns - self.imu.timestamps_ns[0]) * 1e-9
        moved = [np.interp(times + seconds, times, self.imu.accel[:, k]) for k in range(3)]
        found = copy(self)
        found._integrals(replace(self.imu, accel=np.stack(moved, axis=1)), self.start_from_imu, self.centres)
        return found

    def _integrals(self, imu: ImuStream, start_from_imu: Array, centres: Stamps) -> None:
        """Forces and rotations under the triangle round every centre: (N, 3, 3, 3) and (N, 3, 3)."""
        n = len(centres)
        self.force, self.bias = np.empty((n, 3, 3, 3)), np.empty((n, 3, 3))
        times = (imu.timestamps_ns - imu.timestamps_ns[0]) * 1e-9
        for k, centre in enumerate((centres - imu.timestamps_ns[0]) * 1e-9):
            i, j = np.searchsorted(times, [centre - _H_S, centre + _H_S])
            weights = np.maximum(_H_S - np.abs(times[i:j] - centre), 0.0)
            weights /= max(weights.sum(), 1e-12)
            R = self.to_world[k] @ start_from_imu[i:j]
            # [axis of the world, axis of the IMU that P puts it on, axis that was read]
            self.force[k] = np.einsum("t,tax,ty->axy", weights, R, imu.accel[i:j])
            self.bias[k] = np.einsum("t,tax->ax", weights, R)

    def solve(self, axes: Array) -> ForceFit:
        """The least that this reading of the axes leaves, robustly."""
        x, H, size, off = self._least(self._columns(), np.einsum("naxy,xy->na", self.force, axes))
        moved = self.path_term * x[0]
        # second differences overlap: neighbouring rows are not independent
        stds = size * np.sqrt(2.0 * np.diag(np.linalg.inv(H)))
        rms = float(np.sqrt(np.mean(np.minimum(off, 4 * size) ** 2) / 3))
        reach = float(np.sqrt(np.mean(moved**2)))
        return ForceFit(
            axes, float(x[0]), float(stds[0] / max(abs(x[0]), 1e-12)), x[1:4], rms, reach, x[7:], stds[7:]
        )

    def delay(self) -> tuple[float, float]:
        """Seconds by which the forces are stamped late, as an unknown beside the others, and its deviation.

        By how the forces change with the stamps: good to about a third of a second.
        """
        right, late, early = (
            np.einsum("naxx->na", e.force)
            for e in (self, self.ahead(_DELAY_STEP_S), self.ahead(-_DELAY_STEP_S))
        )
        changing = (early - late) / (2 * _DELAY_STEP_S)
        columns = np.concatenate([self._columns(), changing[:, :, None]], axis=2)
        x, H, size, off = self._least(columns, right)
        weights = 1 / (1 + (off / (3 * size)) ** 2)
        scores = np.einsum("nar,n,na->nr", columns, weights, np.einsum("nar,r->na", columns, x) - right)
        sums = np.add.reduceat(scores, np.arange(0, len(scores), _ALIKE), axis=0)
        inverse = np.linalg.inv(H)
        scattered = float((inverse @ (sums.T @ sums) @ inverse)[10, 10])
        return float(x[10]), float(np.sqrt(max(scattered, 2.0 * size**2 * float(inverse[10, 10]))))

    def alone(self, axis: int) -> AxisFit:
        """One axis of the accelerometer against what the two others and vision say of it.

        Rows are turned into the IMU's axes in the middle of each window, where every axis has its own.
        """
        columns = np.einsum("nax,nac->nxc", self.world_from_imu, self._columns())
        right = np.einsum("nax,nayy->nx", self.world_from_imu, self.force)
        others = [k for k in range(3) if k != axis]
        x, _, size, _ = self._least(columns[:, others], right[:, others])
        told, shown = columns[:, axis] @ x, right[:, axis]
        told, shown = told - np.median(told), shown - np.median(shown)
        slope, weights = 1.0, np.asarray(np.ones(len(told)))
        for _ in range(6):
            square = max(float(np.sum(weights * told**2)), 1e-12)
            slope = float(np.sum(weights * told * shown)) / square
            off = np.abs(shown - slope * told)
            weights = 1 / (1 + (off / max(3 * float(np.median(off)), 1e-4)) ** 2)
        std = float(np.median(off)) * 1.48 * np.sqrt(2.0 / square)
        return AxisFit(slope, float(std), float(np.sqrt(np.mean(told**2))), size)

    def _columns(self) -> Array:
        """(N, 3, 10) of scale, gravity, lever arm and bias, in axes of the visual world."""
        columns = np.zeros((len(self.force), 3, 10))
        columns[:, :, 0] = self.path_term
        columns[:, :, 1:4] = -np.eye(3)
        columns[:, :, 4:7] = self.lever_term
        columns[:, :, 7:] = self.bias
        return columns

    def _least(self, columns: Array, right: Array) -> tuple[Array, Array, float, Array]:
        """Unknowns (C,), their information for a residual of one, its robust size per axis, and residuals (N,)."""
        (n, axes), free = right.shape, columns.shape[2]
        A, b = columns.reshape(-1, free), right.reshape(-1)
        prior = np.zeros(free)
        weights: Array = np.ones(n)
        x: Array = np.zeros(free)
        size, H = 0.1, np.eye(free)
        for _ in range(8):
            prior[4:7], prior[7:10] = (size / _LEVER_STD) ** 2, (size / _BIAS_STD) ** 2
            prior[10:] = (size / _DELAY_STD_S) ** 2
            w = np.repeat(weights, axes)
            H = (A * w[:, None]).T @ A + np.diag(prior) + 1e-12 * np.eye(free) * self.unit**2
            x = np.asarray(np.linalg.solve(H, A.T @ (w * b)), dtype=np.float64)
            off = np.linalg.norm((A @ x - b).reshape(-1, axes), axis=1)
            size = max(float(np.median(off)) / _MEDIAN_LENGTH[axes], 1e-4)
            weights = 1 / (1 + (off / (3 * size)) ** 2)
        return x, H, size, off


def longest_segment(trajectory: Trajectory) -> Trajectory:
    """The segment with the most poses."""
    ids = trajectory.segment_ids
    assert ids is not None
    return trajectory.take(np.flatnonzero(ids == np.argmax(np.bincount(ids))))
