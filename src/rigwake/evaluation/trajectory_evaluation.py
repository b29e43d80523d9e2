"""A whole trajectory against a known one: ATE, RPE and, where the path is long enough, KITTI's errors."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from rigwake._types import Array
from rigwake.errors import InputError
from rigwake.evaluation.trajectory_errors import (
    AbsoluteError,
    KittiError,
    RelativeError,
    absolute_error,
    align,
    associate,
    kitti_error,
    relative_error,
)
from rigwake.geometry import so3
from rigwake.geometry.align import AlignmentKind
from rigwake.trajectory import Trajectory


@dataclass(frozen=True, eq=False)
class TrajectoryEvaluation:
    """Errors of the N matched poses. relative, kitti: None where the path is too short, or not in metres.

    alignment: what was fitted before the comparison; None for nothing. times_s: (N,) since the first matched pose.
    true_world, found_world: (N, 3) positions, metres, after the alignment. position_error_m, rotation_error_deg: (N,).
    """

    alignment: AlignmentKind | None
    absolute: AbsoluteError
    relative: RelativeError | None
    kitti: KittiError | None
    times_s: Array
    true_world: Array
    found_world: Array
    position_error_m: Array
    rotation_error_deg: Array

    def to_json(self) -> dict[str, Any]:
        """The figures as plain values."""
        return {
            "alignment": self.alignment or "none",
            "ate": asdict(self.absolute),
            "rpe": None if self.relative is None else asdict(self.relative),
            "kitti": None if self.kitti is None else asdict(self.kitti),
        }


def usual_alignment(found: Trajectory) -> AlignmentKind:
    """`se3` for a trajectory in metres, `sim3` for one that is up to scale."""
    return "se3" if found.is_metric else "sim3"


def evaluate_trajectory(
    truth: Trajectory,
    found: Trajectory,
    *,
    alignment: AlignmentKind | None = "se3",
    max_difference_s: float = 0.01,
) -> TrajectoryEvaluation:
    """Compare poses of the same body whose stamps lie within `max_difference_s` of each other.

    Raises InputError where no stamps match, or too few poses for the alignment.
    """
    i, j = associate(truth, found, max_difference_s)
    absolute = absolute_error(truth, found, alignment=alignment, max_difference_s=max_difference_s)
    true_poses, raw = truth.world_from_body[i], found.world_from_body[j]
    fitted = align(true_poses, raw, alignment)
    aligned = fitted.apply(raw)
    scaled = Trajectory(found.name, found.timestamps_ns[j], aligned)
    stamps = truth.timestamps_ns[i]
    return TrajectoryEvaluation(
        alignment,
        absolute,
        relative_error(truth, scaled, max_difference_s=max_difference_s) if len(i) > 1 else None,
        _kitti(Trajectory(truth.name, stamps, true_poses), Trajectory(found.name, stamps, aligned)),
        (stamps - stamps[0]) * 1e-9,
        true_poses.translation,
        aligned.translation,
        np.linalg.norm(aligned.translation - true_poses.translation, axis=1),
        np.rad2deg(
            np.linalg.norm(so3.log(np.swapaxes(true_poses.rotation, 1, 2) @ aligned.rotation), axis=1)
        ),
    )


def _kitti(truth: Trajectory, found: Trajectory) -> KittiError | None:
    try:
        return kitti_error(truth, found)
    except InputError:  # the path is shorter than 100 m
        return None
