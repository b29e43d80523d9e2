"""`rigwake evaluate`: a calibration against a known rig, or a trajectory against a known one."""

from __future__ import annotations

from math import isfinite
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, cast

import typer
from rich.markup import escape

from rigwake.cli.console import figures_table, next_step, out, print_title, write_json
from rigwake.cli.options import (
    JsonOption,
    completed_from,
    require,
    require_number,
    require_there,
    require_writable,
)
from rigwake.errors import UsageError

if TYPE_CHECKING:
    from rigwake.evaluation.rig_errors import RigErrors

_ALIGNMENTS = ("auto", "se3", "sim3", "none")


def command(
    calibration: Annotated[
        Path, typer.Argument(help="A calibration of any format that export writes, or a trajectory.")
    ],
    truth: Annotated[
        Path, typer.Option("--truth", help="The known rig (truth.yaml, any calibration) or trajectory.")
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
    alignment: Annotated[
        str,
        typer.Option(
            help="Trajectories: fitted before the comparison: `se3`, `sim3` (with scale), `none`; `auto`: as metric.",
            autocompletion=completed_from(_ALIGNMENTS),
        ),
    ] = "auto",
    max_difference: Annotated[
        float, typer.Option(help="Trajectories: stamps so many seconds apart belong together.")
    ] = 0.01,
    html: Annotated[Path | None, typer.Option(help="Trajectories: write one HTML page with plots.")] = None,
    json_file: JsonOption = None,
) -> None:
    """Errors of a calibration against a known rig: degrees, metres, and how many of its own sigmas.

    Of a trajectory against a known one: ATE, RPE and KITTI's errors.

    Example: [cyan]rigwake evaluate OUT/calibration.yaml --truth truth.yaml --json errors.json[/cyan]

    Example: [cyan]rigwake evaluate found.tum --truth truth.tum --html page.html[/cyan]
    """
    require_there(calibration, truth)
    require("--gauge", gauge, ("reference", "align"))
    require("--alignment", alignment, _ALIGNMENTS)
    require_number("--max-difference", max_difference, above=0.0)
    require_writable("--json", json_file)
    require_writable("--html", html)
    from rigwake.exporters.known_rig_errors import evaluate_against, is_trajectory_file

    if is_trajectory_file(calibration):
        _evaluate_trajectory(calibration, truth, frame, alignment, max_difference, html, json_file)
        return
    if html is not None:
        raise UsageError(
            "--html is for trajectories.", remedy="`rigwake report` makes the page of a calibration."
        )
    from rigwake.exporters import read_calibration
    from rigwake.exporters.known_rigs import read_known_rig, rig_in_house_frames

    found = read_calibration(calibration)
    rig = rig_in_house_frames(read_known_rig(truth), frame)
    found, errors = evaluate_against(found, rig, gauge="align" if gauge == "align" else "reference")
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


def _evaluate_trajectory(
    found: Path,
    truth: Path,
    frame: str,
    alignment: str,
    max_difference_s: float,
    html: Path | None,
    json_file: Path | None,
) -> None:
    from rigwake.atomic import write_text_atomic
    from rigwake.evaluation.trajectory_evaluation import evaluate_trajectory, usual_alignment
    from rigwake.geometry.align import AlignmentKind
    from rigwake.readers.trajectories import read_trajectory
    from rigwake.report.trajectory_page import figures_in_words, trajectory_page

    estimate = read_trajectory(found).trajectory
    known = read_trajectory(truth, frame=frame).trajectory
    fitted = usual_alignment(estimate) if alignment == "auto" else alignment
    evaluation = evaluate_trajectory(
        known,
        estimate,
        alignment=None if fitted == "none" else cast(AlignmentKind, fitted),
        max_difference_s=max_difference_s,
    )
    if html is not None:
        write_text_atomic(html, trajectory_page(evaluation, found.name, truth.name))
    if json_file is not None:
        write_json(json_file, evaluation.to_json())
        if str(json_file) == "-":
            return
    table = figures_table(("figure", "value"))
    for what, value in figures_in_words(evaluation):
        table.add_row(what, value)
    print_title(f"errors of {found.name} against {truth.name}")
    out.print(table)
    if html is not None:
        out.print(f"written: {html}", markup=False, highlight=False)
    else:
        again = ["rigwake", "evaluate", found, "--truth", truth, "--frame", frame, "--alignment", alignment]
        next_step([*again, "--max-difference", max_difference_s, "--html", "errors.html"], "see where")


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
