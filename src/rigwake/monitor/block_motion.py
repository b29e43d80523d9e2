"""How the rig moved in a block of some seconds, from all its cameras together."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rigwake._robust import MAD_TO_STD
from rigwake._types import Array, Indices, Mask
from rigwake.geometry.interpolate import nearest_indices
from rigwake.monitor.frame_pairs import EpipolarPairs
from rigwake.monitor.pair_kernels import pair_residuals
from rigwake.monitor.rig_motion import PairMotion, RigMotion
from rigwake.monitor.velocity import VelocityPriors, slots_of, solve_velocities, without_slow
from rigwake.rig import Rig

FEWEST_ROWS = 60  # observations of a camera in a block
BIAS_START_STD = 5e-3  # rad/s
_LEAST_WAY_M = 0.25
_BELOW_HORIZON = float(np.sin(np.deg2rad(-1.0)))  # what is lower is taken for water
_LARGEST_NOISE = 30.0


@dataclass(frozen=True, eq=False)
class GyroBias:
    """What is known of the gyro's bias beside what was taken off before: rad/s, and its standard deviation."""

    value: Array
    std: float

    @classmethod
    def unknown(cls) -> GyroBias:
        """Before anything was seen."""
        return cls(np.zeros(3), BIAS_START_STD)


@dataclass(frozen=True, eq=False)
class BlockMotion:
    """How the rig moved in a block, from all cameras as they are calibrated.

    pairs: that show it. place: (P, 3) of each pair's camera. between: of the pairs. velocity: (S, 3) of the slots,
    level axes. way: (P, 3) of each pair's camera. scale: (C,) residuals over what tracks predict. bias: of the
    gyro, as it was taken.
    """

    pairs: EpipolarPairs
    place: Array
    between: PairMotion
    priors: VelocityPriors
    velocity: Array
    way: Array
    scale: Array
    bias: GyroBias

    def slot_at(self, times_ns: Indices) -> tuple[Indices, Mask]:
        """(M,) the slot that begins nearest to each time, and whether it is within half a second."""
        starts = self.priors.slots.first_ns
        nearest = nearest_indices(starts, times_ns)
        return nearest, np.abs(starts[nearest] - times_ns) < 0.5e9


def block_motion(pairs: EpipolarPairs, rig: Rig, motion: RigMotion, bias: GyroBias) -> BlockMotion | None:
    """How the rig moved by pairs above the water; None where it made too little way, or too little was tracked."""
    if len(pairs.pair) < FEWEST_ROWS:
        return None
    place = np.stack([rig.camera(name).rig_from_cam.translation for name in pairs.cameras])[pairs.camera]
    slots = slots_of(pairs, motion, _spacing(pairs))
    between = motion.between(pairs.first_ns, pairs.second_ns, slots.reference_ns[slots.slot], bias.value)
    spans = motion.between(slots.first_ns, slots.second_ns, slots.reference_ns, bias.value)
    scale = np.ones(len(pairs.cameras))
    priors = VelocityPriors.of(slots, spans, motion, bias.value)
    velocity, way = solve_velocities(pairs, between, priors, place, scale[pairs.camera])
    pairs = without_slow(pairs, way, _LEAST_WAY_M)
    if len(pairs.pair) < FEWEST_ROWS:
        return None
    for _ in range(2):
        scale = _noise(way_residuals(pairs, between.rotation, way), pairs)
        velocity, way = solve_velocities(pairs, between, priors, place, scale[pairs.camera], velocity, 2)
    return BlockMotion(pairs, place, between, priors, velocity, way, scale, bias)


def above_water(pairs: EpipolarPairs, motion: RigMotion) -> EpipolarPairs:
    """Without what lies below the horizon: water moves by itself."""
    if not len(pairs.pair):
        return pairs
    up = motion.up_rig_at(pairs.first_ns)[pairs.pair]
    kept = np.einsum("ni,ni->n", pairs.first, up) > _BELOW_HORIZON
    return EpipolarPairs(
        pairs.cameras,
        pairs.camera,
        pairs.first_ns,
        pairs.second_ns,
        pairs.first[kept],
        pairs.second[kept],
        pairs.std[kept],
        pairs.pair[kept],
        pairs.cluster[kept],
        pairs.pixels[kept],
    )


def _spacing(pairs: EpipolarPairs) -> int:
    """Nanoseconds between the starts of a camera's pairs."""
    steps = np.diff(pairs.first_ns)[np.diff(pairs.camera) == 0]
    return int(np.median(steps)) if len(steps) else round(1e9)


def way_residuals(pairs: EpipolarPairs, rotation: Array, way: Array) -> Array:
    """(N,) epipolar residuals over their standard deviations. rotation: (P, 3, 3), way: (P, 3) of the pairs."""
    residual = np.empty(len(pairs.pair))
    pair_residuals(pairs.first, pairs.second, pairs.std, pairs.pair, rotation, way, residual)
    return residual


def _noise(residual: Array, pairs: EpipolarPairs) -> Array:
    """(C,) how much larger a camera's residuals are than predicted, at least half."""
    camera = pairs.camera[pairs.pair]
    scale = np.ones(len(pairs.cameras))
    for k in range(len(scale)):
        of_camera = np.abs(residual[camera == k])
        if len(of_camera):
            scale[k] = np.clip(MAD_TO_STD * float(np.median(of_camera)), 0.5, _LARGEST_NOISE)
    return scale
