"""Cut a real recording of one camera into virtual cameras that look apart: a rig without overlap, known exactly.

    python benchmarks/semi_real.py RECORDING -o OUT [--camera NAME] [--lens pinhole|kb4] [--views 2] [--frames N]
    rigwake calibrate OUT -o RESULT
    rigwake evaluate RESULT/calibration.yaml --truth OUT/truth.yaml

Light, blur, noise, compression, motion and lens are real; between the virtual cameras lie a pure turn about the
camera's vertical axis, and 0 mm. IMU and GNSS come along. Where there is no GNSS but the camera's true trajectory, GNSS
is made from it (`--antenna`, `--gnss-std`). What the lens of the recording is wrong by, the virtual lenses are too.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import cv2
import numpy as np
import yaml
from numpy.typing import NDArray

from rigwake._types import Array
from rigwake.cameras.models.kannala_brandt import KannalaBrandt4
from rigwake.cameras.models.pinhole import Pinhole
from rigwake.cameras.protocol import CameraModel
from rigwake.errors import RigwakeError, UsageError
from rigwake.geometry import so3
from rigwake.geometry.se3 import SE3
from rigwake.readers.open import open_recording
from rigwake.recording import CameraStream, Frame, FrameSource, GnssStream, Recording
from rigwake.tracking.masks import pixel_grid
from rigwake.trajectory import Trajectory
from rigwake.writers.write import write_recording

GAP = np.deg2rad(1.0)
"""Between the edges of neighbouring views, so that no point can be seen by two."""

ORIGIN_LLA = (49.0, 8.4, 110.0)


@dataclass(frozen=True)
class VirtualView:
    """A virtual camera: its lens, and how it is turned, `cam_from_view` (3, 3), in the real one."""

    name: str
    model: CameraModel
    cam_from_view: Array


@dataclass(frozen=True, eq=False)
class CutFrames:
    """The frames of a virtual camera, cut from those of a real one."""

    source: FrameSource
    column: NDArray[np.float32]
    row: NDArray[np.float32]
    start: int = 0

    def frames(self, indices: Sequence[int] | NDArray[np.int64], *, colour: bool = False) -> Iterator[Frame]:
        for frame in self.source.frames(np.asarray(indices) + self.start, colour=colour):
            image = cv2.remap(frame.image, self.column, self.row, cv2.INTER_CUBIC, borderValue=(0, 0, 0))
            yield Frame(frame.index - self.start, frame.timestamp_ns, np.asarray(image, np.uint8))


@dataclass(frozen=True)
class Cut:
    """How to cut. views: how many, side by side. lens: of the virtual cameras, `pinhole` or `kb4` (equidistant)."""

    views: int = 2
    lens: str = "pinhole"
    names: tuple[str, ...] = field(default=("left", "right", "third", "fourth"))


def half_angles(model: CameraModel) -> tuple[float, float]:
    """How far the picture reaches to both sides and up and down, the smaller of each (radians)."""
    middle_x, middle_y = (model.width_px - 1) / 2, (model.height_px - 1) / 2
    edges = np.array(
        [[0, middle_y], [model.width_px - 1, middle_y], [middle_x, 0], [middle_x, model.height_px - 1]]
    )
    bearings, valid = model.unproject(edges)
    angles = np.where(valid, np.arccos(np.clip(bearings[:, 2], -1, 1)), model.max_angle)
    return float(angles[:2].min()), float(angles[2:].min())


def focal_px(model: CameraModel) -> float:
    """Pixels per radian on the axis."""
    pixels, _ = model.project(np.array([[0.0, 0, 1], [1e-3, 0, 1]]))
    return float(np.linalg.norm(pixels[1] - pixels[0]) / 1e-3)


def virtual_views(model: CameraModel, cut: Cut) -> list[VirtualView]:
    """The widest views side by side that the picture fills and that do not meet. UsageError if there is no room."""
    across, _ = half_angles(model)
    each = across / cut.views
    half_width = each - GAP / 2
    if half_width < np.deg2rad(4.0) or not 2 <= cut.views <= len(cut.names):
        raise UsageError(
            f"{cut.views} views of {np.rad2deg(2 * half_width):.0f} deg do not make a rig.",
            remedy="Cut 2 to 4 views of at least 8 deg.",
        )
    views = []
    for k in range(cut.views):
        yaw = (2 * k + 1 - cut.views) * each
        turned = so3.exp(np.array([0.0, yaw, 0.0]))
        views.append(VirtualView(cut.names[k], _lens(model, cut.lens, half_width, turned), turned))
    height = min(view.model.height_px for view in views)
    return [replace(view, model=_of_height(view.model, height)) for view in views]


def _lens(model: CameraModel, lens: str, half_width: float, cam_from_view: Array) -> CameraModel:
    """The tallest lens of that width whose every pixel the real picture shows, with its resolution on the axis."""
    focal = focal_px(model)
    reach = focal * (np.tan(half_width) if lens == "pinhole" else half_width)
    if lens not in ("pinhole", "kb4") or (lens == "pinhole" and half_width > np.deg2rad(75)):
        raise UsageError(
            f"No {lens} of {np.rad2deg(2 * half_width):.0f} deg.", remedy="Choose --lens kb4 for wide views."
        )
    width = 2 * int(reach)
    tallest = model.height_px if lens == "pinhole" else min(width, model.height_px)  # a circle is no taller
    for height in range(tallest - tallest % 2, 15, -2):
        centre = ((width - 1) / 2, (height - 1) / 2)
        if lens == "pinhole":
            made: CameraModel = Pinhole((focal, focal, *centre, *(6 * (0.0,))), width, height)
        else:
            made = KannalaBrandt4(
                (focal, focal, *centre, *(4 * (0.0,))), width, height, angle_limit=half_width
            )
        if _shown(model, made, cam_from_view):
            return made
    raise UsageError("The picture is too low to be cut.", remedy="Cut fewer views.")


def _of_height(model: CameraModel, height: int) -> CameraModel:
    params = model.params.copy()
    params[3] = (height - 1) / 2
    return replace(model.with_params(params), height_px=height)  # type: ignore[type-var]


def _shown(model: CameraModel, view: CameraModel, cam_from_view: Array) -> bool:
    """Whether the real picture shows the rim of the view's field."""
    right, bottom = view.width_px - 1.0, view.height_px - 1.0
    x, y = np.linspace(0, right, 41), np.linspace(0, bottom, 41)
    sides = ((x, 0), (x, bottom), (0, y), (right, y))
    rim = np.concatenate([np.stack(np.broadcast_arrays(*side), axis=1) for side in sides])
    bearings, seen = view.unproject(rim)
    pixels, valid = model.project(bearings[seen] @ cam_from_view.T)
    inside = (pixels >= 0).all(axis=1) & (pixels <= [model.width_px - 1, model.height_px - 1]).all(axis=1)
    return bool((valid & inside).all() and seen.any())


def cut_stream(stream: CameraStream, view: VirtualView, start: int, count: int) -> CameraStream:
    """The virtual camera's frames, `count` of them from `start` on."""
    assert stream.model is not None
    shape = (view.model.height_px, view.model.width_px)
    bearings, valid = view.model.unproject(pixel_grid(shape[1], shape[0]))
    pixels, there = stream.model.project(np.nan_to_num(bearings) @ view.cam_from_view.T)
    pixels = np.where((valid & there)[:, None], pixels, -1e4).astype(np.float32)
    column, row = (np.ascontiguousarray(pixels[:, i].reshape(shape)) for i in range(2))
    stamps = stream.timestamps_ns[start : start + count]
    source = CutFrames(stream.source, column, row, start)
    return CameraStream(view.name, stamps, source, shape[1], shape[0], view.model)


def made_gnss(truth: Trajectory, antenna: Array, std: float) -> GnssStream:
    """GNSS with white noise of `std` metres (half as much again upwards), from a true trajectory whose world is its
    first camera: that one's x, z and -y are taken for east, north and up."""
    enu_from_world = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
    stds = std * np.array([1.0, 1.0, 1.5])
    position = (truth.world_from_body * antenna) @ enu_from_world.T
    position += np.random.default_rng(0).normal(size=position.shape) * stds
    spread = np.tile(np.diag(stds**2), (len(position), 1, 1))
    return GnssStream("gnss", truth.timestamps_ns, position, spread, ORIGIN_LLA)


def cut_recording(
    recording: Recording,
    camera: str,
    cut: Cut,
    *,
    frames: tuple[int, int] | None = None,
    antenna: Array,
    gnss_std: float = 0.02,
) -> tuple[Recording, dict[str, object]]:
    """The rig of virtual cameras as a recording without its truth, and the truth as `truth.yaml` holds it."""
    stream = recording.camera(camera)
    if stream.model is None:
        raise UsageError(
            f"camera {camera} has no intrinsics.", remedy="Give the recording a rig.yaml with a lens."
        )
    start, count = frames or (0, len(stream))
    views = virtual_views(stream.model, cut)
    cameras = {view.name: cut_stream(stream, view, start, count) for view in views}
    gnss = dict(recording.gnss)
    truth = recording.true_trajectories.get(camera)
    made = not gnss and truth is not None
    if made and truth is not None:
        stamps = stream.timestamps_ns[start : start + count]
        gnss["gnss"] = made_gnss(truth.between(int(stamps[0]), int(stamps[-1])), antenna, gnss_std)
    known = recording.true_rig
    first_from_real = SE3(views[0].cam_from_view.T, np.zeros(3))
    content: dict[str, object] = {
        "cameras": {
            view.name: {"base_from_cam": _transform(first_from_real * SE3(view.cam_from_view, np.zeros(3)))}
            for view in views
        }
    }
    if made:
        content["gnss"] = {"antenna_lever_arm_base_m": (first_from_real * antenna[None])[0].tolist()}
    if known is not None and known.rig_from_imu is not None and camera in known.cameras:
        cam_from_imu = known.cameras[camera].rig_from_cam.inverse() * known.rig_from_imu
        content["imu"] = {"base_from_imu": _transform(first_from_real * cam_from_imu)}
    rig = Recording(recording.path, "semi-real", cameras, imus=recording.imus, gnss=gnss)
    return rig, content


def _transform(a_from_b: SE3) -> dict[str, list[float]]:
    return {"quat_wxyz": a_from_b.quat_wxyz.tolist(), "translation_m": a_from_b.translation.tolist()}


def write_cut(recording: Recording, truth: dict[str, object], out: Path) -> None:
    """A folder recording, and `truth.yaml` in it for `rigwake evaluate`."""
    write_recording(recording, out, file_format="folder", image_encoding="png")
    text = "# exact: all cameras are cut from one; base is the first of them\n"
    (out / "truth.yaml").write_text(text + yaml.safe_dump(truth, sort_keys=False, default_flow_style=None))


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("recording", type=Path)
    parser.add_argument("-o", "--out", type=Path, required=True)
    parser.add_argument("--camera", help="which camera to cut (the first by default)")
    parser.add_argument("--views", type=int, default=2)
    parser.add_argument("--lens", choices=("pinhole", "kb4"), default="pinhole")
    parser.add_argument("--frames", type=int, nargs=2, metavar=("START", "COUNT"))
    parser.add_argument(
        "--antenna", type=float, nargs=3, default=(0.3, -0.5, -1.0), help="in the real camera, m"
    )
    parser.add_argument("--gnss-std", type=float, default=0.02)
    asked = parser.parse_args()
    try:
        recording = open_recording(asked.recording)
        camera = asked.camera or next(iter(recording.cameras))
        made, truth = cut_recording(
            recording, camera, Cut(asked.views, asked.lens),
            frames=tuple(asked.frames) if asked.frames else None,
            antenna=np.array(asked.antenna), gnss_std=asked.gnss_std,
        )  # fmt: skip
        write_cut(made, truth, asked.out)
    except RigwakeError as error:
        raise SystemExit(str(error)) from error
    for stream in made.cameras.values():
        print(f"{stream.name}: {len(stream)} frames of {stream.width_px} x {stream.height_px}")
    print(f"rigwake calibrate {asked.out} -o RESULT")
    print(f"rigwake evaluate RESULT/calibration.yaml --truth {asked.out / 'truth.yaml'}")


if __name__ == "__main__":
    main()
