"""The rig's velocity a second at a time, from all cameras together as they are calibrated."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import solve_banded

from rigwake._types import Array, Indices
from rigwake.geometry import so3
from rigwake.monitor.frame_pairs import EpipolarPairs
from rigwake.monitor.pair_kernels import LOSS_STDS, accumulate_velocity, pair_residuals, sum_by
from rigwake.monitor.rig_motion import PairMotion, RigMotion, VelocityGained, distance_prior

_GUESS_STD = 0.5  # m/s
_TRIALS, _TRIAL_ROWS = 20, 2000  # first guesses, and observations that each is tried on
_THINNED, _LAST_ROUNDS = 4, 2  # of observations until the last rounds
_ACCEL_MARGIN = 2.0  # over the data sheet's noise: vibration, interpolation
_VELOCITY_FLOOR = 1e-3  # m/s, between neighbouring slots
_LEVEL_STD, _ACCEL_BIAS_STD = 0.5, 0.1  # m/s^2


@dataclass(frozen=True, eq=False)
class Slots:
    """Pairs of frames that start at about the same time share one unknown velocity.

    slot: (P,) of each pair. reference_ns: (S,) their times. distance, distance_std: (S,) of the antenna over the
    slot's span `first_ns .. second_ns` (S,). antenna_rig: (3,).
    """

    slot: Indices
    reference_ns: Indices
    first_ns: Indices
    second_ns: Indices
    distance: Array
    distance_std: Array
    antenna_rig: Array


def slots_of(pairs: EpipolarPairs, motion: RigMotion, spacing_ns: int) -> Slots:
    """Group the pairs by the time at which they start, `spacing_ns` apart."""
    number = (pairs.first_ns - pairs.first_ns.min()) // max(spacing_ns, 1)
    _, slot = np.unique(number, return_inverse=True)
    slot = slot.astype(np.int64)
    count = np.bincount(slot)
    origin = pairs.first_ns.min()
    first = origin + np.round(np.bincount(slot, pairs.first_ns - origin) / count).astype(np.int64)
    second = origin + np.round(np.bincount(slot, pairs.second_ns - origin) / count).astype(np.int64)
    distance, std, antenna = distance_prior(motion, first, second)
    return Slots(slot, (first + second) // 2, first, second, distance, std, antenna)


@dataclass(frozen=True, eq=False)
class VelocityPriors:
    """What GNSS and IMU say of the velocities of a block's S slots, and of an acceleration in level axes (the level is
    not exact) and the biases of accelerometer and gyro: 3S + 9 unknowns in this order.

    antenna: (S, 3) way of the
    antenna beside that of the velocity, in rig axes.
    """

    slots: Slots
    spans: PairMotion
    gained: VelocityGained
    antenna: Array
    accel_noise: float
    gyro_bias: Array

    @classmethod
    def of(cls, slots: Slots, spans: PairMotion, motion: RigMotion, gyro_bias: Array) -> VelocityPriors:
        """The priors of a block."""
        gained = motion.velocity_gained(slots.reference_ns)
        antenna = (spans.rotation - np.eye(3)) @ slots.antenna_rig + spans.known
        return cls(slots, spans, gained, antenna, motion.accel_noise, gyro_bias)

    def normal_equations(self, velocity: Array) -> tuple[Array, Array]:
        """`H` (3S + 9, 3S + 9) and `g`, linearised at velocities (S, 3)."""
        count = len(velocity)
        size = 3 * count + 9
        H, g = np.zeros((size, size)), np.zeros(size)
        row = self._distance_rows(velocity)
        _add_blocks(H, row[:, :3, None] * row[:, None, :3])
        g[: 3 * count] -= (row[:, :3] * row[:, 3:]).ravel()
        steps = np.diff(self.slots.reference_ns) * 1e-9
        gained = self.gained
        across = so3.hat((velocity[1:] + velocity[:-1]) / 2) @ gained.by_accel_bias + gained.by_gyro_bias
        error = np.diff(velocity, axis=0) - gained.change + across @ self.gyro_bias
        std = np.sqrt((_ACCEL_MARGIN * self.accel_noise) ** 2 * steps + _VELOCITY_FLOOR**2)[:, None]
        one = np.broadcast_to(np.eye(3), across.shape)
        J = np.concatenate([-one, one, -steps[:, None, None] * one, -gained.by_accel_bias, across], axis=2)
        J /= std[:, :, None]
        products = np.swapaxes(J, 1, 2) @ J
        pulls = (np.swapaxes(J, 1, 2) @ (error / std)[:, :, None])[:, :, 0]
        two, rest = 3 * np.arange(count - 1)[:, None] + np.arange(6), slice(3 * count, size)
        for links in (slice(0, None, 2), slice(1, None, 2)):  # those of one go share no slot
            at = two[links]
            H[at[:, :, None], at[:, None, :]] += products[links, :6, :6]
            H[at, rest] += products[links, :6, 6:]
            g[at] -= pulls[links, :6]
        H[rest, : 3 * count] = H[: 3 * count, rest].T
        H[rest, rest] += products[:, 6:, 6:].sum(axis=0)
        g[rest] -= pulls[:, 6:].sum(axis=0)
        at = np.arange(3 * count, 3 * count + 3)
        H[at, at] += _LEVEL_STD**-2.0
        H[at + 3, at + 3] += _ACCEL_BIAS_STD**-2.0
        return H, g

    def _distance_rows(self, velocity: Array) -> Array:
        """(S, 4): the distance's derivative by the velocity and its residual, over its standard deviation."""
        moved = np.einsum("nij,nj->ni", self.spans.by_velocity, velocity) + self.antenna
        length = np.maximum(np.linalg.norm(moved, axis=1), 1e-6)
        row = np.einsum("ni,nij->nj", moved / length[:, None], self.spans.by_velocity)
        residual = (length - self.slots.distance)[:, None]
        return np.concatenate([row, residual], axis=1) / self.slots.distance_std[:, None]


def solve_velocities(
    pairs: EpipolarPairs,
    between: PairMotion,
    priors: VelocityPriors,
    place: Array,
    scale: Array,
    start: Array | None = None,
    rounds: int = 8,
) -> tuple[Array, Array]:
    """Velocities (S, 3) in level axes and the way (P, 3) of each pair's camera in rig axes at the earlier time.

    Robust least squares over the block on the epipolar residuals of all cameras and the priors. between: of the pairs.
    place: (P, 3) of each pair's camera. scale: (P,) how much larger the residuals of a pair's camera are than its
    tracks predict. start: velocities to start from.
    """
    slots = priors.slots
    lever = np.einsum("nij,nj->ni", between.rotation, place) - place + between.known
    velocity = _first_guess(pairs, between, priors, lever) if start is None else start
    count = len(slots.reference_ns)
    rows = (pairs.first, pairs.second, pairs.std, pairs.pair)
    thinned = tuple(values[::_THINNED] for values in rows)
    for k in range(rounds):
        thin = k < rounds - _LAST_ROUNDS
        way = np.einsum("nij,nj->ni", between.by_velocity, velocity[slots.slot]) + lever
        H_slot, g_slot = np.zeros((count, 3, 3)), np.zeros((count, 3))
        accumulate_velocity(
            *(thinned if thin else rows),
            between.rotation,
            way,
            between.by_velocity,
            slots.slot,
            scale * max(2.0 ** (rounds // 2 - 1 - k), 1.0),  # wide at first: what is far off pulls, too
            H_slot,
            g_slot,
        )
        H, g = priors.normal_equations(velocity)
        H, g = H[:-3, :-3], g[:-3]  # the gyro's bias is known well enough here
        share = _THINNED if thin else 1
        _add_blocks(H, share * H_slot)
        g[: 3 * count] -= share * g_slot.ravel()
        step = _solve_chain(H, g, 3 * count)[: 3 * count].reshape(count, 3)
        longest = 0.5 * max(float(np.linalg.norm(velocity, axis=1).mean()), 0.2)
        velocity = velocity + step * min(1.0, longest / max(float(np.linalg.norm(step, axis=1).max()), 1e-12))
    return velocity, np.einsum("nij,nj->ni", between.by_velocity, velocity[slots.slot]) + lever


def _solve_chain(H: Array, g: Array, count: int) -> Array:
    """`H^-1 g`, where only neighbouring slots share entries of the first `count` rows and columns of H."""
    width = 5  # of the band on either side: 3 x 3 blocks and their neighbours
    band = np.zeros((2 * width + 1, count))
    for k in range(-width, width + 1):
        band[width - k, max(k, 0) : count + min(k, 0)] = np.diagonal(H[:count, :count], k)
    solved = solve_banded((width, width), band, np.column_stack([g[:count], H[:count, count:]]))
    rest = np.linalg.solve(
        H[count:, count:] - H[count:, :count] @ solved[:, 1:], g[count:] - H[count:, :count] @ solved[:, 0]
    )
    return np.concatenate([solved[:, 0] - solved[:, 1:] @ rest, rest])


def _add_blocks(H: Array, blocks: Array) -> None:
    """Add (S, 3, 3) to the diagonal, in place."""
    at = 3 * np.arange(len(blocks))[:, None] + np.arange(3)
    H[at[:, :, None], at[:, None, :]] += blocks


def _first_guess(pairs: EpipolarPairs, between: PairMotion, priors: VelocityPriors, lever: Array) -> Array:
    """(S, 3): of the guesses of every slot, carried to the others by the accelerometer, the one that fits all best."""
    slots = priors.slots
    guesses = _guess_per_slot(pairs, slots, between, priors.spans)
    tilted = np.cumsum(priors.gained.change - priors.gained.by_gyro_bias @ priors.gyro_bias, axis=0)
    gained = np.concatenate([np.zeros((1, 3)), tilted])
    few = np.random.default_rng(0).permutation(len(pairs.pair))[:_TRIAL_ROWS]
    residual = np.empty(len(few))
    rows = tuple(values[few] for values in (pairs.first, pairs.second, pairs.std, pairs.pair))
    best, best_cost = guesses, np.inf
    step = max(len(guesses) // _TRIALS, 1)
    trials = [_through(guesses, priors, gained)]
    trials += [guesses[k] + gained - gained[k] for k in range(0, len(guesses), step)]
    for velocity in trials:
        way = np.einsum("nij,nj->ni", between.by_velocity, velocity[slots.slot]) + lever
        pair_residuals(*rows, between.rotation, way, residual)
        cost = float(np.log1p((residual / LOSS_STDS) ** 2).sum())
        if cost < best_cost:
            best, best_cost = velocity, cost
    return best


def _through(guesses: Array, priors: VelocityPriors, gained: Array) -> Array:
    """(S, 3): the accelerometer's velocities, with the first one, an acceleration and a bias that fit most guesses
    (least absolute deviations by reweighting)."""
    seconds = (priors.slots.reference_ns - priors.slots.reference_ns[0]) * 1e-9
    by_bias = np.concatenate([np.zeros((1, 3, 3)), np.cumsum(priors.gained.by_accel_bias, axis=0)])
    one = np.broadcast_to(np.eye(3), by_bias.shape)
    A = np.concatenate([one, seconds[:, None, None] * one, by_bias], axis=2)
    b = guesses - gained
    weight = np.ones(len(b))
    ridge = np.diag(np.repeat([1e-6, _LEVEL_STD**-2.0, _ACCEL_BIAS_STD**-2.0], 3)) * _GUESS_STD**2
    fitted = b
    for _ in range(12):
        weighted = A * weight[:, None, None]
        x = np.linalg.solve(
            np.einsum("nij,nik->jk", weighted, A) + ridge, np.einsum("nij,ni->j", weighted, b)
        )
        fitted = A @ x
        weight = 1 / np.maximum(np.linalg.norm(fitted - b, axis=1), 0.05)
    return np.asarray(fitted + gained)


def _guess_per_slot(pairs: EpipolarPairs, slots: Slots, between: PairMotion, spans: PairMotion) -> Array:
    """(S, 3): the direction that most epipolar planes contain, as far as GNSS says, forward by the parallax.

    Lever arms are left out: they are short against a second's way.
    """
    first, second, pair = (values[::_THINNED] for values in (pairs.first, pairs.second, pairs.pair))
    after = np.einsum("nij,nj->ni", between.rotation[pair], second)
    normal = np.cross(after, first)
    length = np.linalg.norm(normal, axis=1)
    # planes of points with little parallax are uncertain, those of wrong tracks have much: neither counts more
    in_level = np.einsum("nij,ni->nj", between.by_velocity[pair], normal)
    size = np.maximum(np.linalg.norm(in_level, axis=1), 1e-12)
    unit = in_level / size[:, None]
    slot = slots.slot[pair]
    weight = length / (length + 0.02)
    count = len(slots.reference_ns)
    for _ in range(6):
        sums = np.zeros((count, 9))
        sum_by(slot, (unit[:, :, None] * unit[:, None, :]).reshape(-1, 9), weight, sums)
        direction = np.linalg.eigh(sums.reshape(-1, 3, 3))[1][:, :, 0]
        across = np.einsum("ni,ni->n", unit, direction[slot])
        weight = length / (length + 0.02) / (1 + (across / 0.1) ** 2)
    ahead = np.einsum("nij,nj->ni", between.by_velocity[pair], direction[slot])
    parallax = np.einsum("ni,ni->n", np.cross(ahead, after), np.cross(first, after))
    vote = np.zeros((count, 1))
    sum_by(slot, np.sign(parallax)[:, None], weight, vote)
    seconds = np.linalg.norm(spans.by_velocity[:, :, 0], axis=1)
    return direction * np.where(vote < 0, -1.0, 1.0) * (slots.distance / seconds)[:, None]


def without_slow(pairs: EpipolarPairs, way: Array, least_m: float) -> EpipolarPairs:
    """Only the observations of pairs whose camera came some way: without parallax there is no epipolar plane."""
    kept = np.linalg.norm(way, axis=1)[pairs.pair] >= least_m
    return replace(
        pairs,
        first=pairs.first[kept],
        second=pairs.second[kept],
        std=pairs.std[kept],
        pair=pairs.pair[kept],
        cluster=pairs.cluster[kept],
        pixels=pairs.pixels[kept],
    )
