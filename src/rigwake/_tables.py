"""Frozen dataclasses as tables: every field an array with one row per entry, or a table of its own."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import fields, is_dataclass, replace
from typing import Any, TypeVar

import numpy as np

Table = TypeVar("Table")


def take_rows(table: Table, index: Any, *, keep: Collection[str] = ()) -> Table:
    """The table with the chosen rows (indices, mask or slice); fields named in `keep` are no rows and stay."""
    chosen = {name: _taken(value, index) for name, value in _columns(table, keep)}
    return replace(table, **chosen)  # type: ignore[type-var]


def join_rows(tables: Sequence[Table], *, keep: Collection[str] = ()) -> Table:
    """The rows of all tables, one after the other; fields named in `keep` are those of the first table."""
    if not tables:
        raise ValueError("There are no tables to join.")
    first = tables[0]
    joined = {
        name: join_rows([getattr(table, name) for table in tables])
        if is_dataclass(value)
        else np.concatenate([getattr(table, name) for table in tables])
        for name, value in _columns(first, keep)
    }
    return replace(first, **joined)  # type: ignore[type-var]


def _columns(table: Any, keep: Collection[str]) -> list[tuple[str, Any]]:
    return [(f.name, getattr(table, f.name)) for f in fields(table) if f.name not in keep]


def _taken(value: Any, index: Any) -> Any:
    return take_rows(value, index) if is_dataclass(value) else value[index]
