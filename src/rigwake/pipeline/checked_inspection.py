"""An inspection with what the sensors say about each other."""

from __future__ import annotations

from dataclasses import replace

from rigwake.inspection.readiness import Readiness, judge
from rigwake.inspection.recording_inspection import (
    MIN_MOTION_SAMPLES,
    Inspection,
    Progress,
    inspect_recording,
)
from rigwake.pipeline.sensor_checks import imu_checks
from rigwake.plausibility.values import SensorCheck
from rigwake.recording import Finding, Recording, main_imu


def inspect_with_checks(
    recording: Recording, progress: Progress | None = None
) -> tuple[Inspection, Readiness, tuple[SensorCheck, ...]]:
    """The inspection, whether it is enough to calibrate, and the checks; a sensor that is wrong is an error of it."""
    inspection = inspect_recording(recording, progress)
    checks = _sensor_checks(recording)
    wrong = [check for check in checks if not check.agrees]
    named = tuple(Finding("error", check.sensor, f"{check.hypothesis} {check.remedy}") for check in wrong)
    inspection = replace(inspection, findings=(*inspection.findings, *named))
    return inspection, judge(inspection), checks


def _sensor_checks(recording: Recording) -> tuple[SensorCheck, ...]:
    """The IMU that every verb uses: its units and axes, alone and against the cameras' coarse turns."""
    imu = main_imu(recording)
    if imu is None or len(imu.gyro) < MIN_MOTION_SAMPLES:
        return ()
    return imu_checks(imu, {n: c for n, c in recording.cameras.items() if c.model is not None})
