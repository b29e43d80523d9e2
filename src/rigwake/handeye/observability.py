"""What the motion determined, how well, in words, and which motion would help.

The information matrix holds two parts: what the true motion gave, and what the noise added spuriously (see `motions`).
Only the first counts. Directions are judged in units at which a result is as good as none: 5 degrees, 1 m,
0.1 s, a factor e in scale. A direction is open when its standard deviation exceeds one such unit, or when the
excitation found does not stand out from the noise. Open directions enter the covariance with ten units, so
that whatever depends on them is as unsure as they are.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from rigwake._types import Array
from rigwake.calibration.rig_calibration import UnobservableDirection
from rigwake.geometry.se3 import SE3, covariance_in_axes_of_a
from rigwake.handeye.handeye_problem import HandeyeProblem
from rigwake.handeye.likelihood import (
    USEFUL_ROTATION,
    USEFUL_TRANSLATION,
    Equations,
    HandeyeEstimate,
    split_observable,
    useful_units,
)

_OPEN_UNITS = 10.0  # how far an open direction may be off: 50 degrees, 10 m
_BLOCKS = (30, 10, 6)  # of time, whose scores are taken to be independent: errors may last for a sixth of it
_LAGS = 10  # poses back, to tell how errors of poses fade
_LONGEST = 0.98  # part of them that is left from pose to pose
_NEGLIGIBLE = 0.02  # component of a direction that is not worth naming


def covariance(problem: HandeyeProblem, estimate: HandeyeEstimate) -> Array:
    """Covariance of all unknowns, open directions included: (P, P).

    Sandwich `H^-1 M H^-1` with H the genuine information. M is the raw information if the noise is known; it
    exceeds H by what the errors of the Jacobians add. If the noise was learnt, M is not less than the
    scatter of the scores over blocks of time, which holds correlation that no model foresaw; errors of poses
    that last for a while (increments are filtered white, poses are not) count as fewer than there are poses. Blocks
    are of several lengths, and along every direction the largest scatter holds: errors of odometry last for minutes.
    """
    equations = estimate.equations
    units = useful_units(problem.layouts)
    split = split_observable(equations, estimate.required_ratio)
    middle = np.eye(len(split.genuine))
    if not problem.has_known_noise:
        middle = middle * (_memory(estimate) if problem.absolute else 1.0)
        for count in _BLOCKS:
            middle = _larger(middle, split.basis.T @ _scatter(equations, count) @ split.basis)
    outer = split.basis / split.genuine
    far = _OPEN_UNITS * split.open(units)
    whole = outer @ middle @ outer.T + far @ far.T
    # rounding beside the large open directions: keeps every later change of axes positive definite
    scaled = np.trace(whole / (units[:, None] * units[None, :]))
    return np.asarray(whole + np.diag(4e-15 * scaled * units**2))


def _larger(first: Array, second: Array) -> Array:
    """A covariance that is nowhere less than either of two, the first positive definite: along each direction in which
    they differ alone, the larger one."""
    L = np.linalg.cholesky(first)
    values, vectors = np.linalg.eigh(np.linalg.solve(L, np.linalg.solve(L, second).T))
    root = L @ vectors
    return np.asarray((root * np.maximum(values, 1.0)) @ root.T)


def _scatter(equations: Equations, blocks_wanted: int) -> Array:
    scores = equations.scores[equations.used]
    count = min(blocks_wanted, len(scores))
    size, longer = divmod(len(scores), count)
    blocks = np.add.reduceat(scores, np.arange(count) * size + np.minimum(np.arange(count), longer))
    return np.asarray(blocks.T @ blocks * (len(blocks) / max(len(blocks) - 1, 1)))


def _memory(estimate: HandeyeEstimate) -> float:
    """How many poses in a row amount to one independent error, of rotation or translation, whichever lasts longer:
    `1 + 2 rho_1 / (1 - phi)` for correlations `rho_k = rho_1 phi^(k-1)` with the k-th pose before, as of an error that
    lasts beside one that does not. (Without the latter phi is rho_1.)"""
    longest = 1.0
    for m, r in enumerate(estimate.residuals):
        valid = estimate.valid[:, m]
        for part in (slice(0, 3), slice(3, 6)):
            rho = np.array([_correlation(r[:, part], valid, lag) for lag in range(1, _LAGS + 1)])
            phi = rho[0]
            if rho[0] > 2 / np.sqrt(3 * max(valid.sum(), 1)):  # stands out of what white errors show
                phi = max(phi, float(rho[:-1] @ rho[1:] / (rho[:-1] @ rho[:-1])))
            longest = max(longest, 1 + 2 * rho[0] / (1 - min(phi, _LONGEST)))
    return longest


def _correlation(rows: Array, valid: NDArray[np.bool_], lag: int) -> float:
    """Of rows (N, 3) with those `lag` before."""
    pairs = valid[lag:] & valid[:-lag]
    before, after = rows[:-lag][pairs], rows[lag:][pairs]
    scale = np.sqrt(np.sum(before**2) * np.sum(after**2))
    return float(np.sum(before * after) / scale) if scale > 0 else 0.0


def unobservable_directions(
    reference: str, member: str, ref_from_member: SE3, member_covariance: Array, rotations: Array
) -> tuple[UnobservableDirection, ...]:
    """Directions of one mounting, in the axes of the reference, that are unobservable.

    member_covariance: (6, 6) right tangent. turns: (N, 3) rotation vectors of the reference's motion.
    """
    units = np.repeat([USEFUL_ROTATION, USEFUL_TRANSLATION], 3)
    scaled = covariance_in_axes_of_a(ref_from_member, member_covariance) / (units[:, None] * units[None, :])
    values, vectors = np.linalg.eigh(scaled)
    wide = vectors[:, values > 1.0] * units[:, None]
    directions = [_tidy(v) for v in _translations_first(wide)]
    return tuple(
        UnobservableDirection(d, _words(d, reference, member), _remedy(d, directions, rotations))
        for d in directions
    )


def _translations_first(wide: Array) -> list[Array]:
    """A basis of the columns' span that begins with its pure translations, along the axes if all are open."""
    if not wide.shape[1]:
        return []
    basis, _ = np.linalg.qr(wide)
    _, singular, Vt = np.linalg.svd(basis[:3])
    padded = np.concatenate([singular, np.zeros(Vt.shape[0] - len(singular))])
    pure = basis @ Vt[padded < _NEGLIGIBLE].T
    rest = basis @ Vt[padded >= _NEGLIGIBLE].T
    for coupled in rest.T:
        if np.linalg.norm(coupled[3:]) > _NEGLIGIBLE:
            # turning on moves the member along an arc: every offset across the axis is open with it
            across = np.linalg.svd(coupled[None, :3])[2][1:]
            pure = np.concatenate([pure, np.vstack([np.zeros((3, 2)), across.T])], axis=1)
    basis, size, _ = np.linalg.svd(pure, full_matrices=False)
    pure = basis[:, size > _NEGLIGIBLE]
    if pure.shape[1] == 3:
        pure = np.eye(6)[:, 3:]
    rest[3:] -= pure[3:] @ (pure[3:].T @ rest[3:])
    return [*pure.T, *rest.T]


def _tidy(direction: Array) -> Array:
    """Unit length, negligible components zero, largest component positive."""
    d = direction / np.linalg.norm(direction)
    d = np.where(np.abs(d) < _NEGLIGIBLE, 0.0, d)
    d = d / np.linalg.norm(d)
    return d * np.sign(d[np.argmax(np.abs(d))])


def _words(direction: Array, reference: str, member: str) -> str:
    parts = []
    for kind, vector in (("rotation about", direction[:3]), ("offset along", direction[3:])):
        if np.any(vector):
            parts.append(f"{kind} {_axis_words(vector)} of {reference}")
    coupled = " together with " if len(parts) == 2 else ""
    return f"{member}: {coupled.join(parts)}"


def _axis_words(vector: Array) -> str:
    unit = vector / np.linalg.norm(vector)
    main = int(np.argmax(np.abs(unit)))
    if abs(unit[main]) > np.cos(np.deg2rad(2.0)):
        return "xyz"[main]
    return "the direction (" + ", ".join(f"{u:+.2f}" for u in unit) + ")"


def _remedy(direction: Array, all_open: Sequence[Array], rotations: Array) -> str:
    translations = sum(not np.any(d[:3]) for d in all_open)
    if np.any(direction[:3]):
        return "Move in a second direction, or turn about a second axis."
    if translations >= 2:
        return "Turn through at least 60 degrees, to both sides."
    spread = np.linalg.svd(rotations, compute_uv=False) if len(rotations) else np.zeros(3)
    if spread[0] > 0 and len(rotations):
        return "Record where waves (or a ramp, or a crane) roll and pitch the vehicle by some degrees."
    return "Turn about a second axis."
