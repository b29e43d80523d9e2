"""The gyroscope against every camera's coarse turns, before anything is tracked: unit, axes, bias, rate of stamps."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace

import numpy as np

from rigwake._types import Array
from rigwake.errors import RigwakeError
from rigwake.plausibility.imu_samples import VettedImu
from rigwake.plausibility.stamp_rates import rate_of_stamps, with_rate
from rigwake.plausibility.turn_fit import TurnFit, fit_turns
from rigwake.plausibility.values import SensorCheck
from rigwake.recording import ImuStream
from rigwake.trajectory import Trajectory

_UNEXPLAINED = 0.2  # of the coarse turns; good recordings leave up to 0.1
_CLEARLY_BETTER = 0.5
MOST_BIAS = np.deg2rad(20.0)  # rad/s; the worst of the cheapest MEMS gyroscopes, uncalibrated
_DEG_S = "its unit is deg/s"
_LEFT_HANDED = "its axes are left-handed (one has the wrong sign, or two are exchanged)"


def _of_rates(change: Callable[[Array], Array]) -> Callable[[ImuStream], ImuStream]:
    return lambda imu: replace(imu, gyro=change(imu.gyro))


_WRONGS: dict[str, Callable[[ImuStream], ImuStream]] = {
    _DEG_S: _of_rates(np.deg2rad),
    _LEFT_HANDED: _of_rates(lambda w: w * [1.0, 1.0, -1.0]),
    f"{_LEFT_HANDED} and {_DEG_S}": _of_rates(lambda w: np.deg2rad(w * [1.0, 1.0, -1.0])),
}
_REMEDIES = {
    _DEG_S: "Record in rad/s.",
    _LEFT_HANDED: "Correct the IMU's axes (x, y, z right-handed, all signs as mounted).",
}


def vet_turns(imu: ImuStream, turns: Mapping[str, Trajectory], *, repair: bool = True) -> VettedImu:
    """The gyroscope against coarse turns of every camera: unit, handedness, bias, and the rate that its stamps claim.

    turns: by camera, from images alone. Only a wrong that makes most cameras agree is held against the gyroscope; what
    nothing explains is left for finer checks.
    """
    if not turns:
        return VettedImu(imu, ())
    fits = _fits(imu, turns)
    figure = _unexplained(fits)
    if figure <= _UNEXPLAINED:
        return VettedImu(imu, _check_bias(_bias(fits, np.zeros(3))))
    tried = {words: change(imu) for words, change in _WRONGS.items()}
    middle = np.median(imu.gyro, axis=0)
    tried["bias"] = replace(imu, gyro=imu.gyro - middle)
    refits = {words: _fits(stream, turns) for words, stream in tried.items()}
    best = min(refits, key=lambda words: _unexplained(refits[words]))
    if not _explains(left := _unexplained(refits[best]), figure):
        rate = _rate(imu, turns)
        left = 1.0 if rate is None else _unexplained(_fits(with_rate(imu, rate), turns))
        known = rate is not None and _explains(left, figure)
        return VettedImu(imu, (_wrong_rate(imu, rate, figure, left),) if known and rate is not None else ())
    if best == "bias":
        return _without_bias(imu, refits[best], middle, repair)
    return _wrong_axes(imu, best, figure, left, repair)


def _explains(left: float, figure: float) -> bool:
    return left <= _CLEARLY_BETTER * figure and left <= 1.5 * _UNEXPLAINED


def _wrong_axes(imu: ImuStream, best: str, figure: float, left: float, repair: bool) -> VettedImu:
    given = f"it leaves {100 * figure:.0f} % of the cameras' turns unexplained"
    words = f"{given}; {best}: then {100 * left:.0f} % are left"
    quantity = "part of the cameras' turns that it does not explain"
    check = SensorCheck("gyroscope", False, figure, _UNEXPLAINED, f"{words}.", "", quantity)
    if best == _DEG_S and repair:
        check = replace(check, hypothesis=f"{words}. Multiplied by pi / 180.", remedy=_REMEDIES[_DEG_S])
        return VettedImu(_WRONGS[best](imu), (check.with_action("repaired"),))
    remedy = _REMEDIES.get(best, _REMEDIES[_LEFT_HANDED])
    return VettedImu(imu, (replace(check, remedy=remedy),))


def _bias(fits: Mapping[str, TurnFit | None], taken_off: Array) -> Array | None:
    """(3,) rad/s by most cameras, or None where it is not known."""
    told = [f.gyro_bias for f in fits.values() if f is not None and f.unexplained <= 1.5 * _UNEXPLAINED]
    return taken_off + np.median(told, axis=0) if told else None


def _check_bias(bias: Array | None) -> tuple[SensorCheck, ...]:
    """A bias that no gyroscope has; nothing where it is as such biases are."""
    size = 0.0 if bias is None else float(np.linalg.norm(bias))
    if bias is None or size <= MOST_BIAS:
        return ()
    axes = ", ".join(f"{np.rad2deg(b):.1f}" for b in bias)
    words = (
        f"its bias is {np.rad2deg(size):.0f} deg/s ({axes} about x, y, z): no gyroscope errs by more than "
        f"{np.rad2deg(MOST_BIAS):.0f}."
    )
    remedy = "Check the driver's conversion to rad/s, and replace the sensor if it is right."
    return (SensorCheck("gyroscope", False, size, MOST_BIAS, words, remedy, "bias, rad/s"),)


def _without_bias(
    imu: ImuStream, fits: Mapping[str, TurnFit | None], middle: Array, repair: bool
) -> VettedImu:
    """A bias that hides the turns, taken off if a cheap gyroscope may have it."""
    bias = _bias(fits, middle)
    beyond = _check_bias(bias)
    if beyond or bias is None:
        return VettedImu(imu, beyond)
    size = float(np.linalg.norm(bias))
    words = f"its bias of {np.rad2deg(size):.0f} deg/s is so large that its turns are not the cameras'"
    remedy = "Calibrate the gyroscope's bias at rest."
    check = SensorCheck("gyroscope", False, size, MOST_BIAS, f"{words}.", remedy, "bias, rad/s")
    if not repair:
        return VettedImu(imu, (check,))
    check = replace(check, hypothesis=f"{words}; taken off.").with_action("repaired")
    return VettedImu(replace(imu, gyro=imu.gyro - bias), (check,))


def _wrong_rate(imu: ImuStream, rate: float, figure: float, left: float) -> SensorCheck:
    hertz = 1e9 / float(np.median(np.diff(imu.timestamps_ns)))
    words = (
        f"its stamps run {1 / rate:.3f} times as fast as the cameras': by their turns samples come at "
        f"{hertz / rate:.1f} Hz, by its stamps at {hertz:.1f}. As stamped {100 * figure:.0f} % of the turns are "
        f"unexplained, corrected {100 * left:.0f} %."
    )
    remedy = "Stamp samples when they are taken; check the rate that the driver, or the cameras', assumes."
    return SensorCheck(
        "imu", False, 1 / rate, 1.0, words, remedy, "seconds stamped per second of the cameras"
    )


def _rate(imu: ImuStream, turns: Mapping[str, Trajectory]) -> float | None:
    """By the first of two cameras that tells it: one rate is to hold for all."""
    for trajectory in list(turns.values())[:2]:
        rate = rate_of_stamps(imu, trajectory)
        if rate is not None:
            return rate
    return None


def _fits(imu: ImuStream, turns: Mapping[str, Trajectory]) -> dict[str, TurnFit | None]:
    found: dict[str, TurnFit | None] = {}
    for name, trajectory in turns.items():
        try:
            found[name] = fit_turns(trajectory, imu)
        except RigwakeError:
            found[name] = None
    return found


def _unexplained(fits: Mapping[str, TurnFit | None]) -> float:
    return float(np.median([1.0 if fit is None else fit.unexplained for fit in fits.values()]))
