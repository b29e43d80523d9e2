"""Front ends on rendered images with exact truth, and what can go wrong with a recording."""

from dataclasses import replace

import numpy as np
import pytest

from rigwake.errors import InputError, UsageError
from rigwake.recording import CameraStream
from rigwake.tracking.front_ends import track_camera
from rigwake.tracking.tracking_options import TrackingOptions
from rigwake.tracks import Tracks, load_tracks
from tracking_scene import CylinderScene, turning_scene, wall_points


def errors_px(scene: CylinderScene, tracks: Tracks) -> tuple[np.ndarray, np.ndarray]:
    """Observed minus projected truth (M, 2), the point being what the first pixel of a track saw; first rows."""
    _, first, inverse = np.unique(tracks.track_ids, return_index=True, return_inverse=True)
    points = np.empty((len(first), 3))
    for k, row in enumerate(first):
        pose = scene.world_from_cam[int(tracks.frame_indices[row])]
        points[k] = wall_points(pose, tracks.bearings_cam[row : row + 1])[0]
    poses = scene.world_from_cam[tracks.frame_indices]
    local = np.einsum("nji,nj->ni", poses.rotation, points[inverse] - poses.translation)
    pixels, valid = scene.model.project(local)
    pixels[~valid] = np.inf
    later = np.ones(len(tracks), dtype=bool)
    later[first] = False
    return tracks.pixels - pixels, later


@pytest.fixture(scope="module")
def hard_scene() -> CylinderScene:
    """Turning and approaching through strong vignetting, with an exposure jump."""
    gains = np.where(np.arange(20) < 12, 1.0, 0.75)
    return turning_scene(20, gains=gains, vignetting=0.4)


@pytest.fixture(scope="module")
def hard_stream(hard_scene: CylinderScene) -> CameraStream:
    return hard_scene.stream()


@pytest.fixture(scope="module")
def hard_tracks(hard_stream: CameraStream) -> Tracks:
    return track_camera(hard_stream, TrackingOptions(max_features=150))


def test_klt_lands_on_projected_truth_through_vignetting_and_exposure(hard_scene, hard_tracks):
    error, later = errors_px(hard_scene, hard_tracks)
    error = error[later]
    assert later.sum() > 20 * 60
    inliers = np.linalg.norm(error, axis=1) < 1.0
    assert inliers.mean() > 0.99
    assert np.sqrt((error[inliers] ** 2).mean()) < 0.1
    angle = np.rad2deg(np.arccos(hard_tracks.bearings_cam[later, 2]))
    for low, high in ((0, 40), (40, 65), (65, 92)):
        zone = inliers & (angle >= low) & (angle < high)
        assert zone.sum() > 100
        assert np.linalg.norm(error[zone].mean(axis=0)) < 0.008


def test_predicted_deviations_are_honest(hard_scene, hard_tracks):
    error, later = errors_px(hard_scene, hard_tracks)
    score = (error[later] ** 2).sum(axis=1) / 2 / hard_tracks.std_px[later] ** 2
    assert 0.5 < np.median(score) / np.log(2) < 2.0  # the median of a chi-square of two, halved, is ln 2


def test_tracks_survive_for_long(hard_tracks):
    lengths = np.bincount(hard_tracks.track_ids)
    assert (lengths >= 16).sum() > 20


def test_same_input_same_tracks(hard_stream, hard_tracks):
    again = track_camera(hard_stream, TrackingOptions(max_features=150))
    np.testing.assert_array_equal(again.track_ids, hard_tracks.track_ids)
    np.testing.assert_array_equal(again.pixels, hard_tracks.pixels)


def test_order_and_uniqueness_of_observations(hard_tracks):
    key = hard_tracks.frame_indices * (hard_tracks.track_ids.max() + 1) + hard_tracks.track_ids
    assert (np.diff(key) > 0).all()


def test_black_and_repeated_frames_are_bridged_and_reported():
    scene = turning_scene(12, black=(4,), repeated=(7,))
    tracks = track_camera(scene.stream(), TrackingOptions(max_features=80))
    report = tracks.report
    assert report is not None
    assert (report.frames, report.frames_used, report.frames_black, report.frames_repeated) == (12, 10, 1, 1)
    assert not np.isin(tracks.frame_indices, [4, 7]).any()
    before, after = (set(tracks.track_ids[tracks.frame_indices == row]) for row in (3, 5))
    assert len(before & after) > 0.6 * len(before)
    error, later = errors_px(scene, tracks)
    assert np.median(np.linalg.norm(error[later], axis=1)) < 0.1


def test_nothing_is_followed_across_a_long_gap():
    scene = turning_scene(6)
    options = TrackingOptions(max_features=60, max_gap_s=0.15)
    chosen = np.array([0, 1, 2, 4, 5])
    tracks = track_camera(scene.stream(), options, indices=chosen)
    np.testing.assert_array_equal(tracks.timestamps_ns, chosen * 100_000_000)
    early = set(tracks.track_ids[tracks.frame_indices <= 2])
    late = set(tracks.track_ids[tracks.frame_indices >= 3])
    assert early
    assert late
    assert not early & late


@pytest.mark.parametrize(
    ("front_end", "matcher", "limit_px"),
    [
        ("sift", "brute-force", 0.6),
        ("sift", "flann", 0.6),
        ("orb", "brute-force", 1.5),
        ("orb", "flann", 1.5),
        ("fast-brief", "brute-force", 1.5),
        ("fast-brief", "flann", 1.5),
    ],
)
def test_descriptor_front_ends_follow_points(front_end, matcher, limit_px):
    scene = turning_scene(5)
    options = TrackingOptions(
        front_end=front_end,
        matcher=matcher,
        max_features=200,
        max_displacement_px=20,
        min_displacement_px=0.1,
    )
    tracks = track_camera(scene.stream(), options)
    error, later = errors_px(scene, tracks)
    assert later.sum() > 150
    assert np.median(np.linalg.norm(error[later], axis=1)) < limit_px
    key = tracks.frame_indices * (tracks.track_ids.max() + 1) + tracks.track_ids
    assert (np.diff(key) > 0).all()


def test_displacement_gates_and_region_of_interest():
    scene = turning_scene(4)
    options = TrackingOptions(front_end="orb", max_features=200, max_displacement_px=1e-3)
    assert len(track_camera(scene.stream(), options)) < 5
    options = TrackingOptions(max_features=100, region_of_interest=(100, 60, 80, 90))
    pixels = track_camera(scene.stream(), options).pixels
    assert len(pixels) > 30
    assert (pixels >= [99, 59]).all()
    assert (pixels <= [180, 150]).all()


def test_few_points_are_taken_high_above_the_horizon(hard_scene, hard_stream, hard_tracks):
    up_cam = np.tile([0.0, -1.0, 0.0], (len(hard_stream), 1))
    tracks = track_camera(hard_stream, TrackingOptions(max_high_fraction=0.05), up_cam=up_cam)
    first = np.unique(tracks.track_ids, return_index=True)[1]
    high = -tracks.bearings_cam[:, 1] > np.sin(np.deg2rad(16.0))
    freely = -hard_tracks.bearings_cam[:, 1] > np.sin(np.deg2rad(16.0))
    assert freely[hard_tracks.frame_indices == 0].sum() > 40
    in_first_frame = tracks.frame_indices[first] == 0
    assert 0 < high[first][in_first_frame].sum() <= 20
    assert (~high[first][in_first_frame]).sum() > 80


def test_options_that_do_not_exist_are_refused():
    with pytest.raises(UsageError, match="klt, sift, fast-brief, orb"):
        TrackingOptions(front_end="surf")  # type: ignore[arg-type]
    with pytest.raises(UsageError, match="max_features"):
        TrackingOptions(max_features=0)


def test_a_camera_without_intrinsics_is_refused():
    stream = replace(turning_scene(2).stream(), model=None)
    with pytest.raises(UsageError, match="no intrinsics"):
        track_camera(stream)


def test_tracks_round_trip(tmp_path, hard_tracks):
    path = tmp_path / "tracks" / "front.npz"
    hard_tracks.save(path)
    loaded = load_tracks(path)
    assert loaded.camera == hard_tracks.camera
    assert loaded.report == hard_tracks.report
    for name in ("timestamps_ns", "frame_indices", "track_ids", "pixels", "bearings_cam", "std_px"):
        np.testing.assert_array_equal(getattr(loaded, name), getattr(hard_tracks, name))


def test_files_that_are_not_tracks_are_refused(tmp_path, hard_tracks):
    text, cut, other = (tmp_path / name for name in ("text.npz", "cut.npz", "other.npz"))
    text.write_text("no tracks")
    hard_tracks.save(cut)
    cut.write_bytes(cut.read_bytes()[:500])
    np.savez(other, camera=np.array(["a", None], dtype=object))
    for path in (text, cut, other, tmp_path / "missing.npz"):
        with pytest.raises(InputError, match="holds no tracks"):
            load_tracks(path)
