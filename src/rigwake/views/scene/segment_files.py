"""Segmentation of whole recordings and folders: labels and overlays as files, and what they are worth."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from rigwake._types import Array, Image
from rigwake.atomic import atomic_path
from rigwake.errors import InputError, UsageError
from rigwake.readers.image_files import image_files
from rigwake.readers.open import open_recording
from rigwake.readers.picture_files import IMAGE_SUFFIXES, picture_or_none
from rigwake.readers.topics import TopicMap
from rigwake.views.frames import frame_sets
from rigwake.views.prepare import SurroundOptions, prepare_surround
from rigwake.views.scene.colour_method import ColourClassifier
from rigwake.views.scene.label_measures import (
    ClassMap,
    LabelComparison,
    LabelMeasures,
    flat_horizon,
    water_edge_rows,
)
from rigwake.views.scene.network import external_network, shipped_network
from rigwake.views.scene.segmentation import (
    Labels,
    PixelClassifier,
    SmoothedLabels,
    overlay,
    segment_image,
)
from rigwake.views.strips import level_strip
from rigwake.views.surface import WaterAndShell

_UNSURE = 0.75  # mean confidence below which a picture is named


@dataclass(frozen=True)
class SegmentChoices:
    """What a person may choose; see `rigwake segment --help`."""

    method: str = "network"
    onnx: Path | None = None
    classes: tuple[str, ...] = ("obstacle", "water", "sky")
    count: int = 200
    measure: Path | None = None
    horizon_row: float | None = None
    field_deg: float = 60.0
    height_m: float | None = None

    def classifier(self) -> PixelClassifier:
        """The network or the colour method."""
        if self.method == "colour":
            return ColourClassifier()
        return shipped_network() if self.onnx is None else external_network(self.onnx, self.classes)


@dataclass(frozen=True, eq=False)
class SegmentedPicture:
    """One picture with its labels. elevation_deg: (H,) of the rows, NaN where unknown."""

    name: str
    image: Image
    labels: Labels
    elevation_deg: Array
    step_deg: float
    wraps: bool


@dataclass(frozen=True)
class SegmentSummary:
    """What was written, how sure it is, and, against labels, how good, beside the flat-horizon baseline."""

    folder: Path
    pictures: int
    confidence: float
    unsure: tuple[str, ...]
    notes: tuple[str, ...]
    measured: LabelMeasures | None
    baseline: LabelMeasures | None

    def lines(self) -> list[str]:
        """Sentences for people."""
        lines = [f"{self.folder}: {self.pictures} pictures labelled, mean confidence {self.confidence:.2f}."]
        lines += self.notes
        lines += [f"Not to be trusted: {words}" for words in self.unsure[:8]]
        if len(self.unsure) > 8:
            lines.append(f"... and {len(self.unsure) - 8} more.")
        for title, m in (("measured", self.measured), ("a flat cut at the horizon", self.baseline)):
            if m is not None:
                lines.append(
                    f"{title}: mean IoU {m.mean_iou:.3f}, water edge {m.water_edge_deg:.2f} deg RMSE; below the "
                    f"horizon: recall {m.recall:.2f}, precision {m.precision:.2f} of obstacle pixels, "
                    f"{m.objects_found} of {m.objects} objects found, {m.false_objects} false, F1 {m.f1:.2f}"
                    + ("" if np.isnan(m.f1_danger) else f", within 15 m {m.f1_danger:.2f}")
                )
        return lines

    def as_dict(self) -> dict[str, Any]:
        """For JSON: NaN becomes null."""

        def plain(measures: LabelMeasures | None) -> dict[str, Any] | None:
            if measures is None:
                return None
            found = asdict(measures) | {"mean_iou": measures.mean_iou}
            found["iou"] = [_number(value) for value in measures.iou]
            return {k: _number(v) if isinstance(v, float) else v for k, v in found.items()}

        return {
            "pictures": self.pictures,
            "confidence": _number(self.confidence),
            "unsure": list(self.unsure),
            "notes": list(self.notes),
            "measured": plain(self.measured),
            "flat_horizon": plain(self.baseline),
        }


def _number(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None


def segment_to_folder(
    source: Path,
    folder: Path,
    calibration: Path | None,
    choices: SegmentChoices,
    topics: TopicMap | None = None,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> SegmentSummary:
    """Label every picture of a recording, a folder or a file; write `labels/NAME.png` and `overlays/NAME.jpg`.

    Raises InputError or UsageError if there is nothing to read, or if labels to measure against do not fit.
    """
    classifier = choices.classifier()
    notes: list[str] = []
    if calibration is not None:
        total, pictures = _strips(calibration, source, classifier, choices, topics, notes)
    else:
        total, pictures = _plain(source, classifier, choices, topics)
    found: LabelComparison | None = None
    flat: LabelComparison | None = None
    confidence, unsure, done = [], [], 0
    for picture in pictures:
        _write(folder / "labels" / f"{picture.name}.png", picture.labels.classes)
        _write(folder / "overlays" / f"{picture.name}.jpg", overlay(picture.image, picture.labels))
        sure = picture.labels.mean_confidence
        confidence.append(sure)
        if picture.labels.words or sure < _UNSURE:
            unsure.append(f"{picture.name}: {picture.labels.words or f'mean confidence {sure:.2f}'}")
        truth = _truth(choices.measure, picture) if choices.measure is not None else None
        if truth is not None:
            found, flat = (
                found or LabelComparison(picture.step_deg),
                flat or LabelComparison(picture.step_deg),
            )
            elevation = picture.elevation_deg
            if not np.isfinite(elevation).all():
                highest = np.nanmin(water_edge_rows(truth)) if (truth == 0).any() else truth.shape[0] / 2
                elevation = (highest - np.arange(truth.shape[0])) * picture.step_deg
            height = np.nan if choices.height_m is None else choices.height_m
            found.add(picture.labels.classes, truth, elevation, height, picture.wraps)
            flat.add(flat_horizon(truth, elevation), truth, elevation, height, picture.wraps)
        done += 1
        progress(done, total)
    if choices.measure is not None and found is None:
        raise UsageError(
            f"No label picture in {choices.measure} has the name of a picture.",
            consequence="Nothing was measured.",
            remedy="Name them like the pictures, with .png.",
        )
    return SegmentSummary(
        folder, done, float(np.mean(confidence)) if confidence else np.nan, tuple(unsure), tuple(notes),
        found.measures() if found else None, flat.measures() if flat else None,
    )  # fmt: skip


def _write(path: Path, picture: NDArray[np.uint8]) -> None:
    _, encoded = cv2.imencode(path.suffix, picture)
    path.parent.mkdir(parents=True, exist_ok=True)
    with atomic_path(path) as temporary:
        temporary.write_bytes(encoded.tobytes())


def _truth(folder: Path, picture: SegmentedPicture) -> ClassMap | None:
    path = folder / f"{picture.name}.png"
    if not path.is_file():
        return None
    truth = picture_or_none(path)
    if (
        truth is None
        or truth.shape != picture.labels.classes.shape
        or not np.isin(truth, (0, 1, 2, 255)).all()
    ):
        raise InputError(
            f"{path} is no label picture of {picture.name}.",
            consequence="Nothing can be measured against it.",
            remedy="Same size as the picture, grey values 0 water, 1 obstacle, 2 sky, 255 not scored.",
        )
    return np.asarray(truth, np.uint8)


def _evenly(count: int, most: int) -> NDArray[np.int64]:
    return np.unique(np.linspace(0, count - 1, min(count, most)).round().astype(np.int64))


def _plain(
    source: Path, classifier: PixelClassifier, choices: SegmentChoices, topics: TopicMap | None
) -> tuple[int, Iterator[SegmentedPicture]]:
    """Pictures of ordinary lenses, each on its own."""
    files = [source] if source.is_file() and source.suffix.lower() in IMAGE_SUFFIXES else []
    if source.is_dir():
        files = image_files(source)
    if files:
        chosen = [files[k] for k in _evenly(len(files), choices.count)]
        return len(chosen), (_one(p.stem, _read(p), classifier, choices) for p in chosen)
    recording = open_recording(source, topics)
    streams = {name: s for name, s in recording.cameras.items() if len(s)}
    if not streams:
        raise InputError(f"{source} has no pictures.", consequence="There is nothing to label.")
    each = max(choices.count // len(streams), 1)
    plans = {name: _evenly(len(s), each) for name, s in streams.items()}

    def run() -> Iterator[SegmentedPicture]:
        for name, stream in streams.items():
            for frame in stream.frames(plans[name], colour=True):
                yield _one(f"{name}_{frame.timestamp_ns}", frame.image, classifier, choices)

    return sum(len(plan) for plan in plans.values()), run()


def _read(path: Path) -> Image:
    image = picture_or_none(path, cv2.IMREAD_COLOR)
    if image is None:
        raise InputError(f"{path} cannot be read as a picture.", remedy="Take it out of the folder.")
    return np.asarray(image, np.uint8)


def _one(name: str, image: Image, classifier: PixelClassifier, choices: SegmentChoices) -> SegmentedPicture:
    rows, columns = image.shape[:2]
    step = choices.field_deg / columns
    elevation = np.full(rows, np.nan)
    if choices.horizon_row is not None:
        elevation = (choices.horizon_row - np.arange(rows)) * step
    return SegmentedPicture(name, image, segment_image(image, classifier), elevation, step, False)


def _strips(
    calibration: Path,
    source: Path,
    classifier: PixelClassifier,
    choices: SegmentChoices,
    topics: TopicMap | None,
    notes: list[str],
) -> tuple[int, Iterator[SegmentedPicture]]:
    """Level strips of all cameras, without the own vessel, steadied over time."""
    options = SurroundOptions(height_m=choices.height_m, hull="mask", correct_colours=False)
    setup = prepare_surround(calibration, source, options, topics)
    notes += [setup.leveller.words[:1].upper() + setup.leveller.words[1:] + ".", *setup.notes]
    times = setup.times_ns()
    chosen = times[_evenly(len(times), choices.count)]

    def run() -> Iterator[SegmentedPicture]:
        smoothed = SmoothedLabels(classifier)
        for frames in frame_sets(setup.streams, setup.rig, chosen):
            images = frames.images(setup.rig)
            attitude = setup.attitude_at(frames)
            surface = WaterAndShell(setup.shell_m) if setup.height else setup.surface_at(frames, attitude)
            strip = level_strip(images, setup.rig, attitude, surface, None, setup.masks, frames.timestamp_ns)
            labels = smoothed.next(strip)
            elevation = np.rad2deg(strip.grid.elevations())
            yield SegmentedPicture(
                str(frames.timestamp_ns), strip.image, labels, elevation, strip.grid.step_deg, True
            )

    return len(chosen), run()
