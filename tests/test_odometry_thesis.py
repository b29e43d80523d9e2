"""The frame-to-frame baseline: exact without noise, and worse than the adjusted odometry with it."""

import numpy as np
import pytest

from odometry_worlds import circling, fisheye, tracks_of
from rigwake.errors import EstimationError, UsageError
from rigwake.evaluation.trajectory_errors import absolute_error
from rigwake.odometry.thesis_odometry import ThesisOptions, estimate_thesis
from rigwake.trajectory import Trajectory


def test_exact_tracks_give_the_path_with_its_relative_scale():
    world_from_cam = circling(60)
    tracks = tracks_of(world_from_cam, fisheye(), noise_px=1e-4)
    found = estimate_thesis(tracks, fisheye())
    error = absolute_error(Trajectory("front", tracks.timestamps_ns, world_from_cam), found, alignment="sim3")
    assert not found.is_metric
    assert error.rmse_m < 0.02
    assert error.rotation_rmse_deg < 0.05


def test_the_gyro_fraction_replaces_the_turn_of_the_camera():
    world_from_cam = circling(40)
    tracks = tracks_of(world_from_cam, fisheye(), noise_px=1.0)
    truth = Trajectory("front", tracks.timestamps_ns, world_from_cam)
    errors = [
        absolute_error(
            truth,
            estimate_thesis(
                tracks, fisheye(), ThesisOptions(gamma=gamma, gate_px=3.0), rotations=world_from_cam.rotation
            ),
            alignment="sim3",
        ).rotation_rmse_deg
        for gamma in (0.0, 1.0)
    ]
    assert errors[1] < errors[0]


def test_moving_average_is_centred():
    world_from_cam = circling(40)
    tracks = tracks_of(world_from_cam, fisheye(), noise_px=1e-4)
    plain, smooth = (
        estimate_thesis(tracks, fisheye(), ThesisOptions(smooth_frames=n)).world_from_body.translation
        for n in (1, 5)
    )
    np.testing.assert_allclose(smooth[10], plain[8:13].mean(axis=0))


def test_refuses_what_cannot_work():
    tracks = tracks_of(circling(10), fisheye(), points=5)
    with pytest.raises(EstimationError, match="enough tracks"):
        estimate_thesis(tracks, fisheye())
    with pytest.raises(UsageError, match="gamma"):
        ThesisOptions(gamma=1.5)
    with pytest.raises(UsageError, match="odd"):
        ThesisOptions(smooth_frames=4)
