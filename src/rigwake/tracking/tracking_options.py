"""What can be chosen about tracking."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

from rigwake.errors import UsageError

MatcherName = Literal["brute-force", "flann"]
FrontEndName = Literal["klt", "sift", "fast-brief", "orb"]


@dataclass(frozen=True)
class TrackingOptions:
    """Options of a front end; the defaults suit 640x480 to 1280x960 images at 5 to 30 Hz.

    front_end: `klt` follows corners from frame to frame; the others match descriptors.
    max_features: points followed at a time. redetect_below: new points are looked for when fewer than this
        share of those after the last detection are left, and every `redetect_every` frames when fewer than this
        share of `max_features` are. cell_px: side of the grid cells over which points are balanced.
    min_distance_px: spacing of points. window_px, levels: the pyramidal Lucas-Kanade search.
    max_forward_backward_px: how far a point may land from where it started when followed there and back.
    patch_radius_px: of the reference patches that every observation is registered against.
    warp_prior_std: how far a patch may deform otherwise than the camera's turn predicts, per frame (px per px).
    min_correlation: with the reference patch, under which a point is lost. max_std_px: predicted standard
        deviation of an observation, above which a point is lost. max_stretch: a patch drawn larger or smaller
        than its reference by more ends; the point may be found anew, as another track.
    matcher, max_ratio: how the other front ends match descriptors, and Lowe's ratio: a match must be closer than
        this fraction of the distance to the second best. memory: frames for which a point that was not matched is
        remembered. min_displacement_px, max_displacement_px: matches that moved less or more are dropped.
    max_high_fraction: of `max_features`, how many new points may lie more than 15 degrees above the horizon, where it
        is known; below it come first. That high is mostly sky.
    region_of_interest: x, y, width, height of the part of the image to use, pixels; None is all.
    max_gap_s: points are not followed across a longer gap between usable frames.
    """

    front_end: FrontEndName = "klt"
    max_features: int = 400
    redetect_below: float = 0.7
    redetect_every: int = 5
    cell_px: int = 40
    min_distance_px: int = 6
    window_px: int = 21
    levels: int = 4
    max_forward_backward_px: float = 1.0
    patch_radius_px: int = 8
    warp_prior_std: float = 0.02
    min_correlation: float = 0.93
    max_std_px: float = 0.2
    max_stretch: float = 1.8
    matcher: MatcherName = "brute-force"
    max_ratio: float = 0.8
    memory: int = 3
    min_displacement_px: float = 0.0
    max_displacement_px: float = 100.0
    max_high_fraction: float = 0.2
    region_of_interest: tuple[int, int, int, int] | None = None
    max_gap_s: float = 0.6

    def __post_init__(self) -> None:
        for name, known in (("front_end", get_args(FrontEndName)), ("matcher", get_args(MatcherName))):
            if getattr(self, name) not in known:
                raise UsageError(
                    f"No {name.replace('_', ' ')} {getattr(self, name)!r}.",
                    remedy=f"There are: {', '.join(known)}.",
                )
        for name in ("max_features", "cell_px", "min_distance_px", "window_px", "levels"):
            if getattr(self, name) < 1:
                raise UsageError(f"tracking option {name} must be at least 1, not {getattr(self, name)}.")
