"""How the boat moved: the numbers and curves that tell whether a recording can calibrate anything."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from rigwake._types import Array
from rigwake.errors import EstimationError
from rigwake.geometry.align import align_points
from rigwake.geometry.interpolate import interpolate
from rigwake.trajectory import Trajectory

_MOST_POINTS = 1200


@dataclass(frozen=True, eq=False)
class MotionFigures:
    """Of one trajectory: seconds and, at these, yaw, pitch, roll (degrees, yaw unwrapped) and speed (m/s)."""

    duration_s: float
    path_m: float
    turned_deg: float
    yaw_span_deg: float
    roll_std_deg: float
    pitch_std_deg: float
    at_s: Array
    yaw_pitch_roll_deg: Array
    speed: Array


def motion_of(trajectory: Trajectory) -> MotionFigures:
    """Statistics of a metric trajectory of the rig; speed over about one second."""
    R = trajectory.world_from_body.rotation
    yaw = np.unwrap(np.arctan2(R[:, 1, 0], R[:, 0, 0]))
    pitch = np.arcsin(np.clip(-R[:, 2, 0], -1, 1))
    roll = np.arctan2(R[:, 2, 1], R[:, 2, 2])
    angles = np.rad2deg(np.stack([yaw, pitch, roll], axis=1))
    t, p = trajectory.times_s, trajectory.world_from_body.translation
    apart = max(1, round(1.0 / max(float(np.median(np.diff(t))), 1e-3))) if len(t) > 1 else 1
    speed = np.full(len(t), np.nan)
    if len(t) > apart:
        steps = np.linalg.norm(p[apart:] - p[:-apart], axis=1) / (t[apart:] - t[:-apart])
        speed[apart // 2 : apart // 2 + len(steps)] = steps
    kept = thin(len(t))
    return MotionFigures(
        duration_s=trajectory.duration_s,
        path_m=trajectory.path_length,
        turned_deg=float(np.abs(np.diff(angles[kept, 0])).sum()),
        yaw_span_deg=float(np.ptp(angles[:, 0])),
        roll_std_deg=float(angles[:, 2].std()),
        pitch_std_deg=float(angles[:, 1].std()),
        at_s=t[kept],
        yaw_pitch_roll_deg=angles[kept],
        speed=speed[kept],
    )


def thin(count: int, most: int = _MOST_POINTS) -> np.ndarray:
    """Indices of at most so many of `count`, evenly spread, both ends included."""
    return np.unique(np.linspace(0, max(count - 1, 0), min(count, most)).astype(np.int64))


def paths_in_one_world(trajectories: Mapping[str, Trajectory], main: str) -> dict[str, Array]:
    """Positions (N, 3) of all trajectories, thinned, laid over the one called `main`.

    Each odometry has a world, and if not metric a unit, of its own: it is aligned (with scale) where the times
    overlap; one that cannot be is left out.
    """
    if main not in trajectories:
        return {}
    whole = trajectories[main]
    paths = {main: whole.world_from_body.translation[thin(len(whole))]}
    for name, trajectory in trajectories.items():
        if name == main:
            continue
        stamps = trajectory.timestamps_ns
        inside = (stamps >= whole.timestamps_ns[0]) & (stamps <= whole.timestamps_ns[-1])
        kept = np.flatnonzero(inside)[thin(int(inside.sum()))] if inside.any() else np.zeros(0, np.int64)
        if len(kept) < 3:
            continue
        own = trajectory.world_from_body.translation[kept]
        target = interpolate(whole.timestamps_ns, whole.world_from_body, stamps[kept]).translation
        try:
            alignment = align_points(own, target, "sim3")
        except EstimationError:  # on one line or in one place: nothing to lay over
            continue
        paths[name] = alignment.scale * (own @ alignment.target_from_source.rotation.T)
        paths[name] += alignment.target_from_source.translation
    return paths
