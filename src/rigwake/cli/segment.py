"""`rigwake segment`: water, obstacle and sky in the pictures of a recording, or in any pictures."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from rigwake.cli.console import next_step, out, progress_bar, write_json
from rigwake.cli.options import JsonOption, TopicOption, TopicsOption, require


def command(
    source: Annotated[Path, typer.Argument(help="Recording, folder of pictures, or a picture.")],
    output: Annotated[Path, typer.Option("-o", "--out", "--output", help="Folder for labels and overlays.")],
    calibration: Annotated[
        Path | None,
        typer.Option(help="Calibration of the rig: all cameras in one level strip, smoothed over time."),
    ] = None,
    method: Annotated[str, typer.Option(help="network or colour.")] = "network",
    onnx: Annotated[Path | None, typer.Option(help="Another network, as an ONNX file.")] = None,
    classes: Annotated[
        str, typer.Option(help="Output channels of --onnx in order: water, obstacle, sky, other.")
    ] = "obstacle,water,sky",
    count: Annotated[int, typer.Option(help="At most so many pictures, evenly spaced.")] = 200,
    measure: Annotated[
        Path | None,
        typer.Option(
            help="Folder of label pictures (PNG, same names; 0 water, 1 obstacle, 2 sky, 255 not scored)."
        ),
    ] = None,
    horizon_row: Annotated[
        float | None, typer.Option(help="Row of the horizon, for --measure on plain pictures.")
    ] = None,
    field_deg: Annotated[
        float, typer.Option(help="Field of view across, degrees, for --measure on plain pictures.")
    ] = 60.0,
    height_m: Annotated[
        float | None, typer.Option(help="Height of the cameras above the water, metres.")
    ] = None,
    topic: TopicOption = None,
    topics: TopicsOption = None,
    json_file: JsonOption = None,
) -> None:
    """Tell water, what stands in it, and sky apart.

    Example: [cyan]rigwake segment sail.bag --calibration OUT -o LABELS[/cyan]

    Example: [cyan]rigwake segment pictures/ -o LABELS[/cyan]
    """
    from rigwake.errors import UsageError
    from rigwake.readers.topics import TopicMap
    from rigwake.views.scene.segment_files import SegmentChoices, segment_to_folder

    require("--method", method, ("network", "colour"))
    if count < 1:
        raise UsageError(f"--count {count}: at least one picture.")
    if not 1 <= field_deg <= 180:
        raise UsageError(f"--field-deg {field_deg:g} is not between 1 and 180.")
    if onnx is not None and method == "colour":
        raise UsageError("--onnx and --method colour contradict each other.", remedy="Leave one out.")
    names = tuple(name.strip() for name in classes.split(","))
    choices = SegmentChoices(method, onnx, names, count, measure, horizon_row, field_deg, height_m)
    with progress_bar() as bar:
        task = bar.add_task("reading", total=1)
        result = segment_to_folder(
            source,
            output,
            calibration,
            choices,
            TopicMap.from_options(topic or (), topics),
            lambda done, total: bar.update(task, completed=done, total=total, description="segmenting"),
        )
    if json_file is not None:
        write_json(json_file, result.as_dict())
    if str(json_file) != "-":
        for line in result.lines():
            out.print(line, markup=False, highlight=False, soft_wrap=True)
        if calibration is not None:
            next_step(
                f"rigwake stixels {calibration} {source} -o {output}", "obstacles with bearing and range"
            )
