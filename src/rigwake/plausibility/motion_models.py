"""Which camera model fits a lens that only motion shows: cross-validation over pairs of pictures."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from rigwake._types import Array
from rigwake.ba.rig.intrinsics_refinement import IntrinsicsWidth, moved_px
from rigwake.cameras.model_fitting import convert_camera
from rigwake.cameras.registry import camera_from_params
from rigwake.errors import EstimationError, RigwakeError
from rigwake.plausibility.gyro_lens import GyroLens, fit_lens_to_gyroscope, held_out_errors_px
from rigwake.plausibility.turn_fit import TurnFit
from rigwake.plausibility.view_pairs import ViewPairs
from rigwake.recording import ImuStream

CANDIDATES_BY_MOTION = ("kb4", "mei", "ds", "scaramuzza", "pinhole")
_FOLDS = 2
_HARDLY_WORSE = 0.02
_PINHOLE_REACH = np.deg2rad(75.0)
_FAR_PX, _SEES = 8.0, 0.97  # from where it started; part of the points that it has a ray for
_NEAR = IntrinsicsWidth(focal=0.05, centre_px=15.0, distortion=0.1, aspect=0.002)


@dataclass(frozen=True, eq=False)
class MotionScore:
    """How well a model predicts pairs of pictures that it was not fitted to: RMS in pixels, the mean over pairs.

    found: the lens by all pairs, None if the model could not be fitted: then `failure` says why.
    """

    model: str
    held_out_px: float
    free_count: int = 0
    found: GyroLens | None = None
    failure: str = ""


def compare_models(
    pairs: ViewPairs,
    near: GyroLens,
    imu: ImuStream,
    turn: TurnFit,
    models: Sequence[str] = CANDIDATES_BY_MOTION,
) -> tuple[GyroLens, tuple[MotionScore, ...]]:
    """The lens of the model with the fewest parameters among those that predict held-out pairs as well as the best, and
    all scores.

    near: a lens that is nearly right, where every model starts. As well: worse by less than the standard error of the
    difference, pair by pair, and by less than 2 %. `near` itself where no model can be fitted.
    """
    turn = replace(
        turn, imu_from_cam=near.imu_from_cam, gyro_bias=near.gyro_bias, time_offset_s=near.time_offset_s
    )
    scores, errors = [], {}
    for model in models:
        score, by_pair = _score(pairs, near, imu, turn, model)
        scores.append(score)
        if by_pair is not None:
            errors[model] = by_pair
    judged = [score for score in scores if score.model in errors]
    if not judged:
        return near, tuple(scores)
    best = min(judged, key=lambda score: score.held_out_px)
    as_good = [s for s in judged if _is_as_good(errors[s.model], errors[best.model])]
    chosen = min(as_good, key=lambda score: (score.free_count, score.held_out_px))
    assert chosen.found is not None
    return chosen.found, tuple(scores)


def _is_as_good(errors: Array, best: Array) -> bool:
    worse = errors - best
    chance = worse.std(ddof=1) / np.sqrt(len(worse))
    return bool(worse.mean() <= min(chance, _HARDLY_WORSE * best.mean()))


def _score(
    pairs: ViewPairs, near: GyroLens, imu: ImuStream, turn: TurnFit, model: str
) -> tuple[MotionScore, Array | None]:
    """The score, and the errors (P,) of all pairs, each by a lens that was fitted to the others."""
    count = len(pairs.rotation)
    errors = np.empty(count)
    try:
        reach = _reach(near, pairs)
        if model == "pinhole" and reach > _PINHOLE_REACH:
            raise EstimationError("It sees too wide for a pinhole.")
        close = convert_camera(near.lens, model, reach).camera
        # where the model ends follows from its parameters: points beyond count against it
        start = camera_from_params(model, close.params, close.width_px, close.height_px)
        for fold in range(_FOLDS):
            held_out = np.arange(count) % _FOLDS == fold
            fitted = fit_lens_to_gyroscope(pairs.take(np.flatnonzero(~held_out)), start, imu, turn, _NEAR)
            errors[held_out] = held_out_errors_px(fitted, pairs.take(np.flatnonzero(held_out)), imu)
        found = fit_lens_to_gyroscope(pairs, start, imu, turn, _NEAR)
        _require_near(found, near, pairs)
    except (RigwakeError, np.linalg.LinAlgError) as error:
        return MotionScore(model, np.inf, failure=str(error)), None
    free = len(found.lens.params) - len(getattr(found.lens, "fixed_by_default", ()))
    return MotionScore(model, float(errors.mean()), free, found), errors


def _require_near(found: GyroLens, near: GyroLens, pairs: ViewPairs) -> None:
    """Raise EstimationError for a lens that shows other directions than the one it started from: where a model cannot
    follow, its rays may shrink to a bundle between which no distances are left."""
    moved = np.linalg.norm(moved_px(near.lens, found.lens, pairs.first), axis=1)
    known = np.isfinite(moved)
    if known.mean() < _SEES or float(np.median(moved[known])) > _FAR_PX:
        raise EstimationError("It cannot follow this lens.")


def _reach(near: GyroLens, pairs: ViewPairs) -> float:
    """The angle off the axis within which the points lie, radians."""
    bearings, seen = near.lens.unproject(np.concatenate([pairs.first, pairs.second]))
    return float(np.arccos(np.clip(np.percentile(bearings[seen, 2], 0.5), -1.0, 1.0)))
