"""CPU time of the surround view against four `cv2.remap` calls in the same minute.

    python benchmarks/surround.py

Four fisheyes of 640 x 480 are drawn into a panorama of 2048 x 1024 (and a top view of 1000 x 1000). The peer is what a
view costs without blending, gains or a new attitude: four fixed-point `cv2.remap` calls over the whole panorama.
Figures are CPU milliseconds of this process and ratios; the last column is frames per second on two quiet cores.
"""

from __future__ import annotations

import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np

sys.path.insert(0, str(Path(__file__).parent.parent / "tests"))

from rigwake.views.colour import ColourModel
from rigwake.views.depth.sweep import swept_points
from rigwake.views.frames import FrameSet
from rigwake.views.projections import EquirectangularView, TopDown
from rigwake.views.strips import level_strip
from rigwake.views.surface import WaterAndShell
from rigwake.views.surround_view import SurroundView
from rigwake.views.video import video_file
from view_scenes import attitude, four_cameras

_ROUNDS = 12


def side_by_side(
    work: Callable[[], object], peer: Callable[[], object], rounds: int = _ROUNDS
) -> tuple[float, float]:
    """Median CPU times of one call each, milliseconds, called in turn."""
    times: dict[int, list[float]] = {0: [], 1: []}
    for at in range(rounds + 1):
        for which, call in enumerate((work, peer)):
            start = time.process_time()
            call()
            if at:  # the first warms up
                times[which].append(time.process_time() - start)
    return 1e3 * float(np.median(times[0])), 1e3 * float(np.median(times[1]))


def main() -> None:
    cv2.setNumThreads(1)
    rig, stand, surface = four_cameras(), attitude(3.0, -2.0), WaterAndShell()
    rng = np.random.default_rng(0)
    noise = rng.integers(0, 255, (4, 480, 640, 3), dtype=np.uint8)
    stack = np.stack([cv2.GaussianBlur(image, (0, 0), 3) for image in noise])
    frames = FrameSet(0, rig.names, stack, {}, np.zeros(4))
    jpegs = [cv2.imencode(".jpg", image)[1] for image in stack]
    projection = EquirectangularView()
    remaps = _remaps(rig, stand, surface, projection)

    def peer() -> None:
        for image, (first, second) in zip(stack, remaps, strict=True):
            cv2.remap(image, first, second, cv2.INTER_LINEAR)

    colour = ColourModel(rng.normal(0, 0.1, (4, 3)), np.array([0.1, -0.4, 0.1]))
    view, coloured = SurroundView(rig, projection), SurroundView(rig, projection, colour=colour)
    top = SurroundView(rig, TopDown())
    out, ground = np.empty((1024, 2048, 3), np.uint8), np.empty((1000, 1000, 3), np.uint8)

    def decode() -> None:
        for jpeg in jpegs:
            cv2.imdecode(jpeg, cv2.IMREAD_COLOR)

    def anew(which: SurroundView, target: np.ndarray) -> None:
        which.picture(frames, attitude(3.0, -2.0), WaterAndShell(), target)

    rows = {
        "panorama, fixed attitude": lambda: view.picture(frames, stand, surface, out),
        "... with gains and vignetting": lambda: coloured.picture(frames, stand, surface, out),
        "panorama, attitude and surface new": lambda: anew(view, out),
        "top view 1000 x 1000, attitude new": lambda: anew(top, ground),
        "decoding four JPEGs": decode,
        "sphere sweep 768 x 216 x 64": lambda: swept_points(frames.images(rig), rig, stand),
        "level strip 900 x 190": lambda: level_strip(frames.images(rig), rig, stand, surface),
    }
    print(f"{'':38}{'CPU ms':>8}{'ratio':>8}{'fps':>7}")
    for name, work in rows.items():
        took, reference = side_by_side(work, peer)
        print(f"{name:38}{took:8.1f}{took / reference:8.2f}{2000 / took:7.0f}")
    with tempfile.TemporaryDirectory() as folder:
        took, reference = side_by_side(_encoder(out, Path(folder)), peer, 4)
    print(
        f"{'H.264 encoding of a panorama':38}{took / 10:8.1f}{took / 10 / reference:8.2f}{20000 / took:7.0f}"
    )
    print(f"{'four cv2.remap, fixed point':38}{reference:8.1f}{1.0:8.2f}")


def _remaps(rig, stand, surface, projection) -> list:  # type: ignore[no-untyped-def]
    u, v = np.meshgrid(np.arange(projection.width_px), np.arange(projection.height_px))
    points = projection.points_level(np.stack([u.ravel(), v.ravel()], axis=1).astype(float), stand, surface)
    maps = []
    for model, cam_from_level in zip(rig.models, rig.cam_from_level(stand.level_from_rig), strict=True):
        pixels, valid = model.project(cam_from_level * points)
        pixels = np.where(valid[:, None], pixels, -10.0).reshape(*u.shape, 2).astype(np.float32)
        maps.append(cv2.convertMaps(pixels[..., 0].copy(), pixels[..., 1].copy(), cv2.CV_16SC2))
    return maps


def _encoder(picture: np.ndarray, folder: Path) -> Callable[[], None]:
    """Encodes ten pictures, the conversion to YUV included."""

    def encode() -> None:
        with video_file(folder / "panorama.mp4", 2048, 1024, 10.0, True) as video:
            for k in range(10):
                video.write(np.roll(picture, 8 * k, axis=1), k * 10**8)

    return encode


if __name__ == "__main__":
    main()
