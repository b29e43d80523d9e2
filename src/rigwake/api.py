"""rigwake from Python: a function per verb, which does all that its verb does.

Paths may be strings. `topics` says which topic is which sensor (`{"camera.front": "/a/b"}`), `camera_files` names
files of lenses (`{"front": "front.yaml"}`). `progress` is called with a name, what is done, and the fraction of it.
All raise the errors of `rigwake.errors`: cause, consequence and remedy, in place of an exit code.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from rigwake.errors import InputError, UsageError
from rigwake.extras import require_extra

if TYPE_CHECKING:
    from rigwake.calibration import Calibration
    from rigwake.config import CalibrateConfig
    from rigwake.evaluation.rig_errors import CameraDifference, RigErrors
    from rigwake.evaluation.trajectory_evaluation import TrajectoryEvaluation
    from rigwake.geometry.align import AlignmentKind
    from rigwake.handeye.handeye_result import HandeyeResult
    from rigwake.inspection.readiness import Readiness
    from rigwake.inspection.recording_inspection import Inspection
    from rigwake.intrinsics.board_calibration import IntrinsicCalibration
    from rigwake.monitor.run import MonitorResult
    from rigwake.odometry.camera_odometry import CameraOdometryOptions
    from rigwake.pipeline.odometry_run import OdometryRun
    from rigwake.pipeline.prior import RigPrior
    from rigwake.pipeline.undistortion import Target
    from rigwake.readers.topics import TopicMap
    from rigwake.recording import Recording
    from rigwake.rig import Rig
    from rigwake.trajectory import Trajectory

FilePath = Path | str
Progress = Callable[[str, str, float], None]
FUNCTIONS = (
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
)
__all__ = [*FUNCTIONS, "FilePath", "Progress"]


def _silent(name: str, what: str, fraction: float) -> None:
    """Progress that nobody asked for."""


def open_recording(
    path: FilePath,
    *,
    topics: Mapping[str, str] | None = None,
    camera_files: Mapping[str, FilePath] | None = None,
) -> Recording:
    """Open a ROS bag, MCAP file, or folder; images are read when they are used. Raises InputError."""
    from rigwake.readers.open import open_recording as read

    return read(path, _topic_map(topics, camera_files))


def load_calibration(path: FilePath) -> Calibration:
    """Read a `calibration.yaml`, or a file of any format that `export` writes. Raises InputError."""
    from rigwake.exporters import read_calibration

    return read_calibration(path)


def inspect(
    recording: FilePath | Recording, *, html: FilePath | None = None, progress: Progress = _silent
) -> tuple[Inspection, Readiness]:
    """Sensors, rates, gaps, clocks and motion of a recording, and whether that is enough to calibrate.

    html: also write the page with plots. Sensors that contradict the others are findings of severity `error`.
    """
    from rigwake.atomic import write_text_atomic
    from rigwake.pipeline.checked_inspection import inspect_with_checks
    from rigwake.report.inspection_page import inspection_page

    inspection, verdict, _ = inspect_with_checks(
        _opened(recording), lambda what, done, total: progress("inspect", what, done / max(total, 1))
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
    progress: Progress = _silent,
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
        topics=_topic_map(topics, camera_files),
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
    progress: Progress = _silent,
) -> OdometryRun:
    """The trajectory of one camera, or of each; writes NAME.tum, tracks and masks into `out`.

    `result.done["front"].trajectory` is metric with an IMU or GNSS, else up to scale. Cameras without a trajectory are
    in `result.missing`, with the reason; the first reason is raised where no camera has one. Raises InputError where
    sensors contradict each other.
    """
    from rigwake.odometry.camera_odometry import CameraOdometryOptions
    from rigwake.pipeline.odometry_run import run_odometry
    from rigwake.plausibility.values import refuse

    run = run_odometry(
        _opened(recording),
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
    lenses = [c for c in run.checks if not c.agrees and "lens" in c.hypothesis]
    refuse([c for c in run.checks if c not in lenses], "What was written is not to be trusted.")
    return run


def handeye(
    reference: FilePath | Trajectory,
    *others: FilePath | Trajectory,
    out: FilePath | None = None,
    method: Literal["ml", "seed"] = "ml",
    noise: Literal["auto", "estimated", "increments", "poses"] = "auto",
    time_offset: bool = True,
    scale: bool = False,
) -> HandeyeResult:
    """Where bodies sit on one rig, from one trajectory of each: no shared view, any clock, any origin.

    out: write a calibration.yaml there. See `rigwake handeye --help` for method and noise. Raises UnobservableError
    when they did not move enough, InputError where a trajectory contradicts the others.
    """
    from rigwake.calibration import save_calibration
    from rigwake.handeye.handeye_result import HandeyeOptions
    from rigwake.pipeline.handeye_run import run_handeye

    options = HandeyeOptions(
        method="ml" if method == "ml" else "thesis",
        noise=None if noise == "auto" else noise,
        time_offset=time_offset,
        scale=scale,
    )
    result, _, _ = run_handeye(_trajectory(reference), [_trajectory(other) for other in others], options)
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
    progress: Progress = _silent,
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
    progress: Progress = _silent,
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


def evaluate(
    found: FilePath | Calibration | Trajectory,
    truth: FilePath | Rig | Trajectory,
    *,
    gauge: Literal["reference", "align"] = "reference",
    frame: str = "enu",
    alignment: AlignmentKind | Literal["auto", "none"] = "auto",
    max_difference_s: float = 0.01,
) -> RigErrors | TrajectoryEvaluation:
    """Errors of a calibration against a known rig, or of a trajectory against a known one.

    gauge: of a rig: in its reference frame, or after fitting the whole rig to the truth. frame: what the transforms of
    the truth mean. alignment, max_difference_s: of trajectories. See `rigwake evaluate --help`.
    """
    from rigwake.evaluation.trajectory_evaluation import evaluate_trajectory, usual_alignment
    from rigwake.exporters.known_rig_errors import evaluate_against, is_trajectory_file
    from rigwake.exporters.known_rigs import read_known_rig, rig_in_house_frames
    from rigwake.readers.trajectories import read_trajectory
    from rigwake.rig import Rig
    from rigwake.trajectory import Trajectory

    if isinstance(found, Trajectory) or (isinstance(found, str | Path) and is_trajectory_file(Path(found))):
        estimate = _trajectory(found)
        if isinstance(truth, Rig):
            raise UsageError("A trajectory is compared with a trajectory, not with a rig.")
        known = truth if isinstance(truth, Trajectory) else read_trajectory(truth, frame=frame).trajectory
        fitted = usual_alignment(estimate) if alignment == "auto" else alignment
        return evaluate_trajectory(
            known,
            estimate,
            alignment=None if fitted == "none" else fitted,
            max_difference_s=max_difference_s,
        )
    if isinstance(truth, Trajectory):
        raise UsageError("A calibration is compared with a rig, not with a trajectory.")
    rig = truth if isinstance(truth, Rig) else read_known_rig(truth)
    return evaluate_against(_calibration(found), rig_in_house_frames(rig, frame), gauge=gauge)[1]


def diff(
    first: FilePath | Calibration,
    second: FilePath | Calibration,
    *,
    ranges_m: Sequence[float] = (5.0, 20.0, 100.0),
) -> dict[str, CameraDifference]:
    """How far two calibrations of one rig are apart, by camera: degrees, millimetres, and pixels at these ranges."""
    from rigwake.evaluation.rig_errors import compare_calibrations
    from rigwake.exporters import in_common_frame

    a, b, _ = in_common_frame(_calibration(first), _calibration(second))
    return compare_calibrations(a, b, list(ranges_m))


def export(
    calibration: FilePath | Calibration,
    to: str,
    out: FilePath,
    *,
    parent_frame: str = "",
    child_frame: str = "{name}_optical_frame",
    imu: FilePath | None = None,
    max_fit_error_px: float = 0.5,
    allow_unobservable: bool = False,
) -> tuple[str, ...]:
    """Write a calibration in another program's format; returns what the user must know about the result.

    to: a format of `rigwake export --help`. imu: Kalibr's imu.yaml, for formats that hold IMU noise. Raises
    UnobservableError for cameras that are not fully determined, unless `allow_unobservable` leaves them out.
    """
    from rigwake.exporters import FORMATS, ExportOptions, export_calibration
    from rigwake.exporters.basalt import read_imu_noise

    if to not in FORMATS:
        raise UsageError(f"The format {to!r} is unknown.", remedy=f"Choose from {', '.join(FORMATS)}.")
    noise = None if imu is None else read_imu_noise(Path(imu))
    options = ExportOptions(parent_frame, child_frame, noise, max_fit_error_px)
    found = _calibration(calibration)
    return tuple(export_calibration(found, to, Path(out), options, allow_unobservable=allow_unobservable))


def report(
    folder: FilePath,
    *,
    figures: FilePath | None = None,
    figure_format: Literal["png", "svg"] = "png",
    rrd: FilePath | None = None,
) -> Path:
    """Rebuild `report.html` in the folder of a calibration and return its path.

    figures: also write figures for papers to this folder. rrd: also a recording for the rerun viewer.
    """
    from rigwake.report import build_report, load_report_content

    content = load_report_content(folder)
    page = build_report(content)
    if figures is not None:
        require_extra("matplotlib", "report", "Writing figures")
        from rigwake.report.figures import write_figures

        write_figures(content, Path(figures), figure_format)
    if rrd is not None:
        from rigwake.report.rerun_log import log_to_rerun

        log_to_rerun(content, Path(rrd), view=False)
    return page


def simulate(
    scenario: FilePath = "demo",
    out: FilePath | None = None,
    *,
    duration_s: float | None = None,
    seed: int | None = None,
    jobs: int = 1,
    truth_images: bool = False,
    progress: Progress = _silent,
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
    progress: Progress = _silent,
) -> MonitorResult:
    """Has a camera moved since it was calibrated, or during this recording? `result.verdicts` by camera.

    out: folder for monitor.html and monitor.json. log: logbook that the verdicts go into. Raises InputError where the
    recording is not of the calibrated vessel, UnobservableError where it is too short.
    """
    from rigwake.monitor.kept_result import keep_result
    from rigwake.monitor.run import monitor as run

    calibrated, opened = _calibration(calibration), _opened(recording)
    result = run(calibrated, opened, progress)
    note = Path(calibration).name if isinstance(calibration, str | Path) else ""
    keep_result(
        calibrated,
        opened,
        result,
        None if out is None else Path(out),
        None if log is None else Path(log),
        note=note,
    )
    return result


def _topic_map(
    topics: Mapping[str, str] | None, camera_files: Mapping[str, FilePath] | None
) -> TopicMap | None:
    from rigwake.readers.topics import TopicMap

    if not topics and not camera_files:
        return None
    assignments = [f"{sensor}={topic}" for sensor, topic in (topics or {}).items()]
    files = [f"{camera}={file}" for camera, file in (camera_files or {}).items()]
    return TopicMap.from_options(assignments, None, files)


def _opened(recording: FilePath | Recording) -> Recording:
    return open_recording(recording) if isinstance(recording, str | Path) else recording


def _calibration(calibration: FilePath | Calibration | Trajectory) -> Calibration:
    from rigwake.calibration import Calibration

    if isinstance(calibration, str | Path):
        return load_calibration(calibration)
    if not isinstance(calibration, Calibration):
        raise InputError("A calibration is wanted, or the path of one.")
    return calibration


def _trajectory(trajectory: FilePath | Trajectory | Calibration) -> Trajectory:
    from rigwake.readers.trajectories import read_trajectory
    from rigwake.trajectory import Trajectory

    if isinstance(trajectory, str | Path):
        return read_trajectory(trajectory).trajectory
    if not isinstance(trajectory, Trajectory):
        raise InputError("A trajectory is wanted, or the path of one.")
    return trajectory
