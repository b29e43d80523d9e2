"""`rigwake monitor CALIB REC`: has a camera moved since it was calibrated?"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from rich.markup import escape

from rigwake.cli.console import next_step, out, progress_bars, write_json
from rigwake.cli.options import (
    CameraFileOption,
    JsonOption,
    TopicOption,
    TopicsOption,
    require_there,
    require_writable,
)

_COLOURS = {
    "OK": "green",
    "SUSPECT": "yellow",
    "DRIFTED": "red",
    "RECALIBRATING": "cyan",
    "UNOBSERVABLE": "yellow",
}


def command(
    calibration: Annotated[Path, typer.Argument(help="calibration.yaml of this vessel.")],
    recording: Annotated[Path, typer.Argument(help="What it recorded later: ROS bag, MCAP, folder.")],
    out_folder: Annotated[
        Path | None, typer.Option("-o", "--out", "--output", help="Folder for monitor.html and monitor.json.")
    ] = None,
    log: Annotated[
        Path | None, typer.Option("--log", metavar="VESSEL.db", help="Logbook that the verdicts go into.")
    ] = None,
    topic: TopicOption = None,
    topics: TopicsOption = None,
    camera_file: CameraFileOption = None,
    json_file: JsonOption = None,
) -> None:
    """Has a camera moved since it was calibrated, or during this recording?

    Exit code 0: all cameras are where they were. 5: a camera, a clock or the IMU is not. 3: the motion cannot tell.

    Example: [cyan]rigwake monitor calibration.yaml today.bag -o OUT --log vessel.db[/cyan]
    """
    require_there(calibration, recording, topics)
    require_writable("-o", out_folder, folder=True)
    require_writable("--log", log)
    require_writable("--json", json_file)
    from rigwake.calibration import load_calibration
    from rigwake.logbook.store import Logbook
    from rigwake.monitor.kept_result import keep_result
    from rigwake.monitor.monitor_report import result_to_dict, verdict_line
    from rigwake.monitor.run import monitor
    from rigwake.readers.open import open_recording
    from rigwake.readers.topics import TopicMap
    from rigwake.tracking.hull_picture import load_hull_pictures

    calibrated = load_calibration(calibration)
    if log is not None:
        with Logbook(log, create=True):
            pass  # what is wrong with it is told before the work
    opened = open_recording(recording, TopicMap.from_options(topic or (), topics, camera_file or ()))
    with progress_bars() as bars:
        hull = load_hull_pictures(calibration, calibrated.cameras)
        result = monitor(calibrated, opened, bars, hull=hull)
    if json_file is not None:
        write_json(json_file, result_to_dict(result))
    keep_result(calibrated, opened, result, out_folder, log, note=calibration.name)
    if str(json_file) != "-":
        for verdict in result.verdicts.values():
            line = verdict_line(verdict, f"rigwake recalibrate {calibration} {recording} -o NEW.yaml")
            state = str(verdict.state)
            out.print(
                escape(line).replace(state, f"[{_COLOURS[state]}]{state}[/]", 1),
                soft_wrap=True,
                highlight=False,
            )
        for cue in result.cues.values():
            out.print(f"cue {cue.words}", style="dim", markup=False, highlight=False, soft_wrap=True)
        for note in result.notes:
            out.print(f"note: {note}", style="yellow", markup=False, highlight=False, soft_wrap=True)
        if result.blamed:
            next_step(
                ["rigwake", "recalibrate", calibration, recording, "-o", "NEW.yaml"],
                "measure the camera that moved",
            )
        elif log is not None:
            next_step(["rigwake", "log", "list", log], "the history of this vessel")
        else:
            next_step(["rigwake", "log", "--help"], "keep a history: monitor with --log VESSEL.db")
    if result.exit_code:
        raise typer.Exit(result.exit_code)
