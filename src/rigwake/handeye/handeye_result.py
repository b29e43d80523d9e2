"""What hand-eye calibration is asked, and what it answers."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

from rigwake._types import Array
from rigwake.calibration.rig_calibration import CalibratedCamera, Calibration
from rigwake.geometry.se3 import SE3

Method = Literal["ml", "thesis"]
NoiseModel = Literal["estimated", "increments", "poses"]


@dataclass(frozen=True)
class NoiseLevel:
    """Standard deviation per axis of one pose, or of one increment, of a trajectory (radians, metres)."""

    rotation_std: float
    translation_std: float


@dataclass(frozen=True)
class HandeyeOptions:
    """How to calibrate.

    method: `ml`, or the baseline `seed`.
    noise: errors independent from increment to increment, from pose to pose, or `estimated`: drift and jitter
        in shares learnt from the residuals, or poses where these do not drift (see `selection`).
        None: as the covariances of the trajectories say, else `estimated`.
    levels: known noise by trajectory name, for trajectories that bring no covariances of their own. Unless
        every trajectory has covariances or a level, the noise is estimated from the residuals.
    time_offset: estimate the clock of every member. scale: also of members that claim to be metric.
    robust: down-weight steps that the noise cannot explain. max_gap_s: longest gap to bridge by
        interpolation (default ten median periods).
    """

    method: Method = "ml"
    noise: NoiseModel | None = None
    levels: Mapping[str, NoiseLevel] = field(default_factory=dict)
    time_offset: bool = True
    scale: bool = False
    robust: bool = True
    max_gap_s: float | None = None
    max_iterations: int = 50


@dataclass(frozen=True, eq=False)
class HandeyeResult:
    """Where the members sit, how sure that is, and how the estimate came about.

    reference: name. members: by name, parts that the motion left unobservable marked (see CalibratedCamera).
    ref_from_members: the raw estimates by name; along unobservable directions they are arbitrary.
    joint_covariance: (6 M, 6 M) right tangents of the members in order.
    scales: by name, one (scale, std) per segment that was scaled; NaN where unobservable.
    noise: what the likelihood assumed, in words. residual_std: by name, (6,) `[rotation, translation]`.
    steps, down_weighted: how many steps in time entered, and how many of them as outliers.
    """

    reference: str
    members: Mapping[str, CalibratedCamera]
    ref_from_members: Mapping[str, SE3]
    joint_covariance: Array
    scales: Mapping[str, Array]
    noise: str
    residual_std: Mapping[str, Array]
    steps: int
    down_weighted: int
    iterations: int
    converged: bool

    def calibration(self, provenance: Mapping[str, object] | None = None) -> Calibration:
        """The result as the one file that everything downstream reads."""
        return Calibration(
            self.reference, self.members, self.joint_covariance, provenance=dict(provenance or {})
        )
