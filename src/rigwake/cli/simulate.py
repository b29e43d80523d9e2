"""`rigwake simulate [SCENARIO] -o REC`: a recording of a harbour whose truth is known."""

from __future__ import annotations

import os
import shutil
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.markup import escape

from rigwake.cli.console import next_step, out, progress_bar
from rigwake.cli.options import PRESETS, completed_from, require_number, require_writable
from rigwake.errors import UsageError

if TYPE_CHECKING:
    from rigwake.recording import Finding, Recording
    from rigwake.simulation.scenario import Scenario


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
        _check_target(output)
    from rigwake.simulation.scenario import load_scenario

    chosen = _changed(load_scenario(scenario), duration, seed)
    if show:
        import yaml

        print(yaml.safe_dump(chosen.model_dump(mode="json", exclude_none=True), sort_keys=False), end="")
        return
    assert output is not None
    truth_folder = output.parent / f"{output.stem}_truth"
    recording, findings = _record(chosen, output, truth_folder, workers, truth_images)
    frames = sum(len(camera) for camera in recording.cameras.values())
    out.print(
        f"{escape(str(output))}: {len(recording.cameras)} cameras, {frames} frames, {chosen.duration_s:g} s."
    )
    out.print(f"{escape(str(truth_folder))}: truth.yaml and true trajectories.")
    for finding in findings:
        out.print(f"[dim]{escape(finding.sensor)}: {escape(finding.message)}[/dim]")
    next_step(["rigwake", "inspect", output], "see what was recorded")


_SUFFIXES = (".bag", ".mcap", "")  # others are more likely a slip than the name of a folder


def _check_target(output: Path | None) -> None:
    """Raises UsageError for a recording that could not be written after it was rendered."""
    if output is None:
        raise UsageError("Where to? -o names the recording.", remedy="For example: -o harbour.bag")
    if os.path.lexists(output):
        raise UsageError(f"{output} is already there.", remedy="Remove it, or choose another name.")
    if output.suffix not in _SUFFIXES:
        raise UsageError(
            f"-o {output}: no recording has the suffix {output.suffix}.",
            remedy=f"-o {output.stem}.bag (ROS 1), {output.stem}.mcap (ROS 2), or {output.stem} (a folder).",
        )
    require_writable("-o", output, folder=output.suffix == "")


def _record(
    scenario: Scenario, output: Path, truth_folder: Path, workers: int, truth_images: bool
) -> tuple[Recording, tuple[Finding, ...]]:
    """Render and write everything, with a progress bar; what was rendered survives an interruption."""
    from rigwake.simulation.record import build_world, render_recording, work_folder
    from rigwake.simulation.setup import prepare
    from rigwake.simulation.truth_writer import write_truth, write_truth_images
    from rigwake.writers.write import write_recording

    simulation = prepare(scenario)
    work = work_folder(output, scenario)
    with progress_bar() as bar:
        task = bar.add_task("building the scene (compiles the first time)", total=1)

        def show_progress(text: str, done: int, total: int) -> None:
            bar.update(task, description=escape(text), completed=done, total=total)

        scenery, renderer = build_world(simulation)
        recording = render_recording(simulation, renderer, work, workers=workers, progress=show_progress)
        show_progress("writing", 0, 1)
        findings = write_recording(recording, output)
        write_truth(simulation, scenery.known_points_world, truth_folder)
        if truth_images:
            write_truth_images(simulation, renderer, truth_folder, show_progress)
    shutil.rmtree(work)
    return recording, findings


def _changed(scenario: Scenario, duration: float | None, seed: int | None) -> Scenario:
    from rigwake.simulation.scenario import build_scenario

    changes = {"duration_s": duration, "seed": seed}
    given = {key: value for key, value in changes.items() if value is not None}
    return build_scenario(scenario.model_dump() | given, scenario.name) if given else scenario
