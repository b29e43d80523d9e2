"""What is said of a camera, and of the whole rig, in words."""

from __future__ import annotations

import numpy as np

from rigwake._types import Array
from rigwake.monitor.judge import Judgement
from rigwake.monitor.score import BLOCK_S, BlockScores
from rigwake.monitor.thresholds import Thresholds
from rigwake.monitor.trim import trim_change
from rigwake.monitor.vessel_rig import AXIS_REMEDIES, AXIS_WORDS

_NO_TURN_DEG_S = 2.0
_LARGEST_SHIFT_M = 0.1  # where only larger ones would be seen, none is


def drift_words(size_deg: float, std_deg: float, about: Array, rate_deg_per_hour: float | None = None) -> str:
    """Size, axis, kind. about: (3,) the rotation about `AXIS_WORDS`. rate_deg_per_hour: of a ramp."""
    direction = np.abs(about) / max(float(np.linalg.norm(about)), 1e-12)
    axis = AXIS_WORDS[int(np.argmax(direction))] if direction.max() > 0.9 else "an oblique axis"
    parts = f"{size_deg:.2f} ± {std_deg:.2f} deg about {axis}"
    if rate_deg_per_hour is not None:
        return f"{parts}, {rate_deg_per_hour:.2f} deg per hour (ramp)"
    return f"{parts} (step)"


def shift_words(std_m: Array, thresholds: Thresholds) -> str:
    """How large a shift must be to be seen, or why none is. std_m: (3,) of a shift over the last blocks, rig axes."""
    least = np.sqrt(thresholds.alarm) * std_m
    if not (least <= _LARGEST_SHIFT_M).any():
        return "shifts are unobservable: too little structure within 15 m, or too little motion"
    sizes = (
        f"{axis} {100 * size:.0f} cm" if size <= _LARGEST_SHIFT_M else f"{axis} unobservable"
        for axis, size in zip(("x", "y", "z"), least, strict=True)
    )
    return f"shifts from {', '.join(sizes)}"


def unobservable_words(
    scores: BlockScores, std: Array, camera: int, thresholds: Thresholds, is_tracked: bool = True
) -> str:
    """Which axes this motion did not show, why, and what would. is_tracked: whether its pictures showed anything."""
    recent = slice(max(len(scores) - thresholds.longest, 0), len(scores))
    minutes = (recent.stop - recent.start) * BLOCK_S / 60
    used = bool(scores.rows[recent, camera].any())
    blind = [a for a in range(3) if not used or std[a] > thresholds.observable_deg]
    remedies = list(dict.fromkeys(AXIS_REMEDIES[a] for a in blind))
    turning = np.rad2deg(float(np.median(scores.turning[recent])))
    if not is_tracked:
        return "about every axis: nothing tracked (fog, darkness, a covered lens); what helps: clear sight and light"
    if not used:
        why = f"no way made in {minutes:.1f} min"
        remedies.insert(0, "sailing at 1 m/s or more")
    elif turning < _NO_TURN_DEG_S:
        why = f"no turn in {minutes:.0f} min"
    else:
        why = "too little motion"
    return f"about {' and '.join(AXIS_WORDS[a] for a in blind)}: {why}; what helps: {', '.join(remedies)}"


def rig_notes(judgement: Judgement, thresholds: Thresholds) -> list[str]:
    """What concerns the whole rig: causes that no camera is blamed for, and a trim that changed."""
    notes = [
        alarm.words for alarm in judgement.alarms if not alarm.camera and not alarm.explanations[0].camera
    ]
    trim = trim_change(judgement.scores)
    if trim is not None:
        block, degrees = trim
        imu_too = any(alarm.explanations[0].cause == "imu" for alarm in judgement.alarms)
        cause = "the IMU turned on its mount" if imu_too else "the boat's trim or list changed"
        notes.append(f"the level changed by {degrees:.1f} deg after {block * BLOCK_S / 60:.1f} min: {cause}")
    return notes
