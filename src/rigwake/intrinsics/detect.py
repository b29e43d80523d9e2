"""Corners of a board in images, by OpenCV's detectors, to a fraction of a pixel."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import lru_cache
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from rigwake._types import Array
from rigwake.errors import EstimationError, UsageError
from rigwake.intrinsics.board_observations import MIN_CORNERS, BoardObservations, BoardView, gathered
from rigwake.intrinsics.boards import Board
from rigwake.intrinsics.saddles import fitted_saddles, normals_of_grid
from rigwake.readers.picture_files import IMAGE_SUFFIXES, picture_or_none

Grey = NDArray[np.uint8]
Found = tuple[NDArray[np.int64], Array]  # corner ids and pixels

_SUBPIXEL_STOP = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_MAX_ITER, 50, 1e-3)
_SMALLEST_TAG_PX = 12.0  # below, the window of the refinement would hold more than one corner
_WINDOW_OF_SQUARE = 0.3  # half the window, as a fraction of the shortest side of a square
_ROOM_OF_BORDER = 1.4  # what lies beyond the border is far from the edges and weighs little
_FARTHEST_REFINEMENT_PX = 1.5  # farther, the window has found something else, such as glare
_BORDER_BITS = (2, 1)  # Kalibr prints its tags with a border of two bits, AprilTag's own have one
_NOTHING: Found = (np.zeros(0, dtype=np.int64), np.zeros((0, 2)))


def detect_corners(board: Board, image: Grey) -> Found:
    """Ids (N,) and pixels (N, 2) of the board's corners in a grey image; empty if it is not there."""
    return {"chessboard": _chessboard, "aprilgrid": _aprilgrid, "charuco": _charuco}[board.kind](board, image)


def _chessboard(board: Board, image: Grey) -> Found:
    flags = cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_EXHAUSTIVE | cv2.CALIB_CB_ACCURACY
    found, corners = cv2.findChessboardCornersSB(image, (board.columns, board.rows), flags=flags)
    if not found:
        return _NOTHING
    pixels = np.asarray(corners, dtype=np.float64).reshape(-1, 2)
    return np.arange(len(pixels)), _refined_saddles(image, pixels.reshape(board.rows, board.columns, 2))


def _refined_saddles(image: Grey, grid: Array) -> Array:
    """(N, 2) corners of a chessboard, given as (rows, columns, 2), where the edges around them cross.

    `findChessboardCornersSB` fits a polynomial to what it filtered: on rendered boards its corners are off by 0.06 px
    and by alike amounts over a whole view, which no covariance of independent corners explains. Gradients in windows
    that hold one corner each halve that, edges fitted in them (`fitted_saddles`) bring it to a quarter and less.
    """
    sides = [np.linalg.norm(np.diff(grid, axis=axis), axis=2).min() for axis in (0, 1)]
    half = int(np.clip(round(_WINDOW_OF_SQUARE * min(sides)), 2, 10))
    start = grid.reshape(-1, 1, 2).astype(np.float32)
    refined = cv2.cornerSubPix(image, start.copy(), (half, half), (-1, -1), _SUBPIXEL_STOP)
    refined = _unless_far(np.asarray(refined, dtype=np.float64).reshape(-1, 2), grid.reshape(-1, 2))
    normals = normals_of_grid(refined.reshape(grid.shape))
    return _unless_far(fitted_saddles(image, refined, normals, float(min(sides))), refined)


def _unless_far(refined: Array, before: Array) -> Array:
    """The refined corners, but those before where refinement went astray or found nothing."""
    is_near = np.linalg.norm(refined - before, axis=1) <= _FARTHEST_REFINEMENT_PX  # NaN is not
    return np.where(is_near[:, None], refined, before)


@lru_cache(maxsize=4)
def _charuco_detector(board: Board) -> cv2.aruco.CharucoDetector:
    return cv2.aruco.CharucoDetector(board.charuco())


def _charuco(board: Board, image: Grey) -> Found:
    corners, ids, _, _ = _charuco_detector(board).detectBoard(image)
    if ids is None or len(ids) == 0:
        return _NOTHING
    return np.asarray(ids, dtype=np.int64).ravel(), np.asarray(corners, dtype=np.float64).reshape(-1, 2)


@lru_cache(maxsize=4)
def _tag_detector(border_bits: int) -> cv2.aruco.ArucoDetector:
    parameters = cv2.aruco.DetectorParameters()
    parameters.markerBorderBits = border_bits
    parameters.minMarkerPerimeterRate = 0.02  # tags shrink towards the rim of a fisheye
    parameters.adaptiveThreshWinSizeMax = 53
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
    return cv2.aruco.ArucoDetector(dictionary, parameters)


def _aprilgrid(board: Board, image: Grey) -> Found:
    tags: dict[int, Array] = {}
    border = 0.0  # width of the black border, as a fraction of the tag
    for border_bits in _BORDER_BITS:
        quads, ids, _ = _tag_detector(border_bits).detectMarkers(image)
        if ids is not None and len(ids) > len(tags):
            border = border_bits / (6 + 2 * border_bits)
            # OpenCV goes clockwise from the top left; the board counter-clockwise from the bottom left
            tags = {
                int(i): np.asarray(quad, dtype=np.float64).reshape(4, 2)[::-1]
                for i, quad in zip(np.ravel(ids), quads, strict=True)
                if int(i) < board.columns * board.rows
            }
        if len(tags) > 1:
            break
    if len(tags) < 2:
        return _NOTHING
    turn = _tag_turn(board, tags)
    ids_out, pixels = [], []
    for tag, quad in tags.items():
        refined = _refined_tag(board, image, np.roll(quad, -turn, axis=0), border)
        if refined is not None:
            ids_out.append(4 * tag + np.arange(4))
            pixels.append(refined)
    return (np.concatenate(ids_out), np.concatenate(pixels)) if pixels else _NOTHING


def _tag_turn(board: Board, tags: dict[int, Array]) -> int:
    """By how many quarters the printed tags are turned against the dictionary's.

    Printers disagree. The right turn is that in which each tag's own sides point to where its nearest
    neighbour is.
    """
    points = board.corner_points[:, :2].reshape(-1, 4, 2)
    names = list(tags)
    origins = np.array([points[tag, 0] for tag in names])
    centres = np.array([tags[tag].mean(axis=0) for tag in names])
    apart = np.linalg.norm(origins[:, None] - origins[None], axis=2)
    np.fill_diagonal(apart, np.inf)
    nearest = apart.argmin(axis=1)
    offsets, seen = (origins[nearest] - origins) / board.size_m, centres[nearest] - centres
    errors = []
    for turn in range(4):
        quads = np.array([np.roll(tags[tag], -turn, axis=0) for tag in names])
        x, y = quads[:, 1] - quads[:, 0], quads[:, 3] - quads[:, 0]
        predicted = offsets[:, :1] * x + offsets[:, 1:] * y
        errors.append(np.median(np.linalg.norm(predicted - seen, axis=1) / np.linalg.norm(seen, axis=1)))
    return int(np.argmin(errors))


def _refined_tag(board: Board, image: Grey, quad: Array, border: float) -> Array | None:
    """The four corners refined in windows that hold one corner each, or None if that fails.

    The detector's quads lie up to 4 px inside of the tag; gradients, in windows that reach as far, bring them to a few
    hundredths, edges fitted in windows as wide as the tag's black `border` (a fraction of its side) or the gap's black
    squares to a tenth of that. Where there are no such squares, corners stay as gradients say.
    """
    sides = np.roll(quad, -1, axis=0) - quad
    shortest = float(np.linalg.norm(sides, axis=1).min())
    if shortest < _SMALLEST_TAG_PX:
        return None
    half = int(np.clip(round(0.5 * min(board.spacing, 0.5) * shortest), 2, 8))
    inside = (quad >= half + 2).all() and (quad < np.array(image.shape[::-1]) - half - 2).all()
    if not inside:
        return None
    start = quad.astype(np.float32).reshape(-1, 1, 2)
    refined = cv2.cornerSubPix(image, start.copy(), (half, half), (-1, -1), _SUBPIXEL_STOP)
    refined = np.asarray(refined, dtype=np.float64).reshape(4, 2)
    moved = np.linalg.norm(refined - quad, axis=1)
    if moved.max() > half or moved.min() == 0:  # what leaves its window is put back
        return None
    normals = [np.arctan2(s[:, 1], s[:, 0]) + np.pi / 2 for s in (sides, np.roll(sides, 1, axis=0))]
    room_px = _ROOM_OF_BORDER * min(board.spacing, border) * shortest
    return _unless_far(fitted_saddles(image, refined, normals, room_px), refined)


def list_images(paths: Iterable[Path]) -> list[Path]:
    """Image files among paths and in folders, sorted within each folder; UsageError if there are none."""
    files: list[Path] = []
    for path in paths:
        if path.is_dir():
            files += sorted(file for file in path.iterdir() if file.suffix.lower() in IMAGE_SUFFIXES)
        elif path.is_file():
            files.append(path)
        else:
            raise UsageError(f"{path} is neither a file nor a folder.")
    if not files:
        raise UsageError(
            "There are no images.", remedy=f"Known suffixes: {', '.join(sorted(IMAGE_SUFFIXES))}."
        )
    return files


def detect_board(
    board: Board, files: Sequence[Path], *, progress: Callable[[], object] = lambda: None
) -> BoardObservations:
    """Corners in all images, several images at a time; `progress` is called after each.

    Raises UsageError if images differ in size, EstimationError if the board is in none of them.
    """

    def work(file: Path) -> tuple[tuple[int, int] | None, Found]:
        image = picture_or_none(file)
        found = _NOTHING if image is None else detect_corners(board, image)
        progress()
        return (None if image is None else (image.shape[1], image.shape[0])), found

    with ThreadPoolExecutor(max_workers=os.cpu_count()) as pool:
        results = list(pool.map(work, files))
    sizes: dict[tuple[int, int], list[str]] = {}
    views, unused, points = [], [], board.corner_points
    for file, (size, (ids, pixels)) in zip(files, results, strict=True):
        if size is None:
            unused.append((file.name, "not an image"))
            continue
        sizes.setdefault(size, []).append(file.name)
        if len(ids):
            views.append(BoardView(file.name, points[ids], pixels))
        else:
            unused.append((file.name, "no board found"))
    _check_sizes(sizes)
    width_px, height_px = next(iter(sizes))
    observations = gathered(width_px, height_px, views, tuple(unused))
    if not observations.views:
        raise EstimationError(
            f"No {board.words} was found in any of {len(files)} images.",
            consequence="Not one view has enough corners to use.",
            remedy="Check the counts (a chessboard is counted by its inner corners), that the whole board with "
            f"its white rim is visible, sharp and well lit, and that {MIN_CORNERS} corners can be seen.",
        )
    return observations


def _check_sizes(sizes: dict[tuple[int, int], list[str]]) -> None:
    if not sizes:
        raise UsageError("None of the files is an image.")
    if len(sizes) > 1:
        listed = "; ".join(
            f"{w}x{h}: {names[0]} and {len(names) - 1} more" for (w, h), names in sizes.items()
        )
        raise UsageError(
            f"The images differ in size ({listed}).",
            consequence="Intrinsics belong to one resolution.",
            remedy="Calibrate each resolution by itself.",
        )
