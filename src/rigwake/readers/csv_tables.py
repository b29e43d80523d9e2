"""Tables with named columns: any separator, header or comment, stamps exact to the nanosecond."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from rigwake._types import Array, Stamps
from rigwake.errors import InputError
from rigwake.readers.column_names import name_and_unit
from rigwake.readers.stamp_units import NS_PER_UNIT, UNIT_OF_WORD, stamps_from_text
from rigwake.readers.trajectory_rows import cells_of, is_number, with_decimal_point
from rigwake.text_files import read_text_file

_SECOND_NAMES = ("sec", "secs", "header.stamp.sec", "header.stamp.secs", "stamp.sec", "timestamp.sec")
_NANO_NAMES = ("nanosec", "nsec", "nsecs", "header.stamp.nanosec", "header.stamp.nsecs", "stamp.nanosec")
_STAMP_NAMES = (
    *("timestamp", "field.header.stamp", "header.stamp", "rosbagtimestamp", "time", "stamp", "t", "__time"),
    *("epoch", "unix_time", "timestamps", *_SECOND_NAMES, "utc", "datetime", "date_time", "utc_time"),
    *("time_utc", "timestamp_utc", "date"),
)
_COMMENTS = ("#", "%", "//")
_MAX_TABLE_BYTES = 2**30


@dataclass(frozen=True, eq=False)
class Table:
    """Cells of a csv file by column name (lower case, without units); rows of another width are dropped.

    units: of each column, as in `timestamp [ns]` or `timestamp_ns`, else empty.
    """

    path: Path
    columns: dict[str, list[str]]
    units: dict[str, str]
    dropped_rows: int

    def find(self, *names: str) -> str | None:
        """The first of these columns that is there."""
        return next((name for name in names if name in self.columns), None)

    def numbers(self, *alternatives: Sequence[str]) -> Array:
        """(N, k) floats of the first alternative whose k columns are all there; unreadable cells are NaN.

        Raises InputError if none is there.
        """
        for names in alternatives:
            if all(name in self.columns for name in names):
                return np.column_stack([_floats(self.columns[name]) for name in names])
        raise InputError(
            f"{self.path} lacks the columns {', '.join(alternatives[0])}.",
            remedy=f"It has {', '.join(self.columns)}; name them so.",
        )

    @property
    def stamp_column(self) -> str | None:
        """The name of the time column."""
        return self.find(*_STAMP_NAMES)

    def stamps_ns(self) -> Stamps:
        """The time column in integer nanoseconds; its unit from the header, else from its size.

        Unreadable stamps are -1. Raises InputError if there is no time column.
        """
        name = self.stamp_column
        if name is None:
            raise InputError(
                f"{self.path} lacks a time column.", remedy="Name it timestamp_ns or timestamp_s."
            )
        unit = self.units[name] if self.units[name] in NS_PER_UNIT else ""
        nano = next((other for other in _NANO_NAMES if other in self.columns), None)
        if nano is not None and name in _SECOND_NAMES:
            seconds, parts = (
                stamps_from_text(self.columns[name], "s"),
                stamps_from_text(self.columns[nano], "ns"),
            )
            return np.where((seconds >= 0) & (parts >= 0), seconds + parts, -1)
        return stamps_from_text(self.columns[name], unit)


def _floats(cells: list[str]) -> Array:
    try:
        return np.array(cells, dtype=np.float64)
    except ValueError:
        return np.array([_float(cell) for cell in cells])


def _float(cell: str) -> float:
    try:
        return float(cell)
    except ValueError:
        return float("nan")


def read_table(path: Path, names: Sequence[str] = ()) -> Table:
    """Read a table with a header line, which may stand in a comment: commas, semicolons, tabs or white space.

    names: of the columns of a table without a header. Raises InputError if it is no table.
    """
    lines = [line for line in read_text_file(path, _MAX_TABLE_BYTES).splitlines() if line.strip()]
    if not lines:
        raise InputError(f"{path} is empty.")
    comments = [line for line in lines if line.lstrip().startswith(_COMMENTS)]
    body = [line for line in lines if not line.lstrip().startswith(_COMMENTS)]
    separator = _separator(body[0] if body else comments[-1])
    try:
        rows = _split(body, separator)
    except csv.Error as error:
        raise InputError(f"{path} cannot be read as csv ({error}).") from error
    if rows and not _is_header(rows[0]):
        header = _comment_header(comments, len(rows[0]), separator) or list(names)
        if len(header) != len(rows[0]):
            raise InputError(f"{path} has no header line.", remedy="Name its columns in the first line.")
    else:
        header = rows[0] if rows else _split(comments[-1:], separator)[0]
        rows = rows[1:]
    named, units = zip(*(_name_and_unit(cell) for cell in header), strict=True)
    whole = [row for row in rows if len(row) == len(named)]
    columns = (
        dict(zip(named, map(list, zip(*whole, strict=True)), strict=True))
        if whole
        else {n: [] for n in named}
    )
    return Table(path, columns, dict(zip(named, units, strict=True)), len(rows) - len(whole))


def _separator(line: str) -> str:
    return next((sign for sign in (";", "\t", ",") if sign in line), " ")


def _split(lines: Sequence[str], separator: str) -> list[list[str]]:
    """Cells of lines, without the empty one that a trailing separator opens."""
    stripped = [line.strip().lstrip("#%").strip() for line in lines]
    if separator == " ":
        return [list(cells_of(line)[0]) for line in stripped]
    rows = [row for row in csv.reader(stripped, delimiter=separator, skipinitialspace=True) if row]
    if separator != ",":
        rows = [[with_decimal_point(cell) for cell in row] for row in rows]
    return [
        row[:-1] if len(row) > 2 and not row[-1].strip() and line.endswith(separator) else row
        for row, line in zip(rows, stripped, strict=False)
    ]


def _is_header(row: Sequence[str]) -> bool:
    return not any(is_number(cell) for cell in row)


def _comment_header(comments: Sequence[str], width: int, separator: str) -> list[str]:
    """The last comment that has as many words as there are columns."""
    for comment in reversed(comments):
        for sign in dict.fromkeys((separator, ",", " ")):
            cells = _split([comment], sign)
            if cells and len(cells[0]) == width and _is_header(cells[0]):
                return cells[0]
    return []


def _name_and_unit(cell: str) -> tuple[str, str]:
    """The name in lower case without its unit, and the unit: of times `s`, `ms`, `us` or `ns`."""
    name, unit = name_and_unit(cell)
    stem, _, suffix = name.rpartition("_")
    if stem in _STAMP_NAMES and suffix in UNIT_OF_WORD:
        return stem, UNIT_OF_WORD[suffix]
    return name, UNIT_OF_WORD.get(unit, unit) if name in _STAMP_NAMES else unit
