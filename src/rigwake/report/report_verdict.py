"""The verdict in plain words: good, usable or unobservable; why, and what to do next."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from rigwake.calibration import Calibration

Level = Literal["good", "usable", "unobservable"]

# what "good" asks for; each figure is shown beside the verdict
GOOD_ROTATION_DEG = 0.1
GOOD_POSITION_M = 0.03
AGREEING_SIGMAS = 3.0
GOOD_ASSOCIATION_PX = 2.0
ODD_PAIR_PX, ODD_PAIR_RATIO = 1.0, 5.0  # a pair of cameras that is off by more than both stands out
_FEW = 3.0  # with fewer than nine landmarks a pair may be further off, by this over the root of their number


@dataclass(frozen=True)
class Reason:
    """One thing that speaks for or against the calibration, and what to do about it."""

    holds: bool
    words: str
    remedy: str = ""


@dataclass(frozen=True)
class ReportVerdict:
    """The level, one sentence, and the reasons, the worst first."""

    level: Level
    sentence: str
    reasons: tuple[Reason, ...]


_SENTENCES: dict[Level, str] = {
    "good": "Every camera is determined, precisely, and independent checks agree.",
    "usable": "What is given here is determined, but not everything that was asked of it holds.",
    "unobservable": "The motion in this recording does not fix every camera.",
}


def judge(calibration: Calibration) -> ReportVerdict:
    """Determined? Precise? Confirmed by checks that the estimate did not use? Residuals do not count."""
    lost = _unobservable(calibration)
    reasons = [
        *lost,
        *_estimation(calibration.checks),
        *_sensors(calibration.checks),
        *_precision(calibration),
        _split_half(calibration.checks),
        _association(calibration.checks),
    ]
    level: Level = "unobservable" if lost else "good" if all(r.holds for r in reasons) else "usable"
    sentence = " ".join(filter(None, (_left_out(calibration.checks), _SENTENCES[level])))
    return ReportVerdict(level, sentence, tuple(sorted(reasons, key=lambda r: r.holds)))


def _left_out(checks: Mapping[str, Any]) -> str:
    """The cameras that are missing from the result, for the headline."""
    failed = checks.get("failed_cameras")
    return f"Without {', '.join(map(str, failed))}." if isinstance(failed, Mapping) and failed else ""


def _unobservable(calibration: Calibration) -> list[Reason]:
    return [
        Reason(False, f"unobservable: {direction.words}.", _sentence(direction.remedy))
        for camera in calibration.cameras.values()
        for direction in camera.unobservable
    ]


def _estimation(checks: Mapping[str, Any]) -> list[Reason]:
    """Cameras that were given up, and an adjustment that did not settle."""
    failed = checks.get("failed_cameras")
    reasons = [
        Reason(False, f"{name} could not be calibrated.", str(why))
        for name, why in (failed.items() if isinstance(failed, Mapping) else ())
    ]
    if checks.get("converged") is False:
        reasons.append(
            Reason(
                False, "The adjustment did not settle.", "Look at the residuals over time and at the masks."
            )
        )
    return reasons


def _sensors(checks: Mapping[str, Any]) -> list[Reason]:
    """Whether every sensor agrees with the others; cameras that were left out are told by `_estimation`."""
    found = checks.get("sensor_checks")
    if not isinstance(found, list) or not all(isinstance(check, Mapping) for check in found):
        return []
    reasons = []
    for check in found:
        words = f"{check.get('sensor')}: {check.get('hypothesis')}"
        if check.get("action") == "left out" and not str(check.get("sensor")).startswith("camera "):
            reasons.append(Reason(False, f"Left out, {words}", str(check.get("remedy") or "")))
        elif check.get("action") == "repaired":
            reasons.append(Reason(True, f"Repaired, {words}", str(check.get("remedy") or "")))
    if not any(not check.get("agrees") for check in found):
        reasons.append(Reason(True, f"Every sensor agrees with the others ({len(found)} comparisons)."))
    return reasons


def _sentence(words: str) -> str:
    return f"{words[:1].upper()}{words[1:].rstrip('.')}." if words else ""


def _precision(calibration: Calibration) -> list[Reason]:
    """The largest standard deviations of rotation and position, against what good asks for."""
    kinds = (
        (
            "looking direction",
            "°",
            1.0,
            GOOD_ROTATION_DEG,
            "std_rotation_deg",
            "turn more, in both directions",
        ),
        (
            "position",
            " mm",
            1e3,
            GOOD_POSITION_M,
            "std_translation_m",
            "turn more, closer to structures on shore",
        ),
    )
    reasons = []
    for what, unit, factor, limit, attribute, remedy in kinds:
        worst = {
            name: float(np.nanmax(getattr(camera, attribute)))
            for name, camera in calibration.cameras.items()
            if np.isfinite(getattr(camera, attribute)).any()
        }
        worst = {name: value for name, value in worst.items() if value > 0}  # the reference itself has none
        if not worst:
            reasons.append(Reason(False, f"The calibration does not say how sure its {what}s are."))
            continue
        name = max(worst, key=lambda n: worst[n])
        holds = worst[name] <= limit
        where = (
            "where it is determined, " if any(c.unobservable for c in calibration.cameras.values()) else ""
        )
        words = (
            f"{where}{what} known to {worst[name] * factor:.2g}{unit} (1σ) or better; the least sure is {name}"
            f"{'' if holds else f'; good means at most {limit * factor:g}{unit}'}."
        )
        reasons.append(
            Reason(holds, words[0].upper() + words[1:], "" if holds else f"Record longer: {remedy}.")
        )
    return reasons


def _number(content: Any, key: str) -> float | None:
    value = content.get(key) if isinstance(content, Mapping) else None
    return float(value) if isinstance(value, int | float) and not isinstance(value, bool) else None


def _split_half(checks: Mapping[str, Any]) -> Reason:
    """Both halves of the recording, calibrated by themselves."""
    halves = checks.get("split_half")
    sigmas = {name: _number(c, "sigmas") for name, c in halves.items()} if isinstance(halves, Mapping) else {}
    known = {str(name): value for name, value in sigmas.items() if value is not None}
    if not known:
        return Reason(
            False,
            "The two halves of the recording were not compared.",
            "Record at least two turns and rerun.",
        )
    name = max(known, key=lambda n: known[n])
    if known[name] <= AGREEING_SIGMAS:
        return Reason(True, f"The two halves of the recording agree within {known[name]:.1f} σ.")
    return Reason(
        False,
        f"The two halves of the recording disagree by {known[name]:.1f} σ for {name}: "
        "the standard deviations are too small, or something moved.",
        "Look at the residuals over time and the masks; check that the mounts are rigid.",
    )


def _association(checks: Mapping[str, Any]) -> Reason:
    """Landmarks predicted into images, of other cameras too, that were not used for them."""
    association = checks.get("hand_over")
    median = _number(association, "median_px")
    count = _number(association, "count") or 0
    if median is None or count == 0 or not _between_cameras(association):
        return Reason(
            False,
            "No landmark went from one camera to another, so the cameras could not be checked against each other.",
            "Turn through at least 360 degrees near structures on shore.",
        )
    words = (
        f"{count:.0f} landmarks, predicted into images not used for them, land {median:.2g} px off (median)"
    )
    odd = [f"{pair} {off:.2g} px" for pair, off in odd_pairs(association).items()]
    if odd:
        return Reason(
            False,
            f"{words}, but from camera to camera {', '.join(odd)}: one of them may be tied by wrong matches.",
            "Look at the cross-camera association pictures, and compare with --set adjustment.cross_camera=false.",
        )
    if median <= GOOD_ASSOCIATION_PX:
        return Reason(True, f"{words}.")
    return Reason(
        False,
        f"{words}; good means at most {GOOD_ASSOCIATION_PX:g} px.",
        "Look at the cross-camera association pictures: one camera off in all of them points to its lens or its mount.",
    )


def odd_limit_px(median_px: float) -> float:
    """Beyond this a pair of cameras, or one landmark, stands out among held-out landmarks with such a median."""
    return max(ODD_PAIR_PX, ODD_PAIR_RATIO * median_px)


def odd_pairs(association: Any) -> dict[str, float]:
    """By pair `a->b` the median in px, where landmarks land far off although all others do not."""
    median = _number(association, "median_px")
    pairs = association.get("by_pair") if isinstance(association, Mapping) else None
    if median is None or not isinstance(pairs, Mapping):
        return {}
    found = {
        str(pair): (_number(entry, "median_px") or 0.0, _number(entry, "count") or 0)
        for pair, entry in pairs.items()
    }
    limit_px = odd_limit_px(median)
    # the median of a few landmarks is off by chance
    return {
        pair: off
        for pair, (off, count) in found.items()
        if count > 1 and off > limit_px * max(1.0, _FEW / np.sqrt(count))
    }


def _between_cameras(association: Any) -> bool:
    """Whether a pair `a->b` is of two cameras; a landmark seen again by the same one says nothing about the rig."""
    pairs = association.get("by_pair") if isinstance(association, Mapping) else None
    if not isinstance(pairs, Mapping):
        return True  # the file does not tell pairs apart
    return any(first != second for first, _, second in (str(pair).partition("->") for pair in pairs))
