"""Which camera is to blame: rotations that explain the misalignments of all seams together."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from rigwake._types import Array
from rigwake.geometry.so3 import hat
from rigwake.views.attitude import LevelAttitude
from rigwake.views.seams import PX_PER_RAD, SeamMatches
from rigwake.views.surface import Surface
from rigwake.views.surround_rig import SurroundRig


@dataclass(frozen=True)
class CameraBlame:
    """The rotation by which one camera differs from what most others agree on.

    rotation_deg: about the axes of the level frame (ahead, port, up). std_deg: its uncertainty (mean of the axes).
    is_to_blame: it stands out from its uncertainty and from the other cameras.
    """

    name: str
    rotation_deg: tuple[float, float, float]
    std_deg: float
    is_to_blame: bool

    @property
    def size_deg(self) -> float:
        """Angle of the rotation."""
        return float(np.linalg.norm(self.rotation_deg))


_MATCH_STD = np.deg2rad(0.12)
_ALL_RANGES_STD = 1.0  # of one over the range that the view was drawn for: an error common to all seams,
_SEAM_RANGE_STD = 0.5  # one of every seam in every frame set,
_MATCH_RANGE_STD = 0.5  # and one of every match
_DISTINCT = 4.0  # standard deviations, all axes together
# about ahead, port and up: a scene that is nearer on one side looks like a turn about up
_LEAST_STD = np.deg2rad(np.array([0.03, 0.03, 0.15]))
_LEAST_BLAME_DEG = 0.25


def blame_cameras(
    rig: SurroundRig, attitude: LevelAttitude, surface: Surface, seams: Iterable[SeamMatches]
) -> list[CameraBlame]:
    """Small rotations of all cameras that explain the misalignments, relative to the median camera.

    `misalignment = (w_first - w_second) x direction + parallax * (error of one over the range)`; the errors of the
    range are unknowns with priors. Robust least squares (Cauchy). With fewer than three connected cameras nobody can
    tell which of two is wrong: none is blamed then.
    """
    seams = [seam for seam in seams if len(seam.directions)]
    if not seams:
        return []
    count = len(rig)
    positions = rig.positions_level(attitude.level_from_rig)
    rows, values = [], []
    for number, seam in enumerate(seams):
        d = seam.directions
        right, down = _tangents(d)
        measured = (seam.misalignment_px[:, :1] * right + seam.misalignment_px[:, 1:] * down) / PX_PER_RAD
        across = positions[seam.second] - positions[seam.first]
        parallax = (across - (d @ across)[:, None] * d) / surface.range_m(d, attitude)[:, None]
        size = np.linalg.norm(parallax, axis=1)
        along = parallax / np.maximum(size, 1e-12)[:, None]
        turns = -np.array([hat(x) for x in d])  # w x d = -[d] w
        for axis, std in (
            (along, np.hypot(_MATCH_STD, _MATCH_RANGE_STD * size)),
            (np.cross(d, along), np.full(len(d), _MATCH_STD)),
        ):
            lever = np.einsum("ni,nij->nj", axis, turns)
            A = np.zeros((len(d), 3 * count + 1 + len(seams)))
            A[:, 3 * seam.first : 3 * seam.first + 3] = -lever
            A[:, 3 * seam.second : 3 * seam.second + 3] = lever
            moved = (parallax * axis).sum(axis=1)
            A[:, 3 * count] = moved
            A[:, 3 * count + 1 + number] = moved
            rows.append(A / std[:, None])
            values.append((measured * axis).sum(axis=1) / std)
    prior = np.concatenate(
        [np.full(3 * count, np.deg2rad(3.0)), [_ALL_RANGES_STD], np.full(len(seams), _SEAM_RANGE_STD)]
    )
    solution, covariance = _robust(np.vstack(rows), np.concatenate(values), prior)
    return _blames(
        rig,
        solution[: 3 * count].reshape(count, 3),
        covariance,
        {k for seam in seams for k in (seam.first, seam.second)},
    )


def _blames(rig: SurroundRig, turns: Array, covariance: Array, owners: set[int]) -> list[CameraBlame]:
    known = sorted(owners)
    turns = turns - np.median(turns[known], axis=0)
    sizes = {k: float(np.rad2deg(np.linalg.norm(turns[k]))) for k in known}
    blames = []
    for k in known:
        block = covariance[3 * k : 3 * k + 3, 3 * k : 3 * k + 3] + np.diag(_LEAST_STD) ** 2
        std = float(np.rad2deg(np.sqrt(np.trace(block) / 3)))
        sigmas = float(np.sqrt(turns[k] @ np.linalg.solve(block, turns[k])))
        others = float(np.median([sizes[j] for j in known if j != k]))
        stands_out = len(known) >= 3 and sizes[k] > max(_LEAST_BLAME_DEG, 2 * others) and sigmas > _DISTINCT

        x, y, z = np.rad2deg(turns[k]).tolist()
        blames.append(CameraBlame(rig.names[k], (x, y, z), std, stands_out))
    return blames


def _robust(A: Array, y: Array, prior_std: Array) -> tuple[Array, Array]:
    """Solution and covariance; the mean rotation, which nothing determines, is taken out of the covariance."""
    prior = np.diag(prior_std**-2.0)
    solution, information = np.zeros(A.shape[1]), prior
    for _ in range(10):
        weight = 1 / (1 + ((y - A @ solution) / 2.0) ** 2)
        information = (A * weight[:, None]).T @ A + prior
        solution = np.asarray(np.linalg.solve(information, A.T @ (weight * y)), dtype=np.float64)
    covariance = np.linalg.inv(information)
    rotations = int((prior_std == prior_std[0]).sum())
    mean = np.tile(np.eye(3), (rotations // 3, rotations // 3)) / (rotations // 3)
    gauge = np.eye(rotations) - mean
    return solution, gauge @ covariance[:rotations, :rotations] @ gauge


def _tangents(directions: Array) -> tuple[Array, Array]:
    """Unit vectors to the right and down at directions of a panorama, scaled as its pixels are."""
    horizontal = np.hypot(directions[:, 0], directions[:, 1])
    ahead = directions[:, :2] / np.maximum(horizontal, 1e-9)[:, None]
    # a column is a step of azimuth: cos(elevation) of an angle
    right = np.column_stack([ahead[:, 1], -ahead[:, 0], np.zeros(len(directions))]) * horizontal[:, None]
    down = np.column_stack([ahead * directions[:, 2:3], -horizontal])
    return right, down
