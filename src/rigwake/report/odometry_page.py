"""The page of an odometry: paths from above, points and residuals over time, a picture of each camera."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from markupsafe import Markup

from rigwake._types import Array
from rigwake.cameras.protocol import CameraModel
from rigwake.errors import RigwakeError
from rigwake.geometry.se3 import SE3
from rigwake.odometry.camera_odometry import CameraOdometry
from rigwake.recording import CameraStream, Recording
from rigwake.report.charts import Series, line_chart, top_view
from rigwake.report.html_page import (
    card,
    figure,
    grid,
    html_page,
    legend,
    listing,
    note,
    picture,
    side_by_side,
    table,
    verdict,
)
from rigwake.report.motion_figures import motion_of, thin
from rigwake.trajectory import Trajectory

_BINS = 200  # of a curve over time
_DOTS = 400  # points drawn over a picture


def odometry_page(opened: Recording, results: Mapping[str, CameraOdometry | RigwakeError]) -> str:
    """One HTML page of what became of each camera; failed cameras are named with their reason."""
    done = {name: r for name, r in results.items() if not isinstance(r, RigwakeError)}
    failed = [f"{name}: {r}" for name, r in results.items() if isinstance(r, RigwakeError)]
    tone = "lost" if not done else "usable" if failed else "good"
    words = f"{len(done)} of {len(results)} cameras have a trajectory"
    rows = [_row(name, result) for name, result in done.items()]
    head = ["camera", "metres from", "frames placed", "segments", "path", "tracks", "residual, px"]
    notes = [f"{name}: {text}" for name, result in done.items() for text in result.notes]
    return html_page(
        f"Odometry of {opened.path.name}",
        [
            verdict(tone, words, failed),
            card("Cameras", table("Cameras", head, rows, words=(1,)), listing(notes)),
            card("Paths from above", *_paths(done)),
            card("Motion", *_motion(done)),
            card("Tracked points and residuals", *_residuals(opened, done)),
            card("Pictures", *_pictures(opened, done)),
        ],
        f"{opened.kind}. {sum(len(r.tracks.timestamps_ns) for r in done.values())} frames of {len(done)} cameras.",
    )


def _row(name: str, result: CameraOdometry) -> list[str]:
    metric = result.trajectory.is_metric
    counts = result.visual.counts if result.visual is not None else None
    return [
        name,
        result.scale_source if metric else "nothing: up to scale",
        f"{len(result.trajectory)} / {len(result.tracks.timestamps_ns)}",
        "–" if counts is None else str(counts.segments),
        f"{result.trajectory.path_length:.1f} {'m' if metric else 'units'}",
        f"{len(np.unique(result.tracks.track_ids)):,}",
        "–" if counts is None else f"{counts.inlier_rms_px:.2f}",
    ]


def _paths(done: Mapping[str, CameraOdometry]) -> list[Markup]:
    """Those of one world together (with GNSS: east and north), every other by itself."""
    together = [n for n, r in done.items() if r.trajectory.is_metric and r.scale_source == "gnss"]
    colours = {name: k for k, name in enumerate(done)}
    charts = []
    if together:
        series = [_seen_from_above(n, done[n].trajectory, colours[n])[0] for n in together]
        chart = top_view("Paths from above", series)
        charts.append(figure(chart, f"{', '.join(together)}: east to the right, north up."))
    for name in (n for n in done if n not in together):
        series_of_one, words = _seen_from_above(name, done[name].trajectory, colours[name])
        unit = "m" if done[name].trajectory.is_metric else "units"
        charts.append(
            figure(top_view(f"Path of {name} from above", [series_of_one], unit), f"{name}: {words}")
        )
    explained = note("Squares mark the starts.")
    return [legend(done), side_by_side(*charts), explained] if charts else []


def _seen_from_above(name: str, trajectory: Trajectory, colour: int) -> tuple[Series, str]:
    """A path in the plane of its world, segments apart. A world whose vertical is not known is seen along the
    direction in which its path extends least."""
    kept = thin(len(trajectory))
    points = trajectory.world_from_body.translation[kept]
    words = "in a world of its own, whose heading is arbitrary."
    if not trajectory.is_metric:
        axes = np.linalg.svd(points - points.mean(axis=0), full_matrices=False)[2]
        points = (points - points.mean(axis=0)) @ axes.T
        words = "in a world and a unit of its own, seen along the direction in which it extends least."
    assert trajectory.segment_ids is not None
    broken = np.flatnonzero(np.diff(trajectory.segment_ids[kept])) + 1
    x, y = (np.insert(points[:, axis], broken, np.nan) for axis in (0, 1))
    return Series(name, x, y, colour), words


def _motion(done: Mapping[str, CameraOdometry]) -> list[Markup]:
    metric = {n: r.trajectory for n, r in done.items() if r.trajectory.is_metric and len(r.trajectory) > 2}
    if not metric:
        return []
    colours = {name: k for k, name in enumerate(done)}
    motions = {name: motion_of(trajectory) for name, trajectory in metric.items()}
    start = min(int(t.timestamps_ns[0]) for t in metric.values())
    at = {n: m.at_s + (int(metric[n].timestamps_ns[0]) - start) * 1e-9 for n, m in motions.items()}
    heights = {n: t.world_from_body.translation[thin(len(t)), 2] for n, t in metric.items()}
    speed = [Series(n, at[n], m.speed, colours[n]) for n, m in motions.items()]
    height = [Series(n, at[n], heights[n] - heights[n].mean(), colours[n]) for n in metric]
    return [
        legend(done),
        side_by_side(
            figure(line_chart("Speed over time", "time, s", "m/s", speed), "Speed of each camera."),
            figure(
                line_chart("Height over time", "time, s", "m", height, from_zero=False),
                "Height of each camera about its mean.",
            ),
        ),
    ]


def _lens(opened: Recording, name: str, result: CameraOdometry) -> CameraModel | None:
    if result.lens is not None:
        return result.lens.camera
    return opened.cameras[name].model if name in opened.cameras else None


def _residuals(opened: Recording, done: Mapping[str, CameraOdometry]) -> list[Markup]:
    colours = {name: k for k, name in enumerate(done)}
    counts, sizes = [], []
    for name, result in done.items():
        tracks = result.tracks
        times = (tracks.timestamps_ns - tracks.timestamps_ns[0]) * 1e-9
        per_frame = np.bincount(tracks.frame_indices, minlength=len(times)).astype(np.float64)
        kept = thin(len(times), _BINS)
        counts.append(Series(name, times[kept], per_frame[kept], colours[name]))
        lens = _lens(opened, name, result)
        found = None if lens is None else map_residuals(result, lens)
        if found is not None:
            sizes.append(Series(name, *_medians(times, *found), colours[name]))
    return [
        legend(done),
        side_by_side(
            figure(line_chart("Points per frame", "time, s", "points", counts), "Tracked points per frame."),
            figure(
                line_chart("Residuals over time", "time, s", "px", sizes),
                "Median reprojection error of the points of the visual map.",
            ),
        ),
    ]


def map_residuals(result: CameraOdometry, lens: CameraModel) -> tuple[Array, Array] | None:
    """Frames (N,) and reprojection errors (N,), px, of the observations that agree with the visual map; None without
    a map. A point counts in the poses of the segment that made it, since each segment has a world of its own."""
    visual, tracks = result.visual, result.tracks
    if visual is None or not len(visual.landmarks):
        return None
    pose_of = np.full(len(tracks.timestamps_ns), -1)
    pose_of[visual.frame_indices] = np.arange(len(visual.frame_indices))
    order = np.argsort(visual.landmarks.track_ids)
    ids = visual.landmarks.track_ids[order]
    place = np.minimum(np.searchsorted(ids, tracks.track_ids), len(ids) - 1)
    landmark, pose = order[place], pose_of[tracks.frame_indices]
    known = visual.inliers & (ids[place] == tracks.track_ids) & (pose >= 0)
    assert visual.trajectory.segment_ids is not None
    known &= visual.trajectory.segment_ids[pose] == visual.landmarks.segment_ids[landmark]
    rows = np.flatnonzero(known)
    poses = visual.trajectory.world_from_body[pose[rows]]
    points = _moved(poses.inverse(), visual.landmarks.points_world[landmark[rows]])
    pixels, valid = lens.project(points)
    errors = np.linalg.norm(pixels - tracks.pixels[rows], axis=1)
    return tracks.frame_indices[rows][valid].astype(np.float64), errors[valid]


def _moved(cam_from_world: SE3, points_world: Array) -> Array:
    return np.einsum("nij,nj->ni", cam_from_world.rotation, points_world) + cam_from_world.translation


def _medians(times: Array, frames: Array, errors: Array) -> tuple[Array, Array]:
    """The median of each of some hundred stretches of frames, NaN where there is nothing."""
    edges = np.linspace(0, len(times), min(len(times), _BINS) + 1).astype(int)
    order = np.argsort(frames, kind="stable")
    bounds = np.searchsorted(frames[order], edges)
    medians = [
        float(np.median(errors[order[a:b]])) if b > a else np.nan
        for a, b in zip(bounds[:-1].tolist(), bounds[1:].tolist(), strict=True)
    ]
    return times[np.minimum((edges[:-1] + edges[1:]) // 2, len(times) - 1)], np.array(medians)


def _pictures(opened: Recording, done: Mapping[str, CameraOdometry]) -> list[Markup]:
    drawn = [
        _one_picture(opened.cameras[name], result) for name, result in done.items() if name in opened.cameras
    ]
    if not any(drawn):
        return []
    said = "Dots: tracked points; light blue those that agree with the map, orange those that do not. Dark: not used."
    return [grid(*drawn), note(said)]


def _one_picture(stream: CameraStream, result: CameraOdometry) -> Markup:
    """The frame in the middle of those with points, with its points and its mask over it."""
    tracks = result.tracks
    if not len(tracks.frame_indices):
        return Markup("")
    index = int(np.median(tracks.frame_indices))
    stamp = int(tracks.timestamps_ns[index])
    at = int(np.searchsorted(stream.timestamps_ns, stamp))
    frame = next(iter(stream.frames([min(at, len(stream) - 1)], colour=True)), None)
    if frame is None:
        return Markup("")
    rows = np.flatnonzero(tracks.frame_indices == index)[:_DOTS]
    agrees = result.visual.inliers[rows] if result.visual is not None else np.ones(len(rows), np.bool_)
    radius = stream.width_px / 160
    dots = [
        f'<circle cx="{u:.1f}" cy="{v:.1f}" r="{radius:.1f}" fill="{"#56b4e9" if good else "#ff8a3c"}" '
        'stroke="#000" stroke-width="0.4"/>'
        for (u, v), good in zip(tracks.pixels[rows].tolist(), agrees.tolist(), strict=True)
    ]
    image = frame.image.copy()
    usable = result.mask.usable
    if usable.shape == image.shape[:2]:
        image[~usable] //= 2
    seconds = (stamp - int(tracks.timestamps_ns[0])) * 1e-9
    return picture(image, f"{stream.name} at {seconds:.1f} s: {len(rows)} points", dots)
