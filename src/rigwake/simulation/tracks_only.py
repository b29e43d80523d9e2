"""Recordings without pictures: exact observations of landmarks plus the faults of a tracker.

For Monte Carlo over estimators: noise, outliers, tracks that break, and tracks that ride on moving water.
Nothing hides anything: landmarks are occluded neither by each other nor by the boat.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from rigwake._tables import take_rows
from rigwake._types import Array
from rigwake.geometry.se3 import SE3
from rigwake.recording import Frame, Recording
from rigwake.simulation.scenario import Camera, Scenario, Tracking
from rigwake.simulation.scene_layout import sample_landmarks
from rigwake.simulation.setup import Simulation, build_recording, prepare
from rigwake.simulation.waves import GRAVITY
from rigwake.tracks import Tracks

_WATER_LIFETIME_S = 1.2
_WATER_RANGE_M = 40.0


@dataclass(frozen=True)
class NoFrames:
    """The frame source of a recording without pictures: it yields none."""

    def frames(self, indices: Sequence[int] | NDArray[np.int64], *, colour: bool = False) -> Iterator[Frame]:
        """No frames."""
        return iter(())


@dataclass(frozen=True, eq=False)
class CameraTruth:
    """What the observations of one camera's `Tracks` really are, row by row.

    landmark_ids: (M,) row of `landmarks_world`, -1 on water. pixels: (M, 2) without noise.
    is_outlier: (M,) observation shifted on purpose.
    """

    landmark_ids: NDArray[np.int64]
    pixels: Array
    is_outlier: NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class SimulatedTracks:
    """Tracks by camera, with their truth, and a recording that holds everything but pictures."""

    tracks: Mapping[str, Tracks]
    truth: Mapping[str, CameraTruth]
    landmarks_world: Array
    recording: Recording


@dataclass(frozen=True, eq=False)
class _Sightings:
    """Exact observations: frame, track, landmark (-1 on water) and pixel of each."""

    frame: NDArray[np.int64]
    track: NDArray[np.int64]
    landmark: NDArray[np.int64]
    pixels: Array

    def take(self, index: NDArray[np.bool_] | NDArray[np.int64]) -> _Sightings:
        return take_rows(self, index)


def simulate_tracks(scenario: Scenario) -> SimulatedTracks:
    """Simulate a scenario without rendering. UsageError as `prepare`."""
    simulation = prepare(scenario)
    tracking = scenario.tracking
    rng = simulation.rng(10)
    landmarks = sample_landmarks(simulation.layout, rng, tracking.landmarks)
    tracks, truth = {}, {}
    for index, camera in enumerate(scenario.cameras):
        camera_rng = simulation.rng(11, index)
        sightings = _sort(_land_and_water(simulation, camera, landmarks, camera_rng))
        tracks[camera.name], truth[camera.name] = _observe(
            simulation, camera, sightings, tracking, camera_rng
        )
    sources = {camera.name: NoFrames() for camera in scenario.cameras}
    recording = build_recording(simulation, dict(sources), Path(scenario.name))
    return SimulatedTracks(tracks, truth, landmarks, recording)


def _land_and_water(
    simulation: Simulation, camera: Camera, landmarks: Array, rng: np.random.Generator
) -> _Sightings:
    land = _land(simulation, camera, landmarks, rng)
    water = _water(simulation, camera, rng)
    offset = int(land.track.max()) + 1 if len(land.track) else 0
    return _Sightings(
        np.concatenate([land.frame, water.frame]),
        np.concatenate([land.track, water.track + offset]),
        np.concatenate([land.landmark, water.landmark]),
        np.concatenate([land.pixels, water.pixels]),
    )


def _world_from_cam(simulation: Simulation, camera: Camera, times_s: Array) -> SE3:
    return simulation.motion.world_from_rig(times_s) * simulation.rig.camera(camera.name).rig_from_cam


def _see(
    simulation: Simulation, camera: Camera, frame: NDArray[np.int64], points_world: Array
) -> tuple[Array, NDArray[np.bool_]]:
    """Pixels (N, 2) of points (N, 3) in frames (N,), and whether they lie in the image.

    A rolling shutter exposes row v later by `v / (height - 1)` of the readout; the row is found by iteration.
    """
    model = simulation.rig.camera(camera.name).model
    assert model is not None
    times = simulation.scene_times_s(camera)
    readout = camera.rolling_shutter_ms * 1e-3
    # one pose per frame; with a rolling shutter, one per observation from the second round on
    poses = _world_from_cam(simulation, camera, times)[frame]
    pixels, valid = model.project(poses.inverse() * points_world)
    for _ in range(4 if readout > 0 else 0):
        row = np.clip(np.nan_to_num(pixels[:, 1]), 0, camera.height_px - 1) / (camera.height_px - 1)
        poses = _world_from_cam(simulation, camera, times[frame] + row * readout)
        pixels, still = model.project(poses.inverse() * points_world)
        valid &= still  # a point that leaves the field of view on the way has no row to be seen from
    edge = np.array([camera.width_px - 0.5, camera.height_px - 0.5])
    inside = valid & np.all((pixels >= -0.5) & (pixels <= edge), axis=1)
    return pixels, inside


def _land(simulation: Simulation, camera: Camera, landmarks: Array, rng: np.random.Generator) -> _Sightings:
    """Tracks of landmarks: each stay in view is cut into random lifetimes, and as many are kept as asked for."""
    tracking = simulation.scenario.tracking
    times = simulation.scene_times_s(camera)
    model = simulation.rig.camera(camera.name).model
    assert model is not None
    poses = _world_from_cam(simulation, camera, times)
    towards = landmarks[:, None] - poses.translation  # (L, F, 3)
    ahead = np.einsum("lfi,fi->lf", towards, poses.rotation[..., 2])
    seen = ahead > np.cos(model.max_angle) * np.linalg.norm(towards, axis=-1)
    landmark, frame = np.nonzero(seen)
    # lifetimes: a track of landmark l ends at random, at the rate 1 / lifetime
    ends = rng.random(len(frame)) < 1 / (tracking.lifetime_s * camera.rate_hz)
    track = _number_runs(landmark, frame, ends)
    if not len(track):
        return _Sightings(frame, track, landmark, np.empty((0, 2)))
    sample = rng.integers(0, len(frame), 4000)  # how much of the field of view lies inside the image
    _, sample_inside = _see(simulation, camera, frame[sample], landmarks[landmark[sample]])
    wanted = tracking.features * len(times) / (len(frame) * max(float(sample_inside.mean()), 1e-2))
    kept = (rng.random(int(track.max()) + 1) < wanted)[track]
    landmark, frame, track = landmark[kept], frame[kept], track[kept]
    pixels, inside = _see(simulation, camera, frame, landmarks[landmark])
    return _Sightings(frame, track, landmark, pixels).take(inside)


def _number_runs(
    landmark: NDArray[np.int64], frame: NDArray[np.int64], ends: NDArray[np.bool_]
) -> NDArray[np.int64]:
    """Track number of each (landmark, frame) in sorted order; a gap, another landmark or an end starts anew."""
    if not len(landmark):
        return landmark
    starts = (np.diff(landmark) != 0) | (np.diff(frame) != 1) | ends[1:]
    return np.concatenate([[0], np.cumsum(starts)])


def _water(simulation: Simulation, camera: Camera, rng: np.random.Generator) -> _Sightings:
    """Short tracks on crests that run with the waves at their phase speed and rise and fall with them."""
    scenario = simulation.scenario
    times = simulation.scene_times_s(camera)
    lifetime = max(int(_WATER_LIFETIME_S * camera.rate_hz), 2)
    count = int(scenario.tracking.water * scenario.tracking.features * len(times) / lifetime * 2)
    poses = _world_from_cam(simulation, camera, times)
    birth = rng.integers(0, len(times), count)
    length = np.minimum(rng.geometric(1 / lifetime, count), len(times) - birth)
    distance = 3 + (_WATER_RANGE_M - 3) * rng.random(count) ** 2
    bearing = rng.uniform(0, 2 * np.pi, count)
    plan = poses.translation[birth, :2] + distance[:, None] * np.stack([np.cos(bearing), np.sin(bearing)], 1)
    period = scenario.sea.tp_s * rng.uniform(0.3, 1.0, count)
    direction = np.deg2rad(scenario.sea.direction_deg) + rng.normal(0, 0.4, count)
    speed = GRAVITY * period / (2 * np.pi)
    track = np.repeat(np.arange(count), length)
    frame = birth[track] + _ranges(length)
    age = times[frame] - times[birth[track]]
    heading = np.stack([np.cos(direction), np.sin(direction)], 1)
    moved = plan[track] + heading[track] * (speed[track] * age)[:, None]
    phase = 2 * np.pi * (age / period[track] + rng.random(count)[track])
    height = scenario.sea.hs_m / 4 * np.sin(phase)
    pixels, inside = _see(simulation, camera, frame, np.column_stack([moved, height]))
    return _Sightings(frame, track, np.full(len(frame), -1), pixels).take(inside)


def _ranges(lengths: NDArray[np.int64]) -> NDArray[np.int64]:
    """`0, 1, .., n-1` for each n, one after the other."""
    starts = np.cumsum(lengths) - lengths
    return np.arange(int(lengths.sum())) - np.repeat(starts, lengths)


def _sort(sightings: _Sightings) -> _Sightings:
    """By frame, then by track; tracks that left the image and came back are two."""
    by_track = sightings.take(np.lexsort((sightings.frame, sightings.track)))
    no_ends = np.zeros(len(by_track.frame), dtype=bool)
    track = _number_runs(by_track.track, by_track.frame, no_ends)
    renumbered = _Sightings(by_track.frame, track, by_track.landmark, by_track.pixels)
    return renumbered.take(np.lexsort((track, by_track.frame)))


def _observe(
    simulation: Simulation, camera: Camera, exact: _Sightings, tracking: Tracking, rng: np.random.Generator
) -> tuple[Tracks, CameraTruth]:
    """Noise and outliers on top of exact pixels; bearings from the noisy pixels."""
    model = simulation.rig.camera(camera.name).model
    assert model is not None
    n = len(exact.frame)
    noisy = exact.pixels + rng.standard_normal((n, 2)) * tracking.noise_px
    is_outlier = rng.random(n) < tracking.outliers
    shift = rng.uniform(-tracking.outlier_px, tracking.outlier_px, (n, 2))
    noisy[is_outlier] += shift[is_outlier]
    bearings, valid = model.unproject(noisy)
    tracks = Tracks(
        camera.name,
        simulation.camera_stamps(camera),
        exact.frame[valid],
        exact.track[valid],
        noisy[valid],
        bearings[valid],
        np.full(int(valid.sum()), max(tracking.noise_px, 1e-3)),
    )
    return tracks, CameraTruth(exact.landmark[valid], exact.pixels[valid], is_outlier[valid])
