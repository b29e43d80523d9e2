"""Loop closure: joined tracks, and an outage that place recognition bridges on real pictures."""

from dataclasses import replace

import numpy as np
import pytest

from odometry_worlds import circling, fisheye, tracks_of
from rigwake.evaluation.trajectory_errors import absolute_error
from rigwake.odometry.loop_closure import LoopOptions, closed_path, find_loops, joined_tracks
from rigwake.odometry.monocular import estimate_monocular, readjust
from rigwake.odometry.result import OdometryResult
from rigwake.recording import CameraStream, Frame
from rigwake.tracks import Tracks
from rigwake.trajectory import Trajectory

FRAMES = 60


class StampedDots:
    """Draws at each observation a pattern that belongs to its point, on grey."""

    def __init__(self, tracks: Tracks, names: np.ndarray) -> None:
        self.tracks, self.names = tracks, names

    def frames(self, indices, *, colour=False):
        for index in indices:
            image = np.full((480, 640), 128, np.uint8)
            rows = np.flatnonzero(self.tracks.frame_indices == index)
            for (x, y), name in zip(self.tracks.pixels[rows], self.names[rows], strict=True):
                c, r = round(float(x)), round(float(y))
                if 12 <= c < 628 and 12 <= r < 468:
                    patch = np.random.default_rng(int(name)).integers(0, 255, (6, 6)).astype(np.uint8)
                    image[r - 12 : r + 12, c - 12 : c + 12] = np.kron(patch, np.ones((4, 4), np.uint8))
            yield Frame(int(index), int(self.tracks.timestamps_ns[index]), image)


def broken_tracks() -> tuple[Tracks, np.ndarray]:
    """A slow path whose tracks all break in the middle, with the points' true names."""
    tracks = tracks_of(circling(FRAMES, seconds_per_turn=80.0), fisheye(), points=130, longest=1000)
    broken = replace(tracks, track_ids=tracks.track_ids + np.where(tracks.frame_indices > 30, 10**8, 0))
    kept = ~np.isin(tracks.frame_indices, [29, 30])
    return broken.take(kept), tracks.track_ids[kept]


@pytest.fixture(scope="module")
def broken() -> tuple[CameraStream, Tracks, np.ndarray, OdometryResult]:
    tracks, names = broken_tracks()
    stream = CameraStream("front", tracks.timestamps_ns, StampedDots(tracks, names), 640, 480, fisheye())
    return stream, tracks, names, estimate_monocular(tracks, fisheye())


@pytest.mark.slow
def test_an_outage_is_bridged_by_recognising_the_place(broken):
    stream, tracks, names, before = broken
    camera = fisheye()
    assert before.counts.segments == 2
    loops = find_loops(stream, tracks, camera, before, LoopOptions(min_gap_s=0.5, words=32))
    assert len(loops.frames)
    name_of = dict(zip(tracks.track_ids.tolist(), names.tolist(), strict=True))
    right = np.array([name_of[a] == name_of[b] for a, b in loops.track_ids.tolist()])
    assert right.mean() > 0.95
    after = estimate_monocular(joined_tracks(tracks, loops.track_ids), camera)
    assert after.counts.segments == 1
    assert after.counts.placed == before.counts.placed


@pytest.mark.slow
def test_a_loop_joins_segments_of_different_units_and_takes_their_drift_away():
    path = circling(160, seconds_per_turn=13.0)  # a turn and a quarter; tracks live for a second and a half
    tracks = tracks_of(path, fisheye(), points=200, longest=15, noise_px=0.5)
    drawn = StampedDots(tracks, tracks.track_ids // 10_000)
    stream = CameraStream("front", tracks.timestamps_ns, drawn, 640, 480, fisheye())
    before = estimate_monocular(tracks, fisheye())
    loops = find_loops(stream, tracks, fisheye(), before, LoopOptions(min_gap_s=9.0, words=32))
    frames, closed = closed_path(before, loops)
    np.testing.assert_array_equal(frames, before.frame_indices)
    after = readjust(joined_tracks(tracks, loops.track_ids), fisheye(), frames, closed)

    def error(found: Trajectory) -> float:
        truth = Trajectory("truth", tracks.timestamps_ns, path)
        return absolute_error(truth, found, alignment="sim3").rmse_m

    by_graph = error(replace(before.trajectory, world_from_body=closed, covariances=None))
    assert by_graph < 0.05 * error(before.trajectory)
    assert error(after.trajectory) < by_graph
    assert after.counts.segments == 1
    assert len(after.trajectory) >= len(frames)


def test_joined_tracks_keep_one_observation_per_frame():
    tracks = tracks_of(circling(5), fisheye(), points=40)
    ids = np.unique(tracks.track_ids)[:3]
    joined = joined_tracks(tracks, np.array([[ids[0], ids[1]], [ids[1], ids[2]]]))
    assert ids[0] in joined.track_ids
    assert not np.isin(ids[1:], joined.track_ids).any()
    pairs = np.stack([joined.frame_indices, joined.track_ids], axis=1)
    assert len(np.unique(pairs, axis=0)) == len(pairs)
    others = ~np.isin(tracks.track_ids, ids)
    assert np.isin(tracks.track_ids[others], joined.track_ids).all()


def test_without_repeated_places_there_are_no_loops(broken):
    stream, tracks, _, visual = broken
    loops = find_loops(stream, tracks, fisheye(), visual, LoopOptions(min_gap_s=3600.0, words=32))
    assert loops.frames.shape == (0, 2)
    np.testing.assert_array_equal(joined_tracks(tracks, loops.track_ids).track_ids, tracks.track_ids)


@pytest.mark.parametrize("count", [0, 5])
def test_too_few_descriptors_are_no_loops(broken, count):
    stream, tracks, _, visual = broken
    rows = np.flatnonzero(visual.inliers)[count:]
    inliers = visual.inliers.copy()
    inliers[rows] = False
    assert len(find_loops(stream, tracks, fisheye(), replace(visual, inliers=inliers)).frames) == 0
