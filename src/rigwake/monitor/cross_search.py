"""Looks in every camera's pictures for what the others track: at the same time, and a second before or after."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from rigwake._tables import join_rows
from rigwake._types import Array, Indices, Mask
from rigwake.ba.rig.association import find_landmarks
from rigwake.ba.rig.search_proposals import AssociationOptions, Searches, map_stencils, warped
from rigwake.geometry.interpolate import nearest_indices
from rigwake.geometry.se3 import SE3
from rigwake.monitor.block_motion import BlockMotion
from rigwake.monitor.cross_views import inverse_ranges
from rigwake.monitor.frame_pairs import PAIR_S, PixelAngles, frame_partners
from rigwake.monitor.rig_motion import RigMotion
from rigwake.recording import CameraStream
from rigwake.rig import Rig
from rigwake.tracking.masks import inside, lens_mask
from rigwake.tracks import CrossViews, Tracks

_MOST = 15  # tracks per second, pair of cameras and time
_OPTIONS = AssociationOptions(search_px=6.0)  # what turned by a degree is still found
_MARGIN_PX = 16.0
_NEAREST_M, _FARTHEST_M = 2.0, 2000.0
_ABOVE_HORIZON = 0.0  # sine of the elevation


@dataclass(frozen=True, eq=False)
class _Source:
    """N observations of a camera, each with one of the same track a second later, and points (N, 3) in rig axes at the
    first. reference, velocity, bias: of their slots, as in `BlockMotion`."""

    first: Indices
    later: Indices
    times_ns: Indices
    points: Array
    reference_ns: Indices
    velocity: Array
    bias: Array


def find_cross_views(
    tracks: Mapping[str, Tracks],
    streams: Mapping[str, CameraStream],
    rig: Rig,
    motion: RigMotion,
    motions: Sequence[BlockMotion | None],
) -> CrossViews:
    """What two cameras saw, from the pictures.

    tracks, streams: by camera. motions: how the rig moved block by block; points are only looked for where it made
    way, since their ranges come from it, and at standstill at a usual range.
    """
    names = tuple(rig.cameras)
    offsets = {name: round(rig.camera(name).time_offset_s * 1e9) for name in names}
    usable = {name: lens_mask(streams[name]).usable for name in names}
    sources = {name: _sources(tracks[name], rig, motion, motions, offsets[name]) for name in names}
    parts: list[Searches] = []
    rows: list[tuple[int, Indices, Indices]] = []
    count = 0
    for a, source in enumerate(names):
        for b, target in enumerate(names):
            for lag_s in (0.0, PAIR_S, -PAIR_S):
                if a == b or not len(sources[source].first) or not len(tracks[target].timestamps_ns):
                    continue
                found = _proposed(
                    sources[source], tracks, rig, motion, (a, b), names, offsets, usable[target], lag_s, count
                )
                parts.append(found[0])
                rows.append((a, sources[source].first[found[1]], sources[source].later[found[1]]))
                count += len(found[1])
    return _views(names, parts, rows, tracks, streams, rig)


def _sources(
    tracks: Tracks, rig: Rig, motion: RigMotion, motions: Sequence[BlockMotion | None], offset_ns: int
) -> _Source:
    on_rig = tracks.timestamps_ns + offset_ns
    partner = frame_partners(on_rig)
    seconds = (on_rig - on_rig[0]) // round(PAIR_S * 1e9) if len(on_rig) else on_rig
    starts = np.flatnonzero((np.diff(seconds, prepend=-1) > 0) & (partner >= 0))
    rows = np.flatnonzero(np.isin(tracks.frame_indices, starts))
    rows, later = tracks.same_tracks(rows, partner[tracks.frame_indices[rows]])
    mounted = rig.camera(tracks.camera)
    u = tracks.bearings_cam[rows] @ mounted.rig_from_cam.rotation.T
    first_ns, later_ns = on_rig[tracks.frame_indices[rows]], on_rig[tracks.frame_indices[later]]
    above = np.einsum("ni,ni->n", u, motion.up_rig_at(first_ns)) > _ABOVE_HORIZON
    rows, later, u, first_ns, later_ns = (x[above] for x in (rows, later, u, first_ns, later_ns))
    reference, velocity, bias, moving = _slots(motions, first_ns)
    way = motion.between(first_ns, later_ns, reference, bias.mean(axis=0) if len(bias) else np.zeros(3))
    place = mounted.rig_from_cam.translation
    moved = (way.by_velocity @ velocity[:, :, None])[:, :, 0] + way.known + (way.rotation @ place - place)
    after = (way.rotation @ (tracks.bearings_cam[later] @ mounted.rig_from_cam.rotation.T)[:, :, None])[
        :, :, 0
    ]
    assert mounted.model is not None
    resolution = PixelAngles(mounted.model)
    std = np.stack([resolution(tracks.bearings_cam[k]) * tracks.std_px[k] for k in (rows, later)], axis=1)
    inverse_range, range_std = inverse_ranges(u, after, moved, std, moving)
    near = (inverse_range < 1 / _NEAREST_M) & (inverse_range + 2 * range_std > 0)
    near &= np.isfinite(inverse_range)
    points = place + u / np.clip(inverse_range, 1 / _FARTHEST_M, None)[:, None]
    return _Source(
        rows[near], later[near], first_ns[near], points[near], reference[near], velocity[near], bias[near]
    )


def _slots(motions: Sequence[BlockMotion | None], times_ns: Indices) -> tuple[Indices, Array, Array, Mask]:
    """Reference times, velocities, gyro biases of the slots at times (N,), and whether the rig made way there."""
    reference, velocity, bias = times_ns.copy(), np.zeros((len(times_ns), 3)), np.zeros((len(times_ns), 3))
    moving = np.zeros(len(times_ns), dtype=bool)
    for found in motions:
        if found is None:
            continue
        at, near = found.slot_at(times_ns)
        near &= ~moving
        reference[near] = found.priors.slots.reference_ns[at[near]]
        velocity[near], bias[near] = found.velocity[at[near]], found.bias.value
        moving |= near
    if moving.any():
        bias[~moving] = bias[moving].mean(axis=0)  # the gyro keeps it where the rig makes no way
    return reference, velocity, bias, moving


def _proposed(
    source: _Source,
    tracks: Mapping[str, Tracks],
    rig: Rig,
    motion: RigMotion,
    pair: tuple[int, int],
    names: tuple[str, ...],
    offsets: Mapping[str, int],
    usable: Mask,
    lag_s: float,
    count: int,
) -> tuple[Searches, Indices]:
    """Searches in one camera's pictures, numbered from `count`, and their rows of the source."""
    own, other = names[pair[0]], names[pair[1]]
    stamps = tracks[other].timestamps_ns
    wanted = source.times_ns + round(lag_s * 1e9) - offsets[other]
    at = nearest_indices(stamps, wanted)
    rows = np.flatnonzero(np.abs(stamps[at] - wanted) < 0.1e9)
    seen_ns = stamps[at[rows]] + offsets[other]
    if not len(rows):
        return _searches(tracks[own], source, rows, rows, pair, np.empty((0, 2)), count), rows
    bias = source.bias[rows].mean(axis=0)
    way = motion.between(source.times_ns[rows], seen_ns, source.reference_ns[rows], bias)
    place = (way.by_velocity @ source.velocity[rows][:, :, None])[:, :, 0] + way.known
    mounted, target = rig.camera(own), rig.camera(other)
    assert mounted.model is not None
    assert target.model is not None
    first_from_target = SE3(way.rotation, place) * target.rig_from_cam
    target_from_first = first_from_target.inverse()
    pixels, valid = target.model.project(target_from_first * source.points[rows])
    valid &= inside(usable, pixels)
    edge = np.array([target.model.width_px, target.model.height_px]) - 1 - _MARGIN_PX
    valid[valid] = ((pixels[valid] > _MARGIN_PX) & (pixels[valid] < edge)).all(axis=1)
    chosen = _evenly_at_most(source.times_ns[rows], valid, _MOST)
    rows, pixels, target_from_first = rows[chosen], pixels[chosen], target_from_first[chosen]
    searches = _searches(tracks[own], source, rows, stamps[at[rows]], pair, pixels, count)
    first_from_source = SE3(
        np.broadcast_to(mounted.rig_from_cam.rotation, (len(rows), 3, 3)),
        np.broadcast_to(mounted.rig_from_cam.translation, (len(rows), 3)),
    )
    mapped = map_stencils(
        tracks[own].pixels[source.first[rows]],
        source.points[rows],
        (mounted.model, target.model),
        first_from_source,
        target_from_first,
    )
    return warped(searches, mapped, _OPTIONS), rows


def _evenly_at_most(group: Indices, allowed: Mask, most: int) -> Indices:
    """Allowed rows, at most so many of each group, evenly."""
    chosen = []
    rows = np.flatnonzero(allowed)
    for value in np.unique(group[rows]):
        own = rows[group[rows] == value]
        chosen.append(own[np.unique(np.linspace(0, len(own) - 1, min(most, len(own))).astype(np.int64))])
    return np.concatenate(chosen) if chosen else np.empty(0, dtype=np.int64)


def _searches(
    tracks: Tracks,
    source: _Source,
    rows: Indices,
    stamps: Indices,
    pair: tuple[int, int],
    pixels: Array,
    count: int,
) -> Searches:
    first = source.first[rows]
    n = len(rows)
    return Searches(
        count + np.arange(n),
        np.full(n, pair[0]),
        tracks.timestamps_ns[tracks.frame_indices[first]],
        tracks.pixels[first],
        tracks.std_px[first],
        np.full(n, pair[1]),
        stamps,
        pixels,
        np.tile(np.eye(2), (n, 1, 1)),
        np.zeros((n, 2, 3)),
    )


def _views(
    names: tuple[str, ...],
    parts: Sequence[Searches],
    rows: Sequence[tuple[int, Indices, Indices]],
    tracks: Mapping[str, Tracks],
    streams: Mapping[str, CameraStream],
    rig: Rig,
) -> CrossViews:
    """Carry out the searches."""
    if not sum(len(part) for part in parts):
        return CrossViews.nothing(names)
    found = find_landmarks(names, join_rows(list(parts)), streams, _OPTIONS)
    source = np.concatenate([np.full(len(first), a) for a, first, _ in rows])[found.landmark_indices]
    first, later = (np.concatenate([row[k] for row in rows])[found.landmark_indices] for k in (1, 2))
    n = len(found.landmark_indices)
    stamps, bearings, std = np.zeros((n, 3), dtype=np.int64), np.zeros((n, 3, 3)), np.zeros((n, 3))
    clusters, good = np.zeros(n, dtype=np.int64), np.ones(n, dtype=bool)
    stamps[:, 2] = found.timestamps_ns
    for a, name in enumerate(names):
        own, model = tracks[name], rig.camera(name).model
        assert model is not None
        resolution = PixelAngles(model)
        mine = np.flatnonzero(source == a)
        for k, index in enumerate((first[mine], later[mine])):
            stamps[mine, k] = own.timestamps_ns[own.frame_indices[index]]
            bearings[mine, k] = own.bearings_cam[index]
            std[mine, k] = resolution(own.bearings_cam[index]) * own.std_px[index]
        clusters[mine] = own.track_ids[first[mine]] * len(names) + a
        seen = np.flatnonzero(found.camera_indices == a)
        bearings[seen, 2], good[seen] = model.unproject(found.pixels[seen])
        std[seen, 2] = resolution(np.nan_to_num(bearings[seen, 2])) * found.std_px[seen]
    views = CrossViews(
        names,
        source,
        found.camera_indices,
        stamps[:, 0],
        stamps[:, 1],
        stamps[:, 2],
        bearings[:, 0],
        bearings[:, 1],
        bearings[:, 2],
        std,
        clusters,
    )
    return views.take(np.flatnonzero(good & np.isfinite(bearings).all(axis=(1, 2))))
