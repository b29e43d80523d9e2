"""Tables of all recordings: CSV, Parquet, and the page."""

from __future__ import annotations

import csv
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rigwake.atomic import atomic_path, write_text_atomic
from rigwake.fleet.fleet_jobs import FleetJob, FleetOutcome
from rigwake.fleet.fleet_page import render_page
from rigwake.fleet.resume import read_outcome

_BATCH = 4096  # rows held in memory
_TEXTS = (
    "recording",
    "vessel",
    "status",
    "cause",
    "message",
    "notes",
    "reference",
    "camera",
    "state",
    "words",
    "key",
)
_FIGURES = (
    "duration_s",
    "seconds",
    "qw",
    "qx",
    "qy",
    "qz",
    "x_m",
    "y_m",
    "z_m",
    "std_rx_deg",
    "std_ry_deg",
    "std_rz_deg",
    "std_x_m",
    "std_y_m",
    "std_z_m",
    "time_offset_s",
    "size_deg",
    "size_std_deg",
)
_COUNTS = ("started_ns", "attempts")
COLUMNS = (*_TEXTS, *_COUNTS, *_FIGURES)


@dataclass(frozen=True)
class Tables:
    """Files that were written; parquet: None where pyarrow is missing."""

    page: Path
    csv: Path
    parquet: Path | None


def outcomes_of(jobs: Iterable[FleetJob], loose: Mapping[str, FleetOutcome]) -> Iterator[FleetOutcome]:
    """What is known of every job, in its order: what this run has not kept, else what lies beside the results.

    A job that was never done has no outcome.
    """
    for job in jobs:
        outcome = loose.get(job.name) or read_outcome(job.result_folder)
        if outcome is not None and outcome.recording == job.recording and outcome.choices == job.choices:
            yield outcome


def table_rows(outcome: FleetOutcome) -> list[dict[str, Any]]:
    """One row per camera; a recording without cameras has one."""
    shared = {
        "recording": outcome.recording,
        "vessel": outcome.vessel,
        "status": outcome.status,
        "cause": outcome.cause,
        "message": outcome.message,
        "notes": " ".join(outcome.notes),
        "reference": outcome.reference,
        "key": outcome.key,
        "started_ns": outcome.started_ns,
        "attempts": outcome.attempts,
        "duration_s": outcome.duration_s,
        "seconds": outcome.seconds,
    }
    rows = []
    for name, camera in outcome.cameras.items():
        row = {
            **shared,
            "camera": name,
            **{k: camera.get(k) for k in ("state", "words", "size_deg", "size_std_deg")},
        }
        row["time_offset_s"] = camera.get("time_offset_s")
        for columns, key in (
            (("qw", "qx", "qy", "qz"), "quat_wxyz"),
            (("x_m", "y_m", "z_m"), "translation_m"),
            (("std_rx_deg", "std_ry_deg", "std_rz_deg"), "std_rotation_deg"),
            (("std_x_m", "std_y_m", "std_z_m"), "std_translation_m"),
        ):
            row.update(zip(columns, camera.get(key) or [None] * len(columns), strict=True))
        rows.append(row)
    return rows or [shared]


def write_tables(
    out: Path,
    jobs: Sequence[FleetJob],
    loose: Mapping[str, FleetOutcome],
    shard: tuple[int, int] | None = None,
) -> Tables:
    """Write `fleet.html`, `fleet.csv`, `fleet.parquet` (with the shard in the name) of all outcomes. Raises OSError."""
    stem = "fleet" if shard is None else f"fleet-{shard[0]}-of-{shard[1]}"
    _write_csv(out / f"{stem}.csv", outcomes_of(jobs, loose))
    parquet = _write_parquet(out / f"{stem}.parquet", outcomes_of(jobs, loose))
    page = out / f"{stem}.html"
    write_text_atomic(page, render_page(outcomes_of(jobs, loose), len(jobs), f"{stem}.csv"))
    return Tables(page, out / f"{stem}.csv", parquet)


def _write_csv(path: Path, outcomes: Iterable[FleetOutcome]) -> None:
    with (
        atomic_path(path) as temporary,
        temporary.open("w", encoding="utf-8", errors="backslashreplace", newline="") as file,
    ):
        writer = csv.DictWriter(file, COLUMNS)
        writer.writeheader()
        for outcome in outcomes:
            writer.writerows({key: _cell(value) for key, value in row.items()} for row in table_rows(outcome))


def _cell(value: Any) -> Any:
    """Text that a spreadsheet would take for a formula is marked as text."""
    return f"'{value}" if isinstance(value, str) and value[:1] in ("=", "+", "-", "@", "\t", "\r") else value


def _write_parquet(path: Path, outcomes: Iterable[FleetOutcome]) -> Path | None:
    try:
        import pyarrow as pa
        import pyarrow.parquet as pq
    except ImportError:
        return None
    types = {**dict.fromkeys(_TEXTS, pa.string()), **dict.fromkeys(_COUNTS, pa.int64())}
    schema = pa.schema([(name, types.get(name, pa.float64())) for name in COLUMNS])
    with atomic_path(path) as temporary, pq.ParquetWriter(temporary, schema) as writer:
        for rows in _batches(row for outcome in outcomes for row in table_rows(outcome)):
            full = [{name: _text(row.get(name)) for name in COLUMNS} for row in rows]
            writer.write_table(pa.Table.from_pylist(full, schema=schema))
    return path


def _text(value: Any) -> Any:
    return value.encode("utf-8", "backslashreplace").decode() if isinstance(value, str) else value


def _batches(rows: Iterable[dict[str, Any]]) -> Iterator[list[dict[str, Any]]]:
    batch: list[dict[str, Any]] = []
    for row in rows:
        batch.append(row)
        if len(batch) >= _BATCH:
            yield batch
            batch = []
    if batch:
        yield batch
