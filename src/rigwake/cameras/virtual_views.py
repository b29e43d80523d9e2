"""Virtual views of a lens: tables for `cv2.remap`, with masks.

A view is anything that tells the ray of each of its pixels: a `CameraModel` (pinhole or other), a `Cylinder`
or an `Equirectangular` panorama, turned against the real camera by a rotation `cam_from_view`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from rigwake._types import Array, Mask
from rigwake.cameras.models.lens import axis_focal_px
from rigwake.cameras.models.pinhole import Pinhole
from rigwake.cameras.protocol import CameraModel
from rigwake.errors import CameraError

_ONE_VIEW_ANGLE = np.deg2rad(50.0)  # one pinhole view reaches this far without wasting pixels at its rim
_FIVE_FACES_ANGLE = np.arccos(-1 / np.sqrt(3))  # to the corners of a cube without its back face


class ViewGeometry(Protocol):
    """What a remap table needs of its target."""

    @property
    def width_px(self) -> int:
        """Image width."""

    @property
    def height_px(self) -> int:
        """Image height."""

    def project(self, points_cam: Array) -> tuple[Array, Mask]:
        """Pixels (N, 2) and validity (N,) of points (N, 3)."""

    def unproject(self, pixels: Array) -> tuple[Array, Mask]:
        """Unit bearings (N, 3) and validity (N,) of pixels (N, 2)."""


@dataclass(frozen=True)
class Equirectangular:
    """A panorama linear in longitude and latitude, centred on the z axis; y (down) is its pole.

    `longitude = atan2(x, z)`, `latitude = asin(y)`, `u = width (longitude / horizontal_fov + 1/2) - 1/2`, and v
    alike: the image's edges, not its outer pixel centres, lie at half the field of view (radians).
    """

    width_px: int
    height_px: int
    horizontal_fov: float = 2 * np.pi
    vertical_fov: float = np.pi

    def unproject(self, pixels: Array) -> tuple[Array, Mask]:
        """Unit bearings (N, 3) of pixels (N, 2); all are valid whose angles exist."""
        longitude = ((pixels[:, 0] + 0.5) / self.width_px - 0.5) * self.horizontal_fov
        latitude = ((pixels[:, 1] + 0.5) / self.height_px - 0.5) * self.vertical_fov
        level = np.cos(latitude)
        rays = np.stack([level * np.sin(longitude), np.sin(latitude), level * np.cos(longitude)], axis=-1)
        return rays, (np.abs(longitude) <= np.pi) & (np.abs(latitude) <= np.pi / 2)

    def project(self, points_cam: Array) -> tuple[Array, Mask]:
        """Pixels (N, 2) of points (N, 3); the poles and the origin are not valid."""
        x, y, z = np.asarray(points_cam, dtype=np.float64).T
        level = np.hypot(x, z)
        u = self.width_px * (np.arctan2(x, z) / self.horizontal_fov + 0.5) - 0.5
        v = self.height_px * (np.arctan2(y, level) / self.vertical_fov + 0.5) - 0.5
        return np.stack([u, v], axis=-1), level > 0


@dataclass(frozen=True)
class Cylinder:
    """A panorama on a cylinder about the y axis: upright things stay straight.

    `u = width (longitude / horizontal_fov + 1/2) - 1/2`, `v = f y / hypot(x, z) + (height - 1) / 2` with
    `f = width / horizontal_fov` pixels per radian, so that the centre is not stretched.
    """

    width_px: int
    height_px: int
    horizontal_fov: float

    @property
    def focal_px(self) -> float:
        """Pixels per radian of longitude, and the focal length of the vertical."""
        return self.width_px / self.horizontal_fov

    def unproject(self, pixels: Array) -> tuple[Array, Mask]:
        """Unit bearings (N, 3) of pixels (N, 2)."""
        longitude = ((pixels[:, 0] + 0.5) / self.width_px - 0.5) * self.horizontal_fov
        y = (pixels[:, 1] - (self.height_px - 1) / 2) / self.focal_px
        rays = np.stack([np.sin(longitude), y, np.cos(longitude)], axis=-1)
        return rays / np.hypot(1.0, y)[:, None], np.abs(longitude) <= np.pi

    def project(self, points_cam: Array) -> tuple[Array, Mask]:
        """Pixels (N, 2) of points (N, 3); those on the cylinder's axis are not valid."""
        x, y, z = np.asarray(points_cam, dtype=np.float64).T
        level = np.hypot(x, z)
        valid = level > 0
        u = self.width_px * (np.arctan2(x, z) / self.horizontal_fov + 0.5) - 0.5
        v = self.focal_px * y / np.where(valid, level, 1.0) + (self.height_px - 1) / 2
        return np.stack([u, v], axis=-1), valid


@dataclass(frozen=True, eq=False)
class RemapTable:
    """Where in the camera's image each pixel of a view comes from.

    map_x, map_y: (H, W) float32 for `cv2.remap`, -1 where nothing is seen. mask: (H, W), true where the lens
    sees the view's ray and the pixel lies inside the image.
    """

    map_x: NDArray[np.float32]
    map_y: NDArray[np.float32]
    mask: Mask

    def apply(self, image: NDArray[np.uint8], interpolation: int = cv2.INTER_LINEAR) -> NDArray[np.uint8]:
        """The view of an image (H, W) or (H, W, 3); black where nothing is seen."""
        view = cv2.remap(image, self.map_x, self.map_y, interpolation, borderMode=cv2.BORDER_CONSTANT)
        view[~self.mask] = 0
        return np.asarray(view)


@dataclass(frozen=True, eq=False)
class VirtualView:
    """A virtual camera and how it is turned: `ray_cam = cam_from_view @ ray_view`."""

    view: ViewGeometry
    cam_from_view: Array


def remap_table(camera: CameraModel, view: ViewGeometry, cam_from_view: Array | None = None) -> RemapTable:
    """The table that shows what `view`, turned by the rotation `cam_from_view` (3, 3), would see.

    Rays outside the lens's maximal angle and pixels outside the image are masked, never guessed.
    """
    columns, rows = np.meshgrid(np.arange(view.width_px), np.arange(view.height_px))
    pixels = np.stack([columns, rows], axis=-1).reshape(-1, 2).astype(np.float64)
    rays, seen = view.unproject(pixels)
    if cam_from_view is not None:
        rays = rays @ np.asarray(cam_from_view, dtype=np.float64).T
    source, valid = camera.project(rays)
    source = np.where(np.isfinite(source), source, -1.0)
    inside = (source >= 0).all(axis=1) & (source <= [camera.width_px - 1, camera.height_px - 1]).all(axis=1)
    mask = (seen & valid & inside).reshape(view.height_px, view.width_px)
    maps = np.where(mask[..., None], source.reshape(*mask.shape, 2), -1.0).astype(np.float32)
    return RemapTable(np.ascontiguousarray(maps[..., 0]), np.ascontiguousarray(maps[..., 1]), mask)


def covering_views(
    camera: CameraModel, focal_px: float | None = None, overlap: float = np.deg2rad(2.0)
) -> dict[str, VirtualView]:
    """Pinhole views that together show all that a lens sees, by name (`front`, `left`, ...).

    One view up to 50 degrees off the axis; beyond, the faces of a cube around the camera, each widened by
    `overlap` (radians) on every side and cropped to what the lens sees; the back face only where the lens
    reaches it. focal_px: by default that of the lens at its axis, so that no detail is lost there.
    """
    if focal_px is None:
        focal_px = axis_focal_px(camera)
    if camera.max_angle <= _ONE_VIEW_ANGLE:
        faces, half = {"front": np.eye(3)}, camera.max_angle
    else:
        faces, half = _cube_faces(), np.pi / 4 + overlap
        if camera.max_angle <= _FIVE_FACES_ANGLE:
            del faces["back"]
    views = {}
    for name, cam_from_view in faces.items():
        view = _cropped(camera, focal_px, half, cam_from_view)
        if view is not None:
            views[name] = VirtualView(view, cam_from_view)
    if not views:
        raise CameraError("No ray of this lens falls inside its image: its size or centre is wrong.")
    return views


def _cube_faces() -> dict[str, Array]:
    """Rotations `cam_from_view` of the faces, rows staying level where they can (x right, y down)."""
    columns = {  # the view's x, y and z axes in the camera frame
        "front": ([1, 0, 0], [0, 1, 0], [0, 0, 1]),
        "left": ([0, 0, 1], [0, 1, 0], [-1, 0, 0]),
        "right": ([0, 0, -1], [0, 1, 0], [1, 0, 0]),
        "up": ([1, 0, 0], [0, 0, 1], [0, -1, 0]),
        "down": ([1, 0, 0], [0, 0, -1], [0, 1, 0]),
        "back": ([-1, 0, 0], [0, 1, 0], [0, 0, -1]),
    }
    return {name: np.array(axes, dtype=np.float64).T for name, axes in columns.items()}


def _cropped(camera: CameraModel, focal_px: float, half: float, cam_from_view: Array) -> Pinhole | None:
    """The square pinhole of half-angle `half`, cut to the rectangle of pixels that the camera sees."""
    side = max(2 * int(np.ceil(focal_px * np.tan(half))), 2)
    centre = (side - 1) / 2
    whole = Pinhole((focal_px, focal_px, centre, centre, *[0.0] * 6), side, side)
    mask = remap_table(camera, whole, cam_from_view).mask
    if not mask.any():
        return None
    columns, rows = np.flatnonzero(mask.any(axis=0)), np.flatnonzero(mask.any(axis=1))
    values = (focal_px, focal_px, centre - columns[0], centre - rows[0], *[0.0] * 6)
    return Pinhole(values, int(np.ptp(columns)) + 1, int(np.ptp(rows)) + 1)
