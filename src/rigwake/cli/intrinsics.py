"""`rigwake intrinsics`: a camera's lens from images of a board."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

import typer
from rich.markup import escape
from rich.table import Table

from rigwake.cli.console import (
    err,
    figures_table,
    next_step,
    out,
    print_title,
    progress_bar,
    progress_bars,
    write_json,
)
from rigwake.cli.options import (
    LENS_MODELS,
    FovOption,
    JsonOption,
    TopicOption,
    TopicsOption,
    completed_from,
    fields_of_view,
    require,
    require_there,
    require_writable,
    topic_words,
)
from rigwake.errors import PartialResultError, RigwakeError, UsageError
from rigwake.extras import require_extra

if TYPE_CHECKING:
    from rigwake._types import Image
    from rigwake.intrinsics.board_calibration import IntrinsicCalibration
    from rigwake.intrinsics.board_observations import BoardObservations
    from rigwake.intrinsics.boards import Board
    from rigwake.intrinsics.select import ModelScore
    from rigwake.pipeline.intrinsics_run import IntrinsicsRun, LensChoice


def command(
    images: Annotated[
        list[Path],
        typer.Argument(
            help="Images, folders of images, one csv file of detected corners; or, with --camera, a recording."
        ),
    ],
    board: Annotated[
        str | None,
        typer.Option(
            help="chessboard:9x6:0.03 (inner corners), aprilgrid:6x6:0.088:0.3, charuco:11x8:0.03:0.022."
        ),
    ] = None,
    model: Annotated[
        str,
        typer.Option(
            help=f"{', '.join(LENS_MODELS)}; `auto` compares them.",
            autocompletion=completed_from((*LENS_MODELS, "auto")),
        ),
    ] = "auto",
    camera: Annotated[
        str | None,
        typer.Option(help="Of a recording: the name of a camera, or all of them in one file: `all`."),
    ] = None,
    topic: TopicOption = None,
    topics: TopicsOption = None,
    output: Annotated[
        Path | None, typer.Option("-o", "--out", "--output", help="Write the camera file here.")
    ] = None,
    name: Annotated[str | None, typer.Option(help="The camera's name in the file.")] = None,
    image_size: Annotated[str | None, typer.Option(help="WIDTHxHEIGHT, needed with a csv file.")] = None,
    from_motion: Annotated[
        bool,
        typer.Option(
            "--from-motion", help="Of a recording without a board: by how its pictures and IMU turn."
        ),
    ] = False,
    fov: FovOption = None,
    fix: Annotated[str, typer.Option(help="Parameters to hold, comma-separated: `skew,k3`.")] = "",
    free: Annotated[str, typer.Option(help="Parameters to estimate though they are held by default.")] = "",
    html: Annotated[
        Path | None,
        typer.Option(help="Write one HTML page: corners, residuals, uncertainty over the picture."),
    ] = None,
    plots: Annotated[Path | None, typer.Option(help="Folder for the coverage and residual plots.")] = None,
    json_file: JsonOption = None,
) -> None:
    """A camera's lens from images of a board, for pinholes and for fisheyes beyond 180 degrees.

    Example: [cyan]rigwake intrinsics images/ --board aprilgrid:6x6:0.088:0.3 --model kb4 -o front.yaml[/cyan]

    Example: [cyan]rigwake intrinsics board.bag --camera all --board chessboard:9x6:0.03 -o lenses.yaml[/cyan]

    Example: [cyan]rigwake intrinsics sail.bag --from-motion --fov 185 -o lenses.yaml[/cyan]
    """
    require_there(*images, topics)
    require("--model", model, (*LENS_MODELS, "auto"))
    fov_deg = fields_of_view(fov)
    require_writable("-o", output)
    require_writable("--html", html)
    require_writable("--plots", plots, folder=True)
    require_writable("--json", json_file)
    if (camera is not None or from_motion) and len(images) > 1:
        option = "--from-motion" if from_motion else "--camera"
        raise UsageError(
            f"{option} reads one recording.", remedy=f"Give the recording alone, or leave out {option}."
        )
    if from_motion:
        _by_motion(images[0], camera, fov_deg, _TopicWords(topic, topics), output, json_file)
        return
    if fov_deg.keys() - {"all"}:
        raise UsageError("With a board, one --fov holds for every lens.", remedy="Give --fov 185.")
    if plots is not None:
        require_extra("matplotlib", "report", "Writing plots")
    from rigwake.atomic import write_text_atomic
    from rigwake.intrinsics.result_file import save_intrinsics
    from rigwake.pipeline.intrinsics_run import LensChoice

    choice = LensChoice(model, _names(fix), _names(free), fov_deg.get("all"))
    if camera is not None:
        run = _of_recording(images[0], camera, _TopicWords(topic, topics), _board_named(board), choice)
    else:
        run = _of_images(images, board, image_size, name or (output.stem if output else "camera"), choice)
    if output is not None and run.found:
        save_intrinsics(output, run.contents())
    if html is not None:
        write_text_atomic(html, run.page(images[0].resolve().name))
    written = [path for path in (output if run.found else None, html, *_plotted(run, plots)) if path]
    if json_file is not None:
        write_json(json_file, run.contents())
    quiet = str(json_file) == "-"
    if not quiet:
        _print_all(run, written)
    _refuse_missing(run.failed, len(run.found))
    if not quiet:
        words = _words_again(images, board, image_size, fov, fix, free)
        words += ["--camera", camera, *topic_words(topic, topics)] if camera is not None else []
        _name_next_step(run, output, words, "lenses" if camera is not None else next(iter(run.found)))


def _print_all(run: IntrinsicsRun, written: Sequence[Path]) -> None:
    for name, lens in run.found.items():
        _print(name, lens.result, lens.observations, lens.scores)
    for path in written:
        out.print(f"written: {escape(str(path))}", soft_wrap=True)


def _name_next_step(run: IntrinsicsRun, output: Path | None, words: list[object], stem: str) -> None:
    """words: the command again; stem: of the file to write, where none was given."""
    if output is not None:
        why = f"then: calibrate RECORDING --camera-file {escape(str(output))} -o OUT"
        next_step(["rigwake", "calibrate", "--help"], why)
        return
    models = {lens.result.camera.model for lens in run.found.values()}
    model = models.pop() if len(models) == 1 else "auto"
    next_step([*words, "--model", model, "-o", f"{stem}.yaml"], "write it to a file")


def _plotted(run: IntrinsicsRun, folder: Path | None) -> list[Path]:
    if folder is None:
        return []
    from rigwake.intrinsics.plots import save_plots

    return [path for name, lens in run.found.items() for path in save_plots(lens.result, folder, name)]


class _TopicWords(NamedTuple):
    """--topic and --topics as they were given."""

    topic: list[str] | None
    topics: Path | None


def _of_images(
    images: list[Path], board: str | None, image_size: str | None, name: str, choice: LensChoice
) -> IntrinsicsRun:
    """One camera's lens from pictures or a file of corners."""
    from rigwake.intrinsics.select import CANDIDATES
    from rigwake.pipeline.intrinsics_run import IntrinsicsRun, lens_of

    observations, load = _observe(images, board, image_size)
    if choice.model != "auto":
        return IntrinsicsRun({name: lens_of(observations, choice, load)})
    with progress_bar() as bar:
        task = bar.add_task("comparing models (the first run compiles them)", total=len(CANDIDATES))
        return IntrinsicsRun({name: lens_of(observations, choice, load, lambda: bar.advance(task))})


def _of_recording(
    recording: Path, camera: str, given: _TopicWords, board: Board, choice: LensChoice
) -> IntrinsicsRun:
    """Lenses of one camera of a recording, or of all."""
    from rigwake.pipeline.intrinsics_run import lenses_of_recording
    from rigwake.pipeline.odometry_run import cameras_named
    from rigwake.readers.open import open_recording
    from rigwake.readers.topics import TopicMap

    opened = open_recording(recording, TopicMap.from_options(given.topic or (), given.topics))
    with progress_bars() as bars:
        return lenses_of_recording(cameras_named(opened, camera), board, choice, bars)


def _by_motion(
    recording: Path,
    camera: str | None,
    fov_deg: dict[str, float],
    given: _TopicWords,
    output: Path | None,
    json_file: Path | None,
) -> None:
    """Lenses of a recording that shows no board, from the motion of the whole rig."""
    from rigwake.config import load_config
    from rigwake.intrinsics.result_file import save_intrinsics
    from rigwake.pipeline.intrinsics_run import lenses_from_motion
    from rigwake.readers.topics import TopicMap

    chosen = None if camera in (None, "all") else [camera]
    config = load_config(None, intrinsics="find", fov_deg=fov_deg or None, cameras=chosen)
    topics = TopicMap.from_options(given.topic or (), given.topics)
    with progress_bars() as bars:
        lenses = lenses_from_motion(recording, config, topics, bars)
    if output is not None and lenses.contents:
        save_intrinsics(output, lenses.contents)
    if json_file is not None:
        write_json(json_file, dict(lenses.contents))
    if str(json_file) != "-":
        for name, content in lenses.contents.items():
            _print_by_motion(name, content)
        for note in lenses.notes:
            out.print(f"[dim]note: {escape(note)}[/dim]", soft_wrap=True)
        if output is not None:
            out.print(f"written: {escape(str(output))}", soft_wrap=True)
            next_step(
                ["rigwake", "calibrate", recording, "--camera-file", output, "--help"],
                "another recording of the same cameras can be calibrated with them",
            )
    if lenses.failed:
        reasons = "; ".join(f"{name}: {why}" for name, why in lenses.failed.items())
        raise PartialResultError(f"Cameras have no lens: {', '.join(lenses.failed)}.", consequence=reasons)


def _print_by_motion(name: str, content: Mapping[str, Any]) -> None:
    table = figures_table(("parameter", "value", "± 1 sigma"))
    known = content.get("calibration", {"std": {}, "fixed": []})
    for parameter, value in content["params"].items():
        std = known["std"].get(parameter)
        words = (
            "held"
            if parameter in known["fixed"]
            else "not told by the motion"
            if std is None
            else f"{std:.3g}"
        )
        table.add_row(parameter, f"{value:.8g}", words)
    print_title(f"{name}: {content['model']}, {content['width_px']} x {content['height_px']} px")
    out.print(table)


def _refuse_missing(failed: Mapping[str, RigwakeError], found: int) -> None:
    """Raises the reason where there is no lens at all, PartialResultError where some cameras have none."""
    if not failed:
        return
    if not found:
        raise next(iter(failed.values()))
    for name, error in failed.items():
        err.print(f"[yellow]{escape(name)}: {escape(str(error))}[/yellow]", soft_wrap=True)
    raise PartialResultError(
        f"{len(failed)} of {found + len(failed)} cameras have no lens: {', '.join(failed)}.",
        consequence="The file holds the others.",
        remedy="See the reasons above.",
    )


def _words_again(
    images: list[Path], board: str | None, image_size: str | None, fov: list[str] | None, fix: str, free: str
) -> list[object]:
    """The same command again, but for its model and its outputs."""
    options = {
        "--board": board,
        "--image-size": image_size,
        "--fov": fov[-1] if fov else None,
        "--fix": fix,
        "--free": free,
    }
    given = [word for option, value in options.items() if value for word in (option, value)]
    return ["rigwake", "intrinsics", *images, *given]


def _names(text: str) -> tuple[str, ...]:
    return tuple(word.strip() for word in text.split(",") if word.strip())


def _board_named(board: str | None) -> Board:
    from rigwake.intrinsics.boards import parse_board

    if board is None:
        raise UsageError("Images need a board.", remedy="Add --board, as chessboard:9x6:0.03.")
    return parse_board(board)


def _observe(
    images: list[Path], board: str | None, image_size: str | None
) -> tuple[BoardObservations, Callable[[str], Image | None]]:
    """Views of the board, and what loads the image of a view."""
    from rigwake.intrinsics.board_observations import read_corner_file
    from rigwake.intrinsics.detect import detect_board, list_images
    from rigwake.pipeline.intrinsics_run import image_loader

    if any(path.name.endswith((".csv", ".csv.gz")) for path in images):
        if len(images) > 1:
            raise UsageError("One csv file of corners is read at a time.")
        width_px, height_px = _size(image_size)
        return read_corner_file(images[0], width_px, height_px), image_loader([])
    parsed, files = _board_named(board), list_images(images)
    with progress_bar() as bar:
        task = bar.add_task(f"looking for the {parsed.words}", total=len(files))
        return detect_board(parsed, files, progress=lambda: bar.advance(task)), image_loader(files)


def _size(text: str | None) -> tuple[int, int]:
    if text is None:
        raise UsageError("A csv file of corners needs the image size.", remedy="Add --image-size 752x480.")
    try:
        width_px, height_px = (int(word) for word in text.lower().split("x"))
        if min(width_px, height_px) < 1:
            raise ValueError
    except ValueError:
        raise UsageError(f"--image-size {text!r} is not WIDTHxHEIGHT.", remedy="Write 752x480.") from None
    return width_px, height_px


def _print(
    camera: str, result: IntrinsicCalibration, observations: BoardObservations, scores: Sequence[ModelScore]
) -> None:
    import numpy as np

    if scores:
        table = Table(box=None, pad_edge=False)
        for heading in ("model", "RMS px", "± px", "free", ""):
            table.add_column(heading, justify="left" if heading in ("model", "") else "right")
        for score in sorted(scores, key=lambda s: s.held_out_px):
            chosen = "chosen" if score.model == result.camera.model else score.failure
            figures = (
                ("–", "–") if score.failure else (f"{score.held_out_px:.4f}", f"{score.std_error_px:.4f}")
            )
            table.add_row(score.model, *figures, str(score.free_count), chosen)
        print_title(f"{camera}, cross-validation: held-out views")
        out.print(table)
    size = f"{result.camera.width_px} x {result.camera.height_px} px"
    table = figures_table(("parameter", "value", "± 1 sigma"))
    for (parameter, std), value in zip(result.stds.items(), result.camera.params.tolist(), strict=True):
        uncertainty = (
            "held" if parameter in result.fixed else f"{std:.3g}" if np.isfinite(std) else "unobservable"
        )
        table.add_row(parameter, f"{value:.8g}" if np.isfinite(std) else "–", uncertainty)
    print_title(f"{camera}: {result.camera.model}, {size}")
    out.print(table)
    out.print(
        f"{result.corners.used.sum()} corners in {len(result.view_names)} views to "
        f"{np.rad2deg(result.max_observed_angle):.1f} deg off the axis: RMS {result.rms_px:.4f} px, "
        f"noise {result.sigma_px:.4f} px per coordinate; {result.dropped_corners} corners left out"
    )
    for view, reason in (*result.dropped_views, *observations.unused):
        out.print(f"left out: {view}: {reason}", highlight=False)
    if result.unobservable:
        out.print(f"[yellow]unobservable by these views: {', '.join(result.unobservable)}[/yellow]")
    if not result.converged:
        out.print("[yellow]the refinement had not converged: add views or fix parameters[/yellow]")
