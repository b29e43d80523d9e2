"""Small charts of the pages beside lines and maps: when sensors recorded, values with their uncertainty, a rig."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from markupsafe import Markup, escape

from rigwake._types import Array, Stamps
from rigwake.geometry.se3 import SE3
from rigwake.report.charts import COLOURS, axis_text, svg, ticks

_ROW = 26.0
_WIDTH, _LEFT, _RIGHT = 480.0, 130.0, 22.0


def _row_names(names: Sequence[str], top: float) -> list[str]:
    return [
        f'<text class="tick" x="{_LEFT - 8:.1f}" y="{top + _ROW * (k + 0.5) + 4:.1f}" text-anchor="end">'
        f"{escape(_short(name))}</text>"
        for k, name in enumerate(names)
    ]


def _short(name: str) -> str:
    return name if len(name) <= 18 else name[:17] + "…"


def _x_axis(low: float, high: float, bottom: float, label: str) -> tuple[list[str], float]:
    scale = (_WIDTH - _LEFT - _RIGHT) / ((high - low) or 1.0)
    parts = []
    for value in ticks(low, high, 4):
        u = _LEFT + (value - low) * scale
        parts.append(f'<path class="grid" d="M{u:.1f},6V{bottom:.1f}"/>')
        parts.append(
            f'<text class="tick" x="{u:.1f}" y="{bottom + 16:.1f}" text-anchor="middle">{axis_text(value)}</text>'
        )
    middle = (_LEFT + _WIDTH - _RIGHT) / 2
    parts.append(
        f'<text class="axis" x="{middle:.1f}" y="{bottom + 34:.1f}" text-anchor="middle">{escape(label)}</text>'
    )
    return parts, scale


def presence_chart(title: str, stamps: Mapping[str, Stamps], longest_gap: float = 1.6) -> Markup:
    """A bar per sensor from its first to its last sample, broken where samples are missing.

    stamps: by sensor, increasing nanoseconds; a wait of more than `longest_gap` median periods is a break.
    """
    known = {name: np.asarray(s, np.int64) for name, s in stamps.items() if len(s) > 1}
    if not known:
        return Markup("")
    start = min(int(s[0]) for s in known.values())
    high = max(int(s[-1]) - start for s in known.values()) * 1e-9
    bottom = 8 + _ROW * len(known)
    parts, scale = _x_axis(0.0, high, bottom, "time, s")
    parts += _row_names(list(known), 8)
    for k, one in enumerate(known.values()):
        waits = np.diff(one)
        breaks = np.flatnonzero(waits > longest_gap * np.median(waits))
        begins, ends = np.append(0, breaks + 1), np.append(breaks, len(one) - 1)
        # breaks narrower than half a unit of the drawing cannot be seen: what lies between is one bar
        x0, x1 = (_LEFT + (one[i] - start) * 1e-9 * scale for i in (begins, ends))
        apart = np.flatnonzero(x0[1:] - x1[:-1] > 0.5)
        first, last = np.append(x0[0], x0[1:][apart]), np.append(x1[:-1][apart], x1[-1])
        y = 8 + _ROW * k + 5
        parts += [
            f'<rect class="cell c{k % COLOURS}" x="{a:.1f}" y="{y:.1f}" width="{max(b - a, 1.0):.1f}" '
            f'height="{_ROW - 10}"/>'
            for a, b in zip(first.tolist(), last.tolist(), strict=True)
        ]
    return svg(title, _WIDTH, bottom + 42, parts, "chart")


def interval_chart(title: str, label: str, values: Mapping[str, tuple[float, float]]) -> Markup:
    """A dot per name with a bar of one and a thin one of three standard deviations. values: (value, sigma) by name;
    sigma may be NaN (no bar); a value that is NaN has a row without a dot."""
    finite = [(v, s if np.isfinite(s) else 0.0) for v, s in values.values() if np.isfinite(v)]
    if not finite:
        return Markup("")
    low = min(0.0, min(v - 3 * s for v, s in finite))
    high = max(0.0, max(v + 3 * s for v, s in finite))
    pad = 0.05 * (high - low or 1.0)
    bottom = 8 + _ROW * len(values)
    parts, scale = _x_axis(low - pad, high + pad, bottom, label)
    parts += _row_names(list(values), 8)
    for k, (value, sigma) in enumerate(values.values()):
        if not np.isfinite(value):
            continue
        u, y = _LEFT + (value - low + pad) * scale, 8 + _ROW * (k + 0.5)
        for factor, width in ((3, 1.5), (1, 5)) if np.isfinite(sigma) else ():
            reach = factor * sigma * scale
            bar = f'style="stroke-width:{width}" d="M{u - reach:.1f},{y:.1f}h{2 * reach:.1f}"'
            parts.append(f'<path class="line c{k % COLOURS}" {bar}/>')
        parts.append(f'<circle class="dot c{k % COLOURS}" cx="{u:.1f}" cy="{y:.1f}" r="4"/>')
    return svg(title, _WIDTH, bottom + 42, parts, "chart")


def rig_from_above(title: str, rigs: Sequence[Mapping[str, SE3]], axis: int = 2) -> Markup:
    """Bodies on one or more rigs from above, at one scale: a dot each, an arrow along its own z (or another `axis`).

    rigs: `rig_from_cam` by name; of several rigs each has a colour, of one each body. What is NaN is left out.
    """
    placed = [{name: x for name, x in rig.items() if np.isfinite(x.translation[:2]).all()} for rig in rigs]
    points = np.array([x.translation[:2] for rig in placed for x in rig.values()] + [np.zeros(2)])
    if len(points) < 2:
        return Markup("")
    low, high = points.min(axis=0), points.max(axis=0)
    span = max(float((high - low).max()), 0.1)
    arrow, width = 0.22 * span, 420.0
    low, high = low - 1.4 * arrow, high + 1.4 * arrow
    scale = width / float(high[0] - low[0])
    height = float(high[1] - low[1]) * scale + 30

    def at(point: Array) -> tuple[float, float]:
        return float(point[0] - low[0]) * scale, float(high[1] - point[1]) * scale

    u, v = at(np.zeros(2))
    parts = [f'<path class="arrow" d="M{u - 8:.1f},{v:.1f}h16M{u:.1f},{v - 8:.1f}v16"/>']
    for k, rig in enumerate(placed):
        for body, (name, x) in enumerate(rig.items()):
            css = f"c{(k if len(placed) > 1 else body + 1) % COLOURS}{' dashed' if k else ''}"
            u, v = at(x.translation)
            ahead = x.rotation[:2, axis]
            if np.isfinite(ahead).all():
                tip = at(x.translation[:2] + arrow * ahead)
                parts.append(f'<path class="line {css}" d="M{u:.1f},{v:.1f}L{tip[0]:.1f},{tip[1]:.1f}"/>')
            parts.append(f'<circle class="dot {css}" cx="{u:.1f}" cy="{v:.1f}" r="4"/>')
            if k == 0:
                side, beside = ("end", u - 7) if u > width - 90 else ("start", u + 7)
                where = f'x="{beside:.1f}" y="{v - 7:.1f}" text-anchor="{side}"'
                parts.append(f'<text class="tick" {where}>{escape(_short(name))}</text>')
    marks = ticks(0, span, 4)
    bar = marks[1] if len(marks) > 1 else span
    parts.append(f'<path class="scalebar" d="M8,{height - 8:.1f}h{bar * scale:.1f}"/>')
    parts.append(f'<text class="tick" x="8" y="{height - 14:.1f}">{axis_text(bar)} m</text>')
    return svg(title, width, height, parts, "map")
