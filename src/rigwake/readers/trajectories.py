"""Trajectory files: TUM, KITTI, EuRoC/ASL and csv with a header, sniffed from their content.

| format | a row | time |
|---|---|---|
| TUM | `t x y z qx qy qz qw`, spaces or commas | seconds |
| KITTI | the 12 entries of `world_from_body`, row by row | from a times file, else nominal |
| EuRoC | `t_ns, x, y, z, qw, qx, qy, qz, ...` | nanoseconds |
| csv | any order, named in a header line: `timestamp_ns`/`t`, `x y z`, `qw qx qy qz` | by name or size |

A file `NAME.cov.csv` beside `NAME.tum` holds covariances (see `writers.trajectories`) and is read with it.
What can be repaired is repaired and reported as findings; what cannot raises TrajectoryError with the line.
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from decimal import Decimal, InvalidOperation
from pathlib import Path
from typing import Literal

import numpy as np

from rigwake._types import Array, Stamps
from rigwake.errors import InputError, TrajectoryError
from rigwake.geometry.se3 import SE3
from rigwake.geometry.so3 import nearest_rotation
from rigwake.recording import Finding
from rigwake.trajectory import CovarianceKind, Trajectory

TrajectoryFormat = Literal["tum", "kitti", "euroc", "csv"]
_NOMINAL_RATE_HZ = 10  # of KITTI files without times
_NANOSECONDS_FROM = (
    1e14  # a stamp this large cannot be seconds (year 3 million), but 1970-01-02 in nanoseconds
)


@dataclass(frozen=True, eq=False)
class TrajectoryFile:
    """A trajectory as read, with what was repaired on the way."""

    trajectory: Trajectory
    format: TrajectoryFormat
    findings: tuple[Finding, ...] = ()


@dataclass(frozen=True)
class _Row:
    line: int
    cells: tuple[str, ...]


def read_trajectory(
    path: Path | str,
    *,
    name: str | None = None,
    file_format: TrajectoryFormat | None = None,
    times: Path | str | None = None,
) -> TrajectoryFile:
    """Read one trajectory file.

    name: of the body; default the file's stem. file_format: default sniffed. times: stamps of a KITTI file,
    one in seconds per line; default `times.txt` beside it. Raises TrajectoryError naming file and line.
    """
    path = Path(path)
    rows, comments = _rows(path)
    chosen = file_format or _sniff(path, rows, comments)
    name = name or path.name.split(".")[0]
    findings: list[Finding] = []
    if chosen == "kitti":
        stamps, transforms = _read_kitti(path, rows, times, name, findings)
    else:
        stamps, transforms = _read_stamped(path, rows, _columns(path, chosen, rows, comments), name, findings)
    kept = _order(stamps, name, findings)
    stamps, transforms = stamps[kept], transforms[kept]
    if len(stamps) < 2:
        raise TrajectoryError(
            f"{path}: {len(stamps)} usable pose(s); a trajectory needs at least two.",
            remedy="Check that the recording is complete.",
        )
    is_metric = not any(re.search(r"is_metric:\s*false", comment) for comment in comments)
    covariances, kind, segments = _read_sidecar(path.with_suffix(".cov.csv"), stamps, findings, name)
    trajectory = Trajectory(name, stamps, transforms, covariances, kind, is_metric, segments)
    return TrajectoryFile(trajectory, chosen, tuple(findings))


def _rows(path: Path) -> tuple[list[_Row], list[str]]:
    """Rows of cells with their line numbers, and the comment lines."""
    try:
        text = path.read_text(encoding="utf-8-sig")
    except FileNotFoundError as error:
        raise InputError(f"There is no file {path}.") from error
    except (OSError, UnicodeDecodeError) as error:
        raise TrajectoryError(f"{path} is not a readable text file: {error}.") from error
    rows, comments = [], []
    for number, line in enumerate(text.splitlines(), start=1):
        stripped = line.strip()
        if stripped.startswith(("#", "%")):
            comments.append(stripped.lstrip("#% "))
        elif stripped:
            separator = ";" if ";" in stripped else "," if "," in stripped else None
            rows.append(_Row(number, tuple(cell.strip() for cell in stripped.split(separator))))
    if not rows:
        raise TrajectoryError(f"{path} holds no poses.", remedy="Check that the recording is complete.")
    return rows, comments


def _is_number(cell: str) -> bool:
    try:
        float(cell)
    except ValueError:
        return False
    return True


def _sniff(path: Path, rows: Sequence[_Row], comments: Sequence[str]) -> TrajectoryFormat:
    first = rows[0].cells
    if not all(_is_number(cell) for cell in first):
        return "csv"
    if len(first) == 12:
        return "kitti"
    is_ns = "." not in first[0] and math.isfinite(float(first[0])) and float(first[0]) > _NANOSECONDS_FROM
    if len(first) >= 8 and is_ns:
        return "euroc"
    if len(first) == 8:
        return "tum"
    raise TrajectoryError(
        f"{path}, line {rows[0].line}: {len(first)} columns fit no known trajectory format.",
        remedy="TUM has 8 columns, KITTI 12, EuRoC at least 8 with stamps in ns; or give a header line.",
    )


@dataclass(frozen=True)
class _Columns:
    """Where to find what: indices of stamp, x y z and qw qx qy qz, the row's width, the unit of time."""

    stamp: int
    position: tuple[int, int, int]
    quat_wxyz: tuple[int, int, int, int]
    width: int | None
    stamp_unit: Literal["s", "ns"]
    skip_rows: int = 0


def _columns(path: Path, chosen: str, rows: Sequence[_Row], comments: Sequence[str]) -> _Columns:
    if chosen == "tum":
        return _Columns(0, (1, 2, 3), (7, 4, 5, 6), 8, "s")
    if chosen == "euroc":
        return _Columns(0, (1, 2, 3), (4, 5, 6, 7), len(rows[0].cells), "ns")
    return _columns_from_header(path, rows)


_NAMES: dict[str, str] = {
    "stamp": r"(t|time|timestamp|stamp|secs?|seconds|header\.stamp)(_?(s|ns|nsec)|\s*[\[(](s|ns|nsec)[\])])?",
    "x": r"(x|tx|px|p_?x|pos_?x|position_?\.?x|.*position\.x|p_rs_r_x.*)(_m|\s*[\[(]m[\])])?",
    "y": r"(y|ty|py|p_?y|pos_?y|position_?\.?y|.*position\.y|p_rs_r_y.*)(_m|\s*[\[(]m[\])])?",
    "z": r"(z|tz|pz|p_?z|pos_?z|position_?\.?z|.*position\.z|p_rs_r_z.*)(_m|\s*[\[(]m[\])])?",
    "qw": r"(qw|q_?w|quat_?w|.*orientation\.w|orientation_?w|q_rs_w.*)",
    "qx": r"(qx|q_?x|quat_?x|.*orientation\.x|orientation_?x|q_rs_x.*)",
    "qy": r"(qy|q_?y|quat_?y|.*orientation\.y|orientation_?y|q_rs_y.*)",
    "qz": r"(qz|q_?z|quat_?z|.*orientation\.z|orientation_?z|q_rs_z.*)",
}


def _columns_from_header(path: Path, rows: Sequence[_Row]) -> _Columns:
    header = [cell.lower().strip("\"'") for cell in rows[0].cells]
    found: dict[str, int] = {}
    for wanted, pattern in _NAMES.items():
        matches = [i for i, cell in enumerate(header) if re.fullmatch(pattern, cell)]
        if len(matches) != 1:
            raise TrajectoryError(
                f"{path}, line {rows[0].line}: the header names {len(matches)} columns for {wanted}: "
                f"{', '.join(rows[0].cells)}.",
                remedy="Name the columns timestamp_ns (or t), x, y, z, qw, qx, qy, qz.",
            )
        found[wanted] = matches[0]
    if len(rows) < 2:
        raise TrajectoryError(f"{path} holds a header but no poses.")
    named_ns = re.search(r"ns", header[found["stamp"]]) is not None
    first = rows[1].cells[found["stamp"]] if found["stamp"] < len(rows[1].cells) else ""
    large = _is_number(first) and float(first) > _NANOSECONDS_FROM
    return _Columns(
        found["stamp"],
        (found["x"], found["y"], found["z"]),
        (found["qw"], found["qx"], found["qy"], found["qz"]),
        len(header),
        "ns" if named_ns or large else "s",
        skip_rows=1,
    )


def _stamp_ns(cell: str, unit: Literal["s", "ns"]) -> int:
    """Exact nanoseconds; seconds are read as decimals, for a float keeps only 240 ns of a date."""
    value = Decimal(cell)
    return int((value * 10**9 if unit == "s" else value).to_integral_value())


def _read_stamped(
    path: Path, rows: Sequence[_Row], columns: _Columns, name: str, findings: list[Finding]
) -> tuple[Stamps, SE3]:
    indices = (*columns.position, *columns.quat_wxyz)
    stamps: list[int] = []
    values: list[list[float]] = []
    bad_lines: list[int] = []
    for row in rows[columns.skip_rows :]:
        if len(row.cells) != columns.width:
            raise TrajectoryError(
                f"{path}, line {row.line}: {len(row.cells)} columns where {columns.width} are expected.",
                remedy="A last line cut short means an unfinished file: remove it if the rest is right.",
            )
        try:
            numbers = [float(row.cells[i]) for i in indices]
            if all(map(math.isfinite, numbers)) and math.isfinite(float(row.cells[columns.stamp])):
                stamps.append(_stamp_ns(row.cells[columns.stamp], columns.stamp_unit))
                values.append(numbers)
            else:
                bad_lines.append(row.line)
        except (ValueError, InvalidOperation, OverflowError) as error:
            raise TrajectoryError(f"{path}, line {row.line}: not a number in {row.cells}.") from error
    _report_bad_lines(path, bad_lines, len(values), name, findings)
    numbers_array = np.array(values).reshape(-1, 7)
    _check_quaternions(path, rows[columns.skip_rows :], numbers_array[:, 3:], name, findings)
    return _stamp_array(path, stamps), SE3.from_quat_wxyz(numbers_array[:, 3:], numbers_array[:, :3])


def _stamp_array(path: Path, stamps: list[int]) -> Stamps:
    if any(abs(stamp) >= 2**63 for stamp in stamps):
        raise TrajectoryError(f"{path}: a stamp does not fit into 64 bits of nanoseconds.")
    return np.array(stamps, dtype=np.int64)


def _report_bad_lines(
    path: Path, bad_lines: list[int], good: int, name: str, findings: list[Finding]
) -> None:
    if not bad_lines:
        return
    listed = ", ".join(map(str, bad_lines[:5])) + (", ..." if len(bad_lines) > 5 else "")
    if len(bad_lines) > good:
        raise TrajectoryError(
            f"{path}: most rows ({len(bad_lines)} of {len(bad_lines) + good}) hold NaN or infinite values, "
            f"lines {listed}.",
            remedy="The program that wrote them lost track: record or estimate again.",
        )
    findings.append(
        Finding(
            "warning", name, f"{len(bad_lines)} rows with NaN or infinite values left out, lines {listed}"
        )
    )


def _check_quaternions(
    path: Path, rows: Sequence[_Row], quat_wxyz: Array, name: str, findings: list[Finding]
) -> None:
    norms = np.linalg.norm(quat_wxyz, axis=1)
    wrong = np.flatnonzero(np.abs(norms - 1) > 0.1)
    if len(wrong):
        line = rows[wrong[0]].line
        raise TrajectoryError(
            f"{path}, near line {line}: a quaternion of norm {norms[wrong[0]]:.3g}, not 1 "
            f"({len(wrong)} such rows).",
            remedy="Check the order of the columns.",
        )
    off = int(np.sum(np.abs(norms - 1) > 1e-3))
    if off:
        findings.append(Finding("warning", name, f"{off} quaternions off unit norm by over 0.1 % normalised"))


def _read_kitti(
    path: Path, rows: Sequence[_Row], times: Path | str | None, name: str, findings: list[Finding]
) -> tuple[Stamps, SE3]:
    values = np.empty((len(rows), 12))
    for i, row in enumerate(rows):
        if len(row.cells) != 12:
            raise TrajectoryError(f"{path}, line {row.line}: {len(row.cells)} columns where KITTI has 12.")
        try:
            values[i] = [float(cell) for cell in row.cells]
        except ValueError as error:
            raise TrajectoryError(f"{path}, line {row.line}: not a number.") from error
    stamps = _kitti_stamps(path, len(rows), times, name, findings)
    finite = np.isfinite(values).all(axis=1)
    bad_lines = [rows[i].line for i in np.flatnonzero(~finite).tolist()]
    _report_bad_lines(path, bad_lines, int(finite.sum()), name, findings)
    matrices = values[finite].reshape(-1, 3, 4)
    rotations = nearest_rotation(matrices[:, :, :3])
    deviation = np.abs(rotations - matrices[:, :, :3]).max(axis=(1, 2))
    if deviation.max(initial=0) > 0.1:
        line = rows[int(np.flatnonzero(finite)[deviation.argmax()])].line
        raise TrajectoryError(f"{path}, line {line}: the 3 x 3 block is not a rotation.")
    if deviation.max(initial=0) > 1e-3:
        findings.append(Finding("warning", name, "rotations off orthonormal by over 0.1 % projected back"))
    return stamps[finite], SE3(rotations, matrices[:, :, 3])


def _kitti_stamps(
    path: Path, count: int, times: Path | str | None, name: str, findings: list[Finding]
) -> Stamps:
    times_path = Path(times) if times is not None else path.with_name("times.txt")
    if times is None and not times_path.is_file():
        findings.append(
            Finding(
                "warning", name, f"no times.txt beside {path.name}: nominal {_NOMINAL_RATE_HZ} Hz assumed"
            )
        )
        return np.arange(count, dtype=np.int64) * (10**9 // _NOMINAL_RATE_HZ)
    rows, _ = _rows(times_path)
    if len(rows) != count:
        raise TrajectoryError(f"{times_path} holds {len(rows)} stamps, {path} {count} poses.")
    try:
        return _stamp_array(times_path, [_stamp_ns(row.cells[0], "s") for row in rows])
    except (ValueError, InvalidOperation, OverflowError) as error:
        raise TrajectoryError(f"{times_path}: not a number: {error}.") from error


def _order(stamps: Stamps, name: str, findings: list[Finding]) -> Stamps:
    """Indices in the order of time, each stamp once."""
    order = np.argsort(stamps, kind="stable")
    backwards = int(np.sum(np.diff(stamps) < 0))
    if backwards:
        findings.append(Finding("warning", name, f"stamps went back {backwards} times: sorted"))
    repeated = np.flatnonzero(np.diff(stamps[order]) == 0) + 1
    if len(repeated):
        findings.append(Finding("warning", name, f"{len(repeated)} duplicate stamps: the first of each kept"))
    return np.delete(order, repeated)


def _read_sidecar(
    path: Path, stamps: Stamps, findings: list[Finding], name: str
) -> tuple[Array | None, CovarianceKind, Stamps | None]:
    """Covariances and segments of `NAME.cov.csv`, matched by stamp; none if the file is not there."""
    if not path.is_file():
        return None, "increments", None
    rows, comments = _rows(path)
    kind: CovarianceKind = "poses" if any("covariances of poses" in c for c in comments) else "increments"
    width = len(rows[0].cells)
    table: dict[int, list[float]] = {}
    for row in rows:
        try:
            if len(row.cells) != width or width not in (2, 23):
                raise ValueError(f"{len(row.cells)} columns where 2 or 23 are expected")
            table[int(row.cells[0])] = [float(cell) for cell in row.cells[1:]]
        except ValueError as error:
            raise TrajectoryError(f"{path}, line {row.line}: {error}.") from error
    missing = sum(stamp not in table for stamp in stamps.tolist())
    if missing:
        findings.append(Finding("warning", name, f"{path.name} ignored: it lacks {missing} of the stamps"))
        return None, "increments", None
    values = np.array([table[stamp] for stamp in stamps.tolist()])
    segments = values[:, 0].astype(np.int64)
    if width == 2:
        return None, "increments", segments
    upper = np.triu_indices(6)
    covariances = np.zeros((len(stamps), 6, 6))
    covariances[:, upper[0], upper[1]] = covariances[:, upper[1], upper[0]] = values[:, 1:]
    return covariances, kind, segments
