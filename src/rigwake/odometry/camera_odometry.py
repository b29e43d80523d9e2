"""Everything that odometry does for one camera of a recording: masks, tracks, motion, metres."""

from __future__ import annotations

import time
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal

from rigwake._progress import CountProgress
from rigwake._types import Array
from rigwake.cameras.protocol import CameraModel
from rigwake.errors import EstimationError, UnobservableError, UsageError
from rigwake.odometry.below_horizon import HorizonChoice
from rigwake.odometry.bridged import bridged
from rigwake.odometry.loop_closure import closed_path, find_loops, joined_tracks
from rigwake.odometry.measure import measure_camera
from rigwake.odometry.metric import MetricStart, metric_start
from rigwake.odometry.monocular import estimate_monocular, readjust
from rigwake.odometry.odometry_options import OdometryOptions
from rigwake.odometry.result import OdometryResult
from rigwake.odometry.rotation_only import estimate_rotations
from rigwake.odometry.self_calibration import RefinedLens, estimate_refining_lens
from rigwake.odometry.smoother import SmoothedOdometry, smooth
from rigwake.odometry.thesis_odometry import ThesisOptions, estimate_thesis
from rigwake.recording import AttitudeStream, CameraStream, GnssStream, ImuStream
from rigwake.tracking.masks import CameraMask
from rigwake.tracking.tracking_options import TrackingOptions
from rigwake.tracks import Tracks
from rigwake.trajectory import Trajectory

Method = Literal["adjusted", "thesis"]


@dataclass(frozen=True)
class CameraOdometryOptions:
    """What to do for one camera.

    method: `adjusted` (keyframes, bundle adjustment, smoother) or `thesis` (the frame-to-frame baseline).
    hull: look for the own boat in view. horizon: whether what lies below the horizon is left out (needs an IMU).
    mask_file: picture of the camera's size, white where it may be used.
    loops: recognise places seen before and join their tracks; without it this is done only where the odometry broke.
    refine_lens: without IMU and GNSS, refine distortion and principal point where the images contradict them.
    """

    method: Method = "adjusted"
    tracking: TrackingOptions = field(default_factory=TrackingOptions)
    odometry: OdometryOptions = field(default_factory=OdometryOptions)
    thesis: ThesisOptions = field(default_factory=ThesisOptions)
    hull: bool = True
    horizon: HorizonChoice = "auto"
    mask_file: Path | None = None
    loops: bool = False
    refine_lens: bool = True


@dataclass(frozen=True, eq=False)
class CameraOdometry:
    """One camera's motion and how it came about.

    trajectory: the result: metric where a sensor gave metres (`scale_source`), else up to scale.
    visual, start, smoothed: the steps, None where they were not taken. notes: what was left out or bridged.
    lens: the refined one that the bearings of `tracks` are by, None where the one given is right.
    seconds: wall time by stage.
    """

    trajectory: Trajectory
    scale_source: Literal["gnss", "imu", "none"]
    tracks: Tracks
    mask: CameraMask
    visual: OdometryResult | None = None
    start: MetricStart | None = None
    smoothed: SmoothedOdometry | None = None
    lens: RefinedLens | None = None
    notes: tuple[str, ...] = ()
    seconds: dict[str, float] = field(default_factory=dict)


def run_camera(
    stream: CameraStream,
    imu: ImuStream | None = None,
    gnss: GnssStream | None = None,
    options: CameraOdometryOptions | None = None,
    progress: CountProgress | None = None,
    attitude: AttitudeStream | None = None,
) -> CameraOdometry:
    """Masks, tracks, visual odometry and, with an IMU or GNSS, the metric smoother.

    attitude: of the IMU's axes, used where there is an IMU and no GNSS: the path's heading. progress: told stage, done
    and total. Raises UsageError without intrinsics, EstimationError where the images do
    not allow a start. Sensors that cannot tell the scale are named in the notes, and the result is up to scale.
    """
    options = options or CameraOdometryOptions()
    if stream.model is None:
        raise UsageError(
            f"camera {stream.name} has no intrinsics.", remedy="Calibrate one with `rigwake intrinsics`."
        )
    run = _OdometryRun(stream, imu, gnss, attitude, options, progress or (lambda stage, done, total: None))
    return run.thesis() if options.method == "thesis" else run.adjusted()


class _OdometryRun:
    """The stages of one run, with their times and notes."""

    def __init__(
        self,
        stream: CameraStream,
        imu: ImuStream | None,
        gnss: GnssStream | None,
        attitude: AttitudeStream | None,
        options: CameraOdometryOptions,
        progress: CountProgress,
    ) -> None:
        assert stream.model is not None
        self.stream, self.model = stream, stream.model
        self.imu, self.gnss, self.attitude = imu, gnss, attitude
        self.options = options
        self.progress = progress
        self.notes: list[str] = []
        self.seconds: dict[str, float] = {}
        self.stage_started = time.perf_counter()

    def _done(self, stage: str) -> None:
        now = time.perf_counter()
        self.seconds[stage], self.stage_started = now - self.stage_started, now

    def _measured(self) -> tuple[CameraMask, Tracks, Array | None]:
        wanted = self.options
        found = measure_camera(
            self.stream,
            self.imu,
            wanted.tracking,
            self.progress,
            hull=wanted.hull,
            horizon=wanted.horizon,
            mask_file=wanted.mask_file,
        )
        self.notes += found.notes
        self.seconds |= found.seconds
        self.stage_started = time.perf_counter()
        return found.mask, found.tracks, found.rotations

    def thesis(self) -> CameraOdometry:
        """The baseline: frame to frame, no map."""
        mask, tracks, rotations = self._measured()
        trajectory = estimate_thesis(tracks, self.model, self.options.thesis, rotations=rotations)
        self._done("odometry")
        return CameraOdometry(trajectory, "none", tracks, mask, notes=tuple(self.notes), seconds=self.seconds)

    def adjusted(self) -> CameraOdometry:
        """Map, then metres."""
        mask, tracks, rotations = self._measured()
        try:
            visual, lens = self._first_visual(tracks, rotations)
        except EstimationError as error:
            return self._turning(mask, tracks, error)
        tracks = tracks if lens is None else lens.tracks
        if self.options.loops or visual.counts.segments > 1:
            tracks, visual = self._closed(tracks, visual, rotations)
        self.notes += bridged(tracks, self.model, visual, self.imu, self.gnss)
        self._done("odometry")
        start = self._start(visual)
        smoothed = None
        if start is not None:
            self.progress("smoothing", 0, 1)
            smoothed = smooth(tracks, self.model, visual, start, self.imu, self.gnss, self.attitude)
            if smoothed.bridged:
                self.notes.append(
                    f"{smoothed.bridged} frames without a pose by vision were carried by the IMU"
                )
            self._done("smoothing")
        return CameraOdometry(
            smoothed.trajectory if smoothed is not None else visual.trajectory,
            start.scale_source if start is not None else "none",
            tracks,
            mask,
            visual,
            start,
            smoothed,
            lens,
            tuple(self.notes),
            self.seconds,
        )

    def _visual(self, tracks: Tracks, rotations: Array | None) -> OdometryResult:
        total = len(tracks.timestamps_ns)
        return estimate_monocular(
            tracks,
            self.model,
            self._options(),
            rotations=rotations,
            progress=lambda done: self.progress("odometry", min(done, total), total),
        )

    def _options(self) -> OdometryOptions:
        alone = self.imu is None and self.gnss is None  # else the smoother adjusts all frames anyway
        chosen = self.options.odometry
        return replace(chosen, adjust_all_frames=alone and chosen.adjust_all_frames)

    def _first_visual(
        self, tracks: Tracks, rotations: Array | None
    ) -> tuple[OdometryResult, RefinedLens | None]:
        """Vision; where it is alone, with a better lens if the one given does not fit."""
        if not self.options.refine_lens or self.imu is not None or self.gnss is not None:
            return self._visual(tracks, rotations), None

        def estimate(seen: Tracks, model: CameraModel) -> OdometryResult:
            self.model = model
            return self._visual(seen, rotations)

        visual, lens = estimate_refining_lens(tracks, self.model, estimate)
        if lens is not None:
            self.notes.append(
                f"the intrinsics given do not fit the images: distortion and principal point were refined by "
                f"{lens.shift_px:.1f} px (RMS), which takes away {100 * lens.gain:.0f} % of the cost"
            )
        return visual, lens

    def _closed(
        self, tracks: Tracks, visual: OdometryResult, rotations: Array | None
    ) -> tuple[Tracks, OdometryResult]:
        """Tracks of recognised places joined, the path closed and adjusted again; as they were without such places."""
        self.progress("recognising places", 0, 1)
        loops = find_loops(self.stream, tracks, self.model, visual)
        if not len(loops.frames):
            return tracks, visual
        joined = joined_tracks(tracks, loops.track_ids)
        try:
            frames, path = closed_path(visual, loops)
        except EstimationError as error:
            self.notes.append(error.cause)
            frames, path = visual.frame_indices[:0], visual.trajectory.world_from_body[:0]
        if len(frames) == len(visual.frame_indices):
            again = readjust(joined, self.model, frames, path, self._options())
        else:  # what the loops do not connect may be found again on the joined tracks
            again = self._visual(joined, rotations)
        self.notes.append(
            f"{len(loops.frames)} pairs of frames show a place again: {visual.counts.segments} segments became "
            f"{again.counts.segments}"
        )
        return joined, again

    def _turning(self, mask: CameraMask, tracks: Tracks, reason: EstimationError) -> CameraOdometry:
        """Rotations alone, if the camera only turned; else the reason why there is no motion."""
        try:
            trajectory = estimate_rotations(tracks, self.model, self.options.odometry)
        except EstimationError:
            raise reason from None
        self._done("odometry")
        self.notes.append(
            "it stood still or only turned: rotations are measured, positions are not (all zero)"
        )
        return CameraOdometry(trajectory, "none", tracks, mask, notes=tuple(self.notes), seconds=self.seconds)

    def _start(self, visual: OdometryResult) -> MetricStart | None:
        if self.imu is None and self.gnss is None:
            return None
        try:
            start = metric_start(visual.trajectory, self.imu, self.gnss)
        except UnobservableError as error:
            self.notes.append(f"up to scale: {error.cause}")
            return None
        self.notes += start.notes
        return start
