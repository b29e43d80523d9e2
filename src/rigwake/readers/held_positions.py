"""Positions that are repeated until the next one comes: GNSS at 5 Hz in the topic of an INS at 10 Hz."""

from __future__ import annotations

import numpy as np

from rigwake.recording import Finding
from rigwake.trajectory import Trajectory

_FEWEST_RUNS = 8
_LEAST_FRACTION = 0.05
_LONGEST_RUN = 50
_TURNED_RAD = 1e-7


def without_held_positions(trajectory: Trajectory) -> tuple[Trajectory, tuple[Finding, ...]]:
    """The poses whose position is their own, and what was dropped.

    A position is held where it equals the one before to the last digit although the orientation changed, in many
    short runs; long runs are a body at rest. A held position is as old as the run is long, which reads as an offset of
    the body against its direction of travel.
    """
    if len(trajectory) < 3 * _FEWEST_RUNS or trajectory.covariances is not None:
        return trajectory, ()
    position, rotation = trajectory.world_from_body.translation, trajectory.world_from_body.rotation
    turned = np.abs(np.diff(rotation, axis=0)).max(axis=(1, 2)) > _TURNED_RAD
    same = np.all(np.diff(position, axis=0) == 0.0, axis=1)
    held = np.concatenate([[False], same])
    edges = np.flatnonzero(np.diff(np.concatenate([[False], held, [False]]).astype(np.int8)))
    lengths = edges[1::2] - edges[::2]
    short = lengths <= _LONGEST_RUN
    if short.sum() < _FEWEST_RUNS or turned[same].mean() < 0.5:
        return trajectory, ()
    for start, end in zip(edges[::2][~short], edges[1::2][~short], strict=True):
        held[start:end] = False  # at rest
    if held.mean() < _LEAST_FRACTION:
        return trajectory, ()
    message = (
        f"{int(held.sum())} of {len(trajectory)} positions repeat the one before while the body turns: they are older "
        "than their stamp. Those rows were left out."
    )
    return trajectory.take(~held), (Finding("warning", trajectory.name, message),)
