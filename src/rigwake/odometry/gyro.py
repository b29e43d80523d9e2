"""The gyroscope and a camera: how they are turned towards each other, their clocks, and the gyro's bias."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rigwake._types import Array, Stamps
from rigwake.errors import UnobservableError
from rigwake.geometry import so3
from rigwake.geometry.se3 import SE3
from rigwake.recording import ImuStream
from rigwake.sync import estimate_time_offset
from rigwake.trajectory import Trajectory

_MAX_STEP_S = 1.0  # a camera motion over a longer time is not compared with the gyro: its bias would count
_MAX_ROTATION_STD = np.deg2rad(10.0)


@dataclass(frozen=True, eq=False)
class TurnedImu:
    """The gyro integrated: (N, 3, 3) `start_from_imu` at the samples' stamps, for a given bias."""

    timestamps_ns: Stamps
    rotation: Array

    def at(self, at_ns: Stamps) -> Array:
        """(M, 3, 3) `start_from_imu` at these stamps (the rate of the nearest step beyond the ends)."""
        before = np.clip(
            np.searchsorted(self.timestamps_ns, at_ns, side="right") - 1, 0, len(self.rotation) - 2
        )
        span = (self.timestamps_ns[before + 1] - self.timestamps_ns[before]).astype(np.float64)
        fraction = (at_ns - self.timestamps_ns[before]) / span
        step = so3.log(np.swapaxes(self.rotation[before], 1, 2) @ self.rotation[before + 1])
        return np.asarray(self.rotation[before] @ so3.exp(step * fraction[:, None]))


def integrate_gyro(imu: ImuStream, gyro_bias: Array | None = None) -> TurnedImu:
    """Integrate the angular rate, linear between samples, by a prefix product of all steps."""
    rate = imu.gyro if gyro_bias is None else imu.gyro - gyro_bias
    steps_s = np.diff(imu.timestamps_ns) * 1e-9
    products = np.concatenate([np.eye(3)[None], so3.exp(0.5 * (rate[1:] + rate[:-1]) * steps_s[:, None])])
    reach = 1
    while reach < len(products):  # Hillis and Steele's scan: log2(N) batched products
        products[reach:] = products[:-reach] @ products[reach:]
        reach *= 2
    return TurnedImu(imu.timestamps_ns, so3.nearest_rotation(products))


@dataclass(frozen=True, eq=False)
class GyroAlignment:
    """How a camera and the gyroscope are turned towards each other.

    imu_from_cam: (3, 3). time_offset_s: `t_imu = t_cam + time_offset_s`. gyro_bias: (3,) rad/s, IMU axes.
    covariance: (7, 7) of `[rotation about IMU axes, gyro bias, time offset]`, scaled by the residuals.
    """

    imu_from_cam: Array
    time_offset_s: float
    gyro_bias: Array
    covariance: Array


def align_gyro(
    trajectory: Trajectory, imu: ImuStream, *, time_offset_s: float | None = None
) -> GyroAlignment:
    """Rotation, time offset and gyro bias from the turns that both saw: needs no scale and no position.

    Minimises `log(dR_imu^T X dR_cam X^T)` over the camera's motions (Cauchy loss), where `dR_imu` is the gyro
    integrated between the same two times. time_offset_s: initial guess; by correlating angular speeds if None.
    Raises UnobservableError if the camera turned about one axis only, or too little.
    """
    turned = integrate_gyro(imu)
    if time_offset_s is None:
        still = SE3(turned.rotation, np.zeros((len(turned.rotation), 3)))
        time_offset_s = estimate_time_offset(
            Trajectory(imu.name, imu.timestamps_ns, still), trajectory
        ).offset_s
    starts, ends, camera_rotation = _camera_rotations(trajectory, imu, time_offset_s)
    durations = ((ends - starts) * 1e-9)[:, None]

    def residuals(X: Array, bias: Array, offset_s: float) -> Array:
        shift = round(offset_s * 1e9)
        gyro_rotation = np.swapaxes(turned.at(starts + shift), 1, 2) @ turned.at(ends + shift)
        gyro_rotation = gyro_rotation @ so3.exp(-bias * durations)
        return so3.log(np.swapaxes(gyro_rotation, 1, 2) @ X @ camera_rotation @ X.T)

    first = so3.log(
        np.swapaxes(turned.at(starts + round(time_offset_s * 1e9)), 1, 2)
        @ turned.at(ends + round(time_offset_s * 1e9))
    )
    X = _wahba(so3.log(camera_rotation), first)
    bias, offset_s = np.zeros(3), time_offset_s
    information, rms = np.zeros((7, 7)), np.inf
    for _ in range(10):
        error = residuals(X, bias, offset_s)
        J = _jacobian(residuals, X, bias, offset_s)
        size = np.linalg.norm(error, axis=1)
        scale = max(1.5 * float(np.median(size)), 1e-9)
        weights = 1 / (1 + (size / scale) ** 2)
        information = np.einsum("nir,n,nis->rs", J, weights, J)
        step = -np.linalg.lstsq(information, np.einsum("nir,n,ni->r", J, weights, error), rcond=None)[0]
        X, bias, offset_s = so3.exp(step[:3]) @ X, bias + step[3:6], offset_s + float(step[6])
        rms = float(np.sqrt(np.average(size**2, weights=weights) / 3))
        if np.abs(step).max() < 1e-7:
            break
    covariance = np.asarray(np.linalg.pinv(information, hermitian=True)) * rms**2
    _require_rotation(information, rms, trajectory.name)
    return GyroAlignment(X, offset_s, bias, covariance)


def _camera_rotations(
    trajectory: Trajectory, imu: ImuStream, offset_s: float
) -> tuple[Stamps, Stamps, Array]:
    """Starts, ends (camera clock) and rotations between neighbouring poses of one segment inside the IMU's span."""
    stamps, R = trajectory.timestamps_ns, trajectory.world_from_body.rotation
    assert trajectory.segment_ids is not None
    margin = round(0.05e9)
    on_imu = stamps + round(offset_s * 1e9)
    inside = (on_imu > imu.timestamps_ns[0] + margin) & (on_imu < imu.timestamps_ns[-1] - margin)
    usable = (
        (np.diff(trajectory.segment_ids) == 0)
        & (np.diff(stamps) < _MAX_STEP_S * 1e9)
        & inside[1:]
        & inside[:-1]
    )
    if usable.sum() < 10:
        raise UnobservableError(
            f"{trajectory.name}: only {int(usable.sum())} motions fall into the time that {imu.name} covers.",
            consequence="Camera and gyroscope cannot be aligned.",
            remedy="Check that both are on clocks that can be compared, and that the odometry holds.",
        )
    turns = np.swapaxes(R[:-1], 1, 2) @ R[1:]
    return stamps[:-1][usable], stamps[1:][usable], turns[usable]


def _wahba(rotations_cam: Array, rotations_imu: Array) -> Array:
    """The rotation `imu_from_cam` that best maps rotation vectors onto rotation vectors, robustly."""
    weights = np.ones(len(rotations_cam))
    X = np.eye(3)
    for _ in range(5):
        X = so3.nearest_rotation((rotations_imu * weights[:, None]).T @ rotations_cam)
        size = np.linalg.norm(rotations_cam @ X.T - rotations_imu, axis=1)
        weights = 1 / (1 + (size / max(float(np.median(size)), 1e-9)) ** 2)
    return X


def _jacobian(residuals, X: Array, bias: Array, offset_s: float) -> Array:  # type: ignore[no-untyped-def]
    """(N, 3, 7) by central differences: the turns are small, and so cost little to evaluate."""
    columns = []
    for k in range(7):
        step = np.zeros(7)
        step[k] = 1e-3 if k == 6 else 1e-5
        ahead, behind = (
            residuals(so3.exp(sign * step[:3]) @ X, bias + sign * step[3:6], offset_s + sign * step[6])
            for sign in (1.0, -1.0)
        )
        columns.append((ahead - behind) / (2 * step[k]))
    return np.stack(columns, axis=-1)


def _require_rotation(information: Array, rms: float, name: str) -> None:
    eigenvalues = np.linalg.eigvalsh(information[:3, :3])
    worst = rms / np.sqrt(max(float(eigenvalues[0]), 1e-300))
    if worst > _MAX_ROTATION_STD:
        raise UnobservableError(
            f"{name} turned about one axis only, or hardly at all: its rotation towards the IMU is uncertain by "
            f"{np.rad2deg(min(worst, np.pi)):.0f} deg about another.",
            remedy="Record turns, and waves or manoeuvres that roll and pitch the vessel.",
        )


def camera_rotations(imu: ImuStream, alignment: GyroAlignment, timestamps_ns: Stamps) -> Array:
    """(F, 3, 3) `gyro_world_from_cam` at camera stamps: what `estimate_monocular` takes to aid tracking."""
    turned = integrate_gyro(imu, alignment.gyro_bias)
    return np.asarray(
        turned.at(timestamps_ns + round(alignment.time_offset_s * 1e9)) @ alignment.imu_from_cam
    )
