"""The part of a recording that is calibrated: chosen cameras, a stretch of time, one IMU, one receiver."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from rigwake.config import CalibrateConfig
from rigwake.errors import InputError, UnobservableError, UsageError
from rigwake.odometry.imu_alignment import with_noise
from rigwake.recording import (
    CameraStream,
    Frame,
    FrameSource,
    GnssStream,
    ImuStream,
    Recording,
    main_gnss,
    main_imu,
)


@dataclass(frozen=True, eq=False)
class Selection:
    """What takes part. notes: choices that were made, in words. left_out: cameras that are wanted but cannot take
    part, and why."""

    cameras: Mapping[str, CameraStream]
    imu: ImuStream | None
    gnss: GnssStream | None
    notes: tuple[str, ...] = ()
    left_out: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class FrameWindow:
    """The frames from `first` on of another source, numbered from 0."""

    source: FrameSource
    first: int

    def frames(self, indices: Sequence[int] | NDArray[np.int64], *, colour: bool = False) -> Iterator[Frame]:
        """As in the source."""
        shifted = np.asarray(indices, dtype=np.int64) + self.first
        for frame in self.source.frames(shifted, colour=colour):
            yield replace(frame, index=frame.index - self.first)


def select(recording: Recording, config: CalibrateConfig) -> Selection:
    """Apply `cameras`, `start_s`, `duration_s`, `imu` and `gnss` of the settings.

    Raises InputError without cameras or intrinsics, or where a unit was guessed and no repair is wanted, UsageError for
    unknown names, UnobservableError when the stretch is too short to tell anything.
    """
    names = config.cameras or tuple(recording.cameras)
    cameras = {name: recording.camera(name) for name in names}
    if not cameras:
        raise InputError(
            f"{recording.path.name} has no cameras.",
            remedy="`rigwake inspect` lists what it holds; name image topics with --topic camera.front=/a/b.",
        )
    begin = min((int(c.timestamps_ns[0]) for c in cameras.values() if len(c)), default=0)
    begin += round(config.start_s * 1e9)
    end = max((int(c.timestamps_ns[-1]) for c in cameras.values() if len(c)), default=0)
    if config.duration_s is not None:
        end = min(end, begin + round(config.duration_s * 1e9))
    if (end - begin) * 1e-9 < config.min_duration_s:
        raise UnobservableError(
            f"Only {max(end - begin, 0) * 1e-9:.1f} s of images are to be used.",
            consequence=f"Under {config.min_duration_s:g} s no vessel turns enough to tell where its cameras are.",
            remedy="Record one to two minutes with turns to both sides.",
        )
    notes = [
        f"{f.sensor + ': ' if f.sensor else ''}{f.message}"
        for f in recording.findings
        if f.severity != "note"
    ]
    if config.imu and not config.repair:
        _refuse_guesses(recording)
    imu = _one("IMU", main_imu(recording), recording.imus, config.imu, notes)
    gnss = _one("GNSS receiver", main_gnss(recording), recording.gnss, config.gnss, notes)
    notes.extend(
        f"attitude {name}: not used; beside an IMU it tells nothing new of the rig, without one its mounting is unknown"
        for name in recording.attitudes
    )
    windowed = {name: _window(camera, begin, end) for name, camera in cameras.items()}
    left_out: dict[str, str] = {}
    for name, camera in list(windowed.items()):
        if camera.model is None and config.intrinsics != "find":
            left_out[name] = "it has no intrinsics (`rigwake intrinsics` finds them)"
            notes.append(f"{name}: left out, {left_out[name]}")
            del windowed[name]
    if not windowed:
        raise InputError(
            "No camera has intrinsics.",
            consequence="Pixels cannot be turned into directions.",
            remedy="Record camera_info, put them into rig.yaml, or find them: `rigwake intrinsics`, --intrinsics find.",
        )
    known = None if imu is None else _with_noise(imu, config, notes)
    return Selection(windowed, known, gnss, tuple(notes), left_out)


def _refuse_guesses(recording: Recording) -> None:
    """Raise InputError where an IMU's unit was guessed at reading."""
    for finding in recording.findings:
        if finding.is_guess and finding.sensor in recording.imus:
            raise InputError(
                f"{finding.sensor}: {finding.message}",
                consequence="A unit that was guessed is a repair, and none is wanted.",
                remedy="Name the unit in the header of the table, or allow repairs.",
            )


_Sensor = TypeVar("_Sensor", ImuStream, GnssStream)


def _one(
    what: str, main: _Sensor | None, streams: Mapping[str, object], wanted: bool, notes: list[str]
) -> _Sensor | None:
    """The sensor that every verb uses, if any is wanted; notes which are not used."""
    if not wanted or main is None:
        notes.append(f"no {what} " + ("in the recording" if wanted else "used, as asked"))
        return None
    if len(streams) > 1:
        others = ", ".join(name for name in streams if name != main.name)
        notes.append(f"{what} {main.name} used, the others ({others}) not")
    return main


def _with_noise(imu: ImuStream, config: CalibrateConfig, notes: list[str]) -> ImuStream:
    given = {key: value for key, value in config.imu_noise.model_dump().items() if value is not None}
    known = replace(imu, **given)
    complete = with_noise(known)
    if any(getattr(known, name) is None for name in type(config.imu_noise).model_fields):
        notes.append(f"{imu.name}: noise densities not known, those of a middle-class MEMS sensor assumed")
    return complete


def _window(camera: CameraStream, begin_ns: int, end_ns: int) -> CameraStream:
    stamps = camera.timestamps_ns
    first, last = np.searchsorted(stamps, begin_ns), np.searchsorted(stamps, end_ns, side="right")
    if first == 0 and last == len(stamps):
        return camera
    if first >= last:
        raise UsageError(
            f"camera {camera.name} has no images in the chosen stretch of time.",
            remedy="Leave it out with --cameras, or choose another --start or --duration.",
        )
    source = FrameWindow(camera.source, int(first))
    return replace(camera, timestamps_ns=stamps[first:last], source=source)
