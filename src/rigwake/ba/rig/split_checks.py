"""Checks that residuals cannot make: split halves of the recording, held-out landmarks."""

from __future__ import annotations

from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from typing import Any

import numpy as np

from rigwake.ba.rig.gauge import with_gauge
from rigwake.ba.rig.outlier_rounds import SETTLED
from rigwake.ba.rig.rig_values import AdjustmentOptions
from rigwake.ba.rig.rig_verdicts import ReferenceFrame, calibrated_cameras
from rigwake.ba.rig.search_proposals import predicted_pixels
from rigwake.ba.solver.covariance import covariance_of
from rigwake.ba.solver.levenberg_marquardt import solve
from rigwake.ba.solver.rig_problem import (
    InertialStates,
    Observations,
    RigProblem,
    RigSolution,
    States,
)
from rigwake.calibration import CalibratedCamera, Calibration
from rigwake.errors import RigwakeError
from rigwake.evaluation.rig_errors import compare_calibrations
from rigwake.parallel import one_blas_thread


def residual_statistics(solution: RigSolution) -> dict[str, dict[str, Any]]:
    """Per camera: observations, landmarks, and root mean square and median length of the residuals, px."""
    observations = solution.problem.observations
    length = np.linalg.norm(solution.residuals_px, axis=1)
    found = {}
    for index, camera in enumerate(solution.problem.cameras):
        rows = (observations.camera_indices == index) & np.isfinite(length)
        found[camera.name] = {
            "observations": int(rows.sum()),
            "landmarks": len(np.unique(observations.landmark_indices[rows])),
            "rms_px": float(np.sqrt(np.mean(length[rows] ** 2))) if rows.any() else None,
            "median_px": float(np.median(length[rows])) if rows.any() else None,
        }
    return found


def part_of(problem: RigProblem, first: int, last: int, min_observations: int) -> RigProblem:
    """The problem of the states `first..last - 1` alone, with the landmarks that are seen often enough in them."""
    states, observations = problem.states, problem.observations
    inside = slice(first, last)
    stamps = states.timestamps_ns[inside]
    offsets = np.array([round(c.time_offset_s * 1e9) for c in problem.cameras])
    at = observations.timestamps_ns + offsets[observations.camera_indices]
    margin = int(np.median(np.diff(states.timestamps_ns)) // 2)
    rows = (at >= stamps[0] - margin) & (at <= stamps[-1] + margin)
    counts = np.bincount(observations.landmark_indices[rows], minlength=len(problem.landmarks))
    kept = np.flatnonzero(counts >= min_observations)
    rows &= counts[observations.landmark_indices] >= min_observations
    part = observations.take(rows)
    inertial = states.inertial
    if inertial is not None:
        inertial = InertialStates(*(getattr(inertial, name)[inside] for name in vars(inertial)))
    cut = replace(
        problem,
        poses=None,
        distances=(),
        states=States(stamps, states.world_from_rig[inside], inertial),
        landmarks=problem.landmarks.take(kept),
        observations=Observations(
            part.camera_indices,
            part.timestamps_ns,
            np.searchsorted(kept, part.landmark_indices).astype(np.int64),
            part.pixels,
            part.std_px,
        ),
    )
    return with_gauge(cut)


def split_half(
    problem: RigProblem, reference: ReferenceFrame, options: AdjustmentOptions
) -> tuple[Calibration, Calibration] | str:
    """The rig from either half of the recording alone; or, in words, why a half does not determine it."""

    def half(first: int, last: int) -> Calibration | str:
        try:
            part = part_of(problem, first, last, options.min_observations)
            solution = solve(part, SETTLED)
            covariance = covariance_of(solution.problem, clustered=True)
            return calibrated_cameras(solution, covariance, reference, {}, {})
        except RigwakeError as error:
            return str(error)

    middle = len(problem.states) // 2
    # the limit is that of the process: set before both, so that neither lifts it while the other works
    with one_blas_thread(), ThreadPoolExecutor(2) as pool:
        earlier, later = pool.map(half, (0, middle), (middle, len(problem.states)))
    if isinstance(earlier, str):
        return earlier
    return later if isinstance(later, str) else (earlier, later)


def split_half_summary(halves: tuple[Calibration, Calibration] | str) -> dict[str, Any]:
    """For `Calibration.checks`: per camera how far the halves are apart, in how many of their sigmas, and what
    either half says by itself."""
    if isinstance(halves, str):
        return {"failed": halves}
    return {
        name: {
            "rotation_deg": d.rotation_deg,
            "translation_m": 1e-3 * d.translation_mm,
            "sigmas": d.sigmas,
            "halves": [_half(half.cameras[name]) for half in halves],
        }
        for name, d in compare_calibrations(*halves).items()
        if name != halves[0].reference
    }


def _half(camera: CalibratedCamera) -> dict[str, Any]:
    """Where one half alone puts a camera, metres, and its own sigmas about and along the axes of the rig."""
    known = camera.observable_axes
    return {
        "translation_m": camera.rig_from_cam.translation,
        "std_translation_m": np.where(known[3:], camera.std_translation_m, np.nan),
        "std_rotation_deg": np.where(known[:3], camera.std_rotation_deg, np.nan),
    }


def association_errors(solution: RigSolution, unused: Observations) -> dict[str, Any]:
    """Landmarks predicted into images that were not used for them: distances in px, over all and by camera pair."""
    problem = solution.problem
    distance = np.linalg.norm(predicted_pixels(problem, unused) - unused.pixels, axis=1)
    distance_known = np.isfinite(distance)
    first = first_cameras(problem)
    names = [camera.name for camera in problem.cameras]
    pairs = {}
    for a in range(len(names)):
        for b in range(len(names)):
            rows = (first[unused.landmark_indices] == a) & (unused.camera_indices == b) & distance_known
            if rows.any():
                pairs[f"{names[a]}->{names[b]}"] = _summary(distance[rows])
    return {**_summary(distance[distance_known]), "by_pair": pairs}


def first_cameras(problem: RigProblem) -> np.ndarray:
    """(L,) the camera that saw each landmark first."""
    observations = problem.observations
    order = np.lexsort((observations.timestamps_ns, observations.landmark_indices))
    starts = np.searchsorted(observations.landmark_indices[order], np.arange(len(problem.landmarks)))
    return np.asarray(observations.camera_indices[order[np.minimum(starts, len(order) - 1)]])


def _summary(distance: np.ndarray) -> Mapping[str, Any]:
    if not len(distance):
        return {"count": 0, "median_px": None, "rms_px": None}
    return {
        "count": len(distance),
        "median_px": float(np.median(distance)),
        "rms_px": float(np.sqrt(np.mean(distance**2))),
    }
