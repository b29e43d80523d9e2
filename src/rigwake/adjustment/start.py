"""First values of the rig: from one trajectory per camera, by hand-eye, gyro, accelerometer and GNSS.

One camera leads: its trajectory is made metric and put into the world. Hand-eye ties the others to it, all at once;
gyro and accelerometer tie it to the IMU. Any trajectories will do, whoever estimated them.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from rigwake.adjustment.values import RigStart
from rigwake.bundle.problem import BundleCamera, CameraParameter
from rigwake.calibration import Calibration
from rigwake.cameras.base import CameraModel
from rigwake.errors import RigwakeError, UnobservableError
from rigwake.geometry.align import Alignment
from rigwake.geometry.se3 import SE3
from rigwake.geometry.so3 import Array
from rigwake.handeye.calibrate import calibrate_handeye
from rigwake.handeye.values import HandeyeResult
from rigwake.odometry.gnss import GnssAlignment, align_gnss, in_enu
from rigwake.odometry.gyro import GyroAlignment, align_gyro
from rigwake.odometry.inertial import InertialAlignment, align_inertial
from rigwake.recording import GnssStream, ImuStream
from rigwake.trajectory import Trajectory


@dataclass(frozen=True, eq=False)
class FirstRig:
    """First values, and how they came about.

    start: for `assemble_problem`. handeye: the cameras on the leading one, before any adjustment.
    leader: its name. scale_source: `gnss`, `imu`, `trajectory`, or `none` (everything is up to scale).
    failed: cameras that could not be tied to the leading one, with the reason. notes: in words.
    """

    start: RigStart
    handeye: Calibration
    leader: str
    scale_source: str
    failed: Mapping[str, str] = field(default_factory=dict)
    notes: tuple[str, ...] = ()


def first_rig(
    trajectories: Mapping[str, Trajectory],
    models: Mapping[str, CameraModel],
    imu: ImuStream | None = None,
    gnss: GnssStream | None = None,
    *,
    first_offsets_s: Mapping[str, float] | None = None,
) -> FirstRig:
    """First values of the rig, whose frame is the IMU where there is one, else the leading camera.

    trajectories: `world_from_cam` by camera, up to scale or metric. first_offsets_s: guesses of the clocks.
    Raises UnobservableError when no camera can lead: none can be tied to IMU or GNSS, or none has a scale.
    """
    leader = _choose_leader(trajectories)
    trajectory = _longest_segment(trajectories[leader])
    guesses = dict(first_offsets_s or {})
    gyro = None if imu is None else align_gyro(trajectory, imu, time_offset_s=guesses.get(leader))
    metric, antenna_cam, scale_source, inertial = _make_metric(trajectory, imu, gnss, gyro)
    result, failed = _tie_others(metric, trajectories, leader)
    rig_from_leader = _imu_from_leader(gyro, inertial)
    offset_s = 0.0 if gyro is None else gyro.time_offset_s
    cameras = {leader: _camera(leader, models[leader], rig_from_leader, offset_s, held=imu is None)}
    for name, member in result.members.items() if result is not None else ():
        assert result is not None
        rig_from_cam = rig_from_leader * result.ref_from_members[name]
        own = offset_s + (member.time_offset_s or 0.0)
        cameras[name] = _camera(name, models[name], rig_from_cam, own, held=False)
    in_order = {name: cameras[name] for name in trajectories if name in cameras}
    start = RigStart(
        world_from_rig=_of_rig(metric, rig_from_leader, offset_s, "leader" if imu is None else "imu"),
        cameras=in_order,
        gyro_bias=np.zeros(3) if gyro is None else gyro.gyro_bias,
        accel_bias=np.zeros(3) if inertial is None else inertial.accel_bias,
        antenna_rig=np.zeros(3) if antenna_cam is None else rig_from_leader * antenna_cam,
    )
    handeye = Calibration(leader, {}) if result is None else result.calibration()
    return FirstRig(start, handeye, leader, scale_source, failed)


def _camera(name: str, model: CameraModel, rig_from_cam: SE3, offset_s: float, *, held: bool) -> BundleCamera:
    free: frozenset[CameraParameter] = frozenset() if held else frozenset(("rig_from_cam", "time_offset"))
    return BundleCamera(name, model, rig_from_cam, offset_s, free=free)


def _choose_leader(trajectories: Mapping[str, Trajectory]) -> str:
    """The camera whose longest unbroken stretch lasts longest, a metric one before any other."""
    if not trajectories:
        raise UnobservableError(
            "No camera has a trajectory.", remedy="Look at the odometry's messages, or give --trajectories."
        )
    return max(
        trajectories,
        key=lambda name: (
            trajectories[name].is_metric,
            _longest_segment(trajectories[name]).duration_s,
            trajectories[name].path_length,
        ),
    )


def _longest_segment(trajectory: Trajectory) -> Trajectory:
    assert trajectory.segment_ids is not None
    segments = [
        trajectory.take(np.flatnonzero(trajectory.segment_ids == segment))
        for segment in np.unique(trajectory.segment_ids)
    ]
    return max(segments, key=lambda segment: segment.duration_s)


def _make_metric(
    trajectory: Trajectory, imu: ImuStream | None, gnss: GnssStream | None, gyro: GyroAlignment | None
) -> tuple[Trajectory, Array | None, str, InertialAlignment | None]:
    """The leader in metres and in the best world there is; the antenna in its frame; where the scale is from."""
    located: GnssAlignment | None = None
    if gnss is not None:
        located = align_gnss(trajectory, gnss, time_offset_s=0.0 if gyro is None else gyro.time_offset_s)
        trajectory = in_enu(trajectory, located)
    inertial = None
    if imu is not None and gyro is not None:
        inertial = align_inertial(trajectory, imu, gyro, scale=1.0 if trajectory.is_metric else None)
        if located is None:
            trajectory = _levelled(trajectory, inertial)
    if located is not None:
        return trajectory, located.antenna_cam, "gnss", inertial
    source = "imu" if inertial is not None else "trajectory" if trajectory.is_metric else "none"
    return replace(trajectory, is_metric=True, covariances=None), None, source, inertial


def _levelled(trajectory: Trajectory, inertial: InertialAlignment) -> Trajectory:
    """In metres, with gravity downwards; the heading stays as it is."""
    up = -inertial.gravity_visual / np.linalg.norm(inertial.gravity_visual)
    axis, cosine = np.cross(up, [0.0, 0.0, 1.0]), float(up[2])
    sine = float(np.linalg.norm(axis))
    axis = axis / sine if sine > 1e-9 else np.array([1.0, 0.0, 0.0])
    turn = SE3.exp(np.concatenate([axis * np.arctan2(sine, cosine), np.zeros(3)]))
    levelled = Alignment(turn, inertial.scale).apply(trajectory.world_from_body)
    return replace(trajectory, world_from_body=levelled, is_metric=True, covariances=None)


def _tie_others(
    metric: Trajectory, trajectories: Mapping[str, Trajectory], leader: str
) -> tuple[HandeyeResult | None, dict[str, str]]:
    """Joint hand-eye of all other cameras on the leader; those that fail alone are left out and named."""
    others = {name: t for name, t in trajectories.items() if name != leader}
    failed: dict[str, str] = {}
    if not others:
        return None, failed
    try:
        return calibrate_handeye(metric, list(others.values())), failed
    except RigwakeError as error:
        if len(others) == 1:
            return None, {name: str(error) for name in others}
    good = []
    for name, trajectory in others.items():
        try:
            calibrate_handeye(metric, [trajectory])
        except RigwakeError as error:
            failed[name] = str(error)
        else:
            good.append(trajectory)
    return (calibrate_handeye(metric, good) if good else None), failed


def _imu_from_leader(gyro: GyroAlignment | None, inertial: InertialAlignment | None) -> SE3:
    if gyro is None:
        return SE3.identity()
    lever = np.zeros(3) if inertial is None else inertial.imu_cam
    return SE3(gyro.imu_from_cam, -gyro.imu_from_cam @ lever)


def _of_rig(leader: Trajectory, rig_from_leader: SE3, offset_s: float, name: str) -> Trajectory:
    """`world_from_rig` on the rig's clock."""
    return replace(
        leader,
        name=leader.name if name == "leader" else name,
        timestamps_ns=leader.timestamps_ns + round(offset_s * 1e9),
        world_from_body=leader.world_from_body * rig_from_leader.inverse(),
        covariances=None,
    )
