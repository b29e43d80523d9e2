"""Which lenses stay as given while the rig is adjusted: those that the pictures do not contradict.

A lens that is free takes up what the tracker is biased by, a few hundredths of a pixel, and hands it on to where
landmarks are looked for in other cameras, and so to the rig. So the first adjustment, with every lens free, says which
directions of the parameters the motion contradicts; the others are held in the rounds of cross-camera association. Once
these have told what they can, every lens is judged again with all that is known.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from rigwake.ba.rig.intrinsics_refinement import (
    FIRMLY,
    JUDGED,
    KeptDirections,
    holding,
    kept_directions,
    with_intrinsics_priors_of,
)
from rigwake.ba.rig.outlier_rounds import NEARLY_SETTLED, SETTLED
from rigwake.ba.rig.rig_values import AdjustedRig
from rigwake.ba.solver.covariance import covariance_of
from rigwake.ba.solver.levenberg_marquardt import solve
from rigwake.ba.solver.rig_problem import RigProblem, RigSolution, VectorPrior


def hold_uncontradicted(adjusted: AdjustedRig, believed: Mapping[str, VectorPrior]) -> AdjustedRig:
    """The rig solved again with intrinsics as believed along all directions that the motion does not contradict.

    adjusted: at its optimum with free intrinsics. believed: by camera, their priors. A camera of which nothing is
    contradicted has fixed intrinsics in the result.
    """
    if not believed:
        return adjusted
    problem = adjusted.solution.problem
    held = _held(problem, _kept(problem, believed))
    return replace(adjusted, solution=solve(held, NEARLY_SETTLED))


def judge_lenses(adjusted: AdjustedRig, believed: Mapping[str, VectorPrior]) -> AdjustedRig:
    """The rig at its optimum, with those intrinsics as believed that the motion does not tell or does not contradict.

    adjusted: with intrinsics free, or held by `hold_uncontradicted`. In the problem of the result, for its covariance,
    all are free: what the motion does not tell counts with what was believed of it, the rest with what it tells.
    """
    if not believed:
        return adjusted
    before = adjusted.solution
    start = _freed(before.problem, believed)
    free = solve(start, NEARLY_SETTLED)
    kept = _kept(free.problem, believed)
    # nothing was moved, and nothing is to be moved: that is the optimum already
    settled = not _is_free(before.problem) and all(_is_whole(k) for k in kept.values())
    # what is held now was mostly held before: from there it is nearer than from where all is free
    solution = before if settled else solve(_held(start, kept), SETTLED)
    return replace(
        adjusted,
        solution=_judged(solution, kept, believed),
        intrinsics_priors=believed,
        ignored_intrinsics={name: k.ignored for name, k in kept.items()},
    )


def _judged(
    solution: RigSolution, kept: Mapping[str, KeptDirections], believed: Mapping[str, VectorPrior]
) -> RigSolution:
    """The solution, its problem's intrinsics free with the priors that its covariance is to be judged by."""
    free = _freed(solution.problem, believed)
    priors = holding(free, {name: k.untold for name, k in kept.items()}, JUDGED)
    return replace(solution, problem=with_intrinsics_priors_of(free, priors))


def _kept(problem: RigProblem, believed: Mapping[str, VectorPrior]) -> dict[str, KeptDirections]:
    return kept_directions(problem, covariance_of(problem, clustered=True), believed)


def _is_whole(kept: KeptDirections) -> bool:
    """Whether these are all directions that there are."""
    return kept.untold.shape[1] + kept.agreeing.shape[1] == len(kept.untold)


def _is_free(problem: RigProblem) -> bool:
    return any("intrinsics" in camera.free for camera in problem.cameras)


def _freed(problem: RigProblem, believed: Mapping[str, VectorPrior]) -> RigProblem:
    """The problem with intrinsics free, and with the priors that are believed."""
    cameras = tuple(
        replace(camera, free=camera.free | {"intrinsics"}, intrinsics_prior=believed[camera.name])
        if camera.name in believed
        else camera
        for camera in problem.cameras
    )
    return replace(problem, cameras=cameras)


def _held(problem: RigProblem, kept: Mapping[str, KeptDirections]) -> RigProblem:
    """The problem with intrinsics held along directions; fixed where these are all."""
    every = {name: np.concatenate([k.untold, k.agreeing], axis=1) for name, k in kept.items()}
    held = holding(problem, every, FIRMLY)
    cameras = []
    for camera in held.cameras:
        prior = camera.intrinsics_prior
        if prior is not None and camera.name in kept and _is_whole(kept[camera.name]):
            lens = camera.model.with_params(prior.mean)
            fixed = camera.free - {"intrinsics"}
            camera = replace(camera, model=lens, free=fixed, intrinsics_prior=None)
        cameras.append(camera)
    return replace(held, cameras=tuple(cameras))
