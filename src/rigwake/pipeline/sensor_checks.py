"""Every sensor against the rest, before and after the cameras' own stage: repaired, left out, or refused by name."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from rigwake.cameras.protocol import CameraModel
from rigwake.errors import EstimationError, RigwakeError, UsageError
from rigwake.pipeline.stream_selection import Selection
from rigwake.plausibility.coarse_turns import vet_turns
from rigwake.plausibility.force_checks import ForceVerdict, check_forces, compare_forces
from rigwake.plausibility.force_fit import ForceFit, longest_segment
from rigwake.plausibility.gyro_axes import check_axes
from rigwake.plausibility.imu_samples import vet_samples
from rigwake.plausibility.jitter_checks import check_jitter
from rigwake.plausibility.lens_checks import check_lenses, fit_lenses, is_off
from rigwake.plausibility.lens_fit import LensFit
from rigwake.plausibility.picture_checks import check_pictures
from rigwake.plausibility.receiver_checks import vet_receiver
from rigwake.plausibility.receiver_fit import level_path
from rigwake.plausibility.stamp_rates import rate_of_stamps, turns_of, varies, with_rate
from rigwake.plausibility.turn_checks import EXPLAINED, check_clocks, check_mounts, check_scale, mount_change
from rigwake.plausibility.turn_fit import TurnFit, camera_as_gyroscope, fit_turns
from rigwake.plausibility.values import SensorCheck, disagreeing, refuse
from rigwake.recording import CameraStream, GnssStream, ImuStream
from rigwake.tracking.camera_rotations import visual_rotations
from rigwake.tracks import Tracks
from rigwake.trajectory import Trajectory

_UNRELATED = 0.5  # of a camera's turns that the gyroscope does not explain
_WELL_EXPLAINED, _FAR_WORSE = 0.05, 8.0


@dataclass(frozen=True, eq=False)
class VettedSensors:
    """What takes part after the checks. left_out: sensors that do not, with the reason, by their name in the checks."""

    selection: Selection
    checks: tuple[SensorCheck, ...] = ()
    turns: Mapping[str, Trajectory] = field(default_factory=dict)
    left_out: Mapping[str, str] = field(default_factory=dict)


def vet_imu(selection: Selection, names: tuple[str, ...], *, repair: bool) -> VettedSensors:
    """The IMU by itself, and against the coarse turns of the cameras `names`, before anything is tracked.

    Raises InputError that names what is wrong, if it is more than a unit.
    """
    imu = selection.imu
    if imu is None:
        return VettedSensors(selection)
    samples = vet_samples(imu, repair=repair)
    refuse(samples.checks)
    turns = {name: found for name in names if (found := _rotation_vectors(selection, name)) is not None}
    turned = vet_turns(samples.imu, turns, repair=repair)
    refuse(turned.checks)
    return VettedSensors(replace(selection, imu=turned.imu), (*samples.checks, *turned.checks), turns)


def _rotation_vectors(selection: Selection, name: str) -> Trajectory | None:
    try:
        return visual_rotations(selection.cameras[name])
    except (EstimationError, UsageError):
        return None


def vet_sensors(
    selection: Selection,
    tracks: Mapping[str, Tracks],
    trajectories: Mapping[str, Trajectory],
    *,
    without_horizon: frozenset[str] = frozenset(),
    lenses: Mapping[str, LensFit] | None = None,
    pardoned: frozenset[str] = frozenset(),
    repair: bool,
) -> VettedSensors:
    """Lenses, gyroscope, clocks, mounts, accelerometer and GNSS from what every camera saw by itself.

    tracks, trajectories: by camera. without_horizon: cameras that show nothing above the horizon that the IMU tells;
    they never take part. lenses: their fits, where they are known already. pardoned: cameras of which nothing is said,
    as long as their lens is not known. Cameras that disagree are left out while others remain; so is GNSS if there is
    an IMU. Raises InputError that names what is wrong where nothing can be left out.
    """
    models = {name: m for name in trajectories if (m := selection.cameras[name].model) is not None}
    found = compare_sensors(selection.imu, tracks, models, trajectories, lenses=lenses, repair=repair)
    spared = {f"camera {name}" for name in pardoned}
    checks, imu = [check for check in found.checks if check.sensor not in spared], found.imu
    accused = {check.sensor for check in disagreeing(checks)}
    checks += [_without_horizon(n) for n in sorted(without_horizon) if f"camera {n}" not in accused]
    refuse([check for check in checks if not check.sensor.startswith("camera ")])
    cameras, checks = _cameras_left(tuple(trajectories), checks)
    gnss, by_gnss = _receiver(selection.gnss, found, cameras, trajectories, repair)
    checks += by_gnss
    left_out = {check.sensor: check.hypothesis for check in checks if check.action == "left out"}
    chosen = {
        name: stream
        for name, stream in selection.cameras.items()
        if name in cameras or name not in trajectories
    }
    return VettedSensors(
        replace(selection, cameras=chosen, imu=imu, gnss=gnss), tuple(checks), left_out=left_out
    )


@dataclass(frozen=True, eq=False)
class Comparison:
    """Every camera against its lens and the IMU: the checks, the IMU (repaired), and what GNSS is compared by."""

    checks: tuple[SensorCheck, ...]
    imu: ImuStream | None
    fits: Mapping[str, TurnFit]
    forces: Mapping[str, ForceVerdict]


def compare_sensors(
    imu: ImuStream | None,
    tracks: Mapping[str, Tracks],
    models: Mapping[str, CameraModel],
    trajectories: Mapping[str, Trajectory],
    *,
    lenses: Mapping[str, LensFit] | None = None,
    repair: bool,
) -> Comparison:
    """Lenses, gyroscope, clocks, mounts and accelerometer; raises nothing for what does not agree."""
    lenses = fit_lenses(tracks, models, trajectories) if lenses is None else lenses
    checks = [*check_pictures(tracks), *check_lenses(lenses, tracks, models, trajectories)]
    if imu is None:
        checks += _without_gyroscope(trajectories) if len(trajectories) > 1 else []
        return Comparison(tuple(checks), None, {}, {})
    sound = frozenset(name for name, fit in lenses.items() if not is_off(fit, models[name].width_px))
    fits, found = _fit_all(trajectories, imu)
    checks += found
    focal_stds = {name: float(np.sqrt(max(fit.covariance[0, 0], 0.0))) for name, fit in lenses.items()}
    fits, imu, found = _scaled(trajectories, fits, imu, sound, focal_stds, repair)
    checks += [*found, *check_clocks(fits), *check_jitter(trajectories, imu, fits)]
    # a wrong axis of the gyroscope looks like a mount of every camera that moves; a wrong focal length looks like a
    # wrong axis: it scales turns about two axes of the camera, not those about the optical axis
    checks += check_axes({n: f for n, f in fits.items() if n in sound or n not in lenses}) or check_mounts(
        fits
    )
    steady = {n: f for n, f in fits.items() if not _is_accused(n, checks)}
    forces = compare_forces(trajectories, imu, steady)
    checks += check_forces(forces)
    return Comparison(tuple(checks), imu, fits, forces)


def imu_checks(imu: ImuStream, cameras: Mapping[str, CameraStream]) -> tuple[SensorCheck, ...]:
    """What an IMU's samples and the cameras' coarse turns tell, without repairing or refusing anything."""
    samples = vet_samples(imu, repair=True)
    turns = {}
    for name, stream in cameras.items():
        try:
            turns[name] = visual_rotations(stream)
        except (EstimationError, UsageError):
            continue
    return (*vet_samples(imu, repair=False).checks, *vet_turns(samples.imu, turns, repair=False).checks)


def _without_horizon(name: str) -> SensorCheck:
    words = "above the horizon that the IMU tells its pictures show nothing to follow, below it they do."
    remedy = "Check that its pictures are neither mirrored nor of another camera, and the IMU's axes."
    return SensorCheck(f"camera {name}", False, 1.0, 0.0, words, remedy, "below the horizon")


def _without_gyroscope(trajectories: Mapping[str, Trajectory]) -> list[SensorCheck]:
    """Cameras against the one that lasts longest: clocks that drift, mounts that changed, turns that do not match."""
    reference_camera = max(trajectories, key=lambda n: len(longest_segment(trajectories[n])))
    others = {name: path for name, path in trajectories.items() if name != reference_camera}
    fits, found = _fit_all(others, camera_as_gyroscope(longest_segment(trajectories[reference_camera])))
    found = [*found, *check_clocks(fits), *check_mounts(fits)]
    wrong = [check for check in found if not check.agrees]
    named = {check.sensor for check in wrong}
    if wrong and (len(named) >= len(others) or "gyroscope" in named or "imu" in named):
        # all of the others, or the only other: it may as well be the reference camera
        either = "it" if len(others) > 1 else f"it or {next(iter(others))}"
        words = f"{wrong[0].hypothesis} Compared with the others' turns; {either} is at fault."
        return [replace(wrong[0], sensor=f"camera {reference_camera}", hypothesis=words)] + (
            [replace(check, sensor=f"camera {name}") for name in others for check in wrong[:1]]
            if len(others) == 1
            else []
        )
    return found


def _is_accused(name: str, checks: list[SensorCheck]) -> bool:
    return any(check.sensor == f"camera {name}" for check in disagreeing(checks))


def _fit_all(
    trajectories: Mapping[str, Trajectory], imu: ImuStream
) -> tuple[dict[str, TurnFit], list[SensorCheck]]:
    """Every camera's turns against the gyroscope's; those that have nothing to do with it are checks."""
    fits: dict[str, TurnFit] = {}
    unrelated: dict[str, float] = {}
    for name, trajectory in trajectories.items():
        try:
            fit = fit_turns(trajectory, imu)
        except RigwakeError:
            # too short, or hardly turning: nothing to say; else nothing of its turns is the gyroscope's
            if varies(trajectory) and varies(turns_of(imu)):
                unrelated[name] = 1.0
            continue
        fits[name] = fit
        if fit.unexplained > _UNRELATED:
            unrelated[name] = fit.unexplained
    unrelated |= _odd_ones(fits)
    quantity = "part of its turns that the gyroscope does not explain"
    if unrelated and not fits.keys() - unrelated.keys() and len(unrelated) > 1:
        worst = float(np.median(list(unrelated.values())))
        words = f"it leaves {100 * worst:.0f} % of every camera's turns unexplained, at any mounting and time offset."
        remedy = "Check that the IMU belongs to this recording, its axes, unit and stamps."
        rates = [
            r for name in unrelated if (r := _rate(imu, trajectories[name], unrelated[name])) is not None
        ]
        if len(rates) * 2 > len(unrelated):
            words += f" They agree if its stamps run {1 / float(np.median(rates)):.3f} times as fast as the cameras'."
        return {}, [SensorCheck("gyroscope", False, worst, _UNRELATED, words, remedy, quantity)]
    checks = []
    for name, figure in unrelated.items():
        words = f"the gyroscope explains only {100 * (1 - figure):.0f} % of its turns, at any mounting and time offset."
        if (rate := _rate(imu, trajectories[name], figure)) is not None:
            words += f" It agrees if its stamps run {rate:.3f} times as fast as the IMU's."
        remedy = (
            "Check that its pictures belong to this recording, are neither turned nor cut, and their stamps."
        )
        checks.append(SensorCheck(f"camera {name}", False, figure, _UNRELATED, words, remedy, quantity))
    return {n: f for n, f in fits.items() if n not in unrelated}, checks


def _odd_ones(fits: Mapping[str, TurnFit]) -> dict[str, float]:
    """Cameras a good part of whose turns the gyroscope does not explain although it explains all of the others'."""
    left = {name: fit.unexplained for name, fit in fits.items()}
    found = {}
    for name, figure in left.items():
        others = [x for other, x in left.items() if other != name]
        usual = float(np.median(others)) if others else 1.0
        odd = usual < _WELL_EXPLAINED and figure > max(EXPLAINED, _FAR_WORSE * usual)
        if odd and mount_change(fits[name]) is None:  # a knock is told with its time, below
            found[name] = figure
    return found


def _rate(imu: ImuStream, trajectory: Trajectory, unexplained: float) -> float | None:
    """Seconds of the camera per second of the IMU where that, and nothing else, makes their turns agree; else None."""
    rate = rate_of_stamps(imu, trajectory)
    try:
        left = 1.0 if rate is None else fit_turns(trajectory, with_rate(imu, rate)).unexplained
    except RigwakeError:
        return None
    return rate if left < min(0.3, 0.5 * unexplained) else None


def _scaled(
    trajectories: Mapping[str, Trajectory],
    fits: dict[str, TurnFit],
    imu: ImuStream,
    sound: frozenset[str],
    focal_stds: Mapping[str, float],
    repair: bool,
) -> tuple[dict[str, TurnFit], ImuStream, list[SensorCheck]]:
    """The gyroscope's scale, corrected where several cameras with sound lenses agree on it."""
    found, factor = check_scale(fits, sound, focal_stds)
    if factor is None or not repair:
        return fits, imu, list(found)
    again = {n: fit_turns(trajectories[n], replace(imu, gyro=imu.gyro * factor)) for n in fits}
    checks = [
        replace(c, hypothesis=f"{c.hypothesis} Multiplied by {factor:.4f}.").with_action("repaired")
        if c.sensor == "gyroscope"
        else c
        for c in found
    ]
    return again, replace(imu, gyro=imu.gyro * factor), checks


def _cameras_left(
    names: tuple[str, ...], checks: list[SensorCheck]
) -> tuple[tuple[str, ...], list[SensorCheck]]:
    """Cameras that nothing speaks against; raises InputError when there is none."""
    left = tuple(name for name in names if not _is_accused(name, checks))
    if not left:
        refuse(checks)
    accused = set(disagreeing(checks))
    return left, [check.with_action("left out") if check in accused else check for check in checks]


def _scale_uncertainty(force: ForceFit) -> float:
    """How far a scale by the accelerometer may be off: noise of the positions makes it too large, by its part of the
    accelerations squared."""
    return 0.03 + 2.5 * (force.left / max(force.moved, 1e-6)) ** 2 + 5 * force.scale_std


def _receiver(
    gnss: GnssStream | None,
    found: Comparison,
    cameras: tuple[str, ...],
    trajectories: Mapping[str, Trajectory],
    repair: bool,
) -> tuple[GnssStream | None, list[SensorCheck]]:
    """The receiver against the best path; what delays it is taken off its stamps.

    Of the paths that last at least half as long as the longest, that which agrees best with the gyroscope: fixes far
    from a path that jumps would be blamed for it.
    """
    if gnss is None:
        return None, []
    imu, fits, forces = found.imu, found.fits, found.forces
    usable = [n for n in cameras if imu is None or n in forces]
    level = imu is not None and bool(usable)
    if imu is not None and not usable:
        return gnss, []
    segments = {n: longest_segment(trajectories[n]) for n in usable}
    longest = max(len(segment) for segment in segments.values())
    long_enough = [n for n in usable if 2 * len(segments[n]) >= longest]
    misfit = {n: float(np.square(fits[n].residuals).mean()) for n in long_enough if n in fits}
    reference_camera = min(long_enough, key=lambda n: (misfit.get(n, 0.0), -len(segments[n])))
    segment = segments[reference_camera]
    force = forces[reference_camera].given if level else None
    sure = force is not None and force.scale_std < 0.05 and force.scale > 0
    vetted = vet_receiver(
        gnss,
        level_path(segment, force.gravity if force is not None else None),
        fits[reference_camera].time_offset_s if level else 0.0,
        level=level,
        inertial_scale=(force.scale, _scale_uncertainty(force)) if force is not None and sure else None,
        repair=repair,
    )
    checks = list(vetted.checks)
    if vetted.gnss is None:
        if imu is None:
            refuse(checks)
        return None, [c.with_action("left out") if c in disagreeing(checks) else c for c in checks]
    refuse(checks)
    late = round(vetted.delay_s * 1e9)
    return replace(vetted.gnss, timestamps_ns=vetted.gnss.timestamps_ns - late), checks
