"""Csv tables with a header line: columns by any of their usual names, stamps exact to the nanosecond."""

from __future__ import annotations

import csv
import re
from collections.abc import Sequence
from dataclasses import dataclass
from decimal import Decimal, InvalidOperation
from pathlib import Path

import numpy as np

from rigwake._types import Array, Stamps
from rigwake.errors import InputError

_NS_PER_UNIT = {"ns": 1, "us": 10**3, "ms": 10**6, "s": 10**9}
_STAMP_NAMES = ("timestamp", "time", "stamp", "t")
_MAX_TABLE_BYTES = 2**30
_LARGEST_NS = Decimal(2**62)


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

    def stamps_ns(self) -> Stamps:
        """The time column in integer nanoseconds; its unit from the header, else from its size.

        Unreadable stamps are -1. Raises InputError if there is no time column.
        """
        name = self.find(*_STAMP_NAMES)
        if name is None:
            raise InputError(
                f"{self.path} lacks a time column.", remedy="Name it timestamp_ns or timestamp_s."
            )
        return stamps_from_text(self.columns[name], self.units[name])


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


def stamps_from_text(cells: Sequence[str], unit: str = "") -> Stamps:
    """Integer nanoseconds of times in text; unreadable or absurd ones are -1.

    Without a unit the size of the first readable one tells: seconds, ms, us or ns since 1970 differ by
    factors of 1000.
    """
    values = [_decimal(cell) for cell in cells]
    if not unit:
        first = next((value for value in values if value is not None), Decimal(0))
        unit = "ns" if first >= 10**17 else "us" if first >= 10**14 else "ms" if first >= 10**11 else "s"
    factor = _NS_PER_UNIT[unit]
    stamps = (None if value is None else value * factor for value in values)
    exact = [-1 if ns is None or not 0 <= ns < _LARGEST_NS else int(ns) for ns in stamps]
    return np.array(exact, dtype=np.int64)


def _decimal(cell: str) -> Decimal | None:
    try:
        value = Decimal(cell.strip())
    except InvalidOperation:
        return None
    return value if value.is_finite() and abs(value.adjusted()) < 30 else None


def read_table(path: Path) -> Table:
    """Read a csv file with a header line, which may begin with `#`. InputError if it is not one."""
    try:
        if path.stat().st_size > _MAX_TABLE_BYTES:
            raise InputError(f"{path} is larger than {_MAX_TABLE_BYTES} bytes.")
        with path.open(encoding="utf-8-sig", newline="") as file:
            rows = [row for row in csv.reader(file, skipinitialspace=True) if row]
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise InputError(f"{path} cannot be read as csv ({error}).") from error
    if not rows:
        raise InputError(f"{path} is empty.")
    names, units = zip(*(_name_and_unit(cell) for cell in rows[0]), strict=True)
    body = [row for row in rows[1:] if len(row) == len(names)]
    columns = (
        dict(zip(names, map(list, zip(*body, strict=True)), strict=True)) if body else {n: [] for n in names}
    )
    return Table(path, columns, dict(zip(names, units, strict=True)), len(rows) - 1 - len(body))


def _name_and_unit(cell: str) -> tuple[str, str]:
    text = cell.strip().lstrip("#").strip().lower()
    bracketed = re.fullmatch(r"(.*?)\s*[\[(]\s*(.*?)\s*[\])]", text)
    name, unit = (bracketed[1], bracketed[2]) if bracketed else (text, "")
    stem, _, suffix = name.rpartition("_")
    if stem in _STAMP_NAMES and suffix in _NS_PER_UNIT:
        return stem, suffix
    return name, unit if unit in _NS_PER_UNIT else ""
