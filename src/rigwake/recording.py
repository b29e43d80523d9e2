"""The `Recording` value: what every reader and the simulator return.

Images are read lazily through a `FrameSource` and streamed; everything else is small and held in memory.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol, TypeVar, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from rigwake._types import Array, Image, Stamps
from rigwake.cameras.protocol import CameraModel
from rigwake.errors import UsageError
from rigwake.geometry.se3 import SE3
from rigwake.rig import Rig
from rigwake.trajectory import Trajectory


@dataclass(frozen=True, eq=False)
class Frame:
    """One image: (H, W) grey or (H, W, 3) BGR uint8, and when it was taken on the camera's clock."""

    index: int
    timestamp_ns: int
    image: Image


class FrameSource(Protocol):
    """Reads images of one camera on demand. Can be pickled, so that cameras are worked on in parallel."""

    def frames(self, indices: Sequence[int] | NDArray[np.int64], *, colour: bool = False) -> Iterator[Frame]:
        """Frames in the order of the (increasing) indices; an image that cannot be decoded is left out."""


@runtime_checkable
class EncodedFrameSource(FrameSource, Protocol):
    """A source whose frames lie encoded (JPEG, PNG) in the recording, and can be handed on as they are."""

    @property
    def is_encoded(self) -> bool:
        """Whether they really do; a source over other sources may not know before."""

    def encoded_frames(self, indices: Sequence[int] | NDArray[np.int64]) -> Iterator[tuple[int, bytes]]:
        """Index and encoded image of each frame, not decoded; one of another size is left out."""


@dataclass(frozen=True, eq=False)
class CameraStream:
    """One camera of a recording.

    timestamps_ns: (N,) strictly increasing, camera clock, one per frame.
    model: intrinsics, if the recording or the user gave them. topic: topic or folder it came from.
    frame_id: its optical frame in the recording's tf tree, if any. intrinsics_covariance: (P, P) of the model's
    parameters, if a board calibrated them and its file says so.
    """

    name: str
    timestamps_ns: Stamps
    source: FrameSource
    width_px: int
    height_px: int
    model: CameraModel | None = None
    topic: str = ""
    frame_id: str = ""
    intrinsics_covariance: Array | None = None

    def __len__(self) -> int:
        return len(self.timestamps_ns)

    def frames(
        self, indices: Sequence[int] | NDArray[np.int64] | None = None, *, colour: bool = False
    ) -> Iterator[Frame]:
        """Stream frames (all by default), decoded one at a time."""
        return self.source.frames(np.arange(len(self)) if indices is None else indices, colour=colour)


@dataclass(frozen=True, eq=False)
class ImuStream:
    """Inertial samples in IMU axes.

    gyro: (N, 3) rad/s. accel: (N, 3) specific force, m/s^2 (+9.81 on the up axis at rest).
    Noise densities are continuous-time (rad/s/sqrt(Hz), m/s^2/sqrt(Hz)), as are the bias random walks;
    None where unknown.
    """

    name: str
    timestamps_ns: Stamps
    gyro: Array
    accel: Array
    topic: str = ""
    frame_id: str = ""
    gyro_noise_density: float | None = None
    accel_noise_density: float | None = None
    gyro_bias_walk: float | None = None
    accel_bias_walk: float | None = None


@dataclass(frozen=True, eq=False)
class GnssStream:
    """Antenna positions.

    position_enu: (N, 3) metres in the tangent plane at `origin_lla` (degrees, degrees, ellipsoidal metres).
    covariances: (N, 3, 3) ENU; velocity_enu: (N, 3) m/s where the receiver gave it.
    """

    name: str
    timestamps_ns: Stamps
    position_enu: Array
    covariances: Array
    origin_lla: tuple[float, float, float]
    velocity_enu: Array | None = None
    topic: str = ""
    frame_id: str = ""


@dataclass(frozen=True, eq=False)
class AttitudeStream:
    """Attitude or heading in ENU: `world_from_body` rotations (N, 3, 3) with (N, 3, 3) covariances about
    body axes (right tangent). Heading alone has a huge roll and pitch variance."""

    name: str
    timestamps_ns: Stamps
    world_from_body: Array
    covariances: Array
    topic: str = ""
    frame_id: str = ""


@dataclass(frozen=True)
class Finding:
    """Something noticed while reading: what, about which sensor, how bad (`note`, `warning`, `error`).

    is_guess: whether values were converted by a guess at their unit, which runs without repairs refuse.
    """

    severity: str
    sensor: str
    message: str
    is_guess: bool = field(default=False, kw_only=True)


@dataclass(frozen=True, eq=False)
class Recording:
    """Everything a recording holds.

    poses: trajectories found in pose topics, by topic or name. static_transforms: from tf_static, by
    `(parent, child)`: `parent_from_child`. true_rig, true_trajectories: known truth (simulation).
    findings: what was repaired, dropped or is suspicious.
    """

    path: Path
    kind: str
    cameras: Mapping[str, CameraStream] = field(default_factory=dict)
    imus: Mapping[str, ImuStream] = field(default_factory=dict)
    gnss: Mapping[str, GnssStream] = field(default_factory=dict)
    attitudes: Mapping[str, AttitudeStream] = field(default_factory=dict)
    poses: Mapping[str, Trajectory] = field(default_factory=dict)
    static_transforms: Mapping[tuple[str, str], SE3] = field(default_factory=dict)
    true_rig: Rig | None = None
    true_trajectories: Mapping[str, Trajectory] = field(default_factory=dict)
    findings: tuple[Finding, ...] = ()

    def camera(self, name: str) -> CameraStream:
        """The camera of this name; UsageError lists what is there."""
        if name not in self.cameras:
            raise UsageError(
                f"No camera {name!r} in {self.path.name}.",
                remedy=f"It has: {', '.join(self.cameras) or 'none'}.",
            )
        return self.cameras[name]


def main_imu(recording: Recording) -> ImuStream | None:
    """The IMU that every verb uses: of those that cover nearly all of the time the one with the most samples."""
    return _main(list(recording.imus.values()))


def main_gnss(recording: Recording) -> GnssStream | None:
    """The receiver that every verb uses, chosen like the IMU."""
    return _main(list(recording.gnss.values()))


_Stream = TypeVar("_Stream", ImuStream, GnssStream)
_NEARLY_ALL = 0.9  # of the time that the sensor recording longest covers


def _main(streams: Sequence[_Stream]) -> _Stream | None:
    if not streams:
        return None
    seconds = [int(s.timestamps_ns[-1] - s.timestamps_ns[0]) if len(s.timestamps_ns) else 0 for s in streams]
    covering = [s for s, t in zip(streams, seconds, strict=True) if t >= _NEARLY_ALL * max(seconds)]
    return min(covering, key=lambda stream: (-len(stream.timestamps_ns), stream.name))


def static_transform(recording: Recording, parent: str, child: str) -> SE3 | None:
    """`parent_from_child` along the chain of the recording's static transforms; None if there is none."""
    return transform_between(recording.static_transforms, parent, child)


def transform_between(transforms: Mapping[tuple[str, str], SE3], parent: str, child: str) -> SE3 | None:
    """`parent_from_child` along a chain of transforms, in either direction; None if there is none.

    The shortest chain is taken (breadth first). A leading slash of a frame's name does not count, as in tf2.
    """
    parent, child = parent.lstrip("/"), child.lstrip("/")
    steps: dict[str, list[tuple[str, SE3]]] = {}
    for (above, below), above_from_below in transforms.items():
        steps.setdefault(above, []).append((below, above_from_below))
        steps.setdefault(below, []).append((above, above_from_below.inverse()))
    found = {parent: SE3.identity()}
    waiting = [parent]
    for frame in waiting:
        for neighbour, frame_from_neighbour in steps.get(frame, []):
            if neighbour not in found:
                found[neighbour] = found[frame] * frame_from_neighbour
                waiting.append(neighbour)
    return found.get(child)
