"""Did the own hull move in a camera's picture? Its edges now against those kept with the calibration.

This needs no motion of the boat, so it works at standstill. The mean of some frames of a block is registered onto the
mean picture of the calibration by a rotation of the camera (Gauss-Newton on locally normalised grey levels, coarse to
fine; Baker and Matthews, *Lucas-Kanade 20 years on*, 2004). A hull is near: a shift of the camera of a few millimetres
looks like a rotation, and is told as one.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise

import cv2
import numpy as np

from rigwake._types import Array, Indices, Mask
from rigwake.cameras.protocol import CameraModel
from rigwake.geometry import so3
from rigwake.geometry.se3 import SE3
from rigwake.monitor.thresholds import Thresholds
from rigwake.recording import CameraStream
from rigwake.tracking.hull_picture import HullPicture, mean_picture, spread_frames

_BLURS_PX = (6.0, 3.0, 1.5)
_ROUNDS = 12
_LOCAL_PX = 10.0  # window over which contrast is made the same
_GRID_PX = 4  # one point at most in each such square: about what a blur leaves independent
_FEWEST_POINTS = 150
_LEAST_CONTRAST = 2.0  # grey levels per px
_CORRELATED = 3.0  # variance by what neighbouring points share
_LEAST_LIKENESS = 0.6  # correlation of both pictures at the points
_FLOOR_DEG = 0.02  # light from elsewhere moves edges
_FRAMES = 8
_STEP_S = 5.0
_OBSERVABLE_DEG = 0.1


@dataclass(frozen=True, eq=False)
class HullStep:
    """Five seconds: the camera's rotation against the reference, rad, rig axes (3,), its covariance (3, 3), and the
    correlation of the two pictures after it."""

    start_ns: int
    rotation: Array
    covariance: Array
    likeness: float


@dataclass(frozen=True, eq=False)
class HullCue:
    """What the own hull says of one camera.

    steps: those that could be compared. rotation, covariance: of the steps since it moved, else of all, rig axes; None
    if nothing could be compared. since_ns: when it moved, None if it did not. words: one line.
    """

    camera: str
    steps: tuple[HullStep, ...]
    rotation: Array | None
    covariance: Array | None
    since_ns: int | None
    words: str

    @classmethod
    def untold(cls, camera: str, words: str, steps: tuple[HullStep, ...] = ()) -> HullCue:
        """Nothing that can be told of a camera, and why."""
        return cls(camera, steps, None, None, None, words)

    @property
    def moved(self) -> bool:
        """Whether the hull is elsewhere in the picture."""
        return self.since_ns is not None


def hull_cues(
    streams: Mapping[str, CameraStream],
    rig_from_cams: Mapping[str, SE3],
    time_offsets_s: Mapping[str, float],
    span_ns: tuple[int, int],
    pictures: Mapping[str, HullPicture],
    thresholds: Thresholds,
) -> dict[str, HullCue]:
    """The cue of every camera of which a picture of the own hull is kept. span_ns: what is looked at, in rig time."""
    cues = {}
    stride = round(_STEP_S * 1e9)
    starts_ns = range(span_ns[0], span_ns[1] - stride + 1, stride)
    for name, kept in pictures.items():
        stream = streams.get(name)
        if stream is None or stream.model is None:
            continue
        on_rig = stream.timestamps_ns + round(time_offsets_s[name] * 1e9)
        if kept.picture.shape != (stream.height_px, stream.width_px):
            cues[name] = HullCue.untold(name, "the picture kept of it has another size")
            continue
        reference = HullEdges(kept, stream.model)
        if not reference.is_enough:
            cues[name] = HullCue.untold(name, "too little of the own hull is in view")
            continue
        steps = []
        for start in starts_ns:
            rows = np.flatnonzero((on_rig >= start) & (on_rig < start + stride))
            picture = mean_picture(stream, spread_frames(rows, _FRAMES)) if len(rows) else None
            if picture is not None:
                steps.append(reference.step(picture, rig_from_cams[name].rotation, start))
        cues[name] = judge_hull(name, steps, thresholds, kept.origin)
    return cues


class HullEdges:
    """The edges of a kept picture, ready to be compared with others of the same camera."""

    def __init__(self, kept: HullPicture, model: CameraModel) -> None:
        self._model = model
        soft = cv2.GaussianBlur(kept.picture.astype(np.float32), (0, 0), _BLURS_PX[-1])
        rows, columns = edge_points(soft, kept.region)
        pixels = np.stack([columns, rows], axis=1).astype(np.float64)
        bearings, valid = model.unproject(pixels)
        self._bearings = bearings[valid]
        self._values = [
            normalised(kept.picture, blur)[rows[valid], columns[valid]].astype(np.float64)
            for blur in _BLURS_PX
        ]

    @property
    def is_enough(self) -> bool:
        """Whether there is enough to compare."""
        return len(self._bearings) >= _FEWEST_POINTS

    def step(self, picture: Array, rig_from_cam_rotation: Array, start_ns: int) -> HullStep:
        """How the camera turned between the kept picture and this one. picture: (H, W) grey levels."""
        turned, information, likeness = np.eye(3), np.zeros((3, 3)), 0.0
        for blur, values in zip(_BLURS_PX, self._values, strict=True):
            shown = normalised(picture, blur)
            for _ in range(_ROUNDS):
                step, information, likeness = self._solve(shown, values, turned)
                turned = so3.exp(-step) @ turned
                if np.linalg.norm(step) < 1e-6:
                    break
        covariance = np.linalg.pinv(information, rcond=1e-9, hermitian=True)
        # the boat stands still: what it seems to turn by in the picture, the camera turned the other way
        rotation = -rig_from_cam_rotation @ so3.log(turned)
        return HullStep(
            start_ns, rotation, rig_from_cam_rotation @ covariance @ rig_from_cam_rotation.T, likeness
        )

    def _solve(self, shown: Array, values: Array, turned: Array) -> tuple[Array, Array, float]:
        """One Gauss-Newton step (3,) in the camera's axes, the information (3, 3), and the correlation before it."""
        bearings = self._bearings @ turned.T
        projection = self._model.project_with_jacobians(bearings)
        height, width = shown.shape
        at = projection.pixels
        inside = projection.valid & (at >= 1).all(axis=1) & (at[:, 0] < width - 2) & (at[:, 1] < height - 2)
        if inside.sum() < _FEWEST_POINTS:
            return np.zeros(3), np.zeros((3, 3)), 0.0
        maps = at[inside].astype(np.float32)[:, None, :]
        found, by_x, by_y = (
            cv2.remap(image, maps, None, cv2.INTER_LINEAR)[:, 0].astype(np.float64)
            for image in (
                shown,
                cv2.Sobel(shown, cv2.CV_32F, 1, 0, scale=1 / 8),
                cv2.Sobel(shown, cv2.CV_32F, 0, 1, scale=1 / 8),
            )
        )
        residual = found - values[inside]
        by_pixel = np.stack([by_x, by_y], axis=1)
        d_bearing = np.einsum("ni,nij->nj", by_pixel, projection.d_point[inside])
        jacobian = np.cross(d_bearing, bearings[inside])  # d hat(b) = d x b: of `exp(-step) b`
        spread = 1.4826 * float(np.median(np.abs(residual))) + 1e-9
        weight = 1.0 / np.maximum(1.0, np.abs(residual) / (1.5 * spread))
        normal = jacobian.T @ (weight[:, None] * jacobian)
        step = -np.linalg.pinv(normal, rcond=1e-9, hermitian=True) @ (jacobian.T @ (weight * residual))
        likeness = float(np.corrcoef(found, values[inside])[0, 1]) if spread > 0 else 0.0
        largest = np.deg2rad(1.0)
        step *= min(1.0, largest / max(float(np.linalg.norm(step)), 1e-12))
        return step, normal / (_CORRELATED * spread**2), likeness


def normalised(picture: Array, blur_px: float) -> Array:
    """(H, W) float32 without local mean and contrast: what light does to a deck."""
    soft = cv2.GaussianBlur(picture.astype(np.float32), (0, 0), blur_px)
    window = _LOCAL_PX + 2 * blur_px
    flat = soft - cv2.GaussianBlur(soft, (0, 0), window)
    contrast = np.sqrt(cv2.GaussianBlur(flat * flat, (0, 0), window) + 4.0)
    return np.asarray(flat / contrast)


def edge_points(soft: Array, region: Mask) -> tuple[Indices, Indices]:
    """Rows and columns of the strongest edges of the hull: one in each small square, away from the picture's border."""
    by_x = cv2.Sobel(soft, cv2.CV_32F, 1, 0, scale=1 / 8)
    by_y = cv2.Sobel(soft, cv2.CV_32F, 0, 1, scale=1 / 8)
    strength = np.hypot(by_x, by_y) * (region & (soft > 0))
    border = 8
    strength[:border], strength[-border:], strength[:, :border], strength[:, -border:] = 0, 0, 0, 0
    height, width = (side - side % _GRID_PX for side in strength.shape)
    squares = strength[:height, :width].reshape(height // _GRID_PX, _GRID_PX, width // _GRID_PX, _GRID_PX)
    squares = squares.transpose(0, 2, 1, 3).reshape(-1, _GRID_PX * _GRID_PX)
    best = squares.argmax(axis=1)
    strong = squares[np.arange(len(squares)), best] > _LEAST_CONTRAST
    row, column = np.divmod(np.flatnonzero(strong), width // _GRID_PX)
    inner_row, inner_column = np.divmod(best[strong], _GRID_PX)
    return row * _GRID_PX + inner_row, column * _GRID_PX + inner_column


def judge_hull(camera: str, steps: list[HullStep], thresholds: Thresholds, origin: str) -> HullCue:
    """One line about a camera from its steps.

    Covariances are widened by what the steps scatter. It moved if two in a row are beyond the alarm; from the first of
    them on.
    """
    usable = [step for step in steps if step.likeness >= _LEAST_LIKENESS and step.covariance.any()]
    if not usable:
        why = "no picture" if not steps else "it looks different: other light, or things on deck"
        return HullCue.untold(camera, f"cannot be compared: {why}")
    covariances = _widened(usable)
    floor = np.deg2rad(_FLOOR_DEG) ** 2 * np.eye(3)
    statistic = np.array(
        [
            s.rotation @ np.linalg.solve(c + floor, s.rotation)
            for s, c in zip(usable, covariances, strict=True)
        ]
    )
    beyond = statistic > thresholds.alarm
    twice = np.flatnonzero(beyond[:-1] & beyond[1:])
    first = int(twice[0]) if len(twice) else 0
    chosen = np.arange(len(usable)) >= first if len(twice) else ~beyond
    if not chosen.any():
        return HullCue.untold(camera, "own hull elsewhere, but for five seconds only", tuple(usable))
    rotation, covariance = _mean(
        [s for s, used in zip(usable, chosen, strict=True) if used],
        [c for c, used in zip(covariances, chosen, strict=True) if used],
    )
    covariance = covariance + floor
    size, std = np.rad2deg(np.linalg.norm(rotation)), np.rad2deg(np.sqrt(np.linalg.eigvalsh(covariance)[-1]))
    if len(twice):
        words = f"{size:.2f} ± {std:.2f} deg against the own hull (picture {origin})"
        return HullCue(camera, tuple(usable), rotation, covariance, usable[first].start_ns, words)
    if std > _OBSERVABLE_DEG:
        return HullCue(
            camera, tuple(usable), rotation, covariance, None, "too little of the own hull is in view"
        )
    words = f"own hull where it was, to {max(3 * std, size):.2f} deg (picture {origin})"
    if beyond[-1]:
        words += "; elsewhere in the last five seconds: not sure yet"
    return HullCue(camera, tuple(usable), rotation, covariance, None, words)


def _mean(steps: list[HullStep], covariances: list[Array]) -> tuple[Array, Array]:
    """The mean rotation of some steps by their information, and its covariance."""
    least = np.deg2rad(1e-3) ** 2 * np.eye(3)
    inverses = [np.linalg.inv(c + least) for c in covariances]
    covariance = np.linalg.inv(np.sum(inverses, axis=0))
    weighted = np.sum([i @ s.rotation for i, s in zip(inverses, steps, strict=True)], axis=0)
    return covariance @ weighted, covariance


def _widened(steps: list[HullStep]) -> list[Array]:
    """Covariances times what neighbouring steps differ by, where that is more than they say; a single jump does not
    count."""
    if len(steps) < 3:
        return [step.covariance for step in steps]
    ratios = []
    for one, two in pairwise(steps):
        difference = two.rotation - one.rotation
        ratios.append(
            float(difference @ np.linalg.pinv(one.covariance + two.covariance, hermitian=True) @ difference)
            / 3
        )
    factor = max(1.0, float(np.median(ratios)) / 0.79)  # median of chi-square of three, per degree
    return [factor * step.covariance for step in steps]
