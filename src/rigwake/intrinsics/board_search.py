"""The board in the frames of a recorded camera: a few dozen different views of it, out of thousands of frames."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from itertools import islice

import cv2
import numpy as np

from rigwake._types import Array
from rigwake.errors import EstimationError
from rigwake.intrinsics.board_observations import MIN_CORNERS, BoardObservations, BoardView, gathered
from rigwake.intrinsics.boards import Board
from rigwake.intrinsics.detect import Found, detect_corners
from rigwake.recording import CameraStream, Frame

MOST_FRAMES = 150
"""Frames that are searched, spread evenly: more would cost minutes and add views that are alike."""
MOST_VIEWS = 60
_FRAMES_AT_ONCE = 8
_LEAST_STEP = 0.02  # of the image's width: a board that moved less is the same view again


def find_board(
    board: Board,
    camera: CameraStream,
    *,
    most_frames: int = MOST_FRAMES,
    progress: Callable[[int, int], object] = lambda done, total: None,
) -> BoardObservations:
    """Views of the board in a camera's frames, by names as `frame_name` makes them; views that repeat the one before
    are left out. progress: called with frames searched and frames to search.

    Raises EstimationError where no frame shows the board.
    """
    count = len(camera)
    indices = np.unique(np.linspace(0, max(count - 1, 0), min(count, most_frames)).astype(np.int64))
    found: list[tuple[str, Found]] = []
    with ThreadPoolExecutor(max_workers=os.cpu_count()) as pool:
        for frames in _batches(camera.frames(indices)):
            corners = pool.map(lambda frame: detect_corners(board, _grey(frame)), frames)
            found += [(frame_name(f.index), c) for f, c in zip(frames, corners, strict=True)]
            progress(len(found), len(indices))
    seen = [(name, ids, pixels) for name, (ids, pixels) in found if len(ids) >= MIN_CORNERS]
    if not seen:
        raise EstimationError(
            f"{camera.name}: no {board.words} was found in {len(found)} of its {count} frames.",
            consequence="This camera has no intrinsics.",
            remedy="Check the counts (a chessboard is counted by its inner corners), and that the whole board with its "
            "white rim is visible, sharp and well lit.",
        )
    kept = _different(seen, camera.width_px)
    points = board.corner_points
    views = [BoardView(name, points[ids], pixels) for name, ids, pixels in kept]
    known = {name for name, _, _ in kept}
    unused = tuple((name, "the board has hardly moved") for name, _, _ in seen if name not in known)
    return gathered(camera.width_px, camera.height_px, views, unused)


def frame_name(index: int) -> str:
    """The name of the view in a frame of a recording."""
    return f"frame {index}"


def frame_of(camera: CameraStream, view_name: str) -> Frame | None:
    """The frame of a view by its name; None if it cannot be decoded."""
    return next(iter(camera.frames([int(view_name.rpartition(" ")[2])])), None)


def _batches(frames: Iterator[Frame]) -> Iterator[list[Frame]]:
    """A few frames at a time, so that memory does not grow with the recording."""
    while batch := list(islice(frames, _FRAMES_AT_ONCE)):
        yield batch


def _grey(frame: Frame) -> np.ndarray:
    return frame.image if frame.image.ndim == 2 else cv2.cvtColor(frame.image, cv2.COLOR_BGR2GRAY)


_Seen = tuple[str, np.ndarray, Array]


def _different(seen: list[_Seen], width_px: int) -> list[_Seen]:
    """Views in which the board stands elsewhere than in the one kept before; at most `MOST_VIEWS` of them."""
    kept = seen[:1]
    for one in seen[1:]:
        _, ids, pixels = one
        _, before_ids, before = kept[-1]
        _, a, b = np.intersect1d(before_ids, ids, return_indices=True)
        moved = float(np.median(np.linalg.norm(pixels[b] - before[a], axis=1))) if len(a) else np.inf
        if moved > _LEAST_STEP * width_px:
            kept.append(one)
    chosen = np.unique(np.linspace(0, len(kept) - 1, min(len(kept), MOST_VIEWS)).astype(np.int64))
    return [kept[k] for k in chosen.tolist()]
