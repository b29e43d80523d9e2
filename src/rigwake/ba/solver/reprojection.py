"""Reprojection of landmarks into frames: residuals in pixels, in each camera's own lens model.

With y = R^T (d + rho (c - p)) for a camera at p with rotation R and a landmark of anchor c, bearing d and
inverse range rho, the pixel is that of the direction y: nothing is divided by depth, so neither points at
infinity nor angles beyond 90 degrees are special. Right perturbation gives dy = [hat(y), -rho I] delta.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rigwake._kernels import njit
from rigwake._types import Array, Indices, Mask
from rigwake.ba.solver.camera_frames import Frames
from rigwake.ba.solver.extrapolation import extrapolated
from rigwake.ba.solver.parameter_layout import ParameterLayout, tangent_bases
from rigwake.ba.solver.rig_problem import BundleCamera, RigProblem, SolverOptions
from rigwake.ba.solver.robust_loss import robust
from rigwake.ba.solver.schur import LinearObservations
from rigwake.ba.solver.state_motion import TimedPoses
from rigwake.cameras.protocol import Projection
from rigwake.geometry import so3
from rigwake.parallel import over_ranges, ranges

_LEAST_OBSERVATIONS = 10_000  # that are worth a thread


@dataclass(frozen=True, eq=False)
class Reprojection:
    """Residuals (M, 2) in pixels, in the order of `Frames.order`, NaN where the lens has no ray for the observed
    pixel (not `valid`, (M,)), their robust cost, and how many landmarks lie beyond the lens (`rim.py`)."""

    residuals_px: Array
    valid: Mask
    cost: float
    beyond: int


def linearise(
    problem: RigProblem, layout: ParameterLayout, frames: Frames, poses: TimedPoses, options: SolverOptions
) -> tuple[Reprojection, LinearObservations]:
    """Residuals, cost, and derivatives, whitened and weighted by the robust loss."""
    points = _directions_of(problem, frames, poses)
    views = _views(problem, frames, poses, points)
    result, factor = _compared(problem, frames, views, options)
    m, width = len(frames.order), max((_extra_width(camera, layout) for camera in problem.cameras), default=0)
    by_point = np.zeros((m, 2, 3))
    linear = LinearObservations(
        frames.landmark_starts,
        frames.of_observation,
        np.where(result.valid[:, None], result.residuals_px * factor[:, None], 0.0),
        np.zeros((m, 2, 6)),
        np.zeros((m, 2, 3)),
        np.zeros((m, 2, width)),
        np.full((m, width), -1, dtype=np.int64),
    )
    for camera, view in zip(problem.cameras, views, strict=True):
        d_point = view.projection.d_point * factor[view.rows, None, None]
        by_point[view.rows] = d_point if view.read_out is None else d_point @ view.read_out.rotation
        _fill_extras(camera, layout, linear, view, d_point, factor[view.rows])
    landmarks = problem.landmarks
    _derivatives(
        poses.world_from_body.rotation,
        poses.world_from_body.translation,
        frames.of_observation,
        problem.observations.landmark_indices[frames.order],
        landmarks.anchors_world,
        landmarks.inverse_ranges,
        tangent_bases(landmarks.bearings_world),
        points,
        by_point,
        linear.by_frame,
        linear.by_landmark,
    )
    for view in views:
        if view.read_out is not None:
            moved = np.einsum("nij,nj->ni", by_point[view.rows], view.read_out.travelled)
            linear.by_landmark[view.rows, :, 2] -= moved
    return result, linear


@dataclass(frozen=True, eq=False)
class _ReadOut:
    """Directions as seen when their row was read, y' = rotation (y - rho travelled), and dy' by the delay."""

    points: Array
    rotation: Array
    travelled: Array
    by_delay: Array


@dataclass(frozen=True, eq=False)
class _View:
    """What one camera sees: its (sorted) observations `rows`, where their landmarks project to, and how many
    of these lie beyond the lens model."""

    rows: Indices
    read_out: _ReadOut | None
    projection: Projection
    beyond: int


def _directions_of(problem: RigProblem, frames: Frames, poses: TimedPoses) -> Array:
    """(M, 3) y of the module's formula, for the frames' own times."""
    points, landmarks = np.empty((len(frames.order), 3)), problem.landmarks
    _directions(
        poses.world_from_body.rotation,
        poses.world_from_body.translation,
        frames.of_observation,
        problem.observations.landmark_indices[frames.order],
        landmarks.anchors_world,
        landmarks.bearings_world,
        landmarks.inverse_ranges,
        points,
    )
    return points


def _views(problem: RigProblem, frames: Frames, poses: TimedPoses, points: Array) -> list[_View]:
    """What the cameras see, one thread each."""
    found: dict[int, _View] = {}

    def work(first: int, last: int) -> None:
        for index in range(first, last):
            found[index] = _view(problem, index, frames, poses, points)

    counts = np.array([len(rows) for rows in frames.observations])
    over_ranges(ranges(counts, _LEAST_OBSERVATIONS), work)
    return [found[index] for index in range(len(problem.cameras))]


def _view(problem: RigProblem, index: int, frames: Frames, poses: TimedPoses, points: Array) -> _View:
    camera, rows = problem.cameras[index], frames.observations[index]
    y, read_out = points[rows], None
    if camera.line_delay_s != 0 or "line_delay" in camera.free:
        read_out = _read_out(problem, camera, frames, poses, rows, y)
        y = read_out.points
    projection = camera.model.project_with_jacobians(y)
    beyond = np.flatnonzero(~projection.valid)
    if len(beyond):
        observed = problem.observations.pixels[frames.order[rows[beyond]]]
        near = extrapolated(camera.model, observed, y[beyond])
        projection.pixels[beyond], projection.valid[beyond] = near.pixels, near.valid
        projection.d_point[beyond] = near.d_point
    return _View(rows, read_out, projection, len(beyond))


def _compared(
    problem: RigProblem, frames: Frames, views: list[_View], options: SolverOptions
) -> tuple[Reprojection, Array]:
    """Residuals and cost, and the factors (M,) that whiten and robustly weight; 0 where not valid."""
    m, observations = len(frames.order), problem.observations
    predicted, valid = np.full((m, 2), np.nan), np.zeros(m, dtype=bool)
    for view in views:
        predicted[view.rows], valid[view.rows] = view.projection.pixels, view.projection.valid
    residuals, weights = predicted - observations.pixels[frames.order], 1 / observations.std_px[frames.order]
    squared = np.where(valid, np.sum((residuals * weights[:, None]) ** 2, axis=1), 0.0)
    loss, slope = robust(squared, options.loss, options.loss_scale)
    beyond = sum(view.beyond for view in views)
    return Reprojection(residuals, valid, 0.5 * float(loss.sum()), beyond), np.where(
        valid, weights * np.sqrt(slope), 0.0
    )


def _read_out(
    problem: RigProblem, camera: BundleCamera, frames: Frames, poses: TimedPoses, rows: Indices, y: Array
) -> _ReadOut:
    """The camera moves on by its twist while rows are read: its frame becomes `frame * Exp(twist dt)`, with
    the rotation exact and the path straight within an image."""
    pixels, landmarks = problem.observations.pixels[frames.order[rows]], problem.landmarks
    owners = problem.observations.landmark_indices[frames.order[rows]]
    lines = (pixels[:, 1] - camera.reference_row_px)[:, None]
    inverse_ranges = landmarks.inverse_ranges[owners][:, None]
    twist = poses.twist[frames.of_observation[rows]]
    dt = lines * camera.line_delay_s
    rotation, travelled = so3.exp(-twist[:, :3] * dt), twist[:, 3:] * dt
    points = np.einsum("nij,nj->ni", rotation, y - inverse_ranges * travelled)
    rate = -np.cross(twist[:, :3], points) - inverse_ranges * np.einsum("nij,nj->ni", rotation, twist[:, 3:])
    return _ReadOut(points, rotation, travelled, rate * lines)


def _extra_width(camera: BundleCamera, layout: ParameterLayout) -> int:
    blocks = [layout.shared.get((camera.name, kind)) for kind in ("line_delay", "intrinsics")]
    return sum(block.stop - block.start for block in blocks if block)


def _fill_extras(
    camera: BundleCamera,
    layout: ParameterLayout,
    linear: LinearObservations,
    view: _View,
    d_point: Array,
    factor: Array,
) -> None:
    """Derivatives by line delay and intrinsics, into columns counted from the first extra."""
    parts = {"intrinsics": view.projection.d_params * factor[:, None, None]}
    if view.read_out is not None:
        parts["line_delay"] = np.einsum("nij,nj->ni", d_point, view.read_out.by_delay)[:, :, None]
    start = 0
    for kind, jacobian in parts.items():
        block = layout.shared.get((camera.name, kind))
        if block is not None:
            stop = start + block.stop - block.start
            linear.by_extras[view.rows, :, start:stop] = jacobian
            linear.extras[view.rows, start:stop] = np.arange(block.start, block.stop) - layout.extras_start
            start = stop


@njit()
def _directions(  # type: ignore[no-untyped-def]
    rotations, positions, frames, landmarks, anchors, bearings, inverse_ranges, out
):
    """`R^T (d + rho (c - p))` of every observation."""
    w = np.empty(3)
    for m in range(len(frames)):
        f, k = frames[m], landmarks[m]
        for i in range(3):
            w[i] = bearings[k, i] + inverse_ranges[k] * (anchors[k, i] - positions[f, i])
        for i in range(3):
            out[m, i] = rotations[f, 0, i] * w[0] + rotations[f, 1, i] * w[1] + rotations[f, 2, i] * w[2]


@njit()
def _derivatives(  # type: ignore[no-untyped-def]
    rotations,
    positions,
    frames,
    landmarks,
    anchors,
    inverse_ranges,
    bases,
    y,
    by_point,
    by_frame,
    by_landmark,
):
    """Chain the pixels' derivatives by the directions to frames and landmarks."""
    world = np.empty(3)
    for m in range(len(frames)):
        f, k = frames[m], landmarks[m]
        for i in range(2):
            a, b, c = by_point[m, i, 0], by_point[m, i, 1], by_point[m, i, 2]
            by_frame[m, i, 0] = b * y[m, 2] - c * y[m, 1]
            by_frame[m, i, 1] = c * y[m, 0] - a * y[m, 2]
            by_frame[m, i, 2] = a * y[m, 1] - b * y[m, 0]
            by_frame[m, i, 3] = -inverse_ranges[k] * a
            by_frame[m, i, 4] = -inverse_ranges[k] * b
            by_frame[m, i, 5] = -inverse_ranges[k] * c
            for j in range(3):
                world[j] = a * rotations[f, j, 0] + b * rotations[f, j, 1] + c * rotations[f, j, 2]
            by_landmark[m, i, 0] = (
                world[0] * bases[k, 0, 0] + world[1] * bases[k, 1, 0] + world[2] * bases[k, 2, 0]
            )
            by_landmark[m, i, 1] = (
                world[0] * bases[k, 0, 1] + world[1] * bases[k, 1, 1] + world[2] * bases[k, 2, 1]
            )
            by_landmark[m, i, 2] = (
                world[0] * (anchors[k, 0] - positions[f, 0])
                + world[1] * (anchors[k, 1] - positions[f, 1])
                + world[2] * (anchors[k, 2] - positions[f, 2])
            )
