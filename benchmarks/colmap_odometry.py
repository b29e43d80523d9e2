"""The peer of one camera's odometry: pycolmap on the same frames, incremental and global (GLOMAP).

SIFT on the CPU, sequential matching, focal length held. Features and matches are made once for all mappers, and
counted into the CPU seconds of each. Its fisheye model knows nothing beyond 90 degrees, so images of such lenses are
masked to 88; the own hull is masked with what our camera stage has found.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2  # before pycolmap: the other order breaks reading PNG files
import numpy as np
import pycolmap

from rigwake.cameras.protocol import CameraModel
from rigwake.geometry.se3 import SE3
from rigwake.recording import CameraStream
from rigwake.tracking.masks import lens_mask, pixel_grid
from rigwake.tracking.self_mask import find_self_mask
from rigwake.trajectory import Trajectory

pycolmap.logging.minloglevel = pycolmap.logging.ERROR.value
WIDEST_DEG = 88.0
MAX_FEATURES = 2000  # per image
MIN_PLACED = 10  # frames, under which a model is counted as none


@dataclass(frozen=True)
class Mapping:
    """What one mapper found: None where it found no model. CPU seconds with features and matches."""

    method: str
    trajectory: Trajectory | None
    cpu_s: float


def colmap_camera(model: CameraModel) -> tuple[str, str]:
    """COLMAP's name of the lens and its parameters; its first pixel has its centre at one half."""
    values = dict(zip(model.param_names, model.params, strict=True))
    extra = ("k1", "k2", "k3", "k4") if model.model == "kb4" else ("k1", "k2", "p1", "p2")
    shift = {"cx": 0.5, "cy": 0.5}
    names = ("fx", "fy", "cx", "cy", *extra)
    params = ",".join(str(values[n] + shift.get(n, 0.0)) for n in names)
    return "OPENCV_FISHEYE" if model.model == "kb4" else "OPENCV", params


def write_mask(stream: CameraStream, path: Path) -> None:
    """Black beyond 88 degrees, beyond the lens and on the own hull."""
    usable = lens_mask(stream).usable
    usable &= ~find_self_mask(stream, usable)
    bearings, _ = stream.model.unproject(pixel_grid(stream.width_px, stream.height_px))
    usable &= (bearings[:, 2] > np.cos(np.deg2rad(WIDEST_DEG))).reshape(usable.shape)
    cv2.imwrite(str(path), usable.astype(np.uint8) * 255)


def map_camera(stream: CameraStream, indices: np.ndarray, refine: tuple[bool, ...]) -> Iterator[Mapping]:
    """Paths of the frames `indices` by both mappers, one after the other; refine: the distortion, too, or not."""
    with tempfile.TemporaryDirectory() as folder:
        started = time.process_time()
        _match(stream, indices, Path(folder))
        before_s = time.process_time() - started
        for mapper in ("incremental", "global"):
            for refined in refine:
                started = time.process_time()
                models = _MAPPERS[mapper](Path(folder), refined)
                cpu_s = before_s + time.process_time() - started
                best = max(models.values(), key=lambda m: m.num_reg_images(), default=None)
                lens = "distortion refined" if refined else "lens as given"
                found = _trajectory(best, stream) if best and best.num_reg_images() >= MIN_PLACED else None
                yield Mapping(f"pycolmap {mapper}, {lens}", found, cpu_s)


def _match(stream: CameraStream, indices: np.ndarray, folder: Path) -> None:
    """Images, features and verified matches of the frames, in `folder`."""
    images, database = folder / "images", folder / "database.db"
    images.mkdir()
    for frame in stream.frames(indices):
        cv2.imwrite(str(images / f"{frame.index:06d}.png"), frame.image)
    model, params = colmap_camera(stream.model)
    reader = pycolmap.ImageReaderOptions(camera_model=model, camera_params=params)
    if model == "OPENCV_FISHEYE":
        write_mask(stream, folder / "mask.png")
        reader.camera_mask_path = str(folder / "mask.png")
    pycolmap.extract_features(
        database,
        images,
        camera_mode=pycolmap.CameraMode.SINGLE,
        reader_options=reader,
        extraction_options={"sift": {"max_num_features": MAX_FEATURES}},
        device=pycolmap.Device.cpu,
    )
    pycolmap.match_sequential(database, device=pycolmap.Device.cpu)


def _incremental(folder: Path, refine: bool) -> dict[int, pycolmap.Reconstruction]:
    options = pycolmap.IncrementalPipelineOptions(
        ba_refine_focal_length=False, ba_refine_extra_params=refine, extract_colors=False, random_seed=0
    )
    return pycolmap.incremental_mapping(folder / "database.db", folder / "images", folder, options)


def _global(folder: Path, refine: bool) -> dict[int, pycolmap.Reconstruction]:
    options = pycolmap.GlobalPipelineOptions(random_seed=0)
    options.mapper.global_positioning.use_gpu = options.mapper.bundle_adjustment.ceres.use_gpu = False
    options.mapper.bundle_adjustment.refine_focal_length = False
    options.mapper.bundle_adjustment.refine_extra_params = refine
    return pycolmap.global_mapping(folder / "database.db", folder / "images", folder, options)


_MAPPERS = {"incremental": _incremental, "global": _global}


def _trajectory(model: pycolmap.Reconstruction, stream: CameraStream) -> Trajectory:
    """The frames that were placed, up to one scale."""
    placed = sorted((int(Path(i.name).stem), i.cam_from_world()) for i in model.images.values() if i.has_pose)
    cam_from_world = SE3.from_matrix(np.stack([pose.matrix() for _, pose in placed]))
    stamps = stream.timestamps_ns[[index for index, _ in placed]]
    return Trajectory(stream.name, stamps, cam_from_world.inverse(), is_metric=False)
