"""Maximum likelihood over mountings, clocks, scales (and world gauges): a few Gauss-Newton steps.

The cost is `sum_k rho(r_k^T S_k^-1 r_k)` over steps in time, S the covariance of the stacked residuals of all
members (see `noise`), rho Huber's. It is minimised over the true motions as well (profile likelihood), which
is what the agreed motions in the Jacobians of `motions` amount to.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rigwake.geometry.so3 import Array
from rigwake.handeye.information import (
    USEFUL_CLOCK,
    USEFUL_ROTATION,
    USEFUL_TRANSLATION,
    Equations,
    determined,
    doubt_of,
    form_equations,
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
from rigwake.handeye.problem import HandeyeProblem, step_covariances
from rigwake.handeye.values import HandeyeOptions

_MOVES_LESS = 1e-3  # of a standard deviation: converged
_SETTLED = 0.3  # of a standard deviation: near enough to learn the noise from the residuals
_PATIENCE = 15  # steps
_LONGEST_TURN, _LONGEST_WAY = 0.5, 20.0  # radians, metres in one step


@dataclass(frozen=True, eq=False)
class Estimate:
    """The solver's end: unknowns, the normal equations and (N, 6) residuals there, and how it went.

    valid, segments: (N, M) steps that a member knows, and the index of its segment.
    """

    mountings: tuple[Mounting, ...]
    equations: Equations
    residuals: tuple[Array, ...]
    valid: NDArray[np.bool_]
    segments: NDArray[np.int64]
    filters: tuple[Jitter, ...]
    doubt: float
    iterations: int
    converged: bool


class _Solver:
    """The problem at the current unknowns; steps are resampled only when a clock moved."""

    def __init__(self, problem: HandeyeProblem, start: Sequence[Mounting], options: HandeyeOptions):
        self.problem, self.options = problem, options
        self.covariances = step_covariances(problem, options) if problem.has_known_noise else {}
        self.filters = (Jitter(),) * len(start)
        self.move_to(tuple(start), resample=True)

    def move_to(self, mountings: tuple[Mounting, ...], *, resample: bool) -> None:
        self.mountings = mountings
        if resample:
            self.steps = self.problem.steps(mountings)
            self.valid = np.stack([s.valid for s in self.steps], axis=1)
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
        return learnt_noise(frames, np.concatenate(filtered, axis=1), self.valid, self.problem.absolute)

    def equations(self) -> Equations:
        return form_equations(
            self.problem,
            self.steps,
            self.mountings,
            self.residuals,
            self.noise(),
            self.filters,
            robust=self.options.robust,
        )

    def step(self, doubt: float) -> float:
        """One Gauss-Newton step; its length in standard deviations."""
        self.latest = self.equations()
        tangent, moved = _bounded_step(self.latest, useful_units(self.problem.layouts), doubt)
        ends = np.cumsum([layout.size for layout in self.problem.layouts])
        parts = np.split(tangent, ends[:-1])
        moves = zip(self.mountings, parts, self.problem.layouts, strict=True)
        clocks_moved = any(
            np.any(part[layout.clock]) for part, layout in zip(parts, self.problem.layouts, strict=True)
        )
        self.move_to(tuple(x.retract(part, layout) for x, part, layout in moves), resample=clocks_moved)
        return moved


def maximise(problem: HandeyeProblem, start: Sequence[Mounting], options: HandeyeOptions) -> Estimate:
    """Gauss-Newton from `start` until a step moves nothing by more than a thousandth of its deviation."""
    solver = _Solver(problem, start, options)
    learning = problem.noise == "estimated"
    doubt = doubt_of(problem, int(solver.valid.any(axis=1).sum()))
    moved, iterations, settled, enough = np.inf, 0, not learning, _MOVES_LESS
    while (moved > enough or not settled) and iterations < options.max_iterations:
        if learning and moved < _SETTLED:
            solver.learn_filters()
            settled = True
        moved = solver.step(doubt)
        iterations += 1
        if iterations % _PATIENCE == 0:
            # what comes and goes with every step is on the edge: a direction of being determined (give it
            # up), a pose of the shared time (it moves the estimate by little)
            doubt, enough = 2 * doubt, 10 * enough
    return Estimate(
        solver.mountings,
        solver.latest if moved <= enough else solver.equations(),
        solver.residuals,
        solver.valid,
        np.stack([s.segments for s in solver.steps], axis=1),
        solver.filters,
        doubt,
        iterations,
        moved <= enough,
    )


def information_criterion(problem: HandeyeProblem, estimate: Estimate) -> float:
    """Schwarz's criterion (BIC) of learnt noise, lower is better: how well the past predicts each residual.

    Comparable between increments and poses, for increments are the poses' differences: a change of variables
    of determinant one. Levels are taken alike on all axes, whatever the estimate assumed.
    """
    total = 0.0
    for m, (layout, jitter, r) in enumerate(
        zip(problem.layouts, estimate.filters, estimate.residuals, strict=True)
    ):
        valid = estimate.valid[:, m]
        predicted = jitter.apply(r)[valid]
        levels = [robust_mean_square(part) for part in (predicted[:, :3], predicted[:, 3:])]
        total += 3 * len(predicted) * float(np.sum(np.log(levels)))
        total += layout.size * np.log(max(len(predicted), 1))
    return total


def _bounded_step(equations: Equations, units: Array, doubt: float) -> tuple[Array, float]:
    """The Gauss-Newton step along what is determined, and its length in standard deviations.

    Along the rest the likelihood follows the noise, often towards infinity; it stays where it started.
    """
    basis = determined(equations, units, doubt).basis
    coefficients = -(basis.T @ equations.scores.sum(axis=0))
    step = basis @ coefficients
    limits = np.full(len(units), np.inf)
    limits[units == USEFUL_ROTATION] = _LONGEST_TURN
    limits[units == USEFUL_TRANSLATION] = _LONGEST_WAY
    limits[units == USEFUL_CLOCK] = USEFUL_CLOCK
    shorten = min(1.0, float(np.min(limits / np.maximum(np.abs(step), 1e-300))))
    return step * shorten, float(np.linalg.norm(coefficients))
