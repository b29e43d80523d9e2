"""What is kept of a monitored recording: a page, JSON, and an entry in the logbook."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from rigwake.atomic import write_text_atomic
from rigwake.calibration import Calibration
from rigwake.errors import RigwakeError
from rigwake.logbook.store import Logbook, LoggedVerdict
from rigwake.monitor.monitor_page import write_page
from rigwake.monitor.monitor_report import logged_verdicts, result_to_dict
from rigwake.monitor.recalibration import Recalibration, camera_to_measure, recalibrate
from rigwake.monitor.run import MonitorResult
from rigwake.monitor.states import recalibrated, recalibrating
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
        number = _number(book, calibration, just_before_ns(recording), note)
        book.add_verdicts(number, logged_verdicts(result, recording.path))


def just_before_ns(recording: Recording) -> int:
    """A moment before its first picture: what changed since that one can then supersede what held until it."""
    return min(int(c.timestamps_ns[0]) for c in recording.cameras.values() if len(c)) - 1


def _number(book: Logbook, calibration: Calibration, begin_ns: int, note: str) -> int:
    """Of a calibration in the logbook, which learns of it if need be."""
    number = book.find(calibration)
    return book.add(calibration, begin_ns, note=note) if number is None else number


def recalibrate_with_log(
    calibration: Calibration,
    recording: Recording,
    result: MonitorResult,
    log: Path,
    save: Callable[[Calibration], None],
    *,
    note: str = "",
) -> Recalibration:
    """As `recalibrate`, and the logbook follows: the camera is RECALIBRATING while it is measured, then the new
    calibration supersedes the old one and it is OK, or it is again what it was, with the reason.

    save: writes the new calibration, before the logbook learns of it. note: a word on the old one.
    """
    camera = camera_to_measure(result)
    (before,) = (v for v in logged_verdicts(result, recording.path) if v.camera == camera)
    during = recalibrating(result.verdicts[camera].state)
    with Logbook(log, create=True) as book:
        number = _number(book, calibration, min(just_before_ns(recording), before.begin_ns - 1), note)
        book.add_verdicts(number, [replace(before, state=str(during), words="its new mounting is measured")])
    try:
        found = recalibrate(calibration, result)
        save(found.calibration)
        _log_recalibrated(found, before, str(recalibrated(during)), recording, log)
    except BaseException as error:  # an interrupt too: the camera must not stay RECALIBRATING
        reason = error.cause if isinstance(error, RigwakeError) else "it was ended"
        with Logbook(log) as book:
            book.add_verdicts(number, [replace(before, words=f"{before.words}; not recalibrated: {reason}")])
        raise
    return found


def _log_recalibrated(
    found: Recalibration, before: LoggedVerdict, state: str, recording: Recording, log: Path
) -> None:
    """The new calibration supersedes the old one, and the camera is in a new state."""
    std = float(np.rad2deg(np.sqrt(np.linalg.eigvalsh(found.covariance)[-1])))
    after = replace(
        before,
        state=state,
        size_deg=None,
        std_deg=None,
        words=f"recalibrated to {std:.3f} deg",
        begin_ns=found.since_ns,
        evidence={},
    )
    with Logbook(log) as book:
        new = book.add(
            found.calibration, found.since_ns, note=f"{before.camera} recalibrated from {recording.path.name}"
        )
        book.add_verdicts(new, [after])
