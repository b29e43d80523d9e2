"""`rigwake export`: a calibration in the format of another program."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from rigwake.cli.console import next_step, out
from rigwake.cli.options import EXPORT_FORMATS, completed_from, require, require_number, require_there


def command(
    calibration: Annotated[
        Path, typer.Argument(help="A calibration.yaml, or a file of any format that export writes.")
    ],
    to: Annotated[
        str,
        typer.Option(
            "--to",
            help=f"{', '.join(EXPORT_FORMATS[:-1])} or {EXPORT_FORMATS[-1]}.",
            metavar="FORMAT",
            autocompletion=completed_from(EXPORT_FORMATS),
        ),
    ],
    output: Annotated[
        Path | None,
        typer.Option("-o", "--out", "--output", help="File or folder to write; default beside the input."),
    ] = None,
    parent_frame: Annotated[str, typer.Option(help="ROS, URDF: the parent frame; default the rig's.")] = "",
    child_frame: Annotated[
        str,
        typer.Option(
            help="ROS, URDF: the cameras' frames; default {name}_optical_frame.", show_default=False
        ),
    ] = "{name}_optical_frame",
    imu: Annotated[
        Path | None, typer.Option(help="Kalibr's imu.yaml, for formats that hold IMU noise (basalt).")
    ] = None,
    max_fit_error: Annotated[
        float, typer.Option(help="Largest error, in pixels, of a lens that has to be converted.")
    ] = 0.5,
    allow_unobservable: Annotated[
        bool,
        typer.Option(
            "--allow-unobservable",
            help="Leave cameras out that are not fully determined, instead of refusing.",
        ),
    ] = False,
) -> None:
    """Write a calibration so that ROS, Kalibr, OpenVINS, Basalt, COLMAP, mrcal, OpenCV or CamOdoCal load it.

    Example: [cyan]rigwake export OUT/calibration.yaml --to kalibr -o camchain.yaml[/cyan]
    """
    require_there(calibration, imu)
    require("--to", to, EXPORT_FORMATS)
    require_number("--max-fit-error", max_fit_error, above=0.0)
    from rigwake.exporters import FORMATS, ExportOptions, export_calibration, read_calibration
    from rigwake.exporters.basalt import read_imu_noise

    target = output or calibration.parent / "exports" / FORMATS[to].usual_file
    options = ExportOptions(
        parent_frame, child_frame, None if imu is None else read_imu_noise(imu), max_fit_error
    )
    notes = export_calibration(
        read_calibration(calibration), to, target, options, allow_unobservable=allow_unobservable
    )
    out.print(f"{target}: {FORMATS[to].what}", markup=False, highlight=False)
    for note in notes:
        out.print(f"note: {note}", style="yellow", markup=False, highlight=False)
    if _can_be_compared(calibration, target):
        next_step(
            ["rigwake", "diff", calibration, target], "compare what was written with where it came from"
        )
    else:
        as_json = ["rigwake", "export", calibration, "--to", "json", "--allow-unobservable"]
        next_step(as_json, "the same for programs of your own")


def _can_be_compared(calibration: Path, target: Path) -> bool:
    """Whether `rigwake diff` reads what was written: not every format says enough to be read back."""
    from rigwake.errors import RigwakeError
    from rigwake.evaluation.rig_errors import compare_calibrations
    from rigwake.exporters import in_common_frame, read_calibration

    try:
        a, b, _ = in_common_frame(read_calibration(calibration), read_calibration(target))
        return bool(compare_calibrations(a, b, [20.0]))
    except RigwakeError:
        return False
