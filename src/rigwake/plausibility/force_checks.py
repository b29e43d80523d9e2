"""The accelerometer, judged by every camera's path: axes, sign, gravity; and pictures that are mirrored."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from rigwake._types import Array
from rigwake.errors import RigwakeError
from rigwake.plausibility.force_fit import GRAVITY, ForceEquations, ForceFit, signed_permutations
from rigwake.plausibility.turn_fit import TurnFit
from rigwake.plausibility.values import SensorCheck
from rigwake.recording import ImuStream
from rigwake.trajectory import Trajectory

_KNOWN_ROTATION = np.deg2rad(2.0)
_CLEARLY_BETTER = 0.6
_SIGN_SIGMAS = 6.0
_GRAVITY_TOLERANCE = 0.12


@dataclass(frozen=True, eq=False)
class ForceVerdict:
    """Of one camera: the fit as given, the best of all readings of the axes, and whether both tell anything."""

    given: ForceFit
    best: ForceFit


def compare_forces(
    trajectories: Mapping[str, Trajectory], imu: ImuStream, turns: Mapping[str, TurnFit]
) -> dict[str, ForceVerdict]:
    """For every camera whose rotation towards the IMU is known to 2 degrees, how well the accelerometer fits."""
    found = {}
    for name, fit in turns.items():
        if fit.rotation_std > _KNOWN_ROTATION or fit.unexplained > 0.15:
            continue
        try:
            equations = ForceEquations(trajectories[name], imu, fit)
        except RigwakeError:
            continue
        fits = [equations.solve(axes) for axes in signed_permutations()]
        found[name] = ForceVerdict(fits[0], min((f for f in fits if f.scale > 0), key=lambda f: f.left))
    return found


def check_forces(verdicts: Mapping[str, ForceVerdict]) -> tuple[SensorCheck, ...]:
    """The accelerometer where most cameras agree on what is wrong; a camera where it stands alone."""
    wrong = {name: words for name, v in verdicts.items() if (words := _what_is_wrong(v))}
    quantity = "specific force that vision does not explain, m/s^2"
    if not verdicts:
        return ()
    if len(wrong) * 2 <= len(verdicts):
        left = float(np.median([v.given.left for v in verdicts.values()]))
        sound = SensorCheck("accelerometer", True, left, left, quantity=quantity)
        return (sound, *(_mirrored(name, verdicts[name]) for name in wrong))
    name = min(wrong, key=lambda n: verdicts[n].best.left)
    v = verdicts[name]
    if len(verdicts) == 1 and _is_reversed(v):
        words = f"{wrong[name]}; or the pictures of {name} are mirrored"
    else:
        words = wrong[name]
    remedy = "Correct the accelerometer's axes and signs: at rest it shows +9.81 on the axis that points up."
    return (SensorCheck("accelerometer", False, v.given.left, v.best.left, f"{words}.", remedy, quantity),)


def _what_is_wrong(v: ForceVerdict) -> str:
    """In words, or nothing."""
    gravity = float(np.linalg.norm(v.given.gravity))
    if _is_reversed(v):
        return (
            "its sign is reversed: the path that vision measures fits its forces only the wrong way round "
            f"(scale {v.given.scale:.3g})"
        )
    if v.best.left < _CLEARLY_BETTER * v.given.left and v.best.left < 0.7 * max(v.best.moved, v.given.left):
        return (
            f"it leaves {v.given.left:.2f} m/s^2 unexplained, but {v.best.left:.2f} with its axes read as "
            f"({_axes_words(v.best.axes)})"
        )
    if gravity < 0.5 * GRAVITY and v.given.left < 0.7 * v.given.moved:
        return f"gravity comes out as {gravity:.2f} m/s^2: it was taken out"
    if abs(gravity / GRAVITY - 1) > _GRAVITY_TOLERANCE and v.given.left < 0.5 * v.given.moved:
        return f"gravity comes out as {gravity:.2f} m/s^2 where it is 9.81: its scale is wrong"
    return ""


def _is_reversed(v: ForceVerdict) -> bool:
    sure = v.given.scale < 0 and v.given.scale_std < 1 / _SIGN_SIGMAS
    return bool(sure and v.given.left < 1.2 * v.best.left and v.given.left < 0.7 * v.given.moved)


def _axes_words(axes: Array) -> str:
    """`-y, x, z` for a reading whose first axis is minus the second that was recorded."""
    words = []
    for row in axes:
        k = int(np.argmax(np.abs(row)))
        words.append(f"{'-' if row[k] < 0 else ''}{'xyz'[k]}")
    return ", ".join(words)


def _mirrored(name: str, v: ForceVerdict) -> SensorCheck:
    words = (
        f"its path fits the accelerometer only mirrored (scale {v.given.scale:.3g}, the other cameras' are positive): "
        "its pictures are mirrored"
        if _is_reversed(v)
        else f"its path does not fit the accelerometer ({v.given.left:.2f} m/s^2 left), the other cameras' do: "
        "its pictures are mirrored or turned, or its path is wrong"
    )
    remedy = "Record the pictures as the sensor takes them."
    return SensorCheck(f"camera {name}", False, v.given.scale, 0.0, f"{words}.", remedy, "scale of its path")
