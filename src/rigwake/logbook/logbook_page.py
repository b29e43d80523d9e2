"""The drift of a vessel's cameras over its whole history, as one HTML file."""

from __future__ import annotations

from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from rigwake.atomic import write_text_atomic
from rigwake.evaluation.rig_errors import compare_calibrations
from rigwake.logbook.store import Logbook
from rigwake.report.charts import Series, line_chart
from rigwake.report.html_page import card, figure, html_page, legend, table


def write_history(book: Logbook, path: Path) -> None:
    """Write the page: how far each camera has turned since the first calibration, entries and verdicts."""
    write_text_atomic(path, render_history(book))


def render_history(book: Logbook) -> str:
    """The whole page as text."""
    entries, verdicts = book.calibrations(), book.verdicts()
    parts = []
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
                sizes = np.array([v.size_deg for v in said])
                series.append(Series(f"{name}, monitor", at, sizes, colour, is_dots=True))
        chart = line_chart("Turned since the first calibration", "days", "deg", series)
        words = "Lines: calibrations; dots: what the monitor said."
        parts.append(card("Turned since the first calibration", legend(turned), figure(chart, words)))
    rows = [[str(e.id), _time(e.valid_from_ns), _time(e.valid_to_ns), e.note] for e in entries]
    parts.append(
        card("Calibrations", table("Calibrations", ["number", "from", "to", "note"], rows, words=(3,)))
    )
    rows = [[_time(v.begin_ns), v.recording, v.camera, v.state, v.words] for v in verdicts]
    rows = rows or [["", "", "", "", "nothing yet: rigwake monitor --log"]]
    head = ["from", "recording", "camera", "state", "words"]
    parts.append(card("What the monitor said", table("What the monitor said", head, rows, words=(4,))))
    return html_page(f"Logbook {book.path.name}", parts)


def _time(time_ns: int | None) -> str:
    if time_ns is None:
        return "now"
    if time_ns < 10**17:  # no date
        return f"{time_ns * 1e-9:.1f} s"
    return datetime.fromtimestamp(time_ns * 1e-9, UTC).strftime("%Y-%m-%d %H:%M")
