"""Images with exact truth for the tracker: a fisheye inside a cylinder of random texture."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cache

import cv2
import numpy as np
from numpy.typing import NDArray

from rigwake._types import Array
from rigwake.cameras.models.kannala_brandt import KannalaBrandt4
from rigwake.cameras.protocol import CameraModel
from rigwake.geometry import so3
from rigwake.geometry.se3 import SE3
from rigwake.recording import CameraStream, Frame
from rigwake.tracking.masks import pixel_grid

RADIUS = 20.0
_TEXTURE = (1024, 6144)  # rows over 40 m of height, columns once around


def fisheye(width_px: int = 320, height_px: int = 240) -> KannalaBrandt4:
    scale = width_px / 640
    params = np.array([200, 200, 320, 240, -0.0115, 0.0062, -0.0034, 0.0005])
    params[:4] *= scale
    return KannalaBrandt4(tuple(params), width_px, height_px, angle_limit=np.deg2rad(92.0))


@cache
def random_texture(seed: int) -> NDArray[np.float32]:
    """Detail on several scales, cyclic from left to right."""
    rng = np.random.default_rng(seed)
    texture = np.zeros(_TEXTURE, np.float32)
    for scale, weight in ((6, 1.0), (12, 1.0), (30, 1.0), (90, 0.7)):
        small = rng.normal(size=(_TEXTURE[0] // scale, _TEXTURE[1] // scale)).astype(np.float32)
        small = np.concatenate([small[:, -4:], small, small[:, :4]], axis=1)
        large = cv2.resize(small, (_TEXTURE[1] + 8 * scale, _TEXTURE[0]), interpolation=cv2.INTER_CUBIC)
        texture += weight * large[:, 4 * scale : 4 * scale + _TEXTURE[1]]
    return np.clip(110 + 30 * texture, 5, 250).astype(np.float32)


def wall_points(world_from_cam: SE3, bearings_cam: Array) -> Array:
    """Where rays (N, 3) meet the cylinder: (N, 3)."""
    ray, origin = bearings_cam @ world_from_cam.rotation.T, world_from_cam.translation
    a = ray[:, 0] ** 2 + ray[:, 1] ** 2
    b = ray[:, :2] @ origin[:2]
    c = origin[0] ** 2 + origin[1] ** 2 - RADIUS**2
    return origin + ray * ((-b + np.sqrt(b * b - a * c)) / a)[:, None]


@dataclass(frozen=True)
class Pictures:
    """Images in memory as a source of frames, 10 Hz."""

    images: Sequence[NDArray[np.uint8]]

    def frames(self, indices: Sequence[int] | NDArray[np.int64], *, colour: bool = False) -> Iterator[Frame]:
        for index in indices:
            yield Frame(int(index), int(index) * 100_000_000, self.images[index])


def stream_of(images: Sequence[NDArray[np.uint8]], model: CameraModel | None = None) -> CameraStream:
    height, width = images[0].shape
    return CameraStream("front", np.arange(len(images)) * 100_000_000, Pictures(images), width, height, model)


@cache
def _rays(model: CameraModel, fine: int) -> tuple[Array, NDArray[np.bool_]]:
    """Bearings and validity of `fine` x `fine` rays per pixel."""
    grid = pixel_grid(model.width_px * fine, model.height_px * fine)
    return model.unproject((grid + 0.5) / fine - 0.5)


@dataclass(frozen=True)
class CylinderScene:
    """A stream of rendered images: (F,) poses, gain per frame, vignetting and noise."""

    model: CameraModel
    world_from_cam: SE3
    texture: NDArray[np.float32]
    gains: Array
    vignetting: float = 0.0
    noise_std: float = 1.0
    black: tuple[int, ...] = ()
    repeated: tuple[int, ...] = ()

    def frames(self, indices: Sequence[int] | NDArray[np.int64], *, colour: bool = False) -> Iterator[Frame]:
        for index in indices:
            yield Frame(int(index), int(index) * 100_000_000, self.image(int(index)))

    def image(self, index: int) -> NDArray[np.uint8]:
        if index in self.repeated:
            return self.image(index - 1)
        width, height = self.model.width_px, self.model.height_px
        if index in self.black:
            return np.zeros((height, width), np.uint8)
        fine = 2  # rays per pixel and axis
        bearings, valid = _rays(self.model, fine)
        points = wall_points(self.world_from_cam[index], np.nan_to_num(bearings, nan=0.5))
        column = np.arctan2(points[:, 1], points[:, 0]) / (2 * np.pi) * _TEXTURE[1] % _TEXTURE[1]
        row = np.clip((points[:, 2] + 20) / 40, 0, 1) * (_TEXTURE[0] - 1)
        shape = (height * fine, width * fine)
        cyclic = np.concatenate([self.texture, self.texture[:, :2]], axis=1)
        shade = cv2.remap(
            cyclic,
            column.reshape(shape).astype(np.float32),
            row.reshape(shape).astype(np.float32),
            cv2.INTER_LINEAR,
        ) * (self.gains[index] * valid.reshape(shape))
        image = cv2.GaussianBlur(shade, (0, 0), 0.6 * fine)
        image = cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA)
        centre = np.array([width / 2, height / 2])
        distance = np.linalg.norm(pixel_grid(width, height) - centre, axis=1).reshape(height, width)
        image *= 1 - self.vignetting * (distance / centre[0]) ** 2
        image += np.random.default_rng(index).normal(0, self.noise_std, image.shape)
        return np.clip(np.rint(image), 0, 255).astype(np.uint8)

    def stream(self) -> CameraStream:
        images = [self.image(k) for k in range(len(self.gains))]
        return stream_of(images, self.model)


def turning_scene(frames: int, *, seed: int = 0, yaw_deg: float = 1.2, **kwargs: object) -> CylinderScene:
    """A camera that yaws, rolls and sways inside the cylinder; 10 Hz."""
    t = np.arange(frames)
    upright = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])  # world_from_cam: looks along x, y down is -z
    yaw = so3.exp(np.stack([0 * t, 0 * t, np.deg2rad(yaw_deg) * t], axis=1))
    roll = so3.exp(np.stack([0 * t, 0 * t, 0.05 * np.sin(t / 5)], axis=1))
    positions = np.stack([0.18 * t, 2 * np.sin(t / 20), 0.2 * np.sin(t / 6)], axis=1)
    settings: dict[str, object] = {"gains": np.ones(frames), "vignetting": 0.0, **kwargs}
    return CylinderScene(  # type: ignore[arg-type]
        fisheye(), SE3(yaw @ upright @ roll, positions), random_texture(seed), **settings
    )
