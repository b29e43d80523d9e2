"""`rigwake recalibrate CALIB REC -o NEW`: a new mounting for the camera that moved, and only for it."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from rigwake.cli.console import next_step, out, progress_bars, write_json
from rigwake.cli.options import (
    CameraFileOption,
    JsonOption,
    TopicOption,
    TopicsOption,
    require_there,
    require_writable,
)


def command(
    calibration: Annotated[Path, typer.Argument(help="The calibration that no longer holds.")],
    recording: Annotated[
        Path, typer.Argument(help="The recording in which the camera moved, or a later one.")
    ],
    new: Annotated[Path, typer.Option("-o", "--out", "--output", help="File of the new calibration.")],
    log: Annotated[
        Path | None,
        typer.Option("--log", metavar="VESSEL.db", help="Logbook in which it supersedes the old one."),
    ] = None,
    topic: TopicOption = None,
    topics: TopicsOption = None,
    camera_file: CameraFileOption = None,
    json_file: JsonOption = None,
) -> None:
    """Measure the one camera that the monitor blames; all others are written as they were.

    Example: [cyan]rigwake recalibrate calibration.yaml today.bag -o new.yaml --log vessel.db[/cyan]
    """
    require_there(calibration, recording, topics)
    require_writable("-o", new)
    require_writable("--log", log)
    require_writable("--json", json_file)
    import numpy as np

    from rigwake.calibration import Calibration, load_calibration, save_calibration
    from rigwake.calibration.yaml_file import plain
    from rigwake.errors import UsageError
    from rigwake.evaluation.rig_errors import compare_calibrations
    from rigwake.monitor.kept_result import recalibrate_with_log
    from rigwake.monitor.recalibration import recalibrate
    from rigwake.monitor.run import monitor
    from rigwake.readers.open import open_recording
    from rigwake.readers.topics import TopicMap

    if new.exists():
        raise UsageError(f"{new} is already there.", remedy="Remove it, or choose another name.")
    old = load_calibration(calibration)
    opened = open_recording(recording, TopicMap.from_options(topic or (), topics, camera_file or ()))
    with progress_bars() as bars:
        result = monitor(old, opened, bars)
    if log is None:
        found = recalibrate(old, result)
        save_calibration(found.calibration, new)
    else:

        def save(calibrated: Calibration) -> None:
            save_calibration(calibrated, new)

        found = recalibrate_with_log(old, opened, result, log, save, note=calibration.name)
    difference = compare_calibrations(old, found.calibration, [20.0])[found.camera]
    if json_file is not None:
        content = {"camera": found.camera, "blocks": found.blocks, "difference": difference.to_json()}
        write_json(json_file, plain(content))
    if str(json_file) == "-":
        return
    size = 100 * float(np.linalg.norm(found.shift))
    shifted = f" and shifted by {size:.1f} cm" if size else ""
    out.print(
        f"{found.camera}: turned by {difference.rotation_deg:.3f} deg{shifted} against {calibration.name}, "
        f"measured from {10 * found.blocks} s; all other cameras are unchanged.",
        soft_wrap=True,
        markup=False,
        highlight=False,
    )
    out.print(f"written: {new}", markup=False, highlight=False)
    next_step(["rigwake", "diff", calibration, new], "see what changed, in pixels too")
