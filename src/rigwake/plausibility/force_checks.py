"""The accelerometer, judged by every camera's path: axes, sign, gravity; and pictures that are mirrored."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from rigwake._types import Array
from rigwake.errors import RigwakeError
from rigwake.plausibility.force_fit import (
    GRAVITY,
    AxisFit,
    ForceEquations,
    ForceFit,
    signed_permutations,
)
from rigwake.plausibility.turn_fit import TurnFit
from rigwake.plausibility.values import SensorCheck
from rigwake.recording import ImuStream
from rigwake.trajectory import Trajectory

_KNOWN_ROTATION = np.deg2rad(2.0)
_CLEARLY_BETTER = 0.6
_SIGN_SIGMAS = 6.0
_GRAVITY_TOLERANCE = 0.12
_LARGE_BIAS = 0.4  # m/s^2, worth a word
MOST_BIAS = 1.5  # m/s^2; what the cheapest MEMS accelerometers have, uncalibrated, is below 1
_LEAST_TOLD, _TOLD_STDS = 0.15, 4.0  # what an axis should show, m/s^2 and over what the others leave
_LEAST_SLOPE, _MOST_SLOPE = 0.5, 1.6
_WORTH_ASKING = 0.15  # of the accelerations: good recordings leave a tenth of that where they tell anything
_DELAY_S, _DELAY_SIGMAS, _FITTING = 0.04, 8.0, 0.5
_DELAYS_S = tuple(sign * s for s in (0.05, 0.1, 0.2, 0.3, 0.4, 0.6) for sign in (1.0, -1.0))


@dataclass(frozen=True, eq=False)
class ForceVerdict:
    """Of one camera: the fit as given, the best of all readings of the axes, and every axis against the others.

    delays: what is left, m/s^2, by seconds that the accelerometer is suspected to be behind the gyroscope; empty where
    there was no need to ask. delay: the same as an unknown of the fit, with its deviation; for small ones.
    """

    given: ForceFit
    best: ForceFit
    axes: tuple[AxisFit, ...] = ()
    delays: Mapping[float, float] = field(default_factory=dict)
    delay: tuple[float, float] = (0.0, np.inf)


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
        best = min((f for f in fits if f.scale > 0), key=lambda f: f.left)
        alone = tuple(equations.alone(axis) for axis in range(3))
        delays = {}
        if min(best.left, *(axis.left for axis in alone)) > _WORTH_ASKING * best.moved:
            delays = {s: equations.ahead(s).solve(np.eye(3)).left for s in _DELAYS_S}
        found[name] = ForceVerdict(fits[0], best, alone, delays, equations.delay())
    return found


def check_forces(verdicts: Mapping[str, ForceVerdict]) -> tuple[SensorCheck, ...]:
    """The accelerometer where most cameras agree on what is wrong; a camera where it stands alone."""
    wrong = {name: words for name, v in verdicts.items() if (words := _what_is_wrong(v))}
    quantity = "specific force that vision does not explain, m/s^2"
    if not verdicts:
        return ()
    if own := _of_itself(verdicts):
        return (own,)
    if len(wrong) * 2 <= len(verdicts):
        left = float(np.median([v.given.left for v in verdicts.values()]))
        words, advice = _large_bias(verdicts)
        sound = SensorCheck("accelerometer", True, left, left, words, advice, quantity)
        return (sound, *(_mirrored(name, verdicts[name]) for name in wrong))
    name = min(wrong, key=lambda n: verdicts[n].best.left)
    v = verdicts[name]
    if len(verdicts) == 1 and _is_reversed(v):
        words = f"{wrong[name]}; or the pictures of {name} are mirrored"
    else:
        words = wrong[name]
    remedy = "Correct the accelerometer's axes and signs: at rest it shows +9.81 on the axis that points up."
    return (SensorCheck("accelerometer", False, v.given.left, v.best.left, f"{words}.", remedy, quantity),)


def _large_bias(verdicts: Mapping[str, ForceVerdict]) -> tuple[str, str]:
    """Words and advice about a bias that an accelerometer may have, but that may as well be something else."""
    bias = np.median([v.given.bias for v in verdicts.values()], axis=0)
    stds = np.median([v.given.bias_std for v in verdicts.values()], axis=0)
    bias = np.where(stds < 0.2 * _LARGE_BIAS, bias, 0.0)
    size = float(np.linalg.norm(bias))
    if size < _LARGE_BIAS:
        return "", ""
    words = (
        f"its bias is {size:.2f} m/s^2; if its axes are turned against the gyroscope's by "
        f"{np.rad2deg(size / GRAVITY):.1f} deg it looks the same, and all cameras are turned by that."
    )
    return words, "Calibrate it at rest, in six positions."


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


def _of_itself(verdicts: Mapping[str, ForceVerdict]) -> SensorCheck | None:
    """A bias, an axis or a delay that is wrong by all cameras together: it is no camera's fault."""
    bias = np.median([v.given.bias for v in verdicts.values()], axis=0)
    known = np.median([v.given.bias_std for v in verdicts.values()], axis=0) < 0.2 * MOST_BIAS
    size = float(np.abs(bias[known]).max(initial=0.0))
    if size > MOST_BIAS:
        axes = ", ".join(f"{b:.1f}" if k else "unknown" for b, k in zip(bias, known, strict=True))
        words = f"its bias is ({axes}) m/s^2 on x, y, z: no accelerometer errs by more than {MOST_BIAS:g}."
        remedy = "Check its unit and the driver's conversion; replace the sensor if they are right."
        return SensorCheck("accelerometer", False, size, MOST_BIAS, words, remedy, "bias, m/s^2")
    for k, name in enumerate("xyz"):
        deaf = [v.axes[k] for v in verdicts.values() if v.axes and _is_deaf(v.axes[k], v.given)]
        if len(deaf) * 2 > len(verdicts):
            slope = float(np.median([axis.slope for axis in deaf]))
            words = f"its {name} axis shows {slope:.2f} of the force that its other axes and vision tell it should."
            remedy = "Check the sensor's settings and range; replace it."
            return SensorCheck(
                "accelerometer", False, slope, 1.0, words, remedy, "shown by one axis over told"
            )
    delayed = [s for v in verdicts.values() if (s := _delay(v)) is not None]
    if len(delayed) * 2 > len(verdicts):
        late = float(np.median(delayed))
        side = "late" if late > 0 else "early"
        words = f"its samples are stamped {abs(late):.2g} s too {side} against the gyroscope's."
        remedy = "Stamp gyroscope and accelerometer together, when they are read."
        return SensorCheck("accelerometer", False, late, 0.0, words, remedy, "delay behind the gyroscope, s")
    return None


def _delay(v: ForceVerdict) -> float | None:
    """The delay that makes the forces fit; None where none does."""
    best = min(v.delays, key=lambda s: v.delays[s], default=None)
    if best is not None and v.delays[best] <= _CLEARLY_BETTER * min(v.given.left, v.best.left):
        return best
    seconds, std = v.delay
    fits = v.given.left < _FITTING * v.given.moved  # else it may be anything
    return seconds if fits and abs(seconds) > max(_DELAY_S, _DELAY_SIGMAS * std) else None


def _is_deaf(axis: AxisFit, given: ForceFit) -> bool:
    """Whether an axis does not show what the two others and vision agree on."""
    far = axis.slope < _LEAST_SLOPE or axis.slope > _MOST_SLOPE
    told = axis.told > max(_LEAST_TOLD, _TOLD_STDS * axis.left)
    sure = abs(axis.slope - 1) > _SIGN_SIGMAS * axis.slope_std
    return bool(far and told and sure and axis.left < _CLEARLY_BETTER * given.left)


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
