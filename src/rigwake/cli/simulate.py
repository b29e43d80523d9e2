"""`rigwake simulate [SCENARIO] -o REC`: a recording of a harbour whose truth is known."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Annotated

import typer
from rich.markup import escape

from rigwake.cli.console import next_step, out, progress_bar
from rigwake.cli.options import PRESETS, completed_from, require_number, require_writable
from rigwake.extras import require_extra
from rigwake.simulation.recording_target import require_recording_target


def command(
    scenario: Annotated[
        str,
        typer.Argument(
            help=f"A scenario file, or a preset: {', '.join(PRESETS)}.",
            autocompletion=completed_from(PRESETS),
        ),
    ] = "demo",
    output: Annotated[
        Path | None,
        typer.Option("-o", "--out", "--output", help="REC.bag (ROS 1), REC.mcap (ROS 2) or a folder."),
    ] = None,
    duration: Annotated[float | None, typer.Option(help="Seconds, instead of the scenario's.")] = None,
    seed: Annotated[
        int | None, typer.Option(help="Another draw of sea, noise and (unless fixed) scene.")
    ] = None,
    workers: Annotated[
        int, typer.Option("--jobs", "--workers", min=1, help="Frames rendered at a time.")
    ] = os.cpu_count() or 1,
    truth_images: Annotated[
        bool, typer.Option("--truth-images", help="Also label and range images of every frame.")
    ] = False,
    show: Annotated[bool, typer.Option(help="Print the scenario as YAML and stop.")] = False,
) -> None:
    """Simulate a recording of any rig on a boat in a harbour, with its truth in REC_truth/.

    Example: [cyan]rigwake simulate demo -o harbour.bag[/cyan]

    Example: [cyan]rigwake simulate ferry --show > mine.yaml; rigwake simulate mine.yaml -o mine.mcap[/cyan]
    """
    require_number("--duration", duration, above=0.0)
    if not show:
        require_recording_target(output)
        require_writable("-o", output, folder=output is not None and output.suffix == "")
    from rigwake.simulation.scenario import changed_scenario, load_scenario

    chosen = changed_scenario(load_scenario(scenario), duration, seed)
    if show:
        import yaml

        print(yaml.safe_dump(chosen.model_dump(mode="json", exclude_none=True), sort_keys=False), end="")
        return
    assert output is not None
    require_extra("embreex", "sim", "The simulator")
    truth_folder = output.parent / f"{output.stem}_truth"
    from rigwake.simulation.write_simulation import write_simulation

    with progress_bar() as bar:
        task = bar.add_task("building the scene (compiles the first time)", total=1)
        recording, findings = write_simulation(
            chosen,
            output,
            workers=workers,
            truth_images=truth_images,
            progress=lambda text, done, total: bar.update(
                task, description=escape(text), completed=done, total=total
            ),
        )
    frames = sum(len(camera) for camera in recording.cameras.values())
    out.print(
        f"{escape(str(output))}: {len(recording.cameras)} cameras, {frames} frames, {chosen.duration_s:g} s."
    )
    out.print(f"{escape(str(truth_folder))}: truth.yaml and true trajectories.")
    for finding in findings:
        out.print(f"[dim]{escape(finding.sensor)}: {escape(finding.message)}[/dim]")
    next_step(["rigwake", "inspect", output], "see what was recorded")
