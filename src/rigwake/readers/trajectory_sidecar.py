"""`NAME.cov.csv` beside `NAME.tum`: covariances and segments, as `writers.trajectories` writes them."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from rigwake._types import Array, Stamps
from rigwake.errors import TrajectoryError
from rigwake.readers.trajectory_rows import read_text_rows
from rigwake.recording import Finding
from rigwake.trajectory import CovarianceKind

_NEGATIVE = -1e-9  # an eigenvalue this far below zero, in units of the largest, is rounding


@dataclass(frozen=True, eq=False)
class Sidecar:
    """Covariances (N, 6, 6), what they are of, and segments (N,); None where the file has none."""

    covariances: Array | None = None
    kind: CovarianceKind = "increments"
    segment_ids: NDArray[np.int64] | None = None


def read_sidecar(path: Path, stamps: Stamps, name: str) -> tuple[Sidecar, list[Finding]]:
    """The rows of these stamps; nothing if there is no file or it lacks stamps (said in a finding).

    Raises TrajectoryError, naming file and line, for what is no covariance: NaN, negative, not symmetric positive.
    """
    if not path.is_file():
        return Sidecar(), []
    text = read_text_rows(path)
    kind: CovarianceKind = (
        "poses" if any("covariances of poses" in c for c in text.comments) else "increments"
    )
    width = len(text.rows[0].cells) if text.rows else 0
    table: dict[int, tuple[int, list[float], int]] = {}
    for row in text.rows:
        try:
            if len(row.cells) != width or width not in (2, 23):
                raise ValueError(f"{len(row.cells)} columns where 2 or 23 are expected")
            segment = int(float(row.cells[1]))
            if not 0 <= segment < 2**31:
                raise ValueError(f"{row.cells[1]} is no segment")
            table[int(row.cells[0])] = segment, [float(cell) for cell in row.cells[2:]], row.line
        except (ValueError, OverflowError) as error:
            raise TrajectoryError(f"{path}, line {row.line}: {error}.") from error
    missing = sum(stamp not in table for stamp in stamps.tolist())
    if missing or not table:
        return Sidecar(), [Finding("warning", name, f"{path.name} ignored: it lacks {missing} of the stamps")]
    rows = [table[stamp] for stamp in stamps.tolist()]
    segments = np.array([segment for segment, _, _ in rows], dtype=np.int64)
    if np.any(np.diff(segments) < 0):
        raise TrajectoryError(f"{path}: segments go back.", remedy="Remove the file, or write it again.")
    if width == 2:
        return Sidecar(segment_ids=segments), []
    upper = np.triu_indices(6)
    covariances = np.zeros((len(stamps), 6, 6))
    values = np.array([values for _, values, _ in rows])
    covariances[:, upper[0], upper[1]] = covariances[:, upper[1], upper[0]] = values
    _check(path, covariances, [line for _, _, line in rows])
    return Sidecar(covariances, kind, segments), []


def _check(path: Path, covariances: Array, lines: list[int]) -> None:
    with np.errstate(invalid="ignore", over="ignore"):
        finite = np.all(np.abs(covariances) < 1e100, axis=(1, 2))
    eigenvalues = np.linalg.eigvalsh(np.where(np.asarray(finite)[:, None, None], covariances, 0.0))
    negative: NDArray[np.bool_] = eigenvalues[:, 0] < _NEGATIVE * np.maximum(eigenvalues[:, -1], 1e-300)
    bad = np.flatnonzero(~finite | negative)
    if len(bad):
        raise TrajectoryError(
            f"{path}, line {lines[bad[0]]}: no covariance: it holds NaN, infinite or negative variances "
            f"({len(bad)} such rows).",
            remedy="Remove the file: then the noise is estimated.",
        )
