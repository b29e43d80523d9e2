"""Gyroscope, clocks and mounts, judged by how every camera's turns fit the gyroscope's."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from itertools import permutations

import numpy as np

from rigwake._robust import robust_std
from rigwake._types import Array
from rigwake.geometry import so3
from rigwake.plausibility.turn_fit import TurnFit, rotation_between
from rigwake.plausibility.values import SensorCheck

EXPLAINED = 0.15
_SCALE = 0.01
_AGREED = 0.004  # spread of the scales that cameras ask for, to be one scale
_SIGMAS = 6.0
_SURE = 3.0
_DRIFT = 2.5e-4
_TURNED = np.deg2rad(0.2)
# by which the robust cost falls when a knock is undone: one bad rotation among many gains 0.1
_CONFIRMED = 3.0
_FEWEST = 8  # strides on either side of a change
# tried at once: of a long recording evenly spread ones, then those beside the best
_MOST_SPLITS = 200


def check_scale(
    fits: Mapping[str, TurnFit], sound_lenses: frozenset[str], focal_stds: Mapping[str, float] | None = None
) -> tuple[tuple[SensorCheck, ...], float | None]:
    """The gyroscope's scale by cameras whose lens is known to be right, and the factor that corrects it.

    focal_stds: how well tracks tell the focal lengths, as a part of them: one camera whose lens they do not tell
    accuses both. Cameras that stand alone with a wrong scale are checks of their own. The factor is None where none
    is needed, or where fewer than two cameras agree on one.
    """
    quantity = "a camera's turns over the gyroscope's"
    known = {n: f for n, f in fits.items() if f.unexplained <= EXPLAINED and n in sound_lenses}
    if not known:
        return (), None
    middle = float(np.median([f.scale for f in known.values()]))
    off = {n: f for n, f in known.items() if _is_off(f)}
    if len(off) * 2 <= len(known):
        checks = [SensorCheck("gyroscope", True, middle, 1.0, quantity=quantity)]
        checks += [_camera_scale(name, fit) for name, fit in off.items()]
        return tuple(checks), None
    spread = max(abs(f.scale / middle - 1) for f in off.values())
    words, remedy = _scale_words(off, focal_stds or {})
    check = SensorCheck("gyroscope", False, middle, 1.0, f"{words}.", remedy, quantity)
    agreed = len(off) >= 2 and spread < _AGREED and abs(middle - 1) < 0.1
    return (check,), middle if agreed else None


def _scale_words(off: Mapping[str, TurnFit], focal_stds: Mapping[str, float]) -> tuple[str, str]:
    """What is wrong where these cameras turned otherwise than the gyroscope says, and the remedy."""
    name, fit = next(iter(off.items()))
    if len(off) == 1 and _SURE * focal_stds.get(name, 0.0) > abs(fit.scale - 1):
        words = (
            f"it does not agree with {name}, which turned by {fit.scale:.4f} of it: its scale, the focal length, or an "
            f"unknown read-out time of {name} is to blame; the tracks do not tell which"
        )
        remedy = (
            "Calibrate the lens (`rigwake intrinsics`) and the gyroscope's scale; of a rolling shutter say how long a "
            f"row takes to be read (--set 'line_delay_s={{{name}: 3e-5}}')."
        )
        return words, remedy
    turned = ", ".join(f"{n} turned by {f.scale:.4f} of it" for n, f in sorted(off.items()))
    words = f"its scale is wrong: {turned}, although the lenses fit their own tracks"
    return words, "Calibrate the gyroscope's scale, or check its unit and the rate that its stamps claim."


def scale_of_lenses(
    fits: Mapping[str, TurnFit], sound_lenses: frozenset[str], witnesses: frozenset[str]
) -> dict[str, float]:
    """By camera whose lens the gyroscope contradicts: its turns over the gyroscope's, the factor of its focal length.

    witnesses: cameras with lenses known well enough to tell that it is the gyroscope: where most agree on one scale of
    it, no lens is to blame.
    """
    known = {n: f for n, f in fits.items() if f.unexplained <= EXPLAINED and n in sound_lenses}
    off = {n: f.scale for n, f in known.items() if _is_off(f)}
    seen = [scale for name, scale in off.items() if name in witnesses]
    agreed = len(seen) >= 2 and max(seen) - min(seen) < 2 * _AGREED
    return {} if agreed and len(seen) * 2 > len(known) else off


def _is_off(fit: TurnFit) -> bool:
    return bool(abs(fit.scale - 1) > max(_SCALE, _SIGMAS * fit.std[7]))


def _camera_scale(name: str, fit: TurnFit) -> SensorCheck:
    words = f"it turns by {fit.scale:.4f} of what the gyroscope and the other cameras say: its lens is wrong."
    remedy = "Calibrate its lens (`rigwake intrinsics`)."
    return SensorCheck(f"camera {name}", False, fit.scale, 1.0, words, remedy, "turns over the gyroscope's")


def check_clocks(fits: Mapping[str, TurnFit]) -> tuple[SensorCheck, ...]:
    """Clocks that drift: one camera's against the IMU, or the IMU's against all cameras."""
    quantity = "seconds lost against the IMU's clock per second"
    known = {n: f for n, f in fits.items() if f.unexplained <= EXPLAINED}
    off = {n: f for n, f in known.items() if abs(f.drift) > max(_DRIFT, _SIGMAS * f.std[8])}
    common = float(np.median([f.drift for f in known.values()])) if known else 0.0
    alike = [n for n, f in off.items() if abs(f.drift - common) < max(0.3 * abs(common), 3 * f.std[8])]
    if len(known) >= 2 and len(alike) * 2 > len(known):
        words = (
            f"its clock runs {1e6 * common:+.0f} ppm against every camera's: its stamps claim a wrong rate."
        )
        remedy = "Stamp samples when they are taken; check the rate that the driver assumes."
        return (SensorCheck("imu", False, common, _DRIFT, words, remedy, quantity),)
    checks = []
    for name, fit in off.items():
        words = (
            f"its clock drifts against the IMU's by {1e6 * fit.drift:+.0f} ± {1e6 * fit.std[8]:.0f} ppm, "
            f"{1e3 * abs(fit.drift) * (fit.end_ns[-1] - fit.start_ns[0]) * 1e-9:.0f} ms over the recording."
        )
        remedy = "Synchronise its clock (PTP, hardware trigger) or stamp its images on one computer."
        checks.append(SensorCheck(f"camera {name}", False, fit.drift, _DRIFT, words, remedy, quantity))
    return tuple(checks)


@dataclass(frozen=True, eq=False)
class MountChange:
    """A camera that sat otherwise before than after: when (its own clock), and both `imu_from_cam` (3, 3).

    std: of the angle between both. knock: the turn that the camera saw then and the gyroscope did not, radians, or None
    where no single stride shows it.
    """

    at_ns: int
    before: Array
    after: Array
    std: float
    knock: float | None = None

    @property
    def turned(self) -> float:
        """Angle between both, radians."""
        return float(np.linalg.norm(so3.log(self.before.T @ self.after)))


def mount_change(fit: TurnFit) -> MountChange | None:
    """The time that best splits a camera's turns into two mountings; None where one mounting explains them as well.

    A camera that was knocked, exchanged or whose picture was turned keeps its own turns, but no longer under one
    rotation towards the IMU. A knock is also a turn of the camera that the gyroscope did not feel: where one stride
    shows it, the same turn between both sides confirms it.
    """
    turns, gyro, n = fit.camera_turns, gyro_turns(fit), len(fit.camera_turns)
    if n < 2 * _FEWEST:
        return None
    sizes = np.linalg.norm(fit.residuals, axis=1)
    knocks = []
    for k in np.flatnonzero(sizes > max(_TURNED, 10 * fit.rms)).tolist():
        if _FEWEST <= k < n - _FEWEST and _stays(fit, gyro, k):
            knocks.append(replace(_split(fit, gyro, k, 1), knock=float(sizes[k])))
    if knocks:
        return max(knocks, key=lambda found: found.knock or 0.0)
    first, last = _FEWEST, n - _FEWEST
    while True:
        step = max(1, (last - first) // _MOST_SPLITS)
        costs = {
            k: _misfit(turns[:k], gyro[:k], fit.rms) + _misfit(turns[k:], gyro[k:], fit.rms)
            for k in range(first, last + 1, step)
        }
        at = min(costs, key=lambda k: costs[k])
        if step == 1:
            break
        first, last = max(first, at - step), min(last, at + step)
    best = _split(fit, gyro, at, 0)
    return best if best.turned > max(_TURNED, _SIGMAS * best.std) else None


def _stays(fit: TurnFit, gyro: Array, k: int) -> bool:
    """Whether the turn that stride k shows beyond the gyroscope's is there to stay: undone, all later turns fit better.

    A bad pose makes two such strides, which cancel; what stays may hide in the gyroscope's bias, so the bias is free.
    A single stride proves nothing: where the later turns are too few to tell, it is no knock.
    """
    before, after = fit.residuals[k - 1], fit.residuals[k + 1]
    if min(np.linalg.norm(fit.residuals[k] + x) for x in (before, after)) < 0.5 * np.linalg.norm(
        fit.residuals[k]
    ):
        return False
    knock = so3.exp(fit.imu_from_cam.T @ fit.residuals[k])
    others = np.arange(len(gyro)) != k
    undone = fit.camera_turns.copy()
    undone[k + 1 :] = undone[k + 1 :] @ knock.T
    given = _misfit(fit.camera_turns[others], gyro[others], fit.rms, biased=True)
    return given - _misfit(undone[others], gyro[others], fit.rms, biased=True) > _CONFIRMED


def _split(fit: TurnFit, gyro: Array, k: int, skipped: int) -> MountChange:
    """Both mountings for a change at stride k; so many strides from there on belong to neither."""
    sides = (slice(0, k), slice(k + skipped, None))
    mounts = [rotation_between(fit.camera_turns[part], gyro[part]) for part in sides]
    stds = [
        _rotation_std(fit.camera_turns[part], gyro[part], X) for part, X in zip(sides, mounts, strict=True)
    ]
    return MountChange(int(fit.start_ns[k]), mounts[0], mounts[1], float(np.hypot(stds[0], stds[1])))


def gyro_turns(fit: TurnFit) -> Array:
    """(N, 3) rotation vectors of the gyroscope over the strides, from the camera's and the residuals."""
    turned = fit.imu_from_cam @ so3.exp(fit.camera_turns) @ fit.imu_from_cam.T
    return so3.log(turned @ so3.exp(-fit.residuals))


def _misfit(turns: Array, gyro: Array, noise: float, *, biased: bool = False) -> float:
    """Robust cost of the best rotation; biased: of the best rotation and bias."""
    if biased:
        turns, gyro = turns - turns.mean(axis=0), gyro - gyro.mean(axis=0)
    X = rotation_between(turns, gyro)
    off = np.linalg.norm(turns @ X.T - gyro, axis=1)
    return float(np.sum(np.log1p((off / max(3 * noise, 1e-4)) ** 2)))


def _rotation_std(turns: Array, gyro: Array, X: Array) -> float:
    off = turns @ X.T - gyro
    noise = robust_std(off)
    moment = np.einsum("ni,nj->ij", gyro, gyro)
    information = np.trace(moment) * np.eye(3) - moment  # of a rotation that is told by how it turns vectors
    return float(noise / np.sqrt(max(float(np.linalg.eigvalsh(information)[0]), 1e-12)))


def check_mounts(fits: Mapping[str, TurnFit]) -> tuple[SensorCheck, ...]:
    """Cameras that were knocked, exchanged or turned during the recording, with the time."""
    quantity = "turn of the mount during the recording, deg"
    changes = {}
    for name, fit in fits.items():
        change = mount_change(fit)
        if change is not None:
            changes[name] = change
    partners = _exchanged(changes)
    if len(changes) > 1 and len(changes) == len(fits) and not partners:
        return (_moved_imu(fits, changes, quantity),)
    checks = []
    for name, change in changes.items():
        at = (change.at_ns - int(fits[name].start_ns[0])) * 1e-9
        size = np.rad2deg(change.turned)
        if name in partners:
            words = f"it and {partners[name]} are exchanged from {at:.1f} s on."
            remedy = "Calibrate the part before or after (--start, --duration)."
        elif size > 20:
            words = (
                f"it looks {size:.0f} deg elsewhere from {at:.1f} s on: pictures of another camera, turned pictures, "
                "or a mount that moved."
            )
            remedy = "Calibrate the part before or after (--start, --duration)."
        else:
            size = size if change.knock is None else np.rad2deg(change.knock)
            words = f"it was knocked at {at:.1f} s: its mount turned by {size:.2f} deg."
            remedy = "Fix its mount; calibrate the part before or after (--start, --duration)."
        checks.append(
            SensorCheck(
                f"camera {name}", False, float(size), float(np.rad2deg(_TURNED)), words, remedy, quantity
            )
        )
    return tuple(checks)


def _moved_imu(fits: Mapping[str, TurnFit], changes: Mapping[str, MountChange], quantity: str) -> SensorCheck:
    """Where every camera's mounting seems to change, it is what all are compared with."""
    told = ", ".join(
        f"{name} by {np.rad2deg(change.knock or change.turned):.2f} deg at "
        f"{(change.at_ns - int(fits[name].start_ns[0])) * 1e-9:.1f} s"
        for name, change in changes.items()
    )
    words = (
        f"no camera keeps its mounting against it ({told}): it moved, or one axis of its gyroscope is wrong."
    )
    remedy = "Fix its mount; check the scale and range of every axis of the gyroscope."
    size = float(np.rad2deg(np.median([change.turned for change in changes.values()])))
    return SensorCheck("imu", False, size, float(np.rad2deg(_TURNED)), words, remedy, quantity)


def _exchanged(changes: Mapping[str, MountChange]) -> dict[str, str]:
    """Cameras that sit after a change where another sat before it, and the other way round."""
    found = {}
    for a, b in permutations(changes, 2):
        there = np.linalg.norm(so3.log(changes[a].after.T @ changes[b].before))
        back = np.linalg.norm(so3.log(changes[b].after.T @ changes[a].before))
        if max(there, back) < np.deg2rad(10) and changes[a].turned > np.deg2rad(15):
            found[a] = b
    return found
