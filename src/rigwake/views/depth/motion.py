"""Ranges from one camera that moves: its picture now and a little earlier are the two views of a pair.

The pair is matched like that of two cameras (`epipolar`), with the way the camera went as baseline. What moves by
itself has a wrong range, which shows as a disagreement with the water plane or with other pairs; mirror images lie
under the plane, which tells them from what stands on it (`height_check.tested_by_height`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from rigwake._types import Image, Mask, Stamps
from rigwake.geometry import so3
from rigwake.geometry.se3 import SE3
from rigwake.views.attitude import AttitudeTrack, LevelAttitude
from rigwake.views.depth.epipolar import MatchedPoints, epipolar_pairs, match_pair
from rigwake.views.surround_rig import SurroundRig

_LEAST_WAY_M = 0.6
_LONGEST_NS = 2_000_000_000  # boats and waves move on
_MOST_TURN = np.deg2rad(35.0)


@dataclass(frozen=True, eq=False)
class Earlier:
    """Pictures taken a little earlier, by camera name, and the pose of the rig then in the rig's frame of now."""

    images: Mapping[str, Image]
    rig_from_rig_then: SE3


def moved_points(
    images: Mapping[str, Image],
    earlier: Earlier,
    rig: SurroundRig,
    attitude: LevelAttitude,
    masks: Mapping[str, Mask] | None = None,
    nearest_m: float = 3.0,
) -> list[MatchedPoints]:
    """What every camera sees now and saw earlier, points in the level frame of now; none of cameras that hardly moved.

    images: of now, by camera name. The way since should be exact to a hundredth of its length: so are the ranges.
    """
    found = []
    for index, name in enumerate(rig.names):
        if name not in images or name not in earlier.images:
            continue
        now = rig.rig_from_cam[index]
        then = earlier.rig_from_rig_then * now
        pictures = {"now": images[name], "then": earlier.images[name]}
        own = {} if masks is None or name not in masks else dict.fromkeys(pictures, masks[name])
        model = rig.models[index]
        virtual = SurroundRig(
            ("now", "then"), (model, model), (now, then), (0.0, 0.0), rig.viewpoint_rig, rig.forward_rig
        )
        for pair in epipolar_pairs(virtual, attitude):
            points = match_pair(pair, pictures, virtual, attitude, own, nearest_m)
            if points is not None:
                found.append(
                    MatchedPoints(points.points_level, points.inverse_std, points.texture, (name, name))
                )
    return found


def earlier_time(track: AttitudeTrack | None, times_ns: Sequence[int] | Stamps, now_ns: int) -> int | None:
    """The latest of the times (rig clock, increasing) before `now_ns` since when the rig has gone far enough for a
    baseline, and has not turned too far; None if there is none or the way is not known."""
    if track is None:
        return None
    times = np.asarray(times_ns, dtype=np.int64)
    for then in times[(times < now_ns) & (times > now_ns - _LONGEST_NS)][::-1].tolist():
        moved = track.moved(then, now_ns)
        if moved is None or np.linalg.norm(so3.log(moved.rotation)) > _MOST_TURN:
            return None
        if np.linalg.norm(moved.translation) >= _LEAST_WAY_M:
            return int(then)
    return None
