"""`rigwake intrinsics`: a camera's lens from images of a board."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.markup import escape
from rich.table import Table

from rigwake.cli.console import figures_table, next_step, out, print_title, progress_bar, write_json
from rigwake.cli.options import (
    LENS_MODELS,
    JsonOption,
    completed_from,
    require,
    require_number,
    require_there,
    require_writable,
)
from rigwake.errors import UsageError

if TYPE_CHECKING:
    from rigwake.intrinsics.board_calibration import IntrinsicCalibration
    from rigwake.intrinsics.board_observations import BoardObservations
    from rigwake.intrinsics.select import ModelScore


def command(
    images: Annotated[
        list[Path], typer.Argument(help="Images, folders of images, or one csv file of detected corners.")
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
    output: Annotated[
        Path | None, typer.Option("-o", "--out", "--output", help="Write the camera file here.")
    ] = None,
    name: Annotated[str | None, typer.Option(help="The camera's name in the file.")] = None,
    image_size: Annotated[str | None, typer.Option(help="WIDTHxHEIGHT, needed with a csv file.")] = None,
    fov: Annotated[
        float | None, typer.Option(help="The lens's full field of view in degrees, if known.")
    ] = None,
    fix: Annotated[str, typer.Option(help="Parameters to hold, comma-separated: `skew,k3`.")] = "",
    free: Annotated[str, typer.Option(help="Parameters to estimate though they are held by default.")] = "",
    plots: Annotated[Path | None, typer.Option(help="Folder for the coverage and residual plots.")] = None,
    json_file: JsonOption = None,
) -> None:
    """A camera's lens from images of a board, for pinholes and for fisheyes beyond 180 degrees.

    Example: [cyan]rigwake intrinsics images/ --board aprilgrid:6x6:0.088:0.3 --model kb4 -o front.yaml[/cyan]
    """
    require_there(*images)
    require("--model", model, (*LENS_MODELS, "auto"))
    require_number("--fov", fov, above=0.0, below=360.0)
    require_writable("-o", output)
    require_writable("--plots", plots, folder=True)
    require_writable("--json", json_file)
    import numpy as np

    from rigwake.intrinsics.board_calibration import calibrate
    from rigwake.intrinsics.plots import save_plots
    from rigwake.intrinsics.result_file import calibration_to_dict, save_intrinsics
    from rigwake.intrinsics.select import choose

    camera_name = name or (output.stem if output else "camera")
    observations = _observe(images, board, image_size)
    scores = _compare(observations) if model == "auto" else []
    result = calibrate(
        observations,
        choose(scores) if model == "auto" else model,
        fix=_names(fix),
        free=_names(free),
        max_angle=None if fov is None else float(np.deg2rad(fov / 2)),
    )
    content = calibration_to_dict(result, observations.unused, scores)
    if output is not None:
        save_intrinsics(output, camera_name, content)
    written = save_plots(result, plots, camera_name) if plots is not None else []
    if json_file is not None:
        write_json(json_file, {camera_name: content})
        if str(json_file) == "-":
            return
    _print(result, observations, scores)
    for path in [*([output] if output else []), *written]:
        out.print(f"written: {escape(str(path))}", soft_wrap=True)
    if output is None:
        words = _words_again(images, board, image_size, fov, fix, free)
        next_step([*words, "--model", result.camera.model, "-o", f"{camera_name}.yaml"], "write it to a file")
    else:
        next_step(
            ["rigwake", "calibrate", "--help"],
            f"then: calibrate RECORDING --camera-file {escape(str(output))} -o OUT",
        )


def _words_again(
    images: list[Path], board: str | None, image_size: str | None, fov: float | None, fix: str, free: str
) -> list[object]:
    """The same command again, but for its model and its outputs."""
    options = {"--board": board, "--image-size": image_size, "--fov": fov, "--fix": fix, "--free": free}
    given = [word for option, value in options.items() if value for word in (option, value)]
    return ["rigwake", "intrinsics", *images, *given]


def _names(text: str) -> list[str]:
    return [word.strip() for word in text.split(",") if word.strip()]


def _observe(images: list[Path], board: str | None, image_size: str | None) -> BoardObservations:
    from rigwake.intrinsics.board_observations import read_corner_file
    from rigwake.intrinsics.boards import parse_board
    from rigwake.intrinsics.detect import detect_board, list_images

    if any(path.name.endswith((".csv", ".csv.gz")) for path in images):
        if len(images) > 1:
            raise UsageError("One csv file of corners is read at a time.")
        width_px, height_px = _size(image_size)
        return read_corner_file(images[0], width_px, height_px)
    if board is None:
        raise UsageError("Images need a board.", remedy="Add --board, as chessboard:9x6:0.03.")
    parsed, files = parse_board(board), list_images(images)
    with progress_bar() as bar:
        task = bar.add_task(f"looking for the {parsed.words}", total=len(files))
        return detect_board(parsed, files, progress=lambda: bar.advance(task))


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


def _compare(observations: BoardObservations) -> list[ModelScore]:
    from rigwake.intrinsics.select import CANDIDATES, cross_validate

    with progress_bar() as bar:
        task = bar.add_task("comparing models (the first run compiles them)", total=len(CANDIDATES))
        return cross_validate(observations, progress=lambda: bar.advance(task))


def _print(result: IntrinsicCalibration, observations: BoardObservations, scores: list[ModelScore]) -> None:
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
        print_title("cross-validation: held-out views")
        out.print(table)
    size = f"{result.camera.width_px} x {result.camera.height_px} px"
    table = figures_table(("parameter", "value", "± 1 sigma"))
    for (parameter, std), value in zip(result.stds.items(), result.camera.params.tolist(), strict=True):
        uncertainty = (
            "held" if parameter in result.fixed else f"{std:.3g}" if np.isfinite(std) else "unobservable"
        )
        table.add_row(parameter, f"{value:.8g}" if np.isfinite(std) else "–", uncertainty)
    print_title(f"{result.camera.model}, {size}")
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
