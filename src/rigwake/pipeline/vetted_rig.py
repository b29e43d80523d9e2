"""The rig from every camera's own motion, once sensors were compared and lenses that are wrong were mended."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

from rigwake.ba.rig.rig_values import InitialRig
from rigwake.config import CalibrateConfig
from rigwake.pipeline.before_start import without_cameras
from rigwake.pipeline.lens_mending import (
    MendedLenses,
    mend_lenses,
    refuse_contradicted,
    started_from,
    with_guessed,
)
from rigwake.pipeline.prior import RigPrior
from rigwake.pipeline.rig_stage import RigEstimate, estimate_rig, initialise_rig
from rigwake.pipeline.sensor_checks import VettedSensors, vet_sensors
from rigwake.pipeline.stream_selection import Selection
from rigwake.plausibility.exposure_lag import exposure_lags, later_by, restamped
from rigwake.plausibility.values import SensorCheck, refuse
from rigwake.recording import Recording
from rigwake.tracks import Tracks
from rigwake.trajectory import Trajectory

_WORDS = "comparing the sensors"


@dataclass(frozen=True, eq=False)
class VettedRig:
    """own, tracks: what was used, by camera. first: initial values. vetted: the sensors that
    were used, and what was said of them."""

    own: Mapping[str, Trajectory]
    tracks: Mapping[str, Tracks]
    first: InitialRig
    rig: RigEstimate
    vetted: VettedSensors


def estimate_vetted_rig(
    recording: Recording,
    selection: Selection,
    tracks: Mapping[str, Tracks],
    trajectories: Mapping[str, Trajectory],
    config: CalibrateConfig,
    prior: RigPrior,
    *,
    masks: Path,
    external: bool = False,
    without_horizon: frozenset[str] = frozenset(),
    guessed: frozenset[str] = frozenset(),
    progress: Callable[[str, float], None] = lambda words, fraction: None,
) -> VettedRig:
    """Sensors compared, initial values, rig. With intrinsics to refine, lenses that contradict what the cameras saw are
    given a better start; where the rig then moves a lens by pixels, all that was compared and estimated with the former
    one is done again.

    tracks, trajectories: by camera. external: whether another odometry made the trajectories, which then stay.
    without_horizon: see `vet_sensors`. guessed: cameras whose lens is a guess. masks: see `estimate_rig`.

    Raises InputError that names a sensor that cannot be right, and as `initialise_rig` and `estimate_rig`.
    """
    by_stamps: tuple[SensorCheck, ...] = ()
    if config.sensor_checks:
        selection, tracks, trajectories, by_stamps = _restamped(
            selection, tracks, trajectories, config.repair
        )
        refuse(by_stamps)
    mended = MendedLenses(selection, tracks, trajectories)
    odometry = None if external else replace(config.odometry, seed=config.seed)
    refines = config.intrinsics != "fixed" and config.repair
    if config.sensor_checks:
        progress(_WORDS, 0.0)
        mended = mend_lenses(selection, tracks, trajectories, odometry) if refines else mended
    mended = with_guessed(mended, guessed)
    # landmarks are not looked for in other cameras before the lenses are known
    alone = _without_association(config) if mended.moved else config
    found = _one_pass(recording, mended, alone, prior, masks, without_horizon, mended.moved, progress)
    if refines:
        again = started_from(mended, found.rig.lenses, odometry)
        if mended.moved or again is not mended:
            nobody: frozenset[str] = frozenset()
            found = _one_pass(recording, again, config, prior, masks, without_horizon, nobody, progress)
        refuse_contradicted(again, found.rig.lenses)
    return replace(found, vetted=replace(found.vetted, checks=(*by_stamps, *found.vetted.checks)))


def _restamped(
    selection: Selection, tracks: Mapping[str, Tracks], trajectories: Mapping[str, Trajectory], repair: bool
) -> tuple[Selection, dict[str, Tracks], dict[str, Trajectory], tuple[SensorCheck, ...]]:
    """Stamps that depend on how long a frame lasts, corrected everywhere; only told of where that cannot be."""
    cameras, tracks, paths = dict(selection.cameras), dict(tracks), dict(trajectories)
    stamps = {name: cameras[name].timestamps_ns for name in paths}
    lags = {} if selection.imu is None else exposure_lags(paths, stamps, selection.imu)
    checks = []
    for name, lag in lags.items():
        moved = later_by(lag, stamps[name]) if repair else None
        if moved is None:  # where it cannot be corrected, the clock is said to drift
            checks += [] if repair else [lag.check(name, repaired=False)]
            continue
        cameras[name] = replace(cameras[name], timestamps_ns=stamps[name] + moved)
        tracks[name] = restamped(tracks[name], stamps[name], moved)
        paths[name] = restamped(paths[name], stamps[name], moved)
        checks.append(lag.check(name))
    return replace(selection, cameras=cameras), tracks, paths, tuple(checks)


def _without_association(config: CalibrateConfig) -> CalibrateConfig:
    """The settings without cross-camera association."""
    return config.model_copy(update={"adjustment": replace(config.adjustment, cross_camera=False)})


def _one_pass(
    recording: Recording,
    mended: MendedLenses,
    config: CalibrateConfig,
    prior: RigPrior,
    masks: Path,
    without_horizon: frozenset[str],
    pardoned: frozenset[str],
    progress: Callable[[str, float], None],
) -> VettedRig:
    vetted = VettedSensors(mended.selection)
    if config.sensor_checks:
        progress(_WORDS, 0.0)
        vetted = vet_sensors(
            mended.selection,
            mended.tracks,
            mended.trajectories,
            without_horizon=without_horizon,
            lenses=mended.fits,
            pardoned=pardoned,
            repair=config.repair,
        )
    selection = vetted.selection
    own = {name: path for name, path in mended.trajectories.items() if name in selection.cameras}
    prior = without_cameras(prior, mended.selection.cameras.keys() - own.keys())
    first = initialise_rig(selection, own, config, prior)
    rig = estimate_rig(
        recording,
        selection,
        mended.tracks,
        first,
        config,
        prior,
        masks=masks,
        beliefs=mended.beliefs,
        progress=progress,
    )
    vetted = replace(vetted, checks=(*mended.checks, *vetted.checks))
    return VettedRig(own, mended.tracks, first, rig, vetted)
