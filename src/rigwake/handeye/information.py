"""The normal equations of all unknowns, and how much of their information the noise only adds spuriously."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rigwake._types import Array
from rigwake.handeye import normal_kernels
from rigwake.handeye.handeye_problem import HandeyeProblem
from rigwake.handeye.motions import (
    Linearised,
    Mounting,
    MountingLayout,
    Steps,
    linearise,
    spurious_information,
)
from rigwake.handeye.noise import Jitter, StepNoise, outlier_limit

# an unknown is as good as open when its standard deviation exceeds this: 5 degrees, 1 m, 0.1 s, a factor e
USEFUL_ROTATION, USEFUL_TRANSLATION, USEFUL_TIME_OFFSET, USEFUL_LOG_SCALE = np.deg2rad(5.0), 1.0, 0.1, 1.0
_ROUNDING = 1e-13  # an eigenvalue this small, beside a unit diagonal, is zero


@dataclass(frozen=True, eq=False)
class Equations:
    """Of all P unknowns over N steps.

    information: (P, P) `J^T W J`. scores: (N, P) gradients per step. weights: (N,) robust. used: (N,) steps
    that entered. spurious: (P, P) what the noise alone contributes to `information`.
    """

    information: Array
    scores: Array
    weights: Array
    used: NDArray[np.bool_]
    spurious: Array


@dataclass(frozen=True, eq=False)
class Group:
    """Steps that the same members know. rows: (6 m,) of the stacked residuals of these members."""

    steps: NDArray[np.int64]
    members: NDArray[np.int64]
    rows: NDArray[np.int64]


def group_steps(valid: NDArray[np.bool_]) -> list[Group]:
    """Groups of the steps that any member knows; valid (N, M)."""
    codes = valid @ (1 << np.arange(valid.shape[1]))
    groups = []
    for code in np.unique(codes[codes > 0]):
        steps = np.flatnonzero(codes == code)
        members = np.flatnonzero(valid[steps[0]])
        groups.append(Group(steps, members, (6 * members[:, None] + np.arange(6)).ravel()))
    return groups


@dataclass(frozen=True, eq=False)
class _Weighing:
    """The noise of a group's steps, each (1 or n, 6 m, 6 m). inverse: S^-1; blame: Sa S^-1, the fraction of a
    residual that is the reference's; left: covariance of the reference's error once that estimate is taken off."""

    inverse: Array
    gain: Array
    left: Array


def form_equations(
    problem: HandeyeProblem,
    steps: Sequence[Steps],
    mountings: Sequence[Mounting],
    residuals: Sequence[Array],
    noise: StepNoise,
    filters: Sequence[Jitter],
    *,
    robust: bool,
    groups: Sequence[Group] | None = None,
) -> Equations:
    """Normal equations at `mountings`; `residuals` are theirs, `noise` that of the filtered residuals.

    groups: of the steps, if known already.
    """
    stacked = _side_by_side(residuals)
    filtered = _side_by_side([f.apply(r) for f, r in zip(filters, residuals, strict=True)])
    if groups is None:
        groups = group_steps(np.stack([s.valid for s in steps], axis=1))
    weighings = [_Weighing(*noise.restricted(group.steps, group.rows).inverse()) for group in groups]
    weights, used = np.ones(len(stacked)), np.zeros(len(stacked), dtype=bool)
    reference_errors, weighted = np.zeros_like(stacked), []
    for group, w in zip(groups, weighings, strict=True):
        limit = outlier_limit(len(group.rows)) if robust else np.inf
        fractions = (w.inverse, w.gain, limit, weights, reference_errors)
        weighted.append(normal_kernels.weigh(stacked, filtered, group.steps, group.rows, *fractions))
        used[group.steps] = True
    linear = [
        linearise(s, x, layout, reference_errors[:, 6 * m : 6 * m + 6])
        for m, (s, x, layout) in enumerate(zip(steps, mountings, problem.layouts, strict=True))
    ]
    jacobians = [f.apply(one.jacobians) for f, one in zip(filters, linear, strict=True)]
    size = problem.columns[-1].stop
    information, scores = np.zeros((size, size)), np.zeros((len(stacked), size))
    for group, w, errors in zip(groups, weighings, weighted, strict=True):
        _add(information, scores, group, w.inverse, errors, weights, jacobians, problem.columns)
    spurious = _spurious(problem, steps, linear, groups, weighings)
    return Equations(information, scores, weights, used, spurious)


def _side_by_side(parts: Sequence[Array]) -> Array:
    return parts[0] if len(parts) == 1 else np.concatenate(parts, axis=1)


def _add(
    information: Array,
    scores: Array,
    group: Group,
    inverse: Array,
    weighted: Array,
    weights: Array,
    jacobians: Sequence[Array],
    columns: Sequence[slice],
) -> None:
    for i, m in enumerate(group.members):
        J, at = jacobians[m], columns[m].start
        normal_kernels.add_scores(J, weighted, 6 * i, group.steps, scores, at)
        for j, n in enumerate(group.members):
            normal_kernels.add_information(
                J,
                jacobians[n],
                inverse,
                (6 * i, 6 * j),
                weights,
                group.steps,
                information,
                (at, columns[n].start),
            )


def _spurious(
    problem: HandeyeProblem,
    steps: Sequence[Steps],
    linear: Sequence[Linearised],
    groups: Sequence[Group],
    weighings: Sequence[_Weighing],
) -> Array:
    columns = problem.columns
    total = np.zeros((columns[-1].stop, columns[-1].stop))
    for group, w in zip(groups, weighings, strict=True):
        for i, m in enumerate(group.members):
            mine, layout = slice(6 * i, 6 * i + 6), problem.layouts[m]
            total[columns[m], columns[m]] += spurious_information(
                steps[m], linear[m], layout, group.steps, w.left[:, mine, mine], w.inverse[:, mine, mine]
            )
            if layout.has_time_offset:
                # the noise of the central difference that gives the member's velocity: half of S from
                # the member, at both ends of two periods
                at = columns[m].start + layout.time_offset.start
                total[at, at] += 1.5 * len(group.steps) / problem.members[m].period_s ** 2
    return total


@dataclass(frozen=True, eq=False)
class ObservableSplit:
    """What of the unknowns the equations determine.

    basis: (P, q) directions along which the raw information is the identity. genuine: (q,) the fraction of it
    that noise did not add spurious, in (0, 1]. rest: (P, P - q) directions without genuine information.
    """

    basis: Array
    genuine: Array
    rest: Array

    def open(self, units: Array) -> Array:
        """The directions without genuine information, each as long as its first unknown to become useless."""
        lengths = np.abs(self.rest / units[:, None]).max(axis=0, initial=0.0)
        return self.rest / np.maximum(lengths, 1e-300)


def split_observable(equations: Equations, required_ratio: float) -> ObservableSplit:
    """Split the unknowns; a direction counts if its genuine information exceeds `required_ratio` times the spurious."""
    information, spurious = equations.information, equations.spurious
    return ObservableSplit(
        *normal_kernels.split_observable(information, spurious, float(required_ratio), _ROUNDING)
    )


def required_information_ratio(problem: HandeyeProblem, used: int) -> float:
    """How much genuine information must exceed what is spurious.

    With known noise the spurious information is known up to its scatter, of which five standard deviations
    are asked for. Learnt levels, and their split between both sides, may be off by as much as themselves.
    """
    return 5.0 * float(np.sqrt(2 / max(used, 1))) if problem.has_known_noise else 1.0


def useful_units(layouts: Sequence[MountingLayout]) -> Array:
    """(P,) the deviation at which each unknown is as good as open."""
    frame = [USEFUL_ROTATION] * 3 + [USEFUL_TRANSLATION] * 3
    units: list[float] = []
    for layout in layouts:
        units += frame * (1 + layout.world_count)
        units += [USEFUL_TIME_OFFSET] * layout.has_time_offset + [USEFUL_LOG_SCALE] * layout.scale_count
    return np.array(units)
