"""When did which camera begin to disagree? A generalised likelihood ratio over windows of one to twelve blocks."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from rigwake._types import Array
from rigwake.monitor.innovations import PARTS, TRANSLATION, Innovations, window_statistic
from rigwake.monitor.thresholds import Thresholds

ChangeKind = Literal["step", "ramp"]
_RAMP_EVIDENCE = 6.0  # log likelihood over a step
_SEEN = np.deg2rad(5.0) ** -2  # information about a direction that counts at all
_SEEN_SHIFT = 1.0  # 1 / m^2: less is no information about a shift
_SETTLED = 6  # blocks since the change that a ramp needs at least


@dataclass(frozen=True, eq=False)
class BlockStatistics:
    """Per block and camera the largest likelihood ratio (B, C), its window's first block (B, C), and whether it is
    against the steady state (B, C). std_deg: (B, C, 3) of a step over the longest window about each camera's axes."""

    value: Array
    first: NDArray[np.int64]
    steady: NDArray[np.bool_]
    std_deg: Array


@dataclass(frozen=True, eq=False)
class Change:
    """A change of one camera's rotation.

    block: the first after it. rotation: (3,) rad in rig axes, of a step, or up to the last block of a ramp;
    covariance (3, 3). rate_deg_per_hour: of a ramp, else 0. evidence: log likelihood over no change.
    """

    camera: str
    block: int
    kind: ChangeKind
    rotation: Array
    covariance: Array
    rate_deg_per_hour: float
    evidence: float

    @property
    def size_deg(self) -> float:
        """Angle in degrees."""
        return float(np.rad2deg(np.linalg.norm(self.rotation)))

    @property
    def std_deg(self) -> float:
        """Standard deviation of the angle in degrees."""
        size = np.linalg.norm(self.rotation)
        along = self.rotation / size if size > 0 else np.array([1.0, 0, 0])
        return float(np.rad2deg(np.sqrt(along @ self.covariance @ along)))


def glr(found: Innovations, thresholds: Thresholds, axes: Array | None = None) -> BlockStatistics:
    """The statistic of every block and camera, from the blocks up to it alone.

    axes: (C, 3, 3), rows, about which a camera's steps are told; the rig's by default.
    """
    return replace(likelihood_ratios(found, thresholds), std_deg=window_std_deg(found, thresholds, axes))


def likelihood_ratios(found: Innovations, thresholds: Thresholds) -> BlockStatistics:
    """As `glr`, without saying how well steps are seen: infinite standard deviations."""
    scores = found.scores
    shape = len(scores), len(scores.cameras)
    value, first, steady = np.zeros(shape), np.zeros(shape, dtype=np.int64), np.zeros(shape, dtype=bool)
    sums = _Sums.of(found)
    for k in range(shape[0]):
        for against in (False, True):
            if against and found.steady[k] is found.belief:
                continue
            longest = min(thresholds.steady_lag if against else thresholds.longest, k + 1)
            starts = np.arange(k + 1 - thresholds.shortest, k - longest, -1)
            if not len(starts):
                continue
            ratios = np.where(scores.rows[starts] > 0, sums.ratios(found, starts, k, steady=against), 0.0)
            best = np.argmax(ratios, axis=0)
            largest = ratios[best, np.arange(shape[1])]
            better = largest > value[k]
            value[k] = np.where(better, largest, value[k])
            first[k] = np.where(better, starts[best], first[k])
            steady[k] = np.where(better, against, steady[k])
    return BlockStatistics(value, first, steady, np.full((*shape, 3), np.inf))


def window_std_deg(found: Innovations, thresholds: Thresholds, axes: Array | None = None) -> Array:
    """(B, C, 3) of a step over the longest window up to each block, about each camera's axes; infinite where unseen."""
    shape = len(found.scores), len(found.scores.cameras)
    if axes is None:
        axes = np.tile(np.eye(3), (shape[1], 1, 1))
    std = np.full((*shape, 3), np.inf)
    for k in range(shape[0]):
        for c in range(shape[1]):
            std[k, c] = step_std_deg(found, c, max(k - thresholds.longest + 1, 0), k, axes[c])
    return std


@dataclass(frozen=True, eq=False)
class _Sums:
    """Sums over the blocks before each (B + 1, ..): normal matrices, their noise, and both kinds of clipped scores."""

    H: Array
    noise: Array
    by_calibration: Array
    by_steady: Array

    @classmethod
    def of(cls, found: Innovations) -> _Sums:
        scores = found.scores
        wide = scores.by_column(scores.inflation)
        return cls(
            _summed(scores.H),
            _summed(scores.H * wide[:, :, None]),
            _summed(found.g_calibration),
            _summed(found.g_steady),
        )

    def ratios(self, found: Innovations, starts: NDArray[np.int64], last: int, *, steady: bool) -> Array:
        """(W, C) likelihood ratios of windows `starts .. last`: the largest of rotation, translation and clock."""
        believed = found.steady[last] if steady else found.belief
        H = self.H[last + 1] - self.H[starts]
        open_part = H @ believed.covariance @ np.swapaxes(H, 1, 2)
        noise = self.noise[last + 1] - self.noise[starts]
        g = self.by_steady if steady else self.by_calibration
        g = g[last + 1] - g[starts]
        cameras = g.shape[1]
        V = np.zeros((len(starts), cameras, len(PARTS), 3, 3))
        for c in range(cameras):
            for part in PARTS:
                at = found.scores.columns(c, part)
                n = at.stop - at.start
                V[:, c, part, :n, :n] = found.spread[last, c, part] * noise[:, at, at] + open_part[:, at, at]
        inverse = np.linalg.pinv((V + np.swapaxes(V, -1, -2)) / 2, rcond=1e-9, hermitian=True)
        return np.asarray(np.einsum("wcpi,wcpij,wcpj->wcp", g, inverse, g).max(axis=2))


def _summed(values: Array) -> Array:
    """(B + 1, ..) sums of the rows before each."""
    return np.concatenate([np.zeros((1, *values.shape[1:])), np.cumsum(values, axis=0)])


def step_std_deg(found: Innovations, camera: int, first: int, last: int, axes: Array) -> Array:
    """(3,) degrees: how well blocks `first .. last` see a step about each of the axes (3, 3); infinite where not."""
    scores = found.scores
    at = scores.columns(camera)
    values, vectors = np.linalg.eigh(scores.H[first : last + 1, at, at].sum(axis=0))
    weak = values < _SEEN
    steady = found.steady[last] is not found.belief
    _, _, covariance = window_statistic(found, camera, first, last, steady=steady)
    std = np.rad2deg(np.sqrt(np.maximum(np.einsum("ai,ij,aj->a", axes, covariance, axes), 0.0)))
    if weak.any():
        std[np.abs(axes @ vectors[:, weak]).max(axis=1) > 0.05] = np.inf
    return np.asarray(std)


def shift_std_m(found: Innovations, thresholds: Thresholds) -> Array:
    """(C, 3) metres: how well the longest window up to the last block sees a shift of each camera, rotation and clock
    held; infinite where not."""
    scores, last = found.scores, len(found.scores) - 1
    std = np.full((len(scores.cameras), 3), np.inf)
    for camera in range(len(std) if last >= 0 else 0):
        first = max(last - thresholds.longest + 1, 0)
        steady = found.steady[last] is not found.belief
        at = scores.columns(camera, TRANSLATION)
        if np.linalg.eigvalsh(scores.H[first : last + 1, at, at].sum(axis=0))[0] < _SEEN_SHIFT:
            continue
        covariance = window_statistic(found, camera, first, last, steady=steady, part=TRANSLATION)[2]
        std[camera] = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    return std


def fit_change(found: Innovations, camera: int, last: int, earliest: int = 0) -> Change:
    """Step or ramp of a camera, when, and how much: the largest likelihood over all times, unclipped.

    The calibration's own error is an unknown offset before and after. A ramp starts from nothing and goes on.
    """
    scores = found.scores
    at = scores.columns(camera)
    inflation = scores.inflation[: last + 1, camera]
    H = np.asarray(scores.H[: last + 1, at, at] / inflation[:, None, None], dtype=np.float64)
    g = np.asarray(scores.g[: last + 1, at] / inflation[:, None], dtype=np.float64)
    offset: Array = np.asarray(
        np.linalg.inv(found.belief.covariance[at, at] + 1e-16 * np.eye(3)), dtype=np.float64
    )
    best: Change | None = None
    for kind, least in (("step", 1), ("ramp", _SETTLED)):
        for start in range(earliest, last + 2 - least):
            since = np.zeros(last + 1)
            since[start:] = 1.0 if kind == "step" else np.arange(last + 1 - start) + 0.5
            change = _fit(H, g, since, offset)
            advantage = change[2] - (_RAMP_EVIDENCE if kind == "ramp" else 0.0)
            if best is None or advantage > best.evidence:
                factor = since[last] if kind == "ramp" else 1.0
                rate = float(np.rad2deg(np.linalg.norm(change[0]))) * 360.0 if kind == "ramp" else 0.0
                best = Change(
                    scores.cameras[camera],
                    start,
                    "ramp" if kind == "ramp" else "step",
                    change[0] * factor,
                    change[1] * factor**2,
                    rate,
                    advantage,
                )
    assert best is not None
    return best


def _fit(H: Array, g: Array, since: Array, offset: Array) -> tuple[Array, Array, float]:
    """Change (3,), covariance and evidence of `rotation = offset + since * change`."""
    A = np.zeros((6, 6))
    A[:3, :3] = H.sum(axis=0) + offset
    A[:3, 3:] = np.einsum("b,bij->ij", since, H)
    A[3:, :3] = A[:3, 3:].T
    A[3:, 3:] = np.einsum("b,bij->ij", since**2, H) + 1e-3 * np.eye(3)
    b = np.concatenate([g.sum(axis=0), since @ g])
    inverse = np.linalg.inv(A)
    x = inverse @ b
    alone = np.linalg.solve(A[:3, :3], b[:3])
    return np.asarray(x[3:]), np.asarray(inverse[3:, 3:]), 0.5 * float(x @ b - alone @ b[:3])
