"""Which column of the linear system is which unknown, and how a step changes the values.

Columns: the states in time order (6 each: right tangent of `world_from_rig`; with an IMU 9 more: velocity in
the world, gyro bias, accelerometer bias), then the shared parameters. Landmarks have no columns here: they
are eliminated.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from rigwake._types import Array, Indices, Mask
from rigwake.ba.solver.rig_problem import BundleCamera, InertialStates, Landmarks, RigProblem

OwnedParameter = tuple[str, str]  # (camera name | "antenna" | "gravity", parameter)


@dataclass(frozen=True, eq=False)
class ParameterLayout:
    """Columns of a problem.

    shared: columns of each free shared parameter. extras: those of them that a single pixel depends on
    directly (intrinsics, line delay); they come last. held: (n_columns,) True for components that stay.
    """

    n_states: int
    state_dim: int
    shared: dict[OwnedParameter, slice]
    n_columns: int
    extras_start: int
    held: Mask

    @property
    def n_state_columns(self) -> int:
        """Columns of all states; the shared parameters begin here."""
        return self.n_states * self.state_dim

    def state_columns(self, states: Indices, width: int) -> Indices:
        """(..., width) first columns of the given states (...); -1 where held."""
        columns = states[..., None] * self.state_dim + np.arange(width)
        return np.where(self.held[columns], -1, columns)

    def shared_columns(self, owner: str, parameter: str, width: int) -> Indices:
        """(width,) columns of a shared parameter; -1 where it is held."""
        block = self.shared.get((owner, parameter))
        return np.full(width, -1) if block is None else np.arange(block.start, block.stop)


def layout_of(problem: RigProblem) -> ParameterLayout:
    """Columns of the problem's free unknowns."""
    n, dim = len(problem.states), 15 if problem.imu is not None else 6
    widths: list[tuple[OwnedParameter, int]] = []
    extras: list[tuple[OwnedParameter, int]] = []
    for camera in problem.cameras:
        widths += [((camera.name, "rig_from_cam"), 6)] if "rig_from_cam" in camera.free else []
        widths += [((camera.name, "time_offset"), 1)] if "time_offset" in camera.free else []
        extras += [((camera.name, "line_delay"), 1)] if "line_delay" in camera.free else []
        n_params = len(camera.model.params)
        extras += [((camera.name, "intrinsics"), n_params)] if "intrinsics" in camera.free else []
    widths += [(("antenna", "position_rig"), 3)] if problem.antenna.free and problem.gnss else []
    if problem.gnss is not None:
        receiver = problem.antenna
        widths += [(("antenna", "time_offset"), 1)] if receiver.time_offset_prior is not None else []
        if receiver.errors is not None:
            widths += [(("antenna", "errors"), 3 * len(receiver.errors.timestamps_ns))]
    widths += [(("gravity", "acceleration_world"), 3)] if problem.gravity.free and problem.imu else []
    extras_start = n * dim + sum(width for _, width in widths)
    shared, start = {}, n * dim
    for key, width in widths + extras:
        shared[key] = slice(start, start + width)
        start += width
    held = np.zeros(start, dtype=bool)
    if problem.states.fixed is not None:
        held[: n * dim] = np.repeat(problem.states.fixed, dim)
    return ParameterLayout(n, dim, shared, start, extras_start, held)


def retract(
    problem: RigProblem, layout: ParameterLayout, step: Array, landmark_step: Array, bases: Array
) -> RigProblem:
    """The problem after a step: columns' step (n_columns,), landmarks' (L, 3) in `bases` (L, 3, 2) and 1/range."""
    states = step[: layout.n_state_columns].reshape(layout.n_states, layout.state_dim)
    moved = replace(problem.states, world_from_rig=problem.states.world_from_rig.retract(states[:, :6]))
    if (old := problem.states.inertial) is not None:
        inertial = InertialStates(
            old.velocity_world + states[:, 6:9],
            old.gyro_bias + states[:, 9:12],
            old.accel_bias + states[:, 12:15],
        )
        moved = replace(moved, inertial=inertial)
    antenna, gravity = problem.antenna, problem.gravity
    if block := layout.shared.get(("antenna", "position_rig")):
        antenna = replace(antenna, position_rig=antenna.position_rig + step[block])
    if block := layout.shared.get(("antenna", "time_offset")):
        antenna = replace(antenna, time_offset_s=antenna.time_offset_s + float(step[block][0]))
    if (block := layout.shared.get(("antenna", "errors"))) and antenna.errors is not None:
        values = antenna.errors.values_enu + step[block].reshape(-1, 3)
        antenna = replace(antenna, errors=replace(antenna.errors, values_enu=values))
    if block := layout.shared.get(("gravity", "acceleration_world")):
        gravity = replace(gravity, acceleration_world=gravity.acceleration_world + step[block])
    return replace(
        problem,
        states=moved,
        cameras=tuple(_moved_camera(camera, layout, step) for camera in problem.cameras),
        landmarks=_moved_landmarks(problem.landmarks, landmark_step, bases),
        antenna=antenna,
        gravity=gravity,
    )


def _moved_camera(camera: BundleCamera, layout: ParameterLayout, step: Array) -> BundleCamera:
    name = camera.name
    if block := layout.shared.get((name, "rig_from_cam")):
        camera = replace(camera, rig_from_cam=camera.rig_from_cam.retract(step[block]))
    if block := layout.shared.get((name, "time_offset")):
        camera = replace(camera, time_offset_s=camera.time_offset_s + float(step[block][0]))
    if block := layout.shared.get((name, "line_delay")):
        camera = replace(camera, line_delay_s=camera.line_delay_s + float(step[block][0]))
    if block := layout.shared.get((name, "intrinsics")):
        camera = replace(camera, model=camera.model.with_params(camera.model.params + step[block]))
    return camera


def _moved_landmarks(landmarks: Landmarks, step: Array, bases: Array) -> Landmarks:
    bearings = landmarks.bearings_world + np.einsum("lij,lj->li", bases, step[:, :2])
    return Landmarks(
        landmarks.anchors_world,
        bearings / np.linalg.norm(bearings, axis=1, keepdims=True),
        landmarks.inverse_ranges + step[:, 2],
    )


def tangent_bases(bearings: Array) -> Array:
    """(L, 3, 2) orthonormal bases of the planes perpendicular to unit bearings (L, 3)."""
    axis = np.zeros_like(bearings)
    axis[np.arange(len(bearings)), np.argmin(np.abs(bearings), axis=1)] = 1.0
    first = np.cross(bearings, axis)
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    return np.stack([first, np.cross(bearings, first)], axis=-1)
