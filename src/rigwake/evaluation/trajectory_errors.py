"""Errors of a trajectory against a reference: ATE, RPE and KITTI's t_rel / r_rel.

Sources: Sturm et al., IROS 2012 (ATE, RPE); Geiger et al., CVPR 2012 (t_rel, r_rel); Grupp's evo, whose
definitions these follow.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rigwake._types import Array
from rigwake.errors import InputError
from rigwake.geometry import so3
from rigwake.geometry.align import Alignment, AlignmentKind, align_points
from rigwake.geometry.interpolate import nearest_indices
from rigwake.geometry.se3 import SE3
from rigwake.trajectory import Trajectory

KITTI_LENGTHS_M = (100.0, 200.0, 300.0, 400.0, 500.0, 600.0, 700.0, 800.0)


@dataclass(frozen=True)
class AbsoluteError:
    """ATE: position error in metres and rotation error in degrees after alignment; matched pairs; scale."""

    rmse_m: float
    mean_m: float
    median_m: float
    max_m: float
    rotation_rmse_deg: float
    pairs: int
    scale: float


@dataclass(frozen=True)
class RelativeError:
    """RPE over a fixed number of poses: metres and degrees per step."""

    rmse_m: float
    rotation_rmse_deg: float
    pairs: int


@dataclass(frozen=True)
class KittiError:
    """KITTI: translation error in per cent of the distance, rotation in degrees per 100 m; sub-sequences used."""

    t_rel_percent: float
    r_rel_deg_per_100m: float
    sequences: int


def associate(
    reference: Trajectory, estimate: Trajectory, max_difference_s: float = 0.01
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Indices of poses of both that belong together: nearest stamps, each used once.

    Raises InputError when no stamps lie within `max_difference_s` of each other.
    """
    nearest = nearest_indices(reference.timestamps_ns, estimate.timestamps_ns)
    gap = np.abs(reference.timestamps_ns[nearest] - estimate.timestamps_ns)
    in_estimate = np.flatnonzero(gap <= max_difference_s * 1e9)
    in_estimate = in_estimate[np.argsort(gap[in_estimate], kind="stable")]
    _, first = np.unique(nearest[in_estimate], return_index=True)
    in_estimate = np.sort(in_estimate[first])
    if not len(in_estimate):
        raise InputError(
            f"No stamps of {estimate.name} lie within {max_difference_s} s of those of {reference.name}.",
            remedy="Check that both are on the same clock.",
        )
    return nearest[in_estimate], in_estimate.astype(np.int64)


def align(reference: SE3, estimate: SE3, kind: AlignmentKind | None) -> Alignment:
    """Alignment of matched poses by their positions; identity for None."""
    if kind is None:
        return Alignment(SE3.identity())
    return align_points(estimate.translation, reference.translation, kind)


def absolute_error(
    reference: Trajectory,
    estimate: Trajectory,
    *,
    alignment: AlignmentKind | None = "se3",
    max_difference_s: float = 0.01,
) -> AbsoluteError:
    """ATE of `estimate` against `reference` after alignment of the matched poses."""
    i, j = associate(reference, estimate, max_difference_s)
    truth, raw = reference.world_from_body[i], estimate.world_from_body[j]
    found = align(truth, raw, alignment)
    aligned = found.apply(raw)
    distance = np.linalg.norm(aligned.translation - truth.translation, axis=1)
    angle = np.linalg.norm(so3.log(np.swapaxes(truth.rotation, 1, 2) @ aligned.rotation), axis=1)
    return AbsoluteError(
        _rms(distance),
        float(distance.mean()),
        float(np.median(distance)),
        float(distance.max()),
        float(np.rad2deg(_rms(angle))),
        len(i),
        found.scale,
    )


def relative_error(
    reference: Trajectory, estimate: Trajectory, *, step: int = 1, max_difference_s: float = 0.01
) -> RelativeError:
    """RPE over `step` matched poses (all overlapping pairs)."""
    i, j = associate(reference, estimate, max_difference_s)
    if len(i) <= step:
        raise InputError(f"{len(i)} matched poses are too few for relative errors over {step} poses.")
    truth, found = reference.world_from_body[i], estimate.world_from_body[j]
    error = _relative(truth, step).inverse() * _relative(found, step)
    distance = np.linalg.norm(error.translation, axis=1)
    angle = np.linalg.norm(so3.log(error.rotation), axis=1)
    return RelativeError(_rms(distance), float(np.rad2deg(_rms(angle))), len(distance))


def kitti_error(
    reference: Trajectory, estimate: Trajectory, *, lengths_m: tuple[float, ...] = KITTI_LENGTHS_M
) -> KittiError:
    """t_rel and r_rel over sub-sequences of the given lengths, from every tenth pose, as KITTI's devkit does.

    The trajectories are matched by stamp. Raises InputError when the path is shorter than every length.
    """
    i, j = associate(reference, estimate)
    truth, found = reference.world_from_body[i], estimate.world_from_body[j]
    steps = np.linalg.norm(np.diff(truth.translation, axis=0), axis=1)
    travelled = np.concatenate([[0.0], np.cumsum(steps)])
    starts, ends, lengths = _sub_sequences(travelled, lengths_m)
    if not len(starts):
        raise InputError(
            f"The path of {travelled[-1]:.0f} m is shorter than every length asked for ({lengths_m[0]:.0f} m).",
            remedy="Pass shorter lengths_m.",
        )
    motion_truth = truth[starts].inverse() * truth[ends]
    motion_found = found[starts].inverse() * found[ends]
    error = motion_found.inverse() * motion_truth
    translation = np.linalg.norm(error.translation, axis=1) / lengths
    rotation = np.linalg.norm(so3.log(error.rotation), axis=1) / lengths
    return KittiError(float(100 * translation.mean()), float(100 * np.rad2deg(rotation.mean())), len(starts))


def _sub_sequences(
    travelled: Array, lengths_m: tuple[float, ...]
) -> tuple[NDArray[np.int64], NDArray[np.int64], Array]:
    first = np.arange(0, len(travelled), 10)
    starts = np.repeat(first, len(lengths_m))
    lengths = np.tile(np.asarray(lengths_m), len(first))
    ends = np.searchsorted(travelled, travelled[starts] + lengths, side="right")
    inside = ends < len(travelled)
    return starts[inside], ends[inside], lengths[inside]


def _relative(world_from_body: SE3, step: int) -> SE3:
    return world_from_body[:-step].inverse() * world_from_body[step:]


def _rms(values: Array) -> float:
    return float(np.sqrt(np.mean(values**2)))
