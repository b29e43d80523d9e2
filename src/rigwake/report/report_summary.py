"""The report in ten lines, for the terminal."""

from __future__ import annotations

from rigwake.calibration import Calibration
from rigwake.report.extrinsics import overview
from rigwake.report.report_verdict import judge

_MOST_CAMERAS = 6


def summary_lines(calibration: Calibration) -> list[str]:
    """Verdict, one line per camera, what speaks against it and what to do: about ten lines of plain text."""
    verdict = judge(calibration)
    lines = [f"{verdict.level.upper()}: {verdict.sentence}"]
    rows = overview(calibration)
    width = max((len(row.camera.name) for row in rows), default=0)
    for row in rows[:_MOST_CAMERAS]:
        place = ", ".join(f"{v.label} {v.text}{' ' + v.std if v.std else ''}" for v in row.position_mm)
        if not row.position_mm[0].std:
            place += " mm"
        lines.append(f"  {row.camera.name:<{width}}  {row.looks or place}")
        if row.looks:
            lines[-1] += f" (± {row.std_rotation_deg}); {place}"
    if len(rows) > _MOST_CAMERAS:
        lines.append(f"  and {len(rows) - _MOST_CAMERAS} more cameras: see the report")
    for reason in verdict.reasons:
        lines.append(f"{'+' if reason.holds else '-'} {reason.words} {reason.remedy}".rstrip())
    return lines
