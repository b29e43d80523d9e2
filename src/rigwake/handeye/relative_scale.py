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
_ROUNDS = 5
_SINGULAR = 1e-6
_USEFUL = 0.3  # deviation
_TOLD_SIGMAS, _TOLD, _EVIDENT = 5.0, 0.01, 0.02


@dataclass(frozen=True)
class RelativeScale:
    """Metres of the reference per metre of the member, and its standard deviation."""

    value: float
    std: float

    @property
    def log_variance(self) -> float:
        """Of its logarithm about 0, as far as chance does not explain it."""
        return max(float(np.log(self.value)) ** 2 - (self.std / self.value) ** 2, 0.0)

    @property
    def is_evident(self) -> bool:
        """Whether it differs from one by five standard deviations and two per cent."""
        return abs(self.value - 1) > max(_EVIDENT, _TOLD_SIGMAS * self.std)


def relative_scale(
    reference: Trajectory, member: Trajectory, ref_from_member: SE3, offset_s: float
) -> RelativeScale | None:
    """From long strides, together with the offset that goes with it: the mounting's own has given way to the scale.

    offset_s: `t_ref = t_member + offset_s`. None where the strides do not tell.
    """
    for stride_s in _STRIDES_S:
        both = strides_of_both(reference, member, offset_s, stride_s)
        if both is not None and len(both[0]) >= _PARTS * _FEWEST_PER_PART:
            return _both_ways(*both, ref_from_member.rotation)
    return None


def _both_ways(A: SE3, B: SE3, ref_from_member: Array) -> RelativeScale | None:
    """Noise of the motion that the scale multiplies pulls it towards zero: with each in that place once, the truth lies
    between, and half their distance is no less than that error."""
    one, other = _over_strides(A, B, ref_from_member), _over_strides(B, A, ref_from_member.T)
    if one is None or other is None:
        return None
    value = float(np.sqrt(one.value / other.value))
    std = float(np.hypot(one.std, (1 / other.value - one.value) / 2))
    return RelativeScale(value, std) if std < _USEFUL else None


def _over_strides(A: SE3, B: SE3, ref_from_member: Array) -> RelativeScale | None:
    """`R_A t - t + t_A = s R t_B` over offsets t and the scale s, robustly; its deviation from leaving out tenths."""
    rows = np.concatenate([np.eye(3) - A.rotation, (B.translation @ ref_from_member.T)[:, :, None]], axis=2)
    weights = np.ones(len(rows))
    for _ in range(_ROUNDS):
        at = _solved(*_normal(rows, A.translation, weights))
        if at is None:
            return None
        left = np.linalg.norm(rows @ at - A.translation, axis=1)
        weights = 1 / (1 + (left / max(2 * float(np.median(left)), 1e-9)) ** 2)
    parts = [
        _normal(rows[part], A.translation[part], weights[part])
        for part in np.array_split(np.arange(len(rows)), _PARTS)
    ]
    information, right = (np.sum([part[i] for part in parts], axis=0) for i in range(2))
    without = [_solved(information - H, right - g) for H, g in parts]
    at = _solved(information, right)
    others = np.array([x[3] for x in without if x is not None])
    if at is None or len(others) < _PARTS:
        return None
    std = float(np.sqrt((_PARTS - 1) / _PARTS * np.sum((others - others.mean()) ** 2)))
    return RelativeScale(float(at[3]), std) if at[3] > 0 and 0 < std < _USEFUL else None


def _normal(rows: Array, right: Array, weights: Array) -> tuple[Array, Array]:
    """(4, 4) and (4,) of the weighted equations."""
    by = rows * weights[:, None, None]
    return np.einsum("nip,niq->pq", by, rows), np.einsum("nip,ni->p", by, right)


def _solved(information: Array, right: Array) -> Array | None:
    """None where offset and scale cannot be told apart. An offset that nothing tells stays at zero."""
    scale = float(information[3, 3])
    if scale <= 0:
        return None
    offsets = np.linalg.pinv(information[:3, :3], rcond=_SINGULAR, hermitian=True)
    left = scale - float(information[3, :3] @ offsets @ information[:3, 3])
    if left < _SINGULAR * scale:
        return None
    value = float(right[3] - information[3, :3] @ offsets @ right[:3]) / left
    return np.append(offsets @ (right[:3] - information[:3, 3] * value), value)


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
