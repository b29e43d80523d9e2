"""The one hypothesise-and-verify loop of the project: adaptive trials, MSAC cost, local optimisation."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from rigwake._types import Array, Mask
from rigwake.errors import EstimationError
from rigwake.geometry.se3 import SE3


class PoseProblem(Protocol):
    """What `search` needs to know: a family of poses, judged by correspondences."""

    @property
    def count(self) -> int:
        """Number of correspondences."""

    @property
    def sample_size(self) -> int:
        """Correspondences in a minimal sample."""

    def solve(self, sample: NDArray[np.int64]) -> Sequence[SE3]:
        """Candidate models of a minimal sample (indices)."""

    def errors(self, model: SE3) -> Array:
        """(N,) errors in units of the inlier gate: an inlier has an error <= 1."""

    def polish(self, model: SE3, inliers: Mask) -> SE3:
        """The model refined on these inliers (mask)."""


@dataclass(frozen=True)
class Budget:
    """How long to search. confidence: wanted probability of one outlier-free sample."""

    confidence: float = 0.999
    min_trials: int = 20
    max_trials: int = 500


@dataclass(frozen=True, eq=False)
class Found:
    """The best model, its inliers (mask), its MSAC cost (gate units) and the trials that were spent."""

    model: SE3
    inliers: Mask
    cost: float
    trials: int


def _needed_trials(inlier_fraction: float, sample_size: int, budget: Budget) -> int:
    good_sample = inlier_fraction**sample_size
    if good_sample >= 1 - 1e-12:
        return budget.min_trials
    if good_sample <= 1e-12:
        return budget.max_trials
    trials = np.log1p(-budget.confidence) / np.log1p(-good_sample)
    return int(np.clip(np.ceil(trials), budget.min_trials, budget.max_trials))


def search(problem: PoseProblem, rng: np.random.Generator, budget: Budget | None = None) -> Found:
    """The model of least MSAC cost `sum min(e^2, 1)` (Torr and Zisserman 2000), refined on its inliers
    whenever a better one is found (locally optimised RANSAC, Chum et al. 2003); deterministic for one `rng`.

    Raises EstimationError with fewer correspondences than a sample needs, or if no sample gave a model.
    """
    budget = budget or Budget()
    n, k = problem.count, problem.sample_size
    if n < k:
        raise EstimationError(f"{n} correspondences, at least {k} are needed.")
    best: Found | None = None
    needed, trial = budget.max_trials, 0
    while trial < needed:
        trial += 1
        for model in problem.solve(rng.choice(n, k, replace=False)):
            candidate = _judge(problem, model, trial)
            if best is None or candidate.cost < best.cost:
                best = _polished(problem, candidate)
                needed = _needed_trials(float(best.inliers.mean()), k, budget)
    if best is None:
        raise EstimationError("No sample of correspondences gave a model.", remedy="Are they all the same?")
    return Found(best.model, best.inliers, best.cost, trial)


def _judge(problem: PoseProblem, model: SE3, trial: int) -> Found:
    errors = problem.errors(model)
    return Found(model, errors <= 1.0, float(np.minimum(errors**2, 1.0).sum()), trial)


def _polished(problem: PoseProblem, found: Found) -> Found:
    for _ in range(2):
        if found.inliers.sum() < problem.sample_size:
            break
        better = _judge(problem, problem.polish(found.model, found.inliers), found.trials)
        if better.cost >= found.cost:
            break
        found = better
    return found
