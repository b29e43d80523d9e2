"""`rigwake stixels`: what stands on the water, with bearing, range and uncertainty."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from rigwake.cli.console import next_step, out, progress_bar, write_json
from rigwake.cli.options import JsonOption, TopicOption, TopicsOption


def command(
    calibration: Annotated[
        Path, typer.Argument(help="calibration.yaml (or its folder), truth.yaml or rig.yaml.")
    ],
    recording: Annotated[Path, typer.Argument(help="Recording, or a folder with one picture per camera.")],
    output: Annotated[
        Path, typer.Option("-o", "--out", "--output", help="Folder for stixels, overlays and top views.")
    ],
    height_m: Annotated[
        float | None,
        typer.Option(help="Mean height of the cameras above the water, metres; default: estimated."),
    ] = None,
    count: Annotated[int, typer.Option(help="At most so many frame sets, evenly spaced.")] = 100,
    onnx: Annotated[Path | None, typer.Option(help="Another segmentation network, as an ONNX file.")] = None,
    classes: Annotated[
        str, typer.Option(help="Output channels of --onnx in order: water, obstacle, sky, other.")
    ] = "obstacle,water,sky",
    matched: Annotated[
        bool, typer.Option("--match/--no-match", help="Use ranges matched between cameras.")
    ] = True,
    radius_m: Annotated[float, typer.Option(help="Reach of the top view, metres.")] = 40.0,
    topic: TopicOption = None,
    topics: TopicsOption = None,
    json_file: JsonOption = None,
) -> None:
    """Find what stands on the water: bearing, range and how sure it is.

    Example: [cyan]rigwake stixels OUT sail.bag -o STIXELS[/cyan]
    """
    from rigwake.errors import UsageError
    from rigwake.readers.topics import TopicMap
    from rigwake.views.scene.segment_files import SegmentChoices
    from rigwake.views.scene.stixel_files import stixels_to_folder

    if count < 1:
        raise UsageError(f"--count {count}: at least one frame set.")
    if not 1 <= radius_m <= 1000:
        raise UsageError(f"--radius-m {radius_m:g} is not between 1 and 1000 metres.")
    names = tuple(name.strip() for name in classes.split(","))
    choices = SegmentChoices(onnx=onnx, classes=names, count=count, height_m=height_m)
    with progress_bar() as bar:
        task = bar.add_task("reading", total=1)
        result = stixels_to_folder(
            calibration,
            recording,
            output,
            choices,
            matched,
            radius_m,
            TopicMap.from_options(topic or (), topics),
            lambda done, total: bar.update(task, completed=done, total=total, description="stixels"),
        )
    if json_file is not None:
        write_json(json_file, result.as_dict())
    if str(json_file) != "-":
        for line in result.lines():
            out.print(line, markup=False, highlight=False, soft_wrap=True)
        next_step(
            f"rigwake surround {calibration} {recording} -o OUT --surface stixels", "views drawn on them"
        )
