"""`rigwake diff`: two calibrations, in degrees, millimetres and pixels."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from rich.table import Table

from rigwake.cli.console import next_step, out, write_json


def command(
    first: Annotated[Path, typer.Argument(help="A calibration, of any format that export writes.")],
    second: Annotated[Path, typer.Argument(help="Another one of the same rig.")],
    range_m: Annotated[
        list[float] | None, typer.Option("--range", help="Ranges in metres at which pixels are compared.")
    ] = None,
    json_file: Annotated[
        Path | None, typer.Option("--json", help="Write the differences ('-': print).")
    ] = None,
) -> None:
    """How far two calibrations are apart: has a camera been knocked, do two recordings agree?

    Example: [cyan]rigwake diff june.yaml july.yaml --range 10 --range 100[/cyan]
    """
    from rigwake.calibration.yaml_file import plain
    from rigwake.evaluate.calibrations import compare_calibrations
    from rigwake.exporters import in_common_frame, read_calibration

    ranges = range_m or [5.0, 20.0, 100.0]
    a, b, notes = in_common_frame(read_calibration(first), read_calibration(second))
    differences = compare_calibrations(a, b, ranges)
    if json_file is not None:
        content = {
            name: {
                "rotation_deg": d.rotation_deg,
                "translation_mm": d.translation_mm,
                "sigmas": d.sigmas,
                "shift_px": {f"{r:g}": {"median": m, "max": x} for r, (m, x) in d.shift_px.items()},
            }
            for name, d in differences.items()
        }
        write_json(json_file, plain({"cameras": content}))
        if str(json_file) == "-":
            return
    table = Table(title=f"{second.name} against {first.name}")
    headings = ["camera", "rotation °", "x mm", "y mm", "z mm", "sigmas", *(f"px at {r:g} m" for r in ranges)]
    for heading in headings:
        table.add_column(heading, justify="left" if heading == "camera" else "right")
    for name, d in differences.items():
        shifts = [
            f"{d.shift_px[r][0]:.2f} (max {d.shift_px[r][1]:.2f})" if r in d.shift_px else "–" for r in ranges
        ]
        sigmas = "–" if d.sigmas is None else f"{d.sigmas:.1f}"
        table.add_row(
            name, f"{d.rotation_deg:.4f}", *(f"{x:+.1f}" for x in d.translation_mm), sigmas, *shifts
        )
    out.print(table)
    for note in notes:
        out.print(f"note: {note}", style="yellow", markup=False, highlight=False)
    out.print("sigmas: root mean square difference in units of both covariances; about 1 means they agree.")
    next_step(f"rigwake export {second} --to ros-static-tf -o tf.launch.py", "load one into your system")
