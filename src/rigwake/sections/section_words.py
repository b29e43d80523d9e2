"""Asked precision and chosen sections, from and to words and plain values."""

from __future__ import annotations

import math
import re
from typing import Any

import numpy as np

from rigwake.errors import UsageError
from rigwake.inspection.told_over_time import ToldOverTime
from rigwake.sections.section_choice import CameraSigmas, Precision
from rigwake.sections.section_plan import SectionPlan

_ANGLES = {"deg": np.pi / 180, "mrad": 1e-3, "rad": 1.0}
_LENGTHS = {"mm": 1e-3, "cm": 1e-2, "m": 1.0}
_PART = re.compile(r"\s*([0-9.]+(?:[eE][-+]?[0-9]+)?)\s*([a-z]+)\s*")
_BLOCKS = " ▁▂▃▄▅▆▇█"
_MOST_BLOCKS = 72


def parse_precision(text: str) -> Precision:
    """`5mm`, `0.02deg`, or both: `5mm,0.02deg`. Raises UsageError."""
    found: dict[str, float] = {}
    for part in re.split(r"[,|]", text):
        match = _PART.fullmatch(part)
        kind = "rotation" if match and match[2] in _ANGLES else "translation"
        factor = (_ANGLES | _LENGTHS).get(match[2]) if match else None
        try:
            value = float(match[1]) * factor if match and factor is not None else math.nan
        except ValueError:
            value = math.nan
        if not (math.isfinite(value) and value > 0) or kind in found:
            raise UsageError(
                f"The precision {text!r} is not understood.",
                remedy="Give sigmas that are to be reached, for example 5mm, 0.02deg or 5mm,0.02deg.",
            )
        found[kind] = value
    return Precision(**found)


def clock_words(spans_ns: tuple[tuple[int, int], ...], start_ns: int) -> str:
    """Spans as seconds since the start: `12-44 s, 100-132 s`."""
    return ", ".join(f"{(a - start_ns) * 1e-9:.0f}-{(b - start_ns) * 1e-9:.0f} s" for a, b in spans_ns)


def duration_words(seconds: float) -> str:
    """`40 s`, `3 min`, `2.5 h`."""
    if seconds < 180:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 5400 else f"{seconds / 3600:.1f} h"


def sigma_words(sigmas: CameraSigmas) -> str:
    """`0.012 deg, 3.4 mm`, and what cannot be told."""
    words = f"{np.degrees(sigmas.rotation):.3f} deg, {1e3 * sigmas.translation:.1f} mm"
    return words + (
        f" ({sigmas.unobservable} of 6 axes not told to 1 deg and 20 cm)" if sigmas.unobservable else ""
    )


def choice_words(plan: SectionPlan) -> str:
    """One sentence: how much is used, which parts, and why."""
    spans = plan.information.spans_ns
    total_s = float(spans[-1, 1] - spans[0, 0]) * 1e-9
    if plan.is_all:
        return f"all {duration_words(total_s)} are used: {plan.choice.reason}"
    where = clock_words(plan.choice.sections_ns, int(spans[0, 0]))
    used = duration_words(plan.choice.seconds)
    return f"{used} of {duration_words(total_s)} are used ({where}): {plan.choice.reason}"


def information_over_time(plan: SectionPlan) -> np.ndarray:
    """(S,) what each stretch tells, as a fraction of the whole: the mean over all parameters."""
    total = plan.information.of(np.arange(len(plan.information)))
    scale = np.sqrt(np.maximum(np.diag(total), 1e-12))
    inverse = np.linalg.pinv(total / np.outer(scale, scale), rcond=1e-9, hermitian=True)
    scaled = plan.information.matrices / np.outer(scale, scale)
    return np.asarray(np.einsum("kl,slk->s", inverse, scaled) / max(np.linalg.matrix_rank(inverse), 1))


def information_line(plan: SectionPlan) -> str:
    """Information over time as a line of blocks."""
    told = information_over_time(plan)
    groups = np.array_split(told, min(len(told), _MOST_BLOCKS))
    heights = np.array([group.sum() for group in groups])
    levels = np.ceil((len(_BLOCKS) - 1) * heights / max(heights.max(), 1e-12)).astype(int)
    return "".join(
        _BLOCKS[max(level, 1)] if height > 0 else _BLOCKS[0]
        for level, height in zip(levels, heights, strict=True)
    )


def plan_to_dict(plan: SectionPlan) -> dict[str, Any]:
    """Plain values, for JSON and the calibration file; times in seconds since the first stretch."""
    choice, spans = plan.choice, plan.information.spans_ns
    start = int(spans[0, 0])

    def sigmas(found: dict[str, CameraSigmas]) -> dict[str, Any]:
        return {
            name: {
                "rotation_deg": float(np.degrees(s.rotation)),
                "translation_m": s.translation,
                "unobservable_axes": s.unobservable,
            }
            for name, s in found.items()
        }

    return {
        "used_s": choice.seconds,
        "of_s": float(spans[-1, 1] - start) * 1e-9,
        "sections_s": [[(a - start) * 1e-9, (b - start) * 1e-9] for a, b in choice.sections_ns],
        "reason": choice.reason,
        "predicted_sigmas": sigmas(dict(choice.predicted)),
        "sigmas_of_all": sigmas(dict(choice.whole)),
        "cpu_s": plan.cost.total_s,
        "cpu_s_of_all": plan.whole_cost.total_s,
    }


def told_over_time(plan: SectionPlan) -> ToldOverTime:
    """What `inspect` draws."""
    spans = plan.information.spans_ns
    chosen = np.zeros(len(spans), dtype=bool)
    chosen[plan.choice.stretches] = True
    lengths_s = np.diff(spans, axis=1)[:, 0] * 1e-9
    return ToldOverTime(spans[:, 0], lengths_s, information_over_time(plan), chosen, choice_words(plan))
