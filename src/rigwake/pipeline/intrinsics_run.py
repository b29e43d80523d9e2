"""Lenses from a board: one from images, or those of all cameras of a recording."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from rigwake._progress import Progress
from rigwake._types import Image
from rigwake.errors import HostError, RigwakeError
from rigwake.intrinsics.board_calibration import IntrinsicCalibration, calibrate
from rigwake.intrinsics.board_observations import BoardObservations
from rigwake.intrinsics.board_search import find_board, frame_of
from rigwake.intrinsics.boards import Board
from rigwake.intrinsics.result_file import calibration_to_dict
from rigwake.intrinsics.select import ModelScore, choose, cross_validate
from rigwake.recording import CameraStream
from rigwake.report.intrinsics_page import CalibratedLens, intrinsics_page


@dataclass(frozen=True)
class LensChoice:
    """What to estimate.

    model: of the registry, or `auto`: the one that predicts held-out views best. fix, free: names of parameters to
    hold, or to estimate though they are held by default. fov_deg: full field of view, if known.
    """

    model: str = "auto"
    fix: tuple[str, ...] = ()
    free: tuple[str, ...] = ()
    fov_deg: float | None = None


@dataclass(frozen=True, eq=False)
class BoardLens:
    """A lens, what it was made from, and how the models compared (empty where one was named)."""

    result: IntrinsicCalibration
    observations: BoardObservations
    scores: tuple[ModelScore, ...] = ()
    load: Callable[[str], Image | None] = field(default=lambda name: None, repr=False)


@dataclass(frozen=True, eq=False)
class IntrinsicsRun:
    """Lenses by camera, and the errors of those that have none."""

    found: Mapping[str, BoardLens]
    failed: Mapping[str, RigwakeError] = field(default_factory=dict)

    def contents(self) -> dict[str, dict[str, Any]]:
        """What the camera file holds of each."""
        return {
            name: calibration_to_dict(lens.result, lens.observations.unused, lens.scores)
            for name, lens in self.found.items()
        }

    def page(self, source: str) -> str:
        """One HTML page. source: the name of what the images came from."""
        lenses = {
            name: CalibratedLens(lens.result, lens.load, lens.observations.unused)
            for name, lens in self.found.items()
        }
        return intrinsics_page(source, lenses, {name: str(error) for name, error in self.failed.items()})


def lens_of(
    observations: BoardObservations,
    choice: LensChoice,
    load: Callable[[str], Image | None] = lambda name: None,
    progress: Callable[[], object] = lambda: None,
) -> BoardLens:
    """The lens that explains the observations. load: the image of a view by its name. progress: called after each model
    that was compared. Raises as `calibrate` and `cross_validate` do."""
    scores = tuple(cross_validate(observations, progress=progress)) if choice.model == "auto" else ()
    result = calibrate(
        observations,
        choose(scores) if choice.model == "auto" else choice.model,
        fix=choice.fix,
        free=choice.free,
        max_angle=None if choice.fov_deg is None else float(np.deg2rad(choice.fov_deg / 2)),
    )
    return BoardLens(result, observations, scores, load)


def lenses_of_recording(
    streams: Sequence[CameraStream],
    board: Board,
    choice: LensChoice,
    progress: Progress = lambda name, what, fraction: None,
) -> IntrinsicsRun:
    """The lens of each camera by itself; one that fails does not stop the others. Raises HostError."""
    found: dict[str, BoardLens] = {}
    failed: dict[str, RigwakeError] = {}
    for stream in streams:
        try:
            found[stream.name] = _lens_of_stream(stream, board, choice, progress)
        except HostError:
            raise
        except RigwakeError as error:
            failed[stream.name] = error
    return IntrinsicsRun(found, failed)


def _lens_of_stream(stream: CameraStream, board: Board, choice: LensChoice, progress: Progress) -> BoardLens:
    def searched(done: int, total: int) -> None:
        progress(stream.name, "looking for the board", done / max(total, 1))

    def load(view_name: str) -> Image | None:
        frame = frame_of(stream, view_name)
        return None if frame is None else frame.image

    observations = find_board(board, stream, progress=searched)
    progress(stream.name, "estimating the lens", 0.0)
    return lens_of(observations, choice, load)


def image_loader(files: Sequence[Path]) -> Callable[[str], Image | None]:
    """Images by the names of their files."""
    by_name = {file.name: file for file in files}

    def load(view_name: str) -> Image | None:
        file = by_name.get(view_name)
        return None if file is None else cv2.imread(str(file), cv2.IMREAD_GRAYSCALE)

    return load
