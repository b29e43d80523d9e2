"""Calibration boards: their corners in metres, and their names on the command line."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np

from rigwake._types import Array
from rigwake.errors import UsageError

BoardKind = Literal["chessboard", "aprilgrid", "charuco"]

_FORMS = {
    "chessboard": "chessboard:COLUMNSxROWS:SQUARE_M with the count of inner corners, as chessboard:9x6:0.03",
    "aprilgrid": "aprilgrid:COLUMNSxROWS:TAG_M:SPACING with the gap as a fraction of a tag, "
    "as aprilgrid:6x6:0.088:0.3",
    "charuco": "charuco:COLUMNSxROWS:SQUARE_M:MARKER_M[:DICTIONARY] with the count of squares, "
    "as charuco:11x8:0.03:0.022:5X5_1000",
}
_MAX_SIDE = 200


@dataclass(frozen=True)
class Board:
    """A flat board with columns x rows of inner corners (chessboard), tags (aprilgrid) or squares (charuco).

    size_m: side of a square or tag. spacing: gap between tags, as a fraction of a tag (aprilgrid).
    marker_m, dictionary: side of the markers and OpenCV's name of their dictionary (charuco).
    """

    kind: BoardKind
    columns: int
    rows: int
    size_m: float
    spacing: float = 0.0
    marker_m: float = 0.0
    dictionary: str = "5X5_1000"

    @property
    def corner_points(self) -> Array:
        """(M, 3) corners in metres, z = 0, in the order of the corner ids.

        Chessboard and charuco: row by row. Aprilgrid: corner `4 tag + k`, tags counted from the bottom left,
        row by row upwards, corners counter-clockwise from the bottom left; y points up.
        """
        if self.kind == "charuco":
            return np.asarray(self.charuco().getChessboardCorners(), dtype=np.float64)
        grid = np.stack(np.meshgrid(np.arange(self.columns), np.arange(self.rows)), axis=-1).reshape(-1, 2)
        if self.kind == "aprilgrid":
            corners = np.array([[0, 0], [1, 0], [1, 1], [0, 1]])
            flat = (grid[:, None] * (1 + self.spacing) + corners).reshape(-1, 2) * self.size_m
        else:
            flat = grid * self.size_m
        return np.column_stack([flat, np.zeros(len(flat))])

    def charuco(self) -> cv2.aruco.CharucoBoard:
        """OpenCV's board of a charuco."""
        number = getattr(cv2.aruco, f"DICT_{self.dictionary}")
        dictionary = cv2.aruco.getPredefinedDictionary(number)
        return cv2.aruco.CharucoBoard((self.columns, self.rows), self.size_m, self.marker_m, dictionary)

    @property
    def words(self) -> str:
        """The board as a person would say it."""
        what = {"chessboard": "inner corners", "aprilgrid": "tags", "charuco": "squares"}[self.kind]
        return f"{self.kind} of {self.columns} x {self.rows} {what}"


def parse_board(text: str) -> Board:
    """The board of a command-line word such as `aprilgrid:6x6:0.088:0.3`; UsageError shows the right form."""
    kind, *fields = text.split(":")
    forms = [_FORMS[kind]] if kind in _FORMS else list(_FORMS.values())
    wrong = UsageError(f"{text!r} is not a board.", remedy=f"Write {'; or '.join(forms)}.")
    counts = {"chessboard": (2,), "aprilgrid": (3,), "charuco": (3, 4)}
    if kind not in counts or len(fields) not in counts[kind]:
        raise wrong
    try:
        columns, rows = (int(word) for word in fields[0].lower().split("x"))
        lengths = [float(word) for word in fields[1:3]]
    except ValueError:
        raise wrong from None
    least = 3 if kind == "chessboard" else 1
    if not (least <= columns <= _MAX_SIDE and least <= rows <= _MAX_SIDE) or not all(
        np.isfinite(length) and length > 0 for length in lengths
    ):
        raise wrong
    if kind == "chessboard":
        return Board("chessboard", columns, rows, lengths[0])
    if kind == "aprilgrid":
        return Board("aprilgrid", columns, rows, lengths[0], spacing=lengths[1])
    dictionary = fields[3].upper().removeprefix("DICT_") if len(fields) == 4 else "5X5_1000"
    if not hasattr(cv2.aruco, f"DICT_{dictionary}") or lengths[1] >= lengths[0]:
        raise wrong
    return Board("charuco", columns, rows, lengths[0], marker_m=lengths[1], dictionary=dictionary)
