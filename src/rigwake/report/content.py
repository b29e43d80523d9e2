"""What a report is made of: the files that a calibration leaves in its folder; layout in docs/report.md.

Large files are reduced while they are read, one at a time, so that memory does not grow with the recording.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

import cv2
import numpy as np

from rigwake.calibration import Calibration, load_calibration
from rigwake.cameras.protocol import CameraModel
from rigwake.errors import InputError, RigwakeError
from rigwake.readers.picture_files import picture_or_none
from rigwake.readers.trajectories import read_trajectory
from rigwake.report.adjustment_file import AdjustmentRecord, read_adjustment
from rigwake.report.reduce import ResidualSummary, TrackSummary, summarise_residuals, summarise_tracks
from rigwake.trajectory import Trajectory

RIG_TRAJECTORY = "rig"
_MASK_WIDTH_PX = 400
_MASK_VALUES = {"hull": 2, "water": 3, "sky": 4}
_LARGEST_JSON_BYTES = 50 * 1024 * 1024
Loaded = TypeVar("Loaded")


@dataclass(frozen=True)
class OverlayPoint:
    """A landmark in a picture: where another camera's calibration predicts it and where it was seen."""

    predicted_px: tuple[float, float]
    observed_px: tuple[float, float]
    from_camera: str
    landmark: str


@dataclass(frozen=True)
class Picture:
    """One image of the recording with what the calibration says about it.

    kind: `horizon` (horizon_px: the predicted horizon as a polyline, NaN between pieces), `hand_over` (points), or
    `patches` (one point; three tiles side by side, each `tile_px` pixels of the recording wide and high, about the
    prediction: as seen before, as predicted, as found).
    """

    camera: str
    file: Path
    timestamp_ns: int
    kind: str
    horizon_px: tuple[tuple[float, float], ...] = ()
    points: tuple[OverlayPoint, ...] = ()
    tile_px: float = 0.0


@dataclass(frozen=True, eq=False)
class ReportContent:
    """Everything that the report shows. `absent` says per panel why it has nothing to show.

    masks: per camera an (h, w) uint8 image: 0 used, 1 excluded, 2 hull, 3 water, 4 sky.
    """

    folder: Path
    calibration: Calibration
    initial: Calibration | None = None
    trajectories: Mapping[str, Trajectory] = field(default_factory=dict)
    tracks: Mapping[str, TrackSummary] = field(default_factory=dict)
    residuals: Mapping[str, ResidualSummary] = field(default_factory=dict)
    adjustment: AdjustmentRecord = field(default_factory=AdjustmentRecord)
    masks: Mapping[str, np.ndarray] = field(default_factory=dict)
    pictures: tuple[Picture, ...] = ()
    absent: Mapping[str, str] = field(default_factory=dict)


def load_report_content(folder: Path | str) -> ReportContent:
    """Read what is there; InputError if there is no calibration. Everything else may be missing or damaged:
    its panel then says so."""
    folder = Path(folder)
    if not (folder / "calibration.yaml").is_file():
        raise InputError(
            f"{folder} holds no calibration.yaml.",
            remedy="Give the folder that `rigwake calibrate REC -o FOLDER` wrote.",
        )
    calibration = load_calibration(folder / "calibration.yaml")
    lenses = {name: camera.model for name, camera in calibration.cameras.items()}
    absent: dict[str, str] = {}

    def read(panel: str, path: Path, load: Callable[[Path], Loaded], otherwise: Loaded) -> Loaded:
        if not path.exists():
            absent[panel] = f"{path.relative_to(folder)} is not there"
            return otherwise
        try:
            loaded = load(path)
        except RigwakeError as error:
            absent[panel] = str(error)
            return otherwise
        if isinstance(loaded, dict | tuple) and not loaded:
            absent[panel] = f"{path.relative_to(folder)} is empty"
        return loaded

    nothing: dict[str, Any] = {}
    return ReportContent(
        folder=folder,
        calibration=calibration,
        initial=read("initial", folder / "initial_rig.yaml", load_calibration, None),
        trajectories=read("trajectories", folder / "trajectories", _read_trajectories, nothing),
        tracks=read("tracks", folder / "tracks", lambda f: _read_tracks(f, lenses), nothing),
        residuals=read("residuals", folder / "residuals.npz", lambda f: _read_residuals(f, lenses), nothing),
        adjustment=read("adjustment", folder / "adjustment.npz", read_adjustment, AdjustmentRecord()),
        masks=read("masks", folder / "masks", _read_masks, nothing),
        pictures=read("pictures", folder / "pictures" / "pictures.json", _read_pictures, ()),
        absent=absent,
    )


def _read_trajectories(folder: Path) -> dict[str, Trajectory]:
    return {f.stem: read_trajectory(f).trajectory for f in sorted(folder.glob("*.tum"))}


def _arrays(path: Path, names: tuple[str, ...]) -> dict[str, np.ndarray]:
    """These arrays of an .npz, nothing else and no code; InputError if one is missing."""
    try:
        with np.load(path, allow_pickle=False) as archive:
            return {name: archive[name] for name in names}
    except Exception as error:  # of damaged bytes, numpy and zipfile make almost any error
        raise InputError(f"{path.name} cannot be read: {type(error).__name__}: {error}.") from error


def _read_tracks(folder: Path, lenses: Mapping[str, CameraModel | None]) -> dict[str, TrackSummary]:
    names = ("timestamps_ns", "frame_indices", "track_ids", "pixels", "report")
    summaries = {}
    for file in sorted(folder.glob("*.npz")):
        summaries[file.stem] = summarise_tracks(_arrays(file, names), lenses.get(file.stem))
    return summaries


def _read_residuals(path: Path, lenses: Mapping[str, CameraModel | None]) -> dict[str, ResidualSummary]:
    names = ("camera", "camera_names", "timestamp_ns", "pixels", "residuals_px", "angle_deg")
    arrays = _arrays(path, names)
    count = len(arrays["camera"])
    shapes = [arrays[name].shape for name in ("timestamp_ns", "pixels", "residuals_px", "angle_deg")]
    if shapes != [(count,), (count, 2), (count, 2), (count,)]:
        raise InputError(f"{path.name}: the arrays disagree in length: {shapes}.")
    summaries = {}
    for index, name in enumerate(arrays["camera_names"].tolist()):
        mine = arrays["camera"] == index
        if mine.any():
            chosen = {key: arrays[key][mine] for key in names[2:]}
            summaries[str(name)] = summarise_residuals(chosen, lenses.get(str(name)))
    return summaries


def _read_masks(folder: Path) -> dict[str, np.ndarray]:
    files = {file.stem: file for file in sorted(folder.glob("*.png"))}
    parts = {name: base for name in files for base in files if name.startswith(f"{base}_")}
    masks = {}
    for name in files.keys() - parts.keys():
        mask = np.where(_image(files[name]) > 127, 0, 1).astype(np.uint8)
        for part in (part for part, base in parts.items() if base == name):
            region = _image(files[part])
            value = _MASK_VALUES.get(part.removeprefix(f"{name}_"), 1)
            if region.shape == mask.shape:
                mask[(region > 127) & (mask > 0)] = value
        height = max(1, round(mask.shape[0] * _MASK_WIDTH_PX / mask.shape[1]))
        masks[name] = cv2.resize(mask, (_MASK_WIDTH_PX, height), interpolation=cv2.INTER_NEAREST)
    return dict(sorted(masks.items()))


def _image(file: Path) -> np.ndarray:
    image = picture_or_none(file)
    if image is None:
        raise InputError(f"{file.name} is not an image.")
    return image


def _read_pictures(path: Path) -> tuple[Picture, ...]:
    if path.stat().st_size > _LARGEST_JSON_BYTES:
        raise InputError(f"{path.name} is too large ({path.stat().st_size} bytes).")
    try:
        entries = json.loads(path.read_text(encoding="utf-8"))
        return tuple(_picture(entry, path.parent) for entry in entries)
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise InputError(f"{path.name} cannot be read: {type(error).__name__}: {error}.") from error


def _picture(entry: Any, folder: Path) -> Picture:
    file = folder / str(entry["file"])
    if file.resolve().parent != folder.resolve():
        raise InputError(f"pictures.json names a file outside its folder: {entry['file']}.")
    return Picture(
        str(entry["camera"]),
        file,
        int(entry["timestamp_ns"]),
        str(entry["kind"]),
        tuple(_pixel(p) for p in entry.get("horizon_px") or ()),
        tuple(
            OverlayPoint(
                _pixel(p["predicted_px"]),
                _pixel(p["observed_px"]),
                str(p.get("from_camera", "")),
                str(p.get("landmark", "")),
            )
            for p in entry.get("points") or ()
        ),
        float(entry.get("tile_px") or 0.0),
    )


def _pixel(value: Any) -> tuple[float, float]:
    if value is None:
        return float("nan"), float("nan")
    u, v = (float("nan") if x is None else float(x) for x in value)
    return u, v
