"""What an intrinsic calibration starts from: board corners seen in images."""

from __future__ import annotations

import csv
import gzip
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from rigwake._types import Array
from rigwake.errors import InputError, UsageError

MIN_CORNERS = 8  # a homography has 8 degrees of freedom: 4 corners would fit anything
_CSV_COLUMNS = ("timestamp_ns", "tag_id", "corner_idx", "u_px", "v_px", "x_m", "y_m", "z_m")
_MAX_CSV_ROWS = 5_000_000


@dataclass(frozen=True, eq=False)
class BoardView:
    """Corners of one image: points_board (N, 3) metres in the board's frame, pixels (N, 2)."""

    name: str
    points_board: Array
    pixels: Array

    def __len__(self) -> int:
        return len(self.pixels)


@dataclass(frozen=True, eq=False)
class BoardObservations:
    """All views of one camera. unused: names of images without enough corners, with the reason."""

    width_px: int
    height_px: int
    views: tuple[BoardView, ...]
    unused: tuple[tuple[str, str], ...] = ()

    def take(self, indices: np.ndarray | list[int]) -> BoardObservations:
        """The chosen views."""
        views = tuple(self.views[int(i)] for i in indices)
        return BoardObservations(self.width_px, self.height_px, views, self.unused)


def read_corner_file(path: Path | str, width_px: int, height_px: int) -> BoardObservations:
    """Corners that another detector found, one view per timestamp.

    The csv file (`.csv` or `.csv.gz`) has the columns
    `timestamp_ns, tag_id, corner_idx, u_px, v_px, x_m, y_m, z_m`; other columns are ignored. Raises
    InputError if columns are missing or a row is broken, UsageError if corners lie outside the image size.
    """
    file = Path(path)
    groups: dict[int, list[list[float]]] = {}
    try:
        for number, row in enumerate(_csv_rows(file)):
            if number >= _MAX_CSV_ROWS:
                raise InputError(f"{file} has more than {_MAX_CSV_ROWS} rows.", remedy="Thin it out.")
            values = [float(row[name]) for name in _CSV_COLUMNS[3:]]
            groups.setdefault(int(row["timestamp_ns"]), []).append(values)
    except (OSError, EOFError, UnicodeDecodeError, ValueError, KeyError, TypeError, csv.Error) as error:
        raise InputError(
            f"{file} cannot be read as a corner file: {error!r}.",
            remedy=f"It needs the columns {', '.join(_CSV_COLUMNS)}.",
        ) from error
    stacked = {stamp: np.array(rows) for stamp, rows in sorted(groups.items())}
    named = [BoardView(str(stamp), rows[:, 2:], rows[:, :2]) for stamp, rows in stacked.items()]
    pixels = np.concatenate([view.pixels for view in named]) if named else np.zeros((0, 2))
    if not np.isfinite(pixels).all() or not all(np.isfinite(view.points_board).all() for view in named):
        raise InputError(f"{file} holds corners that are not finite numbers.")
    if len(pixels) and (pixels.max(axis=0) > [width_px, height_px]).any():
        raise UsageError(
            f"{file.name} has corners up to pixel ({pixels[:, 0].max():.0f}, {pixels[:, 1].max():.0f}), "
            f"outside an image of {width_px} x {height_px}.",
            remedy="Give the true image size, `--image-size WIDTHxHEIGHT`.",
        )
    return gathered(width_px, height_px, named, ())


def gathered(
    width_px: int, height_px: int, views: list[BoardView], unused: tuple[tuple[str, str], ...]
) -> BoardObservations:
    """Observations of the views that have enough corners; the others are named."""
    poor = tuple(
        (v.name, f"{len(v)} corners, {MIN_CORNERS} are needed") for v in views if len(v) < MIN_CORNERS
    )
    kept = tuple(view for view in views if len(view) >= MIN_CORNERS)
    return BoardObservations(width_px, height_px, kept, unused + poor)


def _csv_rows(path: Path) -> Iterator[dict[str, str]]:
    opener = gzip.open if path.suffix == ".gz" else open
    with opener(path, "rt", encoding="utf-8", newline="") as stream:
        reader = csv.DictReader(stream)
        missing = set(_CSV_COLUMNS) - set(reader.fieldnames or ())
        if missing:
            raise InputError(f"{path} lacks the columns {', '.join(sorted(missing))}.")
        yield from reader
