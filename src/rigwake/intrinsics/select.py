"""Which camera model fits a lens: cross-validation over views."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from rigwake._robust import robust_std
from rigwake.cameras.protocol import CameraModel
from rigwake.errors import EstimationError, RigwakeError
from rigwake.geometry.se3 import stack
from rigwake.intrinsics.board_adjustment import BoardEstimate, adjust, residuals
from rigwake.intrinsics.board_calibration import MIN_VIEWS, calibrate
from rigwake.intrinsics.board_observations import BoardObservations
from rigwake.intrinsics.initial_guess import stacked, view_pose

CANDIDATES = ("pinhole", "kb4", "eucm", "ds", "fov", "mei", "scaramuzza", "rational")
_FOLDS = 5


@dataclass(frozen=True)
class ModelScore:
    """How well a model predicts views that it was not calibrated on.

    held_out_px: median over held-out views of the RMS distance of corners, after fitting the board's pose
    only; std_error_px of it. free_count: free parameters. failure: why the model could not be judged, if so.
    """

    model: str
    held_out_px: float
    std_error_px: float
    free_count: int
    failure: str = ""


def cross_validate(
    observations: BoardObservations,
    models: Sequence[str] = CANDIDATES,
    *,
    progress: Callable[[], object] = lambda: None,
) -> list[ModelScore]:
    """Five-fold cross-validation of every model; `progress` is called after each model.

    Raises EstimationError with fewer views than folds can be made of.
    """
    count = len(observations.views)
    if count < 2 * MIN_VIEWS:
        raise EstimationError(
            f"Models cannot be compared on {count} views.", remedy="Record 20 views, or name a --model."
        )
    scores = []
    for model in models:
        scores.append(_score(observations, model, min(_FOLDS, count // 2)))
        progress()
    return scores


def choose(scores: Sequence[ModelScore]) -> str:
    """The model with the fewest free parameters within one standard error of the best.

    Raises EstimationError if no model could be calibrated.
    """
    judged = [score for score in scores if not score.failure]
    if not judged:
        reasons = "; ".join(f"{score.model}: {score.failure}" for score in scores)
        raise EstimationError("No model could be calibrated.", consequence=reasons)
    best = min(judged, key=lambda score: score.held_out_px)
    near = [s for s in judged if s.held_out_px <= best.held_out_px + best.std_error_px]
    return min(near, key=lambda score: (score.free_count, score.held_out_px)).model


def _score(observations: BoardObservations, model: str, folds: int) -> ModelScore:
    errors: list[float] = []
    free_count = 0
    for fold in range(folds):
        held_out = np.arange(len(observations.views)) % folds == fold
        try:
            result = calibrate(observations.take(np.flatnonzero(~held_out)), model)
        except RigwakeError as error:
            return ModelScore(model, np.inf, np.inf, 0, failure=error.cause)
        free_count = len(result.camera.params) - len(result.fixed)
        errors += _held_out_errors(result.camera, observations.take(np.flatnonzero(held_out)))
    if not errors:
        return ModelScore(model, np.inf, np.inf, free_count, failure="it sees no held-out view")
    spread = robust_std(np.array(errors) - np.median(errors))
    return ModelScore(model, float(np.median(errors)), spread / np.sqrt(len(errors)), free_count)


def _held_out_errors(camera: CameraModel, observations: BoardObservations) -> list[float]:
    """RMS distance per view in pixels, with the camera held and the pose fitted; infinite without a pose."""
    poses = [view_pose(camera, view) for view in observations.views]
    found = [i for i, pose in enumerate(poses) if pose is not None]
    errors = [np.inf] * (len(poses) - len(found))
    if not found:
        return errors
    corners = stacked(observations.take(found))
    start = BoardEstimate(camera, stack([pose for pose in poses if pose is not None]))
    estimate, _ = adjust(start, corners, np.zeros(len(camera.params), dtype=np.bool_), sigma_px=1.0)
    r, valid = residuals(estimate, corners)
    squares = np.where(valid, (r**2).sum(axis=1), np.inf)
    return errors + [float(np.sqrt(squares[rows].mean())) for rows in corners.slices]
