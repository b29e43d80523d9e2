"""The normal equations of all unknowns, and how much of their information the noise only feigns."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from rigwake.geometry.so3 import Array
from rigwake.handeye import kernels
from rigwake.handeye import noise as noise_model
from rigwake.handeye.motions import Layout, Linearised, Mounting, Steps, feigned_information, linearise
from rigwake.handeye.noise import Jitter, StepNoise
from rigwake.handeye.problem import HandeyeProblem

# an unknown is as good as open when its standard deviation exceeds this: 5 degrees, 1 m, 0.1 s, a factor e
USEFUL_ROTATION, USEFUL_TRANSLATION, USEFUL_CLOCK, USEFUL_LOG_SCALE = np.deg2rad(5.0), 1.0, 0.1, 1.0
_ROUNDING = 1e-13  # an eigenvalue this small, beside a unit diagonal, is zero


@dataclass(frozen=True, eq=False)
class Equations:
    """Of all P unknowns over N steps.

    information: (P, P) `J^T W J`. scores: (N, P) gradients per step. weights: (N,) robust. used: (N,) steps
    that entered. feigned: (P, P) what the noise alone contributes to `information`.
    """

    information: Array
    scores: Array
    weights: Array
    used: NDArray[np.bool_]
    feigned: Array


@dataclass(frozen=True, eq=False)
class _Group:
    """Steps that the same members know, with their noise.

    rows: (6 m,) of the stacked residuals. inverse: S^-1; blame: Sa S^-1, the share of a residual that is the
    reference's; both (1 or n, 6 m, 6 m).
    """

    steps: NDArray[np.int64]
    members: NDArray[np.int64]
    rows: NDArray[np.int64]
    noise: StepNoise
    inverse: Array
    blame: Array


def form_equations(
    problem: HandeyeProblem,
    steps: Sequence[Steps],
    mountings: Sequence[Mounting],
    residuals: Sequence[Array],
    noise: StepNoise,
    filters: Sequence[Jitter],
    *,
    robust: bool,
) -> Equations:
    """Normal equations at `mountings`; `residuals` are theirs, `noise` that of the filtered residuals."""
    stacked = np.concatenate(residuals, axis=1)
    filtered = np.concatenate([f.apply(r) for f, r in zip(filters, residuals, strict=True)], axis=1)
    groups = _groups(np.stack([s.valid for s in steps], axis=1), noise)
    weights, used = np.ones(len(stacked)), np.zeros(len(stacked), dtype=bool)
    reference_errors = np.zeros_like(stacked)
    for group in groups:
        here = np.ix_(group.steps, group.rows)
        if robust:
            r = filtered[here]
            squared = np.einsum("ni,ni->n", _times(group.inverse, r), r)
            weights[group.steps] = noise_model.robust_weights(squared, len(group.rows))
        used[group.steps] = True
        # what noise cannot explain (an outlier, or a poor start) is not the reference's error either
        reference_errors[here] = _times(group.blame, stacked[here]) * weights[group.steps, None]
    linear = [
        linearise(s, x, layout, reference_errors[:, 6 * m : 6 * m + 6])
        for m, (s, x, layout) in enumerate(zip(steps, mountings, problem.layouts, strict=True))
    ]
    jacobians = [f.apply(one.jacobians) for f, one in zip(filters, linear, strict=True)]
    columns = _columns(problem.layouts)
    size = columns[-1].stop
    information, scores = np.zeros((size, size)), np.zeros((len(stacked), size))
    for group in groups:
        r = filtered[np.ix_(group.steps, group.rows)]
        _add(information, scores, group, r, weights[group.steps], jacobians, columns)
    feigned = _feigned(problem, steps, linear, groups, columns)
    return Equations(information, scores, weights, used, feigned)


def _groups(valid: NDArray[np.bool_], noise: StepNoise) -> list[_Group]:
    codes = valid @ (1 << np.arange(valid.shape[1]))
    groups = []
    for code in np.unique(codes[codes > 0]):
        steps = np.flatnonzero(codes == code)
        members = np.flatnonzero(valid[steps[0]])
        rows = (6 * members[:, None] + np.arange(6)).ravel()
        local = noise.restricted(steps, rows)
        inverse = local.inverse()
        groups.append(_Group(steps, members, rows, local, inverse, local.of_reference @ inverse))
    return groups


def _columns(layouts: Sequence[Layout]) -> list[slice]:
    ends = np.cumsum([0, *(layout.size for layout in layouts)]).tolist()
    return [slice(a, b) for a, b in pairwise(ends)]


def _times(matrices: Array, vectors: Array) -> Array:
    if len(matrices) == 1:
        return np.asarray(vectors @ matrices[0].T)
    return np.asarray((matrices @ vectors[:, :, None])[:, :, 0])


def _add(
    information: Array,
    scores: Array,
    group: _Group,
    r: Array,
    rho: Array,
    jacobians: Sequence[Array],
    columns: Sequence[slice],
) -> None:
    weighted = _times(group.inverse, r) * rho[:, None]
    for i, m in enumerate(group.members):
        mine = slice(6 * i, 6 * i + 6)
        kernels.normal_scores(
            jacobians[m], np.ascontiguousarray(weighted[:, mine]), group.steps, scores[:, columns[m]]
        )
        for j, n in enumerate(group.members[: i + 1]):
            W = np.ascontiguousarray(group.inverse[:, mine, 6 * j : 6 * j + 6])
            H = kernels.normal_block(jacobians[m], jacobians[n], W, rho, group.steps)
            information[columns[m], columns[n]] += H
            if i != j:
                information[columns[n], columns[m]] += H.T


def _feigned(
    problem: HandeyeProblem,
    steps: Sequence[Steps],
    linear: Sequence[Linearised],
    groups: Sequence[_Group],
    columns: Sequence[slice],
) -> Array:
    total = np.zeros((columns[-1].stop, columns[-1].stop))
    for group in groups:
        # covariance of what is left of the reference's error once its estimate is taken off
        left = group.noise.of_reference - group.blame @ group.noise.of_reference
        for i, m in enumerate(group.members):
            mine, layout = slice(6 * i, 6 * i + 6), problem.layouts[m]
            total[columns[m], columns[m]] += feigned_information(
                steps[m], linear[m], layout, group.steps, left[:, mine, mine], group.inverse[:, mine, mine]
            )
            if layout.has_clock:
                # the noise of the central difference that gives the member's velocity: half of S from
                # the member, at both ends of two periods
                at = columns[m].start + layout.clock.start
                total[at, at] += 1.5 * len(group.steps) / problem.members[m].period_s ** 2
    return total


@dataclass(frozen=True, eq=False)
class Determined:
    """What of the unknowns the equations determine.

    basis: (P, q) directions along which the raw information is the identity. genuine: (q,) the share of it
    that noise did not feign, in (0, 1]. open: (P, P - q) directions without genuine information, each as
    long as its first unknown to become useless.
    """

    basis: Array
    genuine: Array
    open: Array


def determined(equations: Equations, units: Array, doubt: float) -> Determined:
    """Split the unknowns; a direction counts if its genuine information exceeds `doubt` times the feigned.

    The matrix is scaled to unit diagonal first: only then are its small eigenvalues those of the motion and
    not of rounding, for the unknowns differ by many decades.
    """
    diagonal = np.diag(equations.information)
    scale = 1 / np.sqrt(np.maximum(diagonal, 1e-300))
    scale[diagonal <= 0] = 0.0
    values, vectors = np.linalg.eigh(equations.information * scale[:, None] * scale[None, :])
    present = values > _ROUNDING
    whitened = (vectors[:, present] * scale[:, None]) / np.sqrt(values[present])
    absent = vectors[:, ~present] * np.where(scale > 0, scale, 1.0)[:, None]
    genuine, turned = np.linalg.eigh(np.eye(whitened.shape[1]) - whitened.T @ equations.feigned @ whitened)
    basis = whitened @ turned
    solid = genuine > doubt * (1 - genuine)
    open_ = np.concatenate([absent, basis[:, ~solid]], axis=1)
    lengths = np.abs(open_ / units[:, None]).max(axis=0, initial=0.0)
    return Determined(basis[:, solid], genuine[solid], open_ / np.maximum(lengths, 1e-300))


def doubt_of(problem: HandeyeProblem, used: int) -> float:
    """How much genuine information must exceed what is feigned.

    With known noise the feigned information is known up to its scatter, of which five standard deviations
    are asked for. Learnt levels, and their split between both sides, may be off by as much as themselves.
    """
    return 5.0 * float(np.sqrt(2 / max(used, 1))) if problem.has_known_noise else 1.0


def useful_units(layouts: Sequence[Layout]) -> Array:
    """(P,) the deviation at which each unknown is as good as open."""
    frame = [USEFUL_ROTATION] * 3 + [USEFUL_TRANSLATION] * 3
    units: list[float] = []
    for layout in layouts:
        units += frame * (1 + layout.world_count)
        units += [USEFUL_CLOCK] * layout.has_clock + [USEFUL_LOG_SCALE] * layout.scale_count
    return np.array(units)
