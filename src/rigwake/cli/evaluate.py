"""`rigwake evaluate`: a calibration against a known rig."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer
from rich.table import Table

from rigwake.cli.console import next_step, out, write_json
from rigwake.errors import UsageError


def command(
    calibration: Annotated[Path, typer.Argument(help="A calibration, of any format that export writes.")],
    truth: Annotated[
        Path, typer.Option("--truth", help="The known rig: a truth.yaml or another calibration.yaml.")
    ],
    gauge: Annotated[
        str,
        typer.Option(
            help="`reference`: in the reference frame; `align`: after fitting the whole rig to the truth."
        ),
    ] = "reference",
    json_file: Annotated[
        Path | None, typer.Option("--json", help="Write the errors to this file ('-': print).")
    ] = None,
) -> None:
    """Errors of a calibration against a known rig: degrees, metres, and how many of its own sigmas.

    Example: [cyan]rigwake evaluate OUT/calibration.yaml --truth truth.yaml --json errors.json[/cyan]
    """
    from rigwake.evaluate.calibrations import evaluate_calibration
    from rigwake.exporters import UNNAMED_FRAMES, read_calibration
    from rigwake.readers.truth import read_true_rig, rig_in_frame

    if gauge not in ("reference", "align"):
        raise UsageError(f"--gauge {gauge!r} is unknown.", remedy="Choose reference or align.")
    found = read_calibration(calibration)
    rig = read_true_rig(truth)
    if found.reference in UNNAMED_FRAMES:
        found = replace(found, reference=rig.reference)
    errors = evaluate_calibration(
        found,
        rig_in_frame(rig, found.reference) if gauge == "reference" else rig,
        gauge="align" if gauge == "align" else "reference",
    )
    if json_file is not None:
        write_json(json_file, errors.to_json())
        if str(json_file) == "-":
            return
    table = Table(title=f"errors of {calibration.name}, cameras in {found.reference}")
    for heading in ("camera", "rotation °", "x m", "y m", "z m", "norm m", "NEES (axes)", "clock ms"):
        table.add_column(heading, justify="left" if heading == "camera" else "right")
    for name, e in errors.cameras.items():
        offset = "–" if e.time_offset_error_s is None else f"{1e3 * e.time_offset_error_s:+.2f}"
        nees = "–" if e.nees is None else f"{e.nees:.1f} ({e.nees_dof})"
        numbers = [f"{x:+.4f}" for x in e.translation_error_m]
        table.add_row(
            name, f"{e.rotation_error_deg:.4f}", *numbers, f"{e.translation_error_norm_m:.4f}", nees, offset
        )
    out.print(table)
    if errors.pairs:
        worst_turn = max(errors.pairs, key=lambda p: p.rotation_error_deg)
        worst_shift = max(errors.pairs, key=lambda p: p.translation_error_m)
        out.print(
            f"camera to camera, worst pair: {worst_turn.rotation_error_deg:.4f}° "
            f"({worst_turn.first}–{worst_turn.second}), {worst_shift.translation_error_m:.4f} m "
            f"({worst_shift.first}–{worst_shift.second})"
        )
    next_step(f"rigwake diff {calibration} OTHER.yaml", "compare with another calibration")
