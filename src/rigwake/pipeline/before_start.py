"""What a calibration can be refused for before the first image is read."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import replace
from pathlib import Path

from rigwake.config import CalibrateConfig
from rigwake.errors import InputError, UsageError
from rigwake.pipeline.prior import RigPrior
from rigwake.pipeline.rig_stage import reference_frame
from rigwake.pipeline.stream_selection import Selection
from rigwake.readers.trajectories import read_trajectory
from rigwake.recording import Recording
from rigwake.trajectory import Trajectory


def check_reference(recording: Recording, selection: Selection, wanted: str) -> None:
    """Raises UsageError for a reference that is neither a sensor that takes part nor known to the recording."""
    if wanted == "auto":
        return
    frame = reference_frame(recording, selection, None, wanted)
    frames = [*(["imu", "base_link"] if selection.imu is not None else []), *selection.cameras]
    if frame.name not in frames:
        raise UsageError(
            f"The reference {wanted!r} takes no part.",
            consequence="Nothing could be reported relative to it.",
            remedy=f"Use --reference with one of: {', '.join(frames)}.",
        )


def check_line_delays(config: CalibrateConfig, selection: Selection) -> None:
    """Raises UsageError for read-out times of cameras that are not there."""
    _check_names("line_delay_s names", config.line_delay_s, selection)


def check_fields_of_view(config: CalibrateConfig, selection: Selection) -> None:
    """Raises UsageError for fields of view of cameras that are not there, or that nothing is done with."""
    _check_names("fov_deg names", set(config.fov_deg) - {"all"}, selection)
    if config.fov_deg and config.intrinsics != "find":
        fate = "refined" if config.intrinsics == "refine" else "kept as they are"
        raise UsageError(
            f"Fields of view are given, but lenses are to be {fate}.",
            consequence="They would not be used.",
            remedy="Add --intrinsics find, or leave out --fov.",
        )


def check_prior(prior: RigPrior, selection: Selection) -> None:
    """Raises UsageError for priors and baselines of cameras that take no part, or of impossible values."""
    _check_names("The prior names", prior.cameras, selection)
    for baseline in prior.baselines:
        _check_names("A baseline of the prior names", (baseline.first, baseline.second), selection)
        if baseline.first == baseline.second:
            raise UsageError(
                f"A baseline of the prior goes from {baseline.first} to itself.", remedy="Name two cameras."
            )
        for what, value in (("distance_m", baseline.distance_m), ("std_m", baseline.std_m)):
            if not (math.isfinite(value) and value > 0):
                raise UsageError(
                    f"The baseline of {baseline.first} and {baseline.second} has {what} {value:g}.",
                    remedy="Give metres above 0.",
                )


def without_cameras(prior: RigPrior, missing: Iterable[str]) -> RigPrior:
    """The prior without cameras that failed."""
    gone = set(missing)
    return replace(
        prior,
        cameras={name: known for name, known in prior.cameras.items() if name not in gone},
        baselines=tuple(b for b in prior.baselines if not {b.first, b.second} & gone),
    )


def read_external_trajectories(folder: Path, selection: Selection) -> dict[str, Trajectory]:
    """Trajectories of another odometry, `CAMERA.tum` in the folder, by camera.

    Raises InputError if there is none or one is damaged, UsageError for files of cameras that take no part.
    """
    if not folder.is_dir():
        raise UsageError(
            f"{folder} is no folder.",
            remedy=f"Give --trajectories a folder with {_tum_names(selection)}.",
        )
    files = {file.stem: file for file in sorted(folder.glob("*.tum")) if file.is_file()}
    found = {
        name: read_trajectory(files[name], name=name).trajectory
        for name in selection.cameras
        if name in files
    }
    if not found:
        raise InputError(
            f"{folder} holds no trajectory of any camera.",
            remedy=f"Name the files {_tum_names(selection)}.",
        )
    return found


def _tum_names(selection: Selection) -> str:
    return ", ".join(f"{name}.tum" for name in selection.cameras)


def _check_names(who: str, names: Iterable[str] | Mapping[str, object], selection: Selection) -> None:
    for name in names:
        if name not in selection.cameras:
            raise UsageError(
                f"{who} a camera {name!r} that takes no part.",
                consequence="What is known of it would be lost.",
                remedy=f"There are: {', '.join(selection.cameras)}.",
            )
