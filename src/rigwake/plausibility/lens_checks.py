"""Lenses, judged by their own tracks: focal length, principal point, pictures turned or mirrored, another's lens."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from rigwake.cameras.protocol import CameraModel
from rigwake.errors import RigwakeError
from rigwake.plausibility.lens_fit import LensFit, fit_lens, focal_growth
from rigwake.plausibility.values import SensorCheck
from rigwake.tracks import Tracks
from rigwake.trajectory import Trajectory

_SCALE = 0.0075
_SHIFT_PX, _SHIFT_OF_WIDTH = 2.0, 0.003
_SIGMAS = 6.0
_GROWTH = 0.005  # of the focal length during a recording; warmth does less, and good recordings show 0.003
_UNCERTAIN_SCALE, _UNCERTAIN_PX = 0.01, 5.0  # a fit less sure than this says nothing
# noise of tracks pulls a lens by its square: per px^2 of the epipolar distances, found on simulated ferries
_PULL_SCALE, _PULL_PX = 0.5, 450.0


def is_off(fit: LensFit, width_px: int) -> bool:
    """Whether focal length or principal point are off by more than chance and more than matters."""
    std = np.sqrt(np.maximum(np.diag(fit.covariance), 0.0))
    noise = fit.refined_rms_px**2
    limit_scale = _SCALE + _PULL_SCALE * noise
    scale_off = abs(fit.scale - 1) > max(limit_scale, _SIGMAS * std[0]) and std[0] < _UNCERTAIN_SCALE
    limit_px = max(_SHIFT_PX, _SHIFT_OF_WIDTH * width_px) + _PULL_PX * noise
    shift_off = np.abs(fit.shift_px) > np.maximum(limit_px, _SIGMAS * std[1:])
    return bool(scale_off or (shift_off & (std[1:] < _UNCERTAIN_PX)).any())


def fit_lenses(
    tracks: Mapping[str, Tracks], models: Mapping[str, CameraModel], trajectories: Mapping[str, Trajectory]
) -> dict[str, LensFit]:
    """The lens fit of every camera that allows one; one that seems off is looked at without the bias of noise."""
    found = {}
    for name, trajectory in trajectories.items():
        try:
            fit = fit_lens(tracks[name], models[name], trajectory)
            if is_off(fit, models[name].width_px):
                fit = fit_lens(tracks[name], models[name], trajectory, unbiased=True)
            found[name] = fit
        except RigwakeError:
            continue
    return found


def check_lenses(
    fits: Mapping[str, LensFit],
    tracks: Mapping[str, Tracks],
    models: Mapping[str, CameraModel],
    trajectories: Mapping[str, Trajectory],
) -> tuple[SensorCheck, ...]:
    """One check per camera, with what is wrong where its tracks contradict its lens."""
    checks = []
    for name, fit in fits.items():
        lens = models[name]
        quantity = "focal length by its tracks over that given"
        if not is_off(fit, lens.width_px):
            grown = _growth(name, fit, tracks[name], lens, trajectories[name])
            sound = SensorCheck(f"camera {name}", True, fit.scale, 1.0, quantity=quantity, part="lens")
            checks.append(sound if grown is None else grown)
            continue
        std = np.sqrt(np.diag(fit.covariance))
        words = (
            f"its lens does not fit its own tracks: they ask for a focal length of {fit.scale:.4f} ± {std[0]:.4f} "
            f"times the one given and a principal point {fit.shift_px[0]:+.1f}, {fit.shift_px[1]:+.1f} "
            f"(± {std[1]:.1f}, {std[2]:.1f}) px away"
        )
        cause = _turned_picture(fit, lens) or _another_lens(name, tracks, models, trajectories)
        remedy = "Give its own lens at this resolution and focus (`rigwake intrinsics` finds it)."
        hypothesis = f"{words}; {cause}." if cause else f"{words}."
        checks.append(
            SensorCheck(f"camera {name}", False, fit.scale, 1.0, hypothesis, remedy, quantity, part="lens")
        )
    return tuple(checks)


def _growth(
    name: str, fit: LensFit, tracks: Tracks, lens: CameraModel, trajectory: Trajectory
) -> SensorCheck | None:
    """A focal length that changes from the beginning to the end, by more than chance and more than matters."""
    found = focal_growth(tracks, lens, trajectory)
    limit = _GROWTH + _PULL_SCALE * fit.refined_rms_px**2
    if found is None or abs(found[0]) < max(limit, _SIGMAS * found[1]):
        return None
    words = (
        f"its focal length changes during the recording: by {100 * found[0]:+.2f} ± {100 * found[1]:.2f} % from the "
        "first third to the last (autofocus, or somebody turned the lens)."
    )
    remedy = "Fix its focus; calibrate a part (--start, --duration)."
    quantity = "focal length in the last third over that in the first, less one"
    return SensorCheck(f"camera {name}", False, found[0], limit, words, remedy, quantity)


def is_turned(fit: LensFit, lens: CameraModel) -> bool:
    """Whether the pictures were turned or mirrored, by where the tracks want the principal point."""
    return bool(_turned_picture(fit, lens))


def _turned_picture(fit: LensFit, lens: CameraModel) -> str:
    """What was done to the pictures, if it puts the principal point where the tracks want it."""
    centre = lens.project(np.array([[0.0, 0.0, 1.0]]))[0][0]
    across, down = lens.width_px - 1 - 2 * centre[0], lens.height_px - 1 - 2 * centre[1]
    std = np.sqrt(np.diag(fit.covariance))[1:]
    found = {
        "its pictures are turned by 180 deg against its lens": np.array([across, down]),
        "its pictures are mirrored left to right against its lens": np.array([across, 0.0]),
        "its pictures are mirrored top to bottom against its lens": np.array([0.0, down]),
    }
    if abs(fit.scale - 1) > _SCALE:
        return ""
    off = {
        words: float(np.max(np.abs(fit.shift_px - shift) / (3 * std + 0.4))) for words, shift in found.items()
    }
    best = min(off, key=lambda words: off[words])
    return best if off[best] < 1 else ""


def _another_lens(
    name: str,
    tracks: Mapping[str, Tracks],
    models: Mapping[str, CameraModel],
    trajectories: Mapping[str, Trajectory],
) -> str:
    """The camera of the recording whose lens fits the tracks, if there is one."""
    for other, lens in models.items():
        same_size = (lens.width_px, lens.height_px) == (models[name].width_px, models[name].height_px)
        if other == name or not same_size:
            continue
        try:
            fit = fit_lens(tracks[name], lens, trajectories[name])
        except RigwakeError:
            continue
        if not is_off(fit, lens.width_px):
            return f"the lens of {other} fits them (focal length {fit.scale:.4f})"
    return ""
