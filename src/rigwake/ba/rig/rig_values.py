"""What goes into and comes out of the bundle adjustment of a rig."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from rigwake._types import Array, Indices
from rigwake.ba.solver.rig_problem import BundleCamera, RigProblem, RigSolution, VectorPrior
from rigwake.calibration import Calibration
from rigwake.errors import UsageError
from rigwake.recording import AttitudeStream, GnssStream, ImuStream
from rigwake.tracks import Tracks
from rigwake.trajectory import Trajectory


@dataclass(frozen=True)
class AdjustmentOptions:
    """Options of the bundle adjustment; the defaults suit a minute or two of sailing with up to a dozen cameras.

    state_rate_hz: rig states per second; observations at the frames nearest to them are used. Without an IMU,
        which carries the motion between them, there are `state_rate_without_imu_hz`.
    tracks_per_second: most tracks per camera and second that take part, the longest of each part of the image
        first. most_tracks: in all, which bounds memory: of long recordings with many cameras fewer per second take
        part. min_observations: fewest frames a track must be seen in.
    gate_stds: an observation further off than this many of its standard deviations is dropped between rounds.
    rounds: of solving and dropping. cross_camera: whether landmarks are matched across cameras and time.
    """

    state_rate_hz: float = 3.0
    state_rate_without_imu_hz: float = 10.0
    tracks_per_second: int = 60
    most_tracks: int = 80_000
    min_observations: int = 3
    gate_stds: float = 4.0
    rounds: int = 2
    cross_camera: bool = True

    def __post_init__(self) -> None:
        for name in (
            "state_rate_hz",
            "state_rate_without_imu_hz",
            "tracks_per_second",
            "most_tracks",
            "gate_stds",
            "rounds",
        ):
            if getattr(self, name) <= 0:
                raise UsageError(f"adjustment option {name} must be positive, not {getattr(self, name)}.")
        if self.min_observations < 2:
            raise UsageError("adjustment option min_observations must be at least 2.")


@dataclass(frozen=True, eq=False)
class RigMeasurements:
    """Everything that was measured on the rig, and whatever is known of where it was.

    tracks: by camera. imu: with noise densities, in rig axes. gnss, attitude: in the same ENU world.
    """

    tracks: Mapping[str, Tracks]
    imu: ImuStream | None = None
    gnss: GnssStream | None = None
    attitude: AttitudeStream | None = None


@dataclass(frozen=True, eq=False)
class InitialRig:
    """The initial guess of all unknowns, and how it came about.

    world_from_rig: the rig's metric trajectory, ENU where there is GNSS, else level where there is an IMU.
    cameras: lens, first `rig_from_cam` and time offset, what is free and what is known, by name.
    gyro_bias, accel_bias: (3,) in rig axes. antenna_rig: (3,) of the GNSS antenna.
    handeye: the cameras on the reference camera, before any adjustment.
    reference_camera: its name. scale_source: `gnss`, `imu`, `trajectory`, `baseline`, or `none` (all is up to scale).
    failed: cameras that could not be tied to the reference camera, with the reason. notes: in words.
    """

    world_from_rig: Trajectory
    cameras: Mapping[str, BundleCamera]
    gyro_bias: Array = field(default_factory=lambda: np.zeros(3))
    accel_bias: Array = field(default_factory=lambda: np.zeros(3))
    antenna_rig: Array = field(default_factory=lambda: np.zeros(3))
    handeye: Calibration = field(default_factory=lambda: Calibration("", {}))
    reference_camera: str = ""
    scale_source: str = "none"
    failed: Mapping[str, str] = field(default_factory=dict)
    notes: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False)
class AssembledProblem:
    """A rig problem, and where its landmarks come from.

    track_cameras, track_ids: (L,) the camera (index into `problem.cameras`) and the track of each landmark.
    """

    problem: RigProblem
    track_cameras: Indices
    track_ids: Indices


@dataclass(frozen=True, eq=False)
class AdjustedRig:
    """The rig at its optimum.

    solution: of the last round. track_cameras, track_ids: as in `AssembledProblem`.
    noise_factors: by camera, how much larger the residuals are than the trackers assumed; the observations'
    `std_px` already contain it. dropped: observations left out as wrong, by camera. intrinsics_priors: by camera, what
    was believed of intrinsics that were estimated; the problem's own priors also hold what the motion does not tell.
    ignored_intrinsics: by camera, see `KeptDirections`.
    """

    solution: RigSolution
    track_cameras: Indices
    track_ids: Indices
    noise_factors: Mapping[str, float]
    dropped: Mapping[str, int]
    intrinsics_priors: Mapping[str, VectorPrior] = field(default_factory=dict)
    ignored_intrinsics: Mapping[str, Array] = field(default_factory=dict)
