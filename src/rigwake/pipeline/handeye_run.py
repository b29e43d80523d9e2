"""Hand-eye calibration with the checks around it."""

from __future__ import annotations

from collections.abc import Sequence

from rigwake.errors import EstimationError, UnobservableError
from rigwake.handeye.handeye_problem import HandeyeOptions, HandeyeResult, in_one_unit
from rigwake.handeye.joint_calibration import calibrate_handeye
from rigwake.handeye.relative_scale import RelativeScale, scale_finding
from rigwake.plausibility.handeye_fit import check_handeye, explain_failure
from rigwake.plausibility.values import SensorCheck, refuse
from rigwake.recording import Finding
from rigwake.trajectory import Trajectory


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
    for name, camera in result.members.items():
        if (scale := camera.statistics.get("relative_scale")) is not None:
            finding = scale_finding(reference.name, name, RelativeScale(*scale))
            noticed += [] if finding is None else [finding]
    determined = any(camera.has_figures for camera in result.members.values())
    checks: tuple[SensorCheck, ...] = ()
    if options.method == "ml" and determined:  # else there is nothing that could agree
        checks = tuple(check_handeye(reference, members, result, options))
    refuse(checks, "No calibration is made from it.")
    return result, checks, tuple(noticed)
