"""`rigwake depth`: how far away everything around is, as a panorama of ranges."""

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
        Path, typer.Option("-o", "--out", "--output", help="Folder for ranges, pictures and point clouds.")
    ],
    at: Annotated[
        float | None, typer.Option(help="Seconds after the first picture; default: evenly spaced.")
    ] = None,
    count: Annotated[int, typer.Option(help="So many frame sets, evenly spaced, without --at.")] = 5,
    height_m: Annotated[
        float | None,
        typer.Option(help="Mean height of the cameras above the water, metres; default: estimated."),
    ] = None,
    nearest_m: Annotated[float, typer.Option(help="Nearest range that is looked for, metres.")] = 3.0,
    sweep: Annotated[
        bool,
        typer.Option(
            "--sweep", help="Match all cameras at once on spheres, instead of pair by pair: coarser."
        ),
    ] = False,
    topic: TopicOption = None,
    topics: TopicsOption = None,
    json_file: JsonOption = None,
) -> None:
    """Measure ranges all around: matched where two cameras see the same, the water plane on water.

    Example: [cyan]rigwake depth OUT sail.bag -o DEPTH --at 12[/cyan]
    """
    from rigwake.errors import UsageError
    from rigwake.readers.topics import TopicMap
    from rigwake.views.depth.depth_files import depth_to_folder

    if count < 1:
        raise UsageError(f"--count {count}: at least one frame set.")
    if not 0.5 <= nearest_m <= 50:
        raise UsageError(f"--nearest-m {nearest_m:g} is not between 0.5 and 50 metres.")
    with progress_bar() as bar:
        task = bar.add_task("reading", total=1)
        result = depth_to_folder(
            calibration,
            recording,
            output,
            at,
            count,
            height_m,
            nearest_m,
            TopicMap.from_options(topic or (), topics),
            lambda done, total: bar.update(task, completed=done, total=total, description="matching"),
            sweep,
        )
    if json_file is not None:
        write_json(json_file, result.as_dict())
    if str(json_file) != "-":
        for line in result.lines():
            out.print(line, markup=False, highlight=False, soft_wrap=True)
        next_step(f"rigwake stixels {calibration} {recording} -o STIXELS", "what stands on the water")
