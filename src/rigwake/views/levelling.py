"""Chooses where the attitude of a recording comes from, best first, and says which it was."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from rigwake._types import Image
from rigwake.errors import UsageError
from rigwake.geometry.se3 import SE3
from rigwake.readers.trajectories import read_trajectory
from rigwake.recording import Recording, static_transform
from rigwake.rig import Rig
from rigwake.views.attitude import (
    AttitudeTrack,
    LevelAttitude,
    level_rotation,
    track_from_imu,
    track_from_sensor,
    track_from_trajectory,
    unlevelled,
)
from rigwake.views.horizon import horizon_attitude
from rigwake.views.surround_rig import SurroundRig

_TRACK_SEARCH_DEG = 6.0  # from one picture to the next
_FIRST_SEARCH_DEG = 16.0
_MOST_TILT_STD = np.deg2rad(10.0)  # a compass alone says nothing about the tilt


@dataclass
class Leveller:
    """Gives the attitude at a time: one fixed attitude, a track, the horizon in the pictures, or none of them.

    words: where attitudes come from, for people.
    """

    rig: SurroundRig
    words: str
    track: AttitudeTrack | None = None
    fixed: LevelAttitude | None = None
    use_horizon: bool = True
    height_m: float = np.nan
    height_std_m: float = 0.0
    masks: Mapping[str, NDArray[np.bool_]] | None = None
    _last: LevelAttitude | None = field(init=False, default=None)

    def at(self, timestamp_ns: int, images: Mapping[str, Image]) -> LevelAttitude:
        """The attitude at a time, with the height above the water."""
        if self.fixed is not None:
            return self.fixed
        if self.track is not None and self.track.covers(timestamp_ns):
            return self.track.at(timestamp_ns)
        start = self._last or unlevelled(self.rig, self.height_m, self.height_std_m)
        if not self.use_horizon:
            return start
        search = _FIRST_SEARCH_DEG if self._last is None else _TRACK_SEARCH_DEG
        seen = horizon_attitude(images, self.rig, start, search, self.masks)
        self._last = seen or self._last
        return seen or start

    def with_height(self, height_m: float, height_std_m: float) -> Leveller:
        """The same at a known mean height of the viewpoint above the water."""

        def at_height(attitude: LevelAttitude | None) -> LevelAttitude | None:
            return attitude and replace(attitude, height_m=height_m, height_std_m=height_std_m)

        track = self.track and self.track.with_height(height_m, height_std_m)
        raised = replace(
            self, track=track, fixed=at_height(self.fixed), height_m=height_m, height_std_m=height_std_m
        )
        raised._last = at_height(self._last)
        return raised


def choose_attitudes(
    recording: Recording,
    rig: SurroundRig,
    calibrated: Rig,
    stabilise: str = "imu",
    calibration_folder: Path | None = None,
    trajectory: Path | None = None,
) -> Leveller:
    """A leveller: from `trajectory`, the trajectory beside the calibration, an attitude sensor, the IMU, or the
    horizon in the pictures; the first that is there and covers the recording.

    stabilise: `imu` (best there is), `horizon` (pictures only) or `off` (one mean attitude for all pictures).
    Raises UsageError if `trajectory` was given and does not cover the recording.
    """
    by_eye = Leveller(rig, "levelled by the horizon in the pictures")
    if stabilise == "horizon":
        return by_eye
    track, words = _track(recording, rig, calibrated, calibration_folder, trajectory)
    if stabilise == "off":
        fixed = unlevelled(rig)
        if track is not None:
            up_rig = track.level_from_rig[:, 2].mean(axis=0)
            fixed = replace(
                fixed,
                level_from_rig=level_rotation(up_rig, rig.forward_rig),
                source=track.source,
                tilt_std=float(np.std(track.level_from_rig[:, 2], axis=0)[:2].max()),
            )
        return Leveller(rig, "not stabilised", fixed=fixed)
    return by_eye if track is None else Leveller(rig, f"levelled by {words}", track)


def _track(
    recording: Recording, rig: SurroundRig, calibrated: Rig, folder: Path | None, trajectory: Path | None
) -> tuple[AttitudeTrack | None, str]:
    """The best track and what it comes from."""
    middle = _middle_ns(recording)
    if trajectory is not None:
        track = track_from_trajectory(read_trajectory(trajectory).trajectory, rig)
        if middle is not None and not track.covers(middle):
            raise UsageError(
                f"{trajectory} does not cover the time of the recording.",
                consequence="It says nothing about the attitude.",
                remedy="Give the trajectory of this recording, or leave it out.",
            )
        return track, f"the trajectory {trajectory.name}"
    if folder is not None and (folder / "trajectories" / "rig.tum").is_file():
        track = track_from_trajectory(read_trajectory(folder / "trajectories" / "rig.tum").trajectory, rig)
        if middle is not None and track.covers(middle):
            return track, "the trajectory of the calibration"
    for name, attitude in recording.attitudes.items():
        tilt_std = np.sqrt(np.median(attitude.covariances[:, :2, :2].diagonal(axis1=1, axis2=2)))
        rig_from_body = _rig_from(recording, calibrated, attitude.frame_id)
        if rig_from_body is not None and tilt_std < _MOST_TILT_STD:
            return track_from_sensor(attitude, rig_from_body, rig), f"the attitude sensor {name}"
    for name, imu in recording.imus.items():
        rig_from_imu = _rig_from(recording, calibrated, imu.frame_id)
        if rig_from_imu is not None and len(imu.timestamps_ns) >= 20:
            return track_from_imu(imu, rig_from_imu, rig), f"the IMU {name}"
    return None, ""


def _middle_ns(recording: Recording) -> int | None:
    stamps = [s.timestamps_ns for s in recording.cameras.values() if len(s)]
    return int(np.median(np.concatenate(stamps))) if stamps else None


def _rig_from(recording: Recording, calibrated: Rig, frame_id: str) -> SE3 | None:
    """How the axes of the IMU (or a sensor on it) sit in the rig; None if nobody knows."""
    if calibrated.reference == "imu":
        return SE3.identity()
    if calibrated.rig_from_imu is not None:
        return calibrated.rig_from_imu
    found = static_transform(recording, calibrated.reference, frame_id) if frame_id else None
    return found or (SE3.identity() if frame_id and frame_id == calibrated.reference else None)
