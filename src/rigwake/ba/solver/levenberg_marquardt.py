"""Levenberg-Marquardt on a `RigProblem`.

Each iteration linearises every factor, eliminates landmarks (`schur.py`), chains frames to states and shared
parameters (`normal.py`), eliminates the states by an envelope Cholesky and solves for the shared parameters.
The damping follows Nielsen, *Damping parameter in Marquardt's method* (1999).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from rigwake._types import Array, Indices
from rigwake.ba.solver.camera_frames import Frames, frame_poses, frames_of
from rigwake.ba.solver.envelope import Envelope, NotPositiveDefiniteError
from rigwake.ba.solver.imu_factors import inertial_factors
from rigwake.ba.solver.linear_factors import coupled_states, measured_factors, out_of_range_notes
from rigwake.ba.solver.normal import Factors, NormalEquations
from rigwake.ba.solver.parameter_layout import ParameterLayout, layout_of, retract, tangent_bases
from rigwake.ba.solver.reprojection import Reprojection, linearise
from rigwake.ba.solver.rig_problem import RigProblem, RigSolution, SolverOptions, SolverReport
from rigwake.ba.solver.schur import (
    FrameEquations,
    FramePairs,
    LinearObservations,
    eliminate_landmarks,
    frame_pairs,
    landmark_steps,
)
from rigwake.ba.solver.state_motion import TimedPoses
from rigwake.errors import CameraError, EstimationError
from rigwake.parallel import one_blas_thread

_LARGEST_DAMPING = 1e12


@dataclass(frozen=True, eq=False)
class Structure:
    """What stays the same while a problem is solved: columns, frames, and which of them meet."""

    layout: ParameterLayout
    frames: Frames
    pairs: FramePairs
    shape: Envelope


@dataclass(frozen=True, eq=False)
class Linearisation:
    """All factors at one set of values."""

    problem: RigProblem
    reprojection: Reprojection
    observations: LinearObservations
    poses: TimedPoses
    factors: tuple[Factors, ...]

    @property
    def cost(self) -> float:
        """Half the robust sum of squares."""
        return self.reprojection.cost + sum(part.cost for part in self.factors)


def structure_of(problem: RigProblem) -> Structure:
    """Analyse the problem once."""
    layout, frames = layout_of(problem), frames_of(problem)
    pairs = frame_pairs(frames.landmark_starts, frames.of_observation, len(frames))
    first = _first_coupled_states(problem, frame_poses(problem, layout, frames).states, pairs)
    dim = layout.state_dim
    return Structure(layout, frames, pairs, Envelope.of_first_columns(np.repeat(first * dim, dim), dim))


def _first_coupled_states(problem: RigProblem, frame_states: Indices, pairs: FramePairs) -> Indices:
    """(N,) the earliest state that each state shares a landmark or a factor with, itself if none is earlier;
    `frame_states` (F, s) are those that each frame depends on."""
    first = np.arange(len(problem.states))
    earliest = frame_states.min(axis=1)
    start = np.minimum(earliest[pairs.rows], earliest[pairs.partners])
    for states in frame_states.T:
        np.minimum.at(first, states[pairs.rows], start)
        np.minimum.at(first, states[pairs.partners], start)
    ties = coupled_states(problem)
    np.minimum.at(first, ties.max(axis=1), ties.min(axis=1))
    return first


def linearised(problem: RigProblem, structure: Structure, options: SolverOptions) -> Linearisation:
    """Every factor and its derivatives."""
    poses = frame_poses(problem, structure.layout, structure.frames)
    reprojection, observations = linearise(problem, structure.layout, structure.frames, poses, options)
    return Linearisation(
        problem, reprojection, observations, poses, tuple(_other_factors(problem, structure.layout, options))
    )


def _other_factors(problem: RigProblem, layout: ParameterLayout, options: SolverOptions) -> Iterator[Factors]:
    yield from measured_factors(problem, layout, options)
    if problem.imu is not None and len(problem.states) > 1:
        yield inertial_factors(problem, layout)


def equations_of(
    linear: Linearisation, structure: Structure, damping: float
) -> tuple[NormalEquations, FrameEquations]:
    """Normal equations without landmarks, whose blocks are damped; the others are not yet."""
    layout = structure.layout
    n_extras = layout.n_columns - layout.extras_start
    reduced = eliminate_landmarks(linear.observations, structure.pairs, n_extras, damping)
    equations = NormalEquations.zeros(layout, structure.shape)
    equations.add_frames(reduced, structure.pairs, linear.poses)
    for factors in linear.factors:
        equations.add_factors(factors)
    return equations, reduced


def solve(problem: RigProblem, options: SolverOptions | None = None) -> RigSolution:
    """Minimise the robust sum of squares of all factors over all free unknowns.

    Deterministic. Raises EstimationError if the values at the start are not finite, or if no damping makes a
    step that lowers the cost from a point that is no minimum.
    """
    wanted = options or SolverOptions()
    with one_blas_thread():
        return _minimise(problem, wanted)


def _minimise(problem: RigProblem, options: SolverOptions) -> RigSolution:
    structure = structure_of(problem)
    linear = linearised(problem, structure, options)
    damping, growth = options.initial_damping, 2.0
    if not np.isfinite(linear.cost):
        raise EstimationError(
            "The cost of the bundle adjustment is not finite at its initial values.",
            remedy="Check the initial poses, landmarks and the measurements' covariances.",
        )
    reason, converged, iteration = f"{options.max_iterations} iterations", False, 0
    for iteration in range(1, options.max_iterations + 1):  # noqa: B007
        trial = _trial(linear, structure, options, damping)
        if trial is None or trial.actual <= 0:
            unhindered = growth == 2.0  # the first step from here: not shortened because others failed
            if trial is not None and unhindered and trial.predicted <= options.tolerance * linear.cost:
                reason, converged = "no step lowers the cost further", True
                break
            damping, growth = damping * growth, growth * 2
            if damping > _LARGEST_DAMPING:
                reason = "no step lowers the cost, however short"
                break
            continue
        gain = trial.actual / trial.predicted
        small = trial.shared_sigmas <= options.shared_tolerance
        settled = growth == 2.0 and (small or trial.actual <= options.tolerance * linear.cost)
        damping, growth = damping * max(1 / 3, 1 - (2 * gain - 1) ** 3), 2.0
        linear = trial.linear
        if settled:
            reason = "the shared parameters have settled" if small else "the cost has settled"
            converged = True
            break
    report = SolverReport(
        converged,
        reason,
        iteration,
        linear.cost,
        len(problem.observations),
        linear.reprojection.beyond,
        out_of_range_notes(problem),
    )
    return _solution(linear, structure, report)


@dataclass(frozen=True, eq=False)
class _Trial:
    """A step's end, with the decrease of the cost that the linear model assumed and the one that came.

    shared_sigmas: length of the shared parameters' step in units of their own uncertainty; inf without any.
    """

    linear: Linearisation
    predicted: float
    actual: float
    shared_sigmas: float


def _trial(
    linear: Linearisation, structure: Structure, options: SolverOptions, damping: float
) -> _Trial | None:
    """One damped step, or None if at this damping the equations cannot be solved or the step goes nowhere."""
    layout = structure.layout
    equations, reduced = equations_of(linear, structure, damping)
    try:
        solved = equations.damped(damping).factorise()
        step = solved.step()
    except NotPositiveDefiniteError:
        return None
    frame_step = linear.poses.moved_by(layout, step)
    landmark_moves = landmark_steps(linear.observations, reduced, frame_step, step[layout.extras_start :])
    problem = linear.problem
    bases = tangent_bases(problem.landmarks.bearings_world)
    # where next to nothing is determined, a step that is hardly damped may lead beyond all floats, or all lenses
    try:
        with np.errstate(over="ignore", invalid="ignore"):
            moved = linearised(retract(problem, layout, step, landmark_moves, bases), structure, options)
    except CameraError:
        return None
    if not np.isfinite(moved.cost):
        return None
    shared = step[layout.n_state_columns :]
    sigmas = float(np.sqrt(shared @ solved.shared @ shared)) if len(shared) else np.inf
    return _Trial(moved, _assumed(equations, reduced, step), linear.cost - moved.cost, sigmas)


def _assumed(equations: NormalEquations, reduced: FrameEquations, step: Array) -> float:
    """Decrease of the damped linear model at its minimum: half of step . gradient over all unknowns. The reduced
    gradient is `g - W V^-1 g_l`; with the landmarks' own `g_l V^-1 g_l` the sum is that of the full problem."""
    g = reduced.landmark_gradient
    by_landmarks = np.einsum("li,lij,lj->", g, reduced.landmark_inverse, g)
    return 0.5 * float(step @ equations.gradient + by_landmarks)


def _solution(linear: Linearisation, structure: Structure, report: SolverReport) -> RigSolution:
    residuals = np.empty_like(linear.reprojection.residuals_px)
    residuals[structure.frames.order] = linear.reprojection.residuals_px
    return RigSolution(linear.problem, residuals, report)
