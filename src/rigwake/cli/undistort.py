"""`rigwake undistort`: pictures without distortion, from any lens that rigwake knows."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, cast, get_args

import typer

from rigwake.cli.console import next_step, out, progress_bar
from rigwake.cli.options import require, require_there, require_writable


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
    from rigwake.pipeline.undistortion import Target, undistort_source

    require("--to", to, get_args(Target))
    require_there(*source, camera_file)
    require_writable("--out", output, folder=True)
    with progress_bar() as bar:
        task = bar.add_task("undistorting", total=1)
        written = undistort_source(
            source,
            output,
            camera_file=camera_file,
            camera=camera,
            target=cast(Target, to),
            focal_px=focal,
            every=every,
            progress=lambda done, total: bar.update(task, completed=done, total=total),
        )
    out.print(f"{len(written)} files in {output}", markup=False, highlight=False)
    next_step("rigwake undistort --help", "other views: --to cylinder, --to equirectangular, --focal")
