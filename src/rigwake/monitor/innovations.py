"""What each block says against what was believed before it, with covariances."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from rigwake._types import Array
from rigwake.calibration import Calibration
from rigwake.monitor.pair_kernels import MOUNTING
from rigwake.monitor.score import BlockScores
from rigwake.monitor.thresholds import Thresholds

ROTATION, TRANSLATION, CLOCK = PARTS = 0, 1, 2
_UNKNOWN_OFFSET_S, _UNKNOWN_PLACE_M, _UNKNOWN_TURN = 2e-3, 1.0, 0.1
_FIRST_SPREADS, _FEWEST_DIFFERENCES = (
    (2.0, 4.0, 2.0),
    4,
)  # until the recording tells: measured over open water
_MEDIANS = (2.366, 2.366, 0.455)  # of chi-square with three and one degrees of freedom
_LEAST_OFFSET_S, _LEAST_PLACE_M = 1e-4, 2e-3
_BIAS_BLOCKS, _FEWEST_BIASES = 12, 3  # whose gyro bias a block's is held against
_BIAS_SURE = 2.0  # standard deviations as the blocks tell them, up to which biases agree


def horizon_columns(cameras: int) -> int:
    """Where the constants of the cameras' lines begin in the scores: behind the offsets of pairs, three a camera."""
    return MOUNTING * cameras + 3 * (cameras * (cameras - 1) // 2)


@dataclass(frozen=True, eq=False)
class Belief:
    """Corrections (7C,) of a calibration that are likely, and their covariance (7C, 7C), in rig axes."""

    mean: Array
    covariance: Array


@dataclass(frozen=True, eq=False)
class Innovations:
    """Scores of B blocks against beliefs.

    scores: the blocks. belief: of the calibration itself. spread: (B, C, 3), of `spreads`. steady: (B,) what is
    believed from the blocks that ended `steady_lag` before each. g_calibration, g_steady: (B, C, 3, 3) clipped scores
    of each camera's rotation, translation and time offset (one number) against either.
    """

    scores: BlockScores
    belief: Belief
    spread: Array
    steady: tuple[Belief, ...]
    g_calibration: Array
    g_steady: Array

    def step(self, camera: int, block: int) -> tuple[Array, Array]:
        """A camera's rotation (3,) rad against the calibration by one block alone, and its covariance (3, 3)."""
        at = self.scores.columns(camera)
        H, g = self.scores.H[block][at, at], self.scores.g[block][at]
        variance = _score_covariance(
            self.scores, self.belief, camera, slice(block, block + 1), ROTATION, self.spread[block]
        )
        inverse = np.linalg.pinv(H, rcond=1e-9, hermitian=True)
        return inverse @ g, inverse @ variance @ inverse


def belief_of(calibration: Calibration, cameras: tuple[str, ...], thresholds: Thresholds) -> Belief:
    """How far a calibration may be off, by its own covariance; what it does not know counts as loose."""
    size = MOUNTING * len(cameras)
    covariance = np.zeros((size, size))
    names = list(calibration.cameras)
    joint = calibration.joint_covariance
    turns = {}
    for k, name in enumerate(cameras):
        camera = calibration.cameras[name]
        R = np.nan_to_num(camera.rig_from_cam.rotation)
        turns[name] = np.kron(np.eye(2), R)
        own = turns[name] @ np.nan_to_num(camera.covariance) @ turns[name].T
        at = MOUNTING * k + np.arange(6)
        covariance[np.ix_(at, at)] = own
        std = camera.time_offset_std_s
        covariance[at[-1] + 1, at[-1] + 1] = (
            max(_UNKNOWN_OFFSET_S if std is None else std, _LEAST_OFFSET_S) ** 2
        )
        loose = np.concatenate([np.full(3, _UNKNOWN_TURN), np.full(3, _UNKNOWN_PLACE_M)]) ** 2
        known = camera.observable_axes & np.isfinite(np.diag(camera.covariance))
        covariance[at, at] += np.where(known, 0.0, loose)
    if joint is not None and np.isfinite(joint).all():
        for a, first in enumerate(cameras):
            for b, second in enumerate(cameras):
                if a == b:
                    continue
                i, j = 6 * names.index(first), 6 * names.index(second)
                rows, columns = MOUNTING * a + np.arange(6), MOUNTING * b + np.arange(6)
                covariance[np.ix_(rows, columns)] = (
                    turns[first] @ joint[i : i + 6, j : j + 6] @ turns[second].T
                )
    floor = np.tile(
        np.r_[np.full(3, np.deg2rad(thresholds.floor_deg)), np.full(3, _LEAST_PLACE_M), 0.0], len(cameras)
    )
    return Belief(np.zeros(size), _positive(covariance) + np.diag(floor**2))


def with_offsets(belief: Belief, size: int, thresholds: Thresholds) -> Belief:
    """The same with what may be off for good behind, up to `size` columns: between pairs of cameras, as lenses leave
    it, and the horizon's line of each camera, as shores leave it."""
    known = len(belief.mean)
    covariance = np.eye(size) * np.deg2rad(thresholds.offset_deg) ** 2
    covariance[:known, :known] = belief.covariance
    lines = slice(horizon_columns(known // MOUNTING), None)
    covariance[lines, lines] *= (thresholds.line_deg / thresholds.offset_deg) ** 2
    return Belief(np.concatenate([belief.mean, np.zeros(size - known)]), covariance)


def discount_wrong_motion(scores: BlockScores) -> BlockScores:
    """Scores of the motion in which a block counts less, the further its gyro bias lies from that of the blocks before.

    A gyro's bias hardly changes within minutes. On a straight course over open water a wrong bias and a wrong direction
    of travel fit nearly as well as the true ones, and every camera's step is then wrong by more than `H` says. From
    scores as they come from `score_blocks`, once.
    """
    weight = np.ones(len(scores))
    known = np.asarray(np.isfinite(scores.bias).all(axis=1))
    for k in np.flatnonzero(known).tolist():
        first = max(k - _BIAS_BLOCKS, 0)
        before = scores.bias[first:k][known[first:k]]
        if len(before) < _FEWEST_BIASES:
            continue
        off = float(np.linalg.norm(scores.bias[k] - np.median(before, axis=0)))
        weight[k] = min(1.0, (_BIAS_SURE * float(scores.bias_std[k]) / max(off, 1e-12)) ** 2)
    return replace(
        scores,
        H=scores.H * weight[:, None, None],
        g=scores.g * weight[:, None],
        sectors=scores.sectors * weight[:, None, None, None, None],
    )


def innovations_of_motion(scores: BlockScores, belief: Belief, thresholds: Thresholds) -> Innovations:
    """As `innovations`, of the motion's scores, with `discount_wrong_motion`; not joint scores, which hold it already.

    The spread is that of the scores as they are: blocks that count little would make the others look surer.
    """
    return innovations(discount_wrong_motion(scores), belief, thresholds, spreads(scores))


def innovations(
    scores: BlockScores, belief: Belief, thresholds: Thresholds, spread: Array | None = None
) -> Innovations:
    """Clipped scores of every block against the calibration and against the steady state before it.

    spread: as of `spreads`, which tells it by default.
    """
    spread = spreads(scores) if spread is None else spread
    steady = _steady_beliefs(scores, belief, thresholds, spread)
    blocks, cameras = len(scores), len(scores.cameras)
    by_calibration, by_steady = np.zeros((blocks, cameras, 3, 3)), np.zeros((blocks, cameras, 3, 3))
    for k in range(blocks):
        for c in range(cameras):
            for believed, out in ((belief, by_calibration), (steady[k], by_steady)):
                for part in PARTS:
                    at = scores.columns(c, part)
                    g = scores.g[k][at] - scores.H[k][at] @ believed.mean
                    V = _score_covariance(scores, believed, c, slice(k, k + 1), part, spread[k])
                    out[k, c, part, : len(g)] = g * min(1.0, thresholds.clip / max(_length(g, V), 1e-12))
    return Innovations(scores, belief, spread, steady, by_calibration, by_steady)


def spreads(scores: BlockScores) -> Array:
    """(B, C, 3): how much more rotations, translations, clocks scatter from block to block than covariances say.

    The median over the blocks before, of squared differences of neighbours: a camera that moved adds a single one, a
    slow drift next to nothing. At least one.
    """
    shape = len(scores), len(scores.cameras), len(PARTS)
    spread = np.broadcast_to(_FIRST_SPREADS, shape).copy()
    for c in range(shape[1]):
        for part in PARTS:
            at = scores.columns(c, part)
            squares: list[float] = []
            last: tuple[Array, Array] | None = None
            for k in range(shape[0]):
                if len(squares) >= _FEWEST_DIFFERENCES:
                    spread[k, c, part] = max(float(np.median(squares[-60:])) / _MEDIANS[part], 1.0)
                H, g = scores.H[k][at, at], scores.g[k][at]
                if not scores.rows[k, c] or np.linalg.eigvalsh(H)[0] <= 0:
                    continue
                covariance = np.linalg.inv(H)
                step, covariance = covariance @ g, covariance * scores.inflation[k, c]
                if last is not None:
                    squares.append(_length(step - last[0], covariance + last[1]) ** 2)
                last = step, covariance
    return spread


def _length(g: Array, V: Array) -> float:
    """`sqrt(g' V^-1 g)`; directions without information count nothing."""
    square = float(g @ np.linalg.pinv(V, rcond=1e-9, hermitian=True) @ g)
    return float(np.sqrt(max(square, 0.0)))


def _score_covariance(
    scores: BlockScores, believed: Belief, camera: int, blocks: slice, part: int, spread: Array
) -> Array:
    """(3, 3) of the summed score of a camera's rotation, translation or clock: noise, and what is not known."""
    at = scores.columns(camera, part)
    H = scores.H[blocks][:, at]
    noise = np.einsum("bij,b->ij", H[:, :, at], scores.inflation[blocks, camera])
    total = H.sum(axis=0)
    return np.asarray(spread[camera, part] * noise + total @ believed.covariance @ total.T)


def window_statistic(
    found: Innovations, camera: int, first: int, last: int, *, steady: bool, part: int = ROTATION
) -> tuple[float, Array, Array]:
    """Likelihood ratio of blocks `first .. last` against no change; the step (3,), rad or metres, and its
    covariance (3, 3)."""
    scores = found.scores
    believed = found.steady[last] if steady else found.belief
    g = (found.g_steady if steady else found.g_calibration)[first : last + 1, camera, part].sum(axis=0)
    g = g[: 1 if part == CLOCK else 3]
    V = _score_covariance(scores, believed, camera, slice(first, last + 1), part, found.spread[last])
    at = scores.columns(camera, part)
    H = scores.H[first : last + 1, at, at].sum(axis=0)
    inverse = np.linalg.pinv(H, rcond=1e-9, hermitian=True)
    return _length(g, V) ** 2, inverse @ g, inverse @ V @ inverse


def _steady_beliefs(
    scores: BlockScores, belief: Belief, thresholds: Thresholds, spread: Array
) -> tuple[Belief, ...]:
    """Per block what is believed from those that ended `steady_lag` before it: errors that stay are no change.

    Blocks that disagree with the belief do not sharpen it: a camera that moved must not become the new normal.
    """
    beliefs = [belief]
    current = belief
    floor = np.deg2rad(thresholds.floor_deg)
    for k in range(len(scores)):
        source = k - thresholds.steady_lag
        if source >= 0:
            current = _updated(scores, current, source, thresholds, floor, spread[k].max(axis=1))
        beliefs.append(current)
    return tuple(beliefs[1:])


def _updated(
    scores: BlockScores, belief: Belief, block: int, thresholds: Thresholds, floor: float, spread: Array
) -> Belief:
    H, g = scores.H[block], scores.g[block]
    if not H.any():
        return belief
    wide = float(
        (scores.inflation[block] * spread).mean()
    )  # one number: else a steady error would seem to change
    H, g = H / wide, g / wide
    g = g - H @ belief.mean
    for c in range(len(scores.cameras)):
        at = scores.columns(c)
        V = H[at, at] + H[at] @ belief.covariance @ H[at].T
        if _length(g[at], V) > thresholds.clip:
            return belief
    # mean + P g, P = (S^-1 + H)^-1 = S (I + H S)^-1
    covariance = belief.covariance @ np.linalg.inv(np.eye(len(g)) + H @ belief.covariance)
    mean = belief.mean + covariance @ g
    covariance = (covariance + covariance.T) / 2
    least = np.zeros(len(g))
    for c in range(len(scores.cameras)):
        turns = scores.columns(c)
        least[turns] = np.maximum(floor**2 - np.diag(covariance)[turns], 0.0)
    offsets = slice(MOUNTING * len(scores.cameras), None)
    still = np.full(len(g), np.deg2rad(thresholds.offset_floor_deg) ** 2)
    still[horizon_columns(len(scores.cameras)) :] = np.deg2rad(thresholds.line_floor_deg) ** 2
    least[offsets] = np.maximum(still - np.diag(covariance), 0.0)[offsets]
    return Belief(mean, covariance + np.diag(least))


def _positive(covariance: Array) -> Array:
    values, vectors = np.linalg.eigh((covariance + covariance.T) / 2)
    return np.asarray((vectors * np.maximum(values, 0.0)) @ vectors.T)
