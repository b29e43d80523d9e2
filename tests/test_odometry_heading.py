"""Attitude beside an IMU, without satellites: the path is turned to the east and kept there."""

from dataclasses import replace

import numpy as np
import pytest

from odometry_worlds import RIG_FROM_CAM, TIME_OFFSET_S, fisheye, rig_path, sensors_of, tracks_of
from rigwake.errors import UnobservableError
from rigwake.geometry import so3
from rigwake.odometry.heading import headed
from rigwake.odometry.metric import metric_start
from rigwake.odometry.monocular import estimate_monocular
from rigwake.odometry.smoother import smooth
from rigwake.recording import AttitudeStream

NOISE = np.deg2rad(1.0)


@pytest.fixture(scope="module")
def seen():
    """Tracks, lens, visual odometry, IMU and initial values in a level world of arbitrary heading."""
    truth, imu = rig_path(), sensors_of()[0]
    tracks = tracks_of(truth.world_from_body * RIG_FROM_CAM, fisheye())
    tracks = replace(tracks, timestamps_ns=truth.timestamps_ns - round(TIME_OFFSET_S * 1e9))
    visual = estimate_monocular(tracks, fisheye())
    return tracks, visual, imu, metric_start(visual.trajectory, imu, None)


def compass(heading_only: bool) -> AttitudeStream:
    """Noisy attitude at 5 Hz; a compass knows roll and pitch to nothing."""
    truth = rig_path()
    rng = np.random.default_rng(2)
    body = truth.world_from_body.rotation[::2]
    up_body = body[:, 2, :]
    error = up_body * rng.normal(0, NOISE, (len(body), 1))
    tilt = np.full(len(body), (10.0 if heading_only else NOISE) ** 2)
    along = np.einsum("ni,nj->nij", up_body, up_body)
    covariances = along * NOISE**2 + (np.eye(3) - along) * tilt[:, None, None]
    return AttitudeStream("compass", truth.timestamps_ns[::2], body @ so3.exp(error), covariances)


def heading_errors_deg(trajectory) -> np.ndarray:
    """About the vertical, of the rig's rotations in the world of the truth."""
    truth = rig_path()
    stamps = trajectory.timestamps_ns + round(TIME_OFFSET_S * 1e9)
    index = np.abs(truth.timestamps_ns[None] - stamps[:, None]).argmin(axis=1)
    found = trajectory.world_from_body.rotation @ RIG_FROM_CAM.rotation.T
    error = found @ np.swapaxes(truth.world_from_body.rotation[index], 1, 2)
    return np.rad2deg(np.arctan2(error[:, 1, 0] - error[:, 0, 1], error[:, 0, 0] + error[:, 1, 1]))


@pytest.mark.parametrize("heading_only", [True, False])
def test_the_path_is_turned_to_the_east_and_kept_there(seen, heading_only):
    tracks, visual, imu, start = seen
    assert np.abs(heading_errors_deg(start.world_from_cam)).min() > 3.0  # by chance it would be right
    found = smooth(tracks, fisheye(), visual, start, imu, None, compass(heading_only))
    assert np.abs(heading_errors_deg(found.trajectory)).max() < 0.6


def test_without_attitude_the_heading_stays_arbitrary(seen):
    tracks, visual, imu, start = seen
    found = smooth(tracks, fisheye(), visual, start, imu)
    assert np.abs(heading_errors_deg(found.trajectory)).min() > 3.0


def test_an_attitude_of_another_time_is_refused(seen):
    late = compass(False)
    late = replace(late, timestamps_ns=late.timestamps_ns + 10**12)
    with pytest.raises(UnobservableError, match="compass"):
        headed(seen[3], late)
