"""An inspection as one self-contained HTML page with plots."""

from __future__ import annotations

from html import escape
from typing import Any

import numpy as np
import plotly.graph_objects as go
from numpy.typing import NDArray
from plotly.subplots import make_subplots

from rigwake._types import Array
from rigwake.inspection.readiness import Readiness
from rigwake.inspection.recording_inspection import Inspection, sensors
from rigwake.inspection.timing import periods_s
from rigwake.inspection.told_over_time import ToldOverTime
from rigwake.recording import main_gnss

_MAX_POINTS = 4000  # of one curve
_COLOURS = {"enough": "#1a7f37", "partly": "#9a6700", "not enough": "#cf222e"}
_STYLE = """
body { font: 15px/1.5 system-ui, sans-serif; max-width: 1100px; margin: 2em auto; padding: 0 1em; color: #1f2328 }
table { border-collapse: collapse; margin: 1em 0 } td, th { padding: .3em .8em; border-bottom: 1px solid #d1d9e0;
text-align: left } .verdict { font-size: 1.3em; font-weight: 600 }
"""


def inspection_page(inspection: Inspection, verdict: Readiness, told: ToldOverTime | None = None) -> str:
    """The page; it loads nothing from elsewhere."""
    recording = inspection.recording
    candidates = (_timeline(inspection), _motion(inspection), _told(inspection, told), _path(inspection))
    figures = [figure for figure in candidates if figure]
    plots = [
        figure.to_html(full_html=False, include_plotlyjs="inline" if at == 0 else False)
        for at, figure in enumerate(figures)
    ]
    parts = [
        f"<h1>{escape(recording.path.name)}</h1><p>{escape(recording.kind)}</p>",
        f'<p class="verdict" style="color:{_COLOURS[verdict.word]}">{escape(verdict.summary)}</p>',
        _listing(verdict.advice),
        _table(["check", "measured", "passed"], _check_rows(verdict)),
        _table(["sensor", "samples", "rate (Hz)", "jitter (ms)", "missing"], _sensor_rows(inspection)),
        _table(["", "sensor", "finding"], [[f.severity, f.sensor, f.message] for f in inspection.findings]),
        *plots,
    ]
    title = f"inspect {escape(recording.path.name)}"
    head = f'<meta charset="utf-8"><title>{title}</title><style>{_STYLE}</style>'
    return f"<!doctype html><html><head>{head}</head><body>{''.join(parts)}</body></html>"


def _listing(lines: tuple[str, ...]) -> str:
    return "".join(["<ul>", *(f"<li>{escape(line)}</li>" for line in lines), "</ul>"]) if lines else ""


def _table(head: list[str], rows: list[list[str]]) -> str:
    if not rows:
        return ""
    body = "".join("<tr>" + "".join(f"<td>{escape(cell)}</td>" for cell in row) + "</tr>" for row in rows)
    return f"<table><tr>{''.join(f'<th>{escape(cell)}</th>' for cell in head)}</tr>{body}</table>"


def _check_rows(verdict: Readiness) -> list[list[str]]:
    words = {True: "yes", False: "no", None: "cannot tell"}
    return [[check.name, check.measured, words[check.passed]] for check in verdict.checks]


def _sensor_rows(inspection: Inspection) -> list[list[str]]:
    return [
        [key, str(t.samples), f"{t.rate_hz:.2f}", f"{t.jitter_ms:.2f}", str(t.dropped)]
        for key, t in inspection.timings.items()
    ]


def _thinned(*columns: NDArray[Any]) -> list[NDArray[Any]]:
    step = max(len(columns[0]) // _MAX_POINTS, 1)
    return [column[::step] for column in columns]


def _start_ns(inspection: Inspection) -> int:
    return min((t.start_ns for t in inspection.timings.values() if t.samples), default=0)


def _timeline(inspection: Inspection) -> go.Figure | None:
    """Time between samples of every sensor: rates, jitter and gaps at a glance."""
    figure = go.Figure()
    start = _start_ns(inspection)
    for key, stream in sensors(inspection.recording).items():
        stamps = np.asarray(stream.timestamps_ns)
        if len(stamps) > 1:
            times, periods = _peaks_kept((stamps[1:] - start) * 1e-9, periods_s(stamps))
            figure.add_scatter(x=times, y=1e3 * periods, name=key, mode="lines")
    if not figure.data:
        return None
    figure.update_layout(title="Time between samples", height=420)
    figure.update_xaxes(title="s")
    figure.update_yaxes(title="ms", type="log")
    return figure


def _peaks_kept(times: Array, values: Array) -> tuple[Array, Array]:
    """Fewer points, of each block the largest value, so that no gap is lost."""
    block = max(len(values) // _MAX_POINTS, 1)
    count = len(values) // block * block
    rows = values[:count].reshape(-1, block).argmax(axis=1) + np.arange(0, count, block)
    return times[rows], values[rows]


def _motion(inspection: Inspection) -> go.Figure | None:
    turn, path = inspection.turning, inspection.travel
    if turn is None:
        return None
    start = _start_ns(inspection)
    figure = make_subplots(rows=3 if path else 2, cols=1, shared_xaxes=True)
    times, rate, tilt = _thinned((turn.times_ns - start) * 1e-9, np.degrees(turn.yaw_rate), turn.tilt_deg)
    figure.add_scatter(x=times, y=rate, name="turning (deg/s)", row=1, col=1)
    figure.add_scatter(x=times, y=tilt, name="tilt (deg)", row=2, col=1)
    if path is not None:
        times, speed = _thinned((path.times_ns - start) * 1e-9, path.speed)
        figure.add_scatter(x=times, y=speed, name="speed (m/s)", row=3, col=1)
    figure.update_layout(title="Motion", height=600)
    return figure


def _told(inspection: Inspection, told: ToldOverTime | None) -> go.Figure | None:
    """Bars of what each stretch tells about the rig; those that would be used in another colour."""
    if told is None:
        return None
    figure = go.Figure()
    middle = (told.starts_ns - _start_ns(inspection)) * 1e-9 + told.lengths_s / 2
    for rows, name in ((told.chosen, "used"), (~told.chosen, "not used")):
        if rows.any():
            figure.add_bar(x=middle[rows], y=100 * told.told[rows], width=told.lengths_s[rows], name=name)
    figure.update_layout(title=f"Information about the rig: {escape(told.words)}", height=360)
    figure.update_xaxes(title="s")
    figure.update_yaxes(title="% of all")
    return figure


def _path(inspection: Inspection) -> go.Figure | None:
    gnss = main_gnss(inspection.recording)
    if gnss is None or len(gnss.timestamps_ns) < 2:
        return None
    east, north = _thinned(gnss.position_enu[:, 0], gnss.position_enu[:, 1])
    figure = go.Figure(go.Scatter(x=east, y=north, mode="lines+markers", name=gnss.name))
    figure.update_layout(title="Path of the antenna (east, north, m)", height=600)
    figure.update_yaxes(scaleanchor="x")
    return figure
