"""`rigwake log ACTION VESSEL.db`: the history of a vessel's calibrations."""

from __future__ import annotations

from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.markup import escape

from rigwake.cli.console import figures_table, next_step, out, write_json
from rigwake.cli.options import JsonOption, completed_from, require, require_there, require_writable
from rigwake.errors import UsageError

if TYPE_CHECKING:
    from rigwake.logbook.store import Logbook

ACTIONS = ("add", "list", "show", "diff", "at", "plot", "export")


def command(
    action: Annotated[
        str, typer.Argument(help=f"One of {', '.join(ACTIONS)}.", autocompletion=completed_from(ACTIONS))
    ],
    vessel: Annotated[Path, typer.Argument(metavar="VESSEL.db", help="The logbook.")],
    what: Annotated[
        list[str] | None,
        typer.Argument(help="add: a calibration. show: a number. diff: two numbers. at: a time."),
    ] = None,
    valid_from: Annotated[
        str | None, typer.Option("--from", help="add: since when it holds (default: now).")
    ] = None,
    note: Annotated[str, typer.Option(help="add: a word about it.")] = "",
    output: Annotated[
        Path | None, typer.Option("-o", "--out", "--output", help="plot, export, show, at: a file.")
    ] = None,
    json_file: JsonOption = None,
) -> None:
    """Calibrations of a vessel with the time in which each holds, and what the monitor said.

    Times: 2026-05-01T14:03:10 (UTC), or nanoseconds.

    Example: [cyan]rigwake log add vessel.db calibration.yaml --from 2026-05-01T08:00[/cyan]

    Example: [cyan]rigwake log at vessel.db 2026-05-03T12:00 -o then.yaml[/cyan]
    """
    require("action", action, ACTIONS)
    arguments = what or []
    needed = {"add": 1, "show": 1, "diff": 2, "at": 1}.get(action, 0)
    if len(arguments) != needed:
        raise UsageError(
            f"log {action} takes {needed} argument{'s' * (needed != 1)} after the logbook, not {len(arguments)}.",
            remedy="See `rigwake log --help`.",
        )
    require_writable("-o", output)
    require_writable("--json", json_file)
    require_there(Path(arguments[0]) if action == "add" else vessel)
    from rigwake.logbook.store import Logbook

    if action == "add":
        _add(vessel, Path(arguments[0]), valid_from, note)
        return
    with Logbook(vessel) as book:
        if action == "list":
            _list(book, json_file)
        elif action == "show":
            _write(book, _number(arguments[0]), output)
        elif action == "at":
            _write(book, book.at(parse_time(arguments[0])).id, output)
        elif action == "diff":
            _diff(book, _number(arguments[0]), _number(arguments[1]), json_file)
        elif action == "plot":
            from rigwake.logbook.logbook_page import write_history

            path = output or vessel.with_suffix(".html")
            write_history(book, path)
            out.print(f"written: {path}", markup=False, highlight=False)
        else:
            _export(book, output)


def parse_time(text: str) -> int:
    """Nanoseconds of a UTC time or of a whole number; UsageError otherwise."""
    if text.isdigit():
        return int(text)
    try:
        moment = datetime.fromisoformat(text)
    except ValueError as error:
        raise UsageError(
            f"{text!r} is no time.", remedy="Write 2026-05-01T14:03:10 (UTC), or nanoseconds."
        ) from error
    if moment.tzinfo is None:
        moment = moment.replace(tzinfo=UTC)
    seconds = int(moment.replace(microsecond=0).timestamp())
    return seconds * 10**9 + moment.microsecond * 1000


def time_words(time_ns: int | None) -> str:
    """A UTC time, or seconds where the clock does not count from 1970."""
    if time_ns is None:
        return "now"
    if time_ns < 10**17:
        return f"{time_ns * 1e-9:.1f} s"
    return datetime.fromtimestamp(time_ns * 1e-9, UTC).strftime("%Y-%m-%d %H:%M:%S")


def _number(text: str) -> int:
    if not text.isdigit():
        raise UsageError(f"{text!r} is no number of a calibration.", remedy="`rigwake log list` shows them.")
    return int(text)


def _add(vessel: Path, file: Path, valid_from: str | None, note: str) -> None:
    import time

    from rigwake.calibration import load_calibration
    from rigwake.logbook.store import Logbook

    calibration = load_calibration(file)
    begin = time.time_ns() if valid_from is None else parse_time(valid_from)
    with Logbook(vessel, create=True) as book:
        number = book.add(calibration, begin, note or file.name)
    out.print(f"calibration {number}, from {time_words(begin)}", markup=False, highlight=False)
    next_step(["rigwake", "log", "list", vessel], "see the history")


def _list(book: Logbook, json_file: Path | None) -> None:
    entries, verdicts = book.calibrations(), book.verdicts()
    if json_file is not None:
        write_json(
            json_file,
            {
                "calibrations": [vars(entry) for entry in entries],
                "verdicts": [{**vars(v), "evidence": dict(v.evidence)} for v in verdicts],
            },
        )
        if str(json_file) == "-":
            return
    table = figures_table(("number", "from", "to", "verdicts", "note"), words=5)
    for entry in entries:
        said = [v for v in verdicts if v.calibration_id == entry.id]
        states = ", ".join(sorted({v.state for v in said})) or "–"
        table.add_row(
            str(entry.id),
            time_words(entry.valid_from_ns),
            time_words(entry.valid_to_ns),
            states,
            escape(entry.note),
        )
    out.print(table)


def _write(book: Logbook, number: int, output: Path | None) -> None:
    """The calibration, to a file or as a table."""
    from rigwake.calibration import save_calibration

    calibration = book.load(number)
    if output is None:
        out.print(f"calibration {number}", markup=False, highlight=False)
        out.print(repr(calibration), markup=False, highlight=False)
        return
    save_calibration(calibration, output)
    out.print(f"calibration {number} written: {output}", markup=False, highlight=False)


def _diff(book: Logbook, first: int, second: int, json_file: Path | None) -> None:
    from rigwake.calibration.yaml_file import plain
    from rigwake.evaluation.rig_errors import compare_calibrations

    differences = compare_calibrations(book.load(first), book.load(second), [20.0])
    if json_file is not None:
        write_json(json_file, plain({name: d.to_json() for name, d in differences.items()}))
        if str(json_file) == "-":
            return
    table = figures_table(("camera", "rotation °", "x mm", "y mm", "z mm"))
    for name, d in differences.items():
        table.add_row(escape(name), f"{d.rotation_deg:.4f}", *(f"{v:+.1f}" for v in d.translation_mm))
    out.print(table)


def _export(book: Logbook, output: Path | None) -> None:
    """A consistent copy of the file, also while others write into it."""
    if output is None:
        raise UsageError("Where to? -o names the copy.", remedy="For example: -o copy.db")
    if output.exists():
        raise UsageError(f"{output} is already there.", remedy="Remove it, or choose another name.")
    book.copy_to(output)
    out.print(f"written: {output}", markup=False, highlight=False)
