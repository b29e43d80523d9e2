"""A simulated recording and its truth as files."""

from __future__ import annotations

import shutil
from pathlib import Path

from rigwake._progress import CountProgress
from rigwake.recording import Finding, Recording
from rigwake.simulation.record import build_world, render_recording, work_folder
from rigwake.simulation.scenario import Scenario
from rigwake.simulation.setup import prepare
from rigwake.simulation.truth_writer import write_truth, write_truth_images
from rigwake.writers.write import write_recording


def write_simulation(
    scenario: Scenario, output: Path, *, workers: int, truth_images: bool, progress: CountProgress
) -> tuple[Recording, tuple[Finding, ...]]:
    """Render and write everything, the truth into `output`_truth/; what was rendered survives an interruption."""
    simulation = prepare(scenario)
    work = work_folder(output, scenario)
    truth_folder = output.parent / f"{output.stem}_truth"
    scenery, renderer = build_world(simulation)
    recording = render_recording(simulation, renderer, work, workers=workers, progress=progress)
    progress("writing", 0, 1)
    findings = write_recording(recording, output)
    write_truth(simulation, scenery.known_points_world, truth_folder)
    if truth_images:
        write_truth_images(simulation, renderer, truth_folder, progress)
    shutil.rmtree(work)
    return recording, findings
