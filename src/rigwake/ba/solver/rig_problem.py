"""The values that go into and come out of the solver: `RigProblem` -> `RigSolution`.

A problem holds the current value of every unknown (states, cameras, landmarks, antenna, gravity) beside the
measurements; a solution holds the same problem at the optimum, so that a next round starts from
`replace(solution.problem, observations=...)`. Priors keep their own mean and therefore survive rounds.

Frames: `world` (ENU, or gravity-aligned, or free when only cameras are given), `rig` (the IMU's own axes
wherever there is an IMU), `cam`. One camera alone is a rig whose `rig_from_cam` is held at the identity.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from rigwake._tables import take_rows
from rigwake._types import Array, Indices, Mask
from rigwake.ba.solver.robust_loss import Loss
from rigwake.cameras.protocol import CameraModel
from rigwake.errors import UsageError
from rigwake.geometry.se3 import SE3
from rigwake.recording import AttitudeStream, GnssStream, ImuStream

CameraParameter = Literal["rig_from_cam", "time_offset", "line_delay", "intrinsics"]
FARTHEST = 1e7  # a landmark at or beyond infinity is reported this many units away


@dataclass(frozen=True, eq=False)
class PosePrior:
    """What is known of a transform: `information` (6, 6) of the right tangent at `mean`; zero where unknown."""

    mean: SE3
    information: Array

    @classmethod
    def in_axes_of_a(cls, mean: SE3, std: ArrayLike) -> PosePrior:
        """From six standard deviations about and along the axes of frame a of `a_from_b` (a tape measure):
        `inf` where nothing is known, a tiny value where the degree of freedom is fixed."""
        weights = np.zeros((6, 6))
        weights[np.diag_indices(6)] = np.asarray(std, dtype=np.float64) ** -2.0
        axes = np.kron(np.eye(2), mean.rotation)
        return cls(mean, axes.T @ weights @ axes)


@dataclass(frozen=True, eq=False)
class VectorPrior:
    """What is known of a vector of n parameters: `mean` (n,) and `information` (n, n)."""

    mean: Array
    information: Array

    @classmethod
    def from_std(cls, mean: ArrayLike, std: ArrayLike) -> VectorPrior:
        """Independent Gaussians; `inf` where nothing is known."""
        centre = np.atleast_1d(np.asarray(mean, dtype=np.float64))
        return cls(centre, np.diag(np.broadcast_to(np.asarray(std, dtype=np.float64) ** -2.0, centre.shape)))


@dataclass(frozen=True, eq=False)
class InertialStates:
    """What an IMU adds to N states: `velocity_world`, `gyro_bias` and `accel_bias`, each (N, 3)."""

    velocity_world: Array
    gyro_bias: Array
    accel_bias: Array


@dataclass(frozen=True, eq=False)
class States:
    """The rig over time.

    timestamps_ns: (N,) strictly increasing, rig clock. world_from_rig: N transforms.
    inertial: needed (and estimated) exactly where there is an IMU.
    fixed: (N,) states that are held (all their components); none by default.
    """

    timestamps_ns: Indices
    world_from_rig: SE3
    inertial: InertialStates | None = None
    fixed: Mask | None = None

    def __post_init__(self) -> None:
        n = len(self.timestamps_ns)
        if n == 0 or self.world_from_rig.shape != (n,) or np.any(np.diff(self.timestamps_ns) <= 0):
            raise UsageError("States need one transform for each of their strictly increasing stamps.")
        if self.inertial is not None:
            shapes = {np.shape(rows) for rows in vars(self.inertial).values()}
            if shapes != {(n, 3)}:
                raise UsageError(f"Velocities and biases must have shape ({n}, 3), got {shapes}.")
        if self.fixed is not None and self.fixed.shape != (n,):
            raise UsageError(f"States.fixed must have shape ({n},).")

    def __len__(self) -> int:
        return len(self.timestamps_ns)


@dataclass(frozen=True, eq=False)
class BundleCamera:
    """A camera as an unknown: current values, what is free, and what is known beforehand.

    time_offset_s: `t_rig = t_cam + time_offset_s`, at the stamp's row (`reference_row_px`).
    line_delay_s: read-out time per row of a rolling shutter: row v is taken
    `(v - reference_row_px) * line_delay_s` later; 0 for a global shutter.
    free: which of these are estimated; the others are held at their value.
    """

    name: str
    model: CameraModel
    rig_from_cam: SE3
    time_offset_s: float = 0.0
    line_delay_s: float = 0.0
    reference_row_px: float = 0.0
    free: frozenset[CameraParameter] = frozenset()
    rig_from_cam_prior: PosePrior | None = None
    time_offset_prior: VectorPrior | None = None
    line_delay_prior: VectorPrior | None = None
    intrinsics_prior: VectorPrior | None = None


@dataclass(frozen=True, eq=False)
class Landmarks:
    """Points as `anchor + bearing / inverse_range`: smooth through infinity, so that a mountain is no trouble.

    anchors_world: (L, 3) constants, best where the point was first seen from. bearings_world: (L, 3) unit.
    inverse_ranges: (L,) 1/metres; 0 is a point at infinity, and a far one may come out slightly negative.
    """

    anchors_world: Array
    bearings_world: Array
    inverse_ranges: Array

    @classmethod
    def from_points(cls, points_world: Array, anchors_world: Array) -> Landmarks:
        """From points (L, 3) and anchors (L, 3) or (3,) that do not coincide with them."""
        anchors = np.broadcast_to(np.asarray(anchors_world, dtype=np.float64), points_world.shape).copy()
        rays = points_world - anchors
        ranges = np.linalg.norm(rays, axis=1)
        if np.any(ranges == 0) or not np.isfinite(ranges).all():
            raise UsageError("Landmarks must be finite and must not coincide with their anchors.")
        return cls(anchors, rays / ranges[:, None], 1 / ranges)

    def __len__(self) -> int:
        return len(self.inverse_ranges)

    @property
    def points_world(self) -> Array:
        """(L, 3) points; those at or beyond infinity are put `FARTHEST` units away."""
        inverse = np.maximum(self.inverse_ranges, 1 / FARTHEST)
        return np.asarray(self.anchors_world + self.bearings_world / inverse[:, None])

    def take(self, index: Indices | Mask) -> Landmarks:
        """The chosen landmarks."""
        return take_rows(self, index)


@dataclass(frozen=True, eq=False)
class Observations:
    """Pixels of landmarks: M rows, at most one per (camera, stamp, landmark).

    camera_indices: (M,) into `RigProblem.cameras`. timestamps_ns: (M,) on that camera's clock.
    landmark_indices: (M,). pixels: (M, 2). std_px: (M,) standard deviation of a pixel coordinate.
    """

    camera_indices: Indices
    timestamps_ns: Indices
    landmark_indices: Indices
    pixels: Array
    std_px: Array

    @classmethod
    def empty(cls) -> Observations:
        """No observations."""
        none = np.zeros(0, dtype=np.int64)
        return cls(none, none, none, np.zeros((0, 2)), np.zeros(0))

    def __len__(self) -> int:
        return len(self.landmark_indices)

    def take(self, index: Indices | Mask) -> Observations:
        """The chosen observations."""
        return take_rows(self, index)


@dataclass(frozen=True, eq=False)
class Antenna:
    """The GNSS antenna: `position_rig` (3,), held unless `free`, and the receiver's clock and errors.

    time_offset_s: `t_rig = t_gnss + time_offset_s`; a receiver that stamps late has a negative one. Estimated where
    there is a `time_offset_prior`. errors: what lasts in its positions, None where they are independent.
    """

    position_rig: Array
    free: bool = False
    prior: VectorPrior | None = None
    time_offset_s: float = 0.0
    time_offset_prior: VectorPrior | None = None
    errors: LastingErrors | None = None


@dataclass(frozen=True, eq=False)
class LastingErrors:
    """A receiver's errors that last, as a Gauss-Markov process of first order per axis: unknowns at K nodes.

    timestamps_ns: (K,) of the nodes on the receiver's clock. values_enu: (K, 3) metres, linear in between.
    std: (3,) stationary standard deviation per axis. correlation_s: time over which the correlation falls to 1/e.
    """

    timestamps_ns: Indices
    values_enu: Array
    std: Array
    correlation_s: float


@dataclass(frozen=True, eq=False)
class Gravity:
    """Gravity in the world frame (3,) m/s^2, held unless `free` (a world that is not level)."""

    acceleration_world: Array = field(default_factory=lambda: np.array([0.0, 0.0, -9.81]))
    free: bool = False
    prior: VectorPrior | None = None


@dataclass(frozen=True, eq=False)
class PoseMeasurements:
    """Measured `world_from_rig` (n) of the states `state_indices` (n,), with covariances (n, 6, 6)."""

    state_indices: Indices
    world_from_rig: SE3
    covariances: Array

    @classmethod
    def of_first_state(cls, world_from_rig: SE3, std: ArrayLike) -> PoseMeasurements:
        """The first state held where it is, with six standard deviations about and along the axes of the world."""
        axes = np.kron(np.eye(2), world_from_rig.rotation)
        covariance = axes.T @ np.diag(np.asarray(std, dtype=np.float64) ** 2) @ axes
        held = SE3(world_from_rig.rotation[None], world_from_rig.translation[None])
        return cls(np.array([0]), held, covariance[None])


@dataclass(frozen=True, eq=False)
class RelativeMeasurements:
    """Measured motion between two states by another body on the rig.

    body_from_body: (n) transforms `body(from)_from_body(to)`, covariances (n, 6, 6), of the camera with this
    index, or of the rig itself for `camera_index` -1.
    """

    from_states: Indices
    to_states: Indices
    body_from_body: SE3
    covariances: Array
    camera_index: int = -1


@dataclass(frozen=True, eq=False)
class DistanceMeasurement:
    """The distance between two states' origins; with a tiny `std` it fixes the scale of a camera-only problem."""

    from_state: int
    to_state: int
    distance: float
    std: float


@dataclass(frozen=True, eq=False)
class CameraBaseline:
    """A known transform between two cameras: `a_from_b` with its information (6, 6) (zero where unknown)."""

    camera_a: int
    camera_b: int
    prior: PosePrior


@dataclass(frozen=True, eq=False)
class CameraDistance:
    """A known distance between the origins of two cameras, whatever the direction; metres."""

    camera_a: int
    camera_b: int
    distance: float
    std: float


@dataclass(frozen=True, eq=False)
class RigProblem:
    """Least squares over states, landmarks and shared parameters; see the fields' types for units.

    imu: samples in rig axes with noise densities; needed exactly where `states.inertial` is given.
    attitude: `world_from_rig` rotations with covariances.

    The gauge is the caller's: GNSS or pose priors determine the world, an IMU its roll and pitch; otherwise
    hold a state (`States.fixed`) and, for cameras alone, the scale (`distances` or a second held state).

    Raises UsageError when the parts contradict each other.
    """

    states: States
    cameras: tuple[BundleCamera, ...]
    landmarks: Landmarks
    observations: Observations
    imu: ImuStream | None = None
    gravity: Gravity = field(default_factory=Gravity)
    gnss: GnssStream | None = None
    antenna: Antenna = field(default_factory=lambda: Antenna(np.zeros(3)))
    attitude: AttitudeStream | None = None
    poses: PoseMeasurements | None = None
    relative: tuple[RelativeMeasurements, ...] = ()
    distances: tuple[DistanceMeasurement, ...] = ()
    baselines: tuple[CameraBaseline, ...] = ()
    camera_distances: tuple[CameraDistance, ...] = ()

    def __post_init__(self) -> None:
        if (self.imu is None) != (self.states.inertial is None):
            raise UsageError("States need velocities and biases where there is an IMU, and only there.")
        if len({camera.name for camera in self.cameras}) != len(self.cameras):
            raise UsageError("Two cameras of the problem have the same name.")
        _check_range("camera", self.observations.camera_indices, len(self.cameras))
        _check_range("landmark", self.observations.landmark_indices, len(self.landmarks))

    def camera_index(self, name: str) -> int:
        """Index of the camera of this name; UsageError lists what is there."""
        names = [camera.name for camera in self.cameras]
        if name not in names:
            raise UsageError(f"No camera {name!r} in this problem.", remedy=f"It has: {', '.join(names)}.")
        return names.index(name)


def _check_range(what: str, indices: Indices, n: int) -> None:
    if len(indices) and (indices.min() < 0 or indices.max() >= n):
        raise UsageError(f"Observations name a {what} that the problem does not have.")


@dataclass(frozen=True)
class SolverOptions:
    """How to minimise.

    loss: robust loss of the observations on their whitened norm, with its width `loss_scale` (sigmas).
    gnss_loss_scale: width of the Huber loss of GNSS fixes (sigmas). tolerance: relative decrease of the cost
    at which to stop. shared_tolerance: or a step of the shared parameters, as a length in units of their own
    uncertainty, at which to stop (0: never). max_iterations: accepted and rejected steps together.
    """

    loss: Loss = "huber"
    loss_scale: float = 2.0
    gnss_loss_scale: float = 3.0
    tolerance: float = 1e-6
    shared_tolerance: float = 0.0
    max_iterations: int = 50
    initial_damping: float = 1e-4


@dataclass(frozen=True)
class SolverReport:
    """How the minimisation went: costs are half the sum of (robust) squared whitened residuals.

    reason: why it stopped. beyond_lens: observations whose landmark lies beyond the lens model's reach at the
    optimum (compared with their own ray; left out where the observed pixel has none). notes: what was left
    out on the way (fixes out of range).
    """

    converged: bool
    reason: str
    iterations: int
    final_cost: float
    observations: int
    beyond_lens: int
    notes: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False)
class RigSolution:
    """The problem at its optimum.

    residuals_px: (M, 2) predicted minus observed pixels in the order of `problem.observations`; NaN where the
    lens has no ray for the observed pixel, which then has no say.
    """

    problem: RigProblem
    residuals_px: Array
    report: SolverReport

    def camera(self, name: str) -> BundleCamera:
        """The camera of this name, at its optimum."""
        return self.problem.cameras[self.problem.camera_index(name)]
