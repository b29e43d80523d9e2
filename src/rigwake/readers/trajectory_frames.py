"""What a file of poses may mean instead of `world_from_body` in right-handed axes, and the way back."""

from __future__ import annotations

from dataclasses import replace
from typing import Literal, get_args

import numpy as np

from rigwake.errors import UsageError
from rigwake.geometry.se3 import SE3
from rigwake.trajectory import Trajectory

FrameMeaning = Literal["enu", "ned", "inverse", "left-handed"]
FRAME_MEANINGS: tuple[str, ...] = get_args(FrameMeaning)

_FLU_FROM_FRD = np.diag([1.0, -1.0, -1.0])
_ENU_FROM_NED = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
_MIRROR_Y = np.diag([1.0, -1.0, 1.0])


def in_house_frames(trajectory: Trajectory, meaning: str) -> Trajectory:
    """`world_from_body` in right-handed axes of poses that were written as `meaning` says.

    enu: as it stands. ned: the world is north-east-down and the body forward-right-down (PX4, most INS); the result
    is east-north-up and forward-left-up. inverse: the rows are `body_from_world`. left-handed: world and body have
    left-handed axes; y is mirrored in both, so that Unity's (right, up, forward) becomes the optical frame and
    Unreal's and CARLA's (forward, right, up) becomes forward-left-up. Covariances do not survive a change.
    Raises UsageError for another meaning.
    """
    poses = trajectory.world_from_body
    if meaning == "enu":
        return trajectory
    if meaning == "ned":
        changed = SE3(_ENU_FROM_NED @ poses.rotation @ _FLU_FROM_FRD.T, poses.translation @ _ENU_FROM_NED.T)
    elif meaning == "inverse":
        changed = poses.inverse()
    elif meaning == "left-handed":
        changed = SE3(_MIRROR_Y @ poses.rotation @ _MIRROR_Y, poses.translation @ _MIRROR_Y)
    else:
        raise UsageError(
            f"--frame {meaning!r} is unknown.", remedy=f"Choose from {', '.join(FRAME_MEANINGS)}."
        )
    return replace(trajectory, world_from_body=changed, covariances=None)
