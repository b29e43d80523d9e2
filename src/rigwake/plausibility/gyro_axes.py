"""Single axes of the gyroscope against the cameras' turns: one that shows too little, too much, or nothing."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from rigwake._types import Array
from rigwake.plausibility.turn_checks import gyro_turns
from rigwake.plausibility.turn_fit import TurnFit
from rigwake.plausibility.values import SensorCheck

_GAIN, _SIGMAS = 0.08, 6.0
_KNOWN = 3.0  # times the noise of a turn, by which turns about an axis vary for its gain to be known


def axis_gains(fit: TurnFit) -> tuple[Array, Array]:
    """What every axis of the gyroscope shows of the camera's turns about it, (3,), and standard deviations (3,);
    infinite for axes about which there was hardly a turn.

    Without believing any mounting: the gyroscope's turns are a linear function of the camera's, and the rows of its
    matrix are those of a rotation, each times the gain of its axis.
    """
    turns, gyro = fit.camera_turns, gyro_turns(fit)
    turns, gyro = turns - np.median(turns, axis=0), gyro - np.median(gyro, axis=0)
    weights: Array = np.ones(len(turns))
    matrix: Array = np.eye(3)
    information: Array = np.eye(3)
    off = np.zeros_like(gyro)
    for _ in range(8):
        information = (turns * weights[:, None]).T @ turns + 1e-12 * np.eye(3)
        matrix = np.asarray(
            np.linalg.solve(information, (turns * weights[:, None]).T @ gyro).T, dtype=np.float64
        )
        off = gyro - turns @ matrix.T
        size = np.linalg.norm(off, axis=1)
        weights = 1 / (1 + (size / max(2 * float(np.median(size)), 1e-6)) ** 2)
    gains = np.linalg.norm(matrix, axis=1)
    # the direction of an axis is that across the two others: an axis that shows nothing has none of its own
    along = np.cross(matrix[[1, 2, 0]], matrix[[2, 0, 1]])
    along /= np.maximum(np.linalg.norm(along, axis=1), 1e-12)[:, None]
    spread = np.einsum("ki,ij,kj->k", along, np.linalg.inv(information), along)
    noise = np.sqrt(np.median(off**2, axis=0)) * 1.48
    turned = 1 / np.sqrt(np.maximum(spread * weights.sum(), 1e-300))
    # errors of the camera's turns show about an axis that the gyroscope follows; about the others they are as large
    known = turned > _KNOWN * noise.max()
    # errors of what a line is fitted over make its slope too small
    flattened = (noise.max() / np.maximum(turned, 1e-12)) ** 2
    return gains, np.where(known, 2.0 * noise * np.sqrt(np.maximum(spread, 0.0)) + flattened / 3, np.inf)


def check_axes(fits: Mapping[str, TurnFit]) -> tuple[SensorCheck, ...]:
    """An axis of the gyroscope that shows another part of the turns than its others, by most cameras; else nothing."""
    if not fits:
        return ()
    votes = []
    for fit in fits.values():
        gains, stds = axis_gains(fit)
        known = np.isfinite(stds)
        if known.sum() < 2:
            continue
        # of two, nobody knows which is wrong: that of the turns' scale is right
        usual = float(np.median(gains[known])) if known.all() else 1.0
        off = known & (np.abs(gains / usual - 1) > np.maximum(_GAIN, _SIGMAS * stds))
        votes.append(np.where(off, gains / usual, np.nan))
    if not votes:
        return ()
    told = np.array(votes)
    axis = int(np.argmax(np.isfinite(told).sum(axis=0)))
    wrong = told[np.isfinite(told[:, axis]), axis]
    if len(wrong) * 2 <= len(fits) or np.ptp(wrong) > max(_GAIN, 0.5 * abs(float(np.median(wrong)) - 1)):
        return ()
    gain = float(np.median(wrong))
    words = (
        f"its {'xyz'[axis]} axis shows {gain:.2f} of the turns that its other axes show as the cameras do."
    )
    remedy = "Check the scale and the range of this axis; calibrate or replace the sensor."
    return (SensorCheck("gyroscope", False, gain, 1.0, words, remedy, "gain of one axis over the others"),)
