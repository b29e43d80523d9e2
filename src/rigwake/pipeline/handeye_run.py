"""Hand-eye calibration with the checks around it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from rigwake.errors import EstimationError, UnobservableError
from rigwake.handeye.handeye_problem import HandeyeOptions, HandeyeResult, in_one_unit
from rigwake.handeye.joint_calibration import calibrate_handeye
from rigwake.handeye.relative_scale import RelativeScale, scale_finding
from rigwake.plausibility.handeye_drift import check_steadiness
from rigwake.plausibility.handeye_fit import check_handeye, explain_failure
from rigwake.plausibility.values import SensorCheck, refuse
from rigwake.recording import Finding
from rigwake.trajectory import Trajectory

_MOST_SCALE = 1.25  # more is no error of an odometry but another unit


def run_handeye(
    reference: Trajectory, others: Sequence[Trajectory], options: HandeyeOptions
) -> tuple[HandeyeResult, tuple[SensorCheck, ...], tuple[Finding, ...]]:
    """The rig, how well each trajectory agrees with it, and what was noticed about units and scales.

    Raises UnobservableError when they did not move enough, InputError where a trajectory contradicts the others.
    """
    members, noticed = [], []
    for other in others:
        member, finding = in_one_unit(reference, other)
        members.append(member)
        noticed += [] if finding is None else [finding]
    try:
        result = calibrate_handeye(reference, members, options)
    except (EstimationError, UnobservableError) as error:
        raise explain_failure(reference, members, error, options) from error
    determined = any(camera.has_figures for camera in result.members.values())
    checks: tuple[SensorCheck, ...] = ()
    if options.method == "ml" and determined:  # else there is nothing that could agree
        checks = tuple(check_handeye(reference, members, result, options))
        steady = [c for m in members for c in check_steadiness(reference, m, result)]
        checks += tuple(steady)
    refuse(checks, "No calibration is made from it.")
    if checks and not options.scale:
        result, scaled = _with_scales(reference, members, result, options)
        checks += scaled
    noticed += [
        f for name, scale in _scales_of(result).items() if (f := scale_finding(reference.name, name, scale))
    ]
    return result, checks, tuple(noticed)


def _with_scales(
    reference: Trajectory, members: Sequence[Trajectory], result: HandeyeResult, options: HandeyeOptions
) -> tuple[HandeyeResult, tuple[SensorCheck, ...]]:
    """The result with a scale of every member, where the lengths of one are evidently not those of the reference.

    Odometries that call themselves metric are some percent off in scale; offsets would take that up. Raises InputError
    where no odometry errs so much.
    """
    evident = {name: found for name, found in _scales_of(result).items() if found.is_evident}
    far = [name for name, found in evident.items() if not 1 / _MOST_SCALE < found.value < _MOST_SCALE]
    refuse(
        (_scale_check(reference, name, evident[name].value, False) for name in far),
        "Its offset would be wrong.",
    )
    if not evident:
        return result, ()
    again = calibrate_handeye(reference, members, replace(options, scale=True))
    found = {name: float(again.scales[name][0, 0]) for name in evident if len(again.scales.get(name, ()))}
    if not all(np.isfinite(list(found.values()))):
        return result, ()  # its covariance counts the scale
    return again, tuple(_scale_check(reference, name, scale, True) for name, scale in found.items())


def _scales_of(result: HandeyeResult) -> dict[str, RelativeScale]:
    stated = {name: camera.statistics.get("relative_scale") for name, camera in result.members.items()}
    return {name: RelativeScale(*scale) for name, scale in stated.items() if scale is not None}


def _scale_check(reference: Trajectory, name: str, scale: float, estimated: bool) -> SensorCheck:
    words = f"its lengths are {1 / scale:.3f} times those of {reference.name}"
    return SensorCheck(
        f"trajectory {name}",
        estimated,
        scale,
        _MOST_SCALE,
        f"{words}; a scale was estimated." if estimated else f"{words}.",
        "" if estimated else "Correct the lengths, or give --scale to estimate a scale.",
        "scale against the reference",
        "repaired" if estimated else "none",
    )
