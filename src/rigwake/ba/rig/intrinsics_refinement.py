"""Intrinsics as unknowns of the rig problem: what is known of them beforehand, what the motion can tell, what it told.

A lens that is described wrongly bends the rig: with a focal length 3 % off two cameras come out degrees and metres
wrong, with residuals that look fine. So every camera's parameters are estimated with the rig, each with a prior as wide
as its origin deserves. What the motion cannot tell stays at the prior, and its width reaches the rig's covariance.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np

from rigwake._types import Array
from rigwake.ba.solver.covariance import RigCovariance
from rigwake.ba.solver.rig_problem import BundleCamera, RigProblem, VectorPrior
from rigwake.cameras.protocol import CameraModel
from rigwake.cameras.registry import camera_to_dict

IntrinsicsChoice = Literal["fixed", "refine", "find"]
"""What to do about intrinsics: trust them, refine them with the rig, or find them from the motion and then refine."""

_FOCAL = frozenset({"fx", "fy", "mu", "mv", "a0"})
_CENTRE = frozenset({"cx", "cy", "u0", "v0"})
_FEWEST_PIXELS = 50
_UNTOLD = 0.3  # of the prior's deviation: errors that nobody foresees would pull at what is known so little
_BARELY_PX = 0.05  # RMS: lenses of rendered recordings, which are exact, come out 0.02 to 0.05 px off
# deviations by which the motion must contradict what was believed, to be followed: there are tens of directions, and
# the bias of tracks makes 3.5 of exact lenses; a real lens that is a tenth of a pixel off makes 7
_CONTRADICTION = 4.0
FIRMLY, JUDGED = 1e-4, 1e-2  # of the prior's deviation: how held directions are held to solve, and to judge
_NEVER = 1e-6  # what a parameter that is not estimated may move the pixels by
_TURN = "a turn of 60 degrees or more to both sides while near and far points cross the whole picture would show them"


@dataclass(frozen=True)
class IntrinsicsWidth:
    """How far intrinsics may be off, one standard deviation. focal: relative, of both focal lengths together. aspect:
    relative, of one against the other. centre_px. distortion: of every further parameter alone, where the lens was
    used, relative to the distance from the centre."""

    focal: float = 0.005
    centre_px: float = 3.0
    distortion: float = 0.01
    aspect: float = 0.001


FROM_A_FILE = IntrinsicsWidth()
_FLOOR = IntrinsicsWidth(1e-5, 1e-2, 1e-5, 1e-6)  # beside a board's covariance


def intrinsics_prior(
    model: CameraModel, pixels: Array, width: IntrinsicsWidth = FROM_A_FILE, covariance: Array | None = None
) -> VectorPrior:
    """What is known of a lens's parameters beforehand.

    pixels: (N, 2) where it is used. covariance: (P, P) of a calibration with a board, NaN where that told nothing;
    else `width` holds. Parameters that models hold by default (`skew`) stay.
    """
    total = _covariance(model, pixels, width)
    if covariance is not None and covariance.shape == total.shape:
        known = np.isfinite(np.diag(covariance)) & (np.diag(covariance) > 0)
        total[known, :] = 0.0
        total[:, known] = 0.0
        floor = _covariance(model, pixels, _FLOOR)
        total[np.ix_(known, known)] = (covariance + floor)[np.ix_(known, known)]
    scale = 1 / np.sqrt(np.diag(total))
    return VectorPrior(model.params, np.linalg.inv(total * np.outer(scale, scale)) * np.outer(scale, scale))


def _covariance(model: CameraModel, pixels: Array, width: IntrinsicsWidth) -> Array:
    """(P, P): independent, but for the two focal lengths, whose ratio is known better than either."""
    total = np.diag(_stds(model, pixels, width) ** 2)
    focal = [k for k, name in enumerate(model.param_names) if name in _FOCAL]
    if len(focal) == 2:
        sizes = model.params[focal]
        total[np.ix_(focal, focal)] = np.outer(sizes, sizes) * width.focal**2
        total[focal, focal] += (sizes * width.aspect) ** 2 / 2
    return total


def _stds(model: CameraModel, pixels: Array, width: IntrinsicsWidth) -> Array:
    """(P,) deviations: of focal lengths and centre as they are, of the rest by what they do at the pixels' rim."""
    bearings, seen = model.unproject(pixels)
    if seen.sum() < _FEWEST_PIXELS:
        columns, rows = np.meshgrid(
            np.linspace(0, model.width_px - 1, 12), np.linspace(0, model.height_px - 1, 9)
        )
        bearings, seen = model.unproject(np.stack([columns.ravel(), rows.ravel()], axis=1))
    projection = model.project_with_jacobians(bearings[seen])
    centre = model.project(np.array([[0.0, 0.0, 1.0]]))[0]
    radius = float(np.percentile(np.linalg.norm(projection.pixels - centre, axis=1), 98.0))
    moves = np.percentile(np.linalg.norm(projection.d_params, axis=1), 98.0, axis=0)
    held = frozenset(getattr(model, "fixed_by_default", ()))
    std = np.empty(len(moves))
    for k, (name, value) in enumerate(zip(model.param_names, model.params.tolist(), strict=True)):
        per_px = 1 / moves[k] if moves[k] > 0 else 1.0
        if name in held:
            std[k] = _NEVER * per_px
        elif name in _FOCAL:
            std[k] = width.focal * abs(value)
        elif name in _CENTRE:
            std[k] = width.centre_px
        else:
            std[k] = width.distortion * radius * per_px
    return std


@dataclass(frozen=True, eq=False)
class LensBelief:
    """The lens that a prior is about, and how far it may be off."""

    model: CameraModel
    width: IntrinsicsWidth = FROM_A_FILE


def with_free_intrinsics(
    problem: RigProblem, covariances: Mapping[str, Array], beliefs: Mapping[str, LensBelief] | None = None
) -> RigProblem:
    """The problem with the intrinsics of every camera free.

    covariances: by camera, of those that a board calibrated. beliefs: by camera, of those whose prior is not about
    the lens that they have, or not as wide as `FROM_A_FILE`.
    """
    cameras = []
    for index, camera in enumerate(problem.cameras):
        pixels = problem.observations.pixels[problem.observations.camera_indices == index]
        belief = (beliefs or {}).get(camera.name, LensBelief(camera.model))
        prior = intrinsics_prior(belief.model, pixels, belief.width, covariances.get(camera.name))
        cameras.append(replace(camera, free=camera.free | {"intrinsics"}, intrinsics_prior=prior))
    return replace(problem, cameras=tuple(cameras))


@dataclass(frozen=True, eq=False)
class KeptDirections:
    """Directions of one camera's parameters, in deviations of their prior, that stay as believed. Directions, not
    parameters: a polynomial may be known although none of its coefficients is.

    untold: (P, h) along which the motion tells next to nothing. agreeing: (P, g) all others of a lens that is right as
    far as the motion tells: moving there would only add noise. Of a lens that is contradicted along one direction
    there is no reason to believe the others, so these are none. ignored: (P, P) scatter of the scores of the camera's
    parameters that stands for what the motion asked for all the same, clearly but for less than matters: the lens may
    be off by that.
    """

    untold: Array
    agreeing: Array
    ignored: Array


def kept_directions(
    problem: RigProblem, covariance: RigCovariance, believed: Mapping[str, VectorPrior]
) -> dict[str, KeptDirections]:
    """By camera with free intrinsics, what to leave as believed, at the optimum of `problem` and its covariance."""
    found = {}
    alone = replace(covariance, excess=None)  # as the information has it
    for camera in problem.cameras:
        if "intrinsics" in camera.free and camera.name in believed:
            prior = believed[camera.name]
            spread, known = covariance.parameter(camera.name, "intrinsics")
            L = _root(prior)
            # what not even the prior determines beside everything else is as open as the prior leaves it
            if not known.all():
                spread = np.asarray(np.linalg.inv(prior.information))  # then nothing is told, nor ignored
            values, vectors = np.linalg.eigh(np.linalg.solve(L, np.linalg.solve(L, spread).T))
            moved = vectors.T @ np.linalg.solve(L, camera.model.params - prior.mean)
            told = values <= _UNTOLD**2
            contradicts = told & (moved**2 > _CONTRADICTION**2 * values)
            followed = prior.mean + L @ vectors @ np.where(contradicts, moved, 0.0)
            right = _barely_moved(problem, camera, prior, followed)
            off = followed - prior.mean if right else np.zeros(len(moved))
            score = np.linalg.solve(alone.parameter(camera.name, "intrinsics")[0], off) if off.any() else off
            found[camera.name] = KeptDirections(
                vectors[:, ~told], vectors[:, told & right], np.outer(score, score)
            )
    return found


def _barely_moved(problem: RigProblem, camera: BundleCamera, prior: VectorPrior, params: Array) -> bool:
    """Whether these parameters move pixels of this camera by less than what a tracker's own bias makes of an exact
    lens."""
    index = problem.cameras.index(camera)
    pixels = problem.observations.pixels[problem.observations.camera_indices == index]
    lengths = np.linalg.norm(
        moved_px(camera.model.with_params(prior.mean), camera.model.with_params(params), pixels), axis=1
    )
    lengths = lengths[np.isfinite(lengths)]
    return bool(len(lengths)) and float(np.sqrt(np.mean(lengths**2))) < _BARELY_PX


def _root(prior: VectorPrior) -> Array:
    """(P, P) L with `L L^T` the prior's covariance."""
    return np.asarray(np.linalg.cholesky(np.linalg.inv(prior.information)))


def _prior_std(prior: VectorPrior) -> Array:
    return np.asarray(np.sqrt(np.diag(np.linalg.inv(prior.information))))


def priors_of(problem: RigProblem) -> dict[str, VectorPrior]:
    """By camera, what is believed of its intrinsics, where they are free."""
    return {c.name: c.intrinsics_prior for c in problem.cameras if c.intrinsics_prior is not None}


def prior_spreads_of(
    problem: RigProblem, believed: Mapping[str, VectorPrior], ignored: Mapping[str, Array] | None = None
) -> dict[tuple[str, str], Array]:
    """For `covariance_of`: what held parameters may really be off by. ignored: by camera, as of `KeptDirections`.

    The solver was given `T = P^-1 + X` for a prior of covariance P, X large where a parameter is held. Its scores
    really scatter by `T P T`, which is `X + X P X` more than the T that the information takes them for.
    """
    prior_spreads = {}
    for camera in problem.cameras:
        prior, true = camera.intrinsics_prior, believed.get(camera.name)
        if prior is not None and true is not None and "intrinsics" in camera.free:
            X = prior.information - true.information
            held = X + X @ np.linalg.inv(true.information) @ X
            prior_spreads[(camera.name, "intrinsics")] = held + (ignored or {}).get(camera.name, 0.0)
    return prior_spreads


def holding(problem: RigProblem, directions: Mapping[str, Array], width: float) -> RigProblem:
    """The problem with intrinsics held at their prior's mean along directions (by camera, as of `KeptDirections`).

    width: how closely, in deviations of the prior: `FIRMLY` while solving; `JUDGED` for the covariance, which could not
    tell what is much less known than what is held from what is not known at all.
    """
    cameras = []
    for camera in problem.cameras:
        prior, held = camera.intrinsics_prior, directions.get(camera.name)
        if prior is None or held is None or not held.shape[1]:
            cameras.append(camera)
            continue
        L = _root(prior)
        along = np.linalg.solve(L.T, held) / width
        moved = np.linalg.solve(L, camera.model.params - prior.mean)
        values = prior.mean + L @ (moved - held @ (held.T @ moved))
        cameras.append(
            replace(
                camera,
                model=camera.model.with_params(values),
                intrinsics_prior=VectorPrior(prior.mean, prior.information + along @ along.T),
            )
        )
    return replace(problem, cameras=tuple(cameras))


def with_intrinsics_priors_of(problem: RigProblem, source: RigProblem) -> RigProblem:
    """The problem with the intrinsics' priors that another has for the same cameras."""
    cameras = tuple(
        replace(camera, intrinsics_prior=other.intrinsics_prior)
        for camera, other in zip(problem.cameras, source.cameras, strict=True)
    )
    return replace(problem, cameras=cameras)


def moved_px(before: CameraModel, after: CameraModel, pixels: Array) -> Array:
    """(N, 2) how far from the pixels (N, 2) of the first lens the second sees their rays; NaN beyond either lens."""
    bearings, seen = before.unproject(pixels)
    moved = np.full(pixels.shape, np.nan)
    landed, valid = after.project(bearings[seen])
    moved[np.flatnonzero(seen)[valid]] = landed[valid] - pixels[seen][valid]
    return moved


def intrinsics_statistics(
    problem: RigProblem,
    covariance: RigCovariance,
    given: Mapping[str, CameraModel],
    believed: Mapping[str, VectorPrior],
) -> dict[str, dict[str, Any]]:
    """By camera, for `CalibratedCamera.statistics`: parameters given and found, deviations before and after, those that
    the motion did not tell, and by how much pixels moved."""
    found = {}
    for index, camera in enumerate(problem.cameras):
        if "intrinsics" in camera.free and camera.name in believed:
            pixels = problem.observations.pixels[problem.observations.camera_indices == index]
            lens = given.get(camera.name, camera.model)
            found[camera.name] = _one_camera(camera, covariance, lens, believed[camera.name], pixels)
    return found


def _one_camera(
    camera: BundleCamera, covariance: RigCovariance, given: CameraModel, prior: VectorPrior, pixels: Array
) -> dict[str, Any]:
    names, before = camera.model.param_names, _prior_std(prior)
    spread, known = covariance.parameter(camera.name, "intrinsics")
    # what the pose can make up for is as open as it was believed to be
    spread = np.where(known[:, None] & known, spread, np.where(np.eye(len(known)) > 0, before**2, 0.0))
    lost = ~(np.sqrt(np.diag(spread)) < _UNTOLD * before)
    held = frozenset(getattr(camera.model, "fixed_by_default", ()))
    open_names = [name for name, open_ in zip(names, lost, strict=True) if open_ and name not in held]
    length = np.linalg.norm(moved_px(given, camera.model, pixels), axis=1)
    length = length[np.isfinite(length)]

    def by_name(values: Array) -> dict[str, float]:
        return dict(zip(names, values.tolist(), strict=True))

    return {
        "given": by_name(given.params) if given.param_names == names else {},
        "given_camera": camera_to_dict(given),
        "found": by_name(camera.model.params),
        "std": by_name(np.sqrt(np.diag(spread))),
        "prior_std": by_name(before),
        "held": sorted(held),
        "not_determined": open_names,
        "remedy": _TURN if open_names else "",
        "moved_rms_px": float(np.sqrt(np.mean(length**2))) if len(length) else None,
        "moved_max_px": float(length.max()) if len(length) else None,
        "covariance": spread.tolist(),
    }
