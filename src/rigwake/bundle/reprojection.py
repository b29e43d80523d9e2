"""Reprojection of landmarks into frames: residuals in pixels, in each camera's own lens model.

With y = R^T (d + rho (c - p)) for a camera at p with rotation R and a landmark of anchor c, bearing d and
inverse range rho, the pixel is that of the direction y: nothing is divided by depth, so neither points at
infinity nor angles beyond 90 degrees are special. Right perturbation gives dy = [hat(y), -rho I] delta.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit

from rigwake.bundle.frames import Frames
from rigwake.bundle.layout import Layout, tangent_bases
from rigwake.bundle.motion import TimedPoses
from rigwake.bundle.problem import Indices, Mask, RigProblem, SolverOptions
from rigwake.bundle.robust import robust
from rigwake.bundle.schur import LinearObservations
from rigwake.geometry import so3
from rigwake.geometry.so3 import Array

_UNSEEN_SIGMAS = (
    100.0  # what an observation costs whose landmark the lens cannot see: a step that loses it fails
)


@dataclass(frozen=True, eq=False)
class Reprojection:
    """Residuals (M, 2) in pixels, in the order of `Frames.order`, NaN where the lens cannot see the landmark
    (`valid`, (M,)), and their robust cost."""

    residuals_px: Array
    valid: Mask
    cost: float


def reproject(problem: RigProblem, frames: Frames, poses: TimedPoses, options: SolverOptions) -> Reprojection:
    """Residuals and cost alone."""
    result, _ = _project(problem, frames, poses, options, None)
    return result


def linearise(
    problem: RigProblem, layout: Layout, frames: Frames, poses: TimedPoses, options: SolverOptions
) -> tuple[Reprojection, LinearObservations]:
    """Residuals, cost, and whitened derivatives."""
    width = max((_extra_width(problem, layout, c) for c in range(len(problem.cameras))), default=0)
    m = len(frames.order)
    linear = LinearObservations(
        frames.landmark_starts,
        frames.of_observation,
        np.zeros((m, 2)),
        np.zeros((m, 2, 6)),
        np.zeros((m, 2, 3)),
        np.zeros((m, 2, width)),
        np.full((m, width), -1, dtype=np.int64),
    )
    return _project(problem, frames, poses, options, (layout, linear))


def _extra_width(problem: RigProblem, layout: Layout, camera: int) -> int:
    name = problem.cameras[camera].name
    blocks = [layout.shared.get((name, kind)) for kind in ("line_delay", "intrinsics")]
    return sum(block.stop - block.start for block in blocks if block)


def _project(
    problem: RigProblem,
    frames: Frames,
    poses: TimedPoses,
    options: SolverOptions,
    target: tuple[Layout, LinearObservations] | None,
) -> tuple[Reprojection, LinearObservations]:
    m = len(frames.order)
    residuals, valid = np.full((m, 2), np.nan), np.zeros(m, dtype=bool)
    marks, seen = problem.landmarks, problem.observations
    landmark_of = seen.landmark_indices[frames.order]
    pixels, weights = seen.pixels[frames.order], 1 / seen.std_px[frames.order]
    points = np.empty((m, 3))
    _directions(
        poses.world_from_body.rotation,
        poses.world_from_body.translation,
        frames.of_observation,
        landmark_of,
        marks.anchors_world,
        marks.bearings_world,
        marks.inverse_ranges,
        points,
    )
    by_point = np.zeros((m, 2, 3)) if target else None
    for c, (camera, rows) in enumerate(zip(problem.cameras, frames.observations, strict=True)):
        if not len(rows):
            continue
        y, shift = points[rows], None
        if camera.line_delay_s != 0 or "line_delay" in camera.free:
            inverse_ranges = marks.inverse_ranges[landmark_of[rows]]
            shift = _read_out(
                camera.line_delay_s,
                pixels[rows, 1] - camera.reference_row_px,
                poses.twist[frames.of_observation[rows]],
                y,
                inverse_ranges,
            )
            y = shift.points
        if target is None or by_point is None:
            projected, valid[rows] = camera.model.project(y)
        else:
            view = camera.model.project_with_jacobians(y)
            projected, valid[rows] = view.pixels, view.valid
            by_point[rows] = view.d_point if shift is None else view.d_point @ shift.rotation
            _fill_extras(problem, target, c, rows, view.d_params, view.d_point, shift, weights[rows])
        residuals[rows] = projected - pixels[rows]
    whitened = np.where(valid[:, None], residuals * weights[:, None], 0.0)
    squared = np.einsum("mi,mi->m", whitened, whitened)
    squared[~valid] = _UNSEEN_SIGMAS**2
    loss, slope = robust(squared, options.loss, options.loss_scale)
    result = Reprojection(residuals, valid, 0.5 * float(loss.sum()))
    if target is None or by_point is None:
        return result, _NOTHING
    linear = target[1]
    factor = np.where(valid, weights * np.sqrt(slope), 0.0)
    linear.residuals[:] = np.where(valid[:, None], residuals * factor[:, None], 0.0)
    linear.by_extras[:] *= np.sqrt(slope)[:, None, None]
    _derivatives(
        poses.world_from_body.rotation,
        poses.world_from_body.translation,
        frames.of_observation,
        landmark_of,
        marks.anchors_world,
        marks.inverse_ranges,
        tangent_bases(marks.bearings_world),
        points,
        by_point,
        factor,
        linear.by_frame,
        linear.by_landmark,
    )
    return result, linear


@dataclass(frozen=True, eq=False)
class _ReadOut:
    """Directions as seen when their row was read: y' = rotation (y - rho t), and dy' by the line delay."""

    points: Array
    rotation: Array
    by_delay: Array


def _read_out(delay_s: float, rows_px: Array, twist: Array, y: Array, inverse_ranges: Array) -> _ReadOut:
    """The camera moves on by its twist while the rows are read: its frame becomes `frame * Exp(twist dt)`,
    with the rotation exact and the path straight within an image."""
    dt = (rows_px * delay_s)[:, None]
    rotation = so3.exp(-twist[:, :3] * dt)
    linear = inverse_ranges[:, None] * twist[:, 3:]
    points = np.einsum("nij,nj->ni", rotation, y - linear * dt)
    moved = np.einsum("nij,nj->ni", rotation, linear)
    rate = -np.cross(twist[:, :3], points) - moved
    return _ReadOut(points, rotation, rate * rows_px[:, None])


def _fill_extras(
    problem: RigProblem,
    target: tuple[Layout, LinearObservations],
    camera: int,
    rows: Indices,
    d_params: Array,
    d_point: Array,
    shift: _ReadOut | None,
    weights: Array,
) -> None:
    """Derivatives by line delay and intrinsics, into columns counted from the first extra."""
    layout, linear = target
    name, start = problem.cameras[camera].name, 0
    parts = {}
    if shift is not None:
        parts["line_delay"] = np.einsum("nij,nj->ni", d_point, shift.by_delay)[:, :, None]
    parts["intrinsics"] = d_params
    for kind, jacobian in parts.items():
        block = layout.shared.get((name, kind))
        if block is None:
            continue
        stop = start + block.stop - block.start
        linear.by_extras[rows, :, start:stop] = jacobian * weights[:, None, None]
        linear.extras[rows, start:stop] = np.arange(block.start, block.stop) - layout.extras_start
        start = stop


_NOTHING = LinearObservations(
    np.zeros(1, np.int64),
    np.zeros(0, np.int64),
    np.zeros((0, 2)),
    np.zeros((0, 2, 6)),
    np.zeros((0, 2, 3)),
    np.zeros((0, 2, 0)),
    np.zeros((0, 0), np.int64),
)


@njit(cache=True)
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


@njit(cache=True)
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
    factor,
    by_frame,
    by_landmark,
):
    """Chain the pixels' derivatives to frames and landmarks, whitened by `factor`."""
    world = np.empty(3)
    for m in range(len(frames)):
        f, k, w = frames[m], landmarks[m], factor[m]
        for i in range(2):
            a, b, c = by_point[m, i, 0] * w, by_point[m, i, 1] * w, by_point[m, i, 2] * w
            if w == 0.0:
                a, b, c = 0.0, 0.0, 0.0
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
