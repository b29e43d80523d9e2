"""What recordings suffer from: the path survives, and the notes name what was bridged."""

from dataclasses import replace

import numpy as np
import pytest

from odometry_worlds import circling, fisheye, tracks_of
from rigwake.evaluation.trajectory_errors import absolute_error
from rigwake.odometry.bridged import bridged
from rigwake.odometry.monocular import estimate_monocular
from rigwake.recording import GnssStream, ImuStream
from rigwake.tracks import TrackingReport, Tracks
from rigwake.trajectory import Trajectory

FRAMES = 120
PATH = circling(FRAMES)


@pytest.fixture(scope="module")
def standing():
    return tracks_of(PATH, fisheye())


def vessel_in(tracks: Tracks, first: int, last: int, points: int = 20) -> Tracks:
    """The same with a vessel that crosses the view, with its own tracks, between two frames."""
    camera, rng = fisheye(), np.random.default_rng(3)
    hull = rng.uniform([-3, -1, 0], [3, 1, 3], (points, 3))
    columns = [[], [], [], []]
    for frame in range(first, last):
        centre = PATH[frame] * np.array([0.5 * (frame - first) - 8, 0.0, 14.0])  # ahead of us, and sideways
        pixels, valid = camera.project(PATH[frame].inverse() * (centre + hull))
        pixels = pixels + rng.normal(0, 0.2, pixels.shape)
        bearings, on_lens = camera.unproject(pixels)
        kept = valid & on_lens
        for column, values in zip(
            columns, (np.full(points, frame), 10**8 + np.arange(points), pixels, bearings), strict=True
        ):
            column.append(values[kept])
    frame, ids, pixels, bearings = (np.concatenate(column) for column in columns)
    both = replace(
        tracks,
        frame_indices=np.concatenate([tracks.frame_indices, frame]),
        track_ids=np.concatenate([tracks.track_ids, ids]),
        pixels=np.concatenate([tracks.pixels, pixels]),
        bearings_cam=np.concatenate([tracks.bearings_cam, bearings]),
        std_px=np.concatenate([tracks.std_px, np.full(len(frame), 0.2)]),
    )
    return both.take(np.lexsort((both.track_ids, both.frame_indices)))


def error_of(result, tracks) -> float:
    truth = Trajectory("truth", tracks.timestamps_ns, PATH)
    return absolute_error(truth, result.trajectory, alignment="sim3").rmse_m


def test_nothing_is_named_where_nothing_was_missing(standing):
    assert bridged(standing, fisheye(), estimate_monocular(standing, fisheye())) == ()


def test_a_vessel_that_crosses_the_view_is_left_out_and_named(standing):
    tracks = vessel_in(standing, 40, 80)
    result = estimate_monocular(tracks, fisheye())
    assert len(result.trajectory) == FRAMES
    assert error_of(result, tracks) < 1.5 * error_of(estimate_monocular(standing, fisheye()), standing) + 0.01
    on_vessel = tracks.track_ids >= 10**8
    assert result.inliers[on_vessel].mean() < 0.05
    (note,) = bridged(tracks, fisheye(), result)
    assert "something that moves" in note
    start, end = (float(word) for word in note.split("between ")[1].split(" s:")[0].split(" and "))
    assert 3.9 < start < end < 8.1


def test_black_repeated_and_unreadable_frames_are_named(standing):
    gone = np.isin(standing.frame_indices, [30, 31, 60, 90])
    report = TrackingReport(FRAMES, FRAMES - 4, 2, 1, 1, 0, 0, 50.0)
    tracks = replace(standing.take(~gone), report=report)
    result = estimate_monocular(tracks, fisheye())
    assert result.counts.empty == 4
    assert result.counts.segments == 1
    assert error_of(result, tracks) < 0.05
    assert bridged(tracks, fisheye(), result) == (
        "2 black or empty frames bridged",
        "1 repeated frame bridged",
        "1 unreadable frame bridged",
    )


def test_gaps_of_every_sensor_are_named_with_length_and_time(standing):
    stamps = standing.timestamps_ns
    imu_ns = np.arange(stamps[0], stamps[-1], 10_000_000)
    imu_ns = imu_ns[(imu_ns < stamps[0] + 2_000_000_000) | (imu_ns > stamps[0] + 2_300_000_000)]
    zeros = np.zeros((len(imu_ns), 3))
    fixes_ns = np.arange(stamps[0], stamps[-1], 200_000_000)
    fixes_ns = fixes_ns[(fixes_ns < stamps[0] + 5_000_000_000) | (fixes_ns > stamps[0] + 7_000_000_000)]
    gnss = GnssStream(
        "gnss",
        fixes_ns,
        np.zeros((len(fixes_ns), 3)),
        np.tile(np.eye(3), (len(fixes_ns), 1, 1)),
        (0.0, 0.0, 0.0),
    )
    lines = bridged(standing, fisheye(), None, ImuStream("imu", imu_ns, zeros, zeros), gnss)
    assert lines == (
        "1 gap in the IMU samples bridged, the longest of 0.3 s at 2.0 s",
        "1 gap in the GNSS fixes bridged, the longest of 2.4 s at 4.8 s",
    )


def test_missing_images_are_a_gap(standing):
    kept = np.flatnonzero((np.arange(FRAMES) < 50) | (np.arange(FRAMES) >= 80))
    row = np.full(FRAMES, -1)
    row[kept] = np.arange(len(kept))
    tracks = standing.take(np.isin(standing.frame_indices, kept))
    tracks = replace(
        tracks, timestamps_ns=standing.timestamps_ns[kept], frame_indices=row[tracks.frame_indices]
    )
    assert bridged(tracks, fisheye()) == ("1 gap in the images bridged, the longest of 3.1 s at 4.9 s",)
