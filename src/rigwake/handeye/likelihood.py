"""Maximum likelihood over mountings, time offsets, scales (and world gauges): a few Gauss-Newton steps.

The cost is `sum_k rho(r_k^T S_k^-1 r_k)` over steps in time, S the covariance of the stacked residuals of all
members (see `noise`), rho Huber's. It is minimised over the true motions as well (profile likelihood), which
is what the agreed motions in the Jacobians of `motions` amount to. The normal equations say how much of their
information the noise only adds spuriously.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rigwake._types import Array
from rigwake.handeye import normal_kernels
from rigwake.handeye.handeye_problem import HandeyeOptions, HandeyeProblem, step_covariances
from rigwake.handeye.motions import (
    Linearised,
    Mounting,
    MountingLayout,
    Steps,
    linearise,
    residuals,
    spurious_information,
)
from rigwake.handeye.noise import (
    Jitter,
    StepNoise,
    fit_jitter,
    known_noise,
    learnt_noise,
    outlier_limit,
    robust_mean_square,
)

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


_MOVES_LESS = 1e-3  # of a standard deviation: converged
_JUDGED = 1.0  # standard deviations from its end: near enough to compare with another model
_SETTLED = 0.3  # of a standard deviation: near enough to learn the noise from the residuals
_PATIENCE = 15  # steps
_LONGEST_TURN, _LONGEST_WAY = 0.5, 20.0  # radians, metres in one step


@dataclass(frozen=True, eq=False)
class HandeyeEstimate:
    """The solver's end: unknowns, the normal equations and (N, 6) residuals there, and how it went.

    valid, segments: (N, M) steps that a member knows, and the index of its segment.
    """

    mountings: tuple[Mounting, ...]
    equations: Equations
    residuals: tuple[Array, ...]
    valid: NDArray[np.bool_]
    segments: NDArray[np.int64]
    filters: tuple[Jitter, ...]
    required_ratio: float
    iterations: int
    converged: bool


class _Solver:
    """The problem at the current unknowns; steps are resampled only when a clock moved."""

    def __init__(self, problem: HandeyeProblem, start: Sequence[Mounting], options: HandeyeOptions):
        self.problem, self.options = problem, options
        self.covariances = step_covariances(problem, options) if problem.has_known_noise else {}
        self.filters = (Jitter(),) * len(start)
        self.limits = _longest_step(useful_units(problem.layouts))
        self.valid, self.groups = np.zeros((0, len(start)), dtype=bool), list[Group]()
        self.move_to(tuple(start), resample=True)

    def move_to(self, mountings: tuple[Mounting, ...], *, resample: bool) -> None:
        self.mountings = mountings
        if resample:
            self.steps = self.problem.steps(mountings)
            valid = np.array([s.valid for s in self.steps]).T
            if not np.array_equal(valid, self.valid):
                self.valid, self.groups = valid, group_steps(valid)
            if self.covariances:
                self.over_steps = self.problem.known_covariances(mountings, self.covariances)
        self.residuals = tuple(residuals(s, x) for s, x in zip(self.steps, mountings, strict=True))

    def learn_filters(self) -> None:
        self.filters = tuple(fit_jitter(r, self.valid[:, m]) for m, r in enumerate(self.residuals))

    def noise(self) -> StepNoise:
        frames = [x.ref_from_member for x in self.mountings]
        if self.covariances:
            return known_noise(frames, *self.over_steps)
        filtered = [f.apply(r) for f, r in zip(self.filters, self.residuals, strict=True)]
        stacked = filtered[0] if len(filtered) == 1 else np.concatenate(filtered, axis=1)
        return learnt_noise(frames, stacked, self.valid, self.problem.absolute)

    def equations(self) -> Equations:
        return form_equations(
            self.problem,
            self.steps,
            self.mountings,
            self.residuals,
            self.noise(),
            self.filters,
            robust=self.options.robust,
            groups=self.groups,
        )

    def step(self, required_ratio: float) -> float:
        """One Gauss-Newton step; its length in standard deviations."""
        self.latest = self.equations()
        tangent, moved = _bounded_step(self.latest, self.limits, required_ratio)
        parts = [tangent[columns] for columns in self.problem.columns]
        moves = list(zip(self.mountings, parts, self.problem.layouts, strict=True))
        time_offsets_moved = any(part[layout.time_offset].any() for _, part, layout in moves)
        self.move_to(tuple(x.retract(part, layout) for x, part, layout in moves), resample=time_offsets_moved)
        return moved

    def estimate(self, required_ratio: float, iterations: int, *, converged: bool) -> HandeyeEstimate:
        """Where the solver stands."""
        segments = np.array([s.segments for s in self.steps]).T
        at = (self.mountings, self.latest, self.residuals, self.valid, segments, self.filters)
        return HandeyeEstimate(*at, required_ratio, iterations, converged)


def maximise(
    problem: HandeyeProblem,
    start: Sequence[Mounting],
    options: HandeyeOptions,
    worthwhile: Callable[[HandeyeEstimate], bool] | None = None,
) -> HandeyeEstimate:
    """Gauss-Newton from `start` until the next step would move nothing by more than a thousandth of its deviation.

    The next step is expected to be shorter than this one as this one is than the last.

    worthwhile: asked once, when steps are down to one deviation; unless it is, the estimate is left there.
    """
    solver = _Solver(problem, start, options)
    learning = problem.noise == "estimated"
    required_ratio = required_information_ratio(problem, int(solver.valid.any(axis=1).sum()))
    moved, ahead, iterations, settled, enough = np.inf, np.inf, 0, not learning, _MOVES_LESS
    while (ahead > enough or not settled) and iterations < options.max_iterations:
        if learning and moved < _SETTLED:
            solver.learn_filters()
            settled = True
        before, moved = moved, solver.step(required_ratio)
        ahead = moved * min(1.0, moved / before) if 0 < before < np.inf else moved
        iterations += 1
        if worthwhile is not None and moved < _JUDGED:
            so_far = solver.estimate(required_ratio, iterations, converged=ahead <= enough)
            if not worthwhile(so_far):
                return so_far
            worthwhile = None
        if iterations % _PATIENCE == 0:
            # what comes and goes with every step is on the edge: a direction of being determined (give it
            # up), a pose of the shared time (it moves the estimate by little)
            required_ratio, enough = 2 * required_ratio, 10 * enough
    if ahead > enough:
        solver.latest = solver.equations()
    return solver.estimate(required_ratio, iterations, converged=ahead <= enough)


def equations_at(problem: HandeyeProblem, estimate: HandeyeEstimate, options: HandeyeOptions) -> Equations:
    """The normal equations of `problem`, which may have further unknowns, at the end of another's estimate."""
    solver = _Solver(problem, estimate.mountings, options)
    solver.filters = estimate.filters
    return solver.equations()


def information_criterion(problem: HandeyeProblem, estimate: HandeyeEstimate) -> float:
    """Schwarz's criterion (BIC) of learnt noise, lower is better: how well the past predicts each residual.

    Comparable between increments and poses, for increments are the poses' differences: a change of variables
    of determinant one. Levels are taken alike on all axes, whatever the estimate assumed.
    """
    total = 0.0
    for m, (layout, jitter, r) in enumerate(
        zip(problem.layouts, estimate.filters, estimate.residuals, strict=True)
    ):
        valid = estimate.valid[:, m]
        predicted, count = jitter.apply(r), int(valid.sum())
        levels = [robust_mean_square(predicted, valid, first) for first in (0, 3)]
        total += 3 * count * float(np.sum(np.log(levels)))
        total += layout.size * np.log(max(count, 1))
    return total


def _longest_step(units: Array) -> Array:
    limits = np.full(len(units), np.inf)
    limits[units == USEFUL_ROTATION] = _LONGEST_TURN
    limits[units == USEFUL_TRANSLATION] = _LONGEST_WAY
    limits[units == USEFUL_TIME_OFFSET] = USEFUL_TIME_OFFSET
    return limits


def _bounded_step(equations: Equations, limits: Array, required_ratio: float) -> tuple[Array, float]:
    """The Gauss-Newton step along what is determined, and its length in standard deviations.

    Along the rest the likelihood follows the noise, often towards infinity; it stays where it started.
    """
    basis = split_observable(equations, required_ratio).basis
    return normal_kernels.bounded_step(basis, equations.scores, limits)
