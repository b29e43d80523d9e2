"""rigwake from Python: a function per verb, which does all that its verb does.

Paths may be strings. `topics` says which topic is which sensor (`{"camera.front": "/a/b"}`), `camera_files` names
files of lenses (`{"front": "front.yaml"}`). `progress` is called with a name, what is done, and the fraction of it.
All raise the errors of `rigwake.errors`: cause, consequence and remedy, in place of an exit code.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from rigwake._api_inputs import (
    FilePath,
    calibration_of,
    load_calibration,
    open_recording,
    opened,
    silent,
    topic_map,
    trajectory_of,
)
from rigwake._api_results import diff, evaluate, export, report
from rigwake._progress import Progress
from rigwake.extras import require_extra

if TYPE_CHECKING:
    from rigwake.calibration import Calibration
    from rigwake.config import CalibrateConfig
    from rigwake.handeye.handeye_problem import HandeyeResult
    from rigwake.inspection.readiness import Readiness
    from rigwake.inspection.recording_inspection import Inspection
    from rigwake.intrinsics.board_calibration import IntrinsicCalibration
    from rigwake.monitor.run import MonitorResult
    from rigwake.odometry.camera_odometry import CameraOdometryOptions
    from rigwake.pipeline.odometry_run import OdometryRun
    from rigwake.pipeline.prior import RigPrior
    from rigwake.pipeline.undistortion import Target
    from rigwake.recording import Recording
    from rigwake.trajectory import Trajectory

__all__ = [
    "FilePath",
    "Progress",
    "calibrate",
    "diff",
    "evaluate",
    "export",
    "handeye",
    "inspect",
    "intrinsics",
    "load_calibration",
    "monitor",
    "odometry",
    "open_recording",
    "report",
    "simulate",
    "undistort",
]
FUNCTIONS = tuple(name for name in __all__ if name.islower())


def inspect(
    recording: FilePath | Recording, *, html: FilePath | None = None, progress: Progress = silent
) -> tuple[Inspection, Readiness]:
    """Sensors, rates, gaps, clocks and motion of a recording, and whether that is enough to calibrate.

    html: also write the page with plots. Sensors that contradict the others are findings of severity `error`.
    """
    from rigwake.atomic import write_text_atomic
    from rigwake.pipeline.checked_inspection import inspect_with_checks
    from rigwake.report.inspection_page import inspection_page

    inspection, verdict, _ = inspect_with_checks(
        opened(recording), lambda what, done, total: progress("inspect", what, done / max(total, 1))
    )
    if html is not None:
        write_text_atomic(Path(html), inspection_page(inspection, verdict))
    return inspection, verdict


def calibrate(
    recording: FilePath,
    out: FilePath = "rigwake-out",
    *,
    topics: Mapping[str, str] | None = None,
    camera_files: Mapping[str, FilePath] | None = None,
    trajectories: FilePath | None = None,
    prior: FilePath | RigPrior | None = None,
    resume: bool = False,
    force: bool = False,
    config: FilePath | CalibrateConfig | None = None,
    progress: Progress = silent,
    **settings: Any,
) -> Calibration:
    """Find where every camera of a recording sits and looks.

    out: folder for the result and what its stages leave; one that holds another result is refused unless `force`
    (replace it) or `resume` (keep its finished stages). trajectories: folder of CAMERA.tum made by another odometry.
    prior: what is known beforehand, or its YAML file. config: a YAML file or tree of settings; settings: single fields
    of `rigwake.config.CalibrateConfig` (`reference="front"`, `duration_s=60`), which win. Cameras that failed
    are named in `checks["failed_cameras"]`. Raises UnobservableError when the motion cannot tell.
    """
    from rigwake.config import CalibrateConfig, load_config
    from rigwake.pipeline.calibration_run import calibrate as run
    from rigwake.pipeline.prior import RigPrior, load_prior

    if isinstance(config, CalibrateConfig):
        given = load_config(None, (), **(config.model_dump() | settings))
    else:
        given = load_config(None if config is None else Path(config), (), **settings)
    return run(
        recording,
        out,
        given,
        topics=topic_map(topics, camera_files),
        trajectories=trajectories,
        prior=prior if prior is None or isinstance(prior, RigPrior) else load_prior(prior),
        resume=resume,
        force=force,
        progress=progress,
    ).calibration


def odometry(
    recording: FilePath | Recording,
    out: FilePath,
    *,
    camera: str = "all",
    imu: bool = True,
    gnss: bool = True,
    attitude: bool = True,
    repair: bool = True,
    jobs: int = 0,
    options: CameraOdometryOptions | None = None,
    progress: Progress = silent,
) -> OdometryRun:
    """The trajectory of one camera, or of each; writes NAME.tum, tracks and masks into `out`.

    `result.done["front"].trajectory` is metric with an IMU or GNSS, else up to scale. Cameras without a trajectory are
    in `result.missing`, with the reason; the first reason is raised where no camera has one. Raises InputError where
    sensors contradict each other.
    """
    from rigwake.odometry.camera_odometry import CameraOdometryOptions
    from rigwake.pipeline.odometry_run import run_odometry

    run = run_odometry(
        opened(recording),
        Path(out),
        options or CameraOdometryOptions(),
        camera=camera,
        imu=imu,
        gnss=gnss,
        attitude=attitude,
        repair=repair,
        jobs=jobs,
        progress=progress,
    )
    if not run.done:
        raise next(iter(run.missing.values()))
    run.refuse_contradicted()
    return run


def handeye(
    reference: FilePath | Trajectory,
    *others: FilePath | Trajectory,
    out: FilePath | None = None,
    method: Literal["ml", "thesis"] = "ml",
    noise: Literal["auto", "estimated", "increments", "poses"] = "auto",
    time_offset: bool = True,
    scale: bool = False,
) -> HandeyeResult:
    """Where bodies sit on one rig, from one trajectory of each: no shared view, any clock, any origin.

    out: write a calibration.yaml there. See `rigwake handeye --help` for method and noise. Raises UnobservableError
    when they did not move enough, InputError where a trajectory contradicts the others.
    """
    from rigwake.calibration import save_calibration
    from rigwake.handeye.handeye_problem import HandeyeOptions
    from rigwake.pipeline.handeye_run import run_handeye

    options = HandeyeOptions(
        method=method,
        noise=None if noise == "auto" else noise,
        time_offset=time_offset,
        scale=scale,
    )
    result, _, _ = run_handeye(trajectory_of(reference), [trajectory_of(other) for other in others], options)
    if out is not None:
        provenance = {"command": "handeye", "method": method, "noise": result.noise}
        save_calibration(result.calibration(provenance), Path(out))
    return result


def intrinsics(
    images: FilePath | Sequence[FilePath],
    board: str,
    *,
    model: str = "auto",
    fov_deg: float | None = None,
    fix: Sequence[str] = (),
    free: Sequence[str] = (),
    out: FilePath | None = None,
    name: str = "camera",
    progress: Progress = silent,
) -> IntrinsicCalibration:
    """A camera's lens from images of a board (`chessboard:9x6:0.03`, `aprilgrid:6x6:0.088:0.3`).

    model: one of `rigwake intrinsics --help`; `auto` compares them on views that were held out. out: write the camera
    file there, under this name. Raises UsageError, InputError, UnobservableError.
    """
    import numpy as np

    from rigwake.intrinsics.board_calibration import calibrate as fit
    from rigwake.intrinsics.boards import parse_board
    from rigwake.intrinsics.detect import detect_board, list_images
    from rigwake.intrinsics.result_file import calibration_to_dict, save_intrinsics
    from rigwake.intrinsics.select import choose, cross_validate

    given = [Path(images)] if isinstance(images, str | Path) else [Path(path) for path in images]
    files, looked = list_images(given), iter(range(1, 1 << 62))
    observations = detect_board(
        parse_board(board),
        files,
        progress=lambda: progress(name, "looking for the board", next(looked) / len(files)),
    )
    scores = cross_validate(observations, progress=lambda: None) if model == "auto" else []
    result = fit(
        observations,
        choose(scores) if model == "auto" else model,
        fix=fix,
        free=free,
        max_angle=None if fov_deg is None else float(np.deg2rad(fov_deg / 2)),
    )
    if out is not None:
        save_intrinsics(Path(out), {name: calibration_to_dict(result, observations.unused, scores)})
    return result


def undistort(
    source: FilePath | Sequence[FilePath] | Recording,
    out: FilePath,
    *,
    camera_file: FilePath | None = None,
    camera: str | None = None,
    to: Target = "pinhole",
    focal_px: float | None = None,
    every: int = 1,
    progress: Progress = silent,
) -> list[Path]:
    """Undistort images, or one camera of a recording; returns the files written. See `rigwake undistort --help`."""
    from rigwake.pipeline.undistortion import undistort_source
    from rigwake.recording import Recording

    if isinstance(source, Recording):
        given: Recording | list[Path] = source
    else:
        given = [Path(source)] if isinstance(source, str | Path) else [Path(path) for path in source]
    return undistort_source(
        given,
        Path(out),
        camera_file=None if camera_file is None else Path(camera_file),
        camera=camera,
        target=to,
        focal_px=focal_px,
        every=every,
        progress=lambda done, total: progress("undistort", "undistorting", done / max(total, 1)),
    )


def simulate(
    scenario: FilePath = "demo",
    out: FilePath | None = None,
    *,
    duration_s: float | None = None,
    seed: int | None = None,
    jobs: int = 1,
    truth_images: bool = False,
    progress: Progress = silent,
) -> Recording:
    """Simulate a recording with known truth and write it: OUT.bag (ROS 1), OUT.mcap (ROS 2) or a folder.

    scenario: a file, or a preset. The truth goes to OUT_truth/. Raises UsageError for an OUT that is there already.
    """
    from rigwake.simulation.recording_target import require_recording_target
    from rigwake.simulation.scenario import changed_scenario, load_scenario
    from rigwake.simulation.write_simulation import write_simulation

    require_extra("embreex", "sim", "The simulator")
    target = require_recording_target(None if out is None else Path(out))
    chosen = changed_scenario(load_scenario(str(scenario)), duration_s, seed)
    write_simulation(
        chosen,
        target,
        workers=jobs,
        truth_images=truth_images,
        progress=lambda what, done, total: progress("simulate", what, done / max(total, 1)),
    )
    return open_recording(target)


def monitor(
    calibration: FilePath | Calibration,
    recording: FilePath | Recording,
    *,
    out: FilePath | None = None,
    log: FilePath | None = None,
    progress: Progress = silent,
) -> MonitorResult:
    """Has a camera moved since it was calibrated, or during this recording? `result.verdicts` by camera.

    out: folder for monitor.html and monitor.json. log: logbook that the verdicts go into. Raises InputError where the
    recording is not of the calibrated vessel, UnobservableError where it is too short.
    """
    from rigwake.monitor.kept_result import keep_result
    from rigwake.monitor.run import monitor as run
    from rigwake.tracking.hull_picture import load_hull_pictures

    calibrated, watched = calibration_of(calibration), opened(recording)
    file = Path(calibration) if isinstance(calibration, str | Path) else None
    hull = {} if file is None else load_hull_pictures(file, calibrated.cameras)
    result = run(calibrated, watched, progress, hull=hull)
    note = "" if file is None else file.name
    keep_result(
        calibrated,
        watched,
        result,
        None if out is None else Path(out),
        None if log is None else Path(log),
        note=note,
    )
    return result
