"""Any calibration as a rig for views: ours, a `truth.yaml`, a `rig.yaml`, or OpenCV files with ground homographies."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from scipy.optimize import least_squares

from rigwake._types import Array
from rigwake.calibration import Calibration, load_calibration
from rigwake.cameras.protocol import CameraModel
from rigwake.cameras.registry import camera_from_params
from rigwake.errors import InputError
from rigwake.geometry import so3
from rigwake.geometry.se3 import SE3
from rigwake.readers.rig_file import read_rig_file
from rigwake.readers.truth_files import read_true_rig
from rigwake.recording import Recording
from rigwake.rig import Rig, RigCamera
from rigwake.text_files import read_text_file
from rigwake.yaml_input import read_yaml_settings

_MAX_BYTES = 2**20
_NEEDED = ("camera_matrix", "dist_coeffs", "resolution", "project_matrix")


@dataclass(frozen=True, eq=False)
class RigSource:
    """A rig, and the calibration it comes from (with covariances) if it is one of ours."""

    rig: Rig
    calibration: Calibration | None = None


def read_rig_source(path: Path | str, recording: Recording | None = None) -> RigSource:
    """Read a calibration of any kind; lenses that it lacks are taken from the recording.

    Raises InputError if the file is none of: a rigwake calibration (or the folder that holds it), a truth.yaml, a
    rig.yaml.
    """
    path = Path(path)
    if path.is_dir():
        path = path / "calibration.yaml"
    if not path.is_file():
        raise InputError(
            f"There is no {path}.", remedy="Give the calibration.yaml that `rigwake calibrate` wrote."
        )
    content = read_yaml_settings(path)
    if "rigwake_calibration" in content:
        calibration = load_calibration(path)
        return RigSource(_with_lenses(calibration.rig, recording), calibration)
    cameras = content.get("cameras")
    entries = list(cameras.values()) if isinstance(cameras, dict) else []
    if any(isinstance(entry, dict) and "base_from_cam" in entry for entry in entries):
        return RigSource(_with_lenses(read_true_rig(path), recording))
    rig = read_rig_file(path)[1]
    if rig is None:
        raise InputError(
            f"{path} does not say where the cameras sit.",
            remedy="Give the calibration.yaml that `rigwake calibrate` wrote.",
        )
    return RigSource(_with_lenses(rig, recording))


def _with_lenses(rig: Rig, recording: Recording | None) -> Rig:
    if recording is None:
        return rig
    cameras = {}
    for name, camera in rig.cameras.items():
        stream = recording.cameras.get(name)
        model = camera.model or (stream.model if stream is not None else None)
        cameras[name] = replace(camera, model=model)
    return replace(rig, cameras=cameras)


@dataclass(frozen=True)
class FloorPlan:
    """The floor plan that a surround view's homographies were made for: its size, and the depth of the strips seen
    ahead and astern, and at the sides, all in its pixels; metres_per_px."""

    width_px: int
    height_px: int
    end_depth_px: int
    side_depth_px: int
    metres_per_px: float = 0.01


def rig_from_homographies(folder: Path, plan: FloorPlan) -> Rig:
    """A rig from the OpenCV files of a four-camera surround view: `front`, `back`, `left`, `right`.

    `project_matrix` maps pixels of the undistorted picture (`cv2.fisheye`, new camera matrix from `scale_xy` and
    `shift_xy`) to the strip of the floor plan beside its camera, as this camera sees it. A pose is fitted to it over
    the strip. The rig frame lies on the floor, in the middle of the plan; x points to its top, y to its left, z up.
    Raises InputError if a file lacks an entry.
    """
    width, height = plan.width_px, plan.height_px
    quarter = np.array([[0.0, 1, 0], [-1, 0, 0], [0, 0, 1]])
    plan_from_strip = {
        "front": SE3.identity(),
        "back": SE3(quarter @ quarter, np.array([width - 1.0, height - 1.0, 0])),
        "left": SE3(quarter, np.array([0.0, height - 1.0, 0])),
        "right": SE3(quarter.T, np.array([width - 1.0, 0.0, 0])),
    }
    # plan: x right, y down, z into the floor
    turn = np.array([[0.0, -1, 0], [-1, 0, 0], [0, 0, -1]])
    rig_from_plan = SE3(turn, -turn @ np.array([(width - 1) / 2, (height - 1) / 2, 0.0]))
    cameras = {}
    for name, from_strip in plan_from_strip.items():
        at_end = name in ("front", "back")
        strip = (width, plan.end_depth_px) if at_end else (height, plan.side_depth_px)
        model, strip_from_pixel, K = _opencv_file(folder / f"{name}.yaml")
        place = rig_from_plan * from_strip * plan_from_homography(model, strip_from_pixel, K, strip)
        cameras[name] = RigCamera(name, SE3(place.rotation, place.translation * plan.metres_per_px), model)
    return Rig("floor", cameras)


def _opencv_file(path: Path) -> tuple[CameraModel, Array, Array]:
    """Lens, homography from undistorted pixels, and the camera matrix of these."""
    if not path.is_file() or path.stat().st_size > _MAX_BYTES:
        raise InputError(f"{path} is not there, or too large for a calibration.")
    try:
        text = read_text_file(path)
        storage = cv2.FileStorage(text, cv2.FILE_STORAGE_READ | cv2.FILE_STORAGE_MEMORY)
        entries = {key: storage.getNode(key).mat() for key in (*_NEEDED, "scale_xy", "shift_xy")}
        storage.release()
    except (cv2.error, SystemError) as error:
        raise InputError(f"{path} cannot be read as an OpenCV file.") from error
    if any(entries[key] is None for key in _NEEDED):
        raise InputError(f"{path.name}: it lacks one of {', '.join(_NEEDED)}.")
    K, H = np.asarray(entries["camera_matrix"], float), np.asarray(entries["project_matrix"], float)
    k = np.zeros(4)
    given = np.asarray(entries["dist_coeffs"], float).ravel()[:4]
    k[: len(given)] = given
    width, height = (int(x) for x in np.asarray(entries["resolution"]).ravel())
    if K.shape != (3, 3) or H.shape != (3, 3) or not np.isfinite([*K.ravel(), *H.ravel(), *k]).all():
        raise InputError(f"{path.name}: camera_matrix and project_matrix must be 3 x 3 and finite.")
    model = camera_from_params("kb4", [K[0, 0], K[1, 1], K[0, 2], K[1, 2], *k], width, height)
    undistorted = K.copy()
    if entries["scale_xy"] is not None:
        undistorted[[0, 1], [0, 1]] *= np.ravel(entries["scale_xy"])
    if entries["shift_xy"] is not None:
        undistorted[:2, 2] += np.ravel(entries["shift_xy"])
    return model, H, undistorted


def plan_from_homography(
    model: CameraModel, plan_from_pixel: Array, K: Array, strip_size: tuple[int, int]
) -> SE3:
    """`plan_from_cam` of a camera whose undistorted pixels a homography maps to a plane z = 0 below it.

    The start is `H^-1 ~ K [r1 r2 t]` (Zhang, PAMI 2000); then the pixels of plan points over the strip (width, depth)
    that is in view are fitted, since a homography that was clicked has no exact pose.
    plan: x right, y down, z away from the camera's side of the plane. K: of the undistorted picture.
    """
    M = np.linalg.inv(K) @ np.linalg.inv(plan_from_pixel)
    M = M / np.sqrt(np.linalg.norm(M[:, 0]) * np.linalg.norm(M[:, 1]))
    starts = []
    for sign in (1.0, -1.0):
        r1, r2, t = (sign * M[:, i] for i in range(3))
        start = SE3(so3.nearest_rotation(np.column_stack([r1, r2, np.cross(r1, r2)])), t).inverse()
        starts += [(sign, start)] if start.translation[2] < 0 else []
    if not starts:
        raise InputError("A homography does not put its camera above the floor.")
    sign, start = starts[0]
    x, y = np.meshgrid(
        np.linspace(0.15, 0.85, 15) * strip_size[0], np.linspace(0.25, 0.95, 9) * strip_size[1]
    )
    points = np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=1)
    rays = sign * (points + np.array([0.0, 0.0, 1.0])) @ M.T
    wanted, visible = model.project(rays)
    unit = np.array([1, 1, 1, *[abs(start.translation[2])] * 3])

    def residuals(step: Array) -> Array:
        pixels, valid = model.project(start.retract(step * unit).inverse() * points[visible])
        return np.where(valid[:, None], pixels - wanted[visible], 100.0).ravel()

    fitted = least_squares(residuals, np.zeros(6), loss="soft_l1")
    return start.retract(fitted.x * unit)
