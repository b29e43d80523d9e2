"""A visual trajectory and GNSS: metric scale, the world's axes, and where the antenna is."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rigwake._types import Array
from rigwake.errors import EstimationError, UnobservableError
from rigwake.geometry import so3
from rigwake.geometry.align import Alignment, align_points
from rigwake.geometry.interpolate import interpolate
from rigwake.geometry.se3 import SE3
from rigwake.recording import GnssStream
from rigwake.trajectory import Trajectory

_ANTENNA_STD_M = 5.0  # prior: an antenna is on the same vessel as the camera
CHI_SQUARE_3_999 = 16.27  # 99.9 % of a chi-square with three degrees of freedom
CHI_SQUARE_3_MEDIAN = 2.37
_DRIFT_FRACTION = (
    0.005  # of the path: what the visual trajectory itself may be off; only gross errors are refused here
)
_MAX_GAP_S = 1.0  # fixes in a longer gap between poses are not used
_MIN_FIXES = 6


@dataclass(frozen=True, eq=False)
class GnssAlignment:
    """How one segment of a visual trajectory lies in the ENU world.

    enu_from_visual: with scale (metres per visual unit). antenna_cam: (3,) antenna in the camera's frame, metres.
    covariance: (10, 10) of `[rotation of enu (left), log scale, translation, antenna_cam]`.
    used: (G,) fixes that took part; gated: how many of those in its time were refused by the chi-square gate.
    """

    enu_from_visual: Alignment
    antenna_cam: Array
    covariance: Array
    used: NDArray[np.bool_]
    gated: int


def align_gnss(
    trajectory: Trajectory,
    gnss: GnssStream,
    *,
    time_offset_s: float = 0.0,
    antenna_cam: Array | None = None,
) -> GnssAlignment:
    """Fit `s R c(t) + t0 + R R_wc(t) l` to the fixes over scale, rotation, translation and antenna position l.

    trajectory: one segment, `world_from_cam`, up to scale. time_offset_s: `t_gnss = t_cam + time_offset_s`.
    antenna_cam: known position (held); None: estimated, with a weak prior that it is within metres of the camera.
    Gauss-Newton from Umeyama's alignment, fixes weighted by their covariances and gated by chi-square, with room
    for the drift of the visual trajectory: a fix that it contradicts by centimetres may well be the better one.

    Raises UnobservableError if the path is too short or straight against the noise of the fixes.
    """
    index, poses = _poses_at_fixes(trajectory, gnss, time_offset_s)
    centres, rotations = poses.translation, poses.rotation
    fixes, covariances = gnss.position_enu[index], gnss.covariances[index]
    try:
        start = align_points(centres, fixes, "sim3")
    except EstimationError as cause:
        raise _unobservable(trajectory.name) from cause
    whitening = np.linalg.cholesky(np.linalg.inv(covariances))
    white_per_metre = np.linalg.norm(whitening, axis=(1, 2))
    x = _Fit(start, np.zeros(3) if antenna_cam is None else np.asarray(antenna_cam, dtype=np.float64))
    prior = np.full(3, _ANTENNA_STD_M**-2.0 if antenna_cam is None else 1e12)
    centre_of_prior = x.antenna_cam.copy()
    used = np.ones(len(fixes), dtype=bool)
    information = np.zeros((10, 10))
    for iteration in range(20):
        error, J = x.linearise(centres, rotations, fixes)
        white = np.einsum("nji,nj->ni", whitening, error)
        squares = (white**2).sum(axis=1)
        # while the fit is rough the gate follows the residuals
        spread = max(float(np.median(squares)) / CHI_SQUARE_3_MEDIAN, 1.0)
        drift = _DRIFT_FRACTION * x.alignment.scale * trajectory.path_length
        used = squares <= CHI_SQUARE_3_999 * spread + (white_per_metre * drift) ** 2
        WJ = np.einsum("nji,njk->nik", whitening, J)[used]
        information = np.einsum("nik,nil->kl", WJ, WJ)
        gradient = np.einsum("nik,ni->k", WJ, white[used])
        information[7:, 7:] += np.diag(prior)
        gradient[7:] += prior * (x.antenna_cam - centre_of_prior)
        step = -np.linalg.lstsq(information, gradient, rcond=None)[0]
        x = x.moved(step)
        if np.abs(step).max() < 1e-7 and iteration > 1:
            break
    covariance = np.asarray(np.linalg.pinv(information, hermitian=True))
    if used.sum() < _MIN_FIXES or not np.sqrt(covariance[3, 3]) < 0.2 or x.alignment.scale <= 0:
        raise _unobservable(trajectory.name)
    taking_part = np.zeros(len(gnss.timestamps_ns), dtype=bool)
    taking_part[index[used]] = True
    return GnssAlignment(x.alignment, x.antenna_cam, covariance, taking_part, int((~used).sum()))


@dataclass(frozen=True, eq=False)
class _Fit:
    alignment: Alignment
    antenna_cam: Array

    def linearise(self, centres: Array, rotations: Array, fixes: Array) -> tuple[Array, Array]:
        """Predicted minus measured positions (N, 3) and derivatives (N, 3, 10)."""
        R, t = self.alignment.target_from_source.rotation, self.alignment.target_from_source.translation
        scaled = self.alignment.scale * centres @ R.T
        turned = R @ rotations
        arm = turned @ self.antenna_cam
        J = np.zeros((len(centres), 3, 10))
        J[:, :, :3] = -so3.hat(scaled + arm)
        J[:, :, 3] = scaled
        J[:, :, 4:7] = np.eye(3)
        J[:, :, 7:] = turned
        return scaled + arm + t - fixes, J

    def moved(self, step: Array) -> _Fit:
        x = self.alignment.target_from_source
        target_from_source = SE3(so3.exp(step[:3]) @ x.rotation, x.translation + step[4:7])
        scale = self.alignment.scale * float(np.exp(np.clip(step[3], -1, 1)))
        return _Fit(Alignment(target_from_source, scale), self.antenna_cam + step[7:])


def _poses_at_fixes(
    trajectory: Trajectory, gnss: GnssStream, offset_s: float
) -> tuple[NDArray[np.int64], SE3]:
    """Fixes that fall between poses, and the camera's poses then."""
    stamps = trajectory.timestamps_ns
    at = gnss.timestamps_ns - round(offset_s * 1e9)
    after = np.searchsorted(stamps, at, side="right")
    inside = (at >= stamps[0]) & (at <= stamps[-1])
    before, after = np.clip(after - 1, 0, len(stamps) - 1), np.clip(after, 0, len(stamps) - 1)
    usable = inside & (stamps[after] - stamps[before] <= _MAX_GAP_S * 1e9)
    usable &= np.isfinite(gnss.position_enu).all(axis=1)
    index = np.flatnonzero(usable)
    if len(index) < _MIN_FIXES:
        raise UnobservableError(
            f"{trajectory.name}: only {len(index)} GNSS fixes fall into its time.",
            consequence="GNSS cannot give it scale and position.",
            remedy="Check the clocks, and that the odometry lasts.",
        )
    return index, interpolate(stamps, trajectory.world_from_body, at[index])


def _unobservable(name: str) -> UnobservableError:
    return UnobservableError(
        f"{name}: its path is too short or too straight for GNSS to tell scale and direction.",
        remedy="Sail a longer stretch with a turn.",
    )
