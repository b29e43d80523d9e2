"""Stixels and ranges: exactness of the cut, ranges against a known world, honesty of their uncertainty."""

from dataclasses import replace
from itertools import product

import cv2
import numpy as np
import pytest

from rigwake.errors import UsageError
from rigwake.geometry.se3 import SE3
from rigwake.trajectory import Trajectory
from rigwake.views.attitude import LevelAttitude, track_from_trajectory
from rigwake.views.depth import height_check
from rigwake.views.depth.depth_files import point_cloud
from rigwake.views.depth.depth_panorama import MATCHED, PLANE, fuse_depth, matched_points
from rigwake.views.depth.epipolar import MatchedPoints, _semi_global, epipolar_pairs
from rigwake.views.depth.motion import Earlier, earlier_time, moved_points
from rigwake.views.depth.persistence import EarlierLooks, earlier_looks
from rigwake.views.depth.sgm import match_around
from rigwake.views.depth.sweep import SWEEP_GRID, _without_speckles, swept_points
from rigwake.views.scene.colour_method import ColourClassifier
from rigwake.views.scene.segmentation import Labels
from rigwake.views.scene.stixel_cut import cut_columns
from rigwake.views.scene.stixel_files import world_to_dict
from rigwake.views.scene.stixel_source import StixelEstimator, contact_shifts
from rigwake.views.scene.stixel_world import find_stixels
from rigwake.views.strips import StripGrid, level_strip
from rigwake.views.surface import WaterAndShell
from view_scenes import HEIGHT_M, attitude, four_cameras, photograph, water_and_ring

RADIUS_M = 12.0
GRID = StripGrid()


def ring_labels(sure: float = 0.95) -> Labels:
    """What the ring world shows from the viewpoint: water, a wall of 4 m height, sky."""
    slope = np.tan(GRID.elevations())
    height = HEIGHT_M + RADIUS_M * slope
    row = np.where(height < 0, 0, np.where(height < 4.0, 1, 2))
    classes = np.repeat(row[:, None], GRID.columns, axis=1).astype(np.uint8)
    probability = np.full((3, *classes.shape), (1 - sure) / 2, np.float32)
    for c in range(3):
        probability[c][classes == c] = sure
    return Labels(classes, probability)


@pytest.fixture(scope="module")
def seen():  # type: ignore[no-untyped-def]
    rig, stand = four_cameras(), attitude(2.0, -1.0)
    images = photograph(rig, stand, water_and_ring(RADIUS_M, is_mottled=True))
    return rig, stand, images, matched_points(images, rig, stand)


def cheapest_by_trying_all(cost: np.ndarray, horizon: int) -> float:
    """The same cost model on a column of a few rows, over every cut there is."""
    rows = cost.shape[1]
    best = np.inf
    for cuts in product((False, True), repeat=rows - 1):
        edges = [0, *[k + 1 for k in range(rows - 1) if cuts[k]], rows]  # from the top
        pieces = [(edges[k], edges[k + 1]) for k in range(len(edges) - 1)][::-1]  # from the bottom
        for kinds in product(range(3), repeat=len(pieces)):
            total, allowed, below = 0.0, True, -1
            for (top, bottom), kind in zip(pieces, kinds, strict=True):
                total += 5.0 + cost[kind, top:bottom].sum()
                if kind == 0:
                    allowed &= top >= horizon - 2 and below in (-1, 1)
                    total += 3.0 if below == 1 else 0.0
                elif kind == 2:
                    allowed &= bottom <= horizon + 2 and below in (-1, 0, 1)
                elif below == 2:
                    total += 6.0
                below = kind
            if allowed:
                best = min(best, total)
    return best


def plain_sgm(cost: np.ndarray, p1: float, p2: float) -> np.ndarray:
    """Sums of the four paths, as the method is written down; along the rows ten times around."""
    rows, columns, _ = cost.shape

    def step(here: np.ndarray, before: np.ndarray) -> np.ndarray:
        least = before.min()
        up = np.append(before[1:], np.inf) + p1
        down = np.append(np.inf, before[:-1]) + p1
        return here + np.minimum.reduce([before, up, down, np.full_like(before, least + p2)]) - least

    total = np.zeros(cost.shape)
    for order in (1, -1):
        for r in range(rows):
            path = np.zeros(cost.shape[2])
            laps = [c for _ in range(10) for c in range(columns)[::order]]
            for n, c in enumerate(laps):
                path = step(cost[r, c], path)
                total[r, c] += path if n >= 9 * columns else 0
        for c in range(columns):
            path = np.zeros(cost.shape[2])
            for r in range(rows)[::order]:
                path = step(cost[r, c], path)
                total[r, c] += path
    return total


def test_matching_around_is_that_of_the_textbook_and_has_no_edge() -> None:
    cost = np.random.default_rng(3).integers(0, 90, (5, 12, 7), dtype=np.uint8)
    level, ratio = match_around(cost)
    sums = plain_sgm(cost.astype(float), 12.0, 60.0)
    best = sums.argmin(axis=2)
    assert (np.abs(level - best) <= 0.5).all()
    apart = np.abs(np.arange(7) - best[..., None]) > 1
    second = np.where(apart, sums, np.inf).min(axis=2)
    np.testing.assert_allclose(ratio, second / sums.min(axis=2), rtol=1e-5)
    turned = match_around(np.roll(cost, 3, axis=1))
    np.testing.assert_array_equal(turned[0], np.roll(level, 3, axis=1))


def test_a_sweep_of_spheres_finds_the_ring_wherever_it_is_cut_open(seen) -> None:  # type: ignore[no-untyped-def]
    rig, stand, images, _ = seen
    quarter = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])  # ahead becomes port
    turned = replace(stand, level_from_rig=quarter @ stand.level_from_rig)
    found = [swept_points(images, rig, which).points_level for which in (stand, turned)]
    planes = []
    for points, shift in zip(found, (0, SWEEP_GRID.columns // 4), strict=True):
        distance = np.linalg.norm(points, axis=1)
        at = np.round(SWEEP_GRID.pixels(points / distance[:, None])).astype(int)
        plane = np.full((SWEEP_GRID.rows, SWEEP_GRID.columns), np.nan)
        plane[at[:, 1], (at[:, 0] + shift) % SWEEP_GRID.columns] = distance
        planes.append(plane)
        wall = (points[:, 2] > -1.5) & (points[:, 2] < 1.5)
        behind = wall & (np.abs(np.arctan2(points[:, 1], points[:, 0])) > np.deg2rad(170))
        for chosen in (wall, behind):
            error = np.hypot(points[chosen, 0], points[chosen, 1]) / RADIUS_M - 1
            assert len(error) > 700
            assert np.median(np.abs(error)) < 0.04  # a step of the sweep is 6 % there
    both = np.isfinite(planes).all(axis=0)
    assert both.sum() > 0.97 * np.isfinite(planes[0]).sum()
    assert np.mean(np.abs(planes[0] / planes[1] - 1)[both] < 0.01) > 0.97


def test_a_sweep_has_no_range_where_no_two_cameras_see(seen) -> None:  # type: ignore[no-untyped-def]
    rig, stand, images, _ = seen
    masks = {name: np.zeros(image.shape[:2], bool) for name, image in images.items()}
    for mask in masks.values():
        mask[mask.shape[0] // 2 :] = True
    swept = swept_points(images, rig, stand, masks)
    free = swept_points(images, rig, stand)
    assert len(swept.points_level) > 0.2 * len(free.points_level)
    for points in (swept.points_level, swept.tried_level):
        views = np.zeros(len(points), int)
        for name, model, cam in zip(
            rig.names, rig.models, rig.cam_from_level(stand.level_from_rig), strict=True
        ):
            pixels, valid = model.project(cam * points)
            column, row = np.round(np.nan_to_num(pixels, nan=-9.0)).astype(int).T
            inside = valid & (column >= 0) & (row >= 0) & (column < model.width_px) & (row < model.height_px)
            inside[inside] = ~masks[name][row[inside], column[inside]]
            views += inside
        assert np.mean(views < 2) < 0.02 + 0.98 * (points is swept.tried_level)
    assert len(swept.tried_level) < 0.6 * len(free.tried_level)


def test_a_small_thing_dead_astern_is_kept_like_any_other() -> None:
    levels = np.full((20, 96), -16, np.int16)
    for middle in (0, 48):
        levels[5:10, np.arange(middle - 5, middle + 5) % 96] = 320
    levels[15, 20:24] = 320  # too small
    kept = _without_speckles(levels) > 0
    assert kept.sum() == 100
    np.testing.assert_array_equal(kept, np.roll(kept, 48, axis=1))


def test_nothing_matched_is_no_range(seen) -> None:  # type: ignore[no-untyped-def]
    rig, stand, images, _ = seen
    dark = {name: np.zeros_like(image) for name, image in images.items()}
    for matched in (matched_points(dark, rig, stand), matched_points(dark, rig, stand, sweeps=True)):
        depth = fuse_depth(matched, ring_labels(), GRID, stand)
        assert not (depth.source == MATCHED).any()


def test_an_earlier_picture_from_below_the_water_says_nothing(seen) -> None:  # type: ignore[no-untyped-def]
    rig, stand, images, _ = seen
    sunk = Earlier(images, SE3(np.eye(3), np.array([0.0, 0.0, -5.0])))
    assert earlier_looks(sunk, rig, stand, WaterAndShell(), GRID, ColourClassifier()) is None


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(4))
def test_the_cut_is_the_cheapest_of_all(seed: int) -> None:
    rng = np.random.default_rng(seed)
    rows, horizon = 7, 3
    cost = rng.gamma(1.0, 6.0, (1, 3, rows))
    none, far = np.zeros((1, rows)), np.ones((1, rows + 1))
    count, cut = cut_columns(cost, none, none, far, far, np.array([rows]), np.array([0]), horizon)
    pieces = cut[0, : count[0]]
    total, below = 0.0, -1
    for bottom, top, kind in pieces[:, :3].astype(int):
        total += 5.0 + cost[0, kind, top:bottom].sum()
        total += 3.0 if (kind, below) == (0, 1) else 6.0 if (kind, below) == (1, 2) else 0.0
        below = kind
    assert pieces[0, 0] == rows
    assert pieces[-1, 1] == 0
    assert total == pytest.approx(cheapest_by_trying_all(cost[0], horizon))


def test_a_wall_in_the_water_has_its_distance() -> None:
    world = find_stixels(ring_labels(), GRID, attitude())
    wall = world.kind == 1
    distance, std = world.range_m()
    assert wall.sum() == GRID.columns
    assert world.stands[wall].all()
    assert np.abs(distance[wall] / RADIUS_M - 1).max() < 0.04  # half a row of 0.4 deg is 2.2 % here
    assert (std[wall] > 0).all()
    assert (np.abs(distance[wall] - RADIUS_M) < 3 * std[wall]).all()
    assert np.allclose(world.free_range_m(), distance[wall])
    surface = world.surface()
    ahead = np.array([[np.cos(0.1), 0.0, np.sin(0.1)]])
    assert surface.range_m(ahead, attitude())[0] == pytest.approx(RADIUS_M / np.cos(0.1), rel=0.05)


def test_matches_make_ranges_better_and_one_line_of_json_is_complete(seen) -> None:  # type: ignore[no-untyped-def]
    rig, stand, images, matched = seen
    labels = ring_labels()
    depth = fuse_depth(matched, labels, GRID, stand)
    strip = level_strip(images, rig, stand, WaterAndShell(40.0), GRID)
    shift = contact_shifts(labels, strip, images, rig, stand)
    world = find_stixels(labels, GRID, stand, *depth.inverse_horizontal(), shift)
    distance, _ = world.range_m()
    wall = (world.kind == 1) & world.stands
    assert np.median(np.abs(distance[wall] / RADIUS_M - 1)) < 0.01
    line = world_to_dict(world)
    assert len(line["obstacles"]) >= GRID.columns
    assert len(line["free_water_m"]) == GRID.columns


def test_ranges_of_two_cameras(seen) -> None:  # type: ignore[no-untyped-def]
    rig, stand, images, matched = seen
    assert len(epipolar_pairs(rig, stand)) >= 4
    depth = fuse_depth(matched, ring_labels(), GRID, stand)
    truth = np.broadcast_to((RADIUS_M / np.cos(GRID.elevations()))[:, None], depth.range_m.shape)
    on_wall = depth.source == MATCHED
    error = depth.range_m[on_wall] / truth[on_wall] - 1
    assert np.median(np.abs(error)) < 0.02
    assert (np.abs(error) > 0.1).mean() < 0.1
    assert on_wall.sum() > 0.9 * (ring_labels().classes == 1).sum()
    inverse_error = (1 / depth.range_m - 1 / truth)[on_wall] / (depth.sigma_m / depth.range_m**2)[on_wall]
    assert np.median(inverse_error**2) / 0.455 < 2.0
    cloud = point_cloud(depth, level_strip(images, rig, stand, WaterAndShell(40.0), GRID))
    assert cloud.startswith(b"ply")
    assert len(cloud) > 19 * on_wall.sum()


@pytest.mark.parametrize("turn", [1, -1])
def test_matches_on_a_slanted_plane_do_not_lag(turn: int) -> None:
    """Water comes nearer from row to row."""
    noise = np.random.default_rng(2).uniform(0, 255, (120, 400)).astype(np.float32)
    right = cv2.GaussianBlur(noise, (0, 0), 1.2)
    right = np.clip(128 + 2.5 * (right - right.mean()), 0, 255)
    disparity = (10 + 0.2 * np.arange(120))[::turn]
    column = np.arange(400, dtype=np.float32)
    u, v = column[None, :] - disparity[:, None], np.repeat(np.arange(120.0)[:, None], 400, axis=1)
    left = cv2.remap(right, u.astype(np.float32), v.astype(np.float32), cv2.INTER_CUBIC)
    found = _semi_global(np.clip(left, 0, 255).astype(np.uint8), right.astype(np.uint8), 48)
    error = (found - disparity[:, None])[10:-10, 60:][found[10:-10, 60:] >= 0]
    assert len(error) > 20_000
    assert abs(np.median(error)) < 0.05


def test_the_nearer_of_two_groups_counts_and_jumps_are_not_trusted() -> None:
    stand = attitude()
    near, far = patch(60, 74, 8.0), patch(60, 74, 20.0)
    half = np.arange(len(far.texture)) % 60 >= 30
    background = MatchedPoints(far.points_level[half], far.inverse_std[half], far.texture[half], ("c", "d"))
    left = MatchedPoints(near.points_level[~half], near.inverse_std[~half], near.texture[~half], ("a", "b"))
    behind = MatchedPoints(far.points_level[~half], far.inverse_std[~half], far.texture[~half], ("e", "f"))
    depth = fuse_depth([left, behind, background], ring_labels(), GRID, stand)
    distance = depth.range_m * np.cos(GRID.elevations())[:, None]
    assert np.allclose(distance[62:72, 205:225], 8.0, rtol=0.01)  # both were matched there
    assert np.allclose(distance[62:72, 235:255], 20.0, rtol=0.01)
    assert depth.confidence[66, 229:231].max() < 0.5 * depth.confidence[66, 210:220].min()


def test_one_camera_that_moves_shows_ranges(seen) -> None:  # type: ignore[no-untyped-def]
    rig, stand, images, _ = seen
    step_level = np.array([0.9, 0.2, 0.0])
    world = water_and_ring(RADIUS_M, is_mottled=True)
    then = photograph(rig, stand, lambda origins, rays: world(origins - step_level, rays))
    moved = SE3(np.eye(3), -(stand.level_from_rig.T @ step_level))
    left = {"left": images["left"]}
    found = moved_points(left, Earlier(then, moved), rig, stand)
    assert {points.names for points in found} == {("left", "left")}
    points = np.concatenate([p.points_level for p in found])
    on_wall = points[:, 2] + HEIGHT_M > 0.5
    distance = np.hypot(points[on_wall, 0], points[on_wall, 1])
    assert on_wall.sum() > 5000
    assert np.median(np.abs(distance / RADIUS_M - 1)) < 0.02
    assert moved_points(left, Earlier(then, SE3.identity()), rig, stand) == []


def test_the_earlier_picture_is_the_latest_that_is_far_enough() -> None:
    times = np.arange(0, 3_000_000_000, 100_000_000)
    way = np.stack([np.minimum(1.05e-9 * times, 2.0), 0 * times, 0 * times], axis=1)
    poses = SE3(np.broadcast_to(np.eye(3), (len(times), 3, 3)), way)
    track = track_from_trajectory(Trajectory("way", times, poses), four_cameras())
    assert earlier_time(track, times, 1_500_000_000) == 900_000_000
    assert earlier_time(track, times, 2_900_000_000) == 1_300_000_000
    assert earlier_time(track, times, 300_000_000) is None
    assert earlier_time(track, times, 9_000_000_000) is None
    assert earlier_time(None, times, 1_500_000_000) is None


def test_water_is_never_matched(seen) -> None:  # type: ignore[no-untyped-def]
    _, stand, _, matched = seen
    depth = fuse_depth(matched, ring_labels(), GRID, stand)
    water = ring_labels().classes == 0
    assert (depth.source[water] == PLANE).all()
    plane = HEIGHT_M / np.sin(-GRID.elevations())
    assert np.allclose(depth.range_m[150], plane[150])
    nobody_knows = LevelAttitude(stand.level_from_rig)
    assert np.isnan(fuse_depth(matched, ring_labels(), GRID, nobody_knows).range_m[water]).all()


def patch(first: int, last: int, distance_m: float) -> MatchedPoints:
    """Rows of an upright thing, 60 columns wide, as two cameras match it."""
    rows = np.repeat(np.arange(first, last), 60)
    columns = np.tile(np.arange(200, 260), last - first)
    directions = GRID.directions()[rows, columns]
    points = directions * (distance_m / np.cos(GRID.elevations()[rows]))[:, None]
    points = np.concatenate([points, points])
    return MatchedPoints(points, np.full(len(points), 1e-3), np.full(len(points), 20.0), ("a", "b"))


def labels_with(wrong: int, first: int, last: int) -> Labels:
    labels = ring_labels(0.7)
    labels.classes[first:last, 200:260] = wrong
    labels.probability[:, first:last, 200:260] = np.roll(np.array([0.6, 0.2, 0.2], np.float32), wrong)[
        :, None, None
    ]
    return labels


def test_what_lies_under_the_water_is_a_mirror_image() -> None:
    stand = attitude()  # 10 degrees down the water is 10.7 m away
    labels = labels_with(1, 98, 103)
    corrected = height_check.tested_by_height(labels, [patch(98, 103, 30.0)], GRID, stand, None)
    assert (corrected.classes[100, 205:255] == 0).all()
    unknown = LevelAttitude(stand.level_from_rig)
    assert height_check.tested_by_height(labels, [patch(98, 103, 30.0)], GRID, unknown, None) is labels


def test_what_reaches_down_to_the_water_stands_and_what_floats_is_chance() -> None:
    stand, distance = attitude(), 5.0
    foot = round(float((GRID.top_deg + np.rad2deg(np.arctan(HEIGHT_M / distance))) / GRID.step_deg))
    labels = labels_with(0, 98, foot)
    standing = height_check.tested_by_height(labels, [patch(98, foot, distance)], GRID, stand, None)
    assert (standing.classes[100:110, 205:255] == 1).all()
    floating = height_check.tested_by_height(labels, [patch(98, 103, distance)], GRID, stand, None)
    assert (floating.classes[98:103, 205:255] == 0).all()


def test_small_and_unsupported_pieces_on_the_water_are_spurious() -> None:
    stand = attitude()
    labels = labels_with(1, 130, 132)
    labels.classes[130:132, 203:260] = 0
    labels.probability[:, 130:132, 203:260] = np.array([0.7, 0.2, 0.1], np.float32)[:, None, None]
    wall = patch(80, 86, RADIUS_M)
    assert (labels.classes[130:132, 200:203] == 1).all()
    assert (
        height_check.tested_by_height(labels, [wall], GRID, stand, None).classes[130:132, 200:203] == 0
    ).all()


def test_a_thing_is_looked_up_where_it_was_before() -> None:
    """The vessel has moved 2 m ahead: what stands 6 m to port was seen some 20 degrees beside where it is now."""
    number = np.zeros((GRID.rows, GRID.columns), np.int32)
    number[98:120, 200:260] = 1
    then_from_now = SE3(np.eye(3), np.array([2.0, 0.0, 0.0]))
    ahead = GRID.directions()[119, 230]
    place = ahead * HEIGHT_M / np.tan(-GRID.elevations()[119]) / np.hypot(*ahead[:2])
    then = then_from_now * place
    column, row = np.round(GRID.pixels(then / np.linalg.norm(then))).astype(int)
    assert abs(column - 230) > 20
    odds = np.full((GRID.rows, GRID.columns), -3.0)
    odds[row - 40 : row + 10, column - 45 : column + 45] = 2.0
    moved, stayed = EarlierLooks(odds, then_from_now), EarlierLooks(odds, SE3(np.eye(3), np.zeros(3)))
    assert moved.mean_odds(number, 2, GRID, HEIGHT_M)[1] > 1.5
    assert stayed.mean_odds(number, 2, GRID, HEIGHT_M)[1] < 1.0
    unseen = EarlierLooks(np.full_like(odds, np.nan), then_from_now)
    assert np.isnan(unseen.mean_odds(number, 2, GRID, HEIGHT_M)[1])


def test_what_looked_more_like_water_before_is_spurious() -> None:
    """Matches alone make a thing of it, against its looks."""
    distance = 5.0
    foot = round(float((GRID.top_deg + np.rad2deg(np.arctan(HEIGHT_M / distance))) / GRID.step_deg))
    labels, thing = labels_with(0, 104, foot), [patch(104, foot, distance)]
    for then, kept in ((-1.2, True), (-2.5, False)):
        odds = np.full((GRID.rows, GRID.columns), then)
        before = EarlierLooks(odds, SE3(np.eye(3), np.zeros(3)))
        found = height_check.tested_by_height(labels, thing, GRID, attitude(), before)
        assert (found.classes[108:114, 210:250] == 1).mean() == kept


def test_without_a_height_there_are_no_stixels() -> None:
    with pytest.raises(UsageError, match="height"):
        find_stixels(ring_labels(), GRID, LevelAttitude(np.eye(3)))


def test_one_camera_alone_gives_stixels_and_nothing_is_matched() -> None:
    rig, stand = four_cameras(), attitude()
    images = {"front": photograph(rig, stand, water_and_ring(RADIUS_M))["front"]}
    strip, labels, world = StixelEstimator(rig).estimate(images, stand, 0)
    assert matched_points(images, rig, stand) == []
    blind = ~strip.is_seen.any(axis=0)
    assert blind.sum() > 200
    assert not np.isin(world.column, np.flatnonzero(blind)).any()
    assert np.isfinite(labels.probability).all()
