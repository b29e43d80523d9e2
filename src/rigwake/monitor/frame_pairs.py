"""Tracks of all cameras as pairs of observations about a second apart, in rig axes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from rigwake._types import Array, Indices
from rigwake.cameras.protocol import CameraModel
from rigwake.geometry.interpolate import nearest_indices
from rigwake.rig import Rig
from rigwake.tracks import Tracks

PAIR_S = 1.0
_TOLERANCE_S = 0.2
_FEWEST = 8  # tracks of a pair
_ANGLES = 200


@dataclass(frozen=True, eq=False)
class EpipolarPairs:
    """P pairs of frames of all cameras, and their N pairs of observations, sorted by pair.

    camera: (P,) index into `cameras`. first_ns, second_ns: (P,) rig clock. first, second: (N, 3) bearings in rig
    axes. std: (N, 2) radians. pair: (N,). cluster: (N,) which track, numbered over all cameras. pixels: (N, 2) of
    the first observation. tracked: (F,) by camera: frames that start a pair, whether or not enough was tracked.
    """

    cameras: tuple[str, ...]
    camera: Indices
    first_ns: Indices
    second_ns: Indices
    first: Array
    second: Array
    std: Array
    pair: Indices
    cluster: Indices
    pixels: Array


@dataclass(frozen=True, eq=False)
class _OfOne:
    first_ns: Indices
    second_ns: Indices
    first: Array
    second: Array
    std: Array
    pair: Indices
    track: Indices
    pixels: Array


def pair_frames(
    tracks: Mapping[str, Tracks], rig: Rig, begin_ns: int, end_ns: int, *, stride: int = 1
) -> EpipolarPairs:
    """All pairs that start in `[begin_ns, end_ns)`, rig clock. stride: of the frames that start a pair."""
    parts = [_pairs_of(tracks[name], rig, begin_ns, end_ns, stride) for name in rig.cameras]
    pairs = np.cumsum([0, *(len(part.first_ns) for part in parts)])
    clusters = np.cumsum([0, *(int(part.track.max()) + 1 if len(part.track) else 0 for part in parts)])

    def join(values: list[Array]) -> Array:
        return np.concatenate(values)

    return EpipolarPairs(
        tuple(rig.cameras),
        np.repeat(np.arange(len(parts)), [len(part.first_ns) for part in parts]),
        np.concatenate([part.first_ns for part in parts]),
        np.concatenate([part.second_ns for part in parts]),
        join([part.first for part in parts]),
        join([part.second for part in parts]),
        join([part.std for part in parts]),
        np.concatenate([part.pair + pairs[k] for k, part in enumerate(parts)]),
        np.concatenate([part.track + clusters[k] for k, part in enumerate(parts)]),
        join([part.pixels for part in parts]),
    )


def _pairs_of(tracks: Tracks, rig: Rig, begin_ns: int, end_ns: int, stride: int) -> _OfOne:
    mounted = rig.camera(tracks.camera)
    model = mounted.model
    assert model is not None
    on_rig = tracks.timestamps_ns + round(mounted.time_offset_s * 1e9)
    partner = frame_partners(on_rig)
    starts = np.flatnonzero((on_rig >= begin_ns) & (on_rig < end_ns) & (partner >= 0))[::stride]
    number = np.full(len(on_rig), -1)
    number[starts] = np.arange(len(starts))
    rows = np.flatnonzero(number[tracks.frame_indices] >= 0)
    rows, mates = tracks.same_tracks(rows, partner[tracks.frame_indices[rows]])
    counts = np.bincount(number[tracks.frame_indices[rows]], minlength=len(starts))
    enough = counts >= _FEWEST
    renumbered = np.cumsum(enough) - 1
    kept = enough[number[tracks.frame_indices[rows]]]
    rows, mates, starts_kept = rows[kept], mates[kept], starts[enough]
    _, track = np.unique(tracks.track_ids[rows], return_inverse=True)
    resolution = PixelAngles(model)
    std = np.stack([resolution(tracks.bearings_cam[k]) * tracks.std_px[k] for k in (rows, mates)], axis=1)
    rotation = mounted.rig_from_cam.rotation
    return _OfOne(
        on_rig[starts_kept],
        on_rig[partner[starts_kept]],
        tracks.bearings_cam[rows] @ rotation.T,
        tracks.bearings_cam[mates] @ rotation.T,
        std,
        renumbered[number[tracks.frame_indices[rows]]].astype(np.int64),
        track.astype(np.int64),
        tracks.pixels[rows],
    )


def frame_partners(stamps_ns: Indices) -> Indices:
    """(F,) the frame nearest to a second after each, -1 if there is none near."""
    wanted = stamps_ns + round(PAIR_S * 1e9)
    if len(stamps_ns) < 2:
        return np.full(len(stamps_ns), -1)
    nearest = nearest_indices(stamps_ns, wanted)
    late = np.abs(stamps_ns[nearest] - wanted) > _TOLERANCE_S * 1e9
    return np.where(late | (nearest <= np.arange(len(stamps_ns))), -1, nearest)


class PixelAngles:
    """How wide a pixel is, by the angle off the optical axis: geometric mean over both directions."""

    def __init__(self, model: CameraModel) -> None:
        self._angles = np.linspace(1e-3, model.max_angle - 2e-3, _ANGLES)
        turn = np.linspace(0, 2 * np.pi, 8, endpoint=False)
        sine, cosine = np.sin(self._angles)[:, None], np.cos(self._angles)[:, None]
        bearings = np.stack(
            [sine * np.cos(turn), sine * np.sin(turn), np.broadcast_to(cosine, (_ANGLES, len(turn)))], axis=-1
        )
        d_point = model.project_with_jacobians(bearings.reshape(-1, 3)).d_point
        area = np.sqrt(np.linalg.det(d_point @ np.swapaxes(d_point, 1, 2)).clip(min=0))
        by_angle = np.sqrt(area).reshape(_ANGLES, len(turn)).mean(axis=1)
        self._radians = 1 / np.maximum(by_angle, 1e-3)

    def __call__(self, bearings_cam: Array) -> Array:
        """(N,) radians per pixel at bearings (N, 3)."""
        angle = np.arccos(np.clip(bearings_cam[:, 2], -1, 1))
        return np.interp(angle, self._angles, self._radians)
