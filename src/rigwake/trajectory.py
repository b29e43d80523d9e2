"""The `Trajectory` value: where one body was, over time."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from rigwake._types import Array
from rigwake.errors import TrajectoryError
from rigwake.geometry.se3 import SE3

CovarianceKind = Literal["poses", "increments"]


@dataclass(frozen=True, eq=False)
class Trajectory:
    """Time-stamped poses of one body in a world frame of its own.

    name: the body's name (`front`, `imu`).
    timestamps_ns: (N,) int64, strictly increasing, on the body's own clock.
    world_from_body: N transforms; metres if `is_metric`, else in an unknown unit per segment.
    covariances: (N, 6, 6) right-tangent `[rotation, translation]`, or None. They describe the `poses`
        themselves (independent errors: GNSS/INS, board poses) or the `increments` (entry k: the motion from
        pose k-1 to k, entry 0 ignored: odometry), as `covariance_kind` says.
    segment_ids: (N,) int, non-decreasing; odometry that broke starts a new segment, with its own origin and
        (if not metric) its own unit. All zeros by default.

    Raises TrajectoryError if stamps do not increase, shapes disagree or values are not finite.
    """

    name: str
    timestamps_ns: NDArray[np.int64]
    world_from_body: SE3
    covariances: Array | None = None
    covariance_kind: CovarianceKind = "increments"
    is_metric: bool = True
    segment_ids: NDArray[np.int64] | None = None

    def __post_init__(self) -> None:
        stamps = np.asarray(self.timestamps_ns)
        if stamps.ndim != 1 or not np.issubdtype(stamps.dtype, np.integer):
            raise TrajectoryError(f"{self.name}: timestamps_ns must be a 1-D integer array of nanoseconds.")
        n = len(stamps)
        if n == 0:
            raise TrajectoryError(
                f"{self.name}: the trajectory is empty.", remedy="Check the file or the topic."
            )
        if self.world_from_body.shape != (n,):
            raise TrajectoryError(
                f"{self.name}: {n} stamps but poses of batch shape {self.world_from_body.shape}."
            )
        finite = (
            np.isfinite(self.world_from_body.translation).all()
            and np.isfinite(self.world_from_body.rotation).all()
        )
        if not finite:
            raise TrajectoryError(f"{self.name}: poses contain NaN or infinite values.")
        if n > 1 and np.any(np.diff(stamps) <= 0):
            raise TrajectoryError(
                f"{self.name}: stamps do not strictly increase.",
                remedy="Sort the poses and drop duplicates; the file readers do this and report it.",
            )
        object.__setattr__(self, "timestamps_ns", stamps.astype(np.int64))
        if self.covariances is not None and np.shape(self.covariances) != (n, 6, 6):
            raise TrajectoryError(f"{self.name}: covariances must have shape ({n}, 6, 6).")
        ids = np.zeros(n, dtype=np.int64) if self.segment_ids is None else np.asarray(self.segment_ids)
        if ids.shape != (n,) or np.any(np.diff(ids) < 0):
            raise TrajectoryError(f"{self.name}: segment_ids must be ({n},) and never decrease.")
        object.__setattr__(self, "segment_ids", ids.astype(np.int64))

    def __len__(self) -> int:
        return len(self.timestamps_ns)

    def __repr__(self) -> str:
        unit = "metric" if self.is_metric else "up to scale"
        return f"Trajectory({self.name!r}, {len(self)} poses, {self.duration_s:.1f} s, {unit})"

    @property
    def duration_s(self) -> float:
        """Seconds between the first and the last pose."""
        return float(self.timestamps_ns[-1] - self.timestamps_ns[0]) * 1e-9

    @property
    def times_s(self) -> Array:
        """(N,) seconds since the first pose (integers are subtracted before the conversion to float)."""
        return (self.timestamps_ns - self.timestamps_ns[0]) * 1e-9

    @property
    def path_length(self) -> float:
        """Summed distance between neighbouring poses of the same segment, metres if metric."""
        steps = np.linalg.norm(np.diff(self.world_from_body.translation, axis=0), axis=1)
        assert self.segment_ids is not None
        return float(steps[np.diff(self.segment_ids) == 0].sum())

    def take(self, index: NDArray[np.int64] | NDArray[np.bool_] | slice) -> Trajectory:
        """The chosen poses, in order. Increment covariances do not survive thinning: they are summed
        only by `odometry`; here they are dropped unless the index is a contiguous slice."""
        kept = np.arange(len(self))[index]
        contiguous = len(kept) > 0 and bool(np.all(np.diff(kept) == 1))
        keep_covariances = self.covariances is not None and (contiguous or self.covariance_kind == "poses")
        assert self.segment_ids is not None
        return replace(
            self,
            timestamps_ns=self.timestamps_ns[kept],
            world_from_body=self.world_from_body[kept],
            covariances=self.covariances[kept] if keep_covariances and self.covariances is not None else None,
            segment_ids=self.segment_ids[kept],
        )

    def between(self, start_ns: int, end_ns: int) -> Trajectory:
        """Poses with `start_ns <= stamp <= end_ns`."""
        inside = (self.timestamps_ns >= start_ns) & (self.timestamps_ns <= end_ns)
        return self.take(np.flatnonzero(inside))
