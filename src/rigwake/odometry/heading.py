"""Heading of the world where no satellites give it: from a compass or an attitude sensor on the IMU."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from rigwake.errors import UnobservableError
from rigwake.geometry import so3
from rigwake.geometry.interpolate import interpolate
from rigwake.geometry.se3 import SE3
from rigwake.odometry.metric import MetricStart
from rigwake.recording import AttitudeStream


def headed(start: MetricStart, attitude: AttitudeStream) -> MetricStart:
    """Initial values in a level world, turned about the vertical so that x is east as the attitude says.

    attitude: `world_from_body` of the IMU's axes, on its clock. The turn is the circular mean of the differences.
    Raises UnobservableError if attitude and path share no time.
    """
    rig = start.world_from_rig
    shared = (attitude.timestamps_ns >= rig.timestamps_ns[0]) & (
        attitude.timestamps_ns <= rig.timestamps_ns[-1]
    )
    if not shared.any():
        raise UnobservableError(
            f"{attitude.name} says nothing about the time of {start.world_from_cam.name}.",
            consequence="The heading of the path stays arbitrary.",
            remedy="Check the clocks with `rigwake inspect`, or leave it out with --no-attitude.",
        )
    path = interpolate(rig.timestamps_ns, rig.world_from_body, attitude.timestamps_ns[shared])
    east_from_level = attitude.world_from_body[shared] @ np.swapaxes(path.rotation, 1, 2)
    sine = float((east_from_level[:, 1, 0] - east_from_level[:, 0, 1]).sum())
    cosine = float((east_from_level[:, 0, 0] + east_from_level[:, 1, 1]).sum())
    turn = SE3(so3.exp(np.array([0.0, 0.0, np.arctan2(sine, cosine)])), np.zeros(3))
    lead = start.world_from_cam
    return replace(start, world_from_cam=replace(lead, world_from_body=turn * lead.world_from_body))
