"""Level frame, attitude over time, and height above the water.

The level frame has its origin in the viewpoint (the mean of the cameras' positions), z up, x ahead and horizontal,
y to port. Azimuths are relative bearings: 0 ahead, positive to starboard. Elevations are positive above the horizon.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from scipy.ndimage import uniform_filter1d

from rigwake._types import Array, Stamps
from rigwake.errors import InputError
from rigwake.geometry import so3
from rigwake.geometry.interpolate import interpolate
from rigwake.geometry.se3 import SE3
from rigwake.odometry.gyro import integrate_gyro
from rigwake.recording import AttitudeStream, ImuStream
from rigwake.trajectory import Trajectory
from rigwake.views.surround_rig import SurroundRig

_IMU_TILT_STD = np.deg2rad(0.7)  # accelerations of a vessel that turns do not cancel altogether
_TRAJECTORY_TILT_STD = np.deg2rad(0.05)
_SENSOR_TILT_STD = np.deg2rad(0.3)
_UP_WINDOW_S = (
    40.0  # a boat that circles at 2 m/s moves the mean force over so long by half a degree at the most
)
_CHUNK_S = 120.0  # the gyro's bias is constant over so long
_WINDOW_S = 4.0  # waves cancel in the mean specific force over so long
_FORCE_STD = 0.3  # m/s^2, of that mean, from accelerations of the vessel
_BIAS_STD = 0.01  # rad/s, before anything is known
_STEEPEST_AHEAD = 0.95  # sine of the elevation beyond which a direction cannot serve as "ahead"


@dataclass(frozen=True, eq=False)
class LevelAttitude:
    """How the rig stands at one time.

    level_from_rig: (3, 3) rotation from rig axes to the level frame. tilt_std: of roll and pitch each, radians.
    height_m, height_std_m: of the viewpoint above the mean water; NaN where unknown. source: where the tilt comes from
    (`trajectory`, `attitude`, `imu`, `horizon`, `none`).
    """

    level_from_rig: Array
    height_m: float = np.nan
    tilt_std: float = 0.0
    height_std_m: float = 0.0
    source: str = "none"

    @property
    def roll_pitch(self) -> tuple[float, float]:
        """Roll (starboard down positive) and pitch (bow down positive), radians."""
        R = self.level_from_rig
        return float(np.arctan2(R[2, 1], R[2, 2])), float(np.arcsin(np.clip(-R[2, 0], -1.0, 1.0)))


@dataclass(frozen=True, eq=False)
class AttitudeTrack:
    """Attitudes over time.

    timestamps_ns: (N,) strictly increasing, rig clock. level_from_rig: (N, 3, 3). heave_m: (N,) of the viewpoint about
    its mean height. height_m, height_std_m: that mean height; NaN where unknown. source, tilt_std: see
    `LevelAttitude`. world_from_rig: where it comes from, if from a trajectory.
    """

    timestamps_ns: Stamps
    level_from_rig: Array
    source: str
    tilt_std: float
    heave_m: Array
    height_m: float = np.nan
    height_std_m: float = 0.0
    world_from_rig: Trajectory | None = None

    def moved(self, then_ns: int, now_ns: int) -> SE3 | None:
        """`rig_from_rig` from the axes of then to those of now, metres; None where the way is not known."""
        way = self.world_from_rig
        if way is None or not way.is_metric:
            return None
        if not way.timestamps_ns[0] <= min(then_ns, now_ns) <= max(then_ns, now_ns) <= way.timestamps_ns[-1]:
            return None
        assert way.segment_ids is not None
        first, last = np.searchsorted(way.timestamps_ns, sorted((then_ns, now_ns)), side="right") - 1
        if way.segment_ids[first] != way.segment_ids[min(last + 1, len(way) - 1)]:
            return None  # odometry broke in between
        poses = interpolate(way.timestamps_ns, way.world_from_body, np.array([then_ns, now_ns]))
        return poses[1].inverse() * poses[0]

    def at(self, timestamp_ns: int) -> LevelAttitude:
        """The attitude at a time, by SLERP between neighbours; the nearest one beyond the ends."""
        stamps = self.timestamps_ns
        R, heave = self.level_from_rig[0], float(self.heave_m[0])
        if len(stamps) > 1:
            before = int(np.clip(np.searchsorted(stamps, timestamp_ns, side="right") - 1, 0, len(stamps) - 2))
            gap = float(stamps[before + 1] - stamps[before])
            fraction = float(np.clip(float(timestamp_ns - stamps[before]) / gap, 0.0, 1.0))
            first, second = self.level_from_rig[before], self.level_from_rig[before + 1]
            R = first @ so3.exp(fraction * so3.log(first.T @ second))
            heave = float((1 - fraction) * self.heave_m[before] + fraction * self.heave_m[before + 1])
        return LevelAttitude(R, self.height_m + heave, self.tilt_std, self.height_std_m, self.source)

    def covers(self, timestamp_ns: int, slack_s: float = 0.5) -> bool:
        """Whether a time lies within the track, or at most `slack_s` outside."""
        slack = round(slack_s * 1e9)
        return bool(self.timestamps_ns[0] - slack <= timestamp_ns <= self.timestamps_ns[-1] + slack)

    def with_height(self, height_m: float, height_std_m: float) -> AttitudeTrack:
        """The same track at a known mean height of the viewpoint above the water."""
        return replace(self, height_m=height_m, height_std_m=height_std_m)


def level_rotation(up_rig: Array, forward_rig: Array) -> Array:
    """(..., 3, 3) `level_from_rig` from the direction against gravity (..., 3) and the direction ahead (3,), rig axes.

    Raises InputError if "ahead" is nearly vertical.
    """
    up = np.asarray(up_rig, dtype=np.float64)
    up = up / np.linalg.norm(up, axis=-1, keepdims=True)
    ahead = np.broadcast_to(forward_rig, up.shape)
    along = np.sum(ahead * up, axis=-1, keepdims=True)
    if not np.all(np.abs(along) < _STEEPEST_AHEAD):
        raise InputError(
            "The direction ahead is nearly vertical in the rig frame.",
            consequence="No view can be levelled.",
            remedy="Calibrate with --reference imu or base_link, whose x axis points to the bow.",
        )
    x = ahead - along * up
    x = x / np.linalg.norm(x, axis=-1, keepdims=True)
    return np.stack([x, np.cross(up, x), up], axis=-2)


def unlevelled(rig: SurroundRig, height_m: float = np.nan, height_std_m: float = 0.0) -> LevelAttitude:
    """The attitude when nothing tells it: up is the rig's z axis, or against the rig's y if its frame is a camera's."""
    up = np.array([0.0, 0.0, 1.0])
    if abs(float(rig.forward_rig @ up)) >= _STEEPEST_AHEAD:
        up = np.array([0.0, -1.0, 0.0])
    return LevelAttitude(
        level_rotation(up, rig.forward_rig), height_m, np.deg2rad(5.0), height_std_m, source="none"
    )


def track_from_trajectory(world_from_rig: Trajectory, rig: SurroundRig) -> AttitudeTrack:
    """LevelAttitude and heave from poses of the rig in a world with z up (`OUT/trajectories/rig.tum`)."""
    R = world_from_rig.world_from_body.rotation
    height = (world_from_rig.world_from_body * rig.viewpoint_rig)[:, 2]
    heave = height - np.median(height) if world_from_rig.is_metric else np.zeros(len(height))
    return AttitudeTrack(
        world_from_rig.timestamps_ns,
        level_rotation(R[:, 2, :], rig.forward_rig),
        "trajectory",
        _TRAJECTORY_TILT_STD,
        heave,
        world_from_rig=world_from_rig,
    )


def track_from_sensor(stream: AttitudeStream, rig_from_body: SE3, rig: SurroundRig) -> AttitudeTrack:
    """LevelAttitude from a sensor that gives roll and pitch itself. rig_from_body: how its axes sit in the rig."""
    up_rig = stream.world_from_body[:, 2, :] @ rig_from_body.rotation.T
    return AttitudeTrack(
        stream.timestamps_ns,
        level_rotation(up_rig, rig.forward_rig),
        "attitude",
        _SENSOR_TILT_STD,
        np.zeros(len(up_rig)),
    )


def track_from_imu(imu: ImuStream, rig_from_imu: SE3, rig: SurroundRig) -> AttitudeTrack:
    """LevelAttitude from the integrated gyro and the mean specific force; good to about half a degree.

    Raises InputError if the IMU has fewer than 20 samples.
    """
    if len(imu.timestamps_ns) < 20:
        raise InputError(f"{imu.name} has only {len(imu.timestamps_ns)} samples: no attitude.")
    up_rig = _up_imu(imu, gyro_bias(imu)) @ rig_from_imu.rotation.T
    return AttitudeTrack(
        imu.timestamps_ns,
        level_rotation(up_rig, rig.forward_rig),
        "imu",
        _IMU_TILT_STD,
        np.zeros(len(up_rig)),
    )


def _up_imu(imu: ImuStream, bias: Array) -> Array:
    """(N, 3) directions against gravity, IMU axes: the specific force, turned into the axes of the start by the gyro,
    averaged over a window that is cut off at the ends of the recording."""
    turned = integrate_gyro(imu, bias).rotation
    total = np.cumsum(np.einsum("nij,nj->ni", turned, imu.accel), axis=0)
    total = np.vstack([np.zeros(3), total])
    half = max(int(0.5 * _UP_WINDOW_S * 1e9 / float(np.median(np.diff(imu.timestamps_ns)))), 1)
    at = np.arange(len(turned))
    force = total[np.minimum(at + half + 1, len(turned))] - total[np.maximum(at - half, 0)]
    up = np.einsum("nji,nj->ni", turned, force)
    return np.asarray(up / np.linalg.norm(up, axis=1, keepdims=True))


def gyro_bias(imu: ImuStream) -> Array:
    """(3,) bias of the gyro, rad/s: with it, the specific force turned by the gyro keeps pointing one way.

    Least squares over chunks of two minutes (median of the chunks), with a prior of 0.01 rad/s; the component along
    gravity stays near zero, since nothing shows it and levelling does not need it.
    """
    stamps = imu.timestamps_ns
    count = max(int((stamps[-1] - stamps[0]) * 1e-9 // _CHUNK_S), 1)
    bounds = np.linspace(0, len(stamps), count + 1).astype(int)
    chunks = [slice(a, b) for a, b in pairwise(bounds.tolist())]
    found = [
        _bias_of_chunk(replace(imu, timestamps_ns=stamps[c], gyro=imu.gyro[c], accel=imu.accel[c]))
        for c in chunks
    ]
    return np.asarray(np.median(found, axis=0))


def _bias_of_chunk(imu: ImuStream) -> Array:
    rate_hz = 1e9 / float(np.median(np.diff(imu.timestamps_ns)))
    window = max(int(_WINDOW_S * rate_hz), 1)
    at = np.arange(window // 2, len(imu.timestamps_ns), window)

    def mean_force(bias: Array) -> Array:
        turned = integrate_gyro(imu, bias).rotation
        force = uniform_filter1d(np.einsum("nij,nj->ni", turned, imu.accel), window, axis=0, mode="nearest")
        return np.asarray(force[at])

    bias = np.zeros(3)
    for _ in range(4):
        force = mean_force(bias)
        columns = [
            (mean_force(bias + 1e-4 * axis) - mean_force(bias - 1e-4 * axis)) / 2e-4 for axis in np.eye(3)
        ]
        J = np.stack(columns, axis=-1)
        # the constant force itself is eliminated: its estimate is the mean
        J, error = J - J.mean(axis=0), force - force.mean(axis=0)
        weights = 1 / (1 + (np.linalg.norm(error, axis=1) / (2 * _FORCE_STD)) ** 2) / _FORCE_STD**2
        information = np.einsum("nir,n,nis->rs", J, weights, J) + np.eye(3) / _BIAS_STD**2
        gradient = np.einsum("nir,n,ni->r", J, weights, error) + bias / _BIAS_STD**2
        bias = bias - np.linalg.solve(information, gradient)
    return bias
