"""`rigwake undistort`: pictures without distortion, from any lens that rigwake knows."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, cast, get_args

import typer

from rigwake.cli.console import next_step, out, progress_bar
from rigwake.cli.options import require, require_there, require_writable
from rigwake.errors import UsageError


def command(
    source: Annotated[list[Path], typer.Argument(help="Images, folders of images, or one recording.")],
    output: Annotated[Path, typer.Option("-o", "--out", "--output", help="Folder for the pictures.")],
    camera_file: Annotated[
        Path | None,
        typer.Option("--camera-file", help="The lens: any camera file. Default: the recording's."),
    ] = None,
    camera: Annotated[
        str | None, typer.Option("--camera", help="Name of the camera in the file or the recording.")
    ] = None,
    to: Annotated[str, typer.Option("--to", help="pinhole, cylinder or equirectangular.")] = "pinhole",
    focal: Annotated[
        float | None, typer.Option("--focal", min=1.0, help="Focal length of the views in pixels.")
    ] = None,
    every: Annotated[int, typer.Option("--every", min=1, help="Of a recording, every n-th frame.")] = 1,
) -> None:
    """Undistort images, or one camera of a recording. A lens wider than 100 degrees becomes several pinholes.

    Example: [cyan]rigwake undistort images/ --camera-file front.yaml --to cylinder -o OUT[/cyan]

    Example: [cyan]rigwake undistort sail.bag --camera front --every 10 -o OUT[/cyan]
    """
    from rigwake.cameras.formats.camera_files import read_camera
    from rigwake.pipeline.undistortion import Target, prepare_undistortion, undistort_files, undistort_stream
    from rigwake.readers.open import open_recording
    from rigwake.readers.picture_files import IMAGE_SUFFIXES

    require("--to", to, get_args(Target))
    require_there(*source, camera_file)
    require_writable("--out", output, folder=True)
    target = cast(Target, to)
    given = None if camera_file is None else read_camera(camera_file, camera)
    with progress_bar() as bar:
        task = bar.add_task("undistorting", total=1)

        def show(done: int, total: int) -> None:
            bar.update(task, completed=done, total=total)

        if all(path.suffix.lower() in IMAGE_SUFFIXES for path in source) or (given and _only_images(source)):
            if given is None:
                raise UsageError(
                    "Images alone do not say what the lens is.", remedy="Give --camera-file FILE."
                )
            written = undistort_files(source, prepare_undistortion(given, target, focal), output, show)
        else:
            if len(source) != 1:
                raise UsageError("Give one recording, or images.")
            recording = open_recording(source[0])
            stream = recording.camera(camera) if camera else next(iter(recording.cameras.values()), None)
            if stream is None:
                raise UsageError(f"{source[0]} has no camera.", remedy=f"rigwake inspect {source[0]}")
            model = given or stream.model
            if model is None:
                raise UsageError(
                    f"{source[0]} does not say what the lens of {stream.name} is.",
                    remedy="Give --camera-file FILE.",
                )
            written = undistort_stream(
                stream, prepare_undistortion(model, target, focal), output, every, show
            )
    out.print(f"{len(written)} files in {output}", markup=False, highlight=False)
    next_step("rigwake undistort --help", "other views: --to cylinder, --to equirectangular, --focal")


def _only_images(source: list[Path]) -> bool:
    """Whether folders hold images and nothing that makes them a recording."""
    from rigwake.readers.image_files import image_files

    return all(path.is_file() or (path.is_dir() and bool(image_files(path))) for path in source)
