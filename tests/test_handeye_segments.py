"""Trajectories in very many pieces: hand-eye ends, in bounded time, with what the longest pieces tell."""

import time
from dataclasses import replace

import numpy as np

from handeye_scenes import PORT, wavy
from rigwake.geometry.se3 import SE3
from rigwake.handeye.joint_calibration import calibrate_handeye
from rigwake.handeye.motions import longest_segments
from rigwake.trajectory import Trajectory


def in_pieces(count: int, poses: int, rng: np.random.Generator) -> Trajectory:
    """The port camera's path in pieces, each with an origin and a unit of its own."""
    t = np.arange(poses) * 0.1
    path, segments = wavy(t) * PORT, np.minimum(np.arange(poses) * count // poses, count - 1)
    first = np.searchsorted(segments, np.arange(count))
    own = path[first][segments].inverse() * path
    unit = np.exp(rng.normal(0, 0.5, count))[segments]
    own = SE3(own.rotation, own.translation / unit[:, None])
    noise = np.concatenate([rng.normal(0, 1e-4, (poses, 3)), rng.normal(0, 2e-3, (poses, 3))], axis=1)
    return Trajectory(
        "port", np.round(t * 1e9).astype(np.int64), own.retract(noise), is_metric=False, segment_ids=segments
    )


def test_455_segments_end() -> None:
    rng = np.random.default_rng(0)
    member = in_pieces(455, 4550, rng)
    reference = Trajectory("rig", member.timestamps_ns, wavy(np.arange(4550) * 0.1))
    started = time.process_time()
    found = calibrate_handeye(reference, [member])
    assert time.process_time() - started < 30  # was hours; mostly compilation where nothing is cached
    assert np.abs(PORT.local(found.ref_from_members["port"])).max() < 0.05
    assert found.members["port"].statistics["poses_left_out"] == 4550 - 600


def test_the_longest_segments_are_kept_whole() -> None:
    segments = np.repeat([0, 1, 2, 3], [5, 9, 3, 7])
    poses, stamps = SE3.identity((24,)), np.arange(24) * 10**8
    covariances = np.arange(1.0, 25)[:, None, None] * np.eye(6)
    whole = Trajectory("a", stamps, poses, covariances, "increments", segment_ids=segments)
    kept, left_out = longest_segments(whole, 2)
    assert left_out == 8
    assert kept.segment_ids is not None
    np.testing.assert_array_equal(kept.segment_ids, np.repeat([0, 1], [9, 7]))
    assert kept.covariances is not None
    np.testing.assert_array_equal(kept.covariances[:, 0, 0], np.r_[6:15, 18:25])
    same, none = longest_segments(replace(whole), 4)
    assert (len(same), none) == (24, 0)
