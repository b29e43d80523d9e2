"""Landmarks that one camera tracks, looked for in the others' pictures: what would be found, without pictures."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from rigwake._types import Array, Indices
from rigwake.cameras.protocol import CameraModel
from rigwake.odometry.indexed_tracks import radians_per_pixel
from rigwake.simulation.setup import Simulation
from rigwake.simulation.tracks_only import CameraTruth, _see
from rigwake.tracks import CrossViews, Tracks

_EVERY_S = 1.0
_WRONG = 0.03  # of the views found show something else nearby
_WRONG_PX = 3.0
_NOISE = 1.4  # a patch of another camera is found less exactly than one of the same


def simulate_cross_views(
    stretches: Mapping[str, Simulation],
    tracks: Mapping[str, Tracks],
    truths: Mapping[str, CameraTruth],
    landmarks: Array,
    most: int,
    rng: np.random.Generator,
) -> CrossViews:
    """Every second, at most `most` tracks of each camera in each other one, at the same time and up to a second off.

    stretches: by camera, each with its own rig where a fault moved one.
    """
    names = tuple(tracks)
    rows: list[tuple[Array | Indices, ...]] = []
    for a, source in enumerate(names):
        first, later = _second_apart(tracks[source])
        first, later = (index[truths[source].landmark_ids[first] >= 0] for index in (first, later))
        for b, target in enumerate(names):
            for lag in (False, True):
                if a == b or not len(first) or most == 0:
                    continue
                chosen = _randomly_at_most(tracks[source].frame_indices[first], most, rng)
                found = _look(
                    stretches[target], tracks, source, target, truths, landmarks, first[chosen], lag, rng
                )
                kept, seen, stamps, std = found
                i, j = first[chosen][kept], later[chosen][kept]
                own = tracks[source]
                width = _axis_resolution(_model(stretches[source], source))
                std_own = own.std_px[i] * width
                rows.append(
                    (
                        np.full(len(i), a),
                        np.full(len(i), b),
                        own.timestamps_ns[own.frame_indices[i]],
                        own.timestamps_ns[own.frame_indices[j]],
                        stamps,
                        own.bearings_cam[i],
                        own.bearings_cam[j],
                        seen,
                        np.stack([std_own, std_own, std], axis=1),
                        own.track_ids[i] * len(names) + a,
                    )
                )
    if not rows:
        return CrossViews.nothing(names)
    return CrossViews(names, *(np.concatenate(column) for column in zip(*rows, strict=True)))


def _second_apart(tracks: Tracks) -> tuple[Indices, Indices]:
    """Observations in a frame of every second, and of the same track a second later."""
    stamps = tracks.timestamps_ns
    step = max(round(_EVERY_S / max(float(np.median(np.diff(stamps))) * 1e-9, 1e-3)), 1)
    first = np.flatnonzero(tracks.frame_indices % step == 0)
    return tracks.same_tracks(first, tracks.frame_indices[first] + step)


def _randomly_at_most(group: Indices, most: int, rng: np.random.Generator) -> Indices:
    """Rows, at most so many of each group, at random."""
    order = rng.permutation(len(group))
    order = order[np.argsort(group[order], kind="stable")]
    starts = np.searchsorted(group[order], group[order])
    return np.asarray(order[np.arange(len(order)) - starts < most])


def _look(
    stretch: Simulation,
    tracks: Mapping[str, Tracks],
    source: str,
    target: str,
    truths: Mapping[str, CameraTruth],
    landmarks: Array,
    rows: Indices,
    lag: bool,
    rng: np.random.Generator,
) -> tuple[Indices, Array, Indices, Array]:
    """Which of the rows the target sees, with bearings (K, 3), stamps (K,) and deviations (K,), radians."""
    camera = next(c for c in stretch.scenario.cameras if c.name == target)
    stamps = tracks[target].timestamps_ns
    frames = np.clip(tracks[source].frame_indices[rows], 0, len(stamps) - 1)
    if lag:
        reach = round(camera.rate_hz)
        away = rng.integers(1, reach + 1, len(rows)) * rng.choice([-1, 1], len(rows))
        frames = np.clip(frames + away, 0, len(stamps) - 1)
    pixels, inside = _see(stretch, camera, frames, landmarks[truths[source].landmark_ids[rows]])
    noise = _NOISE * max(stretch.scenario.tracking.noise_px, 1e-3)
    pixels = pixels + noise * rng.standard_normal(pixels.shape)
    wrong = rng.random(len(rows)) < _WRONG
    pixels[wrong] += rng.uniform(-_WRONG_PX, _WRONG_PX, (int(wrong.sum()), 2))
    model = _model(stretch, target)
    bearings, valid = model.unproject(np.nan_to_num(pixels))
    kept = np.flatnonzero(inside & valid)
    std = np.full(len(kept), noise * _axis_resolution(model))
    return kept, bearings[kept], stamps[frames[kept]], std


def _model(simulation: Simulation, camera: str) -> CameraModel:
    model = simulation.rig.camera(camera).model
    assert model is not None
    return model


def _axis_resolution(model: CameraModel) -> float:
    """Radians per pixel at the optical axis."""
    return float(radians_per_pixel(model, np.array([[1e-6, 0.0, 1.0]]))[0])
