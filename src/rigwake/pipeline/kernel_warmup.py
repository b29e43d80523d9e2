"""Hand-eye's compiled loops, made beside the cameras' work when they are first used.

On a fresh machine they take most of a minute to compile. In the process that estimates the rig this would come after
the cameras, on one core; as one more job of the camera stage it costs no time of its own on several cores.
"""

from __future__ import annotations

import contextlib

import numpy as np

from rigwake._kernels import is_stored
from rigwake.errors import RigwakeError
from rigwake.geometry import so3
from rigwake.geometry.se3 import SE3
from rigwake.handeye.joint_calibration import calibrate_handeye
from rigwake.handeye.noise_kernels import learnt_covariances
from rigwake.trajectory import Trajectory


def handeye_is_compiled() -> bool:
    """Whether an earlier run has left the compiled loops of hand-eye on disk."""
    return is_stored(learnt_covariances)


def compile_handeye() -> None:
    """Solve a small hand-eye problem of two bodies, one of them up to scale, so that its loops are on disk."""
    times_s = np.arange(0.0, 30.0, 0.2)
    turn = np.stack(
        [0.2 * np.sin(1.3 * times_s), 0.2 * np.sin(0.9 * times_s), np.sin(0.25 * times_s)], axis=1
    )
    way = np.stack([2.0 * times_s, 3.0 * np.sin(0.4 * times_s), 0.3 * np.sin(times_s)], axis=1)
    world_from_ref = SE3(so3.exp(turn), way)
    noise = np.random.default_rng(0).normal(scale=1e-3, size=(len(times_s), 6))
    world_from_member = (world_from_ref * SE3(so3.exp([0.0, 0.3, 1.0]), np.array([0.5, 1.0, 0.2]))).retract(
        noise
    )
    stamps = (times_s * 1e9).astype(np.int64)
    reference = Trajectory("reference", stamps, world_from_ref)
    member = Trajectory("member", stamps, world_from_member, is_metric=False)
    with contextlib.suppress(RigwakeError):  # the answer does not matter
        calibrate_handeye(reference, [member])
