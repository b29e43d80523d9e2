"""An inspection as plain values, for JSON."""

from __future__ import annotations

import math
from dataclasses import asdict
from typing import Any

from rigwake.inspection.readiness import Readiness
from rigwake.inspection.recording_inspection import Inspection


def inspection_to_dict(inspection: Inspection, verdict: Readiness) -> dict[str, Any]:
    """Plain values; what is not known is null."""
    recording = inspection.recording
    content = {
        "recording": {"path": str(recording.path), "kind": recording.kind},
        "verdict": {"word": verdict.word, "summary": verdict.summary, "advice": list(verdict.advice)},
        "checks": [asdict(check) for check in verdict.checks],
        "sensors": {key: _sensor(inspection, key) for key in inspection.timings},
        "clock_offsets_to_imu": {
            key: asdict(time_offset) for key, time_offset in inspection.time_offsets.items()
        },
        "motion": _motion(inspection),
        "static_transforms": [list(edge) for edge in recording.static_transforms],
        "findings": [asdict(finding) for finding in inspection.findings],
    }
    return dict(_plain(content))


def _sensor(inspection: Inspection, key: str) -> dict[str, Any]:
    kind, _, name = key.partition(".")
    t = inspection.timings[key]
    content: dict[str, Any] = asdict(t) | {"duration_s": t.duration_s}
    if kind == "camera":
        camera, seen = inspection.recording.cameras[name], inspection.pictures[name]
        content |= {
            "topic": camera.topic,
            "width_px": camera.width_px,
            "height_px": camera.height_px,
            "lens": camera.model.model if camera.model is not None else None,
            "sampled_frames": seen.sampled,
            "readable_frames": seen.readable,
            "dark_frames": seen.dark,
            "overexposed_frames": seen.overexposed,
            "frozen_frames": seen.frozen,
            "mean_level": seen.mean_level,
        }
    return content


def _motion(inspection: Inspection) -> dict[str, Any]:
    turn, path = inspection.turning, inspection.travel
    content: dict[str, Any] = {"turning": None, "travel": None}
    if turn is not None:
        content["turning"] = {
            "turned_deg": turn.turned_deg,
            "net_deg": turn.net_deg,
            "max_rate_deg_s": turn.max_rate_deg_s,
            "tilt_std_deg": list(turn.tilt_std_deg),
            "still_fraction": turn.still_fraction,
        }
    if path is not None:
        content["travel"] = {
            "path_m": path.path_m,
            "extent_m": path.extent_m,
            "mean_speed_m_s": path.mean_speed,
            "max_speed_m_s": path.max_speed,
            "still_fraction": path.still_fraction,
        }
    return content


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
