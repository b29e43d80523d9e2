"""Transforms between stamps: SLERP and linear, or a spline smooth enough to differentiate twice."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation, RotationSpline

from rigwake._types import Array, Indices, Stamps
from rigwake.errors import InputError
from rigwake.geometry import so3
from rigwake.geometry.se3 import SE3


def interpolate(timestamps_ns: Stamps, world_from_body: SE3, at_ns: Stamps) -> SE3:
    """Poses at `at_ns` by SLERP and linear interpolation between neighbours.

    timestamps_ns: (N,) strictly increasing; at_ns: (M,), within the span, else InputError: no extrapolation.
    """
    before, fraction = _locate(timestamps_ns, at_ns)
    first, second = world_from_body[before], world_from_body[before + 1]
    turn = so3.log(np.swapaxes(first.rotation, -1, -2) @ second.rotation)
    rotation = first.rotation @ so3.exp(turn * fraction[:, None])
    step = second.translation - first.translation
    return SE3(rotation, first.translation + step * fraction[:, None])


def _locate(timestamps_ns: Stamps, at_ns: Stamps) -> tuple[NDArray[np.int64], Array]:
    at = np.asarray(at_ns, dtype=np.int64)
    if len(timestamps_ns) < 2:
        raise InputError("Interpolation needs at least two poses.")
    if at.size and (at.min() < timestamps_ns[0] or at.max() > timestamps_ns[-1]):
        raise InputError(
            "Interpolation was asked for a time outside the trajectory.",
            remedy="Restrict the times to the common span first.",
        )
    before = np.clip(np.searchsorted(timestamps_ns, at, side="right") - 1, 0, len(timestamps_ns) - 2)
    gap = (timestamps_ns[before + 1] - timestamps_ns[before]).astype(np.float64)
    return before.astype(np.int64), (at - timestamps_ns[before]) / gap


@dataclass(frozen=True, eq=False)
class TransformSpline:
    """A twice differentiable curve through poses: cubic in position, `RotationSpline` in attitude.

    timestamps_ns: (N,) strictly increasing, N >= 2; world_from_body: N transforms.
    """

    timestamps_ns: Stamps
    world_from_body: SE3

    @cached_property
    def _curves(self) -> tuple[CubicSpline, RotationSpline]:
        if len(self.timestamps_ns) < 2:
            raise InputError("A spline needs at least two poses.")
        times = (self.timestamps_ns - self.timestamps_ns[0]) * 1e-9
        position = CubicSpline(times, self.world_from_body.translation)
        return position, RotationSpline(times, Rotation.from_matrix(self.world_from_body.rotation))

    def _times(self, at_ns: Stamps) -> Array:
        _locate(self.timestamps_ns, at_ns)
        return (np.asarray(at_ns, dtype=np.int64) - self.timestamps_ns[0]) * 1e-9

    def at(self, at_ns: Stamps) -> SE3:
        """Poses at `at_ns` (M,), within the span."""
        position, attitude = self._curves
        times = self._times(at_ns)
        return SE3(attitude(times).as_matrix(), position(times))

    def velocity_world(self, at_ns: Stamps) -> Array:
        """(M, 3) velocities in the world, metres per second."""
        return np.asarray(self._curves[0](self._times(at_ns), 1))

    def acceleration_world(self, at_ns: Stamps) -> Array:
        """(M, 3) accelerations in the world, metres per second squared."""
        return np.asarray(self._curves[0](self._times(at_ns), 2))


def nearest_indices(times: NDArray[Any], at: NDArray[Any]) -> Indices:
    """(n,) index of the time (N,), in rising order, nearest to each of `at` (n,); the later one of two alike."""
    after = np.minimum(np.searchsorted(times, at), len(times) - 1)
    before = np.maximum(after - 1, 0)
    return np.where(at - times[before] < times[after] - at, before, after).astype(np.int64)
