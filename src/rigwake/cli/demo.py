"""`rigwake demo`: simulate, calibrate, evaluate, draw the surround view and report, out of the box."""

from __future__ import annotations

from contextlib import nullcontext
from pathlib import Path
from typing import Annotated

import typer

from rigwake.cli.console import next_step, out
from rigwake.cli.options import require_writable


def command(
    folder: Annotated[
        Path, typer.Option("-o", "--out", "--output", help="Folder for the recording and the result.")
    ] = Path("demo"),
) -> None:
    """Simulate a harbour recording, calibrate it, compare with the truth, draw its seamless view, write the report.

    The recording is kept: a second run calibrates it again.

    Example: [cyan]rigwake demo -o demo[/cyan]
    """
    from rigwake.cli import calibrate, evaluate, report, simulate, surround
    from rigwake.pipeline.kernel_warmup import compile_handeye, handeye_is_compiled
    from rigwake.workers import in_background

    require_writable("-o", folder, folder=True)

    recording, result = folder / "harbour.bag", folder / "result"
    if recording.exists():
        out.print(f"{recording} is there already: not simulated again.")
    else:
        folder.mkdir(parents=True, exist_ok=True)
        # the renderer begins on one core
        with nullcontext() if handeye_is_compiled() else in_background(compile_handeye):
            simulate.command("demo", output=recording)
    calibrate.command(recording, result, force=True)
    evaluate.command(result / "calibration.yaml", folder / "harbour_truth" / "truth.yaml")
    surround.command(result / "calibration.yaml", recording, output=result / "surround", radius_m=20.0)
    report.command(result)
    next_step(
        ["rigwake", "report", result, "--open"], "then calibrate your own: rigwake calibrate REC -o OUT"
    )
