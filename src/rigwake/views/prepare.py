"""Everything a view needs from a calibration and a recording, found once before the first picture is drawn."""

from __future__ import annotations

import importlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from rigwake._types import Mask
from rigwake.calibration import Calibration
from rigwake.errors import EstimationError, InputError, RigwakeError, UsageError
from rigwake.readers.open import open_recording
from rigwake.readers.picture_files import picture_or_none
from rigwake.readers.topics import TopicMap
from rigwake.recording import CameraStream, Recording
from rigwake.tracking.masks import beyond_image_circle
from rigwake.tracking.self_mask import find_self_mask
from rigwake.views.attitude import LevelAttitude
from rigwake.views.colour import ColourModel, ColourSamples, colour_samples, fit_colour
from rigwake.views.depth.motion import Earlier, earlier_time
from rigwake.views.frames import FrameSet, frame_sets, output_times, require_fit
from rigwake.views.height import HeightEstimate, estimate_height
from rigwake.views.levelling import Leveller, choose_attitudes
from rigwake.views.rig_sources import read_rig_source
from rigwake.views.seams import SeamMatches, SeamMeter
from rigwake.views.stills import picture_per_camera
from rigwake.views.surface import SHELL_M, FixedSurface, Shell, Surface, SurfaceSource, WaterAndShell
from rigwake.views.surround_rig import SurroundRig, surround_rig

SURFACES = ("stixels", "shell", "water")
STABILISERS = ("imu", "horizon", "off")
_SAMPLES = 8  # frame sets that colours, shell and height are estimated from
_FAR_SHELL_M = 500.0
_SHELL_LIMITS_M = (15.0, 300.0)

Say = Callable[[str], None]


@dataclass(frozen=True)
class SurroundOptions:
    """What a person may choose. height_m: of the cameras (mean) above the water; None: estimated.
    shell_m: radius of the shell; None: estimated from what stands far away. hull: `show` or `mask` the own vessel."""

    stabilise: str = "imu"
    surface: str = "shell"
    shell_m: float | None = None
    height_m: float | None = None
    hull: str = "show"
    trajectory: Path | None = None
    correct_colours: bool = True


@dataclass(frozen=True, eq=False)
class SurroundSetup:
    """A rig with pictures, and all that was found out about it. notes: sentences for people."""

    rig: SurroundRig
    recording: Recording
    streams: Mapping[str, CameraStream]
    leveller: Leveller
    surfaces: SurfaceSource
    masks: Mapping[str, Mask]
    colour: ColourModel | None
    calibration: Calibration | None
    height: HeightEstimate | None
    samples: tuple[FrameSet, ...]
    shell_m: float
    wave_std_m: float
    notes: tuple[str, ...]

    def times_ns(self) -> NDArray[np.int64]:
        """Times of the frame sets, rig clock."""
        return output_times(self.streams, self.rig)

    def frame_set_at(self, seconds: float | None) -> FrameSet:
        """The frame set nearest to a time in seconds since the first picture; the middle one if None.

        Raises InputError if every camera is missing there, UsageError outside the recording.
        """
        times = self.times_ns()
        elapsed = (times - times[0]) * 1e-9
        if seconds is not None and not -0.5 <= seconds <= elapsed[-1] + 0.5:
            raise UsageError(
                f"--at {seconds:g} lies outside the recording.", remedy=f"It lasts {elapsed[-1]:.1f} s."
            )
        index = len(times) // 2 if seconds is None else int(np.abs(elapsed - seconds).argmin())
        first = max(index - 3, 0)  # a frozen picture is known by those before it
        frames = list(frame_sets(self.streams, self.rig, times[first : index + 1]))[-1]
        require_pictures(frames)
        return frames

    def earlier(self, frames: FrameSet) -> Earlier | None:
        """The pictures before a frame set that show ranges by the way made since; None where the way is not known."""
        track = self.leveller.track
        then_ns = earlier_time(track, self.times_ns(), frames.timestamp_ns)
        moved = None if track is None or then_ns is None else track.moved(then_ns, frames.timestamp_ns)
        if moved is None or then_ns is None:
            return None
        before = next(iter(frame_sets(self.streams, self.rig, [then_ns])))
        return Earlier(before.images(self.rig), moved)

    def surface_at(self, frames: FrameSet, attitude: LevelAttitude) -> Surface:
        """The surface at the time of a frame set."""
        return self.surfaces.surface(frames.images(self.rig), self.rig, attitude, frames.timestamp_ns)

    def attitude_at(self, frames: FrameSet) -> LevelAttitude:
        """The attitude at the time of a frame set."""
        return self.leveller.at(frames.timestamp_ns, frames.images(self.rig))


def require_pictures(frames: FrameSet) -> None:
    """InputError if every camera is missing."""
    if frames.is_missing.all():
        reasons = ", ".join(f"{name}: {why}" for name, why in frames.missing.items())
        raise InputError(
            f"All cameras are missing ({reasons}).",
            consequence="There is nothing to show.",
            remedy="Look at the recording with `rigwake inspect`, or choose another time with --at.",
        )


def open_for_view(path: Path, names: Sequence[str], topics: TopicMap | None = None) -> Recording:
    """A recording, or a folder with one picture per camera."""
    one_each = picture_per_camera(path, names)
    return one_each if one_each is not None else open_recording(path, topics)


def prepare_surround(
    calibration: Path,
    recording: Path,
    options: SurroundOptions,
    topics: TopicMap | None = None,
    say: Say = lambda _: None,
) -> SurroundSetup:
    """Read both, check that they fit, and find attitude, masks, colours, height above the water and shell.

    say: told what is being done. Raises UsageError or InputError if they do not fit or nothing can be seen.
    """
    say("reading")
    named = surround_rig(read_rig_source(calibration).rig) if _has_lenses(calibration) else None
    opened = open_for_view(recording, named.names if named else (), topics)
    source = read_rig_source(calibration, opened)
    rig = surround_rig(source.rig)
    streams = require_fit(rig, opened)
    folder = calibration if calibration.is_dir() else calibration.parent
    leveller = choose_attitudes(opened, rig, source.rig, options.stabilise, folder, options.trajectory)
    say("masks")
    masks, notes = own_masks(rig, streams, folder, options.hull)
    leveller = replace(leveller, masks=masks)
    say("pictures to learn from")
    samples = _sample_sets(streams, rig)
    notes = [*rig.notes, *notes, *_pairing_notes(rig, samples)]
    colour = _colour(rig, samples, leveller, masks) if options.correct_colours else None
    say("height above the water")
    height, words = _height(options, rig, samples, leveller, masks)
    notes += [words] if words else []
    if height is not None:
        leveller = leveller.with_height(height.height_m, height.std_m)
    shell_m = options.shell_m or estimate_shell(rig, samples, leveller, colour)
    heave = np.zeros(1) if leveller.track is None else leveller.track.heave_m
    return SurroundSetup(
        rig,
        opened,
        streams,
        leveller,
        choose_surface(options.surface, shell_m, height is not None),
        masks,
        colour,
        source.calibration,
        height,
        samples,
        shell_m,
        float(np.std(heave)),
        tuple(notes),
    )


def _has_lenses(calibration: Path) -> bool:
    """Whether the calibration can be turned into a rig without the recording's lenses."""
    try:
        surround_rig(read_rig_source(calibration).rig)
    except UsageError:
        return False
    return True


def choose_surface(name: str, shell_m: float, is_height_known: bool) -> SurfaceSource:
    """The surface source that `--surface` names. Raises UsageError where the height is needed and unknown."""
    if name != "shell" and not is_height_known:
        raise UsageError(
            f"--surface {name} needs the height of the cameras above the water, and it could not be estimated.",
            remedy="Give it: --height-m METRES (mean height of the cameras above the water).",
        )
    if name == "water":
        return FixedSurface(WaterAndShell(_FAR_SHELL_M))
    if name == "stixels":
        try:
            module = importlib.import_module("rigwake.views.scene.stixel_source")
        except ModuleNotFoundError as error:
            raise UsageError(
                "This version of rigwake does not estimate stixels.", remedy="Use --surface shell."
            ) from error
        source: SurfaceSource = module.stixel_surface_source(shell_m=shell_m)
        return source
    return FixedSurface(WaterAndShell(shell_m) if is_height_known else Shell(shell_m))


def own_masks(
    rig: SurroundRig, streams: Mapping[str, CameraStream], folder: Path, hull: str
) -> tuple[dict[str, Mask], list[str]]:
    """What must not be shown, by camera name: beyond the image circle, and with hull `mask` the own vessel.

    The hull is taken from the masks beside the calibration, else found in the recording.
    """
    masks: dict[str, Mask] = {}
    notes = []
    for name, stream in streams.items():
        mask = beyond_image_circle(stream)
        if hull == "mask":
            file = folder / "masks" / f"{name}_hull.png"
            stored = picture_or_none(file)
            if stored is not None and stored.shape == mask.shape:
                mask = mask | (stored > 127)
            else:
                try:
                    mask = mask | find_self_mask(stream, ~mask)
                except RigwakeError as error:
                    notes.append(f"{name}: the own vessel is not masked. {error.cause}")
        if mask.any():
            masks[name] = mask
    return masks, notes


def _sample_sets(streams: Mapping[str, CameraStream], rig: SurroundRig) -> tuple[FrameSet, ...]:
    times = output_times(streams, rig)
    if not len(times):
        raise InputError("The recording has no pictures.")
    at = np.unique(np.linspace(0, len(times) - 1, _SAMPLES + 2).astype(int)[1:-1])
    return tuple(frame_sets(streams, rig, times[at]))


def _pairing_notes(rig: SurroundRig, samples: Sequence[FrameSet]) -> list[str]:
    """The worst time difference within frame sets, if it is more than a few milliseconds."""
    offsets = np.array([frames.offsets_s for frames in samples])
    if not np.isfinite(offsets).any():
        return []
    worst = np.nanmax(np.abs(offsets), axis=0, initial=0.0, where=np.isfinite(offsets))
    camera = int(worst.argmax())
    if worst[camera] < 0.005:
        return []
    return [
        "Pictures are paired by corrected time; "
        f"the worst pair is {1e3 * worst[camera]:.0f} ms apart ({rig.names[camera]})."
    ]


def _colour(
    rig: SurroundRig, samples: Sequence[FrameSet], leveller: Leveller, masks: Mapping[str, Mask]
) -> ColourModel | None:
    parts = []
    for frames in samples:
        images = frames.images(rig)
        if len(images) > 1:
            parts.append(colour_samples(images, rig, leveller.at(frames.timestamp_ns, images), masks))
    joined = ColourSamples.joined(parts) if parts else None
    return fit_colour(joined, len(rig)) if joined is not None and len(joined) >= 100 else None


def _height(
    options: SurroundOptions,
    rig: SurroundRig,
    samples: Sequence[FrameSet],
    leveller: Leveller,
    masks: Mapping[str, Mask],
) -> tuple[HeightEstimate | None, str]:
    """The height of the viewpoint above the water, and the sentence that says where it is from."""
    if options.height_m is not None:
        if not 0.05 <= options.height_m <= 200:
            raise UsageError(f"--height-m {options.height_m:g} is not a height above the water in metres.")
        given = HeightEstimate(options.height_m, 0.02 * options.height_m, 0)
        return given, f"Height of the cameras above the water: {options.height_m:g} m, as given."
    try:
        found = estimate_height(rig, samples, leveller, masks)
    except EstimationError as error:
        return None, f"Height of the cameras above the water: not known. {error.cause}"
    places = "points on its ripples." if found.by_ripples else "waterlines of what stands in it."
    if found.why_not_ripples:
        places += (
            f" Its ripples tell nothing: {found.why_not_ripples[:1].lower() + found.why_not_ripples[1:]}"
        )
    return found, (
        f"Height of the cameras above the water: {found.height_m:.2f} +- {found.std_m:.2f} m, "
        f"estimated from {found.contacts} {places}"
    )


def estimate_shell(
    rig: SurroundRig, samples: Sequence[FrameSet], leveller: Leveller, colour: ColourModel | None
) -> float:
    """Radius of the shell that fits what stands farther than 15 m away: the median of triangulated ranges, metres."""
    matches: list[SeamMatches] = []
    meter = SeamMeter(rig, colour)
    for frames in samples:
        matches += meter.measure(frames, leveller.at(frames.timestamp_ns, frames.images(rig)), Shell(SHELL_M))
    ranges = np.concatenate([m.range_m for m in matches]) if matches else np.zeros(0)
    far = ranges[ranges > _SHELL_LIMITS_M[0]]
    if len(far) < 30:
        return SHELL_M
    inverse = float(np.median(1 / far))  # infinite ranges count as zero
    return float(np.clip(1 / max(inverse, 1e-6), *_SHELL_LIMITS_M))
