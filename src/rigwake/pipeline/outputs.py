"""What a calibration leaves in its folder, for reports and for whoever wants to look closer; docs/report.md."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from rigwake._types import Array, Image
from rigwake.atomic import atomic_path, write_text_atomic
from rigwake.ba.rig.association_rounds import CrossCameraMatches
from rigwake.ba.rig.rig_values import AdjustedRig, InitialRig
from rigwake.ba.rig.search_proposals import camera_from_world
from rigwake.ba.solver.rig_problem import RigProblem
from rigwake.calibration import Calibration, save_calibration
from rigwake.pipeline.adjustment_record import write_adjustment
from rigwake.pipeline.association_patches import write_patches
from rigwake.pipeline.stream_selection import Selection
from rigwake.recording import CameraStream
from rigwake.report.picture_overlays import horizon_pixels
from rigwake.trajectory import Trajectory
from rigwake.writers.trajectory_writer import write_tum

_MOST_RESIDUALS = 200_000
_HORIZON_PICTURES = 3  # per camera
_ASSOCIATION_PICTURES = 2  # per camera


def write_outputs(
    out: Path,
    calibration: Calibration,
    adjusted: AdjustedRig,
    first: InitialRig,
    selection: Selection,
    matches: CrossCameraMatches,
) -> None:
    """Trajectories, residuals, pictures and, last, the calibration itself."""
    problem = adjusted.solution.problem
    write_trajectories(out / "trajectories", problem)
    _write_residuals(out / "residuals.npz", adjusted)
    write_adjustment(out / "adjustment.npz", problem)
    is_level = problem.imu is not None or problem.gnss is not None
    _write_pictures(out / "pictures", problem, selection.cameras, matches, is_level)
    save_calibration(calibration, out / "calibration.yaml")


def write_trajectories(folder: Path, problem: RigProblem) -> None:
    """`rig.tum` on the clock of the rig, and of every camera NAME.tum, `world_from_cam` on its own clock."""
    states = problem.states
    write_tum(Trajectory("rig", states.timestamps_ns, states.world_from_rig), folder / "rig.tum")
    for camera in problem.cameras:
        stamps = states.timestamps_ns - round(camera.time_offset_s * 1e9)
        trajectory = Trajectory(camera.name, stamps, states.world_from_rig * camera.rig_from_cam)
        write_tum(trajectory, folder / f"{camera.name}.tum")


def _write_residuals(path: Path, adjusted: AdjustedRig) -> None:
    problem = adjusted.solution.problem
    observations = problem.observations
    step = max(1, -(-len(observations) // _MOST_RESIDUALS))
    rows = np.flatnonzero(np.isfinite(adjusted.solution.residuals_px).all(axis=1))[::step]
    angles = np.full(len(rows), np.nan)
    for index, camera in enumerate(problem.cameras):
        own = observations.camera_indices[rows] == index
        bearings, _ = camera.model.unproject(observations.pixels[rows][own])
        angles[own] = np.rad2deg(np.arccos(np.clip(bearings[:, 2], -1, 1)))
    with atomic_path(path) as temporary, temporary.open("wb") as file:
        np.savez_compressed(
            file,
            camera=observations.camera_indices[rows],
            camera_names=np.array([camera.name for camera in problem.cameras]),
            timestamp_ns=observations.timestamps_ns[rows],
            pixels=observations.pixels[rows].astype(np.float32),
            residuals_px=adjusted.solution.residuals_px[rows].astype(np.float32),
            angle_deg=angles.astype(np.float32),
        )


def _write_pictures(
    folder: Path,
    problem: RigProblem,
    streams: Mapping[str, CameraStream],
    matches: CrossCameraMatches,
    is_level: bool,
) -> None:
    """Some images of every camera with the horizon, and with landmarks associated across cameras from other cameras."""
    entries: list[dict[str, Any]] = []
    for index, camera in enumerate(problem.cameras):
        stream = streams[camera.name]
        if is_level:
            for stamp in _spread_stamps(problem, index):
                horizon = horizon_of_image(problem, index, stamp)
                entry = {"kind": "horizon", "horizon_px": horizon.round(1).tolist(), "points": []}
                entries += _save_picture(folder, stream, stamp, len(entries), entry)
        for stamp, rows in _busiest_images(matches, index):
            points = _association_points(problem, matches, index, stamp, rows)
            entry = {"kind": "hand_over", "horizon_px": [], "points": points}
            entries += _save_picture(folder, stream, stamp, len(entries), entry)
    entries += write_patches(folder, problem, streams, matches.unused)
    write_text_atomic(folder / "pictures.json", json.dumps(_without_nan(entries)) + "\n")


def _spread_stamps(problem: RigProblem, camera: int) -> list[int]:
    stamps = np.unique(problem.observations.timestamps_ns[problem.observations.camera_indices == camera])
    if not len(stamps):
        return []
    at = np.linspace(0, len(stamps) - 1, _HORIZON_PICTURES + 2)[1:-1].astype(int)
    return [int(s) for s in np.unique(stamps[at])]


def _busiest_images(matches: CrossCameraMatches, camera: int) -> list[tuple[int, Any]]:
    unused = matches.unused
    rows = np.flatnonzero(unused.camera_indices == camera)
    stamps, counts = np.unique(unused.timestamps_ns[rows], return_counts=True)
    busiest = stamps[np.argsort(-counts, kind="stable")[:_ASSOCIATION_PICTURES]]
    return [(int(stamp), rows[unused.timestamps_ns[rows] == stamp]) for stamp in busiest]


def _association_points(
    problem: RigProblem, matches: CrossCameraMatches, camera: int, stamp: int, rows: Any
) -> list[dict[str, Any]]:
    unused, observations = matches.unused, problem.observations
    landmarks = unused.landmark_indices[rows]
    cam_from_world = camera_from_world(problem, camera, np.array([stamp]))[0]
    predicted, _ = problem.cameras[camera].model.project(
        cam_from_world * problem.landmarks.points_world[landmarks]
    )
    points = []
    for k, landmark in enumerate(landmarks):
        sources = observations.camera_indices[observations.landmark_indices == landmark]
        source = problem.cameras[int(sources[0])].name if len(sources) else ""
        points.append(
            {
                "predicted_px": predicted[k].round(2).tolist(),
                "observed_px": unused.pixels[rows[k]].round(2).tolist(),
                "from_camera": source,
                "landmark": str(int(landmark)),
            }
        )
    return points


def _save_picture(
    folder: Path, stream: CameraStream, stamp: int, number: int, entry: dict[str, Any]
) -> list[dict[str, Any]]:
    index = np.flatnonzero(stream.timestamps_ns == stamp)
    for frame in stream.frames(index, colour=True):
        name = f"{stream.name}_{number}.jpg"
        _write_jpeg(folder / name, frame.image)
        return [{"camera": stream.name, "file": name, "timestamp_ns": stamp, **entry}]
    return []


def _write_jpeg(path: Path, image: Image) -> None:
    ok, encoded = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, 85])
    if ok:
        with atomic_path(path) as temporary:
            temporary.write_bytes(encoded.tobytes())


def horizon_of_image(problem: RigProblem, camera: int, timestamp_ns: int) -> Array:
    """(N, 2) pixels of the horizon in a camera's image of this stamp, on its own clock; NaN outside the image."""
    cam_from_world = camera_from_world(problem, camera, np.array([timestamp_ns]))[0]
    return horizon_pixels(problem.cameras[camera].model, cam_from_world.rotation[:, 2])


def _without_nan(value: Any) -> Any:
    if isinstance(value, dict):
        return {k: _without_nan(v) for k, v in value.items()}
    if isinstance(value, list):
        return [_without_nan(v) for v in value]
    return None if isinstance(value, float) and not np.isfinite(value) else value
