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
from rigwake._types import Array, Stamps
from rigwake.ba.rig.intrinsics_refinement import IntrinsicsWidth, intrinsics_prior
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
    pixel_distances,
    rays_at,
    rays_of,
    scatter_covariance,
    tangents,
)
from rigwake.recording import ImuStream
from rigwake.tracks import Tracks
from rigwake.trajectory import Trajectory

_FEWEST_PAIRS = 8
_ROUNDS, _STEPS = 8, 12
_MOST_DAMPING, _SETTLED = 1e6, 1e-3
_REDESCENDS = 3.0  # deviations
_LEAST_PX = 0.01
_MOUNT = 7  # rotation, gyro bias, time offset
_MOUNT_STD = np.array([0.5, 0.5, 0.5, 0.05, 0.05, 0.05, 0.1])
_MOUNT_STEPS = np.array([1e-5] * 6 + [1e-4])
_STEP_PX = 0.02
_WITHOUT_RAY_PX = 20.0  # what a point counts that the lens has no ray for
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
    pairs: ViewPairs,
    start: CameraModel,
    imu: ImuStream,
    turn: TurnFit,
    width: IntrinsicsWidth = UNKNOWN,
    first: CameraModel | None = None,
) -> GyroLens:
    """The lens by which pictures turn as the gyroscope does.

    start: the prior's mean; width: its deviations. first: where to begin, if elsewhere. turn: how the camera's turns
    compare with the gyroscope's by a lens like `start`.
    """
    return _Problem(
        pairs, start, start if first is None else first, integrate_gyro(imu), turn, width
    ).solved()


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
    a, b = (rays_of(found.lens, p) for p in (pairs.first, pairs.second))
    off = pixel_distances(a, b, R, direction_of_pairs(pairs, a.bearings, b.bearings, R), pairs.pair)
    squares = np.where(a.seen & b.seen, np.minimum(off**2, _MOST_PX**2), _MOST_PX**2)
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
    """Distances of all pairs by lens and mounting, in pixels, and their least squares."""

    def __init__(
        self,
        pairs: ViewPairs,
        believed: CameraModel,
        start: CameraModel,
        turned: TurnedImu,
        turn: TurnFit,
        width: IntrinsicsWidth,
    ) -> None:
        self.pairs, self.believed, self.turned = pairs, believed, turned
        self.bias, self.offset_s, self.mount = turn.gyro_bias, turn.time_offset_s, turn.imu_from_cam
        prior = intrinsics_prior(believed, np.concatenate([pairs.first, pairs.second]), width)
        self.prior = np.zeros((_MOUNT + len(prior.mean), _MOUNT + len(prior.mean)))
        self.prior[:_MOUNT, :_MOUNT] = np.diag(1 / _MOUNT_STD**2)
        self.prior[_MOUNT:, _MOUNT:] = prior.information
        self.std = np.sqrt(np.diag(np.linalg.inv(self.prior)))
        self.first = np.concatenate([np.zeros(_MOUNT), start.params - believed.params])

    def lens_at(self, x: Array) -> CameraModel:
        """The lens with these steps of its parameters."""
        return self.believed.with_params(self.believed.params + x[_MOUNT:])

    def rotations(self, x: Array, X: Array) -> Array:
        """(P, 3, 3) `second_from_first` of every pair by the gyroscope."""
        shift = round((self.offset_s + float(x[6])) * 1e9)
        pairs, bias = self.pairs, self.bias + x[3:6]
        return _rotations(pairs, self.turned, X, bias, pairs.first_ns + shift, pairs.second_ns + shift)

    def with_directions(self, x: Array, X: Array) -> _State:
        """The directions that suit a lens and a mounting."""
        lens = self.lens_at(x)
        a, b = (lens.unproject(p)[0] for p in (self.pairs.first, self.pairs.second))
        seen = np.isfinite(np.concatenate([a, b], axis=1)).all(axis=1)
        a, b = np.where(seen[:, None], a, _NO_RAY), np.where(seen[:, None], b, _NO_RAY)
        return _State(x, X, direction_of_pairs(self.pairs, a, b, self.rotations(x, X)))

    def solved(self) -> GyroLens:
        """Levenberg-Marquardt with a loss that forgets what is far off; its width and the directions, which may be
        caught where wrong points want them, are renewed between rounds."""
        state, last = self.with_directions(self.first, self.mount), np.inf
        for _ in range(_ROUNDS):
            now = self._linearised(state)
            size = max(robust_std(now[0]), _LEAST_PX)
            state, now = self._minimised(state, now, size)
            again = self.with_directions(state.x, state.X)
            if self._cost(again, self._errors(again), size) < self._cost(state, now[0], size):
                state, now = again, self._linearised(again)
            size = max(robust_std(now[0]), _LEAST_PX)
            if abs(size - last) < _SETTLED * size:
                break
            last = size
        return self._concluded(state, now, size)

    def _minimised(self, state: _State, now: _Linearised, size: float) -> tuple[_State, _Linearised]:
        damping = 1e-3
        for _ in range(_STEPS):
            try:
                tried = self._stepped(state, now, size, damping)
                then = self._errors(tried)
            except (CameraError, np.linalg.LinAlgError):  # a lens that cannot be
                damping *= 10
                continue
            before, after = self._cost(state, now[0], size), self._cost(tried, then, size)
            if not after < before:
                damping *= 10
                if damping > _MOST_DAMPING:
                    break
                continue
            state, now, damping = tried, self._linearised(tried), max(damping / 10, 1e-9)
            if before - after < _SETTLED * before:
                break
        return state, now

    def _errors(self, state: _State) -> Array:
        lens, pairs = self.lens_at(state.x), self.pairs
        a, b = (rays_of(lens, p) for p in (pairs.first, pairs.second))
        off = pixel_distances(a, b, self.rotations(state.x, state.X), state.t, pairs.pair)
        return np.where(a.seen & b.seen, off, _WITHOUT_RAY_PX)

    def _cost(self, state: _State, error: Array, size: float) -> float:
        squares = (error / (_REDESCENDS * size)) ** 2
        known = float(state.x @ self.prior @ state.x)
        return _REDESCENDS**2 * float(np.sum(squares / (1 + squares))) + known

    def _stepped(self, state: _State, now: _Linearised, size: float, damping: float) -> _State:
        error, by_t, by_x = now
        reduced, right, back = eliminate_pairs(self.pairs, error, by_t, by_x, _weights(error, size), damping)
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
        lens = self.lens_at(x)
        a, b = (rays_of(lens, p) for p in (pairs.first, pairs.second))
        R, valid = self.rotations(x, X), a.seen & b.seen
        error = pixel_distances(a, b, R, t, pairs.pair)
        bases, h = tangents(t), 1e-6
        by_t = [(pixel_distances(a, b, R, t + h * bases[:, :, k], pairs.pair) - error) / h for k in range(2)]
        by_x = []
        for k, step in enumerate(_MOUNT_STEPS):
            off = x.copy()
            off[k] += step
            turned = so3.exp(step * np.eye(3)[k]) @ X if k < 3 else X
            moved = pixel_distances(a, b, self.rotations(off, turned), t, pairs.pair)
            by_x.append((moved - error) / step)
        steps = _STEP_PX / np.maximum(np.abs(a.d_params[a.seen]).max(axis=(0, 1)), 1e-9)
        for k, step in enumerate(steps.tolist()):
            params = lens.params.copy()
            params[k] += step
            off_lens = lens.with_params(params)
            a2, b2 = (
                rays_at(
                    off_lens,
                    r.bearings - step * np.einsum("kij,kj->ki", r.by_pixels, r.d_params[:, :, k]),
                    r.seen,
                )
                for r in (a, b)
            )
            valid &= a2.seen & b2.seen
            by_x.append((pixel_distances(a2, b2, R, t, pairs.pair) - error) / step)
        keep = valid[:, None]
        return (
            np.where(valid, error, _WITHOUT_RAY_PX),
            np.where(keep, np.stack(by_t, axis=1), 0.0),
            np.where(keep, np.stack(by_x, axis=1), 0.0),
        )

    def _concluded(self, state: _State, now: _Linearised, size: float) -> GyroLens:
        error, by_t, by_x = now
        weights = _weights(error, size)
        reduced, _, _ = eliminate_pairs(self.pairs, error, by_t, by_x, weights, 1e-9)
        information = reduced + size**2 * self.prior
        covariance = scatter_covariance(self.pairs, error, by_t, by_x, weights, information)[_MOUNT:, _MOUNT:]
        offset_s = self.offset_s + float(state.x[6])
        return GyroLens(
            self.lens_at(state.x), state.X, self.bias + state.x[3:6], offset_s, robust_std(error), covariance,
            len(self.pairs.rotation),
        )  # fmt: skip


def _weights(error: Array, size: float) -> Array:
    """Of distances (K,) by the loss of Geman and McClure."""
    return np.asarray(1 / (1 + (error / (_REDESCENDS * size)) ** 2) ** 2)
