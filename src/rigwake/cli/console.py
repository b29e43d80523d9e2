"""Terminal output shared by all verbs: results on stdout, progress and errors on stderr."""

from __future__ import annotations

import codecs
import json
import shlex
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.console import Console, ConsoleOptions, ConsoleRenderable, RenderableType, RenderHook, RenderResult
from rich.markup import escape
from rich.segment import Segment
from rich.table import Table
from rich.text import Text

from rigwake.atomic import write_text_atomic
from rigwake.errors import RigwakeError

if TYPE_CHECKING:  # what only long work needs would slow the completion of the shell down
    from rich.progress import Progress, TaskID

    from rigwake.calibration import Calibration

# what could move the cursor, colour the terminal, or turn the direction of writing: shown, not done
_CONTROLS = {code: f"\\x{code:02x}" for code in (*range(32), *range(127, 160)) if chr(code) not in "\n\t"}
_CONTROLS |= {
    code: f"\\u{code:04x}" for code in (0x200E, 0x200F, *range(0x202A, 0x202F), *range(0x2066, 0x206A))
}
_PLAIN = {
    "±": "+-",
    "°": " deg",
    "–": "-",
    "—": "-",
    "→": "->",
    "…": "...",
    "·": ".",
    "│": "|",
    "²": "^2",
    "×": "x",
}


def shown(text: str) -> str:
    """The text with control characters written out, as they may stand in names of topics and folders."""
    return text.translate(_CONTROLS)


class _Shown:
    """What a renderable renders, control characters written out."""

    def __init__(self, inner: RenderableType) -> None:
        self._inner = inner

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        for segment in console.render(self._inner, options):
            yield segment if segment.control else Segment(shown(segment.text), segment.style)


class _ShowControls(RenderHook):
    def process_renderables(self, renderables: list[ConsoleRenderable]) -> list[ConsoleRenderable]:
        return [_Shown(renderable) for renderable in renderables]


def _console(stderr: bool = False) -> Console:
    console = Console(stderr=stderr)
    console.push_render_hook(_ShowControls())
    return console


out = _console()
err = _console(stderr=True)


def adapt_streams() -> None:
    """Let standard output and standard error take every character, whatever their encoding: what it lacks is written
    in ASCII."""
    codecs.register_error("rigwake-plain", _in_ascii)
    for stream in (sys.stdout, sys.stderr):
        if hasattr(stream, "reconfigure"):
            stream.reconfigure(errors="rigwake-plain")


def _in_ascii(error: UnicodeError) -> tuple[str, int]:
    if not isinstance(error, UnicodeEncodeError):
        raise error
    wrong = error.object[error.start : error.end]
    known = (_PLAIN.get(c, c) for c in wrong)
    return "".join(known).encode("ascii", "backslashreplace").decode("ascii"), error.end


def print_error(error: RigwakeError) -> None:
    """Cause, consequence and remedy in a panel on stderr."""
    from rich.panel import Panel

    lines = [f"[bold]{escape(error.cause)}[/bold]"]
    if error.consequence:
        lines.append(escape(error.consequence))
    if error.remedy:
        lines.append(f"[green]→ {escape(error.remedy)}[/green]")
    titles = {
        2: "wrong usage",
        3: "the motion cannot determine this",
        4: "a part is missing",
        5: "the computer failed",
    }
    err.print(
        Panel("\n".join(lines), title=titles.get(error.exit_code, "failed"), border_style="red", expand=False)
    )


def next_step(command: str | Sequence[object], why: str) -> None:
    """Name the next step, as every command does when it ends. command: its words, quoted here where they need it."""
    if not isinstance(command, str):
        command = shlex.join(map(str, command))
    out.print(f"\n[bold]next:[/bold] [cyan]{escape(command)}[/cyan]  {escape(why)}", soft_wrap=True)


def print_title(text: str) -> None:
    """The heading of a table, on a line of its own however narrow the table is."""
    out.print(escape(text), style="bold", highlight=False, soft_wrap=True)


class _FiguresTable(Table):
    """A table that becomes a list, one figure a line under the name of its row, where it is wider than the terminal."""

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        if self._least_width(console) <= options.max_width:
            yield from super().__rich_console__(console, options)
            return
        names, *figures = self.columns
        for row, name in enumerate(names.cells):
            yield name
            for column in figures:
                cell = list(column.cells)[row]
                yield Text("  ").append_text(_styled(column.header)).append(" ").append_text(_styled(cell))

    def _least_width(self, console: Console) -> int:
        """The width at which no figure and no name of a row is cut; other words may be wrapped."""
        cells = [[column.header, *column.cells] for column in self.columns]
        wide = [[console.measure(_styled(cell)) for cell in column] for column in cells]
        return -2 + sum(
            2 + max(m.maximum if at == 0 or column.no_wrap else m.minimum for m in found)
            for at, (column, found) in enumerate(zip(self.columns, wide, strict=True))
        )


def _styled(cell: RenderableType) -> Text:
    return cell if isinstance(cell, Text) else Text.from_markup(str(cell))


def figures_table(headings: Sequence[str], words: int = 1) -> Table:
    """A table of figures: no rules, no figure wrapped, units in the headings; a list where the terminal is narrower.

    words: how many columns from the left hold words; the rest holds figures, to the right.
    """
    table = _FiguresTable(box=None, pad_edge=False)
    for index, heading in enumerate(headings):
        table.add_column(heading, justify="left" if index < words else "right", no_wrap=index >= words)
    return table


def write_json(path: Path, content: Any) -> None:
    """Write strict JSON atomically (NaN and infinities become null); '-' prints it."""
    from rigwake.calibration.yaml_file import plain  # here: it takes longer to load than most verbs' help

    text = json.dumps(plain(content), indent=2, allow_nan=False) + "\n"
    if str(path) == "-":
        print(text, end="")
    else:
        write_text_atomic(path, text)


class PlainProgress:
    """Progress as lines of text, where standard error is no terminal: a line per step and every so many seconds."""

    def __init__(self) -> None:
        self._tasks: list[dict[str, Any]] = []

    def add_task(self, description: str, total: float = 1.0) -> TaskID:
        """Another thing that is done."""
        from rich.progress import TaskID

        self._tasks.append({"what": description, "done": 0.0, "total": total, "said": ("", 0.0)})
        return TaskID(len(self._tasks) - 1)

    def advance(self, task: TaskID, steps: float = 1.0) -> None:
        """So much more is done."""
        self.update(task, completed=self._tasks[task]["done"] + steps)

    def update(
        self,
        task: TaskID,
        *,
        description: str | None = None,
        completed: float | None = None,
        total: float | None = None,
    ) -> None:
        """What is done now, how much of it, of how much."""
        state = self._tasks[task]
        new = {"what": description, "done": completed, "total": total}
        state.update({key: value for key, value in new.items() if value is not None})
        now, (what, when) = time.monotonic(), state["said"]
        if state["what"] == what and now - when < _SECONDS_BETWEEN_LINES:
            return
        state["said"] = (state["what"], now)
        percent = min(100 * state["done"] / state["total"], 100) if state["total"] else 0
        err.print(f"{state['what']} {percent:.0f} %", highlight=False, soft_wrap=True)


_SECONDS_BETWEEN_LINES = 10.0


@contextmanager
def progress_bar() -> Iterator[Progress | PlainProgress]:
    """The progress of long work, on stderr: a bar that is gone when done, or plain lines where that is no terminal."""
    with _progress("{task.completed:.0f}/{task.total:.0f}", remaining=True) as progress:
        yield progress


@contextmanager
def _progress(figures: str, remaining: bool = False) -> Iterator[Progress | PlainProgress]:
    """figures: the form of what stands behind the bar. remaining: whether the time that is left is said as well."""
    if not err.is_terminal:
        yield PlainProgress()
        return
    from rich.progress import BarColumn, Progress, SpinnerColumn, TextColumn, TimeRemainingColumn

    columns = [SpinnerColumn(), TextColumn("{task.description}"), BarColumn(), TextColumn(figures)]
    if remaining:
        columns.append(TimeRemainingColumn())
    with Progress(*columns, console=err, transient=True) as progress:
        yield progress


class ProgressBars:
    """One bar per name, told by `bars(name, what, fraction)`."""

    def __init__(self, progress: Progress | PlainProgress) -> None:
        self._progress = progress
        self._tasks: dict[str, TaskID] = {}

    def __call__(self, name: str, what: str, fraction: float) -> None:
        """Show that `name` has done this fraction of `what`."""
        if name not in self._tasks:
            self._tasks[name] = self._progress.add_task(name, total=1.0)
        self._progress.update(self._tasks[name], description=escape(f"{name}: {what}"), completed=fraction)


@contextmanager
def progress_bars() -> Iterator[ProgressBars]:
    """Progress of things done at the same time, on stderr: bars that are gone when done, or plain lines."""
    with _progress("{task.percentage:.0f} %") as progress:
        yield ProgressBars(progress)


def print_looks(calibration: Calibration) -> None:
    """Where every camera looks, one line each; nothing where the axes of the reference have no known meaning."""
    from rigwake.report.extrinsics import looks

    words = {name: looks(camera, calibration.reference) for name, camera in calibration.cameras.items()}
    width = max(map(len, words), default=0)
    for name, where in words.items():
        if where:
            out.print(f"{name:<{width}}  looks {where}", markup=False, highlight=False, soft_wrap=True)
