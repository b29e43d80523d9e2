"""Numbers that decide, in one place: what an alarm takes, and what counts as seen."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rigwake.errors import UsageError


@dataclass(frozen=True)
class Thresholds:
    """alarm: of the likelihood ratio (chi-square of three), above which a camera has drifted; suspect: has perhaps;
    calm: below which a suspicion ends. The figures in docs/monitor.md belong to the defaults.

    clip: a block counts for no more than this many standard deviations.
    margin: by how much (log likelihood) the blamed explanation must beat all others. observable_deg: an axis with a
    larger standard deviation over the longest window is not observable. shortest, longest: blocks of a window;
    steady_lag: blocks that what was steady before is away from it.
    floor_deg: systematic error that no amount of data takes away. offset_deg: by how much lenses let two cameras
    disagree where their pictures overlap; offset_floor_deg: how much of that may change over minutes. line_deg,
    line_floor_deg: the same of each camera's horizon, which may be a shore. alone: the horizon's own ratio, above which
    a camera is suspect where its motion tells nothing. support: log likelihood that the motion alone must add to what
    all cues together say of a camera.
    calm_blocks: quiet blocks that end a suspicion. patience: blocks that blame may take.
    """

    alarm: float = 45.0
    suspect: float = 30.0
    calm: float = 16.0
    clip: float = 8.0
    shortest: int = 2
    longest: int = 12
    steady_lag: int = 6
    margin: float = 3.0
    observable_deg: float = 0.15
    floor_deg: float = 0.005
    offset_deg: float = 0.03
    offset_floor_deg: float = 0.01
    line_deg: float = 1.0
    line_floor_deg: float = 0.03
    alone: float = 90.0
    support: float = 2.0
    calm_blocks: int = 3
    patience: int = 3

    def __post_init__(self) -> None:
        if not 0 < self.calm < self.suspect <= self.alarm:
            raise UsageError(
                f"Thresholds must rise: calm {self.calm:g}, suspect {self.suspect:g}, alarm {self.alarm:g}."
            )
        if self.longest < 2 or self.clip <= 0 or not np.isfinite(self.alarm):
            raise UsageError(
                "A window needs two blocks or more, and clipping a positive number of deviations."
            )
