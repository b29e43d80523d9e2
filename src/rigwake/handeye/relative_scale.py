"""Do two trajectories that both claim metres agree on how far they went?

Odometries often differ by some per cent: a baseline, an accelerometer, a range that is off. Such an error grows with
the motion and lasts for the whole recording, so no scatter of residuals over time shows it; yet in a turn it looks like
a mounting elsewhere. Over strides of many seconds it stands out of the noise; what it does to the mounting follows from
the normal equations.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from rigwake._types import Array
from rigwake.geometry.se3 import SE3
from rigwake.handeye.handeye_problem import HandeyeOptions, HandeyeProblem, strides_of_both
from rigwake.handeye.likelihood import HandeyeEstimate, equations_at, split_observable
from rigwake.recording import Finding
from rigwake.trajectory import Trajectory

_STRIDES_S = (16.0, 8.0, 4.0, 2.0, 1.0)  # the longest of which there are enough
_PARTS = 10  # of the recording: the spread of their scales is that of their median
_FEWEST_PER_PART = 4
_LEAST_WAY = 3.0  # lever arms: a stride that is shorter says more about the mounting than about scale
_TOLD_SIGMAS, _TOLD = 5.0, 0.01


@dataclass(frozen=True)
class RelativeScale:
    """Metres of the reference per metre of the member, and its standard deviation."""

    value: float
    std: float

    @property
    def log_variance(self) -> float:
        """Of its logarithm about 0, as far as chance does not explain it."""
        return max(float(np.log(self.value)) ** 2 - (self.std / self.value) ** 2, 0.0)


def relative_scale(
    reference: Trajectory, member: Trajectory, ref_from_member: SE3, offset_s: float
) -> RelativeScale | None:
    """From the lengths of their ways over long strides, the member's carried over to the reference by the mounting.

    offset_s: `t_ref = t_member + offset_s`. None where they do not go far enough. The median over ten parts of the
    recording, so that a place where one of them is lost does not count.
    """
    for stride_s in _STRIDES_S:
        both = strides_of_both(reference, member, offset_s, stride_s)
        if both is not None and len(both[0]) >= _PARTS * _FEWEST_PER_PART:
            return _over_strides(*both, ref_from_member)
    return None


def _over_strides(A: SE3, B: SE3, X: SE3) -> RelativeScale | None:
    arm = X.translation
    way = A.translation + A.rotation @ arm - arm  # of the member, seen from the reference
    far = np.linalg.norm(way, axis=1) > _LEAST_WAY * np.linalg.norm(arm)
    found = []
    for part in np.array_split(np.flatnonzero(far), _PARTS):
        if len(part) >= _FEWEST_PER_PART:
            ways = np.sum(way[part] ** 2), np.sum(B.translation[part] ** 2)
            found += [0.5 * float(np.log(ways[0] / ways[1]))] if min(ways) > 0 else []
    if len(found) < _PARTS:
        return None
    middle = float(np.median(found))
    spread = 1.4826 * float(np.median(np.abs(np.array(found) - middle)))
    value = float(np.exp(middle))
    return RelativeScale(value, value * spread * float(np.sqrt(np.pi / 2 / len(found))))


def scale_covariance(
    problem: HandeyeProblem,
    estimate: HandeyeEstimate,
    options: HandeyeOptions,
    scales: Sequence[RelativeScale | None],
) -> Array:
    """What disagreeing scales of members that claim metres add to the covariance of all unknowns: (P, P).

    Every unknown moves by `-H^-1 J^T W g` for a scale with the Jacobian g, held at one.
    """
    size = problem.columns[-1].stop
    total = np.zeros((size, size))
    if not any(scale is not None and scale.log_variance > 0 for scale in scales):
        return total
    layouts = [
        replace(at, scale_count=curve.segment_count)
        for at, curve in zip(problem.layouts, problem.members, strict=True)
    ]
    scaled = replace(problem, layouts=tuple(layouts))
    information = equations_at(scaled, estimate, options).information
    kept = np.concatenate(
        [at.start + np.arange(own.size) for at, own in zip(scaled.columns, problem.layouts, strict=True)]
    )
    split = split_observable(estimate.equations, estimate.required_ratio)
    for m, scale in enumerate(scales):
        own = problem.layouts[m]
        if scale is None or own.scale_count:
            continue
        at = scaled.columns[m].start + own.size
        of_scale = information[kept, at : at + layouts[m].scale_count].sum(axis=1)
        moved = (split.basis / split.genuine) @ (split.basis.T @ of_scale)
        total += scale.log_variance * np.outer(moved, moved)
    return total


def scale_finding(reference: str, member: str, scale: RelativeScale) -> Finding | None:
    """A warning where the scales disagree by five standard deviations and a per cent."""
    off = scale.value - 1
    if abs(off) < max(_TOLD, _TOLD_SIGMAS * scale.std):
        return None
    message = (
        f"{member} and {reference} disagree on distances: {reference} goes {100 * abs(off):.1f} ± "
        f"{100 * scale.std:.1f} % {'farther' if off > 0 else 'less far'}. One of them is not in metres as it claims. "
        "The uncertainty of the mounting counts this; --scale estimates it."
    )
    return Finding("warning", member, message)
