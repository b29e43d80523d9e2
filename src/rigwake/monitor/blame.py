"""Whose change is it? Explanations compared by their unclipped evidence over the same blocks."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from rigwake._types import Array
from rigwake.geometry import so3
from rigwake.monitor.innovations import Innovations
from rigwake.monitor.pair_kernels import MOUNTING

Cause = Literal["rotation", "translation", "clock", "imu", "imu clock", "picture"]
_PER_UNKNOWN = 2.0  # log likelihood that an explanation pays for each of its numbers
_STEPS = {"rotation": np.deg2rad(1.0), "translation": 0.05, "clock": 0.02}  # what is thought possible
_SECTOR_EVIDENCE = 20.0  # chi-square per degree of freedom; a camera that turned by 5 deg gives 10


@dataclass(frozen=True, eq=False)
class Explanation:
    """One cause: of which camera ("" for the whole rig), how large (its numbers and covariance), how likely.

    evidence: log likelihood over no change, less what its numbers cost.
    """

    cause: Cause
    camera: str
    value: Array
    covariance: Array
    evidence: float

    @property
    def words(self) -> str:
        """What happened, in words."""
        size = float(np.linalg.norm(self.value))
        match self.cause:
            case "rotation":
                return f"{self.camera} turned by {np.rad2deg(size):.2f} deg"
            case "translation":
                return f"{self.camera} shifted by {100 * size:.1f} cm"
            case "clock":
                return f"the clock of {self.camera} jumped by {1e3 * float(self.value[0]):+.0f} ms"
            case "imu":
                return f"the IMU turned by {np.rad2deg(size):.2f} deg against all cameras"
            case "imu clock":
                return f"the clock of the IMU jumped by {-1e3 * float(self.value[0]):+.0f} ms against all cameras"
            case "picture":
                return f"the picture of {self.camera} is bent in part: a drop or dirt on its lens?"


def explain(
    found: Innovations,
    first: int,
    last: int,
    places: Mapping[str, Array],
    *,
    steady: bool,
    whole_rig: bool = False,
) -> list[Explanation]:
    """All explanations of blocks `first .. last`, the most likely first. places: (3,) of the cameras on the rig.

    whole_rig: only those that concern no single camera.
    """
    scores = found.scores
    believed = found.steady[last] if steady else found.belief
    H = scores.H[first : last + 1].sum(axis=0)
    g = scores.g[first : last + 1].sum(axis=0) - H @ believed.mean
    weight = scores.rows[first : last + 1] + 1e-9
    inflation = (scores.inflation[first : last + 1] * weight).sum(axis=0) / weight.sum(axis=0)
    spread = np.sqrt(scores.by_column(inflation))
    V = H * np.outer(spread, spread) + H @ believed.covariance @ H.T
    explanations = []
    for cause, camera, P, sizes in _causes(scores.cameras, places, len(g)):
        if camera and whole_rig:
            continue
        explanations.append(_weigh(cause, camera, P, sizes, H, g, V))
    explanations.sort(key=lambda e: -e.evidence)
    return explanations


def _causes(
    cameras: tuple[str, ...], places: Mapping[str, Array], size: int
) -> list[tuple[Cause, str, Array, float]]:
    """Cause, camera, directions (size, k) that it may take, and the size that is thought possible."""
    identity = np.eye(size)
    causes: list[tuple[Cause, str, Array, float]] = []
    imu, clock = np.zeros((size, 3)), np.zeros((size, 1))
    for k, name in enumerate(cameras):
        at = MOUNTING * k
        causes.append(("rotation", name, identity[:, at : at + 3], _STEPS["rotation"]))
        causes.append(("translation", name, identity[:, at + 3 : at + 6], _STEPS["translation"]))
        causes.append(("clock", name, identity[:, at + 6 : at + 7], _STEPS["clock"]))
        # the IMU turned by d: every camera turns by -d about it
        imu[at : at + 3] = -np.eye(3)
        imu[at + 3 : at + 6] = so3.hat(places[name])
        clock[at + 6] = 1.0
    causes.append(("imu", "", imu, _STEPS["rotation"]))
    causes.append(("imu clock", "", clock, _STEPS["clock"]))
    return causes


def _weigh(cause: Cause, camera: str, P: Array, size: float, H: Array, g: Array, V: Array) -> Explanation:
    """Evidence of changes in the directions P: `score' (P' V P)^-1 score / 2`, with a prior of their size."""
    score, information, variance = P.T @ g, P.T @ H @ P, P.T @ V @ P
    inverse = np.linalg.pinv(information + 1e-12 * np.eye(len(score)), hermitian=True)
    covariance = inverse @ variance @ inverse
    value = inverse @ score
    prior = size**2 * np.eye(len(score))
    # likelihood of the estimate with and without a change of that size
    with_change = np.linalg.pinv(covariance + prior, hermitian=True)
    without = np.linalg.pinv(covariance, hermitian=True)
    evidence = 0.5 * float(value @ without @ value - value @ with_change @ value)
    return Explanation(cause, camera, value, covariance, evidence - _PER_UNKNOWN * len(score))


def support(claim: Explanation, explanations: Sequence[Explanation]) -> float:
    """Log likelihood that other scores give a claim's value over no change. explanations: of these scores."""
    own = next(e for e in explanations if (e.cause, e.camera) == (claim.cause, claim.camera))
    pull = np.linalg.pinv(own.covariance, hermitian=True) @ claim.value
    return float(pull @ own.value - 0.5 * pull @ claim.value)


def bent_pictures(found: Innovations, first: int, last: int) -> dict[str, float]:
    """By camera, how much the quarters of its image disagree about its rotation: chi-square per degree of freedom.

    A camera that turned turns all of its image; a drop on the lens bends a part.
    """
    scores = found.scores
    disagreement = {}
    sums = scores.sectors[first : last + 1].sum(axis=0)
    for c, name in enumerate(scores.cameras):
        H, g = sums[c, :, :3, :3], sums[c, :, :3, 3]
        noise = scores.inflation[first : last + 1, c].mean()
        whole = np.linalg.pinv(H.sum(axis=0), hermitian=True) @ g.sum(axis=0)
        rest = g - H @ whole
        squares = [
            float(r @ np.linalg.pinv(h, rcond=1e-6, hermitian=True) @ r) for h, r in zip(H, rest, strict=True)
        ]
        disagreement[name] = sum(squares) / (3 * (len(squares) - 1) * noise)
    return disagreement


def strong_bend(disagreement: Mapping[str, float], usual: Mapping[str, float]) -> str:
    """The camera whose picture is bent in part, far beyond what is usual; "" if none."""
    excess = {
        name: value / float(np.clip(usual.get(name, 1.0), 1.0, 2.0)) for name, value in disagreement.items()
    }
    worst = max(excess, key=lambda name: excess[name], default="")
    return worst if worst and excess[worst] > _SECTOR_EVIDENCE else ""
