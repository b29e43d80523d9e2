"""Which stretches to use: the fewest that tell about every parameter what was asked for.

Greedy choice by the determinant of the information (D-optimal design). The gain of a stretch only shrinks as others
are chosen (submodularity), so the greedy set is close to the best one: Nemhauser, Wolsey, Fisher (1978); for
selecting measurements Carlone and Karaman, *Attention and Anticipation in Fast Visual-Inertial Navigation* (2019).
"""

from __future__ import annotations

import heapq
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from rigwake._types import Array, Indices
from rigwake.sections.stretch_information import StretchInformation

_FEWEST_TOGETHER = 3  # stretches of the first piece: initial values come from an unbroken one
_WORTH_KNOWING = (np.deg2rad(1.0), 0.2)  # rad, m: what all of it tells no better than this decides nothing
_UNOBSERVABLE = (np.deg2rad(5.0), 1.0)  # rad, m: the limits of the result
_WORTH = 0.05  # of sigma: what all that is left must gain to be worth it
_TINY = 1e-9


@dataclass(frozen=True)
class Precision:
    """Asked sigmas of every camera, worst axis: of its rotation (rad) and its place (m); None where not asked."""

    rotation: float | None = None
    translation: float | None = None


@dataclass(frozen=True)
class CameraSigmas:
    """Predicted sigmas of one camera along its worst axis, among those that the recording tells to a degree and 20 cm;
    rad and m. unobservable: how many of its six axes it tells no better."""

    rotation: float
    translation: float
    unobservable: int = 0


@dataclass(frozen=True, eq=False)
class SectionChoice:
    """stretches: (n,) chosen rows, in time order. sections_ns: merged (begin, end). predicted: sigmas by camera with
    them; whole: with all of the recording. reason: why no more were taken."""

    stretches: Indices
    sections_ns: tuple[tuple[int, int], ...]
    predicted: Mapping[str, CameraSigmas]
    whole: Mapping[str, CameraSigmas]
    reason: str

    @property
    def seconds(self) -> float:
        """Length of all sections together."""
        return sum(end - begin for begin, end in self.sections_ns) * 1e-9


class WhitenedInformation:
    """Information in units of what the whole recording tells.

    Of each camera's turn and place the axes count that the whole recording tells to `limits` (rad, m): along the
    others no choice makes a difference worth its time.
    """

    def __init__(self, information: StretchInformation, limits: tuple[float, float] = _WORTH_KNOWING) -> None:
        total = information.of(np.arange(len(information)))
        scale = np.sqrt(np.maximum(np.diag(total), _TINY))
        # what nothing tells is given next to nothing, so that all can be inverted
        scaled = total / np.outer(scale, scale) + _TINY * np.eye(len(total))
        values, vectors = np.linalg.eigh(scaled)
        self.basis = vectors / scale[:, None] / np.sqrt(np.maximum(values, _TINY))
        weak = _TINY * np.diag(scale**2)
        self.prior = np.asarray(self.basis.T @ (information.prior + weak) @ self.basis)
        self.matrices = np.einsum(
            "ka,skl,lb->sab", self.basis, information.matrices, self.basis, optimize=True
        )
        self.parts: dict[str, tuple[tuple[slice, Array], ...]] = {}
        for name in information.cameras:
            first = information.parameters[name, "rig_from_cam"].start
            turn, place = slice(first, first + 3), slice(first + 3, first + 6)
            self.parts[name] = tuple(
                (part, _axes_within(self.basis[part], limit))
                for part, limit in zip((turn, place), limits, strict=True)
            )

    def information(self, chosen: list[int]) -> Array:
        """(k, k) whitened information of these stretches."""
        return np.asarray(self.prior + self.matrices[chosen].sum(axis=0))

    def sigmas(self, chosen: list[int]) -> dict[str, CameraSigmas]:
        """Predicted sigmas of every camera with these stretches."""
        values, vectors = np.linalg.eigh(self.information(chosen))
        half = self.basis @ (vectors / np.sqrt(np.maximum(values, _TINY)))
        found = {}
        for name, parts in self.parts.items():
            turn, place = (_largest_std(axes.T @ half[part]) for part, axes in parts)
            found[name] = CameraSigmas(turn, place, 6 - sum(axes.shape[1] for _, axes in parts))
        return found


def _axes_within(half: Array, limit: float) -> Array:
    """(3, n) principal axes of a covariance `half @ half.T` (3, 3) along which its sigma is within the limit."""
    variances, axes = np.linalg.eigh(half @ half.T)
    return np.asarray(axes[:, variances <= limit**2])


def _largest_std(half: Array) -> float:
    """Largest sigma of a covariance `half @ half.T`; 0 for none."""
    return float(np.linalg.norm(half, 2)) if half.size else 0.0


def tells_no_place(information: StretchInformation) -> bool:
    """Whether even all of it leaves the place of every camera unobservable, along any axis."""
    sigmas = WhitenedInformation(information, _UNOBSERVABLE).sigmas(list(range(len(information))))
    return bool(sigmas) and all(s.unobservable >= 3 for s in sigmas.values())


def choose_sections(
    information: StretchInformation,
    costs: Array,
    *,
    precision: Precision | None = None,
    budget: float | None = None,
    in_one_piece: bool = False,
    use_all: str = "",
) -> SectionChoice:
    """The sections to use.

    costs: (S,) CPU-seconds of each stretch; budget: the most that may be spent on them. precision: sigmas to reach;
    without, stretches are taken until all that is left would gain less than 5 %. in_one_piece: they must touch (where
    nothing tells how the rig moved from one to the next). use_all: why all of it is to be used, and only predicted.
    """
    whitened = WhitenedInformation(information)
    everything = list(range(len(information)))
    whole = whitened.sigmas(everything)
    if use_all or len(everything) <= _FEWEST_TOGETHER:
        return _chosen(information, everything, whole, whole, use_all or "it is short")
    enough, why_enough = _goal(whole, precision)
    afford = np.inf if budget is None else budget
    pick = _window if in_one_piece else _greedy
    chosen, reason = pick(whitened, costs, afford, enough)
    words = {
        "enough": why_enough,
        "budget": "more would take more CPU time than allowed",
        "": "nothing else is left",
    }
    return _chosen(information, sorted(chosen), whitened.sigmas(chosen), whole, words[reason])


def _goal(
    whole: Mapping[str, CameraSigmas], precision: Precision | None
) -> tuple[Callable[[Mapping[str, CameraSigmas]], bool], str]:
    """When it is enough, and how to say so."""

    def gains_little(sigmas: Mapping[str, CameraSigmas]) -> bool:
        return all(
            s.rotation * (1 - _WORTH) <= whole[name].rotation
            and s.translation * (1 - _WORTH) <= whole[name].translation
            for name, s in sigmas.items()
        )

    little = f"all that is left would make the sigmas less than {100 * _WORTH:.0f} % smaller"
    if precision is None:
        return gains_little, little
    rotation = np.inf if precision.rotation is None else precision.rotation
    translation = np.inf if precision.translation is None else precision.translation

    def reached(sigmas: Mapping[str, CameraSigmas]) -> bool:
        return all(s.rotation <= rotation and s.translation <= translation for s in sigmas.values())

    if not reached(whole):
        return gains_little, f"the whole recording does not reach the precision asked for; {little}"
    return reached, "the precision asked for is reached"


def _chosen(
    information: StretchInformation,
    rows: list[int],
    predicted: Mapping[str, CameraSigmas],
    whole: Mapping[str, CameraSigmas],
    reason: str,
) -> SectionChoice:
    sections: list[tuple[int, int]] = []
    for row in rows:
        begin, end = information.spans_ns[row].tolist()
        if sections and sections[-1][1] == begin:
            begin = sections.pop()[0]
        sections.append((begin, end))
    return SectionChoice(np.array(rows, dtype=np.int64), tuple(sections), predicted, whole, reason)


_Enough = Callable[[Mapping[str, CameraSigmas]], bool]


def _greedy(
    whitened: WhitenedInformation, costs: Array, budget: float, enough: _Enough
) -> tuple[list[int], str]:
    """The best piece of a few stretches, then the stretch that tells most per CPU-second, again and again."""
    chosen = list(_best_window(whitened, _FEWEST_TOGETHER))
    spent = float(costs[chosen].sum())
    left = [row for row in range(len(costs)) if row not in chosen]
    now = whitened.information(chosen)
    # gains only shrink: a stale one is an upper bound, and only the first of the queue is computed anew
    queue = [(-_gain(now, whitened.matrices[row]) / costs[row], row, len(chosen)) for row in left]
    heapq.heapify(queue)
    while queue:
        if enough(whitened.sigmas(chosen)):
            return chosen, "enough"
        _, row, computed_at = heapq.heappop(queue)
        if computed_at < len(chosen):
            heapq.heappush(queue, (-_gain(now, whitened.matrices[row]) / costs[row], row, len(chosen)))
            continue
        if spent + costs[row] > budget:
            return chosen, "budget"
        chosen.append(row)
        spent += float(costs[row])
        now = now + whitened.matrices[row]
    return chosen, "enough" if enough(whitened.sigmas(chosen)) else ""


def _window(
    whitened: WhitenedInformation, costs: Array, budget: float, enough: _Enough
) -> tuple[list[int], str]:
    """The shortest piece that is enough, among pieces that grow by a quarter."""
    length, last = _FEWEST_TOGETHER, list(_best_window(whitened, _FEWEST_TOGETHER))
    while not enough(whitened.sigmas(last)):
        if length == len(costs):
            return last, ""
        length = min(max(length + 1, length * 5 // 4), len(costs))
        longer = list(_best_window(whitened, length))
        if float(costs[longer].sum()) > budget:
            return last, "budget"
        last = longer
    return last, "enough"


def _best_window(whitened: WhitenedInformation, length: int) -> range:
    """The rows in a piece that tell most."""
    total = np.concatenate([np.zeros_like(whitened.matrices[:1]), np.cumsum(whitened.matrices, axis=0)])
    sums = total[length:] - total[:-length] + whitened.prior
    told = np.linalg.slogdet(sums + _floor(len(whitened.prior)))[1]
    first = int(np.argmax(told))
    return range(first, first + length)


def _gain(now: Array, more: Array) -> float:
    floor = _floor(len(now))
    return float(np.linalg.slogdet(now + more + floor)[1] - np.linalg.slogdet(now + floor)[1])


def _floor(size: int) -> Array:
    """So little that it only keeps determinants from vanishing."""
    return 1e-6 * np.eye(size)
