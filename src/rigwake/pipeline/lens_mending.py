"""Lenses that contradict their own tracks or the gyroscope, with a better start, so that the rig can refine them.

A focal length 3 % off bends every camera's own trajectory: from there the bundle adjustment of the rig does not find
back. The geometry of pairs of images and the turns of the gyroscope tell by how much focal length and principal point
are off; the lens is moved by that, and the camera's trajectory estimated again. What remains, distortion above all, is
left to the bundle adjustment, with a prior that believes the lens less.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.special import chdtri

from rigwake._types import Array
from rigwake.ba.rig.intrinsics_refinement import (
    FROM_A_FILE,
    IntrinsicsWidth,
    LensBelief,
    intrinsics_prior,
    moved_px,
)
from rigwake.cameras.moved_lens import moved_lens
from rigwake.cameras.protocol import CameraModel
from rigwake.errors import RigwakeError
from rigwake.odometry.monocular import estimate_monocular
from rigwake.odometry.odometry_options import OdometryOptions
from rigwake.pipeline.stream_selection import Selection
from rigwake.plausibility.lens_checks import check_lenses, fit_lenses, is_off, is_turned
from rigwake.plausibility.lens_fit import LensFit, fit_lens
from rigwake.plausibility.turn_checks import EXPLAINED, scale_of_lenses
from rigwake.plausibility.turn_fit import fit_turns
from rigwake.plausibility.values import SensorCheck, refuse
from rigwake.recording import ImuStream
from rigwake.tracks import Tracks
from rigwake.trajectory import Trajectory

DISBELIEVED = IntrinsicsWidth(focal=0.02, centre_px=10.0, distortion=0.1, aspect=0.002)
"""What is known of a lens that was found to be wrong, about where it was moved to."""

_ROUNDS = 3
_FARTHEST_SCALE, _FARTHEST_SHIFT = 0.1, 0.08  # a lens further off (centre: of the width) is another camera's
_AGAIN_PX = 2.0  # RMS: what was made with a lens so far off is made again
_AGAIN_MOVED_PX = 0.2  # so is what was made with one that was only guessed
_UNLIKELY = 1e-3
_SURE_SCALE = 0.004  # deviation
_HELD_SCALE = 1e-5
_HARDLY_PX = 1.0
_HARDLY = 0.002  # a scale nearer to one is not worth another round


@dataclass(frozen=True, eq=False)
class MendedLenses:
    """What takes part, with better lenses. fits: of the lenses as they are now; None where they were not looked at.
    beliefs: by camera, the priors of those that are not as given; moved: which of them tracks or gyroscope contradict.
    checks: what was wrong with them, and what was done."""

    selection: Selection
    tracks: Mapping[str, Tracks]
    trajectories: Mapping[str, Trajectory]
    fits: Mapping[str, LensFit] | None = None
    beliefs: Mapping[str, LensBelief] = field(default_factory=dict)
    moved: frozenset[str] = frozenset()
    checks: tuple[SensorCheck, ...] = ()


@dataclass(frozen=True, eq=False)
class _Camera:
    """One camera on the way."""

    lens: CameraModel
    tracks: Tracks
    trajectory: Trajectory


def mend_lenses(
    selection: Selection,
    tracks: Mapping[str, Tracks],
    trajectories: Mapping[str, Trajectory],
    odometry: OdometryOptions | None,
) -> MendedLenses:
    """Lenses moved to where tracks and gyroscope want them, where these contradict them by more than chance.

    tracks, trajectories: by camera. odometry: how trajectories are estimated again; None to keep them, where another
    odometry made them. Pictures that were turned, and lenses too far off to be this camera's, stay as they are.
    """
    cameras = {
        name: _Camera(lens, tracks[name], trajectory)
        for name, trajectory in trajectories.items()
        if (lens := selection.cameras[name].model) is not None
    }
    given = {name: camera.lens for name, camera in cameras.items()}
    fits: dict[str, LensFit] = {}
    for name, camera in cameras.items():
        cameras[name], fit = _by_own_tracks(name, camera, selection.imu, odometry)
        if fit is not None:
            fits[name] = fit
    as_given = frozenset(name for name, camera in cameras.items() if camera.lens is given[name])
    for name, scale in _by_gyroscope(selection.imu, cameras, fits, as_given).items():
        moved = _moved(cameras[name], scale, np.zeros(2), odometry)
        if moved is not None:
            cameras[name] = moved
    for name, camera in cameras.items():
        lost = (
            name not in as_given and selection.imu is not None and _turned_by(camera, selection.imu) is None
        )
        if lost or _is_far(given[name], camera.lens):  # no better, or another camera's
            cameras[name] = _Camera(given[name], tracks[name], trajectories[name])
            fits |= _fit(name, cameras[name])
    moved_now = frozenset(name for name, camera in cameras.items() if camera.lens is not given[name])
    # nor is what a board told of it believed
    streams = {
        name: replace(stream, intrinsics_covariance=None) if name in moved_now else stream
        for name, stream in selection.cameras.items()
    }
    start = MendedLenses(replace(selection, cameras=streams), tracks, trajectories)
    found = _with_cameras(start, cameras, moved_now)
    return replace(
        found,
        # what is left of a lens that was moved is for the rig to mend
        fits={name: fit for name, fit in fits.items() if name not in moved_now},
        beliefs={name: LensBelief(cameras[name].lens, DISBELIEVED) for name in moved_now},
        moved=moved_now,
        checks=tuple(_check(name, given[name], cameras[name].lens) for name in sorted(moved_now)),
    )


def with_guessed(mended: MendedLenses, guessed: frozenset[str]) -> MendedLenses:
    """The same, the lenses of these cameras believed no more than such as had to be moved."""
    beliefs = {
        name: LensBelief(lens, DISBELIEVED)
        for name in guessed & mended.trajectories.keys()
        if (lens := mended.selection.cameras[name].model) is not None
    }
    if not beliefs:
        return mended
    fits = None if mended.fits is None else {n: f for n, f in mended.fits.items() if n not in beliefs}
    return replace(
        mended, fits=fits, beliefs={**beliefs, **mended.beliefs}, moved=mended.moved | beliefs.keys()
    )


def started_from(
    mended: MendedLenses, lenses: Mapping[str, CameraModel], odometry: OdometryOptions | None
) -> MendedLenses:
    """The same with lenses that the rig moved by pixels: bearings and trajectories by them, priors as they were.

    lenses: refined, by camera. `mended` itself where all moved little.
    """
    cameras = {}
    for name, lens in lenses.items():
        former, own = mended.selection.cameras[name].model, mended.tracks[name]
        limit = _AGAIN_MOVED_PX if name in mended.moved else _AGAIN_PX
        if former is not None and _rms_px(former, lens, own.pixels) > limit:
            again = _seen_by(lens, own, mended.trajectories[name], odometry)
            if again is not None:
                cameras[name] = again
    if not cameras and not mended.moved:
        return mended
    beliefs = {}
    for name, camera in cameras.items():
        former = mended.selection.cameras[name].model
        if former is not None:
            contradicted = _contradicts(former, camera.lens, camera.tracks.pixels)
            beliefs[name] = LensBelief(former, DISBELIEVED if contradicted else FROM_A_FILE)
    found = _with_cameras(mended, cameras, frozenset(cameras))
    models = {n: m for n in found.trajectories if (m := found.selection.cameras[n].model) is not None}
    fits = fit_lenses(found.tracks, models, found.trajectories)
    return replace(found, beliefs={**beliefs, **mended.beliefs}, fits=fits)


def _contradicts(believed: CameraModel, found: CameraModel, pixels: Array) -> bool:
    """Whether a lens is too far from the one believed for its prior to have been right."""
    prior = intrinsics_prior(believed, pixels)
    moved = found.params - prior.mean
    return bool(moved @ prior.information @ moved > chdtri(len(moved), _UNLIKELY))


def _rms_px(before: CameraModel, after: CameraModel, pixels: Array) -> float:
    moved = np.linalg.norm(moved_px(before, after, pixels), axis=1)
    moved = moved[np.isfinite(moved)]
    return float(np.sqrt(np.mean(moved**2))) if len(moved) else 0.0


def _with_cameras(
    mended: MendedLenses, cameras: Mapping[str, _Camera], changed: frozenset[str]
) -> MendedLenses:
    """With the lenses, tracks and trajectories of the cameras that changed."""
    streams = {
        name: replace(stream, model=cameras[name].lens) if name in changed else stream
        for name, stream in mended.selection.cameras.items()
    }
    return replace(
        mended,
        selection=replace(mended.selection, cameras=streams),
        tracks={**mended.tracks, **{name: cameras[name].tracks for name in changed}},
        trajectories={**mended.trajectories, **{name: cameras[name].trajectory for name in changed}},
    )


def refuse_contradicted(mended: MendedLenses, lenses: Mapping[str, CameraModel]) -> None:
    """Raise InputError where tracks contradict a lens that was moved even now that the rig has refined it.

    lenses: refined, by camera.
    """
    names = [name for name in mended.moved if name in lenses]
    models = {name: lenses[name] for name in names}
    paths = {name: mended.trajectories[name] for name in names}
    fits = fit_lenses(mended.tracks, models, paths)
    refuse(check_lenses(fits, mended.tracks, models, paths), "Refining it with the rig did not mend it.")


def _by_own_tracks(
    name: str, camera: _Camera, imu: ImuStream | None, odometry: OdometryOptions | None
) -> tuple[_Camera, LensFit | None]:
    """The camera with its lens where pairs of its images want it, and the last fit.

    Wrong distortion looks like a wrong focal length in pairs of images; in how far the camera turns, hardly. So the
    gyroscope tells the focal length where there is one.
    """
    last = _fit(name, camera).get(name)
    for _ in range(_ROUNDS):
        if last is None or not is_off(last, camera.lens.width_px) or is_turned(last, camera.lens):
            break
        scale, shift = last.scale, last.shift_px
        turned = _turned_by(camera, imu)
        if turned is not None:
            try:
                held = fit_lens(camera.tracks, camera.lens, camera.trajectory, scale_std=_HELD_SCALE)
            except RigwakeError:
                break
            scale, shift = turned, held.shift_px
        moved = _moved(camera, scale, shift, odometry)
        if moved is None:
            break
        camera, last = moved, _fit(name, moved).get(name)
        if turned is not None and np.abs(shift).max() < _HARDLY_PX and abs(turned - 1) < _HARDLY:
            break  # what remains is distortion
    return camera, last


def _turned_by(camera: _Camera, imu: ImuStream | None) -> float | None:
    """The camera's turns over the gyroscope's, None where they have too little in common."""
    if imu is None:
        return None
    try:
        fit = fit_turns(camera.trajectory, imu)
    except RigwakeError:
        return None
    return fit.scale if fit.unexplained <= EXPLAINED and abs(fit.scale - 1) < _FARTHEST_SCALE else None


def _fit(name: str, camera: _Camera) -> dict[str, LensFit]:
    return fit_lenses({name: camera.tracks}, {name: camera.lens}, {name: camera.trajectory})


def _by_gyroscope(
    imu: ImuStream | None,
    cameras: Mapping[str, _Camera],
    fits: Mapping[str, LensFit],
    as_given: frozenset[str],
) -> dict[str, float]:
    """Focal scales of cameras that turn by more or less than the gyroscope and the other cameras say.

    A lens that had to be moved, or that the tracks hardly tell, says nothing about the gyroscope.
    """
    if imu is None:
        return {}
    turns = {}
    for name, camera in cameras.items():
        try:
            turns[name] = fit_turns(camera.trajectory, imu)
        except RigwakeError:
            continue
    sound = frozenset(name for name, fit in fits.items() if not is_off(fit, cameras[name].lens.width_px))
    moved = cameras.keys() - as_given
    sure = frozenset(name for name in sound & as_given if fits[name].covariance[0, 0] < _SURE_SCALE**2)
    wanted = scale_of_lenses(turns, sound | moved, sure)
    return {name: s for name, s in wanted.items() if _HARDLY < abs(s - 1) < _FARTHEST_SCALE}


def _moved(
    camera: _Camera, scale: float, shift_px: Array, odometry: OdometryOptions | None
) -> _Camera | None:
    """The camera with a moved lens, bearings and trajectory by it; None where that cannot be."""
    try:
        lens = moved_lens(camera.lens, scale, shift_px)
    except RigwakeError:
        return None
    return _seen_by(lens, camera.tracks, camera.trajectory, odometry)


def _seen_by(
    lens: CameraModel, tracks: Tracks, trajectory: Trajectory, odometry: OdometryOptions | None
) -> _Camera | None:
    """Bearings and trajectory by this lens; None where there is no trajectory."""
    bearings, seen = lens.unproject(tracks.pixels)
    tracks = replace(tracks, bearings_cam=bearings).take(np.flatnonzero(seen))
    try:
        found = trajectory if odometry is None else estimate_monocular(tracks, lens, odometry).trajectory
    except RigwakeError:
        return None
    return _Camera(lens, tracks, found)


def _is_far(given: CameraModel, lens: CameraModel) -> bool:
    scale, shift = _difference(given, lens)
    return abs(scale - 1) > _FARTHEST_SCALE or float(np.abs(shift).max()) > _FARTHEST_SHIFT * given.width_px


def _difference(given: CameraModel, lens: CameraModel) -> tuple[float, Array]:
    """Focal scale and shift of the centre between two lenses."""
    axis = np.array([[0.0, 0.0, 1.0], [1e-3, 0.0, 1.0]])
    before, after = given.project(axis)[0], lens.project(axis)[0]
    sizes = np.linalg.norm(after[1] - after[0]), np.linalg.norm(before[1] - before[0])
    return float(sizes[0] / sizes[1]), after[0] - before[0]


def _check(name: str, given: CameraModel, lens: CameraModel) -> SensorCheck:
    scale, shift = _difference(given, lens)
    words = (
        f"the intrinsics given do not fit what it saw. They were moved to a focal length {scale:.4f} times the one "
        f"given and a principal point {shift[0]:+.1f}, {shift[1]:+.1f} px away, and refined from there with the rig."
    )
    remedy = "Calibrate its lens (`rigwake intrinsics`); --intrinsics fixed refuses such a lens."
    quantity = "focal length by what it saw over that given"
    return SensorCheck(f"camera {name}", False, scale, 1.0, words, remedy, quantity, "repaired")
