"""Lines of a trajectory file as rows of cells, and what might be its header."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

from rigwake.errors import InputError, TrajectoryError
from rigwake.readers.stamp_units import plain_number
from rigwake.text_files import read_text_file

_COMMENT_SIGNS = ("#", "%", "//")
_WITH_COMMA = re.compile(r"^\s*([-+]?\d+),(\d+(?:[eE][-+]?\d+)?)\s*$")
_DECIMAL_COMMA = re.compile(r"[-+]?\d+,\d+([eE][-+]?\d+)?|[-+]?\d+")


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
    spaced = line.split()
    if separator == "," and len(spaced) > 1 and all(_DECIMAL_COMMA.fullmatch(part) for part in spaced):
        return tuple(part.replace(",", ".") for part in spaced), ""
    if separator == "\t" and not all(part.strip() for part in line.strip().split("\t")):
        separator = ""
    parts = [part.strip().strip("\"'") for part in line.split(separator)] if separator else _spaced(line)
    while len(parts) > 1 and not parts[-1]:
        parts.pop()
    if separator in (";", "\t"):
        parts = [with_decimal_point(part) for part in parts]
    return tuple(parts), separator


def with_decimal_point(cell: str) -> str:
    """A number with a decimal comma as Python reads it; anything else as it is."""
    return _WITH_COMMA.sub(r"\1.\2", cell)


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
            numbers = tuple(map(plain_number, cells))
            if not rows and not header and sum(map(is_number, numbers)) < min(4, len(cells)):
                header, header_line = cells, number
            else:
                separator = separator or used
                rows.append(TextRow(number, numbers))
    if not rows and not header:
        raise TrajectoryError(f"{path} holds no poses.", remedy="Check that the recording is complete.")
    return TextRows(
        path,
        tuple(_with_blocks_joined(rows)),
        header,
        header_line,
        tuple(comments),
        tuple(cells_of(comment)[0] for comment in comments if comment),
        separator,
    )


def _with_blocks_joined(rows: list[TextRow]) -> list[TextRow]:
    """The rows; matrices of four lines each, with or without a line of numbers before (Open3D), as one row each."""
    widths = [len(row.cells) for row in rows]
    lead = 1 if widths and widths[0] < 4 else 0
    period = 4 + lead
    if (
        not rows
        or len(rows) % period
        or any(width != 4 for at, width in enumerate(widths) if at % period >= lead)
    ):
        return rows
    blocks = [rows[at + lead : at + period] for at in range(0, len(rows), period)]
    if not all(
        list(map(float, block[3].cells)) == [0, 0, 0, 1]
        for block in blocks
        if all(map(is_number, block[3].cells))
    ):
        return rows
    return [TextRow(block[0].line, tuple(cell for row in block for cell in row.cells)) for block in blocks]
