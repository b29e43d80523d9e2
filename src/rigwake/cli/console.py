"""Terminal output shared by all verbs: results on stdout, progress and errors on stderr."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.markup import escape
from rich.panel import Panel
from rich.progress import BarColumn, Progress, SpinnerColumn, TaskID, TextColumn, TimeRemainingColumn
from rich.table import Table

from rigwake.atomic import write_text_atomic
from rigwake.errors import RigwakeError

out = Console()
err = Console(stderr=True)


def print_error(error: RigwakeError) -> None:
    """Cause, consequence and remedy in a panel on stderr."""
    lines = [f"[bold]{escape(error.cause)}[/bold]"]
    if error.consequence:
        lines.append(escape(error.consequence))
    if error.remedy:
        lines.append(f"[green]→ {escape(error.remedy)}[/green]")
    titles = {2: "wrong usage", 3: "the motion cannot determine this"}
    err.print(
        Panel("\n".join(lines), title=titles.get(error.exit_code, "failed"), border_style="red", expand=False)
    )


def next_step(command: str, why: str) -> None:
    """Name the next step, as every command does when it ends."""
    out.print(f"\n[bold]next:[/bold] [cyan]{escape(command)}[/cyan]  {escape(why)}", soft_wrap=True)


def print_title(text: str) -> None:
    """The heading of a table, on a line of its own however narrow the table is."""
    out.print(escape(text), style="bold", highlight=False, soft_wrap=True)


def figures_table(headings: Sequence[str], words: int = 1) -> Table:
    """A table of figures that stays readable on 80 columns: no rules, no figure wrapped, units in the headings.

    words: how many columns from the left hold words; the rest holds figures, to the right.
    """
    table = Table(box=None, pad_edge=False)
    for index, heading in enumerate(headings):
        table.add_column(heading, justify="left" if index < words else "right", no_wrap=index >= words)
    return table


def write_json(path: Path, content: Any) -> None:
    """Write strict JSON (no NaN) atomically; '-' prints it."""
    text = json.dumps(content, indent=2, allow_nan=False) + "\n"
    if str(path) == "-":
        print(text, end="")
    else:
        write_text_atomic(path, text)


def progress_bar() -> Progress:
    """The progress bar of long work, on stderr, gone when done."""
    return Progress(
        SpinnerColumn(),
        TextColumn("{task.description}"),
        BarColumn(),
        TextColumn("{task.completed:.0f}/{task.total:.0f}"),
        TimeRemainingColumn(),
        console=err,
        transient=True,
    )


class ProgressBars:
    """One bar per name, told by `bars(name, what, fraction)`."""

    def __init__(self, progress: Progress) -> None:
        self._progress = progress
        self._tasks: dict[str, TaskID] = {}

    def __call__(self, name: str, what: str, fraction: float) -> None:
        """Show that `name` has done this fraction of `what`."""
        if name not in self._tasks:
            self._tasks[name] = self._progress.add_task(name, total=1.0)
        self._progress.update(self._tasks[name], description=escape(f"{name}: {what}"), completed=fraction)


@contextmanager
def progress_bars() -> Iterator[ProgressBars]:
    """Bars of things done at the same time, on stderr, gone when done."""
    columns = (
        SpinnerColumn(),
        TextColumn("{task.description}"),
        BarColumn(),
        TextColumn("{task.percentage:.0f} %"),
    )
    with Progress(*columns, console=err, transient=True) as progress:
        yield ProgressBars(progress)
