"""A trajectory as a function of time: cubic interpolation on SE(3), and where it may be asked."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from rigwake._types import Array
from rigwake.geometry.se3 import SE3
from rigwake.handeye import kernels
from rigwake.trajectory import Trajectory


@dataclass(frozen=True, eq=False)
class Sampled:
    """Where a trajectory is at N asked times.

    world_from_body: N transforms. twists: (N, 6) body velocities `[rad/s, m/s]`.
    segments: (N,) int, -1 where the trajectory says nothing (outside it, inside a gap or between segments).
    """

    world_from_body: SE3
    twists: Array
    segments: NDArray[np.int64]

    @cached_property
    def motions(self) -> SE3:
        """`V_k^-1 V_k+1` from each time to the next: N - 1 transforms."""
        return self.motions_over(1)

    def motions_over(self, stride: int) -> SE3:
        """`V_k^-1 V_k+stride`: N - stride transforms."""
        V, starts = self.world_from_body, np.arange(len(self.segments) - stride)
        return SE3(*kernels.motions(V.rotation, V.translation, starts, stride))


@dataclass(frozen=True, eq=False)
class TrajectoryCurve:
    """A trajectory prepared for repeated interpolation.

    Between neighbouring poses j and j+1 the body follows `V_j exp(f(a))`, f the cubic Hermite polynomial in
    the tangent space at V_j with the velocities of both poses (Catmull-Rom); it passes through every pose.

    world_from_body: the poses. start_ns: the stamp that `times_s` counts from.
    increments: (N-1, 6) `log(V_j^-1 V_j+1)`.
    """

    trajectory: Trajectory
    world_from_body: SE3
    start_ns: int
    times_s: Array
    increments: Array
    twists: Array
    period_s: float
    max_gap_s: float

    @classmethod
    def of(cls, trajectory: Trajectory, max_gap_s: float | None = None) -> TrajectoryCurve:
        """Prepare `trajectory`; gaps longer than `max_gap_s` (default: 10 median periods) are not bridged."""
        times = trajectory.times_s
        # contiguous copies: the kernels are compiled for one layout only
        poses = SE3(trajectory.world_from_body.rotation.copy(), trajectory.world_from_body.translation.copy())
        increments = kernels.tangents(
            *kernels.motions(poses.rotation, poses.translation, np.arange(len(times) - 1), 1)
        )
        steps = np.diff(times)
        period = float(np.median(steps))
        longest = 10 * period if max_gap_s is None else max_gap_s
        return cls(
            trajectory,
            poses,
            int(trajectory.timestamps_ns[0]),
            times,
            increments,
            _node_twists(increments, steps),
            period,
            longest,
        )

    @property
    def segment_count(self) -> int:
        """Number of segments, counted from 0 to the highest id."""
        assert self.trajectory.segment_ids is not None
        return int(self.trajectory.segment_ids.max()) + 1

    @cached_property
    def at_poses(self) -> Sampled:
        """At its own stamps."""
        assert self.trajectory.segment_ids is not None
        return Sampled(self.world_from_body, self.twists, self.trajectory.segment_ids)

    def at(self, times_s: Array) -> Sampled:
        """Interpolate at `times_s`, seconds after `start_ns`; a tenth of a period past either end is allowed.

        Times within a nanosecond of a pose are that pose.
        """
        assert self.trajectory.segment_ids is not None
        poses = self.world_from_body
        rotation, translation, twists, segments = kernels.sample(
            self.times_s,
            poses.rotation,
            poses.translation,
            self.increments,
            self.twists,
            self.trajectory.segment_ids,
            times_s,
            self.max_gap_s,
            0.1 * self.period_s,
        )
        return Sampled(SE3(rotation, translation), twists, segments)


def _node_twists(increments: Array, steps: Array) -> Array:
    """Body velocities at the poses from both neighbouring increments (one-sided at the ends)."""
    speed = increments / steps[:, None]
    twists = np.empty((len(steps) + 1, 6))
    twists[0], twists[-1] = speed[0], speed[-1]
    before, after = steps[:-1, None], steps[1:, None]
    twists[1:-1] = (speed[:-1] * after + speed[1:] * before) / (before + after)
    return twists


def longest_segments(trajectory: Trajectory, most: int) -> tuple[Trajectory, int]:
    """The trajectory with its `most` longest segments, numbered from 0, and how many poses of others were left out.

    Every segment brings unknowns of its own (scale, world); of those that last for a few poses hardly more is left.
    """
    ids = trajectory.segment_ids
    assert ids is not None
    counts = np.bincount(ids)
    present = np.flatnonzero(counts)
    if len(present) <= most:
        return trajectory, 0
    kept = np.sort(present[np.argsort(-counts[present], kind="stable")[:most]])
    rows = np.flatnonzero(np.isin(ids, kept))
    covariances = None if trajectory.covariances is None else trajectory.covariances[rows]
    # covariances of increments stay true: within a segment nothing is thinned
    shorter = replace(
        trajectory,
        timestamps_ns=trajectory.timestamps_ns[rows],
        world_from_body=trajectory.world_from_body[rows],
        covariances=covariances,
        segment_ids=np.searchsorted(kept, ids[rows]),
    )
    return shorter, len(trajectory) - len(rows)
