"""A result as plain values, as lines for people, and as entries for a logbook."""

from __future__ import annotations

from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from rigwake.calibration.yaml_file import plain
from rigwake.logbook.store import LoggedVerdict
from rigwake.monitor.blame import Explanation
from rigwake.monitor.run import CameraVerdict, MonitorResult
from rigwake.monitor.score import BLOCK_S
from rigwake.monitor.states import CameraState
from rigwake.monitor.vessel_rig import AXIS_WORDS


def clock_words(time_ns: int) -> str:
    """Time of day (UTC), or seconds where the clock does not count from 1970."""
    if time_ns < 10**17:  # before 1973: not a date
        return f"{time_ns * 1e-9:.0f} s"
    return datetime.fromtimestamp(time_ns * 1e-9, UTC).strftime("%H:%M:%S")


def verdict_line(verdict: CameraVerdict, command: str) -> str:
    """`left  DRIFTED  0.48 ± 0.03 deg about its optical axis since 14:03:10 (step); run: rigwake recalibrate ..`"""
    words = verdict.words
    if verdict.state is CameraState.DRIFTED and verdict.since_ns is not None:
        size, _, kind = words.rpartition(" (")
        words = f"{size} since {clock_words(verdict.since_ns)} ({kind}; run: {command}"
    return f"{verdict.name}  {verdict.state}  {words}"


def result_to_dict(result: MonitorResult) -> dict[str, Any]:
    """Plain values for `--json`."""
    scores = result.judgement.scores
    cameras = {}
    for name, v in result.verdicts.items():
        cameras[name] = {
            "state": str(v.state),
            "words": v.words,
            "size_deg": v.size_deg,
            "size_std_deg": v.size_std_deg,
            "rotation_rig_deg": None if v.rotation is None else np.rad2deg(v.rotation),
            "since_ns": v.since_ns,
            "kind": v.kind or None,
            "rate_deg_per_hour": v.rate_deg_per_hour or None,
            "std_deg_about": dict(zip(AXIS_WORDS, v.std_deg, strict=True)),
        }
    blocks = [
        {
            "start_ns": int(start),
            "states": dict(zip(scores.cameras, (str(s) for s in states), strict=True)),
            "statistic": dict(zip(scores.cameras, result.judgement.statistics.value[k], strict=True)),
            "rows": dict(zip(scores.cameras, scores.rows[k], strict=True)),
            "speed_mps": scores.speed[k],
            "turn_rate_deg_s": np.rad2deg(scores.turning[k]),
        }
        for k, (start, states) in enumerate(zip(scores.starts_ns, result.judgement.standings, strict=True))
    ]
    alarms = [
        {
            "block": alarm.block,
            "since_block": alarm.since,
            "camera": alarm.camera or None,
            "words": alarm.words,
            "explanations": [explanation_to_dict(e) for e in alarm.explanations[:5]],
        }
        for alarm in result.judgement.alarms
    ]
    hull = {
        name: {
            "words": cue.words,
            "moved": cue.moved,
            "since_ns": cue.since_ns,
            "rotation_imu_deg": None if cue.rotation is None else np.rad2deg(cue.rotation),
            "steps": [
                {"start_ns": s.start_ns, "rotation_imu_deg": np.rad2deg(s.rotation), "likeness": s.likeness}
                for s in cue.steps
            ],
        }
        for name, cue in result.hull.items()
    }
    content = {
        "exit_code": result.exit_code,
        "cameras": cameras,
        "own_hull": hull,
        "cues": {
            name: {"words": cue.words, "statistic": dict(zip(scores.cameras, cue.value.T, strict=True))}
            for name, cue in result.cues.items()
        },
        "notes": list(result.notes),
        "alarms": alarms,
        "blocks": blocks,
        "thresholds": vars(result.thresholds),
    }
    return dict(plain(content))


def logged_verdicts(result: MonitorResult, recording: Path) -> list[LoggedVerdict]:
    """What a logbook keeps of a result."""
    starts = result.judgement.scores.starts_ns
    begin, end = int(starts[0]), int(starts[-1] + round(BLOCK_S * 1e9))
    return [
        LoggedVerdict(
            name,
            str(v.state),
            v.size_deg,
            v.size_std_deg,
            v.words,
            recording.name,
            begin,
            end,
            evidence=plain(
                {
                    "rotation_rig_deg": None if v.rotation is None else np.rad2deg(v.rotation),
                    "std_deg": v.std_deg,
                    "since_ns": v.since_ns,
                    "kind": v.kind,
                }
            ),
        )
        for name, v in result.verdicts.items()
    ]


def explanation_to_dict(explanation: Explanation) -> dict[str, object]:
    """Plain values for `--json`."""
    return {
        "cause": explanation.cause,
        "camera": explanation.camera or None,
        "words": explanation.words,
        "evidence": explanation.evidence,
    }
