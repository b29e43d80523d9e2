"""OUT/fleet.html: counts, failures by cause, drift of every vessel's cameras over time, outliers, a table."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from functools import cache
from itertools import cycle
from typing import Any

import jinja2
import numpy as np
from markupsafe import Markup, escape

from rigwake import __version__
from rigwake.fleet.drift_history import FLOOR_DEG, DriftHistory, DriftPoint
from rigwake.fleet.fleet_jobs import FAILED, NOT_OBSERVABLE, FleetOutcome

_MOST_ROWS = 2000  # of the table on the page; the CSV file has all
_MOST_VESSELS = 60
_MOST_MOVED = 500
_MOST_OUTLIERS = 200
_MOST_POINTS = 2000  # of a chart
_MOVED = ("DRIFTED", "SUSPECT")
_EARLIEST_NS, _LATEST_NS = 0, 4_102_444_800_000_000_000  # the year 2100
_WIDTH, _HEIGHT, _MARGIN, _TOP = 640, 170, 36, 26
_LONGEST_NAME = 24
_COLOURS = ("#1b6ca8", "#c1440e", "#3a7d44", "#7d4a9c", "#9c7a1b", "#4a6c7d")


@dataclass
class _Seen:
    """Gathered in one pass over the outcomes."""

    counts: Counter[str] = field(default_factory=Counter)
    causes: dict[str, list[FleetOutcome]] = field(default_factory=lambda: defaultdict(list))
    cause_counts: Counter[str] = field(default_factory=Counter)
    vessels: dict[str, DriftHistory] = field(default_factory=lambda: defaultdict(DriftHistory))
    rows: list[FleetOutcome] = field(default_factory=list)
    moved: list[tuple[FleetOutcome, str, Mapping[str, Any]]] = field(default_factory=list)


def render_page(outcomes: Iterable[FleetOutcome], wanted: int, csv_name: str) -> str:
    """The whole page, one file without anything from elsewhere. wanted: how many recordings there are."""
    seen = _Seen()
    for outcome in outcomes:
        seen.counts[outcome.status] += 1
        if outcome.status in (FAILED, NOT_OBSERVABLE):
            seen.cause_counts[outcome.cause] += 1
            if len(seen.causes[outcome.cause]) < 10:
                seen.causes[outcome.cause].append(outcome)
        for name, camera in outcome.cameras.items():
            if camera.get("state") in _MOVED and len(seen.moved) < _MOST_MOVED:
                seen.moved.append((outcome, name, camera))
        if outcome.is_done and outcome.cameras:
            seen.vessels[outcome.vessel].add(outcome)
        if len(seen.rows) < _MOST_ROWS:
            seen.rows.append(outcome)
    charts: dict[str, Markup] = {}
    outliers: list[tuple[str, DriftPoint]] = []
    outlier_count = 0
    for vessel in sorted(seen.vessels):
        points = seen.vessels[vessel].points()
        odd = [point for point in points if point.is_outlier]
        outlier_count += len(odd)
        outliers += [(vessel, point) for point in odd[: _MOST_OUTLIERS - len(outliers)]]
        if len(points) > 1 and len(charts) < _MOST_VESSELS:
            charts[vessel] = drift_chart(thinned(points))
    return (
        _environment()
        .get_template("fleet.html.j2")
        .render(
            version=__version__,
            counts=seen.counts,
            done=sum(seen.counts.values()),
            wanted=wanted,
            causes=[(cause, n, seen.causes[cause]) for cause, n in seen.cause_counts.most_common()],
            moved=sorted(seen.moved, key=lambda found: found[2]["state"]),
            outliers=outliers,
            outlier_count=outlier_count,
            charts=charts,
            vessels_left_out=max(len(seen.vessels) - _MOST_VESSELS, 0),
            rows=seen.rows,
            csv_name=csv_name,
            date=_date,
        )
    )


@cache
def _environment() -> jinja2.Environment:
    # names come from recordings: everything is escaped unless it is Markup made here
    return jinja2.Environment(
        loader=jinja2.PackageLoader("rigwake.fleet", "templates"),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )


def _date(time_ns: int | None) -> str:
    if time_ns is None or not _EARLIEST_NS <= time_ns <= _LATEST_NS:
        return "–"
    return datetime.fromtimestamp(time_ns * 1e-9, UTC).strftime("%Y-%m-%d %H:%M")


def thinned(points: Sequence[DriftPoint]) -> list[DriftPoint]:
    """At most some thousand points in their order: outliers first of all, the others evenly thinned."""
    if len(points) <= _MOST_POINTS:
        return list(points)
    odd = [k for k, point in enumerate(points) if point.is_outlier][: _MOST_POINTS // 2]
    others = np.linspace(0, len(points) - 1, _MOST_POINTS - len(odd)).astype(int).tolist()
    return [points[k] for k in sorted({*odd, *others})]


def drift_chart(points: Sequence[DriftPoint]) -> Markup:
    """An SVG picture: time along, degrees up, one colour per camera, a bar of one standard deviation."""
    cameras = sorted({point.camera for point in points})
    times = np.array([point.started_ns for point in points], dtype=np.float64)
    span = float(np.ptp(times)) or 1.0
    top = max(max(point.turned_deg + point.std_deg for point in points), FLOOR_DEG) * 1.05
    parts = [
        f'<svg viewBox="0 0 {_WIDTH} {_HEIGHT}" role="img" aria-label="Turn from the median in degrees over time">',
        f'<path d="M{_MARGIN} {_TOP}V{_HEIGHT - 20}H{_WIDTH - 8}" fill="none" stroke="currentColor" opacity="0.5"/>',
        f'<text x="2" y="{_TOP + 8}">{top:.2f}°</text><text x="2" y="{_HEIGHT - 20}">0°</text>',
        f'<text x="{_MARGIN}" y="{_HEIGHT - 4}">{_date(points[0].started_ns)}</text>',
        f'<text x="{_WIDTH - 8}" y="{_HEIGHT - 4}" text-anchor="end">{_date(points[-1].started_ns)}</text>',
    ]
    for point, time in zip(points, times, strict=True):
        x = _MARGIN + 8 + (time - times.min()) / span * (_WIDTH - _MARGIN - 24)
        y = [_HEIGHT - 20 - v / top * (_HEIGHT - 20 - _TOP) for v in _band(point)]
        colour = _COLOURS[cameras.index(point.camera) % len(_COLOURS)]
        parts.append(
            f'<line x1="{x:.1f}" x2="{x:.1f}" y1="{y[0]:.1f}" y2="{y[2]:.1f}" stroke="{colour}" opacity="0.5"/>'
            f'<circle cx="{x:.1f}" cy="{y[1]:.1f}" r="{4 if point.is_outlier else 2.5}" fill="{colour}"/>'
        )
    x = float(_MARGIN + 12)
    for name, colour in zip(cameras, cycle(_COLOURS), strict=False):
        words = name[:_LONGEST_NAME]
        parts.append(
            f'<circle cx="{x:.0f}" cy="8" r="3" fill="{colour}"/><text x="{x + 7:.0f}" y="12">{escape(words)}</text>'
        )
        x += 20 + 6.5 * len(words)
    return Markup("".join([*parts, "</svg>"]))


def _band(point: DriftPoint) -> tuple[float, float, float]:
    return max(point.turned_deg - point.std_deg, 0.0), point.turned_deg, point.turned_deg + point.std_deg
