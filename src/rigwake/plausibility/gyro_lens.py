"""A lens from how pictures turn while the gyroscope tells by how much: focal length, centre, distortion.

Between two frames the gyroscope gives the camera's rotation `R = X^T G X`, with `X = imu_from_cam`. Points of whatever
scene then obey `b2^T [t]x R b1 = 0` with a direction t of the pair's own. Lens, X, gyro bias and time offset are common
to all pairs and estimated together: what is left in an ordinary two-view fit, the trade of focal length against
distortion and of both against the turn, is gone.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from rigwake._robust import robust_std
from rigwake._types import Array, Mask, Stamps
from rigwake.ba.rig.intrinsics_refinement import IntrinsicsWidth, intrinsics_prior
from rigwake.cameras.models.lens import axis_focal_px
from rigwake.cameras.protocol import CameraModel
from rigwake.errors import CameraError, EstimationError
from rigwake.geometry import so3
from rigwake.odometry.gyro import TurnedImu, integrate_gyro
from rigwake.plausibility.turn_fit import TurnFit
from rigwake.plausibility.view_pairs import (
    ViewPairs,
    choose_pairs,
    direction_of_pairs,
    eliminate_pairs,
    moved_directions,
    sampson_distances,
    scatter_covariance,
    tangents,
)
from rigwake.recording import ImuStream
from rigwake.tracks import Tracks
from rigwake.trajectory import Trajectory

_FEWEST_PAIRS = 8
_ROUNDS, _RENEWED = 40, 5
_MOST_DAMPING, _SETTLED = 1e6, 1e-6
_MOUNT = 7  # rotation, gyro bias, time offset
_MOUNT_STD = np.array([0.5, 0.5, 0.5, 0.05, 0.05, 0.05, 0.1])
_MOUNT_STEPS = np.array([1e-5] * 6 + [1e-4])
_STEP_PX = 0.02
_WITHOUT_RAY = 0.1  # radians: what a point counts that the lens has no ray for
_NO_RAY, _MOST_PX = np.array([0.0, 0.0, 1.0]), 3.0
_LARGEST = 0.5  # of a parameter's prior deviation, in one step


UNKNOWN = IntrinsicsWidth(focal=0.2, centre_px=25.0, distortion=0.15, aspect=0.002)
"""How far a lens may be from one that only its field of view tells."""


@dataclass(frozen=True, eq=False)
class GyroLens:
    """A lens and how the camera is turned against the IMU.

    imu_from_cam (3, 3). gyro_bias (3,) rad/s. time_offset_s: `t_imu = t_cam + time_offset_s`. rms_px: robust size
    of the epipolar distances. covariance (P, P): of the lens's parameters, by the scatter over pairs. pairs: of frames.
    """

    lens: CameraModel
    imu_from_cam: Array
    gyro_bias: Array
    time_offset_s: float
    rms_px: float
    covariance: Array
    pairs: int


def pairs_for_lens(tracks: Tracks, turns: Trajectory) -> ViewPairs:
    """Pairs of frames that tell a lens.

    tracks: pixels count, not bearings. turns: rotations of the camera, roughly. Raises EstimationError where fewer than
    8 pairs of frames share enough tracks over a turn.
    """
    pairs = choose_pairs(tracks, turns, within_segments=False)
    if len(pairs.rotation) < _FEWEST_PAIRS:
        raise EstimationError(
            f"{tracks.camera}: only {len(pairs.rotation)} pairs of images show the same points after a turn.",
            consequence="Its lens cannot be found from the motion.",
            remedy="Record turns of 60 degrees and more to both sides, with near and far things in view.",
        )
    return pairs


def fit_lens_to_gyroscope(
    pairs: ViewPairs, start: CameraModel, imu: ImuStream, turn: TurnFit, width: IntrinsicsWidth = UNKNOWN
) -> GyroLens:
    """The lens by which pictures turn as the gyroscope does.

    start: the prior's mean; width: its deviations. turn: how the camera's turns compare with the gyroscope's by a lens
    like `start`.
    """
    return _Problem(pairs, start, integrate_gyro(imu), turn, width).solved(turn)


def held_out_errors_px(found: GyroLens, pairs: ViewPairs, imu: ImuStream) -> Array:
    """(P,) RMS of the epipolar distances of pairs that a lens was not fitted to, each with the direction that suits it.

    A distance counts 3 px at the most, as does a point that the lens has no ray for.
    """
    shift = round(found.time_offset_s * 1e9)
    R = _rotations(
        pairs,
        integrate_gyro(imu),
        found.imu_from_cam,
        found.gyro_bias,
        pairs.first_ns + shift,
        pairs.second_ns + shift,
    )
    (a, seen_a), (b, seen_b) = (found.lens.unproject(p) for p in (pairs.first, pairs.second))
    valid = (seen_a & seen_b)[:, None]
    a, b = np.where(valid, a, _NO_RAY), np.where(valid, b, _NO_RAY)
    off = sampson_distances(a, b, R, direction_of_pairs(pairs, a, b, R), pairs.pair) * axis_focal_px(
        found.lens
    )
    squares = np.where(valid[:, 0], np.minimum(off**2, _MOST_PX**2), _MOST_PX**2)
    starts = np.searchsorted(pairs.pair, np.arange(len(R)))
    counts = np.bincount(pairs.pair, minlength=len(R))
    return np.asarray(np.sqrt(np.add.reduceat(squares, starts) / counts))


def _rotations(
    pairs: ViewPairs, turned: TurnedImu, X: Array, bias: Array, first_ns: Stamps, second_ns: Stamps
) -> Array:
    """(P, 3, 3) `second_from_first` of a camera with `X = imu_from_cam`, by the gyroscope at its own stamps."""
    turn = so3.log(np.swapaxes(turned.at(first_ns), 1, 2) @ turned.at(second_ns))
    seconds = ((second_ns - first_ns) * 1e-9)[:, None]
    return np.asarray(np.swapaxes(X.T @ so3.exp(turn - bias * seconds) @ X, 1, 2))


class _State(NamedTuple):
    """Unknowns: steps of mounting and lens from where they started (7 + L,), imu_from_cam, directions (P, 3)."""

    x: Array
    X: Array
    t: Array


_Linearised = tuple[Array, Array, Array]


class _Problem:
    """Sampson distances of all pairs by lens and mounting, and their least squares."""

    def __init__(
        self, pairs: ViewPairs, start: CameraModel, turned: TurnedImu, turn: TurnFit, width: IntrinsicsWidth
    ) -> None:
        self.pairs, self.start, self.turned = pairs, start, turned
        self.bias, self.offset_s = turn.gyro_bias, turn.time_offset_s
        pixels = np.concatenate([pairs.first, pairs.second])
        count = len(start.params)
        self.prior = np.zeros((_MOUNT + count, _MOUNT + count))
        self.prior[:_MOUNT, :_MOUNT] = np.diag(1 / _MOUNT_STD**2)
        self.prior[_MOUNT:, _MOUNT:] = intrinsics_prior(start, pixels, width).information
        self.std = np.sqrt(np.diag(np.linalg.inv(self.prior)))
        bearings, seen = start.unproject(pixels)
        moves = np.abs(start.project_with_jacobians(bearings[seen]).d_params).max(axis=(0, 1))
        self.steps = _STEP_PX / np.maximum(moves, 1e-9)

    def lens_at(self, x: Array) -> CameraModel:
        """The lens with these steps of its parameters."""
        return self.start.with_params(self.start.params + x[_MOUNT:])

    def rotations(self, x: Array, X: Array) -> Array:
        """(P, 3, 3) `second_from_first` of every pair by the gyroscope."""
        shift = round((self.offset_s + float(x[6])) * 1e9)
        pairs, bias = self.pairs, self.bias + x[3:6]
        return _rotations(pairs, self.turned, X, bias, pairs.first_ns + shift, pairs.second_ns + shift)

    def bearings(self, x: Array) -> tuple[Array, Array, Mask]:
        lens = self.lens_at(x)
        (a, seen_a), (b, seen_b) = (lens.unproject(p) for p in (self.pairs.first, self.pairs.second))
        valid = seen_a & seen_b
        return np.where(valid[:, None], a, 1.0), np.where(valid[:, None], b, 1.0), valid

    def solved(self, turn: TurnFit) -> GyroLens:
        """Levenberg-Marquardt with Cauchy's loss, its width renewed every few steps."""
        x, X = np.zeros(_MOUNT + len(self.start.params)), turn.imu_from_cam
        a, b, _ = self.bearings(x)
        state = _State(x, X, direction_of_pairs(self.pairs, a, b, self.rotations(x, X)))
        now, damping, size = self._linearised(state), 1e-3, 1.0
        for done in range(_ROUNDS):
            if done % _RENEWED == 0:
                size = max(robust_std(now[0]), 1e-6)
            try:
                tried = self._stepped(state, now, size, damping)
                then = self._linearised(tried)
            except CameraError:  # a lens that cannot be
                damping *= 10
                continue
            before, after = self._cost(state, now, size), self._cost(tried, then, size)
            if not after < before:
                damping *= 10
                if damping > _MOST_DAMPING:
                    break
                continue
            state, now, damping = tried, then, max(damping / 10, 1e-9)
            if before - after < _SETTLED * before and done > _RENEWED:
                break
        return self._concluded(state, now, size)

    def _cost(self, state: _State, now: _Linearised, size: float) -> float:
        known = float(state.x @ self.prior @ state.x)
        return 4 * float(np.sum(np.log1p((now[0] / (2 * size)) ** 2))) + known

    def _stepped(self, state: _State, now: _Linearised, size: float, damping: float) -> _State:
        error, by_t, by_x = now
        weights = 1 / (1 + (error / (2 * size)) ** 2)
        reduced, right, back = eliminate_pairs(self.pairs, error, by_t, by_x, weights, damping)
        prior = size**2 * self.prior
        damped = reduced + prior + np.diag(damping * np.diag(reduced))
        step = self._solved(damped, right - prior @ state.x)
        moved = state.x + step
        moved[:3] = 0.0  # what is known of the rotation is about where it is
        return _State(moved, so3.exp(step[:3]) @ state.X, moved_directions(state.t, back(step)))

    def _solved(self, matrix: Array, right: Array) -> Array:
        """A step no longer than half a deviation of what is known; parameters are of very different sizes."""
        scale = 1 / np.sqrt(np.diag(matrix))
        step = scale * np.linalg.solve(matrix * np.outer(scale, scale), scale * right)
        return np.asarray(step * min(1.0, _LARGEST / max(float(np.abs(step / self.std).max()), 1e-12)))

    def _linearised(self, state: _State) -> _Linearised:
        """Distances (K,), derivatives by directions (K, 2) and by mounting and lens (K, 7 + L); zero where
        not valid."""
        pairs, (x, X, t) = self.pairs, state
        a, b, valid = self.bearings(x)
        R = self.rotations(x, X)
        error = sampson_distances(a, b, R, t, pairs.pair)
        bases, h = tangents(t), 1e-6
        by_t = np.stack(
            [(sampson_distances(a, b, R, t + h * bases[:, :, k], pairs.pair) - error) / h for k in range(2)],
            axis=1,
        )
        columns = []
        for k, step in enumerate(np.concatenate([_MOUNT_STEPS, self.steps])):
            off = x.copy()
            off[k] += step
            if k < _MOUNT:
                turned = so3.exp(step * np.eye(3)[k]) @ X if k < 3 else X
                moved = sampson_distances(a, b, self.rotations(off, turned), t, pairs.pair)
            else:
                a2, b2, good = self.bearings(off)
                valid = valid & good
                moved = sampson_distances(a2, b2, R, t, pairs.pair)
            columns.append((moved - error) / step)
        keep = valid[:, None]
        by_x = np.stack(columns, axis=1)
        return np.where(valid, error, _WITHOUT_RAY), np.where(keep, by_t, 0.0), np.where(keep, by_x, 0.0)

    def _concluded(self, state: _State, now: _Linearised, size: float) -> GyroLens:
        error, by_t, by_x = now
        weights = 1 / (1 + (error / (2 * size)) ** 2)
        reduced, _, _ = eliminate_pairs(self.pairs, error, by_t, by_x, weights, 1e-9)
        information = reduced + size**2 * self.prior
        covariance = scatter_covariance(self.pairs, error, by_t, by_x, weights, information)[_MOUNT:, _MOUNT:]
        lens = self.lens_at(state.x)
        offset_s = self.offset_s + float(state.x[6])
        rms_px = robust_std(error) * axis_focal_px(lens)
        bias = self.bias + state.x[3:6]
        return GyroLens(lens, state.X, bias, offset_s, rms_px, covariance, len(self.pairs.rotation))
