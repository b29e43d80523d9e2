"""Solve, drop what does not fit, weigh by what was seen, and solve again."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from rigwake._robust import robust_std
from rigwake._types import Array
from rigwake.ba.rig.gnss_noise import with_learnt_receiver_errors
from rigwake.ba.rig.imu_noise import imu_noise_scales, with_imu_noise
from rigwake.ba.rig.rig_values import AdjustedRig, AdjustmentOptions, AssembledProblem
from rigwake.ba.solver.levenberg_marquardt import solve
from rigwake.ba.solver.rig_problem import Observations, RigProblem, RigSolution, SolverOptions
from rigwake.errors import EstimationError

# Damping holds back just those directions that are known least, and rounds start near their optimum
SETTLED = SolverOptions(tolerance=1e-6, shared_tolerance=0.1, initial_damping=1e-8)
# what is dropped next does not depend on the last digits
NEARLY_SETTLED = replace(SETTLED, shared_tolerance=0.5)
_FIRST_GATE = 3.0  # the first round's gate is wider by this factor: the start is still in the residuals
_MIN_LANDMARKS = 20
_NEAREST_INVERSE = 1e4  # 1 / units: what is nearer than a tenth of a millimetre is no landmark


def adjust(
    assembled: AssembledProblem,
    options: AdjustmentOptions,
    progress: Callable[[str], None] | None = None,
    *,
    final: bool = True,
) -> AdjustedRig:
    """The rig at its optimum after `options.rounds` of solving and dropping outliers.

    final: False if another bundle adjustment starts from this one, so that it need not be exact.

    Between rounds an observation beyond the gate is dropped, landmarks left with too few observations go, and
    each camera's `std_px` is scaled to the spread that its residuals show; so are the IMU's densities where
    its residuals exceed them. Raises EstimationError when too few landmarks are left.
    """
    problem = assembled.problem
    cameras, ids = assembled.track_cameras, assembled.track_ids
    factors = np.ones(len(problem.cameras))
    dropped = np.zeros(len(problem.cameras), dtype=np.int64)
    for done in range(options.rounds + 1):
        last = done == options.rounds
        settled = SETTLED if last and final else NEARLY_SETTLED
        solver = replace(settled, loss="cauchy" if done == 0 else "huber")
        if progress is not None:
            progress(f"adjusting the rig, round {done + 1}: {len(problem.observations)} observations")
        solution = solve(problem, solver)
        if last:
            break
        gate = options.gate_stds * (_FIRST_GATE if done == 0 else 1.0)
        problem, kept, scales, lost = drop_outliers(solution, gate, options.min_observations)
        problem = with_imu_noise(problem, imu_noise_scales(solution))
        problem = with_learnt_receiver_errors(problem)
        factors *= scales
        dropped += lost
        cameras, ids = cameras[kept], ids[kept]
    names = [camera.name for camera in problem.cameras]
    return AdjustedRig(
        solution,
        cameras,
        ids,
        dict(zip(names, factors.tolist(), strict=True)),
        dict(zip(names, dropped.tolist(), strict=True)),
    )


def noise_scales(solution: RigSolution) -> Array:
    """By camera: robust spread of the whitened residuals (1 when the assumed `std_px` are right)."""
    observations = solution.problem.observations
    whitened = solution.residuals_px / observations.std_px[:, None]
    scales = np.ones(len(solution.problem.cameras))
    for index in range(len(scales)):
        own = (observations.camera_indices == index) & np.isfinite(whitened).all(axis=1)
        if own.sum() > 10:
            # each landmark takes 3 of the degrees of freedom; the median shrugs off outliers
            taken = 3 * len(np.unique(observations.landmark_indices[own])) / (2 * own.sum())
            spread = robust_std(whitened[own])
            scales[index] = max(spread / np.sqrt(max(1 - taken, 0.25)), 1e-3)
    return scales


def drop_outliers(
    solution: RigSolution, gate_stds: float, min_observations: int
) -> tuple[RigProblem, np.ndarray, Array, np.ndarray]:
    """The problem without observations beyond the gate and without landmarks that are left with too few.

    Returns it with the indices of the kept landmarks, each camera's noise scale (already applied to `std_px`),
    and how many observations each camera lost.
    """
    problem = solution.problem
    observations = problem.observations
    scales = noise_scales(solution)
    std_px = observations.std_px * scales[observations.camera_indices]
    distance = np.linalg.norm(solution.residuals_px, axis=1) / std_px
    good = np.isfinite(distance) & (distance <= gate_stds)
    # a robust loss may let go of a landmark altogether: it then falls into its anchor
    good &= np.abs(problem.landmarks.inverse_ranges[observations.landmark_indices]) < _NEAREST_INVERSE
    counts = np.bincount(observations.landmark_indices[good], minlength=len(problem.landmarks))
    kept = np.flatnonzero(counts >= min_observations)
    if len(kept) < _MIN_LANDMARKS:
        raise EstimationError(
            f"Only {len(kept)} landmarks agree with one rigid rig.",
            consequence="The rig cannot be adjusted.",
            remedy="Check the intrinsics (`rigwake inspect`), the clocks, and that land is in view.",
        )
    good &= counts[observations.landmark_indices] >= min_observations
    lost = np.bincount(observations.camera_indices[~good], minlength=len(problem.cameras))
    remaining = replace(observations, std_px=std_px).take(good)
    renumbered = Observations(
        remaining.camera_indices,
        remaining.timestamps_ns,
        np.searchsorted(kept, remaining.landmark_indices).astype(np.int64),
        remaining.pixels,
        remaining.std_px,
    )
    reduced = replace(problem, landmarks=problem.landmarks.take(kept), observations=renumbered)
    return reduced, kept, scales, lost
