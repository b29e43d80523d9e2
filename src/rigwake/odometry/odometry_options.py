"""What can be chosen about odometry."""

from __future__ import annotations

from dataclasses import dataclass

from rigwake.errors import UsageError


@dataclass(frozen=True)
class OdometryOptions:
    """Options of monocular odometry; the defaults suit 5 to 30 Hz on boats and cars.

    seed: of everything random; the same seed gives the same answer.
    gate_px: a point agrees with a pose if it is seen within this distance.
    min_inliers, min_inlier_fraction: what a frame must show to be placed.
    min_parallax_stds: smallest angle under which a point is triangulated, in standard deviations of a bearing.
    keyframe_fraction: a keyframe is made when fewer of the last one's points are left than this.
    keyframe_parallax_deg: ... or when the median point has moved this far, rotation apart.
    keyframe_interval_s: ... or after this time.
    window: keyframes in the windowed adjustment. global_growth: the whole map is adjusted each time it has
    grown by this factor. max_lost: a segment ends after so many frames in a row that could not be placed.
    adjust_all_frames: end with an adjustment of every frame, not only of keyframes; switch it off where a
        smoother with inertial or satellite measurements follows.
    """

    seed: int = 0
    gate_px: float = 2.0
    min_inliers: int = 15
    min_inlier_fraction: float = 0.4
    min_parallax_stds: float = 15.0
    keyframe_fraction: float = 0.5
    keyframe_parallax_deg: float = 2.0
    keyframe_interval_s: float = 0.5
    window: int = 8
    global_growth: float = 1.4
    max_lost: int = 5
    adjust_all_frames: bool = True

    def __post_init__(self) -> None:
        for name in ("gate_px", "min_inliers", "min_parallax_stds", "window", "max_lost"):
            if getattr(self, name) <= 0:
                raise UsageError(f"odometry option {name} must be positive, not {getattr(self, name)}.")
        if self.global_growth <= 1:
            raise UsageError(f"odometry option global_growth must exceed 1, not {self.global_growth}.")
