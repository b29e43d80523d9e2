"""`rigwake odometry REC`: the trajectory of one camera, or of each."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple, cast

import typer
from rich.markup import escape

from rigwake.cli.console import err, figures_table, next_step, out, progress_bar, write_json
from rigwake.cli.options import (
    AllowPartialOption,
    CameraFileOption,
    HorizonOption,
    JsonOption,
    TopicOption,
    TopicsOption,
    completed_from,
    horizon_choice,
    require,
    require_there,
    require_writable,
    topic_words,
)
from rigwake.errors import HostError, InputError, PartialResultError, RigwakeError
from rigwake.pipeline.out_folder import check_out_folder
from rigwake.workers import run_in_processes

if TYPE_CHECKING:
    from rigwake.odometry.camera_odometry import CameraOdometry, CameraOdometryOptions
    from rigwake.plausibility.values import SensorCheck
    from rigwake.recording import AttitudeStream, CameraStream, GnssStream, ImuStream, Recording

_METHODS = ("adjusted", "seed")
_FRONT_ENDS = ("klt", "sift", "fast-brief", "orb")


def command(
    recording: Annotated[
        Path, typer.Argument(help="ROS bag, MCAP, EuRoC or KITTI folder, folder of images.")
    ],
    output: Annotated[
        Path, typer.Option("-o", "--out", "--output", help="Folder for NAME.tum, tracks and masks.")
    ],
    camera: Annotated[str, typer.Option(help="Name of a camera, or all.")] = "all",
    front_end: Annotated[
        str,
        typer.Option(help="klt, sift, fast-brief or orb.", autocompletion=completed_from(_FRONT_ENDS)),
    ] = "klt",
    method: Annotated[
        str,
        typer.Option(
            help="adjusted, or the frame-to-frame baseline: seed.",
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
    seed: Annotated[int, typer.Option(help="Random seed.", min=0)] = 0,
    jobs: Annotated[int, typer.Option(help="Processes (default: one per core).", min=0)] = 0,
    allow_partial: AllowPartialOption = False,
    topic: TopicOption = None,
    topics: TopicsOption = None,
    camera_file: CameraFileOption = None,
    repair: Annotated[
        bool,
        typer.Option("--repair/--no-repair", help="Correct units, leave out samples that cannot be right."),
    ] = True,
    json_file: JsonOption = None,
) -> None:
    """Where a camera was, frame by frame: metric with an IMU or GNSS, up to scale without, and says so.

    Example: [cyan]rigwake odometry harbour.bag --camera front -o OUT[/cyan]
    """
    require_there(recording, topics, mask)
    require_writable("-o", output, folder=True)
    require_writable("--json", json_file)
    require("--front-end", front_end, _FRONT_ENDS)
    require("--method", method, _METHODS)
    check_out_folder(output, [recording], force=True, resume=False)
    from rigwake.fingerprint import unchanged
    from rigwake.odometry.camera_odometry import CameraOdometryOptions, Method
    from rigwake.odometry.odometry_options import OdometryOptions
    from rigwake.odometry.thesis_odometry import ThesisOptions
    from rigwake.pipeline.out_folder import check_camera_names, used_by_one
    from rigwake.plausibility.values import checks_to_list, refuse
    from rigwake.readers.open import open_recording
    from rigwake.readers.topics import TopicMap
    from rigwake.recording import main_gnss, main_imu
    from rigwake.tracking.tracking_options import FrontEndName, TrackingOptions

    opened = open_recording(recording, TopicMap.from_options(topic or (), topics, camera_file or ()))
    options = CameraOdometryOptions(
        method=cast(Method, method),
        tracking=TrackingOptions(front_end=cast(FrontEndName, front_end)),
        odometry=OdometryOptions(seed=seed),
        seed=ThesisOptions(seed=seed),
        hull=hull,
        horizon="off" if no_horizon else horizon_choice(horizon),
        mask_file=mask,
        loops=loops,
        refine_lens=refine_lens,
    )
    streams = list(opened.cameras.values()) if camera == "all" else [opened.camera(camera)]
    if not streams:
        raise InputError(
            f"{recording.name} has no cameras.",
            remedy="`rigwake inspect` lists what it holds; name image topics with --topic camera.front=/a/b.",
        )
    check_camera_names(stream.name for stream in streams)
    sensors = Sensors(
        main_imu(opened) if imu else None,
        main_gnss(opened) if gnss else None,
        _first(opened.attitudes) if attitude else None,
    )
    sensors = _vetted(sensors, streams, repair)
    with used_by_one(output), unchanged(recording) as check_unchanged:
        results = _run_all(streams, sensors, options, jobs)
        check_unchanged()
        checks = _compared(sensors, streams, results)
        if json_file is not None:
            write_json(json_file, _summary(opened, results) | {"sensor_checks": checks_to_list(checks)})
        _keep(results, output, quiet=str(json_file) == "-")
    done = {name: result for name, result in results.items() if not isinstance(result, RigwakeError)}
    if str(json_file) != "-":
        _name_next_step(recording, done, output, topic_words(topic, topics))
    lenses = [c for c in checks if not c.agrees and "lens" in c.hypothesis]
    for check in lenses:
        err.print(f"[yellow]{escape(check.sentence)}[/yellow]", soft_wrap=True)
    refuse([c for c in checks if c not in lenses], "What was written is not to be trusted.")
    missing = [name for name in results if name not in done]
    if missing and not allow_partial:
        raise PartialResultError(
            f"{len(missing)} of {len(results)} cameras {'has' if len(missing) == 1 else 'have'} no trajectory: "
            f"{', '.join(missing)}.",
            consequence=f"The others are in {output}.",
            remedy="See the reasons above. With --allow-partial, such a result counts as done (exit code 0).",
        )


def _vetted(sensors: Sensors, streams: list[CameraStream], repair: bool) -> Sensors:
    """The IMU with its units repaired; raises InputError where more is wrong with it than that."""
    from rigwake.pipeline.sensor_checks import vet_imu
    from rigwake.pipeline.stream_selection import Selection

    if sensors.imu is None:
        return sensors
    cameras = {stream.name: stream for stream in streams}
    found = vet_imu(Selection(cameras, sensors.imu, None), tuple(cameras), repair=repair)
    for check in found.checks:
        if check.action != "none" or check.hypothesis:
            err.print(f"[yellow]{escape(check.sentence)}[/yellow]", soft_wrap=True)
    return sensors._replace(imu=found.selection.imu)


def _compared(
    sensors: Sensors, streams: list[CameraStream], results: dict[str, CameraOdometry | RigwakeError]
) -> tuple[SensorCheck, ...]:
    """Every camera's own motion against its lens and the IMU."""
    from rigwake.pipeline.sensor_checks import compare_sensors

    done = {n: r for n, r in results.items() if not isinstance(r, RigwakeError) and r.visual is not None}
    lenses = {s.name: s.model for s in streams if s.model is not None}
    models = {n: lenses[n] if r.lens is None else r.lens.camera for n, r in done.items()}
    paths = {n: r.visual.trajectory for n, r in done.items() if r.visual is not None}
    tracks = {n: r.tracks for n, r in done.items()}
    return compare_sensors(sensors.imu, tracks, models, paths, repair=False).checks


def _keep(results: dict[str, CameraOdometry | RigwakeError], output: Path, quiet: bool) -> None:
    """Write and print what succeeded; raises the first failure if nothing did."""
    done = {n: r for n, r in results.items() if not isinstance(r, RigwakeError)}
    for name, result in done.items():
        _write(output, name, result)
    if not quiet:
        _print(results)
    for failure in results.values():
        if not done and isinstance(failure, RigwakeError):
            raise failure


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


def _first(streams: Any) -> Any:
    return next(iter(streams.values()), None)


class Sensors(NamedTuple):
    """What is used beside the camera."""

    imu: ImuStream | None
    gnss: GnssStream | None
    attitude: AttitudeStream | None


def _run_all(
    streams: list[CameraStream],
    sensors: Sensors,
    options: CameraOdometryOptions,
    processes: int,
) -> dict[str, CameraOdometry | RigwakeError]:
    """Every camera in a process of its own, so many at a time (0: as many as there are processors)."""
    with progress_bar() as bar:
        tasks = {stream.name: bar.add_task(escape(stream.name), total=1) for stream in streams}

        def show(name: str, stage: str, done: int, total: int) -> None:
            bar.update(tasks[name], description=escape(f"{name}: {stage}"), completed=done, total=total)

        jobs = {stream.name: _Job(stream, sensors, options) for stream in streams}
        found = run_in_processes(_in_process, jobs, processes, show)
        return {name: _outcome(*result) for name, result in found.items()}


class _Job(NamedTuple):
    """What the process of a camera needs."""

    stream: CameraStream
    sensors: Sensors
    options: CameraOdometryOptions


_Failure = tuple[str, str, str, int]


def _outcome(result: CameraOdometry | None, failure: _Failure | None) -> CameraOdometry | RigwakeError:
    if failure is None:
        assert result is not None
        return result
    cause, consequence, remedy, exit_code = failure
    error = RigwakeError(cause, consequence=consequence, remedy=remedy)
    error.exit_code = exit_code  # type: ignore[misc]
    return error


def _in_process(job: _Job, progress: Callable[..., None]) -> tuple[CameraOdometry | None, _Failure | None]:
    """One camera; an error travels between processes as its words, since exceptions pickle only their message."""
    import cv2

    from rigwake.odometry.camera_odometry import run_camera

    cv2.setNumThreads(1)  # the processes share the processors already
    stream, sensors, options = job

    def report(stage: str, done: int, total: int) -> None:
        progress(stream.name, stage, done, total)

    try:
        found = run_camera(stream, sensors.imu, sensors.gnss, options, report, sensors.attitude)
    except HostError:
        raise
    except RigwakeError as error:
        return None, (error.cause, error.consequence, error.remedy, error.exit_code)
    return found, None


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
