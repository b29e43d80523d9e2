"""`rigwake evaluate`: a calibration against a known rig."""

from __future__ import annotations

from dataclasses import replace
from math import isfinite
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.markup import escape

from rigwake.cli.console import figures_table, next_step, out, print_title, write_json
from rigwake.cli.options import JsonOption, completed_from, require, require_there, require_writable

if TYPE_CHECKING:
    from rigwake.evaluation.rig_errors import RigErrors
    from rigwake.rig import Rig


def command(
    calibration: Annotated[Path, typer.Argument(help="A calibration, of any format that export writes.")],
    truth: Annotated[
        Path, typer.Option("--truth", help="The known rig: a truth.yaml, or a calibration of any format.")
    ],
    gauge: Annotated[
        str,
        typer.Option(
            help="`reference`: in the reference frame; `align`: after fitting the whole rig to the truth.",
            autocompletion=completed_from(("reference", "align")),
        ),
    ] = "reference",
    frame: Annotated[
        str,
        typer.Option(
            help="What the transforms of the truth mean: `enu` (rig_from_cam, as it stands), `inverse`, `ned` "
            "(the rig's axes are forward-right-down), `left-handed`."
        ),
    ] = "enu",
    json_file: JsonOption = None,
) -> None:
    """Errors of a calibration against a known rig: degrees, metres, and how many of its own sigmas.

    Example: [cyan]rigwake evaluate OUT/calibration.yaml --truth truth.yaml --json errors.json[/cyan]
    """
    require_there(calibration, truth)
    require("--gauge", gauge, ("reference", "align"))
    require_writable("--json", json_file)
    from rigwake.evaluation.rig_errors import evaluate_calibration
    from rigwake.exporters import UNNAMED_FRAMES, read_calibration
    from rigwake.exporters.export_base import refer_to_camera
    from rigwake.exporters.known_rigs import read_known_rig, rig_in_house_frames
    from rigwake.readers.truth_files import rig_in_frame

    found = read_calibration(calibration)
    rig = rig_in_house_frames(read_known_rig(truth), frame)
    if found.reference in UNNAMED_FRAMES:
        found = replace(found, reference=rig.reference)
    elif rig.reference in UNNAMED_FRAMES:
        rig = replace(rig, reference=found.reference)
    elif gauge == "reference" and rig.reference in found.cameras and not _knows(rig, found.reference):
        found = refer_to_camera(found, rig.reference)
    errors = evaluate_calibration(
        found,
        rig_in_frame(rig, found.reference) if gauge == "reference" else rig,
        gauge="align" if gauge == "align" else "reference",
    )
    if json_file is not None:
        write_json(json_file, errors.to_json())
        if str(json_file) == "-":
            return
    _print(errors, f"errors of {calibration.name}, cameras in {found.reference}")
    if (calibration.parent / "report.html").is_file():
        next_step(["rigwake", "report", calibration.parent, "--open"], "look where the errors come from")
    else:
        next_step(
            ["rigwake", "diff", calibration, calibration], "compare calibrations: give another as the second"
        )


def _knows(rig: Rig, frame: str) -> bool:
    return frame == rig.reference or frame in rig.cameras or (frame == "imu" and rig.rig_from_imu is not None)


def _print(errors: RigErrors, title: str) -> None:
    """Errors per camera, and the worst pair of cameras."""
    headings = ("camera", "rotation °", "x mm", "y mm", "z mm", "norm mm", "NEES (axes)", "offset ms")
    table = figures_table(headings)
    for name, e in errors.cameras.items():
        offset = "–" if e.time_offset_error_s is None else f"{1e3 * e.time_offset_error_s:+.2f}"
        nees = "–" if e.nees is None else f"{e.nees:.1f} ({e.nees_dof})"
        table.add_row(
            escape(name),
            _figure(e.rotation_error_deg, ".4f"),
            *(_figure(1e3 * x, "+.1f") for x in e.translation_error_m),
            _figure(1e3 * e.translation_error_norm_m, ".1f"),
            nees,
            offset,
        )
    print_title(title)
    out.print(table)
    if errors.pairs:
        worst_turn = max(errors.pairs, key=lambda p: p.rotation_error_deg)
        worst_shift = max(errors.pairs, key=lambda p: p.translation_error_m)
        out.print(
            f"camera to camera, worst pair: {_figure(worst_turn.rotation_error_deg, '.4f')}° "
            f"({worst_turn.first}–{worst_turn.second}), {_figure(1e3 * worst_shift.translation_error_m, '.1f')} mm "
            f"({worst_shift.first}–{worst_shift.second})",
            markup=False,
        )


def _figure(value: float, form: str) -> str:
    return f"{value:{form}}" if isfinite(value) else "–"
