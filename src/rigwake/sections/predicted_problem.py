"""The bundle adjustment of a short stretch before anything is tracked: assumed landmarks, predicted observations.

What the stretch would tell about the rig is then the information matrix of `ba/solver`, the one that also gives the
covariances of the result: same factors, same noise, same unknowns. Only where the landmarks are is assumed.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from rigwake._types import Array, Indices, Mask
from rigwake.ba.rig.gauge import with_gauge
from rigwake.ba.rig.gnss_noise import with_receiver_errors
from rigwake.ba.solver.rig_problem import (
    Antenna,
    BundleCamera,
    CameraParameter,
    InertialStates,
    Landmarks,
    Observations,
    RigProblem,
    States,
    VectorPrior,
)
from rigwake.cameras.protocol import CameraModel
from rigwake.excerpt import gnss_between, imu_between
from rigwake.geometry.se3 import SE3
from rigwake.recording import GnssStream, ImuStream
from rigwake.sections.expected_motion import ExpectedMotion

_NEAREST_M, _FARTHEST_M, _LOWEST_M, _HIGHEST_M = 8.0, 80.0, -1.0, 8.0
_POINTS = 300
_LIFETIME_S = 3.0
_SIMULATED_TRACKS = 30  # per camera and stretch; they stand for all that would be tracked
_FEWEST_VIEWS = 3
_NO_PRIOR_STD_S = 1e3
_SURROUNDING_S = 0.5  # of inertial samples beyond the states


@dataclass(frozen=True)
class TrackingForecast:
    """What tracking is expected to yield: tracks_per_second of each camera, the standard deviation of a pixel that
    counts (errors that last along a track included), and of one associated across cameras; across_cameras: the
    fraction of landmarks that another camera finds again."""

    tracks_per_second: float = 60.0
    std_px: float = 0.3
    across_std_px: float = 0.6
    across_cameras: float = 0.25


@dataclass(frozen=True, eq=False)
class ForecastSensors:
    """What takes part: lenses by camera, the inertial sensor and the receiver. state_rate_hz: of the adjustment."""

    models: dict[str, CameraModel]
    imu: ImuStream | None
    gnss: GnssStream | None
    state_rate_hz: float


def predicted_problem(
    motion: ExpectedMotion,
    sensors: ForecastSensors,
    forecast: TrackingForecast,
    span_ns: tuple[int, int],
    texture: Array,
    seed: int,
) -> RigProblem:
    """The problem of one stretch. texture: (C,) how much there is to track in each camera, 0 to 1.

    Cameras look at the horizon, evenly spread around the rig at its origin: where they really look is what the
    calibration finds, and what a motion tells hardly depends on it.
    """
    stamps = np.arange(*span_ns, round(1e9 / sensors.state_rate_hz), dtype=np.int64)
    poses, velocity = motion.at(stamps)
    states = States(stamps, poses)
    imu = None
    if sensors.imu is not None:
        margin = round(_SURROUNDING_S * 1e9)
        imu = imu_between(sensors.imu, span_ns[0] - margin, span_ns[1] + margin)
        states = replace(
            states, inertial=InertialStates(velocity, np.zeros_like(velocity), np.zeros_like(velocity))
        )
    gnss = None if sensors.gnss is None else gnss_between(sensors.gnss, span_ns)
    if gnss is not None and len(gnss.timestamps_ns) < 2:
        gnss = None
    cameras = _assumed_cameras(sensors.models, motion.up_rig, hold_first=imu is None)
    rng = np.random.default_rng(seed)
    landmarks, observations = _predicted_observations(states, cameras, forecast, texture, rng)
    antenna = Antenna(np.zeros(3))
    if gnss is not None:
        # what is known of the delay is added once, not once per stretch
        weak = VectorPrior.from_std(0.0, _NO_PRIOR_STD_S) if imu is not None else None
        antenna = Antenna(np.zeros(3), free=True, time_offset_prior=weak)
    problem = RigProblem(states, cameras, landmarks, observations, imu=imu, gnss=gnss, antenna=antenna)
    return with_gauge(with_receiver_errors(problem))


def _assumed_cameras(
    models: dict[str, CameraModel], up_rig: Array, *, hold_first: bool
) -> tuple[BundleCamera, ...]:
    """Level cameras, the first one's axis along the rig's own axis that is most level."""
    ahead = np.eye(3)[np.argmin(np.abs(up_rig))]
    ahead = ahead - (ahead @ up_rig) * up_rig
    ahead /= np.linalg.norm(ahead)
    left = np.cross(up_rig, ahead)
    cameras = []
    for number, (name, model) in enumerate(models.items()):
        azimuth = 2 * np.pi * number / len(models)
        axis = np.cos(azimuth) * ahead + np.sin(azimuth) * left
        rotation = np.stack([np.cross(axis, up_rig), -up_rig, axis], axis=1)
        free: frozenset[CameraParameter] = frozenset(("rig_from_cam", "time_offset"))
        held = hold_first and number == 0
        cameras.append(
            BundleCamera(name, model, SE3(rotation, np.zeros(3)), free=frozenset() if held else free)
        )
    return tuple(cameras)


def _predicted_observations(
    states: States,
    cameras: tuple[BundleCamera, ...],
    forecast: TrackingForecast,
    texture: Array,
    rng: np.random.Generator,
) -> tuple[Landmarks, Observations]:
    """Points on land all around, each seen for a few seconds; a few tracks with small noise stand for many."""
    stamps = states.timestamps_ns
    step_s = float(np.median(np.diff(stamps))) * 1e-9
    seconds = len(stamps) * step_s
    points = _assumed_land(states, rng)
    seen = [_pixels(states, camera, points) for camera in cameras]
    length = max(round(_LIFETIME_S / step_s), _FEWEST_VIEWS)
    rows: list[Array] = []
    chosen: list[Array] = []
    count = 0
    for index in range(len(cameras)):
        pixels, valid = seen[index]
        tracked = forecast.tracks_per_second * seconds * texture[index]
        starts, ids = _lives(valid, length, min(_SIMULATED_TRACKS, int(tracked)), rng)
        shrink = np.sqrt(len(ids) / tracked) if tracked > 0 and len(ids) else 1.0
        for first, point in zip(starts, ids, strict=True):
            at = first + np.flatnonzero(valid[first : first + length, point])
            rows.append(_rows(index, at, count, pixels[at, point], forecast.std_px * shrink))
            if len(cameras) > 1 and rng.random() < forecast.across_cameras:
                rows += _found_again(index, point, count, seen, forecast.across_std_px * shrink, rng)
            chosen.append(np.array([first, point]))
            count += 1
    if not count:
        return Landmarks(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0)), Observations.empty()
    first, point = np.array(chosen).T
    anchors = states.world_from_rig.translation[first]
    table = np.concatenate(rows)
    observations = Observations(
        table[:, 0].astype(np.int64),
        stamps[table[:, 1].astype(np.int64)],
        table[:, 2].astype(np.int64),
        np.ascontiguousarray(table[:, 3:5]),
        np.ascontiguousarray(table[:, 5]),
    )
    return Landmarks.from_points(points[point], anchors), observations


def _assumed_land(states: States, rng: np.random.Generator) -> Array:
    """(P, 3) points around the middle of the way, as many near as far on a logarithmic scale."""
    way = states.world_from_rig.translation
    reach = float(np.linalg.norm(np.ptp(way[:, :2], axis=0))) / 2
    distance = reach + np.exp(rng.uniform(np.log(_NEAREST_M), np.log(_FARTHEST_M), _POINTS))
    azimuth = rng.uniform(0, 2 * np.pi, _POINTS)
    height = rng.uniform(_LOWEST_M, _HIGHEST_M, _POINTS)
    offsets = np.stack([distance * np.cos(azimuth), distance * np.sin(azimuth), height], axis=1)
    return np.asarray((way.min(axis=0) + way.max(axis=0)) / 2 + offsets)


def _pixels(states: States, camera: BundleCamera, points: Array) -> tuple[Array, Mask]:
    """Pixels (N, P, 2) of points in every state's image, and which of them (N, P) lie inside."""
    cam_from_world = (states.world_from_rig * camera.rig_from_cam).inverse()
    points_cam = (
        np.einsum("nij,pj->npi", cam_from_world.rotation, points) + cam_from_world.translation[:, None]
    )
    pixels, valid = camera.model.project(points_cam.reshape(-1, 3))
    size = np.array([camera.model.width_px, camera.model.height_px])
    inside = valid & (pixels > 0).all(axis=1) & (pixels < size - 1).all(axis=1)
    shape = (len(states), len(points))
    return pixels.reshape(*shape, 2), inside.reshape(shape)


def _lives(valid: Mask, length: int, wanted: int, rng: np.random.Generator) -> tuple[Indices, Indices]:
    """First states and points of tracks that are seen at least `_FEWEST_VIEWS` times within `length` states."""
    n = len(valid)
    if wanted < 1 or n < _FEWEST_VIEWS:
        return np.zeros(0, np.int64), np.zeros(0, np.int64)
    first = rng.integers(0, max(n - length, 0) + 1, _POINTS)
    within = np.arange(length)[:, None] + first
    views = np.where(within < n, valid[np.minimum(within, n - 1), np.arange(_POINTS)], False).sum(axis=0)
    good = np.flatnonzero(views >= _FEWEST_VIEWS)[:wanted]
    return first[good], good


def _found_again(
    own: int,
    point: int,
    landmark: int,
    seen: list[tuple[Array, Mask]],
    std_px: float,
    rng: np.random.Generator,
) -> list[Array]:
    """A view or two of the landmark by every other camera that it passes."""
    found = []
    for index, (pixels, valid) in enumerate(seen):
        at = np.flatnonzero(valid[:, point]) if index != own else np.zeros(0, np.int64)
        if len(at):
            at = np.unique(rng.choice(at, 2))
            found.append(_rows(index, at, landmark, pixels[at, point], std_px))
    return found


def _rows(camera: int, states: Indices, landmark: int, pixels: Array, std_px: float) -> Array:
    """(n, 6): camera, state, landmark, pixel, standard deviation."""
    n = len(states)
    columns = [np.full(n, camera), states, np.full(n, landmark), *pixels.T, np.full(n, std_px)]
    return np.stack(columns, axis=1).astype(np.float64)
