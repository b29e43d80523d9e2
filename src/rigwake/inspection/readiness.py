"""Is this recording enough to calibrate, and if not, what to do differently."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Literal

from rigwake.inspection.recording_inspection import Inspection
from rigwake.recording import GnssStream, ImuStream

Word = Literal["enough", "partly", "not enough"]

# What each part of a rig needs from the motion. Horizontal offsets and headings come from turning, vertical
# offsets from rolling and pitching: with a standard deviation s of tilt they are determined 1/s times worse than
# the horizontal ones, so that below half a degree they drown.
MIN_TURNING_DEG = 60.0
MIN_TILT_STD_DEG = 0.5
GOOD_TILT_STD_DEG = 1.0
MIN_PATH_M = 5.0
MAX_STILL = 0.7
MIN_CAMERA_HZ = 3.0
MIN_SECONDS = 15.0  # as `calibrate` demands
_MOST_OF_IT = 0.8  # of a camera whose sail is short
_ABOUT_CAMERAS = ("intrinsics", "frame rate and length", "common time", "pictures")


@dataclass(frozen=True)
class Check:
    """One requirement. `passed` is None where the recording cannot tell. `remedy`: what to do differently."""

    name: str
    passed: bool | None
    is_vital: bool
    measured: str
    remedy: str = ""


@dataclass(frozen=True)
class Readiness:
    """The word: `enough`; `partly` (calibrates, but not everything); `not enough`. And why."""

    word: Word
    summary: str
    checks: tuple[Check, ...]

    @property
    def advice(self) -> tuple[str, ...]:
        """What to do differently, most important first."""
        failed = sorted(
            (c for c in self.checks if c.passed is not True), key=lambda c: (not c.is_vital, c.name)
        )
        return tuple(dict.fromkeys(c.remedy for c in failed if c.remedy))


def judge(inspection: Inspection) -> Readiness:
    """Judge a recording by its sensors and its motion."""
    checks = (*_sensor_checks(inspection), *_motion_checks(inspection))
    failed = [c for c in checks if c.passed is False]
    unknown = [c for c in checks if c.passed is None]
    if any(c.is_vital for c in failed):
        names = ", ".join(c.name for c in failed if c.is_vital)
        return Readiness("not enough", f"Not enough to calibrate: {names}.", checks)
    if failed or any(c.is_vital for c in unknown):
        names = ", ".join(c.name for c in (*failed, *unknown))
        return Readiness("partly", f"Enough to calibrate, with reserve: {names}.", checks)
    return Readiness("enough", "Enough to calibrate.", checks)


def _sensor_checks(inspection: Inspection) -> list[Check]:
    recording = inspection.recording
    cameras = recording.cameras
    unlensed = [name for name, camera in cameras.items() if camera.model is None]
    others = [*recording.imus, *recording.gnss, *recording.poses]
    slow = [
        name
        for name in cameras
        if not inspection.timings[f"camera.{name}"].rate_hz >= MIN_CAMERA_HZ
        or inspection.timings[f"camera.{name}"].duration_s < MIN_SECONDS
    ]
    broken = [
        f.sensor for f in inspection.findings if f.severity == "error" and f.sensor.startswith("camera.")
    ]
    broken = list(dict.fromkeys(broken))
    metric = bool(recording.gnss or recording.imus) or any(t.is_metric for t in recording.poses.values())
    checks = [
        Check(
            "cameras",
            len(cameras) >= 2 or (len(cameras) == 1 and bool(others)),
            True,
            f"{len(cameras)} camera" + "s" * (len(cameras) != 1),
            "Record at least two cameras, or one with an IMU, GNSS or poses.",
        ),
        Check(
            "intrinsics",
            not unlensed,
            True,
            f"missing for {', '.join(unlensed)}" if unlensed else "known for every camera",
            "Give intrinsics: record camera_info, or calibrate each lens with `rigwake intrinsics`.",
        ),
        Check(
            "frame rate and length",
            not slow,
            True,
            f"too slow or short: {', '.join(slow)}" if slow else "every camera long and fast enough",
            f"Record for at least {MIN_SECONDS:.0f} s (a minute or two is best), at {MIN_CAMERA_HZ:.0f} Hz or more.",
        ),
        _common_time(inspection),
        Check(
            "pictures",
            not broken,
            True,
            f"errors in {', '.join(broken)}" if broken else "sampled frames are fine",
            "Look at the findings: frames that cannot be read, black or frozen cameras.",
        ),
        Check(
            "metric scale",
            metric,
            False,
            "an IMU, GNSS or metric poses" if metric else "no sensor that measures metres",
            "Record GNSS or an IMU: without, all offsets are known up to one common scale.",
        ),
    ]
    if cameras:
        return checks
    return [
        replace(check, passed=None, measured="there are no cameras", remedy="")
        if check.name in _ABOUT_CAMERAS
        else check
        for check in checks
    ]


def _common_time(inspection: Inspection) -> Check:
    """Whether every camera shares enough time with the IMU and the GNSS, or without these with the other cameras."""
    recording = inspection.recording
    others = [_longest("imu", recording.imus), _longest("gnss", recording.gnss)]
    anchors = [key for key in others if key is not None] or [
        f"camera.{name}" for name in list(recording.cameras)[:1]
    ]
    apart = []
    for name in recording.cameras:
        for anchor in anchors:
            camera, other = inspection.timings[f"camera.{name}"], inspection.timings[anchor]
            shared_ns = min(camera.end_ns, other.end_ns) - max(camera.start_ns, other.start_ns)
            if shared_ns * 1e-9 < min(MIN_SECONDS, _MOST_OF_IT * camera.duration_s):
                apart.append(f"{name} and {anchor.partition('.')[2]}: {max(shared_ns * 1e-9, 0):.1f} s")
    return Check(
        "common time",
        not apart,
        True,
        f"hardly any in common: {', '.join(apart)}" if apart else "the sensors overlap in time",
        "Let all sensors record at the same time and on one clock: a video without stamps counts from 0, others from "
        "1970; give its stamps in NAME_timestamps.csv.",
    )


def _longest(kind: str, streams: Mapping[str, ImuStream] | Mapping[str, GnssStream]) -> str | None:
    """Key of the stream with the most samples: the one that is used."""
    if not streams:
        return None
    return f"{kind}.{max(streams, key=lambda name: len(streams[name].timestamps_ns))}"


def _motion_checks(inspection: Inspection) -> list[Check]:
    turn, path = inspection.turning, inspection.travel
    turn_remedy = (
        f"Turn through at least {MIN_TURNING_DEG:.0f} deg, to both sides: a figure of eight is best."
    )
    tilt_remedy = (
        "Record where waves roll and pitch the boat, or shift weight on board; else measure the heights of the "
        "cameras with a tape, for calm water does not tell them."
    )
    if turn is None:
        checks = [
            Check("turning", None, True, "unknown without an IMU", turn_remedy),
            Check("rolling and pitching", None, False, "unknown without an IMU", tilt_remedy),
        ]
    else:
        major, minor = turn.tilt_std_deg
        checks = [
            Check(
                "turning",
                turn.turned_deg >= MIN_TURNING_DEG,
                True,
                f"{turn.turned_deg:.0f} deg in all, net {turn.net_deg:.0f} deg",
                turn_remedy,
            ),
            Check(
                "rolling and pitching",
                major >= GOOD_TILT_STD_DEG and minor >= MIN_TILT_STD_DEG,
                False,
                f"tilt varies by {major:.1f} and {minor:.1f} deg (1 sigma)",
                tilt_remedy,
            ),
        ]
    still = path.still_fraction if path is not None else None
    moved = None if path is None else path.path_m >= MIN_PATH_M and (still or 0.0) <= MAX_STILL
    measured = (
        "unknown without GNSS"
        if path is None
        else f"{path.path_m:.0f} m, {100 * path.still_fraction:.0f} % standing"
    )
    remedy = (
        f"Keep moving: at least {MIN_PATH_M:.0f} m under way, not more than {100 * MAX_STILL:.0f} % standing."
    )
    return [*checks, Check("path", moved, False, measured, remedy)]
