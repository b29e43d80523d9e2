"""Terminal output shared by all verbs: results on stdout, progress and errors on stderr."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.markup import escape
from rich.panel import Panel
from rich.progress import BarColumn, Progress, SpinnerColumn, TextColumn, TimeRemainingColumn

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
