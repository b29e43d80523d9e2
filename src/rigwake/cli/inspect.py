"""`rigwake inspect REC`: what is in a recording, and is it enough to calibrate?"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.markup import escape
from rich.table import Table

from rigwake.atomic import write_text_atomic
from rigwake.cli.console import figures_table, next_step, out, progress_bar, write_json
from rigwake.cli.options import (
    CameraFileOption,
    HtmlOption,
    JsonOption,
    TopicOption,
    TopicsOption,
    require_there,
    require_writable,
    topic_words,
)

if TYPE_CHECKING:
    from rigwake.inspection.readiness import Readiness
    from rigwake.inspection.recording_inspection import Inspection
    from rigwake.inspection.time_offsets import SensorTimeOffset
    from rigwake.sections.section_plan import SectionPlan

_COLOURS = {"enough": "green", "partly": "yellow", "not enough": "red"}
_SEVERITIES = {"note": "dim", "warning": "yellow", "error": "red"}
_MARKS = {True: "[green]yes[/green]", False: "[red]no[/red]", None: "[yellow]cannot tell[/yellow]"}


def command(
    recording: Annotated[
        Path, typer.Argument(help="ROS bag, MCAP, EuRoC or KITTI folder, folder of images, NMEA log.")
    ],
    topic: TopicOption = None,
    topics: TopicsOption = None,
    camera_file: CameraFileOption = None,
    json_file: JsonOption = None,
    html: HtmlOption = None,
) -> None:
    """Sensors, rates, gaps, clocks and motion of a recording: is it enough to calibrate?

    Example: [cyan]rigwake inspect sail.bag[/cyan]

    Example: [cyan]rigwake inspect images/ --topic imu=imu.csv --html inspection.html[/cyan]
    """
    require_there(recording, topics)
    require_writable("--json", json_file)
    require_writable("--html", html)
    from rigwake.config import CalibrateConfig
    from rigwake.inspection.inspection_summary import inspection_to_dict
    from rigwake.pipeline.checked_inspection import inspect_with_checks
    from rigwake.pipeline.section_stage import planned_sections
    from rigwake.plausibility.values import checks_to_list
    from rigwake.readers.open import open_recording
    from rigwake.readers.topics import TopicMap
    from rigwake.report.inspection_page import inspection_page
    from rigwake.sections.section_words import plan_to_dict, told_over_time

    opened = open_recording(recording, TopicMap.from_options(topic or (), topics, camera_file or ()))
    with progress_bar() as bar:
        task = bar.add_task("reading", total=1)
        inspection, verdict, checks = inspect_with_checks(
            opened,
            lambda text, done, total: bar.update(task, description=escape(text), completed=done, total=total),
        )
        plan = planned_sections(
            opened,
            CalibrateConfig(),
            lambda text, done, total: bar.update(task, description=escape(text), completed=done, total=total),
        )
    wrong = [check for check in checks if not check.agrees]
    if json_file is not None:
        sections = {"unknown": plan} if isinstance(plan, str) else plan_to_dict(plan)
        content = inspection_to_dict(inspection, verdict)
        write_json(json_file, content | {"sensor_checks": checks_to_list(checks), "sections": sections})
    if html is not None:
        told = None if isinstance(plan, str) else told_over_time(plan)
        write_text_atomic(html, inspection_page(inspection, verdict, told))
    if str(json_file) != "-":
        _print(inspection, verdict)
        if not isinstance(plan, str):
            _print_plan(plan)
        given = topic_words(topic, topics)
        if verdict.word != "not enough":
            next_step(["rigwake", "calibrate", recording, *given, "-o", "OUT"], "estimate the rig")
        elif any(check.name == "intrinsics" and check.passed is False for check in verdict.checks):
            next_step(["rigwake", "intrinsics", "--help"], "how to find the intrinsics of a lens")
        else:
            page = ["--html", "inspection.html"]
            next_step(["rigwake", "inspect", recording, *given, *page], "see why, then record as advised")
    if wrong:
        raise typer.Exit(1)


def _print(inspection: Inspection, verdict: Readiness) -> None:
    recording = inspection.recording
    out.print(f"[bold]{escape(recording.path.name)}[/bold]  {escape(recording.kind)}")
    out.print(_sensor_table(inspection))
    for key in inspection.timings:
        if what := _what(inspection, key):
            out.print(f"[dim]{escape(key)}: {escape(what)}[/dim]")
    checks = Table("check", "measured", "enough", box=None, pad_edge=False)
    for check in verdict.checks:
        checks.add_row(check.name, escape(check.measured), _MARKS[check.passed])
    out.print(checks)
    for finding in inspection.findings:
        colour = _SEVERITIES.get(finding.severity, "dim")
        out.print(
            f"[{colour}]{finding.severity}[/{colour}] {escape(finding.sensor)}: {escape(finding.message)}",
            soft_wrap=True,
        )
    out.print(f"\n[bold {_COLOURS[verdict.word]}]{escape(verdict.summary)}[/]")
    for line in verdict.advice:
        out.print(f"  → {escape(line)}", soft_wrap=True)


def _print_plan(plan: SectionPlan) -> None:
    """Information over time, what `calibrate` would use, what that predicts, and what it costs."""
    from rigwake.sections.section_words import (
        choice_words,
        duration_words,
        information_line,
        sigma_words,
    )

    out.print(f"\ninformation over time  [cyan]{information_line(plan)}[/cyan]", soft_wrap=True)
    out.print(escape(choice_words(plan)), soft_wrap=True)
    for name, sigmas in plan.choice.predicted.items():
        of_all = "" if plan.is_all else f"  [dim](all of it: {sigma_words(plan.choice.whole[name])})[/dim]"
        out.print(f"  {escape(name)}: predicted sigmas {sigma_words(sigmas)}{of_all}", soft_wrap=True)
    takes = duration_words(plan.cost.total_s)
    of_all = "" if plan.is_all else f"; all of the recording about {duration_words(plan.whole_cost.total_s)}"
    out.print(f"calibrating this takes about {takes} of CPU time{of_all}", soft_wrap=True)


def _sensor_table(inspection: Inspection) -> Table:
    heads = ("sensor", "samples", "s", "Hz", "jitter ms", "missing", "clock to IMU")
    table = figures_table(heads)
    for key, t in inspection.timings.items():
        table.add_row(
            escape(key),
            str(t.samples),
            f"{t.duration_s:.1f}",
            f"{t.rate_hz:.2f}",
            f"{t.jitter_ms:.2f}",
            str(t.dropped),
            _time_offset_text(inspection.time_offsets.get(key)),
        )
    return table


def _time_offset_text(time_offset: SensorTimeOffset | None) -> str:
    if time_offset is None:
        return ""
    if time_offset.offset_s is None or time_offset.std_s is None:
        return "[dim]cannot tell[/dim]"
    return f"{1e3 * time_offset.offset_s:+.0f} ± {1e3 * time_offset.std_s:.0f} ms"


def _what(inspection: Inspection, key: str) -> str:
    kind, _, name = key.partition(".")
    recording = inspection.recording
    if kind == "camera":
        camera = recording.cameras[name]
        lens = camera.model.model if camera.model is not None else "no intrinsics"
        return f"{camera.width_px} x {camera.height_px}, {lens}"
    if kind == "imu" and inspection.turning is not None:
        major, minor = inspection.turning.tilt_std_deg
        return f"turns {inspection.turning.turned_deg:.0f} deg, tilts {major:.1f}, {minor:.1f} deg"
    if kind == "gnss" and inspection.travel is not None:
        return f"{inspection.travel.path_m:.0f} m, up to {inspection.travel.max_speed:.1f} m/s"
    return ""
