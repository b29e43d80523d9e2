"""Lenses that the user gives in files: `front=front.yaml`, or one file of a whole rig."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from rigwake._types import Array
from rigwake.cameras.formats.camera_files import read_camera, read_cameras
from rigwake.cameras.protocol import CameraModel
from rigwake.errors import InputError, UsageError
from rigwake.recording import Finding, Recording
from rigwake.yaml_input import read_yaml_settings


@dataclass(frozen=True, eq=False)
class ChosenLens:
    """A lens from a file, and the (P, P) covariance of its parameters where the file has one."""

    model: CameraModel
    covariance: Array | None = None


ANY_CAMERA = ""
"""The name of a lens whose file does not say of which camera it is."""


def lenses_from_options(options: Sequence[str]) -> dict[str, ChosenLens]:
    """Lenses by camera from `FILE` or `CAMERA=FILE`, in every format of `read_cameras`.

    Raises InputError or CameraError for a file that cannot be read, UsageError for two lenses of one camera.
    """
    lenses: dict[str, ChosenLens] = {}
    for option in options:
        name, separator, file = option.partition("=")
        if separator and not Path(option).exists():
            given = {name.strip(): _the_one_lens(file.strip(), name.strip())}
        else:
            given = {
                own: ChosenLens(model, _covariance(Path(option), own))
                for own, model in read_cameras(option).items()
            }
            if len(given) == 1:
                given = {**given, ANY_CAMERA: next(iter(given.values()))}
        for camera, lens in given.items():
            if camera in lenses and camera != ANY_CAMERA:
                raise UsageError(f"--camera-file gives camera {camera} two lenses.", remedy="Give one file.")
            lenses[camera] = lens
    if len(options) > 1:
        lenses.pop(ANY_CAMERA, None)
    return lenses


def _the_one_lens(file: str, camera: str) -> ChosenLens:
    cameras = read_cameras(file)
    own = camera if camera in cameras else next(iter(cameras))
    model = cameras[camera] if camera in cameras else read_camera(file)
    return ChosenLens(model, _covariance(Path(file), own))


def _covariance(path: Path, name: str) -> Array | None:
    """(P, P) of the parameters as `rigwake intrinsics` writes it, NaN where unobservable; None in other files."""
    try:
        content: Any = read_yaml_settings(path)
        entry = content["cameras"][name]["calibration"]
        names, rows = list(entry["std"]), entry["covariance"]
        array = np.array([[np.nan if x is None else float(x) for x in row] for row in rows])
        order = [names.index(p) for p in content["cameras"][name]["params"]]
    except (InputError, KeyError, TypeError, ValueError):
        return None
    return array[np.ix_(order, order)] if array.shape == (len(names), len(names)) else None


def with_chosen_lenses(recording: Recording, lenses: Mapping[str, ChosenLens]) -> Recording:
    """The recording with lenses that the user gave. A file of one lens serves a recording of one camera.

    Raises UsageError if a lens is of no camera, InputError if it is for images of another size.
    """
    if not lenses:
        return recording
    named = {name: lens for name, lens in lenses.items() if name in recording.cameras}
    if not named and ANY_CAMERA in lenses and len(recording.cameras) == 1:
        named = {next(iter(recording.cameras)): lenses[ANY_CAMERA]}
    if not named:
        names = ", ".join(name for name in lenses if name != ANY_CAMERA)
        raise UsageError(
            f"--camera-file is for {names or 'no camera'}, {recording.path.name} has "
            f"{', '.join(recording.cameras) or 'no cameras'}.",
            remedy="Say which is which: --camera-file CAMERA=FILE.",
        )
    for name, chosen in named.items():
        camera, lens = recording.cameras[name], chosen.model
        if (lens.width_px, lens.height_px) != (camera.width_px, camera.height_px):
            raise InputError(
                f"The lens given for {name} is for {lens.width_px} x {lens.height_px} pixels, its images are "
                f"{camera.width_px} x {camera.height_px}.",
                remedy="Calibrate the lens at the size of the recording.",
            )
    models = {name: chosen.model for name, chosen in named.items()}
    completed = with_lenses(recording, models, "the file given", given=True)
    cameras = {
        name: replace(camera, intrinsics_covariance=named[name].covariance) if name in named else camera
        for name, camera in completed.cameras.items()
    }
    return replace(completed, cameras=cameras)


def with_lenses(
    recording: Recording, lenses: Mapping[str, CameraModel], source: str, *, given: bool = False
) -> Recording:
    """The recording with these lenses; one for images of another size is not used, and said.

    given: the user gave them, so that what the recording says of the same lenses no longer matters. Else it is said
    where the recording's own lens differs.
    """
    cameras, findings = dict(recording.cameras), list(recording.findings)
    for name, lens in lenses.items():
        camera = cameras[name]
        if (lens.width_px, lens.height_px) != (camera.width_px, camera.height_px):
            if camera.model is None:
                words = (
                    f"{source} is for {lens.width_px} x {lens.height_px} pixels: its intrinsics are not used."
                )
                findings.append(Finding("error", name, words))
            continue
        cameras[name] = replace(camera, model=lens)
        moot = [
            f for f in findings if f.sensor == name and (_is_about_lens(f) if given else _asks_for_lens(f))
        ]
        findings = [f for f in findings if f not in moot]
        if not given and camera.model is not None and _differ(camera.model, lens):
            words = f"its lens in {source} differs from the one recorded; that of {source} is used."
            findings.append(Finding("warning", name, words))
    return replace(recording, cameras=cameras, findings=tuple(findings))


def _differ(first: CameraModel, second: CameraModel) -> bool:
    return first.model != second.model or not np.allclose(first.params, second.params, rtol=1e-9, atol=1e-12)


def _is_about_lens(finding: Finding) -> bool:
    return "intrinsics" in finding.message or "camera_info" in finding.message


def _asks_for_lens(finding: Finding) -> bool:
    return "must be given" in finding.message or "not calibrated" in finding.message
