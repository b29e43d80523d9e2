"""Yaw, pitch, roll: for people, and for formats that hold nothing better."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from rigwake._types import Array


def yaw_pitch_roll(rotation: ArrayLike) -> Array:
    """(3,) radians with `R = Rz(yaw) Ry(pitch) Rx(roll)`, the fixed-axis roll-pitch-yaw of URDF and REP-103.

    rotation: (3, 3). At a pitch of 90 degrees yaw and roll are not unique; what is returned still composes to R.
    """
    R = np.asarray(rotation, dtype=np.float64)
    yaw = np.arctan2(R[1, 0], R[0, 0])
    c, s = np.cos(yaw), np.sin(yaw)
    # roll of what is left after yaw is taken off: exact also where yaw is arbitrary
    roll = np.arctan2(s * R[0, 2] - c * R[1, 2], c * R[1, 1] - s * R[0, 1])
    pitch = np.arctan2(-R[2, 0], c * R[0, 0] + s * R[1, 0])
    return np.array([yaw, pitch, roll])


def rotation_from_yaw_pitch_roll(angles: ArrayLike) -> Array:
    """(3, 3) `Rz(yaw) Ry(pitch) Rx(roll)` of (3,) radians."""
    (cy, cp, cr), (sy, sp, sr) = np.cos(angles), np.sin(angles)
    return np.array(
        [
            [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
            [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
            [-sp, cp * sr, cp * cr],
        ]
    )
