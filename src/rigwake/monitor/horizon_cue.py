"""The horizon between cameras: how its line in one picture differs from that in the others at the same time.

The boat's attitude, and whatever is wrong with it, moves the line of all cameras alike, so it is unknown every two
seconds. What is left tells two rotations of each camera against the others, none about the vertical. A shore stands
below the horizon and bends, and moves when the boat does. Therefore

- only lines that are straight to a tenth of a degree count (`horizon_line.py`);
- each camera's line may be off by a constant, which is learnt in the first blocks (`horizon_columns`);
- each camera's covariance is what its line scattered so far, from block to block and over a minute.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from rigwake._tables import take_rows
from rigwake._types import Array, Indices, Mask
from rigwake.geometry.interpolate import nearest_indices
from rigwake.monitor.horizon_line import HorizonSearch, level_axes
from rigwake.monitor.innovations import horizon_columns
from rigwake.monitor.pair_kernels import MOUNTING
from rigwake.monitor.rig_motion import RigMotion
from rigwake.monitor.score import BLOCK_S, BlockScores
from rigwake.recording import CameraStream
from rigwake.rig import Rig

_SLOT_S = 2.0
_FLOOR_DEG = 0.02  # of a single line
_BLOCK_FLOOR_DEG = 0.02  # of ten seconds: waves that stand higher than the horizon, haze
_FEWEST = 3  # lines of a camera that a block takes
_LAGS = (1, 3, 6)  # blocks, over which scatter is learnt
_FEWEST_DIFFERENCES, _FIRST_FACTOR = 4, 10.0
_MEDIAN = 0.455  # of chi-square with one degree of freedom
_MOST_ALIKE = 0.9  # correlation of neighbouring blocks


@dataclass(frozen=True, eq=False)
class HorizonSightings:
    """M lines: of which camera (M,), in which slot of two seconds since the first block (M,), ahead and at the
    camera's side (M, 2) with standard deviations (M, 2), radians, and the level axes (M, 3) that these refer to, rig
    axes."""

    camera: NDArray[np.int64]
    slot: NDArray[np.int64]
    elevation: Array
    std: Array
    ahead: Array
    side: Array

    def __len__(self) -> int:
        return len(self.slot)

    @property
    def tilt(self) -> Array:
        """(M, 3) how the direction up would have to change to explain each line alone."""
        return -(self.elevation[:, :1] * self.ahead + self.elevation[:, 1:] * self.side)

    def take(self, index: Indices | Mask) -> HorizonSightings:
        """The chosen lines."""
        return take_rows(self, index)


SLOTS_PER_BLOCK = round(BLOCK_S / _SLOT_S)


def look_at_horizon(
    streams: Mapping[str, CameraStream],
    rig: Rig,
    motion: RigMotion,
    starts_ns: Indices,
    hulls: Mapping[str, Mask] | None = None,
) -> HorizonSightings:
    """The lines of all cameras in one picture per slot. hulls: (H, W) where the own hull is known to be in view."""
    found: list[tuple[int, int, list[float], Array, Array, Array]] = []
    first = int(starts_ns[0]) if len(starts_ns) else 0
    middles = first + np.round((np.arange(SLOTS_PER_BLOCK * len(starts_ns)) + 0.5) * _SLOT_S * 1e9).astype(
        np.int64
    )
    for k, (name, camera) in enumerate(rig.cameras.items()):
        stream = streams.get(name)
        if stream is None or stream.model is None or not len(stream) or not len(middles):
            continue
        search = HorizonSearch(stream.model, camera.rig_from_cam.rotation, (hulls or {}).get(name))
        on_rig = stream.timestamps_ns + round(camera.time_offset_s * 1e9)
        nearest = nearest_indices(on_rig, middles)
        near = np.abs(on_rig[nearest] - middles) < _SLOT_S / 2 * 1e9
        slot_of = dict(zip(nearest[near].tolist(), np.flatnonzero(near).tolist(), strict=True))
        frames = np.array(sorted(slot_of), dtype=np.int64)
        up = motion.up_rig_at(on_rig[frames]) if len(frames) else np.empty((0, 3))
        up_of = dict(zip(frames.tolist(), up, strict=True))
        for frame in stream.frames(frames):
            picture = frame.image if frame.image.ndim == 2 else frame.image.mean(axis=2).astype(np.uint8)
            line = search.find(picture, up_of[frame.index])
            if line is not None:
                ahead, side = level_axes(camera.rig_from_cam.rotation, up_of[frame.index])
                found.append((k, slot_of[frame.index], [line.ahead, line.side], line.std, ahead, side))
    if not found:
        return HorizonSightings(
            *(np.empty(0, dtype=np.int64),) * 2, *(np.empty((0, n)) for n in (2, 2, 3, 3))
        )
    columns = [np.array(column) for column in zip(*found, strict=True)]
    return HorizonSightings(*columns)


def score_horizon(sightings: HorizonSightings, blocks: BlockScores) -> BlockScores:
    """Scores of every block by the horizon. blocks: by the motion, whose conditions are kept."""
    cameras = len(blocks.cameras)
    begin = horizon_columns(cameras)
    size = begin + 3 * cameras
    own = _compared(sightings)
    if not len(own):
        size = MOUNTING * cameras
    H, g = np.zeros((len(blocks), size, size)), np.zeros((len(blocks), size))
    rows = np.zeros((len(blocks), cameras), dtype=np.int64)
    if len(own):
        own, usable = _about_reference(own), _block_tilts(own, len(blocks), cameras)[1]
        wide = scatter(*_block_tilts(own, len(blocks), cameras))
        for b in range(len(blocks)):
            here = own.take((own.slot // SLOTS_PER_BLOCK == b) & usable[b, own.camera])
            here = _compared(here)
            if len(here):
                H[b], g[b] = _block(here, wide[b], size, begin)
                rows[b] = np.bincount(here.camera, minlength=cameras)
    return replace(
        blocks,
        H=H,
        g=g,
        rows=rows,
        inflation=np.ones_like(blocks.inflation),
        noise=np.ones_like(blocks.noise),
        sectors=np.zeros_like(blocks.sectors),
    )


def _compared(sightings: HorizonSightings) -> HorizonSightings:
    """Those of slots in which two cameras or more saw a line."""
    if not len(sightings):
        return sightings
    count = np.bincount(sightings.slot)
    return sightings.take(count[sightings.slot] >= 2)


def _differences(sightings: HorizonSightings) -> Array:
    """(M, 2) each line's tilt less the median of all cameras at the same time, along the camera's axes."""
    tilt = sightings.tilt
    order = np.argsort(sightings.slot, kind="stable")
    _, first = np.unique(sightings.slot[order], return_index=True)
    common = np.empty_like(tilt)
    for rows in np.split(order, first[1:]):
        common[rows] = np.median(tilt[rows], axis=0)
    left = tilt - common
    return np.stack([(left * sightings.ahead).sum(axis=1), (left * sightings.side).sum(axis=1)], axis=1)


def _about_reference(sightings: HorizonSightings) -> HorizonSightings:
    """Lines less what each camera's first ones differed from the others: a constant, that the columns behind hold."""
    apart, elevation = _differences(sightings), sightings.elevation.copy()
    for k in np.unique(sightings.camera):
        rows = np.flatnonzero(sightings.camera == k)
        first = rows[np.argsort(sightings.slot[rows])[: 3 * SLOTS_PER_BLOCK]]
        elevation[rows] += np.median(apart[first], axis=0)
    return replace(sightings, elevation=elevation)


def _block_tilts(sightings: HorizonSightings, blocks: int, cameras: int) -> tuple[Array, Mask, Array]:
    """(B, C, 2) mean differences, whether there are enough (B, C), and the variance (B, C, 2) that lines claim."""
    apart = _differences(sightings)
    at = sightings.slot // SLOTS_PER_BLOCK, sightings.camera
    count = np.zeros((blocks, cameras))
    np.add.at(count, at, 1.0)
    mean, variance = np.zeros((blocks, cameras, 2)), np.zeros((blocks, cameras, 2))
    np.add.at(mean, at, apart)
    np.add.at(variance, at, sightings.std**2 + np.deg2rad(_FLOOR_DEG) ** 2)
    usable = count >= _FEWEST
    many = np.maximum(count, 1.0)[:, :, None]
    return mean / many, usable, variance / many**2


def scatter(mean: Array, usable: Mask, variance: Array) -> Array:
    """(B, C) by how much variances must grow, from the blocks up to each.

    mean: (B, C, 2) differences by block, usable: (B, C), variance: (B, C, 2) claimed. The median over the recording so
    far of squared differences of blocks one, three and six apart: a camera that moves once adds little to it. Blocks
    that resemble their neighbours count less, by the correlation of neighbours.
    """
    wide = np.ones(usable.shape)
    floor = np.deg2rad(_BLOCK_FLOOR_DEG) ** 2
    for c in range(usable.shape[1]):
        squares: dict[int, list[Array]] = {lag: [] for lag in _LAGS}
        for k in np.flatnonzero(usable[:, c]).tolist():
            for lag in _LAGS:
                if k >= lag and usable[k - lag, c]:
                    total = variance[k, c] + variance[k - lag, c]
                    squares[lag].append((mean[k, c] - mean[k - lag, c]) ** 2 / total)
            known = [
                np.median(s, axis=0) / _MEDIAN for s in squares.values() if len(s) >= _FEWEST_DIFFERENCES
            ]
            factor = _FIRST_FACTOR
            if known:
                largest = np.maximum(np.max(known, axis=0), 1.0)
                alike = np.clip(1 - known[0] / largest, 0.0, _MOST_ALIKE)
                factor = float((largest * (1 + alike) / (1 - alike)).max())
            wide[k, c] = factor + floor / float(variance[k, c].mean())
    return wide


def _block(sightings: HorizonSightings, wide: Array, size: int, begin: int) -> tuple[Array, Array]:
    """Normal equations of one block, the attitude of every slot eliminated. wide: (C,) of `scatter`.

    A camera turned by w sees its line at `w . side` ahead and at `-w . ahead` at its side; the direction up that is
    wrong by d, at `-d . ahead` and `-d . side`.
    """
    H, g = np.zeros((size, size)), np.zeros(size)
    weight = 1 / ((sightings.std**2 + np.deg2rad(_FLOOR_DEG) ** 2) * wide[sightings.camera][:, None])
    for slot in np.unique(sightings.slot):
        rows = np.flatnonzero(sightings.slot == slot)
        J, D = np.zeros((2 * len(rows), size)), np.zeros((2 * len(rows), 2))
        basis = np.stack([sightings.ahead[rows[0]], sightings.side[rows[0]]], axis=1)
        for j, m in enumerate(rows):
            ahead, side = sightings.ahead[m], sightings.side[m]
            for at in (MOUNTING * sightings.camera[m], begin + 3 * sightings.camera[m]):
                J[2 * j : 2 * j + 2, at : at + 3] = side, -ahead
            D[2 * j : 2 * j + 2] = -ahead @ basis, -side @ basis
        W = weight[rows].ravel()
        y = sightings.elevation[rows].ravel()
        gain = np.linalg.solve(D.T @ (W[:, None] * D), D.T * W)
        J, y = J - D @ (gain @ J), y - D @ (gain @ y)
        H += J.T @ (W[:, None] * J)
        g += J.T @ (W * y)
    return (H + H.T) / 2, g
