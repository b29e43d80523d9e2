"""Tracking in stretches: the same points as in one go, followed across the cuts, no evidence twice."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from itertools import pairwise

import numpy as np
import pytest

from rigwake.recording import CameraStream
from rigwake.tracking.front_ends import track_camera
from rigwake.tracking.stretches import OVERLAP_S, StretchJob, stretch_rows, track_in_stretches
from rigwake.tracking.tracking_options import TrackingOptions
from rigwake.tracks import Tracks
from tracking_scene import turning_scene

OPTIONS = TrackingOptions(max_features=60)


@pytest.fixture(scope="module")
def stream() -> CameraStream:
    """Fourteen seconds at 3 Hz."""
    scene = turning_scene(42)
    images = scene.stream()
    return CameraStream(
        "front", np.arange(42) * 333_000_000, images.source, images.width_px, images.height_px, scene.model
    )


@pytest.fixture(scope="module")
def joined(stream: CameraStream) -> Tracks:
    return track_in_stretches(stream, OPTIONS, stretch_s=7.0)


@pytest.mark.parametrize("seconds", [0.0, 3.0, 29.0, 31.0, 100.0, 1000.0])
@pytest.mark.parametrize("rate_hz", [2.0, 9.7])
def test_stretches_cover_every_frame_and_overlap(seconds: float, rate_hz: float) -> None:
    stamps = (np.arange(int(seconds * rate_hz) + 1) / rate_hz * 1e9).astype(np.int64) + 17
    parts = stretch_rows(stamps, 20.0)
    np.testing.assert_array_equal(np.unique(np.concatenate(parts)), np.arange(len(stamps)))
    for before, after in pairwise(parts):
        shared = np.intersect1d(before, after)
        length = (stamps[shared[-1]] - stamps[shared[0]]) * 1e-9
        assert OVERLAP_S - 2 / rate_hz <= length <= OVERLAP_S
    assert len(parts) == max(round(seconds / 20.0), 1)


def test_one_stretch_is_tracking_in_one_go(stream: CameraStream) -> None:
    whole = track_camera(stream, OPTIONS)
    one = track_in_stretches(stream, OPTIONS, stretch_s=1000.0)
    for key in ("frame_indices", "track_ids", "pixels", "bearings_cam", "std_px", "timestamps_ns"):
        np.testing.assert_array_equal(getattr(one, key), getattr(whole, key))


def test_points_are_followed_across_the_cut_and_counted_once(stream: CameraStream, joined: Tracks) -> None:
    cut = int(np.searchsorted(stream.timestamps_ns, 7e9))
    for frame in range(cut - 4, cut + 4):
        here, there = (set(joined.track_ids[joined.frame_indices == k].tolist()) for k in (frame, frame + 1))
        assert len(here & there) > 20
        pixels = joined.pixels[joined.frame_indices == frame]
        apart = np.linalg.norm(pixels[:, None] - pixels[None], axis=2) + 1e3 * np.eye(len(pixels))
        assert apart.min() > 1.0
    whole = track_camera(stream, OPTIONS)
    assert len(joined) > 0.9 * len(whole)
    assert len(joined) < 1.25 * len(whole)  # both stretches seek points of their own in the overlap
    assert (np.bincount(joined.track_ids)[np.unique(joined.track_ids)] >= 2).all()
    order = np.lexsort((joined.track_ids, joined.frame_indices))
    np.testing.assert_array_equal(order, np.arange(len(joined)))
    pairs = np.stack([joined.frame_indices, joined.track_ids])
    assert len(np.unique(pairs, axis=1).T) == len(joined)
    assert joined.report is not None
    assert (joined.report.frames, joined.report.frames_used) == (42, 42)
    assert joined.report.observations == len(joined)


def test_where_it_is_done_changes_nothing(stream: CameraStream, joined: Tracks) -> None:
    def elsewhere(work: Callable[[StretchJob], Tracks], jobs: Sequence[StretchJob]) -> list[Tracks]:
        with ThreadPoolExecutor(2) as pool:
            return list(pool.map(work, jobs))

    done: list[int] = []
    again = track_in_stretches(stream, OPTIONS, stretch_s=7.0, map_stretches=elsewhere, progress=done.append)
    for key in ("frame_indices", "track_ids", "pixels", "std_px"):
        np.testing.assert_array_equal(getattr(again, key), getattr(joined, key))
    assert done == [22, 42]


def test_a_track_is_looked_up_in_another_frame(joined: Tracks) -> None:
    rows = np.flatnonzero(joined.frame_indices % 5 == 0)
    kept, later = joined.same_tracks(rows, joined.frame_indices[rows] + 3)
    np.testing.assert_array_equal(joined.track_ids[kept], joined.track_ids[later])
    np.testing.assert_array_equal(joined.frame_indices[kept] + 3, joined.frame_indices[later])
    known = set(zip(joined.frame_indices.tolist(), joined.track_ids.tolist(), strict=True))
    wanted = zip((joined.frame_indices[rows] + 3).tolist(), joined.track_ids[rows].tolist(), strict=True)
    assert 0 < len(kept) == sum(pair in known for pair in wanted) < len(rows)
    assert not len(joined.take([]).same_tracks(rows[:0], rows[:0])[0])
