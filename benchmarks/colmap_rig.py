"""The peer of rig calibration: pycolmap on the images of all cameras, then its rig bundle adjustment.

    python benchmarks/colmap_rig.py RECORDING TRUTH [--rate HZ]

SIFT on the CPU, all pairs of images matched (cameras without common view are tied by what they see at different times),
incremental mapping with the given lenses, the rig taken from the model and adjusted with it, and metres from GNSS by
aligning the reference camera's path. Its fisheye model knows nothing beyond 90 degrees, so images are masked to 88,
and the own hull is masked with what our camera stage has found. Clocks and lever arm are not in its model.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from pathlib import Path

import cv2  # before pycolmap: the other order breaks reading PNG files
import numpy as np
import pycolmap

from colmap_odometry import colmap_camera, write_mask
from rigwake.calibration import CalibratedCamera, Calibration
from rigwake.errors import EstimationError
from rigwake.evaluation.rig_errors import evaluate_calibration
from rigwake.geometry.align import align_points
from rigwake.geometry.se3 import SE3
from rigwake.readers.open import open_recording
from rigwake.readers.truth_files import read_true_rig, rig_in_frame
from rigwake.recording import CameraStream, GnssStream, Recording

NEAR_NS = 60_000_000


def write_images(stream: CameraStream, ticks_ns: np.ndarray, folder: Path) -> list[str]:
    """The frames nearest to the ticks, named by tick: images of one tick form a rig frame."""
    (folder / stream.name).mkdir(parents=True)
    nearest = np.abs(stream.timestamps_ns[:, None] - ticks_ns).argmin(axis=0)
    near = np.abs(stream.timestamps_ns[nearest] - ticks_ns) < NEAR_NS
    name_of = {int(nearest[k]): f"{stream.name}/{k:05d}.png" for k in np.flatnonzero(near)}
    for frame in stream.frames(np.array(sorted(name_of))):
        cv2.imwrite(str(folder / name_of[frame.index]), frame.image)
    return list(name_of.values())


def reconstruct(recording: Recording, ticks_ns: np.ndarray, folder: Path) -> pycolmap.Reconstruction:
    """The largest model, with a rig that has been adjusted."""
    images, database = folder / "images", folder / "database.db"
    for name, stream in recording.cameras.items():
        names = write_images(stream, ticks_ns, images)
        write_mask(stream, folder / f"{name}.png")
        model, params = colmap_camera(stream.model)
        pycolmap.extract_features(
            database,
            images,
            image_names=names,
            camera_mode=pycolmap.CameraMode.PER_FOLDER,
            reader_options=pycolmap.ImageReaderOptions(
                camera_model=model, camera_params=params, camera_mask_path=str(folder / f"{name}.png")
            ),
            device=pycolmap.Device.cpu,
        )
    pycolmap.match_exhaustive(database, device=pycolmap.Device.cpu)
    options = pycolmap.IncrementalPipelineOptions(
        ba_refine_focal_length=False, ba_refine_extra_params=False, multiple_models=False
    )
    models = pycolmap.incremental_mapping(database, images, folder, options)
    model = max(models.values(), key=lambda m: m.num_reg_images(), default=None)
    if model is None:
        raise EstimationError("pycolmap found no model.")
    seen = {image.name.split("/")[0] for image in model.images.values() if image.has_pose}
    missing = set(recording.cameras) - seen
    if missing:
        raise EstimationError(f"pycolmap's largest model holds no image of {', '.join(sorted(missing))}.")
    first, *others = recording.cameras
    rig = pycolmap.RigConfig(
        cameras=[
            pycolmap.RigConfigCamera(ref_sensor=name == first, image_prefix=f"{name}/")
            for name in (first, *others)
        ]
    )
    with pycolmap.Database.open(database) as opened:
        pycolmap.apply_rig_config([rig], opened, model)
    adjustment = pycolmap.BundleAdjustmentOptions(refine_focal_length=False, refine_extra_params=False)
    adjustment.refine_sensor_from_rig = True
    pycolmap.bundle_adjustment(model, adjustment)
    return model


def rig_of(model: pycolmap.Reconstruction, recording: Recording, ticks_ns: np.ndarray) -> Calibration:
    """Cameras in the frame of the first one, metres by GNSS."""
    first = next(iter(recording.cameras))
    gnss = next(iter(recording.gnss.values()))
    cam_from_world = {image.name: image.cam_from_world() for image in model.images.values() if image.has_pose}
    own = {name: pose for name, pose in cam_from_world.items() if name.startswith(f"{first}/")}
    centres = np.array([pose.inverse().translation for pose in own.values()])
    stamps = ticks_ns[[int(Path(name).stem) for name in own]]
    scale = align_points(centres, positions_at(gnss, stamps), "sim3").scale
    cameras = {}
    for name in recording.cameras:
        ticks = [n.split("/")[1] for n in cam_from_world if n.startswith(f"{name}/")]
        both = next(t for t in ticks if f"{first}/{t}" in cam_from_world)  # the rig is one: any tick will do
        pose = cam_from_world[f"{first}/{both}"] * cam_from_world[f"{name}/{both}"].inverse()
        matrix = pose.matrix()
        cameras[name] = CalibratedCamera(
            name, SE3(matrix[:, :3], scale * matrix[:, 3]), np.full((6, 6), np.inf)
        )
    return Calibration(first, cameras)


def positions_at(gnss: GnssStream, stamps: np.ndarray) -> np.ndarray:
    times = (gnss.timestamps_ns - stamps[0]) * 1e-9
    wanted = (stamps - stamps[0]) * 1e-9
    return np.stack([np.interp(wanted, times, axis) for axis in gnss.position_enu.T], axis=1)


def colmap_rig(recording: Path, rate_hz: float) -> Calibration:
    opened = open_recording(recording)
    stamps = next(iter(opened.cameras.values())).timestamps_ns
    ticks_ns = np.arange(stamps[0], stamps[-1], round(1e9 / rate_hz))
    with tempfile.TemporaryDirectory() as folder:
        return rig_of(reconstruct(opened, ticks_ns, Path(folder)), opened, ticks_ns)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("recording", type=Path)
    parser.add_argument("truth", type=Path)
    parser.add_argument("--rate", type=float, default=1.0, help="images per camera and second")
    asked = parser.parse_args()
    wall, cpu = time.perf_counter(), time.process_time()
    found = colmap_rig(asked.recording, asked.rate)
    wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
    errors = evaluate_calibration(found, rig_in_frame(read_true_rig(asked.truth), found.reference))
    for pair in errors.pairs:
        print(
            f"{pair.first}-{pair.second}: {pair.rotation_error_deg:.3f} deg, {100 * pair.translation_error_m:.1f} cm"
        )
    print(f"{asked.rate:g} Hz: {cpu:.0f} CPU s, {wall:.0f} s")


if __name__ == "__main__":
    main()
