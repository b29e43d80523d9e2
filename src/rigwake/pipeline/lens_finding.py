"""`--intrinsics find`: lenses from nothing but the size of the pictures, a field of view and the gyroscope.

Every camera is tracked once with an equidistant lens (a pinhole under 100 degrees) that its field of view gives. What
was tracked, and how far the gyroscope turned meanwhile, tell focal length, centre and distortion within a pixel, and
which camera model predicts pairs of pictures that it was not fitted to. From there on all is as with lenses that were
given and found to be wrong: tracked anew, and refined with the rig.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import cv2
import numpy as np

from rigwake._progress import Progress
from rigwake._types import Array, Mask
from rigwake.ba.rig.intrinsics_refinement import intrinsics_prior, moved_px
from rigwake.cameras.models.lens import axis_focal_px
from rigwake.cameras.moved_lens import moved_lens
from rigwake.cameras.protocol import CameraModel
from rigwake.cameras.registry import camera_class
from rigwake.config import CalibrateConfig
from rigwake.errors import EstimationError, HostError, RigwakeError, UsageError
from rigwake.odometry.measure import measure_camera
from rigwake.pipeline.stream_selection import FrameWindow, Selection
from rigwake.plausibility.gyro_lens import (
    UNKNOWN,
    GyroLens,
    fit_lens_to_gyroscope,
    held_out_errors_px,
    pairs_for_lens,
)
from rigwake.plausibility.imu_samples import vet_samples
from rigwake.plausibility.motion_models import MotionScore, compare_models
from rigwake.plausibility.turn_fit import TurnFit, fit_turns
from rigwake.plausibility.view_pairs import ViewPairs
from rigwake.recording import CameraStream, ImuStream
from rigwake.tracking.masks import beyond_image_circle
from rigwake.tracking.track_turns import turns_of_tracks
from rigwake.tracks import Tracks
from rigwake.trajectory import Trajectory
from rigwake.workers import WorkerReport, run_in_processes

_CIRCLE_DEG = 180.0  # across an image circle, if nobody says more
_PINHOLE_BELOW_DEG = 100.0
_LEAST_DARK = 0.02  # of the picture, beyond the image circle
_MOST_FRAMES = 500
_SCALINGS, _SCALES, _HARDLY = 3, (0.8, 1.25), 0.01
_ROUNDS, _SETTLED_PX = 3, 0.3
# other beginnings: of the deviation of what distortion may be; of the focal length
_BENT, _LONGER = 0.5, 0.05
_UNRELATED = 0.5  # of the turns that the gyroscope does not explain
_POOR_PX = 1.5


@dataclass(frozen=True, eq=False)
class FoundLens:
    """A camera's lens from its motion. start: what the field of view alone gave. scores: of the models compared."""

    start: CameraModel
    found: GyroLens
    scores: tuple[MotionScore, ...]

    @property
    def words(self) -> str:
        """What was found, and from what."""
        lens = self.found.lens
        compared = ", ".join(
            f"{s.model} {s.held_out_px:.3f}" if s.found is not None else f"{s.model} not possible"
            for s in self.scores
        )
        return (
            f"lens found from {self.found.pairs} pairs of pictures and the gyroscope: {lens.model}, "
            f"{axis_focal_px(lens):.1f} px per radian, where the field of view gave {axis_focal_px(self.start):.1f}; "
            f"held-out errors in px: {compared}"
        )


@dataclass(frozen=True, eq=False)
class FoundLenses:
    """The selection with lenses found; cameras that showed none are left out of it, with the reason."""

    selection: Selection
    found: Mapping[str, FoundLens] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class _Job:
    stream: CameraStream
    imu: ImuStream
    config: CalibrateConfig


def find_lenses(selection: Selection, config: CalibrateConfig, progress: Progress) -> FoundLenses:
    """Lenses of all cameras of a selection from their motion, in processes of their own.

    `config.fov_deg`: full fields of view by camera, degrees: across the image circle where the pictures show one, else
    across their width. Raises UsageError without an IMU, or a field of view where nothing shows it; EstimationError
    where no camera's lens could be found.
    """
    if selection.imu is None:
        raise UsageError(
            "Lenses are found by comparing pictures with a gyroscope, and none is used.",
            remedy="Record an IMU, give lenses that are roughly right (--camera-file), or calibrate them with a board.",
        )
    imu = vet_samples(selection.imu, repair=config.repair).imu
    jobs = {
        name: _Job(replace(_stretch(stream, imu), model=start), imu, config)
        for name, stream in selection.cameras.items()
        for start in [starting_lens(stream, config.fov_deg.get(name, config.fov_deg.get("all")))]
    }
    results = run_in_processes(_in_process, jobs, config.jobs, progress)
    found = {name: lens for name, lens in results.items() if isinstance(lens, FoundLens)}
    lost = {name: reason for name, reason in results.items() if isinstance(reason, str)}
    if not found:
        raise EstimationError(
            "No camera's lens could be found from the motion. "
            + " ".join(f"{n}: {why}" for n, why in lost.items()),
            remedy="Check --fov, or give lenses that are roughly right (--camera-file).",
        )
    cameras = {
        name: replace(selection.cameras[name], model=lens.found.lens, intrinsics_covariance=None)
        for name, lens in found.items()
    }
    notes = tuple(f"{name}: {lens.words}" for name, lens in found.items())
    chosen = replace(
        selection,
        cameras=cameras,
        notes=(*selection.notes, *notes),
        left_out={**selection.left_out, **{n: f"its lens was not found: {why}" for n, why in lost.items()}},
    )
    return FoundLenses(chosen, found)


def starting_lens(stream: CameraStream, fov_deg: float | None) -> CameraModel:
    """The lens without distortion that a field of view gives: equidistant, or a pinhole under 100 degrees.

    fov_deg: across the image circle, if the pictures show one, else across their width. If nobody says, it is 180 for
    an image circle, and else that of the lens that the recording has. Raises UsageError where nothing tells.
    """
    circle = _image_circle(beyond_image_circle(stream))
    centre = np.array([(stream.width_px - 1) / 2, (stream.height_px - 1) / 2])
    across = float(stream.width_px)
    if circle is not None:
        centre, across = circle[0], 2 * circle[1]
    if fov_deg is None:
        fov_deg = _CIRCLE_DEG if circle is not None else _known_fov_deg(stream)
    half = float(np.deg2rad(fov_deg / 2))
    is_pinhole = circle is None and fov_deg < _PINHOLE_BELOW_DEG
    focal_px = across / 2 / (np.tan(half) if is_pinhole else half)
    lens = camera_class("pinhole" if is_pinhole else "kb4")
    values = lens.nominal_values(focal_px, float(centre[0]), float(centre[1]))
    return lens(values, stream.width_px, stream.height_px)


def _known_fov_deg(stream: CameraStream) -> float:
    if stream.model is None:
        raise UsageError(
            f"camera {stream.name} has no intrinsics, and its pictures show no image circle.",
            consequence="Where to start looking for its lens is not known.",
            remedy=f"Say how wide it sees, to ten per cent: --fov {stream.name}=90.",
        )
    return field_across_deg(stream.model)


def field_across_deg(lens: CameraModel) -> float:
    """Full field of view across the picture's width, degrees; where the lens ends before, as it would go on."""
    columns = np.arange(float(lens.width_px))
    bearings, seen = lens.unproject(np.stack([columns, np.full_like(columns, lens.height_px / 2)], axis=1))
    ends = np.flatnonzero(seen)[[0, -1]]
    angles = np.arctan2(np.hypot(bearings[ends, 0], bearings[ends, 1]), bearings[ends, 2])
    return float(np.rad2deg(angles.sum()) * (lens.width_px - 1) / max(int(ends[1] - ends[0]), 1))


def _image_circle(dark: Mask) -> tuple[Array, float] | None:
    """Centre and radius of what a lens lights, from the border of what stays dark (H, W); None if hardly anything does.

    Kasa's algebraic fit, twice, the second time without what is far from the first.
    """
    if dark.mean() < _LEAST_DARK:
        return None
    inner = cv2.dilate(dark.astype(np.uint8), np.ones((3, 3), np.uint8)).astype(bool) & ~dark
    inner[[0, -1], :] = inner[:, [0, -1]] = False
    rows, columns = np.nonzero(inner)
    if len(rows) < 50:
        return None
    points = np.stack([columns, rows], axis=1).astype(np.float64)
    centre, radius = np.zeros(2), 0.0
    for _ in range(2):
        A = np.column_stack([points, np.ones(len(points))])
        solved = np.linalg.lstsq(A, (points**2).sum(axis=1), rcond=None)[0]
        centre = solved[:2] / 2
        radius = float(np.sqrt(max(solved[2] + centre @ centre, 0.0)))
        off = np.abs(np.linalg.norm(points - centre, axis=1) - radius)
        near = off <= max(3 * float(np.median(off)), 1.0)
        points = points[near]
    return (centre, radius) if float(np.median(off)) < 0.03 * radius else None


def _stretch(stream: CameraStream, imu: ImuStream) -> CameraStream:
    """Of a long recording, the stretch in which the gyroscope turns most unevenly."""
    if len(stream) <= _MOST_FRAMES:
        return stream
    speed = np.linalg.norm(imu.gyro - np.median(imu.gyro, axis=0), axis=1)
    turned = np.concatenate([[0.0], np.cumsum(speed[1:] * np.diff(imu.timestamps_ns) * 1e-9)])
    at = np.interp(stream.timestamps_ns, imu.timestamps_ns, turned)
    first = int(np.argmax(at[_MOST_FRAMES - 1 :] - at[: len(at) - _MOST_FRAMES + 1]))
    stamps = stream.timestamps_ns[first : first + _MOST_FRAMES]
    return replace(stream, timestamps_ns=stamps, source=FrameWindow(stream.source, first))


def _in_process(job: _Job, progress: WorkerReport) -> FoundLens | str:
    """One camera; the reason in words where its lens was not found."""
    cv2.setNumThreads(1)
    try:
        return _find(job, progress)
    except HostError:
        raise
    except RigwakeError as error:
        return str(error)


def _find(job: _Job, progress: WorkerReport) -> FoundLens:
    start, name = job.stream.model, job.stream.name
    assert start is not None

    def told(stage: str, done: int, total: int) -> None:
        progress(name, f"finding the lens: {stage}", 0.8 * done / max(total, 1))

    measured = measure_camera(
        job.stream,
        job.imu,
        job.config.tracking,
        told,
        hull=job.config.find_self_mask,
        horizon=job.config.horizon,
    )
    progress(name, "finding the lens: comparing camera models", 0.8)
    return lens_from_tracks(measured.tracks, start, job.imu)


def lens_from_tracks(tracks: Tracks, start: CameraModel, imu: ImuStream) -> FoundLens:
    """The lens that pixels of tracks and a gyroscope show, from a start that may be tens of per cent off.

    Raises UnobservableError, EstimationError where they have too little in common.
    """
    lens, found = start, None
    for _ in range(_SCALINGS):
        _, turn = _turns_by(lens, tracks, imu)
        if abs(turn.scale - 1) < _HARDLY:
            break
        lens = moved_lens(lens, float(np.clip(turn.scale, *_SCALES)), np.zeros(2))
    for _ in range(_ROUNDS):
        turns, turn = _turns_by(lens, tracks, imu)
        pairs = pairs_for_lens(tracks, turns)
        begins = _beginnings(lens, start, pairs) if found is None else (lens,)
        fits = [fit_lens_to_gyroscope(pairs, start, imu, turn, first=first) for first in begins]
        found = min(fits, key=lambda fit: float(held_out_errors_px(fit, pairs, imu).mean()))
        moved = np.linalg.norm(moved_px(lens, found.lens, pairs.first), axis=1)
        lens = found.lens
        if float(np.sqrt(np.nanmean(moved**2))) < _SETTLED_PX:
            break
    assert found is not None
    best, scores = compare_models(pairs, found, imu, turn)
    if best.rms_px > _POOR_PX:
        raise EstimationError(
            f"{tracks.camera}: the best lens leaves {best.rms_px:.1f} px between pictures and gyroscope.",
            remedy="Check --fov and the stamps; give a lens that is roughly right (--camera-file).",
        )
    return FoundLens(start, best, scores)


def _turns_by(lens: CameraModel, tracks: Tracks, imu: ImuStream) -> tuple[Trajectory, TurnFit]:
    """How the camera turned by this lens, and how that compares with the gyroscope; EstimationError if not at all."""
    bearings, seen = lens.unproject(tracks.pixels)
    turns = turns_of_tracks(replace(tracks, bearings_cam=bearings).take(np.flatnonzero(seen)))
    turn = fit_turns(turns, imu)
    if turn.unexplained > _UNRELATED:
        raise EstimationError(
            f"{tracks.camera}: the gyroscope explains only {100 * (1 - turn.unexplained):.0f} % of its turns.",
            remedy="Check --fov, the stamps, and the unit of the gyroscope.",
        )
    return turns, turn


def _beginnings(lens: CameraModel, start: CameraModel, pairs: ViewPairs) -> tuple[CameraModel, ...]:
    """Where to begin: the lens that turns like the gyroscope, such as are bent in- and outwards, longer or shorter
    in the middle in turn, and that of the field of view: near points may pull the turns of a camera that looks aside.
    From one alone a fit may end where no lens is."""
    at = start.param_names.index("k1")
    std = float(np.sqrt(np.linalg.inv(intrinsics_prior(start, pairs.first, UNKNOWN).information)[at, at]))
    begins = [lens, start] if lens is not start else [lens]
    for sign in (-1.0, 1.0):
        params = lens.params.copy()
        params[at] += sign * _BENT * std
        begins.append(moved_lens(lens.with_params(params), 1 - sign * _LONGER, np.zeros(2)))
    return tuple(begins)
