"""Camera frames: the images that observations were made in, and where the camera was as they were taken."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rigwake._types import Array, Indices
from rigwake.ba.solver.parameter_layout import ParameterLayout
from rigwake.ba.solver.rig_problem import RigProblem
from rigwake.ba.solver.state_motion import TimedPoses, nearest_states, rig_at, seconds_since_start
from rigwake.geometry.se3 import SE3


@dataclass(frozen=True, eq=False)
class Frames:
    """Images with observations, in time order, and the observations sorted by landmark and then by frame.

    cameras, stamps_s, states: (F,) camera index, stamp on the camera's clock (seconds since the first state)
    and nearest state. order: (M,) the problem's row of each sorted observation. of_observation: (M,) frame of
    each. landmark_starts: (L + 1,). rows: per camera, its frames; observations: per camera, its sorted rows.
    """

    cameras: Indices
    stamps_s: Array
    states: Indices
    order: Indices
    of_observation: Indices
    landmark_starts: Indices
    rows: tuple[Indices, ...]
    observations: tuple[Indices, ...]

    def __len__(self) -> int:
        return len(self.cameras)


def frames_of(problem: RigProblem) -> Frames:
    """The problem's images and the order of its observations."""
    observations = problem.observations
    stamps_ns, instants = np.unique(observations.timestamps_ns, return_inverse=True)
    n_cameras = max(len(problem.cameras), 1)
    unique, inverse = np.unique(instants * n_cameras + observations.camera_indices, return_inverse=True)
    order = np.lexsort((inverse, observations.landmark_indices))
    cameras, stamps = unique % n_cameras, seconds_since_start(problem, stamps_ns)[unique // n_cameras]
    offsets = np.array([camera.time_offset_s for camera in problem.cameras])
    of_observation = inverse[order]
    every_camera = range(len(problem.cameras))
    camera_of_observation = cameras[of_observation]
    return Frames(
        cameras,
        stamps,
        nearest_states(problem, stamps + offsets[cameras]),
        order,
        of_observation,
        np.searchsorted(observations.landmark_indices[order], np.arange(len(problem.landmarks) + 1)),
        tuple(np.flatnonzero(cameras == c) for c in every_camera),
        tuple(np.flatnonzero(camera_of_observation == c) for c in every_camera),
    )


def frame_poses(problem: RigProblem, layout: ParameterLayout, frames: Frames) -> TimedPoses:
    """Where the camera of each frame was, `world_from_cam`: state, time offset and extrinsics chained."""
    parts = []
    for camera, rows in zip(problem.cameras, frames.rows, strict=True):
        moving = "time_offset" in camera.free or camera.line_delay_s != 0 or "line_delay" in camera.free
        times = frames.stamps_s[rows] + camera.time_offset_s
        rig = rig_at(problem, layout, times, frames.states[rows], moving)
        if "time_offset" in camera.free:
            offset = layout.shared_columns(camera.name, "time_offset", 1)
            rig = rig.with_shared(rig.twist[:, :, None], offset)
        cam = rig.seen_from(camera.rig_from_cam)
        if "rig_from_cam" in camera.free:
            cam = cam.with_shared(np.eye(6), layout.shared_columns(camera.name, "rig_from_cam", 6))
        parts.append(cam)
    return _merged(len(frames), parts, frames.rows)


def _merged(n: int, parts: list[TimedPoses], rows: tuple[Indices, ...]) -> TimedPoses:
    """The cameras' poses in the order of the frames, padded with derivatives of zero."""
    neighbours = max((part.states.shape[1] for part in parts), default=1)
    width = max((part.by_states.shape[3] for part in parts), default=6)
    shared = max((part.shared.shape[1] for part in parts), default=0)
    merged = TimedPoses(
        SE3.identity((n,)),
        np.zeros((n, neighbours), dtype=np.int64),
        np.zeros((n, neighbours, 6, width)),
        np.full((n, shared), -1, dtype=np.int64),
        np.zeros((n, 6, shared)),
        np.zeros((n, 6)),
    )
    for part, own in zip(parts, rows, strict=True):
        s, k = part.states.shape[1], part.shared.shape[1]
        merged.world_from_body.rotation[own] = part.world_from_body.rotation
        merged.world_from_body.translation[own] = part.world_from_body.translation
        merged.states[own] = part.states[:, -1:]
        merged.states[own, :s], merged.by_states[own, :s] = part.states, part.by_states
        merged.shared[own, :k], merged.by_shared[own, :, :k] = part.shared, part.by_shared
        merged.twist[own] = part.twist
    return merged
