"""Initial values of the rig: from one trajectory per camera, by hand-eye, gyro, accelerometer and GNSS.

One camera is the reference: its trajectory is made metric and put into the world. Hand-eye ties the others to it,
all at once; gyro and accelerometer tie it to the IMU. Any trajectories will do, whoever estimated them.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from rigwake._types import Array
from rigwake.ba.rig.rig_values import InitialRig
from rigwake.ba.solver.rig_problem import BundleCamera, CameraParameter
from rigwake.calibration import CalibratedCamera, Calibration
from rigwake.cameras.protocol import CameraModel
from rigwake.errors import RigwakeError, UnobservableError
from rigwake.geometry.se3 import SE3
from rigwake.handeye.handeye_problem import HandeyeResult
from rigwake.handeye.joint_calibration import calibrate_handeye
from rigwake.odometry.metric import metric_start
from rigwake.recording import GnssStream, ImuStream
from rigwake.trajectory import Trajectory


def initial_rig(
    trajectories: Mapping[str, Trajectory],
    models: Mapping[str, CameraModel],
    imu: ImuStream | None = None,
    gnss: GnssStream | None = None,
) -> InitialRig:
    """Initial values of the rig, whose frame is the IMU where there is one, else the reference camera.

    trajectories: `world_from_cam` by camera, up to scale or metric.

    Raises UnobservableError when no camera can lead: none can be tied to IMU or GNSS, or none has a scale.
    """
    reference_camera = _choose_reference_camera(trajectories)
    lead = _lead(trajectories[reference_camera], imu, gnss)
    result, failed = _tie_others(lead.world_from_cam, trajectories, reference_camera)
    cameras = {
        reference_camera: _camera(
            reference_camera,
            models[reference_camera],
            lead.rig_from_cam,
            lead.time_offset_s,
            held=imu is None,
        )
    }
    if result is not None:
        for name, member in result.members.items():
            rig_from_cam = lead.rig_from_cam * _without_unobservable_offset(
                member, result.ref_from_members[name]
            )
            offset_s = lead.time_offset_s + (member.time_offset_s or 0.0)
            cameras[name] = _camera(name, models[name], rig_from_cam, offset_s, held=False)
    handeye = Calibration(reference_camera, {}) if result is None else result.calibration()
    notes = lead.notes + tuple(
        f"{name}: in very many pieces; the longest were used to tie it to {reference_camera}, {left_out} poses were not"
        for name, member in handeye.cameras.items()
        if (left_out := member.statistics.get("poses_left_out", 0))
    )
    return InitialRig(
        world_from_rig=lead.world_from_rig,
        cameras={name: cameras[name] for name in trajectories if name in cameras},
        gyro_bias=lead.gyro_bias,
        accel_bias=lead.accel_bias,
        antenna_rig=np.zeros(3) if lead.antenna_rig is None else lead.antenna_rig,
        handeye=handeye,
        reference_camera=reference_camera,
        scale_source=lead.scale_source,
        failed=failed,
        notes=notes,
    )


def _without_unobservable_offset(member: CalibratedCamera, ref_from_cam: SE3) -> SE3:
    """The transform without its offset along directions that the motion left unobservable, where it is arbitrary.

    Cameras of a vessel differ by less in height than nothing would leave them, and landmarks are looked for in
    other cameras' images where the start has them.
    """
    offset = ref_from_cam.translation
    for unobservable_direction in member.unobservable:
        turn, along = unobservable_direction.direction[:3], unobservable_direction.direction[3:]
        if np.linalg.norm(along) > np.linalg.norm(turn):
            along = along / np.linalg.norm(along)
            offset = offset - (along @ offset) * along
    return SE3(ref_from_cam.rotation, offset)


def _camera(name: str, model: CameraModel, rig_from_cam: SE3, offset_s: float, *, held: bool) -> BundleCamera:
    free: frozenset[CameraParameter] = frozenset() if held else frozenset(("rig_from_cam", "time_offset"))
    return BundleCamera(name, model, rig_from_cam, offset_s, free=free)


def _choose_reference_camera(trajectories: Mapping[str, Trajectory]) -> str:
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


@dataclass(frozen=True, eq=False)
class _Lead:
    """The leading camera in metres, in the best world there is, and the rig it sits on."""

    world_from_cam: Trajectory
    world_from_rig: Trajectory
    scale_source: str
    rig_from_cam: SE3
    time_offset_s: float
    gyro_bias: Array
    accel_bias: Array
    antenna_rig: Array | None
    notes: tuple[str, ...]


def _lead(trajectory: Trajectory, imu: ImuStream | None, gnss: GnssStream | None) -> _Lead:
    if imu is not None or gnss is not None:
        found = metric_start(trajectory, imu, gnss)
        return _Lead(
            found.world_from_cam,
            found.world_from_rig,
            found.scale_source,
            found.rig_from_cam,
            found.time_offset_s,
            found.gyro_bias,
            found.accel_bias,
            found.antenna_rig,
            found.notes,
        )
    stretch = _longest_segment(trajectory)
    metric = replace(stretch, is_metric=True, covariances=None)
    source = "trajectory" if trajectory.is_metric else "none"
    nothing = np.zeros(3)
    return _Lead(metric, metric, source, SE3.identity(), 0.0, nothing, nothing, None, ())


def _tie_others(
    metric: Trajectory, trajectories: Mapping[str, Trajectory], reference_camera: str
) -> tuple[HandeyeResult | None, dict[str, str]]:
    """Joint hand-eye of all other cameras on the reference camera; those that fail alone are left out and named."""
    others = {name: t for name, t in trajectories.items() if name != reference_camera}
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
