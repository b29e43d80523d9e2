"""`rigwake report`: the HTML page of a calibration, and figures for papers."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from rigwake.cli.console import next_step, out
from rigwake.cli.options import completed_from, require, require_there, require_writable
from rigwake.extras import require_extra


def command(
    folder: Annotated[Path, typer.Argument(help="The folder that `rigwake calibrate -o` wrote.")],
    open_page: Annotated[bool, typer.Option("--open", help="Open the page in the browser.")] = False,
    figures: Annotated[
        Path | None, typer.Option(help="Also write figures for papers to this folder.")
    ] = None,
    figure_format: Annotated[
        str, typer.Option(help="png or svg.", autocompletion=completed_from(("png", "svg")))
    ] = "png",
    rrd: Annotated[
        Path | None, typer.Option(help="Also write a recording for the rerun viewer (extra `rerun`).")
    ] = None,
    view: Annotated[
        bool, typer.Option("--view", help="Show it in the rerun viewer (extra `rerun`).")
    ] = False,
) -> None:
    """Rebuild the report of a calibration: one HTML file that needs no network.

    Example: [cyan]rigwake report OUT --open[/cyan]
    """
    require_there(folder)
    require("--figure-format", figure_format, ("png", "svg"))
    require_writable("--figures", figures, folder=True)
    require_writable("--rrd", rrd)
    from rigwake.report import build_report, load_report_content, summary_lines

    content = load_report_content(folder)
    path = build_report(content)
    for line in summary_lines(content.calibration):
        out.print(line, markup=False, highlight=False, soft_wrap=True)
    out.print(f"\n{path}: {path.stat().st_size / 1e6:.1f} MB", markup=False, highlight=False)
    if figures is not None:
        require_extra("matplotlib", "report", "Writing figures")
        from rigwake.report.figures import write_figures

        for file in write_figures(content, figures, figure_format):
            out.print(str(file), markup=False, highlight=False)
    if rrd is not None or view:
        from rigwake.report.rerun_log import log_to_rerun

        log_to_rerun(content, rrd, view)
    if open_page:
        import webbrowser

        webbrowser.open(path.resolve().as_uri())
    words: list[object] = ["rigwake", "export", folder / "calibration.yaml", "--to", "ros-static-tf"]
    observable = [camera.is_observable for camera in content.calibration.cameras.values()]
    if not any(observable):
        words[-1:] = ["json"]
    elif not all(observable):
        words.append("--allow-unobservable")
    next_step(words, "load it into your system")
