"""Parts of a recording: a stretch of time, every n-th frame. Images stay where they are."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from rigwake._types import Indices, Stamps
from rigwake.errors import UsageError
from rigwake.recording import (
    AttitudeStream,
    CameraStream,
    EncodedFrameSource,
    Finding,
    Frame,
    FrameSource,
    GnssStream,
    ImuStream,
    Recording,
)

_CLOCK_JUMP_NS = 3600 * 10**9


@dataclass(frozen=True, eq=False)
class ChosenFrames:
    """Some frames of another source: frame `i` is its frame `rows[i]`."""

    source: FrameSource
    rows: Stamps

    def frames(self, indices: Sequence[int] | NDArray[np.int64], *, colour: bool = False) -> Iterator[Frame]:
        """See `FrameSource.frames`."""
        wanted = np.asarray(indices, dtype=np.int64)
        index_of = dict(zip(self.rows[wanted].tolist(), wanted.tolist(), strict=True))
        for frame in self.source.frames(self.rows[wanted], colour=colour):
            yield replace(frame, index=index_of[frame.index])

    @property
    def is_encoded(self) -> bool:
        """Whether the other source is."""
        return isinstance(self.source, EncodedFrameSource) and self.source.is_encoded

    def encoded_frames(self, indices: Sequence[int] | NDArray[np.int64]) -> Iterator[tuple[int, bytes]]:
        """See `EncodedFrameSource.encoded_frames`."""
        if not isinstance(self.source, EncodedFrameSource):
            return
        wanted = np.asarray(indices, dtype=np.int64)
        index_of = dict(zip(self.rows[wanted].tolist(), wanted.tolist(), strict=True))
        for row, encoded in self.source.encoded_frames(self.rows[wanted]):
            yield index_of[row], encoded


@dataclass(frozen=True, eq=False)
class CountedFrames:
    """Another source; `count` is called with the index of every frame after it was read."""

    source: FrameSource
    count: Callable[[int], None]

    def frames(self, indices: Sequence[int] | NDArray[np.int64], *, colour: bool = False) -> Iterator[Frame]:
        """See `FrameSource.frames`."""
        for frame in self.source.frames(indices, colour=colour):
            yield frame
            self.count(frame.index)

    @property
    def is_encoded(self) -> bool:
        """Whether the other source is."""
        return isinstance(self.source, EncodedFrameSource) and self.source.is_encoded

    def encoded_frames(self, indices: Sequence[int] | NDArray[np.int64]) -> Iterator[tuple[int, bytes]]:
        """See `EncodedFrameSource.encoded_frames`."""
        if isinstance(self.source, EncodedFrameSource):
            for pair in self.source.encoded_frames(indices):
                yield pair
                self.count(pair[0])


def excerpt(
    recording: Recording, *, start_s: float = 0.0, duration_s: float | None = None, every: int = 1
) -> Recording:
    """The part from `start_s` after the recording's first stamp on, of each camera every `every`-th frame.

    Transforms and what is known of the rig stay. Sensors without a sample in it are left out, and said. Raises
    UsageError if nothing is left.
    """
    if every < 1 or not np.isfinite(start_s) or start_s < 0 or not (duration_s is None or duration_s > 0):
        raise UsageError(
            "A part begins at or after 0 s, lasts longer than 0 s and takes every 1st, 2nd ... frame.",
            remedy="For example --start 10 --duration 60 --every 2.",
        )
    if start_s == 0 and duration_s is None and every == 1:
        return recording
    stamps = _all_stamps(recording)
    if not len(stamps):
        raise UsageError(f"{recording.path.name} has no stamps to choose a part by.")
    begin = int(stamps[0]) + round(start_s * 1e9)
    end = int(stamps[-1]) if duration_s is None else begin + round(min(duration_s, 1e9) * 1e9)
    part = window(recording, begin, end, every)
    if not len(_all_stamps(part)):
        seconds = (int(stamps[-1]) - int(stamps[0])) * 1e-9
        raise UsageError(
            f"Nothing was recorded in this part: {recording.path.name} is {seconds:.1f} s long.",
            remedy="Choose another --start.",
        )
    return part


def window(recording: Recording, begin_ns: int, end_ns: int, every: int = 1) -> Recording:
    """The samples from `begin_ns` to `end_ns`, both included, of each camera every `every`-th frame."""
    findings: list[Finding] = []

    def rows_of(streams: Mapping[str, _Stamped], step: int = 1) -> Iterator[tuple[str, Indices]]:
        for name, stream in streams.items():
            stamps = stream.timestamps_ns
            first, last = np.searchsorted(stamps, begin_ns), np.searchsorted(stamps, end_ns, side="right")
            if first < last:
                yield name, np.arange(first, last, step)
            else:
                findings.append(Finding("warning", name, "no samples in the chosen part; left out."))

    part = replace(
        recording,
        cameras={n: _frames_at(recording.cameras[n], at) for n, at in rows_of(recording.cameras, every)},
        imus={n: _imu_at(recording.imus[n], at) for n, at in rows_of(recording.imus)},
        gnss={n: _fixes_at(recording.gnss[n], at) for n, at in rows_of(recording.gnss)},
        attitudes={n: _attitudes_at(recording.attitudes[n], at) for n, at in rows_of(recording.attitudes)},
        poses={n: recording.poses[n].take(at) for n, at in rows_of(recording.poses)},
        true_trajectories={
            n: recording.true_trajectories[n].take(at) for n, at in rows_of(recording.true_trajectories)
        },
    )
    return replace(part, findings=(*recording.findings, *findings))


class _Stamped(Protocol):
    @property
    def timestamps_ns(self) -> Stamps: ...


def _frames_at(camera: CameraStream, rows: Indices) -> CameraStream:
    if len(rows) == len(camera):
        return camera
    return replace(camera, timestamps_ns=camera.timestamps_ns[rows], source=ChosenFrames(camera.source, rows))


def _imu_at(imu: ImuStream, rows: Indices) -> ImuStream:
    return replace(imu, timestamps_ns=imu.timestamps_ns[rows], gyro=imu.gyro[rows], accel=imu.accel[rows])


def _fixes_at(gnss: GnssStream, rows: Indices) -> GnssStream:
    return replace(
        gnss,
        timestamps_ns=gnss.timestamps_ns[rows],
        position_enu=gnss.position_enu[rows],
        covariances=gnss.covariances[rows],
        velocity_enu=None if gnss.velocity_enu is None else gnss.velocity_enu[rows],
    )


def imu_between(imu: ImuStream, begin_ns: int, end_ns: int) -> ImuStream:
    """The inertial samples from `begin_ns` to `end_ns`, both included."""
    return _imu_at(imu, _rows_within(imu.timestamps_ns, [(begin_ns, end_ns)]))


def gnss_between(gnss: GnssStream, *spans_ns: tuple[int, int]) -> GnssStream:
    """The fixes within any of these spans (begin, end), both included."""
    return _fixes_at(gnss, _rows_within(gnss.timestamps_ns, spans_ns))


def camera_between(camera: CameraStream, spans_ns: Sequence[tuple[int, int]]) -> CameraStream:
    """The frames within any of these spans (begin, end), both included; no other is ever read."""
    return _frames_at(camera, _rows_within(camera.timestamps_ns, spans_ns))


def _rows_within(stamps: Stamps, spans_ns: Sequence[tuple[int, int]]) -> Indices:
    inside = np.zeros(len(stamps), dtype=bool)
    for begin, end in spans_ns:
        inside[np.searchsorted(stamps, begin) : np.searchsorted(stamps, end, side="right")] = True
    return np.flatnonzero(inside)


def _attitudes_at(attitude: AttitudeStream, rows: Indices) -> AttitudeStream:
    return replace(
        attitude,
        timestamps_ns=attitude.timestamps_ns[rows],
        world_from_body=attitude.world_from_body[rows],
        covariances=attitude.covariances[rows],
    )


def _sensors(recording: Recording) -> Iterator[_Stamped]:
    for streams in (recording.cameras, recording.imus, recording.gnss, recording.attitudes, recording.poses):
        yield from streams.values()


def _all_stamps(recording: Recording) -> Stamps:
    stamps = [np.asarray(sensor.timestamps_ns) for sensor in _sensors(recording)]
    return np.unique(np.concatenate([np.empty(0, dtype=np.int64), *stamps]))


def longest_stretch(recording: Recording) -> Recording:
    """The longest part of a recording whose clock was set while it ran, and a finding that names the jump.

    Between two stamps in it, whatever the sensor, there is never more than an hour.
    """
    stamps = _all_stamps(recording)
    jumps = np.flatnonzero(np.diff(stamps) > _CLOCK_JUMP_NS)
    if not len(jumps):
        return recording
    first = np.concatenate([[0], jumps + 1])
    last = np.concatenate([jumps, [len(stamps) - 1]])
    begin, end = stamps[first], stamps[last]
    within = [
        sum(int(((s.timestamps_ns >= b) & (s.timestamps_ns <= e)).sum()) for s in _sensors(recording))
        for b, e in zip(begin, end, strict=True)
    ]
    best = max(range(len(begin)), key=lambda at: (int(end[at] - begin[at]), within[at]))
    if not any(_crosses(sensor.timestamps_ns) for sensor in _sensors(recording)):
        return recording  # sensors with clocks of their own, none of which was set
    size_s = float((stamps[jumps + 1] - stamps[jumps]).max()) * 1e-9
    kept_s = float(end[best] - begin[best]) * 1e-9
    message = (
        f"the clock was set while recording: stamps jump by {size_s:.3g} s. The longest stretch between jumps, "
        f"{kept_s:.1f} s, is used."
    )
    part = window(recording, int(begin[best]), int(end[best]))
    return replace(part, findings=(*part.findings, Finding("error", "", message)))


def _crosses(stamps: Stamps) -> bool:
    return bool((np.diff(stamps) > _CLOCK_JUMP_NS).any())
