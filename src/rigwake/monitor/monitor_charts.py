"""Timelines of a monitored rig as inline SVG, in the style of the report."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from markupsafe import Markup, escape

from rigwake._types import Array
from rigwake.monitor.score import BLOCK_S
from rigwake.monitor.states import CameraState
from rigwake.report.charts import WIDTH, Series, line_chart

_ROW = 22.0
_LEFT = 90.0
_MOST_STDS = 6.0  # wider bands are left out: they would flatten the rest
CLASSES = {
    CameraState.OK: "ok",
    CameraState.SUSPECT: "suspect",
    CameraState.DRIFTED: "drifted",
    CameraState.RECALIBRATING: "recalibrating",
    CameraState.UNOBSERVABLE: "unobservable",
}


def state_strip(names: Sequence[str], standings: Sequence[Sequence[CameraState]]) -> Markup:
    """A row per camera, a cell per block, coloured by state."""
    width, height = WIDTH + 240.0, _ROW * len(names) + 24
    cell = (width - _LEFT) / max(len(standings), 1)
    parts = []
    for row, name in enumerate(names):
        y = row * _ROW
        parts.append(f'<text class="tick" x="0" y="{y + 15:.1f}">{escape(name)}</text>')
        for k, states in enumerate(standings):
            state = states[row]
            parts.append(
                f'<rect class="state {CLASSES[state]}" x="{_LEFT + k * cell:.2f}" y="{y + 2:.1f}" '
                f'width="{max(cell - 0.5, 0.5):.2f}" height="{_ROW - 5:.1f}"><title>{escape(name)}, '
                f"{k * BLOCK_S:.0f} s: {state}</title></rect>"
            )
    end = len(standings) * BLOCK_S
    y = _ROW * len(names) + 14
    parts.append(f'<text class="tick" x="{_LEFT}" y="{y:.1f}">0 s</text>')
    parts.append(f'<text class="tick" x="{width:.1f}" y="{y:.1f}" text-anchor="end">{end:.0f} s</text>')
    head = f'<svg class="chart strip" viewBox="0 0 {width:.1f} {height:.1f}" role="img" aria-label="States over time">'
    return Markup(head + "".join(parts) + "</svg>")


def axis_chart(title: str, step_deg: Array, std_deg: Array, colour: int) -> Markup:
    """A camera's rotation about one axis, block by block (B,), with a band of two standard deviations."""
    times = np.asarray((np.arange(len(step_deg)) + 0.5) * BLOCK_S, dtype=np.float64)
    known = np.isfinite(step_deg) & np.isfinite(std_deg)
    if known.any():
        known &= std_deg <= _MOST_STDS * np.median(std_deg[known])
    low = np.where(known, step_deg - 2 * std_deg, np.nan)
    high = np.where(known, step_deg + 2 * std_deg, np.nan)
    series = [
        Series("two standard deviations", times, low, colour, upper=high),
        Series("rotation", times, np.where(known, step_deg, np.nan), colour),
    ]
    return line_chart(title, "time, s", "deg", series, from_zero=False)


def statistic_chart(names: Sequence[str], value: Array, alarm: float) -> Markup:
    """The likelihood ratio of every camera (B, C), and the level at which an alarm is raised."""
    times = np.asarray((np.arange(len(value)) + 1) * BLOCK_S, dtype=np.float64)
    ceiling = 3 * alarm  # beyond, how far no longer matters
    series = [Series(name, times, np.minimum(value[:, k], ceiling), k) for k, name in enumerate(names)]
    series.append(Series("alarm", times, np.full(len(times), alarm), 7))
    return line_chart("Likelihood ratio of a change", "time, s", "ratio", series)
