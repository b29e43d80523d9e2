"""A GNSS receiver against a camera's path: scale, time offset, lever arm, and how its errors look.

The path of one camera, level by gravity and up to scale, is put onto the fixes by a heading, a scale, an offset, a
lever arm and a time offset (Gauss-Newton, Cauchy's loss). What is left tells white noise from errors that last,
jumps and fixes that stand still; suspected confusions of the axes are tried in the same way.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from rigwake._types import Array
from rigwake.errors import UnobservableError
from rigwake.geometry import so3
from rigwake.geometry.interpolate import interpolate
from rigwake.geometry.se3 import SE3
from rigwake.recording import GnssStream
from rigwake.trajectory import Trajectory

_FEWEST = 8
_LEVER_STD = 8.0
MAX_LAG_S = 3.0
_MAX_GAP_S = 1.0


@dataclass(frozen=True, eq=False)
class ReceiverFit:
    """How a receiver's fixes lie on a camera's path.

    scale: metres per visual unit, scale_std relative to it. lag_s: `t_cam + lag_s = t_gnss` of the same place beyond
    the time offset given (a receiver that stamps late has a positive lag), lag_std_s. residuals (N, 3): fix minus path,
    ENU, of the fixes `rows` (N,). rms: robust size of a horizontal residual per axis, metres. path_m: length of the
    path in metres. drift_mps: (2,) east and north, by which the fixes run away from the path; zero if not fitted.
    """

    scale: float
    scale_std: float
    lag_s: float
    lag_std_s: float
    residuals: Array
    rows: NDArray[np.int64]
    rms: float
    path_m: float
    drift_mps: Array


def level_path(trajectory: Trajectory, gravity: Array | None) -> Trajectory:
    """The path turned so that gravity (3,), in its own world, points down; unchanged without."""
    if gravity is None:
        return trajectory
    up = -gravity / np.linalg.norm(gravity)
    axis = np.cross(up, [0.0, 0.0, 1.0])
    sine, cosine = float(np.linalg.norm(axis)), float(up[2])
    half = np.array([np.pi, 0.0, 0.0]) if cosine < 0 else np.zeros(3)
    turn = so3.exp(axis / sine * np.arctan2(sine, cosine)) if sine > 1e-9 else so3.exp(half)
    return replace(
        trajectory,
        world_from_body=SE3(turn, np.zeros(3)) * trajectory.world_from_body,
        covariances=None,
    )


def fit_receiver(
    path: Trajectory,
    gnss: GnssStream,
    positions: Array,
    *,
    time_offset_s: float,
    with_lag: bool = True,
    with_drift: bool = False,
) -> ReceiverFit:
    """Put a level path onto fixes.

    path: one segment of `world_from_cam`, z up, up to scale. positions: (G, 3) of the fixes, as suspected.
    time_offset_s: of the camera's clock to the IMU's. with_drift: whether the fixes may run away. Raises
    UnobservableError with fewer than 8 fixes, or where the path is too short against what is left.
    """
    stamps = path.timestamps_ns
    at = gnss.timestamps_ns - round(time_offset_s * 1e9)
    margin = round(0.3e9)
    after = np.clip(np.searchsorted(stamps, at), 1, len(stamps) - 1)
    usable = (at > stamps[0] + margin) & (at < stamps[-1] - margin) & np.isfinite(positions).all(axis=1)
    usable &= stamps[after] - stamps[after - 1] < _MAX_GAP_S * 1e9
    rows = np.flatnonzero(usable)
    if len(rows) < _FEWEST:
        raise UnobservableError(f"{gnss.name}: only {len(rows)} fixes fall into the time of {path.name}.")
    fixes = positions[rows]
    path_unit = max(float(np.ptp(path.world_from_body.translation, axis=0).max()), 1e-12)

    def poses(lag_s: float) -> SE3:
        wanted = np.clip(at[rows] - round(lag_s * 1e9), stamps[0], stamps[-1])
        return interpolate(stamps, path.world_from_body, wanted)

    x = _start(poses(0.0).translation, fixes)
    free = np.ones(11, dtype=bool)
    free[9:] = with_drift
    size, H, error = 1.0, np.eye(11), np.zeros((len(rows), 3))
    seconds = (at[rows] - at[rows].mean()) * 1e-9
    for done in range(25):
        free[8] = with_lag and done >= 4
        here = poses(x[8])
        error = _predicted(x, here) - fixes
        error[:, :2] += seconds[:, None] * x[9:]
        J = np.zeros((len(rows), 3, 11))
        J[:, 0, 9] = J[:, 1, 10] = seconds
        for k, h in enumerate((1e-5, 1e-5, 1e-3, 1e-3, 1e-3, 1e-3, 1e-3, 1e-3)):
            J[:, :, k] = (
                _predicted(x + h * np.eye(11)[k], here) - _predicted(x - h * np.eye(11)[k], here)
            ) / (2 * h)
        dt = 0.1
        J[:, :, 8] = (_predicted(x, poses(x[8] + dt)) - _predicted(x, poses(x[8] - dt))) / (2 * dt)
        off = np.linalg.norm(error[:, :2], axis=1)
        size = max(float(np.median(off)) / 1.18, 1e-3)
        weights = 1 / (1 + (off / (3 * size)) ** 2)
        w = np.stack([weights, weights, weights * 0.3], axis=1)
        J = J * free
        prior = np.zeros(11)
        prior[5:8], prior[8] = (size / _LEVER_STD) ** 2, (size / 1.0) ** 2 if free[8] else 1.0
        H = np.einsum("nir,ni,nis->rs", J, w, J) + np.diag(prior)
        gradient = np.einsum("nir,ni,ni->r", J, w, error)
        gradient[5:8] += prior[5:8] * x[5:8]
        step = -np.linalg.lstsq(H, gradient, rcond=1e-14)[0]
        step[[0, 1, 8]] = np.clip(step[[0, 1, 8]], -0.5, 0.5)
        x = x + step
        x[8] = float(np.clip(x[8], -MAX_LAG_S, MAX_LAG_S))
        if done > 6 and np.abs(step).max() < 1e-5:
            break
    scale = float(np.exp(x[1]))
    covariance = _clustered(J, error, w, H, gnss.timestamps_ns[rows])
    length = float(np.linalg.norm(np.diff(path.world_from_body.translation, axis=0), axis=1).sum()) * scale
    if length < 3 * size or path_unit * scale < size:
        raise UnobservableError(f"{gnss.name}: the path is too short against the noise of the fixes.")
    return ReceiverFit(
        scale, float(np.sqrt(covariance[1, 1])), float(x[8]), float(np.sqrt(covariance[8, 8])) if with_lag else 0.0,
        -error, rows, size, length, x[9:],
    )  # fmt: skip


def _start(path: Array, fixes: Array) -> Array:
    """`[heading, log scale, offset, lever, lag, drift]` by a similarity in the plane."""
    a, b = path[:, :2] - path[:, :2].mean(axis=0), fixes[:, :2] - fixes[:, :2].mean(axis=0)
    z = np.sum((a[:, 0] - 1j * a[:, 1]) * (b[:, 0] + 1j * b[:, 1])) / max(float(np.sum(a * a)), 1e-300)
    x = np.zeros(11)
    x[0], x[1] = float(np.angle(z)), float(np.log(max(abs(z), 1e-9)))
    spread = float(np.sqrt(np.sum(b * b) / max(float(np.sum(a * a)), 1e-300)))
    if abs(z) < 0.3 * spread:  # hardly alike: at least the size is right
        x[1] = float(np.log(max(spread, 1e-9)))
    x[2:5] = np.median(fixes - _predicted(x, SE3(np.tile(np.eye(3), (len(path), 1, 1)), path)), axis=0)
    return x


def _predicted(x: Array, poses: SE3) -> Array:
    heading = so3.exp(np.array([0.0, 0.0, x[0]]))
    turned = heading @ poses.rotation
    return np.asarray(np.exp(x[1]) * poses.translation @ heading.T + turned @ x[5:8] + x[2:5])


def _clustered(J: Array, error: Array, w: Array, H: Array, stamps: NDArray[np.int64]) -> Array:
    """Covariance by the scatter of scores over stretches of five seconds: errors of receivers last."""
    scores = np.einsum("nir,ni,ni->nr", J, w, error)
    _, group = np.unique((stamps - stamps[0]) // 5_000_000_000, return_inverse=True)
    sums = np.zeros((group.max() + 1, scores.shape[1]))
    np.add.at(sums, group, scores)
    inverse = np.linalg.pinv(H, rcond=1e-14, hermitian=True)
    return np.asarray(inverse @ (sums.T @ sums) @ inverse)


def axis_confusions(gnss: GnssStream) -> dict[str, Array]:
    """(G, 3) positions by what people confuse: latitude with longitude, north with east (NED), signs."""
    p = gnss.position_enu
    latitude = np.deg2rad(gnss.origin_lla[0])
    longitude = np.deg2rad(gnss.origin_lla[1])
    swapped = p[:, [1, 0, 2]].copy()
    # what was taken for latitude is longitude: a degree of it was given the length of a degree of latitude
    swapped[:, 0] = p[:, 1] * np.cos(longitude)
    swapped[:, 1] = p[:, 0] / max(float(np.cos(latitude)), 1e-3)
    return {
        "latitude and longitude are exchanged": swapped,
        "north and east are exchanged (NED taken for ENU)": p[:, [1, 0, 2]],
        "the sign of east (or of north) is reversed": p * np.array([-1.0, 1.0, 1.0]),
    }


def frozen_rows(gnss: GnssStream) -> NDArray[np.bool_]:
    """(G,) fixes that repeat the one before to the last digit, in runs of three or more."""
    same = np.concatenate([[False], (np.diff(gnss.position_enu, axis=0) == 0).all(axis=1)])
    run = np.zeros(len(same), dtype=np.int64)
    for k in range(1, len(same)):
        run[k] = run[k - 1] + 1 if same[k] else 0
    longest = run.copy()
    for k in range(len(same) - 2, -1, -1):
        if same[k + 1]:
            longest[k] = max(longest[k], longest[k + 1])
    return np.asarray(same & (longest >= 2))
