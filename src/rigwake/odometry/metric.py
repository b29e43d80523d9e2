"""From one camera's motion up to scale to metres: initial values from GNSS and IMU for a camera and for its rig."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np

from rigwake._types import Array
from rigwake.errors import UnobservableError, UsageError
from rigwake.geometry import so3
from rigwake.geometry.align import Alignment
from rigwake.geometry.se3 import SE3
from rigwake.odometry.gnss import GnssAlignment, align_gnss
from rigwake.odometry.gyro import GyroAlignment, align_gyro
from rigwake.odometry.imu_alignment import InertialAlignment, align_inertial
from rigwake.recording import GnssStream, ImuStream
from rigwake.trajectory import Trajectory

_FEW = 3  # segments that are worth a line each
_UP = np.array([0.0, 0.0, 1.0])


@dataclass(frozen=True, eq=False)
class MetricStart:
    """Initial values of a camera and the rig it sits on, good enough to start an adjustment.

    world_from_cam: metric, camera clock. world: `enu` (GNSS), or `level` (IMU alone: z up, heading arbitrary).
    scale_source: which sensor gave metres. rig_from_cam: rig axes and origin are the IMU's; identity without one.
    time_offset_s: `t_rig = t_cam + time_offset_s`.
    gyro_bias, accel_bias: (3,) rig axes. antenna_rig, antenna_std: (3,) or None without GNSS.
    gnss_used: (G,) fixes that passed the chi-square gate, None without GNSS. notes: what was left out or bridged.
    """

    world_from_cam: Trajectory
    world: Literal["enu", "level"]
    scale_source: Literal["gnss", "imu"]
    rig_from_cam: SE3
    time_offset_s: float
    gyro_bias: Array
    accel_bias: Array
    antenna_rig: Array | None
    antenna_std: Array | None
    gnss_used: Array | None
    notes: tuple[str, ...] = ()

    @property
    def world_from_rig(self) -> Trajectory:
        """The rig's motion on the rig's clock."""
        shifted = self.world_from_cam.timestamps_ns + round(self.time_offset_s * 1e9)
        return replace(
            self.world_from_cam,
            name="rig",
            timestamps_ns=shifted,
            world_from_body=self.world_from_cam.world_from_body * self.rig_from_cam.inverse(),
            covariances=None,
        )


def metric_start(
    trajectory: Trajectory,
    imu: ImuStream | None = None,
    gnss: GnssStream | None = None,
    *,
    time_offset_s: float | None = None,
) -> MetricStart:
    """Scale, world, mounting, lever arms, time offset and biases from one camera's visual trajectory.

    trajectory: `world_from_cam` up to scale, with segments. The gyroscope gives rotation and clock; GNSS the scale,
    the world and the antenna; the accelerometer the lever arm, its bias and, without GNSS, scale and gravity.
    imu: its axes are those of the rig. time_offset_s: known time offset of the camera, else estimated.

    Raises UsageError without IMU and GNSS; UnobservableError if neither determines the scale.
    """
    if imu is None and gnss is None:
        raise UsageError(
            "A metric trajectory needs an IMU or GNSS.", remedy="Without them it stays up to scale."
        )
    notes: list[str] = []
    gyro = align_gyro(trajectory, imu, time_offset_s=time_offset_s) if imu is not None else None
    offset_s = gyro.time_offset_s if gyro is not None else (time_offset_s or 0.0)
    pieces = _segments(trajectory)
    main = int(np.argmax([len(piece) for piece in pieces]))
    by_gnss = _try_gnss(pieces[main], gnss, offset_s, imu is None, notes) if gnss is not None else None
    inertial = None
    if imu is not None and gyro is not None:
        scale = by_gnss.enu_from_visual.scale if by_gnss is not None else None
        inertial = align_inertial(pieces[main], imu, gyro, scale=scale)
    if by_gnss is not None and gnss is not None:
        placed, used = _all_by_gnss(pieces, main, by_gnss, gnss, offset_s, notes)
    else:
        assert inertial is not None
        assert imu is not None
        assert gyro is not None
        placed, used = _all_by_imu(pieces, main, inertial, imu, gyro, notes), None
    rig = _rig(gyro, inertial, by_gnss)
    return MetricStart(
        _joined(placed),
        "enu" if by_gnss is not None else "level",
        "gnss" if by_gnss is not None else "imu",
        rig.rig_from_cam,
        offset_s,
        gyro.gyro_bias if gyro is not None else np.zeros(3),
        inertial.accel_bias if inertial is not None else np.zeros(3),
        rig.antenna,
        rig.antenna_std,
        used,
        tuple(notes),
    )


def _segments(trajectory: Trajectory) -> list[Trajectory]:
    ids = trajectory.segment_ids
    assert ids is not None
    return [trajectory.take(ids == segment) for segment in np.unique(ids)]


def _try_gnss(
    piece: Trajectory, gnss: GnssStream, offset_s: float, must: bool, notes: list[str]
) -> GnssAlignment | None:
    try:
        return align_gnss(piece, gnss, time_offset_s=offset_s)
    except UnobservableError as error:
        if must:
            raise
        notes.append(f"GNSS not used: {error.cause}")
        return None


def _all_by_gnss(
    pieces: list[Trajectory],
    main: int,
    found: GnssAlignment,
    gnss: GnssStream,
    offset_s: float,
    notes: list[str],
) -> tuple[list[Trajectory], Array]:
    """Every segment placed by its own fixes, with the antenna where the longest segment found it."""
    placed, used, gated = [], np.zeros(len(gnss.timestamps_ns), dtype=bool), 0
    left_out: list[tuple[float, str]] = []
    for number, piece in enumerate(pieces):
        alignment = found
        if number != main:
            try:
                alignment = align_gnss(piece, gnss, time_offset_s=offset_s, antenna_cam=found.antenna_cam)
            except UnobservableError as error:
                left_out.append((piece.duration_s, error.cause))
                continue
        placed.append(_metric(piece, alignment.enu_from_visual))
        used |= alignment.used
        gated += alignment.gated
    notes += _left_out_notes(left_out)
    if gated:
        notes.append(f"{gated} GNSS fixes were refused by the chi-square gate")
    return placed, used


def _all_by_imu(
    pieces: list[Trajectory],
    main: int,
    inertial: InertialAlignment,
    imu: ImuStream,
    gyro: GyroAlignment,
    notes: list[str],
) -> list[Trajectory]:
    """The longest segment, level and in metres; without GNSS nothing says where the others are."""
    others = [piece for number, piece in enumerate(pieces) if number != main]
    notes += _left_out_notes([(p.duration_s, "without GNSS its place is unknown") for p in others])
    down = inertial.gravity_visual / np.linalg.norm(inertial.gravity_visual)
    level_from_visual = _rotation_onto(-down, _UP)
    origin = -inertial.scale * level_from_visual @ pieces[main].world_from_body.translation[0]
    return [_metric(pieces[main], Alignment(SE3(level_from_visual, origin), inertial.scale))]


def _left_out_notes(left_out: list[tuple[float, str]]) -> list[str]:
    """Which segments (seconds, cause) were left out: each by itself, or many in one line."""
    if len(left_out) <= _FEW:
        return [f"a segment of {seconds:.1f} s was left out: {cause}" for seconds, cause in left_out]
    total, (longest, cause) = sum(seconds for seconds, _ in left_out), max(left_out)
    return [
        f"{len(left_out)} segments of {total:.1f} s together were left out; the longest, of {longest:.1f} s: {cause}"
    ]


def _rotation_onto(a: Array, b: Array) -> Array:
    """The smallest rotation that turns unit vector a onto unit vector b."""
    axis, cosine = np.cross(a, b), float(a @ b)
    sine = float(np.linalg.norm(axis))
    if sine < 1e-12:
        return np.eye(3) if cosine > 0 else so3.exp(np.array([np.pi, 0.0, 0.0]))
    return so3.exp(axis / sine * np.arctan2(sine, cosine))


def _metric(piece: Trajectory, alignment: Alignment) -> Trajectory:
    return replace(
        piece, world_from_body=alignment.apply(piece.world_from_body), covariances=None, is_metric=True
    )


def _joined(pieces: list[Trajectory]) -> Trajectory:
    """One trajectory of all pieces, which share a world now but keep their segments: the motion between is unknown."""
    poses = [piece.world_from_body for piece in pieces]
    return Trajectory(
        pieces[0].name,
        np.concatenate([piece.timestamps_ns for piece in pieces]),
        SE3(
            np.concatenate([pose.rotation for pose in poses]),
            np.concatenate([pose.translation for pose in poses]),
        ),
        segment_ids=np.concatenate([np.full(len(piece), k) for k, piece in enumerate(pieces)]),
    )


@dataclass(frozen=True, eq=False)
class _Rig:
    rig_from_cam: SE3 = field(default_factory=SE3.identity)
    antenna: Array | None = None
    antenna_std: Array | None = None


def _rig(
    gyro: GyroAlignment | None, inertial: InertialAlignment | None, by_gnss: GnssAlignment | None
) -> _Rig:
    """Where camera and antenna sit in the IMU's frame (the camera's own, without an IMU)."""
    antenna_cov = by_gnss.covariance[7:, 7:] if by_gnss is not None else None
    if gyro is None or inertial is None:
        assert by_gnss is not None
        assert antenna_cov is not None
        return _Rig(antenna=by_gnss.antenna_cam, antenna_std=np.sqrt(np.diag(antenna_cov)))
    R = gyro.imu_from_cam
    rig_from_cam = SE3(R, -R @ inertial.imu_cam)
    lever_std = np.sqrt(np.diag(R @ inertial.covariance[4:7, 4:7] @ R.T))
    if by_gnss is None or antenna_cov is None:
        return _Rig(rig_from_cam)
    antenna_std = np.sqrt(np.diag(R @ antenna_cov @ R.T) + lever_std**2)
    return _Rig(rig_from_cam, rig_from_cam * by_gnss.antenna_cam, antenna_std)
