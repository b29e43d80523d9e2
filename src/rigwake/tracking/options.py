"""What can be chosen about tracking."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from rigwake.errors import UsageError

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
    max_gap_s: points are not followed across a longer gap between usable frames.
    """

    front_end: FrontEndName = "klt"
    max_features: int = 400
    redetect_below: float = 0.8
    redetect_every: int = 5
    cell_px: int = 40
    min_distance_px: int = 8
    window_px: int = 21
    levels: int = 4
    max_forward_backward_px: float = 1.0
    patch_radius_px: int = 8
    warp_prior_std: float = 0.02
    min_correlation: float = 0.93
    max_std_px: float = 0.2
    max_stretch: float = 1.8
    max_gap_s: float = 0.6

    def __post_init__(self) -> None:
        for name in ("max_features", "cell_px", "min_distance_px", "window_px", "levels"):
            if getattr(self, name) < 1:
                raise UsageError(f"tracking option {name} must be at least 1, not {getattr(self, name)}.")
