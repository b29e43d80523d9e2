"""The order of a quaternion without names, by the motion: vehicles travel in a steady direction of their own axes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from rigwake._types import Array
from rigwake.geometry.so3 import matrix_from_quat_wxyz
from rigwake.readers.trajectory_columns import PoseColumns
from rigwake.recording import Finding

_UNSTEADY, _TIMES_STEADIER = 0.06, 8.0
_FEWEST_STEPS = 20


def steadier_order(chosen: PoseColumns, values: Array, name: str) -> tuple[PoseColumns, Array, list[Finding]]:
    """The columns and values with the quaternion in the other order, if only that makes the motion sensible.

    values: (N, 7) position and qw qx qy qz as chosen. In the wrong order the direction of travel, seen from the body,
    turns about as the body does; that must be so, and in the other order it must be far steadier. A warning says what
    was chosen.
    """
    first_is_w = chosen.rotation[0] < chosen.rotation[1]
    roll = 1 if first_is_w else -1  # the numbers as they stand in the file, then read the other way
    other = np.concatenate([values[:, :3], np.roll(values[:, 3:], roll, axis=1)], axis=1)
    as_chosen = _unsteadiness(values)
    if as_chosen < _UNSTEADY or _TIMES_STEADIER * _unsteadiness(other) > as_chosen:
        return chosen, values, []
    qw, qx, qy, qz = chosen.rotation
    rotation = (qz, qw, qx, qy) if first_is_w else (qx, qy, qz, qw)
    words = "last (qx qy qz qw)" if first_is_w else "first (qw qx qy qz)"
    message = (
        f"qw is taken to stand {words}: in the other order the direction of travel would turn about "
        "in the body's axes. Say it with --columns."
    )
    return replace(chosen, rotation=rotation), other, [Finding("warning", name, message)]


def _unsteadiness(values: Array) -> float:
    """1 minus the length of the mean direction of travel in body axes; 0 where it cannot be told."""
    quat_wxyz = values[:, 3:]
    lengths = np.linalg.norm(quat_wxyz, axis=1)
    if np.any(np.abs(lengths - 1) > 0.1):
        return 0.0
    stride = max(1, len(values) // 500)
    position = values[::stride, :3]
    steps = np.diff(position, axis=0)
    size = np.linalg.norm(steps, axis=1)
    moving = size > 0.3 * np.median(size) + 1e-12
    if moving.sum() < _FEWEST_STEPS:
        return 0.0
    rotations = matrix_from_quat_wxyz((quat_wxyz / lengths[:, None])[::stride][:-1][moving])
    directions = np.einsum("nji,nj->ni", rotations, steps[moving] / size[moving, None])
    return float(1 - np.linalg.norm(directions.mean(axis=0)))
