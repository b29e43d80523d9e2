"""Odometry of the cameras of a recording: sensors checked, one process per camera, files written."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import cv2

from rigwake._progress import Progress
from rigwake.atomic import write_text_atomic
from rigwake.errors import HostError, InputError, RigwakeError, UsageError
from rigwake.fingerprint import unchanged
from rigwake.odometry.camera_odometry import CameraOdometry, CameraOdometryOptions, run_camera
from rigwake.odometry.stereo import estimate_stereo
from rigwake.pipeline.out_folder import check_camera_names, check_out_folder, used_by_one
from rigwake.pipeline.sensor_checks import compare_sensors, vet_imu
from rigwake.pipeline.stream_selection import Selection
from rigwake.plausibility.values import SensorCheck, refuse
from rigwake.recording import (
    AttitudeStream,
    CameraStream,
    GnssStream,
    ImuStream,
    Recording,
    main_gnss,
    main_imu,
)
from rigwake.report.odometry_page import odometry_page
from rigwake.rig import Rig
from rigwake.tracking.front_ends import track_camera
from rigwake.trajectory import Trajectory
from rigwake.workers import WorkerReport, run_in_processes
from rigwake.writers.trajectory_writer import write_tum


class Sensors(NamedTuple):
    """What is used beside the camera."""

    imu: ImuStream | None
    gnss: GnssStream | None
    attitude: AttitudeStream | None


@dataclass(frozen=True, eq=False)
class OdometryRun:
    """What became of each camera. imu_checks: of the IMU beforehand; checks: of all sensors with the result."""

    results: Mapping[str, CameraOdometry | RigwakeError]
    imu_checks: tuple[SensorCheck, ...] = ()
    checks: tuple[SensorCheck, ...] = ()

    @property
    def done(self) -> dict[str, CameraOdometry]:
        """The cameras that have a trajectory."""
        return {n: r for n, r in self.results.items() if not isinstance(r, RigwakeError)}

    @property
    def missing(self) -> dict[str, RigwakeError]:
        """The cameras that have none, and why."""
        return {n: r for n, r in self.results.items() if isinstance(r, RigwakeError)}

    @property
    def lens_checks(self) -> list[SensorCheck]:
        """Lenses that do not fit their own tracks: worth a word, but a path by them is not worthless."""
        return [c for c in self.checks if not c.agrees and c.part == "lens"]

    def refuse_contradicted(self) -> None:
        """Raises InputError where sensors, lenses aside, contradict each other."""
        lenses = self.lens_checks
        refuse([c for c in self.checks if c not in lenses], "What was written is not to be trusted.")


def cameras_named(opened: Recording, camera: str) -> list[CameraStream]:
    """One camera by its name, or `all`. Raises UsageError for an unknown name, InputError where there is none."""
    streams = list(opened.cameras.values()) if camera == "all" else [opened.camera(camera)]
    if not streams:
        raise InputError(
            f"{opened.path.name} has no cameras.",
            remedy="`rigwake inspect` lists what it holds; name image topics with --topic camera.front=/a/b.",
        )
    check_camera_names(stream.name for stream in streams)
    return streams


def run_odometry(
    opened: Recording,
    out: Path,
    options: CameraOdometryOptions,
    *,
    camera: str = "all",
    imu: bool = True,
    gnss: bool = True,
    attitude: bool = True,
    repair: bool = True,
    jobs: int = 0,
    progress: Progress = lambda name, what, fraction: None,
    checked: Callable[[tuple[SensorCheck, ...]], None] = lambda checks: None,
) -> OdometryRun:
    """Trajectories of one camera or of all; writes NAME.tum, tracks and masks of those that have one, and the
    page odometry.html, into `out`.

    imu, gnss, attitude: whether to use the recording's. repair: correct the IMU's units. jobs: processes (0: one per
    core). checked: called with the checks of the IMU before the images are read. A camera that fails does not stop
    the others: see `missing`. Raises InputError where the IMU contradicts itself.
    """
    check_out_folder(out, [opened.path], force=True, resume=False)
    streams = cameras_named(opened, camera)
    sensors = Sensors(
        main_imu(opened) if imu else None,
        main_gnss(opened) if gnss else None,
        next(iter(opened.attitudes.values()), None) if attitude else None,
    )
    imu_checks: tuple[SensorCheck, ...] = ()
    if sensors.imu is not None:
        cameras = {stream.name: stream for stream in streams}
        vetted = vet_imu(Selection(cameras, sensors.imu, None), tuple(cameras), repair=repair)
        sensors, imu_checks = sensors._replace(imu=vetted.selection.imu), tuple(vetted.checks)
        checked(imu_checks)
    work = {stream.name: _OdometryJob(stream, sensors, options) for stream in streams}
    with used_by_one(out), unchanged(opened.path) as check_unchanged:
        found = run_in_processes(_in_process, work, jobs, progress)
        results = {name: _outcome(*result) for name, result in found.items()}
        check_unchanged()
        run = OdometryRun(results, imu_checks, _compared(sensors, streams, results))
        for name, result in run.done.items():
            _write(out, name, result)
        write_text_atomic(out / "odometry.html", odometry_page(opened, results))
    return run


def stereo_pair(opened: Recording, names: Sequence[str]) -> tuple[CameraStream, CameraStream]:
    """Two cameras of a recording. Raises UsageError unless two different ones are named."""
    if len(names) != 2 or names[0] == names[1]:
        raise UsageError(
            f"Stereo odometry needs two cameras, not {', '.join(names) or 'none'}.",
            remedy="As in --stereo left,right.",
        )
    check_camera_names(names)
    return opened.camera(names[0]), opened.camera(names[1])


def run_stereo(
    first: CameraStream, second: CameraStream, rig: Rig, options: CameraOdometryOptions
) -> Trajectory:
    """Metric trajectory of the first of two synchronised cameras whose places on the rig are known.

    Raises UsageError where the rig lacks one of them, without intrinsics or common stamps; EstimationError where a
    frame sees too few points in both cameras.
    """
    rig_from_first, rig_from_second = (rig.camera(s.name).rig_from_cam for s in (first, second))
    if first.model is None or second.model is None:
        raise UsageError("Stereo odometry needs the intrinsics of both cameras.")
    tracks = track_camera(first, options=options.tracking)
    return estimate_stereo(
        tracks, first, second, rig_from_second.inverse() * rig_from_first, options.odometry
    )


def _compared(
    sensors: Sensors, streams: list[CameraStream], results: Mapping[str, CameraOdometry | RigwakeError]
) -> tuple[SensorCheck, ...]:
    """Every camera's own motion against its lens and the IMU."""
    done = {n: r for n, r in results.items() if not isinstance(r, RigwakeError) and r.visual is not None}
    lenses = {s.name: s.model for s in streams if s.model is not None}
    models = {n: lenses[n] if r.lens is None else r.lens.camera for n, r in done.items()}
    paths = {n: r.visual.trajectory for n, r in done.items() if r.visual is not None}
    tracks = {n: r.tracks for n, r in done.items()}
    return compare_sensors(sensors.imu, tracks, models, paths, repair=False).checks


class _OdometryJob(NamedTuple):
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


def _in_process(job: _OdometryJob, progress: WorkerReport) -> tuple[CameraOdometry | None, _Failure | None]:
    """One camera; an error travels between processes as its words, since exceptions pickle only their message."""
    cv2.setNumThreads(1)  # the processes share the processors already
    stream, sensors, options = job

    def report(stage: str, done: int, total: int) -> None:
        progress(stream.name, stage, done / max(total, 1))

    try:
        found = run_camera(stream, sensors.imu, sensors.gnss, options, report, sensors.attitude)
    except HostError:
        raise
    except RigwakeError as error:
        return None, (error.cause, error.consequence, error.remedy, error.exit_code)
    return found, None


def _write(output: Path, name: str, result: CameraOdometry) -> None:
    write_tum(result.trajectory, output / f"{name}.tum")
    result.tracks.save(output / f"tracks_{name}.npz")
    result.mask.save(output, name)


def odometry_summary(
    opened: Recording, results: Mapping[str, CameraOdometry | RigwakeError]
) -> dict[str, Any]:
    """What is kept of a run as JSON."""
    return {"recording": opened.path.name, "cameras": {n: camera_summary(r) for n, r in results.items()}}


def camera_summary(result: CameraOdometry | RigwakeError) -> dict[str, Any]:
    """Counts, scale and times of one camera; `error` for one that failed."""
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
            "gnss_refused": result.smoothed.gnss_gated,
            "time_offset_s": result.smoothed.time_offset_s,
        }
    return summary
