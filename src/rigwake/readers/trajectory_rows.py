"""Lines of a trajectory file as rows of cells, and what might be its header."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

from rigwake.errors import InputError, TrajectoryError
from rigwake.text_files import read_text_file

_COMMENT_SIGNS = ("#", "%", "//")


@dataclass(frozen=True)
class TextRow:
    """The cells of one line, and its number in the file."""

    line: int
    cells: tuple[str, ...]


@dataclass(frozen=True)
class TextRows:
    """A text file of numbers.

    header: the cells of a first line that is not numbers, else empty. comments: lines behind a comment sign, and
    as cells in `comment_cells`. separator: `,`, `;`, a tab, or empty for white space.
    """

    path: Path
    rows: tuple[TextRow, ...]
    header: tuple[str, ...]
    header_line: int
    comments: tuple[str, ...]
    comment_cells: tuple[tuple[str, ...], ...]
    separator: str


def is_number(cell: str) -> bool:
    """Whether a cell is a number (NaN and infinities are)."""
    try:
        float(cell)
    except ValueError:
        return False
    return True


def cells_of(line: str) -> tuple[tuple[str, ...], str]:
    """The cells of a line without those that a trailing separator opens, and the separator.

    With `;` or tabs between cells, a comma within numbers is a decimal comma.
    """
    separator = next((sign for sign in ";\t," if sign in line.strip()), "")
    if separator == "\t" and not all(part.strip() for part in line.strip().split("\t")):
        separator = ""
    parts = [part.strip().strip("\"'") for part in line.split(separator)] if separator else _spaced(line)
    while len(parts) > 1 and not parts[-1]:
        parts.pop()
    if separator in (";", "\t"):
        parts = [re.sub(r"^([-+]?\d+),(\d+(?:[eE][-+]?\d+)?)$", r"\1.\2", part) for part in parts]
    return tuple(parts), separator


def _spaced(line: str) -> list[str]:
    """Words, with a unit in brackets kept to the word before it: `timestamp [ns]` is one."""
    return [part.strip("\"'") for part in re.sub(r"\s+([\[(][^\])]*[\])])", r"\1", line).split()]


def read_text_rows(path: Path) -> TextRows:
    """The rows of a file. Raises InputError if it is not there, TrajectoryError if it holds no rows of text."""
    if not path.exists():
        raise InputError(f"There is no file {path}.")
    try:
        text = read_text_file(path)
    except InputError as error:
        raise TrajectoryError(error.cause, remedy=error.remedy) from error
    rows: list[TextRow] = []
    comments: list[str] = []
    header: tuple[str, ...] = ()
    header_line, separator = 0, ""
    for number, line in enumerate(text.splitlines(), start=1):
        stripped = line.strip()
        if stripped.startswith(_COMMENT_SIGNS):
            comments.append(stripped.lstrip("#%/ \t"))
        elif stripped:
            cells, used = cells_of(stripped)
            if not rows and not header and sum(map(is_number, cells)) < min(4, len(cells)):
                header, header_line = cells, number
            else:
                separator = separator or used
                rows.append(TextRow(number, cells))
    if not rows and not header:
        raise TrajectoryError(f"{path} holds no poses.", remedy="Check that the recording is complete.")
    return TextRows(
        path,
        tuple(rows),
        header,
        header_line,
        tuple(comments),
        tuple(cells_of(comment)[0] for comment in comments if comment),
        separator,
    )
