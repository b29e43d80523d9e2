"""What is drawn over a view: rings of distance, the vessel, the bumper, sectors of missing cameras, captions."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from rigwake._types import Array, Image
from rigwake.calibration import Calibration
from rigwake.views.attitude import LevelAttitude
from rigwake.views.projections import TopDown
from rigwake.views.surface import Surface, WaterAndStixels
from rigwake.views.surround_rig import SurroundRig

_WHITE, _DARK, _RED, _GREEN = (245, 245, 245), (25, 25, 25), (40, 40, 230), (90, 200, 90)
_FONT = cv2.FONT_HERSHEY_SIMPLEX
_SECTORS = 24  # of the bumper
_MARGIN_M = 0.35  # of the drawn outline around the cameras
_HATCH_PX = 14


@dataclass(frozen=True)
class WaterUncertainty:
    """What a distance on the water depends on, as standard deviations: height of the cameras (m), tilt (radians) of
    the whole rig and of a camera in it, height of a camera in the rig (m), waves (m, surface against its mean)."""

    height_std_m: float = 0.0
    tilt_std: float = 0.0
    camera_tilt_std: float = 0.0
    camera_height_std_m: float = 0.0
    wave_std_m: float = 0.0

    def distance_std_m(self, distance_m: float, height_m: float) -> float:
        """Of a point on the water: `d = h / tan(depression)`, so `d/h` per metre of height and `(d^2 + h^2)/h` per
        radian of tilt."""
        vertical = np.hypot(np.hypot(self.height_std_m, self.camera_height_std_m), self.wave_std_m)
        tilt = np.hypot(self.tilt_std, self.camera_tilt_std)
        return float(np.hypot(distance_m / height_m * vertical, (distance_m**2 / height_m + height_m) * tilt))


def water_uncertainty(
    attitude: LevelAttitude, calibration: Calibration | None, wave_std_m: float
) -> WaterUncertainty:
    """The uncertainty of distances on the water: the worst camera's from the calibration, where there is one."""
    tilt, height = 0.0, 0.0
    if calibration is not None:
        for camera in calibration.cameras.values():
            std = np.concatenate([np.deg2rad(camera.std_rotation_deg), camera.std_translation_m])
            tilt = max(tilt, float(np.nan_to_num(np.hypot(std[0], std[1]) / np.sqrt(2))))
            height = max(height, float(np.nan_to_num(std[5])))
    return WaterUncertainty(attitude.height_std_m, attitude.tilt_std, tilt, height, wave_std_m)


def ring_distances(radius_m: float) -> list[float]:
    """Four to six round distances up to a radius."""
    for step in (0.5, 1.0, 2.0, 5.0, 10.0, 20.0, 50.0, 100.0, 200.0, 500.0):
        if radius_m / step <= 6:
            return [step * k for k in range(1, int(radius_m / step) + 1)]
    return [radius_m]


def vessel_outline(
    rig: SurroundRig, attitude: LevelAttitude, size_m: tuple[float, float] | None = None
) -> Array:
    """(N, 2) metres ahead and to port: the hull given by length and width, centred on the viewpoint, or else a hull
    around the cameras."""
    if size_m is not None:
        length, width = size_m
        bow = 0.25 * length
        half = width / 2
        return np.array(
            [[length / 2, 0.0], [length / 2 - bow, half], [-length / 2, half], [-length / 2, -half],
             [length / 2 - bow, -half]]
        )  # fmt: skip
    places = rig.positions_level(attitude.level_from_rig)[:, :2]
    turn = np.linspace(0, 2 * np.pi, 12, endpoint=False)
    circle = _MARGIN_M * np.stack([np.cos(turn), np.sin(turn)], axis=1)
    points = (places[:, None] + circle[None]).reshape(-1, 2).astype(np.float32)
    return np.asarray(cv2.convexHull(points)[:, 0], dtype=np.float64)


def draw_top_view(
    picture: Image,
    view: TopDown,
    rig: SurroundRig,
    attitude: LevelAttitude,
    uncertainty: WaterUncertainty,
    surface: Surface | None = None,
    bumper_m: float = 5.0,
    size_m: tuple[float, float] | None = None,
    fill_vessel: bool = False,
) -> None:
    """Rings with their uncertainty, the bumper and the vessel's outline, drawn into the picture.

    The bumper's segments are red where an obstacle of the surface stands inside, green where not; without obstacles
    in the surface it is not drawn.
    """
    centre = view.pixels(np.zeros((1, 2)))[0]
    for distance in ring_distances(view.radius_m):
        std = uncertainty.distance_std_m(distance, attitude.height_m)
        _ring(picture, centre, distance * view.px_per_m, _WHITE, 1)
        at = (centre + np.array([4.0, 16 - distance * view.px_per_m])).astype(int)
        _text(picture, f"{distance:g} m +-{std:.1f}" if std >= 0.05 else f"{distance:g} m", at)
    if isinstance(surface, WaterAndStixels):
        draw_bumper(picture, view, near_sectors(surface, bumper_m), bumper_m)
    outline = np.round(view.pixels(vessel_outline(rig, attitude, size_m))).astype(np.int32)
    if fill_vessel:
        cv2.fillPoly(picture, [outline], (70, 70, 70), cv2.LINE_AA)
    cv2.polylines(picture, [outline], True, _WHITE, 2, cv2.LINE_AA)
    nose = view.pixels(np.array([[float(vessel_outline(rig, attitude, size_m)[:, 0].max()), 0.0]]))[0]
    tip = np.round(nose + np.array([[0.0, -14], [-7, -2], [7, -2]])).astype(np.int32)
    cv2.fillPoly(picture, [tip], _WHITE, cv2.LINE_AA)


def near_sectors(surface: WaterAndStixels, bumper_m: float) -> NDArray[np.bool_]:
    """(24,) sectors of 15 degrees, from astern clockwise, in which an obstacle stands nearer than `bumper_m`."""
    distance = np.where(np.isnan(surface.distance_m), np.inf, surface.distance_m).min(axis=1)
    azimuth = (np.arange(len(distance)) + 0.5) / len(distance)
    sector = np.floor(azimuth * _SECTORS).astype(int)
    near = np.zeros(_SECTORS, dtype=np.bool_)
    np.logical_or.at(near, sector, distance < bumper_m)
    return near


def draw_bumper(picture: Image, view: TopDown, near: NDArray[np.bool_], bumper_m: float) -> None:
    """A segmented ring around the vessel."""
    centre = tuple(int(x) for x in np.round(view.pixels(np.zeros((1, 2)))[0]))
    radius = round(bumper_m * view.px_per_m)
    width = 360 / _SECTORS
    for k, is_near in enumerate(near):
        start = -180 + k * width - 90  # cv2 counts from the right, clockwise on the picture
        colour, thick = (_RED, 8) if is_near else (_GREEN, 2)
        cv2.ellipse(
            picture, centre, (radius, radius), 0, start + 1, start + width - 1, colour, thick, cv2.LINE_AA
        )


def hatch_missing(
    picture: Image, sectors: NDArray[np.int8], names: Sequence[str], missing: Mapping[str, str]
) -> None:
    """Hatch what a missing camera would have shown, and write its name and the reason there.

    sectors: (H, W) index of the missing camera, -1 elsewhere.
    """
    lost = sectors >= 0
    if not lost.any():
        return
    rows, columns = np.arange(sectors.shape[0])[:, None], np.arange(sectors.shape[1])[None, :]
    lines = ((rows + columns) % _HATCH_PX) < 2
    picture[lost] = (0.6 * picture[lost] + 20).astype(np.uint8)
    picture[lost & lines] = (60, 150, 230)
    for index in np.unique(sectors[lost]).tolist():
        mine = (sectors == index).astype(np.uint8)
        distance = cv2.distanceTransform(cv2.resize(mine, None, fx=0.25, fy=0.25), cv2.DIST_L2, 3)
        v, u = divmod(int(distance.argmax()), distance.shape[1])
        name = names[index]
        words = f"{name}: {missing[name]}"
        (width, _), _ = cv2.getTextSize(words, _FONT, 0.6, 2)
        left = int(np.clip(4 * u - width / 2, 4, max(picture.shape[1] - width - 4, 4)))
        _text(picture, words, (left, 4 * v), 0.6)


def caption(picture: Image, words: str) -> None:
    """A line of words at the lower left."""
    _text(picture, words, (10, picture.shape[0] - 12), 0.55)


def _ring(picture: Image, centre: Array, radius: float, colour: tuple[int, int, int], width: int) -> None:
    at = (round(float(centre[0]) * 16), round(float(centre[1]) * 16))
    cv2.circle(picture, at, round(radius * 16), _DARK, width + 2, cv2.LINE_AA, 4)
    cv2.circle(picture, at, round(radius * 16), colour, width, cv2.LINE_AA, 4)


def _text(picture: Image, words: str, at: Sequence[int] | Array, size: float = 0.5) -> None:
    place = (int(at[0]), int(at[1]))
    cv2.putText(picture, words, place, _FONT, size, _DARK, 4, cv2.LINE_AA)
    cv2.putText(picture, words, place, _FONT, size, _WHITE, 1, cv2.LINE_AA)
