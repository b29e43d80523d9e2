"""Blocks of ten seconds: which small changes of the cameras' mountings and clocks would explain their tracks better?

Every pair of frames a second apart gives epipolar residuals (`pair_kernels.py`). The rig's velocity (every pair), the
gyro's noise (every pair) and its bias (every block) are unknown beside the changes of all cameras together, and are
eliminated; what is left are normal equations `H x = g` of all cameras per block. A camera's step is then taken against
the information-weighted mean of the others: an error that all cameras share moves the rig's motion instead.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve

from rigwake._tables import take_rows
from rigwake._types import Array, Indices
from rigwake.monitor.block_motion import (
    BIAS_START_STD,
    FEWEST_ROWS,
    BlockMotion,
    GyroBias,
    above_water,
    block_motion,
    way_residuals,
)
from rigwake.monitor.frame_pairs import EpipolarPairs, pair_frames
from rigwake.monitor.pair_kernels import COLUMNS, LOSS_STDS, MOUNTING, accumulate, sum_by, sum_products
from rigwake.monitor.rig_motion import PairMotion, RigMotion
from rigwake.monitor.velocity import Slots, VelocityPriors
from rigwake.rig import Rig
from rigwake.tracks import Tracks

BLOCK_S = 10.0
_SCORE_LOSS_STDS = 4.0  # of Cauchy's: a camera that moved must not be taken for outliers
_BIAS_LEAST_STD, _BIAS_ROUNDS = 1e-4, 12  # rad/s
_BIAS_TRIALS = np.linspace(-2.0, 2.0, 7)  # standard deviations: a fifth of a degree per second apart
_NUISANCES = 6  # of a slot: rotation and velocity of the rig
_SECTORS = 4  # of the image, around the optical axis


@dataclass(frozen=True, eq=False)
class BlockScores:
    """Normal equations of B blocks for the changes of C cameras.

    cameras: names. starts_ns: (B,) rig clock. H: (B, 7C, 7C), g: (B, 7C): per camera rotation (rad), translation (m)
    and time offset (s), in rig axes, other unknowns eliminated. inflation: (B, C), by how much a camera's score
    varies more than `H` says, from the scatter of whole tracks. noise: (B, C), residuals over what the tracks predict.
    rows: (B, C) observations used. speed: (B,) m/s, turning: (B,) root mean square of the turn rate, rad/s.
    gravity: (B, 3) mean direction against gravity in rig axes. sectors: (B, C, 4, 4, 4) of image quarters the normal
    equations of a rotation alone: `[[H, g], [g, n]]`. bias: (B, 3) rad/s,
    of the gyro beside what was taken off before, and bias_std (B,).
    """

    cameras: tuple[str, ...]
    starts_ns: Indices
    H: Array
    g: Array
    inflation: Array
    noise: Array
    rows: NDArray[np.int64]
    speed: Array
    turning: Array
    gravity: Array
    sectors: Array
    bias: Array
    bias_std: Array

    def __len__(self) -> int:
        return len(self.starts_ns)

    def columns(self, camera: int, part: int = 0) -> slice:
        """Where a camera's rotation (part 0), translation (1) or time offset (2) stands."""
        first = MOUNTING * camera + 3 * part
        return slice(first, first + (1 if part == 2 else 3))

    def by_column(self, values: Array) -> Array:
        """Numbers of the cameras (.., C) for every column of `H`; offsets of pairs take the cameras' mean."""
        own = np.repeat(values, MOUNTING, axis=-1)
        more = self.H.shape[-1] - own.shape[-1]
        mean = np.broadcast_to(values.mean(axis=-1, keepdims=True), (*values.shape[:-1], more))
        return np.concatenate([own, mean], axis=-1)

    def take(self, index: slice | NDArray[np.int64]) -> BlockScores:
        """The chosen blocks."""
        return take_rows(self, index, keep=("cameras",))


def join_blocks(parts: list[BlockScores]) -> BlockScores:
    """Blocks of the same cameras, one after the other."""
    names = (
        "starts_ns",
        "H",
        "g",
        "inflation",
        "noise",
        "rows",
        "speed",
        "turning",
        "gravity",
        "sectors",
        "bias",
        "bias_std",
    )
    return BlockScores(
        parts[0].cameras, *(np.concatenate([getattr(part, name) for part in parts]) for name in names)
    )


def score_blocks(
    tracks: Mapping[str, Tracks],
    rig: Rig,
    motion: RigMotion,
    *,
    starts_ns: Indices | None = None,
    bias: GyroBias | None = None,
    stride: int = 1,
) -> BlockScores:
    """Score every block of a recording, in the order of time.

    tracks: of every camera of the rig. rig: in the IMU's frame (`rig_motion.py`), every number known. starts_ns: of the
    blocks; from the first to the last frame by default. bias: of the gyro, where it is known from before.
    """
    return score_blocks_with_motion(tracks, rig, motion, starts_ns=starts_ns, bias=bias, stride=stride)[0]


def score_blocks_with_motion(
    tracks: Mapping[str, Tracks],
    rig: Rig,
    motion: RigMotion,
    *,
    starts_ns: Indices | None = None,
    bias: GyroBias | None = None,
    stride: int = 1,
) -> tuple[BlockScores, list[BlockMotion | None]]:
    """As `score_blocks`, and how the rig moved in every block, None where it made too little way."""
    if starts_ns is None:
        starts_ns = block_starts(tracks, rig, motion)
    bias = bias or GyroBias.unknown()
    blocks, motions = [], []
    for start in starts_ns.tolist():
        pairs = above_water(
            pair_frames(tracks, rig, start, start + round(BLOCK_S * 1e9), stride=stride), motion
        )
        if bias.std >= BIAS_START_STD:
            bias = _likeliest_bias(pairs, rig, motion, start, bias)
        for _ in range(_BIAS_ROUNDS):
            moved = block_motion(pairs, rig, motion, bias)
            block, found = score_block(moved, rig, motion, start, bias)
            if np.linalg.norm(found.value - bias.value) <= found.std:
                break
            # velocities were found with a bias that is far off: over an open bay they make up for it, so that one
            # step does not reach the optimum, however sure it looks
            bias = GyroBias(found.value, BIAS_START_STD)
        bias = found
        blocks.append(block)
        motions.append(moved)
    if not blocks:
        return _nothing(tuple(rig.cameras), np.empty(0, dtype=np.int64)), []
    return join_blocks(blocks), motions


def _likeliest_bias(
    pairs: EpipolarPairs, rig: Rig, motion: RigMotion, start_ns: int, bias: GyroBias
) -> GyroBias:
    """The start for the gyro's bias about the vertical, of some within two standard deviations, that leads to the best
    fit after one step.

    Over an open bay a wrong bias and a wrong direction of travel together fit nearly as well as the true ones, and no
    step leads from one to the other. Gravity tells the bias about the level axes (`rig_motion.py`).
    """
    if len(pairs.pair) < FEWEST_ROWS:
        return bias
    up = motion.up_rig_at(pairs.first_ns[:1])[0]
    best, least = bias, np.inf
    for stds in _BIAS_TRIALS:
        tried = GyroBias(bias.value + stds * bias.std * up, bias.std)
        found = score_block(block_motion(pairs, rig, motion, tried), rig, motion, start_ns, tried)[1]
        moved = block_motion(pairs, rig, motion, found)
        if moved is None:
            continue
        residual = way_residuals(moved.pairs, moved.between.rotation, moved.way) / LOSS_STDS
        cost = LOSS_STDS**2 * len(pairs.pair) * float(np.log1p(residual**2).mean()) + stds**2
        if cost < least:
            best, least = GyroBias(found.value, bias.std), cost
    return best


def block_starts(tracks: Mapping[str, Tracks], rig: Rig, motion: RigMotion) -> Indices:
    """Starts of whole blocks within the time that cameras and IMU cover."""
    stamps = [
        tracks[name].timestamps_ns + round(camera.time_offset_s * 1e9) for name, camera in rig.cameras.items()
    ]
    known = [s for s in stamps if len(s)]
    if not known:
        return np.empty(0, dtype=np.int64)
    first = max(min(int(s[0]) for s in known), int(motion.timestamps_ns[0]))
    last = min(max(int(s[-1]) for s in known), int(motion.timestamps_ns[-1]))
    block = round(BLOCK_S * 1e9)
    count = (
        last - first + round(1.5e9)
    ) // block  # pairs reach a second further; the last block may lack some
    return first + block * np.arange(max(count, 0), dtype=np.int64)


def score_block(
    moved: BlockMotion | None, rig: Rig, motion: RigMotion, start_ns: int, bias: GyroBias
) -> tuple[BlockScores, GyroBias]:
    """One block, and what is known of the gyro's bias after it."""
    size = MOUNTING * len(rig.cameras)
    if moved is None:
        return _nothing(tuple(rig.cameras), np.array([start_ns], dtype=np.int64)), bias
    pairs, between, way, scale = moved.pairs, moved.between, moved.way, moved.scale
    slots = moved.priors.slots
    residual = way_residuals(pairs, between.rotation, way)
    whitened = residual / (_SCORE_LOSS_STDS * scale[pairs.camera][pairs.pair])
    weight = 1 / (1 + whitened**2) / scale[pairs.camera][pairs.pair] ** 2
    products = np.zeros((len(pairs.camera), COLUMNS, COLUMNS))
    rows = np.empty((len(pairs.pair), COLUMNS))
    accumulate(
        pairs.first,
        pairs.second,
        pairs.std,
        weight,
        pairs.pair,
        between.rotation,
        way,
        between.by_velocity,
        moved.place,
        between.turning,
        between.drift,
        between.turning_first,
        products,
        rows,
    )
    products = products + np.tril(products, -1).transpose(0, 2, 1)
    H, g, new_bias = _eliminate(products, pairs, moved.priors, moved.velocity, motion.gyro_noise, bias)
    counts = np.bincount(pairs.camera[pairs.pair], minlength=len(pairs.cameras))
    poor = np.repeat(counts < FEWEST_ROWS, MOUNTING)
    H[poor, :], H[:, poor], g[poor] = 0.0, 0.0, 0.0
    up = motion.up_rig_at(slots.reference_ns).mean(axis=0)
    rates = np.linalg.norm(between.turning_first, axis=1)
    block = BlockScores(
        pairs.cameras,
        np.array([start_ns], dtype=np.int64),
        H.reshape(1, size, size),
        g.reshape(1, size),
        _inflation(rows, weight, pairs)[None],
        scale[None],
        counts[None],
        np.array([float(np.median(np.linalg.norm(moved.velocity, axis=1)))]),
        np.array([float(np.sqrt(np.mean(rates**2)))]),
        up[None] / np.linalg.norm(up),
        _sectors(rows, weight, pairs)[None],
        new_bias.value[None],
        np.array([new_bias.std]),
    )
    return block, new_bias


def _pair_seconds(slots: Slots) -> float:
    return float(np.median(slots.second_ns - slots.first_ns)) * 1e-9


def _eliminate(
    products: Array,
    pairs: EpipolarPairs,
    priors: VelocityPriors,
    velocity: Array,
    gyro_noise: float,
    bias: GyroBias,
) -> tuple[Array, Array, GyroBias]:
    """Normal equations of all cameras' changes, without what else is unknown, and the gyro's bias that they give.

    Unknown besides: per slot what the gyro's noise turned and the velocity; for the block an acceleration in level axes
    (the level is not exact), the biases of accelerometer and gyro. Velocities of neighbouring slots differ by what the
    accelerometer says.
    """
    slots = priors.slots
    size, count = MOUNTING * len(pairs.cameras), len(slots.reference_ns)
    known = _NUISANCES * count  # first the slots, then the block, then the changes
    total = known + 9 + size
    H, g = np.zeros((total, total)), np.zeros(total)
    by_slot = np.zeros((count, total, _NUISANCES))
    for k in range(len(pairs.cameras)):
        rows = np.flatnonzero(pairs.camera == k)
        part, slot = products[rows], slots.slot[rows]
        at = slice(known + 9 + MOUNTING * k, known + 9 + MOUNTING * (k + 1))
        H[at, at] += part[:, :MOUNTING, :MOUNTING].sum(axis=0)
        g[at] += part[:, :MOUNTING, -1].sum(axis=0)
        np.add.at(by_slot[:, at], slot, part[:, :MOUNTING, MOUNTING:-1])
        for j in range(len(rows)):
            own = slice(_NUISANCES * slot[j], _NUISANCES * (slot[j] + 1))
            H[own, own] += part[j, MOUNTING:-1, MOUNTING:-1]
            g[own] += part[j, MOUNTING:-1, -1]
    H[known + 9 :, :known] = by_slot[:, known + 9 :].transpose(1, 0, 2).reshape(size, known)
    H[:known, known + 9 :] = H[known + 9 :, :known].T
    _add_rotation_priors(H, priors.spans, _pair_seconds(slots), gyro_noise, bias.std)
    H_prior, g_prior = priors.normal_equations(velocity)
    at = np.r_[(_NUISANCES * np.arange(count)[:, None] + [3, 4, 5]).ravel(), known : known + 9]
    H[np.ix_(at, at)] += H_prior
    g[at] += g_prior
    H[range(known + 9), range(known + 9)] += 1e-9
    factor = cho_factor(H[: known + 9, : known + 9], lower=True, check_finite=False)
    cross = np.concatenate([H[: known + 9, known + 9 :], g[: known + 9, None]], axis=1)
    of_bias = np.zeros((known + 9, 3))
    of_bias[known + 6 :] = np.eye(3)
    solution = cho_solve(factor, np.concatenate([cross, of_bias], axis=1), check_finite=False)
    reduced = H[known + 9 :, known + 9 :] - cross[:, :-1].T @ solution[:, :size]
    g_reduced = g[known + 9 :] - cross[:, :-1].T @ solution[:, size]
    std = float(np.sqrt(np.linalg.eigvalsh(solution[known + 6 :, size + 1 :])[-1]))
    found = GyroBias(bias.value + solution[known + 6 :, size], max(3 * std, _BIAS_LEAST_STD))
    return (reduced + reduced.T) / 2, g_reduced, found


def _add_rotation_priors(
    H: Array, spans: PairMotion, seconds: float, gyro_noise: float, bias_std: float
) -> None:
    """The gyro's noise of each slot about its bias: `turned = by_bias @ bias + noise`."""
    count = len(spans.by_bias)
    # pairs overlap: each second's noise must not count as often as there are pairs in it
    overlap = max(count * seconds / BLOCK_S, 1.0)
    information = 1 / (gyro_noise**2 * seconds * overlap)
    at_bias = slice(_NUISANCES * count + 6, _NUISANCES * count + 9)
    for s, by_bias in enumerate(spans.by_bias):
        turned = slice(_NUISANCES * s, _NUISANCES * s + 3)
        H[turned, turned] += information * np.eye(3)
        H[turned, at_bias] -= information * by_bias
        H[at_bias, turned] -= information * by_bias.T
        H[at_bias, at_bias] += information * by_bias.T @ by_bias
    H[at_bias, at_bias] += bias_std**-2.0 * np.eye(3)


def _inflation(rows: Array, weight: Array, pairs: EpipolarPairs) -> Array:
    """(C,) variance of a rotation's score over what independent observations would give, from whole tracks."""
    scores = rows[:, :3] * rows[:, -1:]
    by_track = np.zeros((int(pairs.cluster.max()) + 1, 3))
    sum_by(pairs.cluster, scores, weight, by_track)
    camera_of = np.zeros(len(by_track), dtype=np.int64)
    camera_of[pairs.cluster] = pairs.camera[pairs.pair]
    camera_of_row = pairs.camera[pairs.pair]
    inflation = np.ones(len(pairs.cameras))
    for k in range(len(inflation)):
        mine = camera_of_row == k
        if not mine.any():
            continue
        H = np.einsum("ni,n,nj->ij", rows[mine, :3], weight[mine], rows[mine, :3])
        clusters = by_track[camera_of == k]
        clusters = clusters - clusters.mean(axis=0)
        if np.linalg.eigvalsh(H)[0] > 0:
            inflation[k] = max(float(np.trace(np.linalg.solve(H, clusters.T @ clusters))) / 3, 1.0)
    return inflation


def _sectors(rows: Array, weight: Array, pairs: EpipolarPairs) -> Array:
    """(C, 4, 4, 4) normal equations of a rotation alone, by quarters of the image."""
    result = np.zeros((len(pairs.cameras), _SECTORS, 4, 4))
    camera = pairs.camera[pairs.pair]
    picked = rows[:, [0, 1, 2, COLUMNS - 1]]
    for k in range(len(pairs.cameras)):
        mine = np.flatnonzero(camera == k)
        if not len(mine):
            continue
        middle = np.median(pairs.pixels[mine], axis=0)
        right, low = (pairs.pixels[mine] > middle).T
        sector = 2 * low.astype(np.int64) + right
        sum_products(sector, picked[mine], weight[mine], result[k])
    return result


def _nothing(cameras: tuple[str, ...], starts_ns: Indices) -> BlockScores:
    """Blocks that saw nothing."""
    b, c = len(starts_ns), len(cameras)
    size = MOUNTING * c
    return BlockScores(
        cameras,
        starts_ns,
        np.zeros((b, size, size)),
        np.zeros((b, size)),
        np.ones((b, c)),
        np.ones((b, c)),
        np.zeros((b, c), dtype=np.int64),
        np.zeros(b),
        np.zeros(b),
        np.zeros((b, 3)),
        np.zeros((b, c, _SECTORS, 4, 4)),
        np.full((b, 3), np.nan),
        np.full(b, np.nan),
    )
