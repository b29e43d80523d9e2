"""`rigwake odometry REC`: the trajectory of one camera, or of each."""

from __future__ import annotations

import multiprocessing
from collections.abc import Callable
from concurrent.futures import Future, ProcessPoolExecutor
from pathlib import Path
from queue import Empty
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple, cast, get_args

import typer
from rich.markup import escape

from rigwake.cli.console import figures_table, next_step, out, progress_bar, write_json
from rigwake.cli.options import JsonOption, TopicOption, TopicsOption, require
from rigwake.errors import RigwakeError

if TYPE_CHECKING:
    from rigwake.odometry.camera_odometry import CameraOdometry, CameraOdometryOptions
    from rigwake.recording import AttitudeStream, CameraStream, GnssStream, ImuStream, Recording


def command(
    recording: Annotated[
        Path, typer.Argument(help="ROS bag, MCAP, EuRoC or KITTI folder, folder of images.")
    ],
    output: Annotated[Path, typer.Option("--output", "-o", help="Folder for NAME.tum, tracks and masks.")],
    camera: Annotated[str, typer.Option(help="Name of a camera, or all.")] = "all",
    front_end: Annotated[str, typer.Option(help="klt, sift, fast-brief or orb.")] = "klt",
    method: Annotated[str, typer.Option(help="adjusted, or the frame-to-frame baseline: seed.")] = "adjusted",
    imu: Annotated[bool, typer.Option("--imu/--no-imu", help="Use the recording's IMU.")] = True,
    gnss: Annotated[bool, typer.Option("--gnss/--no-gnss", help="Use the recording's GNSS.")] = True,
    attitude: Annotated[
        bool,
        typer.Option(
            "--attitude/--no-attitude", help="With an IMU and no GNSS: heading from the recording's attitude."
        ),
    ] = True,
    hull: Annotated[bool, typer.Option("--hull/--no-hull", help="Look for the own boat in view.")] = True,
    horizon: Annotated[
        bool,
        typer.Option("--horizon/--no-horizon", help="Leave out what lies below the horizon (with an IMU)."),
    ] = True,
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
    seed: Annotated[int, typer.Option(help="Random seed.")] = 0,
    topic: TopicOption = (),
    topics: TopicsOption = None,
    json_file: JsonOption = None,
) -> None:
    """Where a camera was, frame by frame: metric with an IMU or GNSS, up to scale without, and says so.

    Example: [cyan]rigwake odometry harbour.bag --camera front -o OUT[/cyan]
    """
    from rigwake.odometry.camera_odometry import CameraOdometryOptions, Method
    from rigwake.odometry.odometry_options import OdometryOptions
    from rigwake.odometry.thesis_odometry import ThesisOptions
    from rigwake.readers.open import open_recording
    from rigwake.readers.topics import TopicMap
    from rigwake.tracking.tracking_options import FrontEndName, TrackingOptions

    require("--front-end", front_end, get_args(FrontEndName))
    require("--method", method, get_args(Method))
    opened = open_recording(recording, TopicMap.from_options(topic, topics))
    options = CameraOdometryOptions(
        method=cast(Method, method),
        tracking=TrackingOptions(front_end=cast(FrontEndName, front_end)),
        odometry=OdometryOptions(seed=seed),
        seed=ThesisOptions(seed=seed),
        hull=hull,
        horizon=horizon,
        mask_file=mask,
        loops=loops,
        refine_lens=refine_lens,
    )
    streams = list(opened.cameras.values()) if camera == "all" else [opened.camera(camera)]
    sensors = Sensors(
        _first(opened.imus) if imu else None,
        _first(opened.gnss) if gnss else None,
        _first(opened.attitudes) if attitude else None,
    )
    results = _run_all(streams, sensors, options)
    if json_file is not None:
        write_json(json_file, _summary(opened, results))
    _keep(results, output, quiet=str(json_file) == "-")


def _keep(results: dict[str, CameraOdometry | RigwakeError], output: Path, quiet: bool) -> None:
    """Write and print what succeeded; raises the first failure if nothing did."""
    output.mkdir(parents=True, exist_ok=True)
    done = {n: r for n, r in results.items() if not isinstance(r, RigwakeError)}
    for name, result in done.items():
        _write(output, name, result)
    if not quiet:
        _print(results)
    for failure in results.values():
        if not done and isinstance(failure, RigwakeError):
            raise failure
    if not quiet:
        files = " ".join(str(output / f"{name}.tum") for name in done)
        next_step(f"rigwake handeye {files}", "a rig from these trajectories")


def _first(streams: Any) -> Any:
    return next(iter(streams.values()), None)


Report = Callable[[str, int, int], None]


class Sensors(NamedTuple):
    """What is used beside the camera."""

    imu: ImuStream | None
    gnss: GnssStream | None
    attitude: AttitudeStream | None


def _run_all(
    streams: list[CameraStream],
    sensors: Sensors,
    options: CameraOdometryOptions,
) -> dict[str, CameraOdometry | RigwakeError]:
    """Every camera in a process of its own, as many at a time as there are processors."""
    workers = min(len(streams), multiprocessing.cpu_count())
    with progress_bar() as bar:
        tasks = {stream.name: bar.add_task(stream.name, total=1) for stream in streams}

        def show(name: str, stage: str, done: int, total: int) -> None:
            bar.update(tasks[name], description=f"{name}: {stage}", completed=done, total=total)

        if len(streams) == 1:
            only = streams[0]
            return {only.name: _attempt(only, sensors, options, lambda *state: show(only.name, *state))}
        context = multiprocessing.get_context("spawn")
        with context.Manager() as manager, ProcessPoolExecutor(workers, mp_context=context) as pool:
            queue = manager.Queue()
            futures = {s.name: pool.submit(_in_process, s, sensors, options, queue) for s in streams}
            while any(not future.done() for future in futures.values()):
                _drain(queue, show)
            return {name: _outcome(future) for name, future in futures.items()}


def _drain(queue: Any, show: Callable[[str, str, int, int], None]) -> None:
    try:
        show(*queue.get(timeout=0.2))
    except Empty:
        return


def _outcome(future: Future[tuple[CameraOdometry | None, tuple[str, str, str, int] | None]]) -> Any:
    result, failure = future.result()
    if failure is None:
        return result
    cause, consequence, remedy, exit_code = failure
    error = RigwakeError(cause, consequence=consequence, remedy=remedy)
    error.exit_code = exit_code  # type: ignore[misc]
    return error


def _in_process(
    stream: CameraStream, sensors: Sensors, options: CameraOdometryOptions, queue: Any
) -> tuple[CameraOdometry | None, tuple[str, str, str, int] | None]:
    """One camera; an error travels between processes as its words, since exceptions pickle only their message."""
    import cv2

    cv2.setNumThreads(1)  # the processes share the processors already
    result = _attempt(stream, sensors, options, lambda *state: queue.put((stream.name, *state)))
    if isinstance(result, RigwakeError):
        return None, (result.cause, result.consequence, result.remedy, result.exit_code)
    return result, None


def _attempt(
    stream: CameraStream, sensors: Sensors, options: CameraOdometryOptions, report: Report
) -> CameraOdometry | RigwakeError:
    from rigwake.odometry.camera_odometry import run_camera

    try:
        return run_camera(stream, sensors.imu, sensors.gnss, options, report, sensors.attitude)
    except RigwakeError as error:
        return error


def _write(output: Path, name: str, result: CameraOdometry) -> None:
    from rigwake.writers.trajectory_writer import write_tum

    write_tum(result.trajectory, output / f"{name}.tum")
    result.tracks.save(output / f"tracks_{name}.npz")
    result.mask.save(output, name)


def _summary(opened: Recording, results: dict[str, CameraOdometry | RigwakeError]) -> dict[str, Any]:
    return {"recording": opened.path.name, "cameras": {n: _one_summary(r) for n, r in results.items()}}


def _one_summary(result: CameraOdometry | RigwakeError) -> dict[str, Any]:
    if isinstance(result, RigwakeError):
        return {"error": str(result)}
    frames = len(result.tracks.timestamps_ns)
    total = sum(result.seconds.values())
    summary: dict[str, Any] = {
        "poses": len(result.trajectory),
        "frames": frames,
        "metric": result.trajectory.is_metric,
        "scale_source": result.scale_source,
        "path_length": result.trajectory.path_length,
        "seconds": {stage: round(value, 3) for stage, value in result.seconds.items()},
        "frames_per_second": frames / total if total > 0 else None,
        "notes": list(result.notes),
    }
    if result.visual is not None:
        summary["visual"] = dict(vars(result.visual.counts))
    if result.smoothed is not None:
        report = result.smoothed.solution.report
        summary["smoother"] = {
            "converged": report.converged,
            "reason": report.reason,
            "noise_factor": result.smoothed.noise_factor,
            "frames_bridged": result.smoothed.bridged,
            "time_offset_s": result.smoothed.time_offset_s,
        }
    return summary


def _print(results: dict[str, CameraOdometry | RigwakeError]) -> None:
    headings = ("camera", "metres from", "placed", "segments", "lost", "bridged", "path", "frames/s")
    table = figures_table(headings, words=2)
    for name, result in results.items():
        if isinstance(result, RigwakeError):
            table.add_row(escape(name), "[red]failed[/red]")
            continue
        summary = _one_summary(result)
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
