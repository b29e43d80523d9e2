"""`inspect_recording`: everything that can be said about a recording in seconds."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from rigwake._progress import CountProgress
from rigwake.inspection.picture_samples import (
    MOST_CHECKED_FRAMES,
    Pictures,
    look_at_pictures,
    sampled_indices,
    unreadable_frames,
)
from rigwake.inspection.time_offsets import SensorTimeOffset, camera_offset, gnss_offset
from rigwake.inspection.timing import Timing, timing
from rigwake.inspection.vessel_motion import Travel, Turning, travel, turning
from rigwake.recording import Finding, GnssStream, ImuStream, Recording, main_gnss, main_imu

MIN_MOTION_SAMPLES = 50
_GRAVITY_RANGE = (8.5, 11.0)


@dataclass(frozen=True, eq=False)
class Inspection:
    """What `inspect_recording` found. Sensors by `kind.name`: `camera.front`, `imu.imu`, `gnss.gps`.

    turning, travel: of the IMU and the GNSS that every verb uses, None where there is none. findings: of the reader,
    and what was measured here.
    """

    recording: Recording
    timings: Mapping[str, Timing]
    pictures: Mapping[str, Pictures]
    turning: Turning | None
    travel: Travel | None
    time_offsets: Mapping[str, SensorTimeOffset]
    findings: tuple[Finding, ...]


def inspect_recording(recording: Recording, progress: CountProgress | None = None) -> Inspection:
    """Inspect a recording: stamps of everything, a few dozen sampled frames of each camera."""
    report = progress or (lambda *_: None)
    timings = {key: timing(stream.timestamps_ns) for key, stream in sensors(recording).items()}
    pictures = _pictures(recording, report)
    imu = main_imu(recording)
    imu = imu if imu is not None and len(imu.gyro) >= MIN_MOTION_SAMPLES else None
    turn = turning(imu) if imu is not None else None
    gnss = main_gnss(recording)
    path = travel(gnss) if gnss is not None else None
    time_offsets = _time_offsets(imu, gnss, pictures)
    findings = (*recording.findings, *_timing_findings(timings), *_picture_findings(pictures))
    findings += tuple(_unreadable_findings(recording))
    findings += (*_imu_findings(recording), *_time_offset_findings(time_offsets, timings))
    return Inspection(recording, timings, pictures, turn, path, time_offsets, findings)


def sensors(recording: Recording) -> dict[str, Any]:
    """All streams by `kind.name`."""
    kinds = {
        "camera": recording.cameras,
        "imu": recording.imus,
        "gnss": recording.gnss,
        "attitude": recording.attitudes,
        "pose": recording.poses,
    }
    return {f"{kind}.{name}": stream for kind, streams in kinds.items() for name, stream in streams.items()}


def _pictures(recording: Recording, report: CountProgress) -> dict[str, Pictures]:
    total = sum(len(burst) for c in recording.cameras.values() for burst in sampled_indices(len(c)))
    done = 0
    pictures = {}
    for name, camera in recording.cameras.items():

        def advance(frames: int, name: str = name) -> None:
            nonlocal done
            done += frames
            report(f"looking at {name}", done, total)

        pictures[name] = look_at_pictures(camera, advance)
    return pictures


def _time_offsets(
    imu: ImuStream | None, gnss: GnssStream | None, pictures: Mapping[str, Pictures]
) -> dict[str, SensorTimeOffset]:
    if imu is None:
        return {}
    time_offsets = {f"camera.{name}": camera_offset(name, seen, imu) for name, seen in pictures.items()}
    if gnss is not None:
        time_offsets[f"gnss.{gnss.name}"] = gnss_offset(gnss, imu)
    return time_offsets


def _timing_findings(timings: Mapping[str, Timing]) -> list[Finding]:
    findings = []
    filled = [t for t in timings.values() if t.samples > 1]
    end_ns = max((t.end_ns for t in filled), default=0)
    start_ns = min((t.start_ns for t in filled), default=0)
    whole_s = (end_ns - start_ns) * 1e-9
    for key, t in timings.items():
        if t.dropped:
            message = f"{t.dropped} samples missing in {t.gaps} gaps, the longest {t.longest_gap_s:.2f} s."
            findings.append(Finding("warning" if t.dropped > 0.01 * t.samples else "note", key, message))
        covered = t.duration_s / whole_s if whole_s > 0 else 1.0
        if covered < 0.9 and t.samples > 1:
            first, last = (t.start_ns - start_ns) * 1e-9, (t.end_ns - start_ns) * 1e-9
            message = f"records only from {first:.1f} s to {last:.1f} s of {whole_s:.1f} s."
            findings.append(Finding("warning", key, message))
        if t.samples < 3:
            findings.append(Finding("error", key, f"has only {t.samples} samples."))
    return findings


def _picture_findings(pictures: Mapping[str, Pictures]) -> list[Finding]:
    findings = []
    for name, p in pictures.items():
        counted = {
            "cannot be decoded, or have another size": p.sampled - p.readable,
            "are black": p.dark,
            "are over-exposed": p.overexposed,
            "are the frame before once more (frozen)": p.frozen,
        }
        for what, count in counted.items():
            if count:
                severity = "error" if count > 0.5 * p.sampled else "warning"
                message = f"{count} of {p.sampled} sampled frames {what}."
                findings.append(Finding(severity, f"camera.{name}", message))
    return findings


def _unreadable_findings(recording: Recording) -> list[Finding]:
    findings = []
    most = MOST_CHECKED_FRAMES // max(len(recording.cameras), 1)
    for name, camera in recording.cameras.items():
        lost, checked = unreadable_frames(camera, most)
        if lost:
            message = f"{lost} of {checked} encoded frames are cut off, damaged or of another size: left out."
            findings.append(
                Finding("error" if lost > 0.5 * checked else "warning", f"camera.{name}", message)
            )
    return findings


def _imu_findings(recording: Recording) -> list[Finding]:
    findings = []
    for name, imu in recording.imus.items():
        force = float(np.median(np.linalg.norm(imu.accel, axis=1)))
        if not _GRAVITY_RANGE[0] < force < _GRAVITY_RANGE[1]:
            message = f"the accelerometer shows {force:.2f} m/s^2 at the median, gravity is 9.81."
            hint = " Its unit seems to be g." if 0.8 < force < 1.2 else ""
            findings.append(Finding("warning", f"imu.{name}", message + hint))
        if not imu.gyro.any():
            findings.append(Finding("error", f"imu.{name}", "the gyro is zero throughout."))
    return findings


def _time_offset_findings(
    time_offsets: Mapping[str, SensorTimeOffset], timings: Mapping[str, Timing]
) -> list[Finding]:
    findings = []
    for key, time_offset in time_offsets.items():
        if time_offset.offset_s is None or time_offset.std_s is None:
            continue
        period_s = 1 / timings[key].rate_hz
        if abs(time_offset.offset_s) > max(0.5 * period_s, 3 * time_offset.std_s):
            off_ms, std_ms = 1e3 * time_offset.offset_s, 1e3 * time_offset.std_s
            message = f"its clock is {off_ms:.0f} +- {std_ms:.0f} ms off the IMU's."
            findings.append(Finding("warning", key, message))
    return findings
