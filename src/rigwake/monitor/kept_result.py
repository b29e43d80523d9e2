"""What is kept of a monitored recording: a page, JSON, and an entry in the logbook."""

from __future__ import annotations

import json
from pathlib import Path

from rigwake.atomic import write_text_atomic
from rigwake.calibration import Calibration
from rigwake.logbook.store import Logbook
from rigwake.monitor.monitor_page import write_page
from rigwake.monitor.monitor_report import logged_verdicts, result_to_dict
from rigwake.monitor.run import MonitorResult
from rigwake.recording import Recording


def keep_result(
    calibration: Calibration,
    recording: Recording,
    result: MonitorResult,
    out: Path | None,
    log: Path | None,
    *,
    note: str = "",
) -> None:
    """Write monitor.html and monitor.json into `out`, and the verdicts into the logbook `log`, where given.

    A calibration that was never logged holds from this recording on, as far as the logbook knows; note: a word on it.
    """
    if out is not None:
        text = json.dumps(result_to_dict(result), indent=2, allow_nan=False)
        write_text_atomic(out / "monitor.json", text + "\n")
        write_page(result, recording, out / "monitor.html")
    if log is None:
        return
    with Logbook(log, create=True) as book:
        number = book.find(calibration)
        if number is None:
            begin = min(int(c.timestamps_ns[0]) for c in recording.cameras.values() if len(c))
            number = book.add(calibration, begin, note=note)
        book.add_verdicts(number, logged_verdicts(result, recording.path))
