"""Maximum likelihood over mountings, clocks, scales (and world gauges): a few Gauss-Newton steps.

The cost is `sum_k rho(r_k^T S_k^-1 r_k)` over steps in time, S the covariance of the stacked residuals of all
members (see `noise`), rho Huber's. It is minimised over the true motions as well (profile likelihood), which
is what the agreed motions in the Jacobians of `motions` amount to.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rigwake._types import Array
from rigwake.handeye import normal_kernels
from rigwake.handeye.handeye_problem import HandeyeProblem, step_covariances
from rigwake.handeye.handeye_result import HandeyeOptions
from rigwake.handeye.information import (
    USEFUL_ROTATION,
    USEFUL_TIME_OFFSET,
    USEFUL_TRANSLATION,
    Equations,
    Group,
    form_equations,
    group_steps,
    required_information_ratio,
    split_observable,
    useful_units,
)
from rigwake.handeye.motions import Mounting, residuals
from rigwake.handeye.noise import (
    Jitter,
    StepNoise,
    fit_jitter,
    known_noise,
    learnt_noise,
    robust_mean_square,
)

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
