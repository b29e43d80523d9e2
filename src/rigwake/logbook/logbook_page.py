"""The drift of a vessel's cameras over its whole history, as one HTML file."""

from __future__ import annotations

from collections.abc import Iterable
from datetime import UTC, datetime
from html import escape
from importlib import resources
from pathlib import Path

import numpy as np

from rigwake.atomic import write_text_atomic
from rigwake.evaluation.rig_errors import compare_calibrations
from rigwake.logbook.store import Logbook
from rigwake.report.charts import Series, line_chart


def write_history(book: Logbook, path: Path) -> None:
    """Write the page: how far each camera has turned since the first calibration, entries and verdicts."""
    write_text_atomic(path, render_history(book))


def render_history(book: Logbook) -> str:
    """The whole page as text."""
    entries, verdicts = book.calibrations(), book.verdicts()
    body = f"<header><h1>Logbook {escape(book.path.name)}</h1></header><main>"
    if entries:
        first = book.load(entries[0].id)
        origin = entries[0].valid_from_ns
        days = np.array([(entry.valid_from_ns - origin) / 86400e9 for entry in entries])
        latest = max([days[-1], *((v.begin_ns - origin) / 86400e9 for v in verdicts)])
        turned: dict[str, list[float]] = {name: [] for name in first.cameras}
        for entry in entries:
            differences = compare_calibrations(first, book.load(entry.id), [20.0])
            for name, values in turned.items():
                values.append(differences[name].rotation_deg if name in differences else float("nan"))
        series = []
        for colour, (name, values) in enumerate(turned.items()):
            # one calibration holds until the next, the last one still
            until = np.append(np.repeat(days, 2)[1:], latest + 0.05 * (latest or 1.0))
            series.append(Series(name, until, np.repeat(values, 2), colour))
            said = [v for v in verdicts if v.camera == name and v.size_deg is not None]
            if said:
                at = np.array([(v.begin_ns - origin) / 86400e9 for v in said])
                series.append(Series(f"{name}, monitor", at, np.array([v.size_deg for v in said]), colour))
        chart = line_chart("Turned since the first calibration", "days", "deg", series)
        body += f'<section class="card"><h2>Turned since the first calibration</h2>{_legend(turned)}{chart}</section>'
    rows = "".join(
        f"<tr><td>{e.id}</td><td>{_time(e.valid_from_ns)}</td><td>{_time(e.valid_to_ns)}</td>"
        f'<td class="words">{escape(e.note)}</td></tr>'
        for e in entries
    )
    body += (
        '<section class="card"><h2>Calibrations</h2><table><tr><th>number</th><th>from</th><th>to</th>'
        f'<th class="words">note</th></tr>{rows}</table></section>'
    )
    rows = "".join(
        f"<tr><td>{_time(v.begin_ns)}</td><td>{escape(v.recording)}</td><td>{escape(v.camera)}</td>"
        f'<td>{escape(v.state)}</td><td class="words">{escape(v.words)}</td></tr>'
        for v in verdicts
    )
    rows = rows or '<tr><td colspan="5">nothing yet: rigwake monitor --log</td></tr>'
    body += (
        '<section class="card"><h2>What the monitor said</h2><table><tr><th>from</th><th>recording</th><th>camera</th>'
        f'<th>state</th><th class="words">words</th></tr>{rows}</table></section></main>'
    )
    css = resources.files("rigwake.report").joinpath("assets", "report.css").read_text(encoding="utf-8")
    head = f'<meta charset="utf-8"><title>{escape(book.path.name)}</title><style>{css}</style>'
    return f'<!doctype html><html lang="en"><head>{head}</head><body>{body}</body></html>'


def _legend(names: Iterable[str]) -> str:
    """Which colour is which camera."""
    items = (
        f'<li><span class="swatch s{colour % 8}" aria-hidden="true"></span>{escape(name)}</li>'
        for colour, name in enumerate(names)
    )
    return f'<ul class="legend">{"".join(items)}</ul>'


def _time(time_ns: int | None) -> str:
    if time_ns is None:
        return "now"
    if time_ns < 10**17:  # no date
        return f"{time_ns * 1e-9:.1f} s"
    return datetime.fromtimestamp(time_ns * 1e-9, UTC).strftime("%Y-%m-%d %H:%M")
