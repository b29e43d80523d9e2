"""Lenses alone: from images of a board, of the cameras of a recording that saw one, or from a recording's motion."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import cv2
import numpy as np

from rigwake._progress import Progress
from rigwake._types import Image
from rigwake.cameras.registry import camera_to_dict
from rigwake.config import CalibrateConfig
from rigwake.errors import HostError, RigwakeError
from rigwake.intrinsics.board_calibration import IntrinsicCalibration, calibrate
from rigwake.intrinsics.board_observations import BoardObservations
from rigwake.intrinsics.board_search import find_board, frame_of
from rigwake.intrinsics.boards import Board
from rigwake.intrinsics.result_file import calibration_to_dict
from rigwake.intrinsics.select import ModelScore, choose, cross_validate
from rigwake.pipeline.calibration_run import calibrate as calibrate_rig
from rigwake.readers.topics import TopicMap
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


@dataclass(frozen=True, eq=False)
class MotionLenses:
    """Lenses from the motion. contents: by camera, what the camera file holds. failed: cameras without one, and why.
    notes: what `calibrate` noted on the way."""

    contents: Mapping[str, dict[str, Any]]
    failed: Mapping[str, str]
    notes: tuple[str, ...]


def lenses_from_motion(
    recording: Path,
    config: CalibrateConfig,
    topics: TopicMap | None = None,
    progress: Progress = lambda name, what, fraction: None,
) -> MotionLenses:
    """The lenses that a calibration of the whole rig finds; the rig itself is not kept.

    config: `intrinsics` is what it says, find or refine. Raises as `pipeline.calibration_run.calibrate`.
    """
    with TemporaryDirectory(prefix="rigwake-lenses-") as folder:
        run = calibrate_rig(recording, Path(folder) / "out", config, topics=topics, progress=progress)
    contents = {
        name: {**camera_to_dict(camera.model), **_known_by_motion(camera.statistics.get("intrinsics"))}
        for name, camera in run.calibration.cameras.items()
        if camera.model is not None
    }
    return MotionLenses(contents, run.failed, run.notes)


def _known_by_motion(told: Mapping[str, Any] | None) -> dict[str, Any]:
    """`calibration` of a camera file: deviations and covariance, null where the motion does not tell a parameter."""
    if not told:
        return {}
    std = {n: None if n in told["not_determined"] else s for n, s in told["std"].items()}
    return {
        "calibration": {
            "from": "motion",
            "std": std,
            "fixed": list(told["held"]),
            "undetermined": list(told["not_determined"]),
            "covariance": told["covariance"],
        }
    }


def image_loader(files: Sequence[Path]) -> Callable[[str], Image | None]:
    """Images by the names of their files."""
    by_name = {file.name: file for file in files}

    def load(view_name: str) -> Image | None:
        file = by_name.get(view_name)
        return None if file is None else cv2.imread(str(file), cv2.IMREAD_GRAYSCALE)

    return load
