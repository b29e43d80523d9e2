"""OUT/fleet.html: counts, failures by cause, drift of every vessel's cameras over time, outliers, a table."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from functools import cache
from typing import Any

import jinja2
import numpy as np
from markupsafe import Markup

from rigwake import __version__
from rigwake.fleet.fleet_jobs import FAILED, NOT_OBSERVABLE, FleetOutcome
from rigwake.geometry import so3

_MOST_ROWS = 2000  # of the table on the page; the CSV file has all
_MOST_VESSELS = 60
_OUTLIER_SIGMAS = 5.0
_FLOOR_DEG = 0.02  # differences below say nothing about a mount
_EARLIEST_NS, _LATEST_NS = 0, 4_102_444_800_000_000_000  # the year 2100
_WIDTH, _HEIGHT, _MARGIN = 640, 160, 36
_COLOURS = ("#1b6ca8", "#c1440e", "#3a7d44", "#7d4a9c", "#9c7a1b", "#4a6c7d")


@dataclass(frozen=True)
class DriftPoint:
    """One camera in one recording: how far it is turned from the vessel's median, with its standard deviation."""

    started_ns: int
    recording: str
    camera: str
    turned_deg: float
    std_deg: float

    @property
    def is_outlier(self) -> bool:
        """Beyond what its own uncertainty explains."""
        return self.turned_deg > _OUTLIER_SIGMAS * max(self.std_deg, _FLOOR_DEG)


@dataclass
class _Seen:
    """Gathered in one pass over the outcomes."""

    counts: Counter[str] = field(default_factory=Counter)
    causes: dict[str, list[FleetOutcome]] = field(default_factory=lambda: defaultdict(list))
    cause_counts: Counter[str] = field(default_factory=Counter)
    vessels: dict[str, list[FleetOutcome]] = field(default_factory=lambda: defaultdict(list))
    rows: list[FleetOutcome] = field(default_factory=list)


def render_page(outcomes: Iterable[FleetOutcome], wanted: int, csv_name: str) -> str:
    """The whole page, one file without anything from elsewhere. wanted: how many recordings there are."""
    seen = _Seen()
    for outcome in outcomes:
        seen.counts[outcome.status] += 1
        if outcome.status in (FAILED, NOT_OBSERVABLE):
            seen.cause_counts[outcome.cause] += 1
            if len(seen.causes[outcome.cause]) < 10:
                seen.causes[outcome.cause].append(outcome)
        if outcome.is_done and outcome.cameras:
            seen.vessels[outcome.vessel].append(outcome)
        if len(seen.rows) < _MOST_ROWS:
            seen.rows.append(outcome)
    drifts = {vessel: drift_points(found) for vessel, found in sorted(seen.vessels.items())}
    outliers = [(vessel, point) for vessel, points in drifts.items() for point in points if point.is_outlier]
    charts = {v: drift_chart(points) for v, points in list(drifts.items())[:_MOST_VESSELS] if len(points) > 1}
    return (
        _environment()
        .get_template("fleet.html.j2")
        .render(
            version=__version__,
            counts=seen.counts,
            done=sum(seen.counts.values()),
            wanted=wanted,
            causes=[(cause, n, seen.causes[cause]) for cause, n in seen.cause_counts.most_common()],
            outliers=outliers[:200],
            outlier_count=len(outliers),
            charts=charts,
            vessels_left_out=max(len(drifts) - _MOST_VESSELS, 0),
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


def drift_points(outcomes: Sequence[FleetOutcome]) -> list[DriftPoint]:
    """How far every camera of one vessel is turned from its median over all recordings, in the order of time.

    The median is the recording's rotation that is nearest to all others. Rigs in other frames are not compared; of a
    monitored vessel it is the size of the drift that the monitor states.
    """
    points: list[DriftPoint] = []
    by_camera: dict[tuple[str, str], list[tuple[FleetOutcome, Mapping[str, Any]]]] = defaultdict(list)
    for outcome in outcomes:
        for name, camera in outcome.cameras.items():
            quat = camera.get("quat_wxyz")
            if quat and None not in quat:
                by_camera[outcome.reference, name].append((outcome, camera))
            elif camera.get("size_deg") is not None:
                points.append(_point(outcome, name, camera["size_deg"], camera.get("size_std_deg") or 0.0))
    for (_, name), found in by_camera.items():
        rotations = so3.matrix_from_quat_wxyz(np.array([camera["quat_wxyz"] for _, camera in found]))
        for (outcome, camera), turned in zip(found, _turned_from_median(rotations), strict=True):
            stds = [s for s in camera.get("std_rotation_deg") or [] if s is not None]
            points.append(_point(outcome, name, float(turned), max(stds, default=0.0)))
    return sorted(points, key=lambda p: (p.started_ns, p.recording, p.camera))


def _turned_from_median(rotations: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
    """Degrees of every rotation from the one in the middle, judged by at most 200 others."""
    sample = rotations[:: max(len(rotations) // 200, 1)]
    cosines = (np.einsum("nij,mij->nm", sample, sample) - 1) / 2
    middle = sample[int(np.arccos(np.clip(cosines, -1, 1)).sum(axis=1).argmin())]
    return np.rad2deg(np.linalg.norm(so3.log(np.swapaxes(rotations, 1, 2) @ middle), axis=1))


def _point(outcome: FleetOutcome, camera: str, turned: float, std: float) -> DriftPoint:
    return DriftPoint(outcome.started_ns or 0, outcome.recording, camera, turned, std)


def drift_chart(points: Sequence[DriftPoint]) -> Markup:
    """An SVG picture: time along, degrees up, one colour per camera, a bar of one standard deviation."""
    cameras = sorted({point.camera for point in points})
    times = np.array([point.started_ns for point in points], dtype=np.float64)
    span = float(np.ptp(times)) or 1.0
    top = max(max(point.turned_deg + point.std_deg for point in points), _FLOOR_DEG) * 1.05
    parts = [
        f'<svg viewBox="0 0 {_WIDTH} {_HEIGHT}" role="img" aria-label="Turn from the median in degrees over time">',
        f'<path d="M{_MARGIN} 8V{_HEIGHT - 20}H{_WIDTH - 8}" fill="none" stroke="currentColor" opacity="0.5"/>',
        f'<text x="2" y="16">{top:.2f}°</text><text x="2" y="{_HEIGHT - 20}">0°</text>',
        f'<text x="{_MARGIN}" y="{_HEIGHT - 4}">{_date(points[0].started_ns)}</text>',
        f'<text x="{_WIDTH - 8}" y="{_HEIGHT - 4}" text-anchor="end">{_date(points[-1].started_ns)}</text>',
    ]
    for point, time in zip(points, times, strict=True):
        x = _MARGIN + 8 + (time - times.min()) / span * (_WIDTH - _MARGIN - 24)
        y = [_HEIGHT - 20 - v / top * (_HEIGHT - 30) for v in _band(point)]
        colour = _COLOURS[cameras.index(point.camera) % len(_COLOURS)]
        parts.append(
            f'<line x1="{x:.1f}" x2="{x:.1f}" y1="{y[0]:.1f}" y2="{y[2]:.1f}" stroke="{colour}" opacity="0.5"/>'
            f'<circle cx="{x:.1f}" cy="{y[1]:.1f}" r="{4 if point.is_outlier else 2.5}" fill="{colour}"/>'
        )
    return Markup("".join([*parts, "</svg>"]))


def _band(point: DriftPoint) -> tuple[float, float, float]:
    return max(point.turned_deg - point.std_deg, 0.0), point.turned_deg, point.turned_deg + point.std_deg
