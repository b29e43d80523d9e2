"""Stamps that jitter, or come in coarse steps: a camera's turns from picture to picture against the gyroscope's.

A picture that is stamped late by `e` seems to have turned too little before it and too much after it, by the rate of
turning times `e`, about the axis of turning. Errors of the pose itself do the same about every axis, and what lasts
(a scale, a time offset) does not change its sign from picture to picture.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from rigwake.geometry import so3
from rigwake.odometry.gyro import integrate_gyro
from rigwake.plausibility.turn_fit import TurnFit
from rigwake.plausibility.values import SensorCheck
from rigwake.recording import ImuStream
from rigwake.trajectory import Trajectory

_JITTER_S = 3e-3  # worth a word: at 30 deg/s a tenth of a degree
_MOST_JITTER_S = 15e-3
_ABOVE_NOISE = 4.0  # variance about the axis of turning over that about the others
_TURNING = 0.1  # rad/s
_FEWEST = 30  # pairs of steps while it turns


def stamp_jitter(trajectory: Trajectory, imu: ImuStream, fit: TurnFit) -> float | None:
    """Standard deviation of a camera's stamps against the gyroscope's, seconds; 0 where it is within the noise of the
    poses, None where the camera turns too little."""
    stamps, ids = trajectory.timestamps_ns, trajectory.segment_ids
    assert ids is not None
    at = stamps + fit.offsets_ns(stamps)
    first, last = imu.timestamps_ns[0], imu.timestamps_ns[-1]
    turned = integrate_gyro(imu, fit.gyro_bias).at(np.clip(at, first, last))
    by_gyro = np.swapaxes(turned[:-1], 1, 2) @ turned[1:]
    R, X = trajectory.world_from_body.rotation, fit.imu_from_cam
    by_camera = X @ np.swapaxes(R[:-1], 1, 2) @ R[1:] @ X.T
    turn = so3.log(by_gyro)
    left = so3.log(np.swapaxes(by_gyro, 1, 2) @ by_camera)
    rate = np.linalg.norm(turn, axis=1) / (np.diff(stamps) * 1e-9)
    axis = turn / np.maximum(np.linalg.norm(turn, axis=1), 1e-12)[:, None]
    along = np.einsum("ni,ni->n", left, axis)
    across = left - along[:, None] * axis
    usable = (rate > _TURNING) & (np.diff(ids) == 0) & (at[:-1] > first) & (at[1:] < last)
    both = usable[:-1] & usable[1:]
    if both.sum() < _FEWEST:
        return None
    shared = -(along[:-1] * along[1:])[both]
    noise = max(-float(np.mean(np.einsum("ni,ni->n", across[:-1], across[1:])[both])) / 2, 0.0)
    excess = float(np.mean(np.clip(shared, *np.quantile(shared, [0.02, 0.98])))) - noise
    if excess < (_ABOVE_NOISE - 1) * noise:
        return 0.0
    return float(np.sqrt(max(excess, 0.0) / np.mean((rate[:-1] * rate[1:])[both])))


def check_jitter(
    trajectories: Mapping[str, Trajectory], imu: ImuStream, fits: Mapping[str, TurnFit]
) -> tuple[SensorCheck, ...]:
    """Cameras whose stamps jitter: named where it is worth a word, at odds with the rest where it is too much. Where
    those of most cameras do, it may as well be the IMU's."""
    known = {n: s for n, fit in fits.items() if (s := stamp_jitter(trajectories[n], imu, fit)) is not None}
    found = {name: size for name, size in known.items() if size > _JITTER_S}
    quantity = "standard deviation of the stamps, s"
    remedy = (
        "Stamp pictures when they are exposed (hardware trigger, the camera's own clock), with all digits."
    )
    if len(found) > 1 and 2 * len(found) > len(known):
        size = float(np.median(list(found.values())))
        words = f"its stamps or those of most cameras jitter, or come in steps, by {1e3 * size:.0f} ms (one sigma)."
        return (SensorCheck("imu", size <= _MOST_JITTER_S, size, _MOST_JITTER_S, words, remedy, quantity),)
    checks = []
    for name, size in found.items():
        words = f"its stamps jitter, or come in steps, by {1e3 * size:.0f} ms (one sigma): its place is less sure."
        agrees = size <= _MOST_JITTER_S
        checks.append(SensorCheck(f"camera {name}", agrees, size, _MOST_JITTER_S, words, remedy, quantity))
    return tuple(checks)
