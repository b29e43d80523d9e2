"""The rig from every camera's trajectory and tracks: initial values, adjustment, checks."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from rigwake._progress import StageProgress
from rigwake.ba.rig.assemble_problem import assemble_problem
from rigwake.ba.rig.association_rounds import CrossCameraMatches, adjust_with_association
from rigwake.ba.rig.imu_noise import imu_noise_factors
from rigwake.ba.rig.initialisation import initial_rig
from rigwake.ba.rig.intrinsics_refinement import (
    LensBelief,
    intrinsics_statistics,
    prior_spreads_of,
    priors_of,
    with_free_intrinsics,
)
from rigwake.ba.rig.outlier_rounds import adjust
from rigwake.ba.rig.rig_values import AdjustedRig, InitialRig, RigMeasurements
from rigwake.ba.rig.rig_verdicts import ReferenceFrame, calibrated_cameras
from rigwake.ba.rig.split_checks import (
    association_errors,
    residual_statistics,
    split_half,
    split_half_summary,
)
from rigwake.ba.rig.uncontradicted_lenses import hold_uncontradicted, judge_lenses
from rigwake.ba.solver.covariance import covariance_of
from rigwake.ba.solver.rig_problem import RigProblem
from rigwake.calibration import Calibration
from rigwake.cameras.protocol import CameraModel
from rigwake.config import CalibrateConfig
from rigwake.errors import EstimationError, InputError, UnobservableError
from rigwake.geometry.se3 import SE3
from rigwake.pipeline.prior import RigPrior
from rigwake.pipeline.stream_selection import Selection
from rigwake.plausibility.noise_bounds import check_imu_noise
from rigwake.plausibility.values import SensorCheck, refuse
from rigwake.recording import Recording, static_transform
from rigwake.tracks import Tracks
from rigwake.trajectory import Trajectory

_MISFIT_PX, _MISFIT_FACTOR = 3.0, 8.0  # residuals beyond both are no noise


@dataclass(frozen=True, eq=False)
class RigEstimate:
    """The rig, and what the bundle adjustment and the cross-camera association left."""

    calibration: Calibration
    adjusted: AdjustedRig
    matches: CrossCameraMatches
    sensor_checks: tuple[SensorCheck, ...] = ()

    @property
    def lenses(self) -> dict[str, CameraModel]:
        """By camera, as the bundle adjustment left it."""
        return {camera.name: camera.model for camera in self.adjusted.solution.problem.cameras}


def initialise_rig(
    selection: Selection, trajectories: Mapping[str, Trajectory], config: CalibrateConfig, prior: RigPrior
) -> InitialRig:
    """Initial values from every camera's own motion (by camera, up to scale or metric) and what is known beforehand.

    Raises UsageError for a prior that names what is not there, UnobservableError when the motion determines nothing.
    """
    models = {name: selection.cameras[name].model for name in trajectories}
    first = initial_rig(
        trajectories,
        {name: model for name, model in models.items() if model is not None},
        selection.imu,
        selection.gnss,
    )
    return prior.applied_to(first, config)


def estimate_rig(
    recording: Recording,
    selection: Selection,
    tracks: Mapping[str, Tracks],
    first: InitialRig,
    config: CalibrateConfig,
    prior: RigPrior,
    *,
    masks: Path,
    beliefs: Mapping[str, LensBelief] | None = None,
    progress: StageProgress = lambda words, fraction: None,
) -> RigEstimate:
    """The rig from initial values and what was tracked.

    tracks: by camera, of all that `first` knows. prior: the one that `first` was made with. masks: folder of the
    cameras' masks, for cross-camera association. beliefs: priors of intrinsics, of cameras whose lens is not the one
    given, which is the `recording`'s. Images are only read with `config.adjustment.cross_camera`.

    Raises UsageError for a reference that is not there, UnobservableError when the motion
    determines nothing, EstimationError when no trustworthy answer was found.
    """
    measurements = RigMeasurements(
        {name: tracks[name] for name in first.cameras}, selection.imu, selection.gnss
    )
    adjusted, matches = _adjust(measurements, first, prior, selection, config, masks, beliefs or {}, progress)
    progress("checking", 0.8)
    reference = replace(
        reference_frame(recording, selection, first, config.reference), is_metric=first.scale_source != "none"
    )
    checks = _noise_checks(selection, adjusted) if config.sensor_checks else ()
    refuse(checks)
    given = {name: m for name in selection.cameras if (m := recording.camera(name).model) is not None}
    calibration = _conclude(selection, given, first, adjusted, matches, reference, config)
    return RigEstimate(calibration, adjusted, matches, checks)


def _noise_checks(selection: Selection, adjusted: AdjustedRig) -> tuple[SensorCheck, ...]:
    imu = selection.imu
    if imu is None or imu.gyro_noise_density is None or imu.accel_noise_density is None:
        return ()
    stated = {"gyro": imu.gyro_noise_density, "accel": imu.accel_noise_density}
    return check_imu_noise(imu_noise_factors(imu, adjusted.solution.problem.imu), stated)


def _adjust(
    measurements: RigMeasurements,
    first: InitialRig,
    prior: RigPrior,
    selection: Selection,
    config: CalibrateConfig,
    masks: Path,
    beliefs: Mapping[str, LensBelief],
    progress: StageProgress,
) -> tuple[AdjustedRig, CrossCameraMatches]:
    """The rig bundle adjustment: alone first, then with landmarks associated across cameras and times."""
    assembled = assemble_problem(measurements, first, config.adjustment)
    problem = _with_intrinsics(prior.constrained(assembled.problem), selection, config, beliefs)
    believed, assembled = priors_of(problem), replace(assembled, problem=problem)
    progress(f"adjusting {len(assembled.problem.observations)} observations", 0.0)
    across = config.adjustment.cross_camera
    # where rounds with landmarks of other cameras follow, they drop what is left of the outliers
    options = replace(config.adjustment, rounds=1) if across else config.adjustment
    adjusted = adjust(assembled, options, final=not across)
    matches = CrossCameraMatches.nothing()
    if across:
        adjusted, matches = adjust_with_association(
            hold_uncontradicted(adjusted, believed),
            selection.cameras,
            masks,
            config.adjustment,
            config.association,
            lambda words: progress(words, 0.5),
        )
    return judge_lenses(adjusted, believed), matches


def _with_intrinsics(
    problem: RigProblem,
    selection: Selection,
    config: CalibrateConfig,
    beliefs: Mapping[str, LensBelief],
) -> RigProblem:
    """The problem with intrinsics free, about what is believed of them; as it is where they are to be trusted."""
    if config.intrinsics == "fixed":
        return problem
    covariances = {
        name: stream.intrinsics_covariance
        for name, stream in selection.cameras.items()
        if stream.intrinsics_covariance is not None
    }
    return with_free_intrinsics(problem, covariances, beliefs)


def _conclude(
    selection: Selection,
    given: Mapping[str, CameraModel],
    first: InitialRig,
    adjusted: AdjustedRig,
    matches: CrossCameraMatches,
    reference: ReferenceFrame,
    config: CalibrateConfig,
) -> Calibration:
    """Covariance, verdicts and checks."""
    solution = adjusted.solution
    believed = adjusted.intrinsics_priors
    spreads = prior_spreads_of(solution.problem, believed, adjusted.ignored_intrinsics)
    covariance = covariance_of(solution.problem, clustered=True, prior_spreads=spreads)
    statistics = residual_statistics(solution)
    for name, numbers in statistics.items():
        numbers |= {"noise_factor": adjusted.noise_factors[name], "dropped": adjusted.dropped[name]}
    _refuse_misfits(statistics)
    for name, numbers in intrinsics_statistics(solution.problem, covariance, given, believed).items():
        statistics[name]["intrinsics"] = numbers
    topics = {name: stream.topic for name, stream in selection.cameras.items()}
    calibration = calibrated_cameras(solution, covariance, reference, statistics, topics)
    others = [camera for name, camera in calibration.cameras.items() if name != reference.name]
    if not any(camera.has_figures for camera in others):
        raise UnobservableError(
            "The motion determined nothing of any camera.", remedy=others[0].unobservable[0].remedy
        )
    return calibration.with_checks(
        residuals=statistics,
        split_half=split_half_summary(split_half(solution.problem, reference, config.adjustment)),
        hand_over=association_errors(solution, matches.unused),
        scale_source=first.scale_source,
        converged=solution.report.converged,
        imu_noise_factors=imu_noise_factors(selection.imu, solution.problem.imu),
    )


def _refuse_misfits(statistics: Mapping[str, Mapping[str, Any]]) -> None:
    """Residuals of several pixels, many times what was predicted, are no noise: the solution is wrong."""
    for name, numbers in statistics.items():
        rms_px, factor = numbers["rms_px"], numbers["noise_factor"]
        if rms_px is not None and rms_px > _MISFIT_PX and factor > _MISFIT_FACTOR:
            raise EstimationError(
                f"{name}: the rig leaves residuals of {rms_px:.1f} px, {factor:.0f} times what the tracks predict.",
                consequence="No one rigid rig with these lenses explains what the cameras saw.",
                remedy="Check the intrinsics (model, field of view, image size), the cameras' names, and the clocks.",
            )


def reference_frame(
    recording: Recording, selection: Selection, first: InitialRig | None, wanted: str
) -> ReferenceFrame:
    """The frame to report in; one of the tf tree (`base_link`) needs a chain of static transforms to the IMU's.

    first: needed for `auto` without an IMU only."""
    if wanted == "auto":
        wanted = "imu" if selection.imu is not None or first is None else first.reference_camera
    if wanted == "imu" and selection.imu is not None:
        return ReferenceFrame("imu", SE3.identity())
    frames = sorted({frame for edge in recording.static_transforms for frame in edge})
    is_frame = wanted == "base_link" or wanted.lstrip("/") in frames
    if is_frame and wanted not in selection.cameras and selection.imu is not None:
        reference_from_imu = static_transform(recording, wanted, selection.imu.frame_id)
        if reference_from_imu is None:
            raise InputError(
                f"The recording does not say where the IMU sits on {wanted}.",
                consequence="The cameras are known in the IMU's frame only.",
                remedy=f"Use --reference imu, or record /tf_static. Its frames: {', '.join(frames) or 'none'}.",
            )
        return ReferenceFrame(wanted, reference_from_imu)
    return ReferenceFrame(wanted, None)
