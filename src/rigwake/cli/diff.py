"""`rigwake diff`: two calibrations, in degrees, millimetres and pixels."""

from __future__ import annotations

from collections.abc import Sequence
from math import isfinite
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.markup import escape

from rigwake.cli.console import figures_table, next_step, out, print_title, write_json
from rigwake.cli.options import HtmlOption, JsonOption, require_number, require_there, require_writable

if TYPE_CHECKING:
    from rigwake.evaluation.rig_errors import CameraDifference


_SAME_PX, _SAME_MS = 1e-3, 1e-4


def command(
    first: Annotated[Path, typer.Argument(help="A calibration, of any format that export writes.")],
    second: Annotated[Path, typer.Argument(help="Another one of the same rig.")],
    range_m: Annotated[
        list[float] | None, typer.Option("--range", help="Ranges in metres at which pixels are compared.")
    ] = None,
    json_file: JsonOption = None,
    html: HtmlOption = None,
) -> None:
    """How far two calibrations are apart: has a camera been knocked, do two recordings agree?

    Example: [cyan]rigwake diff june.yaml july.yaml --range 10 --range 100[/cyan]
    """
    require_there(first, second)
    for value in range_m or ():
        require_number("--range", value, above=0.0)
    require_writable("--json", json_file)
    require_writable("--html", html)
    from rigwake.calibration.yaml_file import plain
    from rigwake.evaluation.rig_errors import compare_calibrations
    from rigwake.exporters import in_common_frame, read_calibration

    ranges = range_m or [5.0, 20.0, 100.0]
    a, b, notes = in_common_frame(read_calibration(first), read_calibration(second))
    differences = compare_calibrations(a, b, ranges)
    if html is not None:
        from rigwake.atomic import write_text_atomic
        from rigwake.report.diff_page import diff_page

        write_text_atomic(html, diff_page(a, b, differences, ranges, (first.name, second.name), notes))
    if json_file is not None:
        write_json(json_file, plain({"cameras": {name: d.to_json() for name, d in differences.items()}}))
        if str(json_file) == "-":
            return
    _print(differences, ranges, f"{second.name} against {first.name}")
    for note in notes:
        out.print(f"note: {note}", style="yellow", markup=False, highlight=False)
    next_step(["rigwake", "export", second, "--to", "csv", "--allow-unobservable"], "one of them as a table")


def _print(differences: dict[str, CameraDifference], ranges_m: Sequence[float], title: str) -> None:
    """How the cameras moved, then what that does to their pixels."""
    moved = figures_table(("camera", "rotation °", "x mm", "y mm", "z mm", "sigmas"))
    at_ranges = [f"at {r:g} m" for r in ranges_m]
    pixels = figures_table(("camera", *at_ranges))
    for name, d in differences.items():
        sigmas = "–" if d.sigmas is None else f"{d.sigmas:.1f}"
        moved.add_row(
            escape(name),
            *(
                f"{v:{form}}" if isfinite(v) else "–"
                for v, form in zip(
                    (d.rotation_deg, *d.translation_mm), (".4f", "+.1f", "+.1f", "+.1f"), strict=True
                )
            ),
            sigmas,
        )
        shifts = [d.shift_px.get(r) for r in ranges_m]
        pixels.add_row(escape(name), *("–" if s is None else f"{s[0]:.2f} / {s[1]:.2f}" for s in shifts))
    print_title(title)
    out.print(moved)
    if any(d.sigmas is not None for d in differences.values()):
        out.print("[dim]sigmas: the difference in units of both covariances; about 1: they agree[/dim]")
    if any(d.shift_px for d in differences.values()):
        print_title("shift of a point, px: median / largest over the image")
        out.print(pixels)
    _print_lenses_and_clocks(differences)


def _print_lenses_and_clocks(differences: dict[str, CameraDifference]) -> None:
    """What the lenses and time offsets differ by; one line where they are the same."""
    table = figures_table(("camera", "lens px", "offset ms"))
    for name, d in differences.items():
        lens = "–" if d.lens_px is None else f"{d.lens_px[0]:.2f} / {d.lens_px[1]:.2f}"
        if d.sizes_px is not None:
            lens = "{}x{} / {}x{}".format(*d.sizes_px)
        table.add_row(escape(name), lens, "–" if d.time_offset_ms is None else f"{d.time_offset_ms:+.3f}")
    compared = [
        d for d in differences.values() if (d.lens_px, d.sizes_px, d.time_offset_ms) != (None, None, None)
    ]
    if not compared:
        return
    same = all(
        (d.lens_px is None or d.lens_px[1] < _SAME_PX)
        and d.sizes_px is None
        and abs(d.time_offset_ms or 0.0) < _SAME_MS
        for d in compared
    )
    if same:
        out.print("[dim]lenses and time offsets, where both files hold them, are the same[/dim]")
        return
    print_title("lenses (px over the image: median / largest; or image sizes) and time offsets differ")
    out.print(table)
