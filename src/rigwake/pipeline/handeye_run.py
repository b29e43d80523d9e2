"""Hand-eye calibration with the checks around it."""

from __future__ import annotations

from collections.abc import Sequence

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
        checks += tuple(c for m in members for c in check_steadiness(reference, m, result))
        scales = (_check_scale(reference, name, scale) for name, scale in _scales_of(result).items())
        checks += tuple(check for check in scales if check)
    refuse(checks, "No calibration is made from it.")
    noticed += [
        f for name, scale in _scales_of(result).items() if (f := scale_finding(reference.name, name, scale))
    ]
    return result, checks, tuple(noticed)


def _scales_of(result: HandeyeResult) -> dict[str, RelativeScale]:
    stated = {name: camera.statistics.get("relative_scale") for name, camera in result.members.items()}
    return {name: RelativeScale(*scale) for name, scale in stated.items() if scale is not None}


def _check_scale(reference: Trajectory, name: str, scale: RelativeScale) -> SensorCheck | None:
    """A scale that no odometry errs by is another unit; less counts in the covariance."""
    if not scale.is_evident or 1 / _MOST_SCALE < scale.value < _MOST_SCALE:
        return None
    return SensorCheck(
        f"trajectory {name}",
        False,
        scale.value,
        _MOST_SCALE,
        f"its lengths are {1 / scale.value:.3f} times those of {reference.name}.",
        "Correct the lengths, or give --scale to estimate a scale.",
        "scale against the reference",
    )
