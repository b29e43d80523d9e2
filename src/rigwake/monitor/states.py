"""What is said of a camera, block by block, and how it changes."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

from rigwake.monitor.thresholds import Thresholds


class CameraState(StrEnum):
    """OK: within the calibration, as far as said. SUSPECT: perhaps not, or not clear whose fault. DRIFTED: it moved.
    RECALIBRATING: a new mounting is being measured. UNOBSERVABLE: this motion cannot tell."""

    OK = "OK"
    SUSPECT = "SUSPECT"
    DRIFTED = "DRIFTED"
    RECALIBRATING = "RECALIBRATING"
    UNOBSERVABLE = "UNOBSERVABLE"


@dataclass(frozen=True)
class Standing:
    """A state, and how many quiet blocks in a row a suspicion has seen."""

    state: CameraState = CameraState.UNOBSERVABLE
    calm: int = 0


def next_standing(
    before: Standing, statistic: float, *, blamed: bool, observable: bool, thresholds: Thresholds
) -> Standing:
    """The state after one more block.

    statistic: likelihood ratio of a change. blamed: the alarm is this camera's, and no other explanation's. observable:
    every axis was seen well enough lately. A drift stays until the camera is recalibrated; a step so large that the
    statistic passes the alarm within one block skips the suspicion; a suspicion ends after some quiet blocks.
    """
    state = before.state
    if state is CameraState.DRIFTED:
        return before
    if statistic >= thresholds.alarm and blamed:
        return Standing(CameraState.DRIFTED)
    if statistic >= thresholds.suspect:
        return Standing(CameraState.SUSPECT)
    quiet = CameraState.OK if observable else CameraState.UNOBSERVABLE
    if state is CameraState.SUSPECT:
        calm = before.calm + 1 if statistic < thresholds.calm else 0
        return Standing(quiet) if calm >= thresholds.calm_blocks else Standing(CameraState.SUSPECT, calm)
    return Standing(quiet)


def recalibrating(state: CameraState) -> CameraState:
    """Of a camera that drifted, or that is suspected of a shift, while its new mounting is measured."""
    measured = state in (CameraState.DRIFTED, CameraState.SUSPECT)
    return CameraState.RECALIBRATING if measured else state


def recalibrated(state: CameraState) -> CameraState:
    """Of a camera whose new mounting is in force."""
    return CameraState.OK if state is CameraState.RECALIBRATING else state
