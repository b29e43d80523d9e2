"""A clock that was set back while recording: samples of two different times bear the same stamps.

Sorting by stamp would weave both together, so the longest stretch between the steps is kept. A message that comes
late, or a batch of them, fills a gap and is no such step.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import TypeVar

import numpy as np

from rigwake._types import Indices, Stamps
from rigwake.excerpt import window
from rigwake.recording import Finding, Recording

_SMALLEST_STEP_NS = 10**8
_MIN_SHARED = 3  # samples after a step whose stamps lie between those before it
_GAP_PERIODS = 3.0
_MOST_STEPS = 5  # a clock that is set more often is none: its samples are sorted
_SAME_EVENT_NS = 2 * 10**9
_STREAMS = ("cameras", "imus", "gnss", "attitudes", "poses")
_Sensor = TypeVar("_Sensor")


@dataclass(frozen=True)
class ClockSetBack(Finding):
    """A sensor's stamps step back for good. before_ns, after_ns: the stamps around each step, in order of recording.
    kept: which stretch, 0 being the one before the first step."""

    before_ns: tuple[int, ...] = ()
    after_ns: tuple[int, ...] = ()
    kept: int = 0


def set_back_rows(timestamps_ns: Stamps) -> Indices:
    """The rows, in order of recording, at which a clock that was set back goes on; empty if it was not."""
    stamps = np.asarray(timestamps_ns, dtype=np.int64)
    steps = np.flatnonzero(np.diff(stamps) < -_SMALLEST_STEP_NS) + 1
    found: list[int] = []
    start = 0
    for row, end in pairwise([*steps.tolist(), len(stamps)]):
        if _are_woven(stamps[start:row], stamps[row:end]):
            found.append(row)
            start = row
    return np.array(found if len(found) <= _MOST_STEPS else [], dtype=np.int64)


def _are_woven(before: Stamps, after: Stamps) -> bool:
    """Whether samples of one side lie between samples of the other that follow each other without a gap."""
    ordered = np.sort(before)
    usual = float(np.median(np.diff(ordered))) if len(ordered) > 1 else 0.0
    place = np.searchsorted(ordered, after)
    inside = (
        (place > 0) & (place < len(ordered)) & ~np.isin(after, ordered)
    )  # what was recorded twice is the same
    low, high = ordered[np.maximum(place - 1, 0)], ordered[np.minimum(place, len(ordered) - 1)]
    return int((inside & (high - low < _GAP_PERIODS * usual)).sum()) >= _MIN_SHARED


def longest_between_steps(sensor: str, timestamps_ns: Stamps) -> tuple[slice, list[Finding]]:
    """The rows to keep of samples in order of recording, and what was left out."""
    stamps = np.asarray(timestamps_ns, dtype=np.int64)
    rows = set_back_rows(stamps)
    if not len(rows):
        return slice(None), []
    bounds = [0, *rows.tolist(), len(stamps)]
    parts = [slice(*pair) for pair in pairwise(bounds)]
    kept = max(range(len(parts)), key=lambda k: (int(np.ptp(stamps[parts[k]])), k))
    worst_s = float((stamps[rows - 1] - stamps[rows]).max()) * 1e-9
    words = (
        f"its clock was set back while recording, by up to {worst_s:.3g} s: time goes back {len(rows)} times. The "
        f"longest stretch between, {float(np.ptp(stamps[parts[kept]])) * 1e-9:.1f} s, is used."
    )
    before, after = (tuple(stamps[at].tolist()) for at in (rows - 1, rows))
    return parts[kept], [ClockSetBack("error", sensor, words, before, after, kept)]


def on_one_clock(recording: Recording) -> Recording:
    """All sensors within the stretch that one clock covers, where the clock of the computer was set back.

    Sensors that sample too slowly to show the step lose what may lie on either side of it. One that kept another
    stretch than the others is left out. If fewer than half of the sensors that must show the step do, it was the
    clock of a single sensor, and the others stay as they are.
    """
    steps = [f for f in recording.findings if isinstance(f, ClockSetBack)]
    if not steps:
        return recording
    main = max(steps, key=lambda f: (sum(_same_event(f, other) for other in steps), f.sensor))
    agreeing = {f.sensor for f in steps if _same_event(f, main) and f.kept == main.kept}
    opposed = {f.sensor for f in steps if _same_event(f, main) and f.kept != main.kept}
    shown = len(agreeing) + len(opposed)
    silent = [name for name, stamps in _stamps(recording) if _must_show(stamps, main)]
    if len([name for name in silent if name not in agreeing | opposed]) > shown:
        return recording
    first, last = _certain_time(main)
    cut = agreeing | opposed
    others = replace(
        recording,
        cameras={n: s for n, s in recording.cameras.items() if n not in cut},
        imus={n: s for n, s in recording.imus.items() if n not in cut},
        gnss={n: s for n, s in recording.gnss.items() if n not in cut},
        attitudes={n: s for n, s in recording.attitudes.items() if n not in cut},
        poses={n: s for n, s in recording.poses.items() if n not in cut},
    )
    part = window(others, first, last)
    words = (
        "left out: its clock was set back too, and its longest stretch is another than that of the others."
    )
    lost = tuple(Finding("error", name, words) for name in sorted(opposed))
    return replace(
        part,
        cameras=_with(part.cameras, recording.cameras, agreeing),
        imus=_with(part.imus, recording.imus, agreeing),
        gnss=_with(part.gnss, recording.gnss, agreeing),
        attitudes=_with(part.attitudes, recording.attitudes, agreeing),
        poses=_with(part.poses, recording.poses, agreeing),
        findings=(*part.findings, *lost),
    )


def _with(
    kept: Mapping[str, _Sensor], all_of_them: Mapping[str, _Sensor], names: set[str]
) -> dict[str, _Sensor]:
    """Those kept and those of these names, in the order of all."""
    return {n: kept.get(n, s) for n, s in all_of_them.items() if n in kept or n in names}


def _same_event(one: ClockSetBack, other: ClockSetBack) -> bool:
    return len(one.before_ns) == len(other.before_ns) and bool(
        (np.abs(np.subtract(one.before_ns, other.before_ns)) < _SAME_EVENT_NS).all()
        and (np.abs(np.subtract(one.after_ns, other.after_ns)) < _SAME_EVENT_NS).all()
    )


def _certain_time(step: ClockSetBack) -> tuple[int, int]:
    """From when to when a stamp can only be of the stretch that is kept."""
    ends = (-(2**62), *step.before_ns), (*step.after_ns, 2**62)
    return ends[0][step.kept] + 1, ends[1][step.kept] - 1


def _stamps(recording: Recording) -> Iterator[tuple[str, Stamps]]:
    for key in _STREAMS:
        for name, stream in getattr(recording, key).items():
            yield name, stream.timestamps_ns


def _must_show(stamps: Stamps, step: ClockSetBack) -> bool:
    """Whether a sensor was recording on both sides of the first step, and fast enough to show it."""
    if len(stamps) < 2:
        return False
    size = step.before_ns[0] - step.after_ns[0]
    covers = stamps[0] < step.after_ns[0] and stamps[-1] > step.before_ns[0]
    return bool(covers and (_MIN_SHARED + 1) * float(np.median(np.diff(stamps))) < size)
