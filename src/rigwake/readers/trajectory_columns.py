"""Which column of a trajectory file holds what: from names, else from the content and the dialect.

Names stand in a header line, in a comment or in `--columns`. Without them a block of a row that is a rotation matrix,
or four columns of unit length, says where the orientation stands; ASL's dialect (commas, nanoseconds) has qw first,
all others qw last.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from rigwake._types import Array
from rigwake.errors import TrajectoryError
from rigwake.readers.column_names import metres_per_unit, quantity_of
from rigwake.readers.stamp_units import unit_of_times
from rigwake.readers.trajectory_rows import TextRows, is_number

TrajectoryFormat = Literal["tum", "kitti", "euroc", "csv", "matrix"]
COLUMNS_REMEDY = (
    "Name the columns timestamp_ns (or t), x, y, z, qw, qx, qy, qz in a header line or with --columns."
)
_SAMPLE_ROWS = 200
_AXES = ("x", "y", "z")
_QUATERNION = ("qw", "qx", "qy", "qz")
_ANGLES = ("roll", "pitch", "yaw")
_MATRIX = tuple(f"r{row}{column}" for row in range(3) for column in range(3))
_MATRIX_FROM_1 = tuple(f"r{row}{column}" for row in range(1, 4) for column in range(1, 4))
_SECONDS_OF_TODAY = (6.3e8, 4.2e9)


@dataclass(frozen=True)
class PoseColumns:
    """Indices of the columns.

    stamp: one column, seconds and nanoseconds, or none. stamp_unit: empty if its size tells. is_index: the stamp
    counts frames. position: x y z, of `metres` each. rotation: 4 (qw qx qy qz), 9 (a matrix, row by row) or 3 (roll,
    pitch, yaw in `radians` each). named: whether names said so.
    """

    stamp: tuple[int, ...]
    position: tuple[int, ...]
    rotation: tuple[int, ...]
    file_format: TrajectoryFormat
    stamp_unit: str = ""
    is_index: bool = False
    metres: float = 1.0
    radians: float | None = 1.0
    named: bool = False

    @property
    def used(self) -> tuple[int, ...]:
        """All columns that hold the pose."""
        return (*self.position, *self.rotation)


def choose_columns(text: TextRows, columns: str | None, file_format: TrajectoryFormat | None) -> PoseColumns:
    """The columns of a file. columns: names given by the user, `_` for those of no use.

    Raises TrajectoryError, naming file and line, if nothing says which column is which.
    """
    if columns is not None:
        names = columns.replace(",", " ").split()
        return named_columns(names, f"--columns {columns}", text, file_format or "csv", strict=True)
    if file_format == "kitti":
        return _matrix_columns(text)
    if text.header:
        where = f"{text.path}, line {text.header_line}: the header"
        return named_columns(text.header, where, text, "csv", strict=True)
    for cells in reversed(text.comment_cells):
        try:
            return named_columns(cells, "", text, file_format or "tum", strict=False)
        except TrajectoryError:
            continue
    return _columns_by_content(text, file_format)


def named_columns(
    names: Sequence[str], where: str, text: TextRows, file_format: TrajectoryFormat, *, strict: bool
) -> PoseColumns:
    """Columns by their names. strict: the names are meant for this; else a comment may hold prose as well.

    Raises TrajectoryError, beginning with `where`, if a quantity is named never or twice.
    """
    quantities = [quantity_of(name) for name in names]
    stamp, unit = _named_stamp(names, quantities)
    if not stamp and (strict or len(text.rows[0].cells) != len(names) + 1):
        raise _named_wrong(where, "stamp", 0, names)
    # a comment may say `world_from_body: t x y z ...`, or leave the time out
    shift = 0 if strict or len(names) == len(text.rows[0].cells) else 1 if not stamp else -min(stamp)
    stamp = stamp or (-1,)
    position = _named(_AXES, quantities, names, where)
    radians: float | None = 1.0
    if any(q in quantities for q in _QUATERNION):
        rotation = _named(_QUATERNION, quantities, names, where)
    elif all(q in quantities for q in _MATRIX) or all(q in quantities for q in _MATRIX_FROM_1):
        rotation = _named(_MATRIX if "r00" in quantities else _MATRIX_FROM_1, quantities, names, where)
        position = position or _named(("r03", "r13", "r23"), quantities, names, where)
    elif all(any(q.startswith(angle) for q in quantities) for angle in _ANGLES):
        rotation = tuple(
            next(i for i, q in enumerate(quantities) if q.startswith(angle)) for angle in _ANGLES
        )
        units = {quantities[i].partition("_")[2] for i in rotation}
        radians = np.pi / 180 if units == {"deg"} else 1.0 if units == {"rad"} else None
    else:
        raise _named_wrong(where, "qw", 0, names)
    metres = metres_per_unit(names[position[0]])
    width = len(text.rows[0].cells) if text.rows else len(names)
    chosen = PoseColumns(
        tuple(i + shift for i in stamp),
        tuple(i + shift for i in position),
        tuple(i + shift for i in rotation),
        file_format,
        unit,
        metres=metres,
        radians=radians,
        named=True,
    )
    if max(*chosen.used, *chosen.stamp) >= width or min(*chosen.used, *chosen.stamp) < 0:
        raise TrajectoryError(
            f"{where} names {len(names)} columns, the rows have {width}.", remedy=COLUMNS_REMEDY
        )
    if not strict and text.separator == "," and _stamp_is_ns(text, chosen.stamp[0]):
        return PoseColumns(**{**chosen.__dict__, "file_format": "euroc"})
    return chosen


def _stamp_is_ns(text: TextRows, column: int) -> bool:
    return unit_of_times(_numbers(text)[:, column]) == "ns"


def _named_stamp(names: Sequence[str], quantities: Sequence[str]) -> tuple[tuple[int, ...], str]:
    """The columns of the stamp and its unit; the stamp of a message goes before the time of its arrival."""
    times = [i for i, q in enumerate(quantities) if q == "t" or q.startswith("t_") or q == "sec"]
    nano = [i for i, q in enumerate(quantities) if q in ("nsec", "t_ns")]
    if not times:
        return (), ""
    best = next((i for i in times if "header" in names[i].lower() or "stamp" in names[i].lower()), times[0])
    quantity = quantities[best]
    if quantity in ("sec", "t", "t_s") and nano and nano[0] != best:
        both = "sec" in names[best].lower() and "sec" in names[nano[0]].lower()
        if both:
            return (best, nano[0]), "s"
    return (best,), "" if quantity in ("t", "sec") else quantity[2:]


def _named(
    wanted: Sequence[str], quantities: Sequence[str], names: Sequence[str], where: str
) -> tuple[int, ...]:
    found = []
    for quantity in wanted:
        matches = [i for i, q in enumerate(quantities) if q == quantity]
        if len(matches) != 1:
            if quantity in _AXES and "r03" in quantities:
                return ()
            raise _named_wrong(where, quantity, len(matches), names)
        found.append(matches[0])
    return tuple(found)


def _named_wrong(where: str, quantity: str, count: int, names: Sequence[str]) -> TrajectoryError:
    listed = ", ".join(names)
    return TrajectoryError(
        f"{where} names {count} columns for {quantity}: {listed:.300}.", remedy=COLUMNS_REMEDY
    )


def _numbers(text: TextRows) -> Array:
    """(n, width) of a sample of rows of the first row's width, spread over the file; NaN for what is no number."""
    width = len(text.rows[0].cells)
    step = max(1, len(text.rows) // _SAMPLE_ROWS)
    rows = [row.cells for row in text.rows[::step] if len(row.cells) == width]
    return np.array([[float(c) if is_number(c) else np.nan for c in row] for row in rows]).reshape(-1, width)


def _matrix_columns(text: TextRows) -> PoseColumns:
    matrix = np.arange(12).reshape(3, 4)
    if text.rows and len(text.rows[0].cells) != 12:
        raise TrajectoryError(
            f"{text.path}, line {text.rows[0].line}: {len(text.rows[0].cells)} columns where KITTI has 12."
        )
    return PoseColumns((), tuple(matrix[:, 3]), tuple(matrix[:, :3].ravel()), "kitti")


def _blocks(width: int) -> list[tuple[int, NDArray[np.int64], NDArray[np.int64]]]:
    """Where a matrix may stand: leading columns, indices of R (9) and of t (3)."""
    found = []
    interleaved = np.arange(12).reshape(3, 4)
    for lead, last in ((0, width in (12, 16)), (1, width in (13, 17)), (2, width in (14, 18))):
        if last:
            found.append((lead, lead + interleaved[:, :3].ravel(), lead + interleaved[:, 3]))
            found.append((lead, lead + np.arange(9), lead + np.arange(9, 12)))
            found.append((lead, lead + np.arange(3, 12), lead + np.arange(3)))
    return found


def _is_rotation(values: Array) -> bool:
    """Whether most rows (n, 9) that are not all zero are rotation matrices."""
    used = values[np.isfinite(values).all(axis=1) & (np.abs(values) > 0).any(axis=1)].reshape(-1, 3, 3)
    if not len(used) or np.abs(used).max() > 1.5:
        return False
    error = np.abs(used @ np.swapaxes(used, 1, 2) - np.eye(3)).max(axis=(1, 2))
    return bool(np.median(error) < 0.05)


def _is_unit(values: Array) -> bool:
    """Whether most rows (n, 4) that are not all zero have length 1."""
    used = values[np.isfinite(values).all(axis=1) & (np.abs(values) > 0).any(axis=1)]
    lengths = np.linalg.norm(used, axis=1) if len(used) else np.zeros(1)
    return bool(np.mean(np.abs(lengths - 1) < 0.05) >= 0.6)


def _columns_by_content(text: TextRows, file_format: TrajectoryFormat | None) -> PoseColumns:
    numbers = _numbers(text)
    width = numbers.shape[1]
    for lead, rotation, position in _blocks(width):
        bottom = numbers[:, lead + 12 : lead + 16]
        ends_right = width in (12, 13, 14) or np.allclose(
            bottom[np.isfinite(bottom).all(axis=1)], [0, 0, 0, 1]
        )
        if ends_right and _is_rotation(numbers[:, rotation]):
            stamp, is_index = _leading_stamp(numbers, lead)
            name: TrajectoryFormat = "kitti" if lead == 0 else "matrix"
            return PoseColumns(stamp, tuple(position), tuple(rotation), name, is_index=is_index)
    if width == 12:
        return _matrix_columns(text)  # its reader says which line is wrong
    first_quaternion = next((k for k in _quaternion_places(width) if _is_unit(numbers[:, k : k + 4])), None)
    if first_quaternion is None and width < 8:
        raise TrajectoryError(
            f"{text.path}, line {text.rows[0].line}: {width} columns fit no known trajectory format.",
            remedy="TUM has 8 columns, KITTI 12, EuRoC at least 8 with stamps in ns; or " + COLUMNS_REMEDY,
        )
    k = 4 if first_quaternion is None else first_quaternion
    stamp, is_index = _leading_stamp(numbers, k - 3)
    is_ns = bool(stamp) and len(stamp) == 1 and unit_of_times(numbers[:, stamp[0]]) == "ns"
    asl = file_format == "euroc" or (file_format is None and is_ns and text.separator == ",")
    order = (k, k + 1, k + 2, k + 3) if asl else (k + 3, k, k + 1, k + 2)
    return PoseColumns(stamp, (k - 3, k - 2, k - 1), order, "euroc" if asl else "tum", is_index=is_index)


def _quaternion_places(width: int) -> Sequence[int]:
    return (4, 5, 6, 7) if width > 7 else (3,) if width == 7 else ()


def _leading_stamp(numbers: Array, count: int) -> tuple[tuple[int, ...], bool]:
    """The column, or seconds and nanoseconds, among the first `count`; whether it counts frames."""
    lead = [i for i in range(count) if np.isfinite(numbers[:, i]).mean() > 0.5]
    if not lead:
        return ((0,) if count else ()), False
    for first, second in itertools.pairwise(lead):
        seconds, nano = np.nanmedian(numbers[:, first]), numbers[:, second]
        whole = bool(np.all(nano[np.isfinite(nano)] % 1 == 0)) and bool(np.nanmax(nano) < 1e9)
        if _SECONDS_OF_TODAY[0] < seconds < _SECONDS_OF_TODAY[1] and whole and np.nanmax(nano) > 1e6:
            return (first, second), False
    best = next((i for i in lead if not _counts_rows(numbers[:, i])), lead[-1])
    return (best,), _counts_rows(numbers[:, best]) and len(lead) == 1 and count == 1 and numbers.shape[
        1
    ] == 13


def _counts_rows(values: Array) -> bool:
    """Whether these are small whole numbers that rise by a few each: frame numbers."""
    finite = values[np.isfinite(values)]
    if len(finite) < 2 or np.any(finite % 1 != 0) or finite.max() > 1e7:
        return False
    return bool(np.all(np.diff(finite) >= 1))
