"""Monocular odometry on synthetic fisheye tracks: recovery inside bounds, water, outages, what it refuses."""

from dataclasses import replace

import numpy as np
import pytest

from odometry_worlds import circling, fisheye, tracks_of
from rigwake.errors import EstimationError, UsageError
from rigwake.evaluation.trajectory_errors import absolute_error
from rigwake.geometry.se3 import SE3
from rigwake.odometry.monocular import estimate_monocular
from rigwake.odometry.odometry_options import OdometryOptions
from rigwake.tracks import Tracks
from rigwake.trajectory import Trajectory

FRAMES = 100


def truth(tracks: Tracks, world_from_cam: SE3) -> Trajectory:
    return Trajectory(tracks.camera, tracks.timestamps_ns, world_from_cam)


def without_frames(tracks: Tracks, first: int, last: int) -> Tracks:
    """No observations in first..last, and no track survives the gap."""
    kept = tracks.take((tracks.frame_indices < first) | (tracks.frame_indices > last))
    later = kept.frame_indices > last
    return replace(kept, track_ids=np.where(later, kept.track_ids + 10**9, kept.track_ids))


def test_recovers_the_path_up_to_scale_with_points_beyond_90_degrees():
    world_from_cam, camera = circling(FRAMES), fisheye()
    tracks = tracks_of(world_from_cam, camera)
    assert (tracks.bearings_cam[:, 2] < 0).any()
    result = estimate_monocular(tracks, camera)
    error = absolute_error(truth(tracks, world_from_cam), result.trajectory, alignment="sim3")
    assert len(result.trajectory) == FRAMES
    assert not result.trajectory.is_metric
    assert result.counts.segments == 1
    assert error.rmse_m < 0.01 * 12.5  # 1 % of the path
    assert error.rotation_rmse_deg < 0.3
    assert result.counts.inlier_rms_px == pytest.approx(0.2 * np.sqrt(2), rel=0.1)
    assert result.inliers.mean() > 0.85


@pytest.mark.slow
def test_wandering_tracks_are_not_inliers():
    world_from_cam, camera = circling(FRAMES), fisheye()
    tracks = tracks_of(world_from_cam, camera, wrong_fraction=0.4, points=600)
    result = estimate_monocular(tracks, camera)
    error = absolute_error(truth(tracks, world_from_cam), result.trajectory, alignment="sim3")
    assert len(result.trajectory) == FRAMES
    assert error.rmse_m < 0.02 * 12.5
    assert set(result.landmarks.track_ids) <= set(tracks.track_ids)


@pytest.mark.slow
def test_inliers_are_rows_of_the_tracks_as_given():
    world_from_cam, camera = circling(60), fisheye()
    tracks = tracks_of(world_from_cam, camera, wrong_fraction=0.2)
    shuffled = np.random.default_rng(1).permutation(len(tracks))
    plain = estimate_monocular(tracks, camera)
    mixed = estimate_monocular(tracks.take(shuffled), camera)
    np.testing.assert_array_equal(plain.inliers[shuffled], mixed.inliers)


def test_an_outage_makes_two_segments_each_right_in_itself():
    world_from_cam, camera = circling(FRAMES), fisheye()
    tracks = without_frames(tracks_of(world_from_cam, camera), 45, 55)
    result = estimate_monocular(tracks, camera)
    assert result.counts.segments == 2
    assert result.counts.empty == 11
    segments = result.trajectory.segment_ids
    assert segments is not None
    for segment in (0, 1):
        piece = result.trajectory.take(segments == segment)
        assert len(piece) >= 30
        error = absolute_error(truth(tracks, world_from_cam), piece, alignment="sim3")
        assert error.rmse_m < 0.1


def test_black_frames_do_not_break_the_path():
    world_from_cam, camera = circling(80), fisheye()
    tracks = tracks_of(world_from_cam, camera)
    tracks = tracks.take(~np.isin(tracks.frame_indices, [20, 21, 50]))
    result = estimate_monocular(tracks, camera)
    assert result.counts.segments == 1
    assert result.counts.placed == 77
    assert result.counts.empty == 3


def test_a_camera_that_only_turns_is_refused():
    turning = circling(40)
    turning = SE3(turning.rotation, np.zeros_like(turning.translation))
    tracks = tracks_of(turning, fisheye())
    with pytest.raises(EstimationError, match="different places"):
        estimate_monocular(tracks, fisheye())


def test_options_are_checked():
    with pytest.raises(UsageError, match="gate_px"):
        OdometryOptions(gate_px=0)
    with pytest.raises(UsageError, match="global_growth"):
        OdometryOptions(global_growth=1.0)
