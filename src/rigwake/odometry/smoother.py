"""One camera's metric trajectory: vision, IMU and GNSS smoothed together over the whole recording.

Calibration is not causal, so neither is this: every state is estimated from everything before and after it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from rigwake._robust import robust_std
from rigwake._types import Array, Indices
from rigwake.ba.solver.covariance import covariance_of
from rigwake.ba.solver.levenberg_marquardt import solve
from rigwake.ba.solver.parameter_layout import layout_of
from rigwake.ba.solver.rig_problem import (
    Antenna,
    BundleCamera,
    InertialStates,
    Landmarks,
    Observations,
    PoseMeasurements,
    RigProblem,
    RigSolution,
    SolverOptions,
    States,
)
from rigwake.ba.solver.state_motion import nearest_states, rig_at, seconds_since_start
from rigwake.cameras.protocol import CameraModel
from rigwake.errors import EstimationError
from rigwake.geometry.interpolate import TransformSpline
from rigwake.geometry.se3 import SE3
from rigwake.geometry.triangulation import triangulate_rays
from rigwake.odometry.gnss import CHI_SQUARE_3_999, CHI_SQUARE_3_MEDIAN
from rigwake.odometry.heading import headed
from rigwake.odometry.imu_alignment import with_noise
from rigwake.odometry.metric import MetricStart
from rigwake.odometry.result import OdometryResult
from rigwake.recording import AttitudeStream, GnssStream, ImuStream
from rigwake.tracks import Tracks
from rigwake.trajectory import Trajectory

_STATE_INTERVAL_S = 0.25  # the IMU carries the motion between states
_EDGE_NS = (
    20_000_000  # a frame this much outside the IMU's samples still becomes a state: the nearest sample serves
)
_MIN_VIEWS = 3
_MIN_LANDMARKS = 20
_GATE_STDS = 4.0
# hardly damped: what the IMU leaves weak would creep towards its place, step by step
_FINE = SolverOptions(loss="huber", tolerance=1e-6, max_iterations=30, initial_damping=1e-8)
_ROUGH = replace(_FINE, loss="cauchy", shared_tolerance=0.5)  # only outliers and the noise are taken from it
# about and along level axes: heading and position are what an IMU cannot tell, the rest is left to it
_GAUGE_STD = np.array([10.0, 10.0, 1e-4, 1e-4, 1e-4, 1e-4])


@dataclass(frozen=True, eq=False)
class SmoothedOdometry:
    """A metric trajectory and what was estimated with it.

    trajectory: `world_from_cam`, camera clock, of every frame in the time of the states, with covariances of the
    poses (those of the nearest state). rig_from_cam, time_offset_s, gyro_bias, accel_bias (mean over the
    recording), antenna_rig: at the optimum. noise_factor: how much larger residuals are than the tracks assumed.
    gnss_gated: fixes that the smoothed path refused. bridged: frames without a visual pose that the IMU carried
    over. solution: the adjusted problem.
    """

    trajectory: Trajectory
    rig_from_cam: SE3
    time_offset_s: float
    gyro_bias: Array | None
    accel_bias: Array | None
    antenna_rig: Array | None
    noise_factor: float
    gnss_gated: int
    bridged: int
    solution: RigSolution


def smooth(
    tracks: Tracks,
    camera: CameraModel,
    visual: OdometryResult,
    start: MetricStart,
    imu: ImuStream | None = None,
    gnss: GnssStream | None = None,
    attitude: AttitudeStream | None = None,
) -> SmoothedOdometry:
    """Adjust states, landmarks, mounting, time offset and biases of a single-camera rig together.

    start: from `metric_start` of the same streams. attitude: of the IMU's axes; gives the world its heading, and holds
    it, where GNSS does not (see `heading.py`). Observations: inliers of the visual odometry at the states'
    frames. With an IMU there are four states per second and the camera's `rig_from_cam` and time offset are free;
    without, a state per frame and the rig is the camera. Two rounds, between which outliers go and the noise of
    the pixels is set to what the residuals show.

    Raises EstimationError if too few landmarks are seen or the bundle adjustment does not succeed.
    """
    noisy_imu = with_noise(imu) if imu is not None else None
    if gnss is not None or imu is None:
        attitude = None
    if attitude is not None:
        start = headed(start, attitude)
    problem = _problem(tracks, camera, visual, start, noisy_imu, gnss, attitude)
    rough = solve(problem, _ROUGH)
    weighted, noise_factor = _reweighted(rough)
    weighted, gated = _gated(weighted)
    solution = solve(weighted, _FINE)
    trajectory, bridged = _every_frame(tracks, visual, solution)
    values = solution.problem.states.inertial
    seen_by = solution.problem.cameras[0]
    return SmoothedOdometry(
        trajectory,
        seen_by.rig_from_cam,
        seen_by.time_offset_s,
        values.gyro_bias.mean(axis=0) if values is not None else None,
        values.accel_bias.mean(axis=0) if values is not None else None,
        solution.problem.antenna.position_rig if gnss is not None else None,
        noise_factor,
        gated,
        bridged,
        solution,
    )


def _problem(
    tracks: Tracks,
    camera: CameraModel,
    visual: OdometryResult,
    start: MetricStart,
    imu: ImuStream | None,
    gnss: GnssStream | None,
    attitude: AttitudeStream | None,
) -> RigProblem:
    chosen = _state_rows(start.world_from_cam, start.time_offset_s, imu)
    cam_stamps = start.world_from_cam.timestamps_ns[chosen]
    rig_poses = start.world_from_rig.world_from_body[chosen]
    rig_stamps = cam_stamps + round(start.time_offset_s * 1e9)
    observations, landmarks = _landmarks(tracks, visual, start.world_from_cam, cam_stamps)
    inertial = None
    if imu is not None:
        velocity = TransformSpline(rig_stamps, rig_poses).velocity_world(rig_stamps)
        n = len(chosen)
        inertial = InertialStates(
            velocity, np.tile(start.gyro_bias, (n, 1)), np.tile(start.accel_bias, (n, 1))
        )
    lens = BundleCamera(
        tracks.camera,
        camera,
        start.rig_from_cam,
        start.time_offset_s,
        free=frozenset(("rig_from_cam", "time_offset")) if imu is not None else frozenset(),
    )
    with_gnss = start.world == "enu" and gnss is not None and start.gnss_used is not None
    return RigProblem(
        States(rig_stamps, rig_poses, inertial),
        (lens,),
        landmarks,
        observations,
        imu=imu,
        gnss=_chosen_fixes(gnss, start.gnss_used) if with_gnss else None,
        antenna=Antenna(start.antenna_rig if start.antenna_rig is not None else np.zeros(3), free=with_gnss),
        attitude=attitude,
        poses=None if with_gnss else _level_gauge(rig_poses[0], holds_heading=attitude is None),
    )


def _state_rows(trajectory: Trajectory, offset_s: float, imu: ImuStream | None) -> Indices:
    """Poses that become states: every one without an IMU, else those nearest to a regular grid it covers."""
    if imu is None:
        return np.arange(len(trajectory))
    on_rig = trajectory.timestamps_ns + round(offset_s * 1e9)
    covered = (on_rig >= imu.timestamps_ns[0] - _EDGE_NS) & (on_rig <= imu.timestamps_ns[-1] + _EDGE_NS)
    inside = np.flatnonzero(covered)
    if len(inside) < 2:
        raise EstimationError(
            f"{trajectory.name} and {imu.name} share no time.", remedy="Check their clocks."
        )
    slots = (on_rig[inside] - on_rig[inside[0]]) // round(_STATE_INTERVAL_S * 1e9)
    _, first = np.unique(slots, return_index=True)
    return np.union1d(inside[first], inside[-1:])


def _landmarks(
    tracks: Tracks, visual: OdometryResult, world_from_cam: Trajectory, cam_stamps: Indices
) -> tuple[Observations, Landmarks]:
    """Inliers at the states' frames, and their points triangulated from the metric poses."""
    stamps = tracks.timestamps_ns[tracks.frame_indices]
    rows = np.flatnonzero(visual.inliers & np.isin(stamps, cam_stamps))
    _, landmark, counts = np.unique(tracks.track_ids[rows], return_inverse=True, return_counts=True)
    rows = rows[counts[landmark] >= _MIN_VIEWS]
    rows = rows[np.lexsort((tracks.frame_indices[rows], tracks.track_ids[rows]))]
    ids, landmark = np.unique(tracks.track_ids[rows], return_inverse=True)
    poses = world_from_cam.world_from_body[np.searchsorted(world_from_cam.timestamps_ns, stamps[rows])]
    directions = np.einsum("nij,nj->ni", poses.rotation, tracks.bearings_cam[rows])
    starts = np.searchsorted(landmark, np.arange(len(ids) + 1))
    found = triangulate_rays(poses.translation, directions, starts)
    anchors, bearings = poses.translation[starts[:-1]], directions[starts[:-1]]
    ranges = np.einsum("ni,ni->n", found.points - anchors, bearings)
    good = found.ahead & np.isfinite(ranges) & (ranges > 0)
    if good.sum() < _MIN_LANDMARKS:
        raise EstimationError(
            f"{tracks.camera}: only {int(good.sum())} landmarks are seen often enough to adjust its motion.",
            remedy="Check masks, exposure and texture; raise max_features.",
        )
    kept = good[landmark]
    number = np.cumsum(good) - 1
    observations = Observations(
        np.zeros(int(kept.sum()), dtype=np.int64),
        stamps[rows][kept],
        number[landmark[kept]],
        tracks.pixels[rows][kept],
        tracks.std_px[rows][kept],
    )
    return observations, Landmarks(anchors[good], bearings[good], 1 / ranges[good])


def _chosen_fixes(gnss: GnssStream | None, used: Array | None) -> GnssStream | None:
    """The fixes that passed the gate."""
    if gnss is None or used is None:
        return gnss
    return replace(
        gnss,
        timestamps_ns=gnss.timestamps_ns[used],
        position_enu=gnss.position_enu[used],
        covariances=gnss.covariances[used],
        velocity_enu=None if gnss.velocity_enu is None else gnss.velocity_enu[used],
    )


def _level_gauge(first: SE3, *, holds_heading: bool) -> PoseMeasurements:
    """Holds position and, unless something measures it, heading of the first state."""
    std = _GAUGE_STD.copy()
    if not holds_heading:
        std[2] = std[0]
    return PoseMeasurements.of_first_state(first, std)


def _reweighted(rough: RigSolution) -> tuple[RigProblem, float]:
    """Without observations beyond the gate, and with pixel noise as large as the residuals show."""
    observations = rough.problem.observations
    whitened = rough.residuals_px / observations.std_px[:, None]
    valid = np.isfinite(whitened).all(axis=1)
    factor = max(robust_std(whitened[valid]), 1e-3)
    kept = valid & (np.linalg.norm(np.nan_to_num(whitened), axis=1) <= _GATE_STDS * factor)
    counts = np.bincount(observations.landmark_indices[kept], minlength=len(rough.problem.landmarks))
    kept &= counts[observations.landmark_indices] >= _MIN_VIEWS
    used, renumbered = np.unique(observations.landmark_indices[kept], return_inverse=True)
    left = observations.take(kept)
    left = replace(left, landmark_indices=renumbered.astype(np.int64), std_px=left.std_px * factor)
    return replace(rough.problem, observations=left, landmarks=rough.problem.landmarks.take(used)), factor


def _gated(problem: RigProblem) -> tuple[RigProblem, int]:
    """Without the fixes that the smoothed path contradicts beyond the chi-square gate, and how many those are."""
    gnss = problem.gnss
    if gnss is None:
        return problem, 0
    times = seconds_since_start(problem, gnss.timestamps_ns)
    inside = (times >= 0) & (gnss.timestamps_ns <= problem.states.timestamps_ns[-1])
    rig = rig_at(
        problem, layout_of(problem), times[inside], nearest_states(problem, times[inside]), moving=True
    )
    antennas = rig.world_from_body * np.tile(problem.antenna.position_rig, (int(inside.sum()), 1))
    error = antennas - gnss.position_enu[inside]
    squares = np.einsum("ni,nij,nj->n", error, np.linalg.inv(gnss.covariances[inside]), error)
    spread = max(float(np.median(squares)) / CHI_SQUARE_3_MEDIAN, 1.0)  # receivers are optimistic, too
    kept = inside.copy()
    kept[inside] = squares <= CHI_SQUARE_3_999 * spread
    return replace(problem, gnss=_chosen_fixes(gnss, kept)), int(inside.sum() - kept.sum())


def _every_frame(tracks: Tracks, visual: OdometryResult, solution: RigSolution) -> tuple[Trajectory, int]:
    """The camera at every frame between the first and the last state, carried there from the nearest state."""
    problem = solution.problem
    seen_by = problem.cameras[0]
    on_rig = tracks.timestamps_ns + round(seen_by.time_offset_s * 1e9)
    slack = 1_000_000  # the time offset has moved a little since states were put on frames
    states_ns = problem.states.timestamps_ns
    inside = (on_rig >= states_ns[0] - slack) & (on_rig <= states_ns[-1] + slack)
    if problem.imu is None:  # nothing carries the motion between states
        inside &= np.isin(tracks.timestamps_ns, visual.trajectory.timestamps_ns)
    frames = np.flatnonzero(inside)
    times = seconds_since_start(problem, on_rig[frames])
    nearest = nearest_states(problem, times)
    rig = rig_at(problem, layout_of(problem), times, nearest, moving=problem.imu is not None)
    marginal = covariance_of(problem, _FINE, states=True).state_covariances
    covariances = None
    if marginal is not None:
        adjoint = seen_by.rig_from_cam.inverse().adjoint()
        covariances = (adjoint @ marginal[:, :6, :6] @ adjoint.T)[nearest]
    trajectory = Trajectory(
        tracks.camera,
        tracks.timestamps_ns[frames],
        rig.world_from_body * seen_by.rig_from_cam,
        covariances,
        covariance_kind="poses",
    )
    return trajectory, int((~np.isin(frames, visual.frame_indices)).sum())
