"""The functions of `rigwake.api` for what is calibrated already: errors, differences, other formats, the report."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from rigwake._api_inputs import FilePath, calibration_of, trajectory_of
from rigwake.errors import UsageError
from rigwake.extras import require_extra

if TYPE_CHECKING:
    from rigwake.calibration import Calibration
    from rigwake.evaluation.rig_errors import CameraDifference, RigErrors
    from rigwake.evaluation.trajectory_evaluation import TrajectoryEvaluation
    from rigwake.geometry.align import AlignmentKind
    from rigwake.rig import Rig
    from rigwake.trajectory import Trajectory


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
        estimate = trajectory_of(found)
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
    return evaluate_against(calibration_of(found), rig_in_house_frames(rig, frame), gauge=gauge)[1]


def diff(
    first: FilePath | Calibration,
    second: FilePath | Calibration,
    *,
    ranges_m: Sequence[float] = (5.0, 20.0, 100.0),
) -> dict[str, CameraDifference]:
    """How far two calibrations of one rig are apart, by camera: degrees, millimetres, and pixels at these ranges."""
    from rigwake.evaluation.rig_errors import compare_calibrations
    from rigwake.exporters import in_common_frame

    a, b, _ = in_common_frame(calibration_of(first), calibration_of(second))
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
    found = calibration_of(calibration)
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
