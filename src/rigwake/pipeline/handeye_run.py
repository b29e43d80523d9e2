"""Hand-eye calibration with the checks around it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from rigwake.errors import EstimationError, UnobservableError
from rigwake.handeye.handeye_problem import HandeyeOptions, HandeyeResult, in_one_unit
from rigwake.handeye.joint_calibration import calibrate_handeye
from rigwake.plausibility.handeye_drift import check_steadiness, scale_against_reference
from rigwake.plausibility.handeye_fit import check_handeye, explain_failure
from rigwake.plausibility.values import SensorCheck, refuse
from rigwake.recording import Finding
from rigwake.trajectory import Trajectory

_LEAST_SCALE = 0.02  # less is drift
_MOST_SCALE = 1.25  # more is no error of an odometry but another unit
_SIGMAS, _SIGMAS_ESTIMATED = 6.0, 4.0


def run_handeye(
    reference: Trajectory, others: Sequence[Trajectory], options: HandeyeOptions
) -> tuple[HandeyeResult, tuple[SensorCheck, ...], tuple[Finding, ...]]:
    """The rig, how well each trajectory agrees with it, and what was noticed about units.

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
    return result, checks, tuple(noticed)


def _with_scales(
    reference: Trajectory, members: Sequence[Trajectory], result: HandeyeResult, options: HandeyeOptions
) -> tuple[HandeyeResult, tuple[SensorCheck, ...]]:
    """The result with a scale of every member, where the lengths of one are not those of the reference.

    Odometries that call themselves metric are some percent off in scale; offsets would take that up. Raises InputError
    where no odometry errs so much.
    """
    suspected = {}
    for member in members:
        scale, std = scale_against_reference(reference, member, result)
        if abs(scale - 1.0) > max(_LEAST_SCALE, _SIGMAS * std):
            suspected[member.name] = scale
    far = [name for name, scale in suspected.items() if not 1 / _MOST_SCALE < scale < _MOST_SCALE]
    checks = tuple(_scale_check(reference, name, suspected[name], False) for name in far)
    refuse(checks, "Its offset would be wrong.")
    if not suspected:
        return result, ()
    again = calibrate_handeye(reference, members, replace(options, scale=True))
    found = {name: again.scales[name][0] for name in suspected if len(again.scales.get(name, ()))}
    off = [name for name, (scale, std) in found.items() if abs(scale - 1.0) > _SIGMAS_ESTIMATED * std]
    if not off:
        return result, ()
    return again, tuple(_scale_check(reference, name, float(found[name][0]), True) for name in off)


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
