"""`rigwake calibrate REC -o OUT`: the main job."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.markup import escape

from rigwake.cli.console import (
    figures_table,
    next_step,
    out,
    print_looks,
    print_title,
    progress_bars,
    write_json,
)
from rigwake.cli.options import (
    AllowPartialOption,
    CameraFileOption,
    CamerasOption,
    FovOption,
    HorizonOption,
    JsonOption,
    RepairOption,
    SettingOption,
    TopicOption,
    TopicsOption,
    fields_of_view,
    horizon_choice,
    require_scheduler,
    require_there,
    require_writable,
)
from rigwake.errors import PartialResultError, UsageError
from rigwake.pipeline.out_folder import check_out_folder

if TYPE_CHECKING:
    from rigwake.calibration import Calibration
    from rigwake.config import CalibrateConfig
    from rigwake.pipeline.calibration_run import CalibrationRun

_OPEN = "unobservable"
SETTINGS = {
    "min_duration_s=5": "calibrate from less than 15 s",
    "imu=false": "do not use the IMU; gnss=false: nor the GNSS",
    "time_offsets=false": "the cameras' clocks are those of the rig",
    "line_delay_s.front=3e-5": "a rolling shutter: seconds per row; estimate_line_delay=true refines it",
    "imu_noise.gyro_noise_density=2e-4": "rad/s/rtHz, if you know it; accel_noise_density: m/s2/rtHz",
    "find_self_mask=false": "do not look for the hull in the images",
    "sensor_checks=false": "do not compare the sensors with each other",
    "tracking.max_features=600": "corners per image",
    "adjustment.cross_camera=false": "do not look for the landmarks of other cameras",
    "adjustment.tracks_per_second=120": "tracks per camera and second in the adjustment",
}
HELP = (
    "Ten settings worth knowing, for --set, or as YAML for --config (all of them: --print-config):\n\n"
    + "\n\n".join(f"[cyan]{setting}[/cyan]  {what}" for setting, what in SETTINGS.items())
)
"""Stands below the options in `calibrate --help`."""


def command(
    recording: Annotated[
        Path | None, typer.Argument(help="ROS bag, MCAP, folder: see `rigwake inspect`.")
    ] = None,
    out_folder: Annotated[Path, typer.Option("-o", "--out", help="Folder for the result.")] = Path(
        "rigwake-out"
    ),
    reference: Annotated[
        str | None, typer.Option(help="Frame to report in: imu, base_link or a camera's name.")
    ] = None,
    cameras: CamerasOption = None,
    start: Annotated[float | None, typer.Option(help="Skip so many seconds.")] = None,
    duration: Annotated[float | None, typer.Option(help="Use so many seconds.")] = None,
    precision: Annotated[
        str | None,
        typer.Option(help="Use as much as every camera needs for these sigmas: 5mm, 0.02deg or 5mm,0.02deg."),
    ] = None,
    budget: Annotated[
        float | None, typer.Option(help="CPU-seconds it may take (default of recordings over 2 min: 300).")
    ] = None,
    use_all: Annotated[bool, typer.Option("--all", help="Use all of a long recording.")] = False,
    prior: Annotated[
        Path | None, typer.Option(help="YAML of what is known: tape measures, baselines.")
    ] = None,
    trajectories: Annotated[
        Path | None, typer.Option(help="Folder of CAMERA.tum made by another odometry.")
    ] = None,
    resume: Annotated[
        bool, typer.Option("--resume", help="Keep the stages that a former run finished.")
    ] = False,
    force: Annotated[bool, typer.Option("--force", help="Replace the result that the folder holds.")] = False,
    allow_partial: AllowPartialOption = False,
    repair: RepairOption = True,
    horizon: HorizonOption = "auto",
    intrinsics: Annotated[
        str | None,
        typer.Option(
            help="refine them with the rig (default), keep them fixed as given, or find them from the motion."
        ),
    ] = None,
    fov: FovOption = None,
    jobs: Annotated[int | None, typer.Option(help="Processes (default: one per core).")] = None,
    seed: Annotated[int | None, typer.Option(help="Random seed.")] = None,
    config: Annotated[Path | None, typer.Option(help="YAML file of settings.")] = None,
    assignments: SettingOption = None,
    scheduler: Annotated[
        str,
        typer.Option(help="Dask cluster for the camera stage: tcp://HOST:PORT, or local:N (extra `fleet`)."),
    ] = "",
    view: Annotated[
        bool, typer.Option("--view", help="Show the result in the rerun viewer (extra `rerun`).")
    ] = False,
    print_config: Annotated[bool, typer.Option("--print-config", help="Show all settings and stop.")] = False,
    topic: TopicOption = None,
    topics: TopicsOption = None,
    camera_file: CameraFileOption = None,
    json_file: JsonOption = None,
) -> None:
    """Find where every camera of a recording sits and looks, and how sure that is.

    Example: [cyan]rigwake calibrate sail.bag -o OUT[/cyan]

    Example: [cyan]rigwake calibrate sail.mcap -o OUT --reference base_link --prior tape.yaml[/cyan]
    """
    require_there(recording, config, prior, trajectories, topics)
    if use_all and (precision is not None or budget is not None):
        raise UsageError(
            "--all uses all of the recording, --precision and --budget a part of it.",
            remedy="Give one of them.",
        )
    if recording is not None:
        require_writable("-o", out_folder, folder=True)
        require_writable("--json", json_file)
        require_scheduler(scheduler)
        check_out_folder(out_folder, [recording], force=force, resume=resume)
    from rigwake.config import load_config
    from rigwake.pipeline.prior import load_prior
    from rigwake.readers.topics import TopicMap

    settings = load_config(
        config,
        assignments or (),
        reference=reference,
        cameras=None if cameras is None else [name.strip() for name in cameras.split(",") if name.strip()],
        start_s=start,
        duration_s=duration,
        precision=precision,
        budget_s=budget,
        use_all=use_all or None,
        intrinsics=intrinsics,
        fov_deg=fields_of_view(fov) or None,
        horizon=None if horizon == "auto" else horizon_choice(horizon),
        jobs=jobs,
        seed=seed,
        repair=None if repair else False,
    )
    if print_config:
        _print_settings(settings)
        return
    if recording is None:
        raise UsageError("No recording was given.", remedy="rigwake calibrate RECORDING -o OUT")
    run = _calibrated(
        recording,
        out_folder,
        settings,
        scheduler,
        topics=TopicMap.from_options(topic or (), topics, camera_file or ()),
        trajectories=trajectories,
        prior=None if prior is None else load_prior(prior),
        resume=resume,
        force=force,
    )
    _show(run, json_file, view)
    if run.is_partial and not allow_partial:
        raise PartialResultError(
            f"{_headline(run)}.",
            consequence=f"The others are in {run.out / 'calibration.yaml'}.",
            remedy="See the reasons above. With --allow-partial, such a result counts as done (exit code 0).",
        )


def _print_settings(settings: CalibrateConfig) -> None:
    import yaml

    out.print(yaml.safe_dump(settings.model_dump(mode="json"), sort_keys=False), end="")


def _calibrated(
    recording: Path, out_folder: Path, settings: CalibrateConfig, scheduler: str, **chosen: Any
) -> CalibrationRun:
    """The main job with progress, its camera stage on a Dask cluster if one is named."""
    from rigwake.pipeline.calibration_run import calibrate

    if scheduler:
        from rigwake.fleet.dask_run import cameras_on_cluster

        chosen["run_cameras"] = cameras_on_cluster(scheduler)
        recording, out_folder = recording.absolute(), out_folder.absolute()  # the same place on every machine
    with progress_bars() as bars:
        return calibrate(recording, out_folder, settings, progress=bars, **chosen)


def _show(run: CalibrationRun, json_file: Path | None, view: bool) -> None:
    """The result as JSON, in the terminal and in the viewer, as was asked for."""
    if json_file is not None:
        from rigwake.calibration.yaml_file import calibration_to_dict

        write_json(json_file, calibration_to_dict(run.calibration))
    if str(json_file) != "-":
        _print_run(run)
    if view:
        from rigwake.report.content import load_report_content
        from rigwake.report.rerun_log import log_to_rerun

        log_to_rerun(load_report_content(run.out), None, view)


def _print_run(run: CalibrationRun) -> None:
    """The rig, what was given up and noted, what was written, what to do next."""
    from rigwake.report.report_verdict import judge

    if run.is_partial:
        out.print(f"[bold red]{escape(_headline(run))}[/bold red]")
    print_calibration(run.calibration)
    for name, reason in run.failed.items():
        out.print(f"[red]{escape(name)} is not calibrated:[/red] {escape(reason.removeprefix(f'{name}: '))}")
    for check in run.sensor_checks:
        if check.action != "none":
            out.print(f"[yellow]{check.action}:[/yellow] {escape(check.sentence)}", soft_wrap=True)
        elif check.hypothesis:
            out.print(f"[dim]note: {escape(check.sentence)}[/dim]", soft_wrap=True)
    for note in run.notes:
        out.print(f"[dim]note: {escape(note)}[/dim]")
    verdict = judge(run.calibration)
    out.print(f"{verdict.level}: {escape(verdict.sentence)}", soft_wrap=True)
    for against in (reason for reason in verdict.reasons if not reason.holds):
        out.print(f"- {escape(f'{against.words} {against.remedy}'.rstrip())}", soft_wrap=True)
    out.print(f"written: {escape(f'{run.out}/calibration.yaml, {run.out}/report.html')}", soft_wrap=True)
    next_step(["rigwake", "report", run.out, "--open"], "look at it before you believe it")


def _headline(run: CalibrationRun) -> str:
    """Which cameras are missing from the result, and which other sensors were left out of it."""
    count = len(run.failed)
    total = count + len(run.calibration.cameras)
    words = []
    if count:
        are = "is" if count == 1 else "are"
        words.append(f"{count} of {total} cameras {are} not calibrated: {', '.join(run.failed)}")
    others = [
        c.sensor for c in run.sensor_checks if c.action == "left out" and not c.sensor.startswith("camera ")
    ]
    if others:
        words.append(f"left out, as it contradicts the others: {', '.join(others)}")
    return "; ".join(words)


def _millimetres(value_m: float, std_m: float) -> str:
    """No digits that the standard deviation does not earn."""
    digits = 1 if std_m < 0.01 else 0
    return f"{1e3 * value_m:+.{digits}f} ± {1e3 * std_m:.{digits}f}"


def print_calibration(calibration: Calibration) -> None:
    """The rig as a table: position with sigmas, sigma of the rotation, clock, repeatability."""
    headings = ("camera", "x mm", "y mm", "z mm", "± deg", "offset ms", "split-half")
    table = figures_table(headings)
    halves = calibration.checks.get("split_half", {})
    for name, camera in calibration.cameras.items():
        known = camera.observable_axes
        cells = [
            _millimetres(x, s) if ok else _OPEN
            for x, s, ok in zip(
                camera.rig_from_cam.translation, camera.std_translation_m, known[3:], strict=True
            )
        ]
        rotation = f"{camera.std_rotation_deg.max():.3f}" if known[:3].all() else _OPEN
        time_offset = "–" if camera.time_offset_s is None else f"{1e3 * camera.time_offset_s:+.2f}"
        apart = halves.get(name, {}).get("sigmas") if isinstance(halves, dict) else None
        table.add_row(escape(name), *cells, rotation, time_offset, "–" if apart is None else f"{apart:.1f}")
    print_title(f"cameras in {calibration.reference}, ± one sigma")
    out.print(table)
    print_looks(calibration)
    if halves:
        out.print("[dim]deg: rotation, worst axis; split-half: difference of both halves in sigmas[/dim]")
    for camera in calibration.cameras.values():
        for direction in camera.unobservable:
            out.print(f"[yellow]unobservable:[/yellow] {escape(direction.words)}. {escape(direction.remedy)}")
