"""Trajectory files of any odometry: TUM, KITTI, EuRoC/ASL, csv with names, matrices; told apart by their content.

| a row | time |
|---|---|
| `t x y z qx qy qz qw` and more (TUM, ORB-SLAM, OpenVINS, evo) | unit by its size, or as the header says |
| `t_ns,x,y,z,qw,qx,qy,qz` and more (EuRoC, VINS) | the same |
| 12 or 16 entries of a matrix, also behind a stamp or a frame number (KITTI, KITTI-360) | `times.txt`, else nominal |
| any order, named in a header line or a comment (rostopic echo -p, PlotJuggler, OKVIS) | by name or size |

`trajectory_columns` says which column is which. A file `NAME.cov.csv` beside `NAME.tum` holds covariances and is read
with it. What can be repaired is repaired and reported as findings; what cannot raises TrajectoryError with the line.
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from rigwake._types import Array, Stamps
from rigwake.errors import TrajectoryError
from rigwake.geometry.euler import rotation_from_yaw_pitch_roll
from rigwake.geometry.se3 import SE3
from rigwake.geometry.so3 import nearest_rotation
from rigwake.readers.held_positions import without_held_positions
from rigwake.readers.quaternion_order import steadier_order
from rigwake.readers.stamp_units import NS_PER_UNIT, decimal_or_none, unit_of_cells
from rigwake.readers.trajectory_columns import (
    COLUMNS_REMEDY,
    PoseColumns,
    TrajectoryFormat,
    choose_columns,
)
from rigwake.readers.trajectory_frames import in_house_frames
from rigwake.readers.trajectory_rows import TextRow, TextRows, is_number, read_text_rows
from rigwake.readers.trajectory_sidecar import read_sidecar
from rigwake.recording import Finding
from rigwake.trajectory import Trajectory

_NOMINAL_RATE_HZ = 10  # of files without times


@dataclass(frozen=True, eq=False)
class TrajectoryFile:
    """A trajectory as read, with what was repaired on the way."""

    trajectory: Trajectory
    format: TrajectoryFormat
    findings: tuple[Finding, ...] = ()


def read_trajectory(
    path: Path | str,
    *,
    name: str | None = None,
    file_format: TrajectoryFormat | None = None,
    times: Path | str | None = None,
    columns: str | None = None,
    frame: str = "enu",
) -> TrajectoryFile:
    """Read one trajectory file.

    name: of the body; default the file's stem. file_format: default by content. times: stamps of a file without any,
    one in seconds per line; default `times.txt` beside it. columns: names of the columns, `t x y z qw qx qy qz`, `_`
    for those of no use. frame: what the rows mean, see `trajectory_frames`. Raises TrajectoryError with file and line.
    """
    path = Path(path)
    text = read_text_rows(path)
    if not text.rows:
        raise TrajectoryError(f"{path} holds a header but no poses.", remedy=COLUMNS_REMEDY)
    chosen = choose_columns(text, columns, file_format)
    name = name or path.name.split(".")[0]
    findings: list[Finding] = []
    kept, values, unusable = _pose_values(path, text.rows, chosen)
    stamps, unit_findings = _stamps(text, chosen, kept, times, name)
    if not chosen.named and len(chosen.rotation) == 4 and len(values) > 2:
        chosen, values, order_finding = steadier_order(chosen, values, name)
        findings += order_finding
    findings += [*unit_findings, *_said(unusable, len(kept), stamps, name)]
    transforms, repaired = _transforms(path, [text.rows[i] for i in kept], values, chosen, name)
    findings += repaired
    order, sorted_findings = _order(stamps, name)
    stamps, transforms = stamps[order], transforms[order]
    if len(stamps) < 2:
        most = f" {len(unusable)} of {len(text.rows)} rows, most rows, hold NaN or infinite values or zeros."
        raise TrajectoryError(
            f"{path}: {len(stamps)} usable pose(s); a trajectory needs at least two.{most if unusable else ''}",
            remedy="Check that the recording is complete.",
        )
    is_metric = not any(re.search(r"is_metric:\s*false", comment) for comment in text.comments)
    sidecar, sidecar_findings = read_sidecar(path.with_suffix(".cov.csv"), stamps, name)
    trajectory = in_house_frames(
        Trajectory(
            name, stamps, transforms, sidecar.covariances, sidecar.kind, is_metric, sidecar.segment_ids
        ),
        frame,
    )
    trajectory, held = without_held_positions(trajectory)
    return TrajectoryFile(
        trajectory, chosen.file_format, (*findings, *sorted_findings, *sidecar_findings, *held)
    )


def _pose_values(
    path: Path, rows: Sequence[TextRow], chosen: PoseColumns
) -> tuple[list[int], Array, list[int]]:
    """Rows that hold a pose, their numbers (position, rotation), and the lines of those that do not: NaN, or an
    orientation of zeros, as trackers write before they begin."""
    width = len(rows[0].cells)
    kept: list[int] = []
    values: list[list[float]] = []
    unusable: list[int] = []
    columns, turn = chosen.used, len(chosen.position)
    for at, row in enumerate(rows):
        if len(row.cells) != width:
            expected = (
                "where KITTI has 12" if chosen.file_format == "kitti" else f"where {width} are expected"
            )
            raise TrajectoryError(
                f"{path}, line {row.line}: {len(row.cells)} columns {expected}.",
                remedy="A last line cut short means an unfinished file: remove it if the rest is right.",
            )
        try:
            numbers = [float(row.cells[i]) for i in columns]
            stamped = all(math.isfinite(float(row.cells[i])) for i in chosen.stamp)
        except ValueError as error:
            raise TrajectoryError(f"{path}, line {row.line}: not a number in {row.cells}.") from error
        is_zero = len(chosen.rotation) > 3 and not any(numbers[turn:])
        if stamped and not is_zero and all(map(math.isfinite, numbers)):
            kept.append(at)
            values.append(numbers)
        else:
            unusable.append(row.line)
    return kept, np.array(values).reshape(-1, len(columns)), unusable


def _said(unusable: list[int], good: int, stamps: Stamps, name: str) -> list[Finding]:
    """A finding for rows that were left out, with the longest gap they leave if they are many."""
    if not unusable:
        return []
    listed = ", ".join(map(str, unusable[:5])) + (", ..." if len(unusable) > 5 else "")
    message = (
        f"{len(unusable)} rows with NaN, infinite values or zeros for an orientation left out, lines {listed}"
    )
    if len(unusable) > good and len(stamps) > 1:
        gap_s = float(np.max(np.diff(np.sort(stamps)))) * 1e-9
        message += f": most of the file; the longest gap is {gap_s:.3g} s"
    return [Finding("warning", name, message)]


def _stamps(
    text: TextRows, chosen: PoseColumns, kept: list[int], times: Path | str | None, name: str
) -> tuple[Stamps, list[Finding]]:
    """Stamps of the rows that are kept."""
    if not chosen.stamp or chosen.is_index or times is not None:
        indices = list(range(len(text.rows)))
        if chosen.is_index:
            indices = [int(float(row.cells[chosen.stamp[0]])) for row in text.rows]
        return _listed_stamps(text, indices, kept, times, name)
    cells = [[decimal_or_none(text.rows[at].cells[i]) for at in kept] for i in chosen.stamp]
    if any(value is None for column in cells for value in column):
        raise TrajectoryError(f"{text.path}: a stamp does not fit into 64 bits of nanoseconds.")
    first = [value for value in cells[0] if value is not None]
    if len(chosen.stamp) == 2:
        nano = [value for value in cells[1] if value is not None]
        exact = [round(s * 10**9 + n) for s, n in zip(first, nano, strict=True)]
        return _stamp_array(text.path, exact), []
    findings = []
    unit = chosen.stamp_unit or unit_of_cells(first)
    if chosen.stamp_unit and first and max(map(abs, first)) * NS_PER_UNIT[unit] >= 2**63:
        by_size = unit_of_cells(first)
        message = f"the header says {unit}, but the stamps have the size of {by_size}: read as {by_size}"
        findings.append(Finding("warning", name, message))
        unit = by_size
    return _stamp_array(text.path, [round(value * NS_PER_UNIT[unit]) for value in first]), findings


def _stamp_array(path: Path, stamps: list[int]) -> Stamps:
    if any(abs(stamp) >= 2**63 for stamp in stamps):
        raise TrajectoryError(f"{path}: a stamp does not fit into 64 bits of nanoseconds.")
    return np.array(stamps, dtype=np.int64)


def _listed_stamps(
    text: TextRows, indices: list[int], kept: list[int], times: Path | str | None, name: str
) -> tuple[Stamps, list[Finding]]:
    """Stamps of `times.txt`, by row or by frame number; without one at a nominal rate."""
    path = text.path
    times_path = Path(times) if times is not None else path.with_name("times.txt")
    if times is None and not times_path.is_file():
        message = f"no times.txt beside {path.name}: nominal {_NOMINAL_RATE_HZ} Hz assumed"
        period = 10**9 // _NOMINAL_RATE_HZ
        return _stamp_array(path, [indices[at] * period for at in kept]), [Finding("warning", name, message)]
    cells = [row.cells[0] for row in read_text_rows(times_path).rows]
    by_row = indices == list(range(len(indices)))
    if len(cells) != len(indices) and (by_row or max(indices, default=0) >= len(cells)):
        raise TrajectoryError(f"{times_path} holds {len(cells)} stamps, {path} {len(indices)} poses.")
    if not all(is_number(cell) for cell in cells):
        raise TrajectoryError(f"{times_path}: not a number: {next(c for c in cells if not is_number(c))}.")
    values = [decimal_or_none(cell) for cell in cells]
    unit = unit_of_cells(values)
    chosen = [values[indices[at]] for at in kept]
    if any(value is None for value in chosen):
        raise TrajectoryError(f"{times_path}: a stamp does not fit into 64 bits of nanoseconds.")
    exact = [round(value * NS_PER_UNIT[unit]) for value in chosen if value is not None]
    return _stamp_array(times_path, exact), []


def _transforms(
    path: Path, rows: Sequence[TextRow], values: Array, chosen: PoseColumns, name: str
) -> tuple[SE3, list[Finding]]:
    """Poses of the numbers, and a finding for what was made orthonormal."""
    position, turn = chosen.metres * values[:, :3], values[:, 3:]
    if len(chosen.rotation) == 4:
        findings = _check_quaternions(path, rows, turn, name)
        return SE3.from_quat_wxyz(turn, position), findings
    if len(chosen.rotation) == 3:
        return SE3(_rotation_of_angles(path, turn, chosen.radians), position), []
    matrices = turn.reshape(-1, 3, 3)
    rotations = nearest_rotation(matrices) if len(matrices) else matrices
    deviation = np.abs(rotations - matrices).max(axis=(1, 2), initial=0)
    if deviation.max(initial=0) > 0.1:
        at = int(deviation.argmax())
        mirrored = np.linalg.det(matrices[at]) < 0
        raise TrajectoryError(
            f"{path}, line {rows[at].line}: the 3 x 3 block is not a rotation"
            + (", it is mirrored." if mirrored else "."),
            remedy="One of its frames is left-handed: write it with right-handed axes." if mirrored else "",
        )
    if deviation.max(initial=0) > 1e-3:
        return SE3(rotations, position), [
            Finding("warning", name, "rotations off orthonormal by over 0.1 % projected back")
        ]
    return SE3(rotations, position), []


def _rotation_of_angles(path: Path, angles: Array, radians: float | None) -> Array:
    """`Rz(yaw) Ry(pitch) Rx(roll)`; TrajectoryError where neither name nor size tells the unit."""
    if radians is None:
        if np.abs(angles).max(initial=0) <= 2 * np.pi:
            raise TrajectoryError(
                f"{path}: roll, pitch and yaw could be radians or degrees.",
                remedy="Name the columns roll_deg (or roll_rad) and so on, in the header or with --columns.",
            )
        radians = np.pi / 180
    return np.stack([rotation_from_yaw_pitch_roll(angle) for angle in radians * angles[:, ::-1]])


def _check_quaternions(path: Path, rows: Sequence[TextRow], quat_wxyz: Array, name: str) -> list[Finding]:
    norms = np.linalg.norm(quat_wxyz, axis=1)
    wrong = np.flatnonzero(np.abs(norms - 1) > 0.1)
    if len(wrong):
        line = rows[wrong[0]].line
        raise TrajectoryError(
            f"{path}, near line {line}: a quaternion of norm {norms[wrong[0]]:.3g}, not 1 "
            f"({len(wrong)} such rows).",
            remedy="Check the order of the columns: name them in a header line or with --columns.",
        )
    off = int(np.sum(np.abs(norms - 1) > 1e-3))
    return (
        [Finding("warning", name, f"{off} quaternions off unit norm by over 0.1 % normalised")] if off else []
    )


def _order(stamps: Stamps, name: str) -> tuple[NDArray[np.int64], list[Finding]]:
    """Indices in the order of time, each stamp once, and what that changed."""
    findings = []
    order = np.argsort(stamps, kind="stable")
    backwards = int(np.sum(np.diff(stamps) < 0))
    if backwards:
        findings.append(Finding("warning", name, f"stamps went back {backwards} times: sorted"))
    repeated = np.flatnonzero(np.diff(stamps[order]) == 0) + 1
    if len(repeated):
        many = ": written with too few digits?" if len(repeated) > len(stamps) // 3 else ""
        message = f"{len(repeated)} duplicate stamps: the first of each kept{many}"
        findings.append(Finding("warning", name, message))
    return np.delete(order, repeated), findings
