"""From measurements and initial values to a rig problem: states, chosen tracks, landmarks."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from rigwake._types import Array, Indices
from rigwake.ba.rig.gnss_noise import with_receiver_errors
from rigwake.ba.rig.rig_values import AdjustmentOptions, AssembledProblem, InitialRig, RigMeasurements
from rigwake.ba.solver.preintegration import LONGEST_BRIDGE_S
from rigwake.ba.solver.rig_problem import (
    Antenna,
    BundleCamera,
    InertialStates,
    Landmarks,
    Observations,
    RigProblem,
    States,
    VectorPrior,
)
from rigwake.errors import EstimationError
from rigwake.geometry.interpolate import TransformSpline, interpolate, nearest_indices
from rigwake.geometry.se3 import SE3
from rigwake.geometry.triangulation import triangulate_rays
from rigwake.tracks import Tracks

_CELLS = 6  # the image is divided into this many columns and rows when tracks are chosen
_RECEIVER_DELAY_STD_S = 0.1
_DEFAULT_RANGE_M = 30.0  # of points without parallax: far enough to be smooth, near enough to move


def assemble_problem(
    measurements: RigMeasurements, start: InitialRig, options: AdjustmentOptions
) -> AssembledProblem:
    """States at `state_rate_hz`, the best tracks of every camera, and their landmarks triangulated from the start.

    Raises EstimationError when no camera has tracks within the span of the rig's trajectory.
    """
    states = _states(measurements, start, options)
    options = _within_bounds(options, states, len(start.cameras))
    parts = [
        _observe(index, camera, measurements.tracks[name], states, options)
        for index, (name, camera) in enumerate(start.cameras.items())
    ]
    observations, track_cameras, track_ids = _number_landmarks(parts)
    cameras = tuple(start.cameras.values())
    landmarks = triangulate_landmarks(start, cameras, observations, len(track_ids))
    problem = RigProblem(
        states=states,
        cameras=cameras,
        landmarks=landmarks,
        observations=observations,
        imu=measurements.imu,
        gnss=measurements.gnss,
        antenna=_antenna(measurements, start),
        attitude=measurements.attitude,
    )
    return AssembledProblem(with_receiver_errors(problem), track_cameras, track_ids)


def _within_bounds(options: AdjustmentOptions, states: States, cameras: int) -> AdjustmentOptions:
    """The options with as many tracks per second as `most_tracks` allows."""
    seconds = len(np.unique(states.timestamps_ns // 10**9))
    affordable = options.most_tracks // max(seconds * cameras, 1)
    return replace(options, tracks_per_second=max(min(options.tracks_per_second, affordable), 1))


def _antenna(measurements: RigMeasurements, start: InitialRig) -> Antenna:
    """The antenna, and with an IMU the receiver's delay, which is known to be small once it was looked for."""
    if measurements.gnss is None or measurements.imu is None:
        return Antenna(start.antenna_rig, free=measurements.gnss is not None)
    delay = VectorPrior.from_std(0.0, _RECEIVER_DELAY_STD_S)
    return Antenna(start.antenna_rig, free=True, time_offset_prior=delay)


def state_times(
    measurements: RigMeasurements, start: InitialRig, options: AdjustmentOptions
) -> NDArray[np.int64]:
    """Stamps (rig clock) of the frames nearest to a regular grid, of the camera with the most frames inside the
    span that the rig's trajectory and the IMU cover."""
    rate_hz = options.state_rate_without_imu_hz if measurements.imu is None else options.state_rate_hz
    margin_ns = int(0.6e9 / rate_hz)
    first, last = start.world_from_rig.timestamps_ns[[0, -1]]
    if measurements.imu is not None:
        first = max(first, measurements.imu.timestamps_ns[0])
        last = min(last, measurements.imu.timestamps_ns[-1])
    best: NDArray[np.int64] = np.empty(0, dtype=np.int64)
    for name, camera in start.cameras.items():
        stamps = measurements.tracks[name].timestamps_ns + round(camera.time_offset_s * 1e9)
        inside = stamps[(stamps >= first) & (stamps <= last)]
        if len(inside) > len(best):
            best = inside
    if len(best) < 2:
        raise EstimationError(
            "No camera has images within the span of the rig's trajectory and the IMU.",
            remedy="Check the clocks with `rigwake inspect`.",
        )
    grid = np.arange(best[0], best[-1] + margin_ns, round(1e9 / rate_hz))
    after = np.clip(np.searchsorted(best, grid), 1, len(best) - 1)
    nearest = np.where(grid - best[after - 1] < best[after] - grid, after - 1, after)
    return best[np.unique(nearest)]


def _states(measurements: RigMeasurements, start: InitialRig, options: AdjustmentOptions) -> States:
    stamps = state_times(measurements, start, options)
    trajectory = start.world_from_rig
    world_from_rig = interpolate(trajectory.timestamps_ns, trajectory.world_from_body, stamps)
    if measurements.imu is None:
        return States(stamps, world_from_rig)
    # differentiating the thinned positions averages the noise of a dense trajectory
    velocity = _velocity(stamps, world_from_rig)
    n = len(stamps)
    inertial = InertialStates(velocity, np.tile(start.gyro_bias, (n, 1)), np.tile(start.accel_bias, (n, 1)))
    return States(stamps, world_from_rig, inertial)


def _velocity(stamps: Indices, world_from_rig: SE3) -> Array:
    """(N, 3) velocities in the world, section by section: nobody knows how the rig went from one to the next."""
    velocity = np.zeros((len(stamps), 3))
    breaks = np.flatnonzero(np.diff(stamps) > round(LONGEST_BRIDGE_S * 1e9)) + 1
    for rows in np.split(np.arange(len(stamps)), breaks):
        if len(rows) > 1:
            velocity[rows] = TransformSpline(stamps[rows], world_from_rig[rows]).velocity_world(stamps[rows])
    return velocity


def _observe(
    index: int, camera: BundleCamera, tracks: Tracks, states: States, options: AdjustmentOptions
) -> tuple[Observations, Indices]:
    """Observations of one camera at the frames nearest to the states; `landmark_indices` are track ids."""
    offset_ns = round(camera.time_offset_s * 1e9)
    frame_stamps = tracks.timestamps_ns + offset_ns
    at = states.timestamps_ns
    nearest = nearest_indices(frame_stamps, at)
    gap_ns = np.abs(frame_stamps[nearest] - at)
    usual_ns = np.median(np.diff(at)) if len(at) > 1 else 1e9
    near = gap_ns <= 0.6 * usual_ns
    if states.inertial is None:
        near &= ~_in_a_break(frame_stamps[nearest], at)
    frames = np.unique(nearest[near])
    kept = np.isin(tracks.frame_indices, frames)
    counts = np.bincount(tracks.track_ids[kept], minlength=int(tracks.track_ids.max(initial=0)) + 1)
    kept &= counts[tracks.track_ids] >= options.min_observations
    chosen = _longest_everywhere(tracks.take(kept), camera, options)
    rows = np.flatnonzero(kept)[np.isin(tracks.track_ids[kept], chosen)]
    observations = Observations(
        np.full(len(rows), index, dtype=np.int64),
        tracks.timestamps_ns[tracks.frame_indices[rows]],
        tracks.track_ids[rows],
        tracks.pixels[rows],
        tracks.std_px[rows],
    )
    return observations, chosen


def _in_a_break(stamps: Indices, states: Indices) -> NDArray[np.bool_]:
    """Which stamps lie between two states that are so far apart that nothing can be said of the way between."""
    right = np.clip(np.searchsorted(states, stamps), 1, len(states) - 1)
    inside = (stamps > states[right - 1]) & (stamps < states[right])
    return np.asarray(inside & (states[right] - states[right - 1] > round(LONGEST_BRIDGE_S * 1e9)))


def _longest_everywhere(tracks: Tracks, camera: BundleCamera, options: AdjustmentOptions) -> Indices:
    """Ids of the longest tracks, taken in turn from every cell of the image, second by second."""
    ids, first, counts = np.unique(tracks.track_ids, return_index=True, return_counts=True)
    if not len(ids):
        return ids
    second = tracks.timestamps_ns[tracks.frame_indices[first]] // 10**9
    cells = np.clip(
        tracks.pixels[first] / [camera.model.width_px, camera.model.height_px] * _CELLS, 0, _CELLS - 1
    ).astype(np.int64)
    group = (second - second.min()) * _CELLS**2 + cells[:, 0] * _CELLS + cells[:, 1]
    order = np.lexsort((ids, -counts, group))
    # place of each track within its own cell: the first of every cell come before the second of any
    starts = np.flatnonzero(np.diff(group[order], prepend=-1))
    place = np.arange(len(order)) - np.repeat(starts, np.diff(np.append(starts, len(order))))
    by_second = np.lexsort((-counts[order], place, second[order]))
    ranked = order[by_second]
    starts = np.flatnonzero(np.diff(second[ranked], prepend=-1))
    rank = np.arange(len(ranked)) - np.repeat(starts, np.diff(np.append(starts, len(ranked))))
    return np.sort(ids[ranked[rank < options.tracks_per_second]])


def _number_landmarks(
    parts: list[tuple[Observations, Indices]],
) -> tuple[Observations, Indices, Indices]:
    """Observations of all cameras with landmarks numbered through."""
    offset, renumbered = 0, []
    for observations, ids in parts:
        renumbered.append(offset + np.searchsorted(ids, observations.landmark_indices))
        offset += len(ids)
    if offset == 0:
        raise EstimationError(
            "No camera has tracks that last.",
            consequence="There is nothing to adjust the rig with.",
            remedy="Check exposure and texture with `rigwake inspect`, or raise the frame rate.",
        )
    every = [observations for observations, _ in parts]
    observations = Observations(
        np.concatenate([o.camera_indices for o in every]),
        np.concatenate([o.timestamps_ns for o in every]),
        np.concatenate(renumbered).astype(np.int64),
        np.concatenate([o.pixels for o in every]),
        np.concatenate([o.std_px for o in every]),
    )
    cameras = np.concatenate([np.full(len(ids), k, dtype=np.int64) for k, (_, ids) in enumerate(parts)])
    return observations, cameras, np.concatenate([ids for _, ids in parts])


def observation_rays(
    start: InitialRig, cameras: tuple[BundleCamera, ...], observations: Observations
) -> tuple[Array, Array]:
    """Origins and unit directions (M, 3) in the world of observations, with the rig where the start has it."""
    origins, directions = np.empty((len(observations), 3)), np.empty((len(observations), 3))
    trajectory = start.world_from_rig
    for index, camera in enumerate(cameras):
        rows = np.flatnonzero(observations.camera_indices == index)
        stamps = observations.timestamps_ns[rows] + round(camera.time_offset_s * 1e9)
        stamps = np.clip(stamps, trajectory.timestamps_ns[0], trajectory.timestamps_ns[-1])
        world_from_cam = (
            interpolate(trajectory.timestamps_ns, trajectory.world_from_body, stamps) * camera.rig_from_cam
        )
        bearings, _ = camera.model.unproject(observations.pixels[rows])
        origins[rows] = world_from_cam.translation
        directions[rows] = np.einsum("nij,nj->ni", world_from_cam.rotation, bearings)
    return origins, directions


def triangulate_landmarks(
    start: InitialRig, cameras: tuple[BundleCamera, ...], observations: Observations, count: int
) -> Landmarks:
    """Landmarks anchored where they were first seen from; those without parallax at a default range."""
    origins, directions = observation_rays(start, cameras, observations)
    order = np.lexsort((observations.timestamps_ns, observations.landmark_indices))
    starts = np.searchsorted(observations.landmark_indices[order], np.arange(count + 1))
    found = triangulate_rays(origins[order], directions[order], starts)
    first = order[starts[:-1]]
    ranges = np.einsum("ni,ni->n", found.points - origins[first], directions[first])
    known = np.isfinite(ranges) & found.ahead & (ranges > 0.1)
    inverse_ranges = np.where(known, 1 / np.where(known, ranges, 1.0), 1 / _DEFAULT_RANGE_M)
    return Landmarks(origins[first], directions[first], inverse_ranges)
