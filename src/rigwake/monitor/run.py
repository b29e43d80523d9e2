"""`monitor`: from a calibration and a recording to what is said of every camera."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from rigwake._progress import Progress
from rigwake._types import Array, Indices
from rigwake.calibration import Calibration
from rigwake.errors import EstimationError, UnobservableError
from rigwake.geometry import so3
from rigwake.geometry.se3 import SE3
from rigwake.monitor.change_detection import Change
from rigwake.monitor.cross_search import find_cross_views
from rigwake.monitor.cues import HORIZON, CueSeries, cue_series, fuse, horizon_suspects, score_cues
from rigwake.monitor.horizon_cue import look_at_horizon, score_horizon
from rigwake.monitor.hull_edges import HullCue, hull_cues
from rigwake.monitor.innovations import belief_of
from rigwake.monitor.judge import Alarm, Judgement, judge_cues
from rigwake.monitor.rig_motion import RigMotion, rig_motion
from rigwake.monitor.score import BLOCK_S, BlockScores, block_starts, score_blocks, score_blocks_with_motion
from rigwake.monitor.states import CameraState
from rigwake.monitor.thresholds import Thresholds
from rigwake.monitor.verdict_words import drift_words, rig_notes, shift_words, unobservable_words
from rigwake.monitor.vessel_rig import MonitoredRig, camera_axes, prepare_rig
from rigwake.recording import Recording
from rigwake.rig import Rig
from rigwake.tracking.front_ends import track_camera
from rigwake.tracking.hull_picture import HullPicture
from rigwake.tracking.masks import lens_mask
from rigwake.tracking.self_mask import find_self_mask
from rigwake.tracking.tracking_options import TrackingOptions
from rigwake.tracks import Tracks

_FEWEST_BLOCKS = 2
_REFINE_ROUNDS = 3
_REFINE_BLOCKS = 12


def _silent(name: str, what: str, fraction: float) -> None:
    """Progress that nobody asked for."""


@dataclass(frozen=True, eq=False)
class CameraVerdict:
    """What is said of one camera at the end.

    state: the last. std_deg: (3,) about `AXIS_WORDS`, of a step over the last blocks. rotation, covariance: of a drift,
    rad, rig axes of the calibration, else None. since_ns: when it began. alarm: if there was one. words: one line.
    """

    name: str
    state: CameraState
    std_deg: Array
    words: str
    rotation: Array | None = None
    covariance: Array | None = None
    since_ns: int | None = None
    alarm: Alarm | None = None
    kind: str = ""
    rate_deg_per_hour: float = 0.0

    @property
    def size_deg(self) -> float | None:
        """Of a drift."""
        return None if self.rotation is None else float(np.rad2deg(np.linalg.norm(self.rotation)))

    @property
    def size_std_deg(self) -> float | None:
        """Standard deviation of `size_deg`."""
        if self.rotation is None or self.covariance is None:
            return None
        along = self.rotation / max(float(np.linalg.norm(self.rotation)), 1e-12)
        return float(np.rad2deg(np.sqrt(along @ self.covariance @ along)))


@dataclass(frozen=True, eq=False)
class MonitorResult:
    """verdicts: by camera. judgement: block by block. notes: in words. monitored: in the IMU's frame. hull: what the
    own hull says, of the cameras of which a picture of it is kept. cues: what each of them says for itself."""

    verdicts: Mapping[str, CameraVerdict]
    judgement: Judgement
    monitored: MonitoredRig
    motion: RigMotion
    tracks: Mapping[str, Tracks]
    notes: tuple[str, ...] = ()
    thresholds: Thresholds = field(default_factory=Thresholds)
    hull: Mapping[str, HullCue] = field(default_factory=dict)
    cues: Mapping[str, CueSeries] = field(default_factory=dict)

    @property
    def exit_code(self) -> int:
        """5: something moved, a camera or what an alarm was explained by; 3: not every camera could be told; else 0."""
        states = {verdict.state for verdict in self.verdicts.values()}
        if CameraState.DRIFTED in states or self.judgement.alarms:
            return 5
        return 3 if states & {CameraState.UNOBSERVABLE, CameraState.SUSPECT} else 0

    @property
    def blamed(self) -> tuple[str, ...]:
        """Cameras that drifted."""
        return tuple(name for name, v in self.verdicts.items() if v.state is CameraState.DRIFTED)


def monitor(
    calibration: Calibration,
    recording: Recording,
    progress: Progress = _silent,
    *,
    tracks: Mapping[str, Tracks] | None = None,
    thresholds: Thresholds | None = None,
    tracking: TrackingOptions | None = None,
    hull: Mapping[str, HullPicture] | None = None,
) -> MonitorResult:
    """Has a camera moved since it was calibrated, or while this was recorded?

    tracks: by camera, where they exist already; by default the images are tracked. hull: pictures of the own boat that
    were kept with the calibration, by camera (`load_hull_pictures`): they tell at standstill, too. Raises InputError
    where the recording is not of the calibrated vessel or lacks an IMU, UnobservableError where it is too short or one
    camera's.
    """
    thresholds = thresholds or Thresholds()
    monitored = prepare_rig(calibration, recording)
    motion = rig_motion(monitored.imu, monitored.gnss, monitored.calibration.antenna_rig)
    _require_length(monitored, motion)
    notes: list[str] = [f"{name}: {why}" for name, why in monitored.left_out.items()]
    if tracks is None:
        tracks = track_rig(monitored, motion, tracking or TrackingOptions(), progress, notes)
    starts = block_starts(tracks, monitored.rig, motion)
    if len(starts) < _FEWEST_BLOCKS:
        _too_short(len(starts) * BLOCK_S)
    progress("monitor", "scoring", 0.0)
    scores, motions = score_blocks_with_motion(tracks, monitored.rig, motion, starts_ns=starts)
    progress("monitor", "looking for what two cameras see", 0.3)
    views = find_cross_views(tracks, monitored.streams, monitored.rig, motion, motions)
    by_cue = score_cues(scores, motions, views, monitored.rig, motion)
    own_hulls = {name: picture.region for name, picture in (hull or {}).items()}
    lines = look_at_horizon(monitored.streams, monitored.rig, motion, starts, own_hulls)
    by_cue[HORIZON] = score_horizon(lines, scores)
    belief = belief_of(monitored.calibration, scores.cameras, thresholds)
    up = scores.gravity.mean(axis=0)
    up = up / np.linalg.norm(up) if np.linalg.norm(up) > 0.1 else np.array([0.0, 0.0, 1.0])
    axes = camera_axes(monitored.rig, up)
    judgement = judge_cues(fuse(by_cue), scores, belief, monitored.places, thresholds, axes)
    progress("monitor", "measuring what moved", 0.8)
    verdicts = {
        name: _verdict(name, judgement, tracks, monitored, motion, axes[k], thresholds)
        for k, name in enumerate(scores.cameras)
    }
    for name, why in monitored.left_out.items():
        verdicts[name] = CameraVerdict(name, CameraState.UNOBSERVABLE, np.full(3, np.inf), why)
    notes += rig_notes(judgement, thresholds)
    on_deck = _hull(monitored, starts, hull or {}, thresholds)
    verdicts, words = with_hull(verdicts, on_deck, monitored.rig_from_imu.rotation)
    notes += words
    cues = cue_series(by_cue, belief, thresholds)
    for name, why in horizon_suspects(cues[HORIZON], scores, thresholds).items():
        if verdicts[name].state is CameraState.UNOBSERVABLE:
            verdicts[name] = replace(verdicts[name], state=CameraState.SUSPECT, words=why)
    return MonitorResult(
        verdicts, judgement, monitored, motion, tracks, tuple(notes), thresholds, on_deck, cues
    )


def _hull(
    monitored: MonitoredRig, starts_ns: Indices, pictures: Mapping[str, HullPicture], thresholds: Thresholds
) -> dict[str, HullCue]:
    """The own hull over all blocks."""
    cameras = monitored.rig.cameras
    return hull_cues(
        monitored.streams,
        {name: camera.rig_from_cam for name, camera in cameras.items()},
        {name: camera.time_offset_s for name, camera in cameras.items()},
        (int(starts_ns[0]), int(starts_ns[-1] + round(BLOCK_S * 1e9))),
        pictures,
        thresholds,
    )


def with_hull(
    verdicts: Mapping[str, CameraVerdict], cues: Mapping[str, HullCue], rig_from_imu_rotation: Array
) -> tuple[dict[str, CameraVerdict], list[str]]:
    """Verdicts with what the own hull says, and notes.

    Where the motion cannot tell, or does not tell whose fault it is, a hull that is elsewhere in the picture makes the
    camera DRIFTED. Where the motion says that the camera is where it was, something on deck moved: a note. A hull that
    is where it was never makes a camera OK: it may have shifted with a part of the boat.
    """
    out, notes = dict(verdicts), []
    for name, cue in cues.items():
        verdict = out[name]
        if not cue.moved or cue.rotation is None or cue.covariance is None:
            notes.append(f"{name}: {cue.words}")
        elif verdict.state is CameraState.OK:
            notes.append(
                f"{name}: {cue.words}, yet the motion says that the camera did not turn: it shifted by some "
                "millimetres, or something on deck moved"
            )
        elif verdict.state is CameraState.DRIFTED:
            notes.append(f"{name}: {cue.words}")
        else:
            back = rig_from_imu_rotation
            out[name] = replace(
                verdict,
                state=CameraState.DRIFTED,
                rotation=back @ cue.rotation,
                covariance=back @ cue.covariance @ back.T,
                since_ns=cue.since_ns,
                kind="step",
                words=f"{cue.words} (step)",
            )
    return out, notes


def _require_length(monitored: MonitoredRig, motion: RigMotion) -> None:
    stamps = [stream.timestamps_ns for stream in monitored.streams.values() if len(stream)]
    if not stamps:
        raise UnobservableError(
            "The recording holds no images.", remedy="`rigwake inspect` shows what it holds."
        )
    first = max(min(int(s[0]) for s in stamps), int(motion.timestamps_ns[0]))
    last = min(max(int(s[-1]) for s in stamps), int(motion.timestamps_ns[-1]))
    if (last - first) * 1e-9 < _FEWEST_BLOCKS * BLOCK_S:
        _too_short(max(last - first, 0) * 1e-9)


def _too_short(seconds: float) -> None:
    raise UnobservableError(
        f"Images and IMU share {seconds:.0f} s; {_FEWEST_BLOCKS} blocks of {BLOCK_S:g} s are the least.",
        consequence="Nothing can be said of any camera.",
        remedy="Record half a minute or more, with turns.",
    )


def track_rig(
    monitored: MonitoredRig,
    motion: RigMotion,
    options: TrackingOptions,
    progress: Progress = _silent,
    notes: list[str] | None = None,
) -> dict[str, Tracks]:
    """Tracks of all cameras above the horizon, which the calibration and the IMU tell, beside the own hull."""
    tracks = {}
    for name, stream in monitored.streams.items():
        camera = monitored.rig.camera(name)
        mask = lens_mask(stream)
        try:
            mask = mask.with_region("hull", find_self_mask(stream, mask.usable))
        except (UnobservableError, EstimationError) as error:
            if notes is not None:
                notes.append(f"{name}: own hull not looked for: {error.cause}")
        on_rig = stream.timestamps_ns + round(camera.time_offset_s * 1e9)
        up_cam = motion.up_rig_at(on_rig) @ camera.rig_from_cam.rotation
        tracks[name] = track_camera(
            stream, options, mask, up_cam=up_cam, progress=_fraction(progress, name, len(stream))
        )
    return tracks


def _fraction(progress: Progress, name: str, total: int) -> Callable[[int], None]:
    return lambda done: progress(name, "tracking", done / max(total, 1))


def refined_step(
    tracks: Mapping[str, Tracks],
    rig: Rig,
    motion: RigMotion,
    camera: str,
    rotation: Array,
    starts_ns: Indices,
) -> tuple[Array, Array, BlockScores]:
    """A camera's rotation (3,) rad against `rig`, its noise covariance (3, 3), and the blocks' scores at it.

    The blocks after the change are scored again with the camera turned, until nothing is left to turn: residuals of
    half a degree are not small. rotation: a first value.
    """
    k = list(rig.cameras).index(camera)
    scores, covariance = None, np.full((3, 3), np.nan)
    for _ in range(_REFINE_ROUNDS):
        scores = score_blocks(tracks, _turned(rig, camera, rotation), motion, starts_ns=starts_ns)
        at = scores.columns(k)
        H, g = scores.H[:, at, at].sum(axis=0), scores.g[:, at].sum(axis=0)
        noise = np.einsum("bij,b->ij", scores.H[:, at, at], scores.inflation[:, k])
        inverse = np.linalg.pinv(H, rcond=1e-9, hermitian=True)
        rotation = so3.log(so3.exp(inverse @ g) @ so3.exp(rotation))
        covariance = inverse @ noise @ inverse
    assert scores is not None
    return rotation, covariance, scores


def _turned(rig: Rig, camera: str, rotation: Array) -> Rig:
    mounted = rig.camera(camera)
    moved = SE3(so3.exp(rotation) @ mounted.rig_from_cam.rotation, mounted.rig_from_cam.translation)
    return replace(rig, cameras={**rig.cameras, camera: replace(mounted, rig_from_cam=moved)})


def _verdict(
    name: str,
    judgement: Judgement,
    tracks: Mapping[str, Tracks],
    monitored: MonitoredRig,
    motion: RigMotion,
    axes: Array,
    thresholds: Thresholds,
) -> CameraVerdict:
    scores = judgement.scores
    k = scores.cameras.index(name)
    state, std = judgement.standings[-1][k], judgement.statistics.std_deg[-1, k]
    alarm = judgement.alarm_of(name)
    if state is CameraState.DRIFTED and alarm is not None and alarm.change is not None:
        return _drift(name, std, alarm, alarm.change, scores, tracks, monitored, motion, axes)
    if state is CameraState.SUSPECT:
        words = alarm.words if alarm is not None else "disagrees with the other cameras; watch it"
        return CameraVerdict(name, state, std, words, alarm=alarm)
    if state is CameraState.UNOBSERVABLE:
        is_tracked = len(tracks[name]) > 0
        return CameraVerdict(name, state, std, unobservable_words(scores, std, k, thresholds, is_tracked))
    shift = shift_words(judgement.shift_std_m[k], thresholds)
    return CameraVerdict(name, state, std, f"to {max(5 * float(std.max()), 0.01):.2f} deg; {shift}")


def _drift(
    name: str,
    std: Array,
    alarm: Alarm,
    change: Change,
    scores: BlockScores,
    tracks: Mapping[str, Tracks],
    monitored: MonitoredRig,
    motion: RigMotion,
    axes: Array,
) -> CameraVerdict:
    rotation, covariance = change.rotation, change.covariance
    first = change.block
    if change.kind == "step":
        if len(scores) - first > 1 and change.evidence > 0:
            first += 1  # the block in which it happened is of both kinds
        last = min(len(scores), first + _REFINE_BLOCKS)
        rotation, noise, _ = refined_step(
            tracks, monitored.rig, motion, name, rotation, scores.starts_ns[first:last]
        )
        covariance = noise + change.covariance / 4
    since = int(scores.starts_ns[change.block])
    in_rig = monitored.rig_from_imu.rotation @ rotation
    turned = monitored.rig_from_imu.rotation @ covariance @ monitored.rig_from_imu.rotation.T
    verdict = CameraVerdict(
        name,
        CameraState.DRIFTED,
        std,
        "",
        in_rig,
        turned,
        since,
        alarm,
        change.kind,
        change.rate_deg_per_hour,
    )
    size, sigma = verdict.size_deg or 0.0, verdict.size_std_deg or 0.0
    rate = change.rate_deg_per_hour if change.kind == "ramp" else None
    return replace(verdict, words=drift_words(size, sigma, axes @ rotation, rate))
