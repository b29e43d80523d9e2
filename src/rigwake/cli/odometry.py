"""`rigwake odometry REC`: the trajectory of one camera, or of each."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, cast

import typer
from rich.markup import escape

from rigwake.cli.console import err, figures_table, next_step, out, progress_bars, write_json
from rigwake.cli.options import (
    AllowPartialOption,
    CameraFileOption,
    HorizonOption,
    JsonOption,
    RepairOption,
    TopicOption,
    TopicsOption,
    completed_from,
    horizon_choice,
    require,
    require_there,
    require_writable,
    topic_words,
)
from rigwake.errors import PartialResultError, RigwakeError
from rigwake.pipeline.out_folder import check_out_folder

if TYPE_CHECKING:
    from rigwake.odometry.camera_odometry import CameraOdometry, CameraOdometryOptions
    from rigwake.pipeline.odometry_run import OdometryRun
    from rigwake.plausibility.values import SensorCheck
    from rigwake.recording import Recording

_METHODS = ("adjusted", "thesis")
_FRONT_ENDS = ("klt", "sift", "fast-brief", "orb")


def command(
    recording: Annotated[
        Path, typer.Argument(help="ROS bag, MCAP, EuRoC or KITTI folder, folder of images.")
    ],
    output: Annotated[
        Path,
        typer.Option("-o", "--out", "--output", help="Folder for NAME.tum, tracks, masks and odometry.html."),
    ],
    camera: Annotated[str, typer.Option(help="Name of a camera, or all.")] = "all",
    front_end: Annotated[
        str,
        typer.Option(help="klt, sift, fast-brief or orb.", autocompletion=completed_from(_FRONT_ENDS)),
    ] = "klt",
    method: Annotated[
        str,
        typer.Option(
            help="adjusted, or the frame-to-frame baseline: thesis.",
            autocompletion=completed_from(_METHODS),
        ),
    ] = "adjusted",
    imu: Annotated[bool, typer.Option("--imu/--no-imu", help="Use the recording's IMU.")] = True,
    gnss: Annotated[bool, typer.Option("--gnss/--no-gnss", help="Use the recording's GNSS.")] = True,
    attitude: Annotated[
        bool,
        typer.Option(
            "--attitude/--no-attitude", help="With an IMU and no GNSS: heading from the recording's attitude."
        ),
    ] = True,
    hull: Annotated[bool, typer.Option("--hull/--no-hull", help="Look for the own boat in view.")] = True,
    horizon: HorizonOption = "auto",
    no_horizon: Annotated[bool, typer.Option("--no-horizon", help="The same as --horizon off.")] = False,
    loops: Annotated[
        bool,
        typer.Option("--loops", help="Recognise places seen before, also where the odometry did not break."),
    ] = False,
    refine_lens: Annotated[
        bool,
        typer.Option(
            "--refine-lens/--no-refine-lens",
            help="Vision alone: refine intrinsics that do not fit the images.",
        ),
    ] = True,
    mask: Annotated[Path | None, typer.Option(help="Picture, white where the camera may be used.")] = None,
    stereo: Annotated[
        str | None,
        typer.Option(
            metavar="FIRST,SECOND", help="Two synchronised cameras whose baseline gives the metres."
        ),
    ] = None,
    rig: Annotated[
        Path | None,
        typer.Option(
            help="With --stereo: where the two sit (a calibration, rig.yaml); default: the recording."
        ),
    ] = None,
    seed: Annotated[int, typer.Option(help="Random seed.", min=0)] = 0,
    jobs: Annotated[int, typer.Option(help="Processes (default: one per core).", min=0)] = 0,
    allow_partial: AllowPartialOption = False,
    topic: TopicOption = None,
    topics: TopicsOption = None,
    camera_file: CameraFileOption = None,
    repair: RepairOption = True,
    json_file: JsonOption = None,
) -> None:
    """Where a camera was, frame by frame: metric with an IMU or GNSS, up to scale without, and says so.

    Example: [cyan]rigwake odometry harbour.bag --camera front -o OUT[/cyan]
    """
    require_there(recording, topics, mask, rig)
    require_writable("-o", output, folder=True)
    require_writable("--json", json_file)
    require("--front-end", front_end, _FRONT_ENDS)
    require("--method", method, _METHODS)
    check_out_folder(output, [recording], force=True, resume=False)
    from rigwake.odometry.camera_odometry import CameraOdometryOptions
    from rigwake.odometry.odometry_options import OdometryOptions
    from rigwake.odometry.thesis_odometry import ThesisOptions
    from rigwake.pipeline.odometry_run import odometry_summary, run_odometry
    from rigwake.plausibility.values import checks_to_list
    from rigwake.readers.open import open_recording
    from rigwake.readers.topics import TopicMap
    from rigwake.tracking.tracking_options import FrontEndName, TrackingOptions

    opened = open_recording(recording, TopicMap.from_options(topic or (), topics, camera_file or ()))
    options = CameraOdometryOptions(
        method="adjusted" if method == "adjusted" else "thesis",
        tracking=TrackingOptions(front_end=cast(FrontEndName, front_end)),
        odometry=OdometryOptions(seed=seed),
        thesis=ThesisOptions(seed=seed),
        hull=hull,
        horizon="off" if no_horizon else horizon_choice(horizon),
        mask_file=mask,
        loops=loops,
        refine_lens=refine_lens,
    )
    if stereo is not None:
        _stereo(opened, stereo, rig or recording, options, output, json_file)
        return
    with progress_bars() as bars:
        run = run_odometry(
            opened,
            output,
            options,
            camera=camera,
            imu=imu,
            gnss=gnss,
            attitude=attitude,
            repair=repair,
            jobs=jobs,
            progress=bars,
            checked=_print_checks,
        )
    if json_file is not None:
        summary = odometry_summary(opened, run.results)
        write_json(json_file, summary | {"sensor_checks": checks_to_list(run.checks)})
    if str(json_file) != "-":
        _print(run.results)
        if run.done:
            _name_next_step(recording, run.done, output, topic_words(topic, topics))
    _refuse(run, output, allow_partial)


def _refuse(run: OdometryRun, output: Path, allow_partial: bool) -> None:
    """The error that this run ends with: no trajectory, sensors that contradict each other, a missing camera."""
    if not run.done:
        raise next(iter(run.missing.values()))
    for check in run.lens_checks:
        err.print(f"[yellow]{escape(check.sentence)}[/yellow]", soft_wrap=True)
    run.refuse_contradicted()
    if run.missing and not allow_partial:
        raise PartialResultError(
            f"{len(run.missing)} of {len(run.results)} cameras {'has' if len(run.missing) == 1 else 'have'} "
            f"no trajectory: {', '.join(run.missing)}.",
            consequence=f"The others are in {output}.",
            remedy="See the reasons above. With --allow-partial, such a result counts as done (exit code 0).",
        )


def _print_checks(checks: tuple[SensorCheck, ...]) -> None:
    for check in checks:
        if check.action != "none" or check.hypothesis:
            err.print(f"[yellow]{escape(check.sentence)}[/yellow]", soft_wrap=True)


def _stereo(
    opened: Recording,
    stereo: str,
    rig: Path,
    options: CameraOdometryOptions,
    output: Path,
    json_file: Path | None,
) -> None:
    """The path of the first of two cameras in metres, by their known baseline."""
    from rigwake.exporters.known_rigs import read_known_rig
    from rigwake.pipeline.odometry_run import run_stereo, stereo_pair
    from rigwake.writers.trajectory_writer import write_tum

    names = [name.strip() for name in stereo.split(",") if name.strip()]
    first, second = stereo_pair(opened, names)
    known = opened.true_rig if rig == opened.path and opened.true_rig is not None else read_known_rig(rig)
    found = run_stereo(first, second, known, options)
    file = output / f"{names[0]}.tum"
    write_tum(found, file)
    if json_file is not None:
        write_json(json_file, {"stereo": names, "poses": len(found), "path_length_m": found.path_length})
        if str(json_file) == "-":
            return
    out.print(f"{file}: {len(found)} poses, {found.path_length:.1f} m", markup=False, highlight=False)
    next_step(["rigwake", "evaluate", "--help"], "compare it with a known trajectory")


def _name_next_step(
    recording: Path, done: dict[str, CameraOdometry], output: Path, topics: list[str]
) -> None:
    """Hand-eye calibration of the trajectories, a metric one first; the whole job where that cannot be."""
    names = sorted(done, key=lambda name: not done[name].trajectory.is_metric)
    if len(names) > 1 and done[names[0]].trajectory.is_metric:
        files = [output / f"{name}.tum" for name in names]
        next_step(["rigwake", "handeye", *files], "a rig from these trajectories")
    else:
        next_step(["rigwake", "calibrate", recording, *topics, "-o", "OUT"], "the rig of this recording")


def _print(results: Mapping[str, CameraOdometry | RigwakeError]) -> None:
    from rigwake.pipeline.odometry_run import camera_summary

    headings = ("camera", "metres from", "placed", "segments", "lost", "bridged", "path", "frames/s")
    table = figures_table(headings, words=2)
    for name, result in results.items():
        if isinstance(result, RigwakeError):
            table.add_row(escape(name), "[red]failed[/red]")
            continue
        summary = camera_summary(result)
        visual, smoother = summary.get("visual", {}), summary.get("smoother", {})
        unit = "m" if result.trajectory.is_metric else "units"
        table.add_row(
            escape(name),
            result.scale_source if result.trajectory.is_metric else "up to scale",
            f"{summary['poses']}/{summary['frames']}",
            str(visual.get("segments", "-")),
            str(visual.get("lost", "-")),
            str(smoother.get("frames_bridged", "-")),
            f"{summary['path_length']:.1f} {unit}",
            f"{summary['frames_per_second'] or 0:.0f}",
        )
    out.print(table)
    for name, result in results.items():
        lines = [str(result)] if isinstance(result, RigwakeError) else list(result.notes)
        for line in lines:
            out.print(f"[yellow]{escape(name)}: {escape(line)}[/yellow]", soft_wrap=True)
