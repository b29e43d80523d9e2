"""The seam report: per seam and range how far two cameras are apart, in words, JSON and one HTML page."""

from __future__ import annotations

import base64
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import cv2
import numpy as np
from markupsafe import Markup

from rigwake._types import Image
from rigwake.report.html_page import card, figure, html_page, listing, note, table
from rigwake.views.prepare import SurroundSetup
from rigwake.views.projections import CylinderView
from rigwake.views.seam_blame import CameraBlame, blame_cameras
from rigwake.views.seams import PX_PER_RAD, RANGE_EDGES_M, SeamMatches, SeamMeter
from rigwake.views.surround_view import SurroundView, blind_sectors

_FEW = 8  # matches: fewer give no figure
_STYLE = "img.wide { display: block; width: 100%; height: auto }"


@dataclass(frozen=True)
class RangeBin:
    """Misalignment of what lies between two ranges. median_px: of a panorama 2048 px around; NaN with few matches."""

    from_m: float
    to_m: float
    matches: int
    median_px: float

    @property
    def median_deg(self) -> float:
        """The same as an angle."""
        return float(np.rad2deg(self.median_px / PX_PER_RAD))


@dataclass(frozen=True)
class Seam:
    """What was measured across one seam. range_m: median range of the matches (infinite: far away).

    median_px: of all matches, NaN with few. difference, difference_raw: grey levels, with and without correction.
    """

    first: str
    second: str
    azimuth_deg: float
    overlap_deg: float
    matches: int
    median_px: float
    range_m: float
    difference: float
    difference_raw: float
    bins: tuple[RangeBin, ...]

    @property
    def words(self) -> str:
        """One line for people."""
        colours = f"colours {self.difference:.1f}" if np.isfinite(self.difference) else "colours not compared"
        if not np.isfinite(self.median_px):
            return f"{self.first}|{self.second}: too little to compare ({self.matches} matches), {colours}"
        where = f"at {self.range_m:.0f} m" if np.isfinite(self.range_m) else "far away"
        return f"{self.first}|{self.second}: {self.median_px:.1f} px {where}, {colours}"


@dataclass(frozen=True)
class SeamReport:
    """All seams of a rig. blind_deg: sectors (from, to), degrees to starboard, that no camera sees."""

    seams: tuple[Seam, ...]
    blames: tuple[CameraBlame, ...]
    blind_deg: tuple[tuple[float, float], ...]
    frame_sets: int

    @property
    def to_blame(self) -> tuple[CameraBlame, ...]:
        """The cameras that stand out."""
        return tuple(blame for blame in self.blames if blame.is_to_blame)

    def lines(self) -> list[str]:
        """What a person reads at the end."""
        lines = [seam.words for seam in self.seams] or [
            "No two cameras overlap: there is no seam to measure."
        ]
        lines += [
            f"{blame.name} is turned by {blame.size_deg:.1f} deg against what the other cameras agree on"
            for blame in self.to_blame
        ]
        if self.blind_deg:
            sectors = ", ".join(f"{a:.0f} to {b:.0f}" for a, b in self.blind_deg)
            lines.append(f"blind sectors (degrees to starboard): {sectors}")
        else:
            lines.append("no blind sector")
        return lines


def measure_report(setup: SurroundSetup) -> SeamReport:
    """Measure the seams on the sample frame sets of a setup."""
    meter = SeamMeter(setup.rig, setup.colour)
    matches: list[SeamMatches] = []
    for frames in setup.samples:
        if frames.is_missing.all():
            continue
        attitude = setup.attitude_at(frames)
        matches += meter.measure(frames, attitude, setup.surface_at(frames, attitude))
    frames = setup.samples[len(setup.samples) // 2]
    attitude = setup.attitude_at(frames)
    view = SurroundView(setup.rig, CylinderView(), setup.masks)
    blames = blame_cameras(setup.rig, attitude, setup.surface_at(frames, attitude), matches)
    blind = blind_sectors(setup.rig, attitude, view.quality, frames.is_missing)
    return SeamReport(
        tuple(seams_of(setup.rig.names, matches)), tuple(blames), tuple(blind), len(setup.samples)
    )


def seams_of(names: Sequence[str], matches: Sequence[SeamMatches]) -> list[Seam]:
    """Figures per seam from the matches of many frame sets."""
    seams = []
    for pair in sorted({(m.first, m.second) for m in matches}):
        mine = [m for m in matches if (m.first, m.second) == pair]
        size = np.concatenate([np.linalg.norm(m.misalignment_px, axis=1) for m in mine])
        ranges = np.concatenate([m.range_m for m in mine])
        bins = []
        for low, high in pairwise(RANGE_EDGES_M):
            inside = (ranges >= low) & ((ranges < high) | ((high == np.inf) & np.isinf(ranges)))
            bins.append(RangeBin(low, high, int(inside.sum()), _median(size[inside])))
        turn = np.angle(np.mean([np.exp(1j * m.azimuth) for m in mine]))
        seams.append(
            Seam(
                names[pair[0]],
                names[pair[1]],
                float(np.rad2deg(turn)),
                float(np.mean([m.overlap_deg for m in mine])),
                len(size),
                _median(size),
                float(np.median(ranges)) if len(ranges) else float("inf"),
                _mean([m.difference for m in mine]),
                _mean([m.difference_raw for m in mine]),
                tuple(bins),
            )
        )
    return sorted(seams, key=lambda seam: seam.azimuth_deg)


def _median(values: Any) -> float:
    return float(np.median(values)) if len(values) >= _FEW else float("nan")


def _mean(values: Sequence[float]) -> float:
    known = [v for v in values if np.isfinite(v)]
    return float(np.mean(known)) if known else float("nan")


def report_to_dict(report: SeamReport, setup: SurroundSetup) -> dict[str, Any]:
    """Plain values for JSON; what is not known is null."""
    return {
        "frame_sets": report.frame_sets,
        "seams": [
            {
                "cameras": [seam.first, seam.second],
                "azimuth_deg": _number(seam.azimuth_deg),
                "overlap_deg": _number(seam.overlap_deg),
                "matches": seam.matches,
                "misalignment_px": _number(seam.median_px),
                "misalignment_deg": _number(float(np.rad2deg(seam.median_px / PX_PER_RAD))),
                "median_range_m": _number(seam.range_m),
                "colour_difference": _number(seam.difference),
                "colour_difference_uncorrected": _number(seam.difference_raw),
                "ranges": [
                    {
                        "from_m": b.from_m,
                        "to_m": _number(b.to_m),
                        "matches": b.matches,
                        "misalignment_px": _number(b.median_px),
                        "misalignment_deg": _number(b.median_deg),
                    }
                    for b in seam.bins
                ],
            }
            for seam in report.seams
        ],
        "cameras": [
            {
                "name": blame.name,
                "rotation_deg": [_number(x) for x in blame.rotation_deg],
                "std_deg": _number(blame.std_deg),
                "is_to_blame": blame.is_to_blame,
            }
            for blame in report.blames
        ],
        "blind_sectors_deg": [[_number(a), _number(b)] for a, b in report.blind_deg],
        "height_m": None if setup.height is None else _number(setup.height.height_m),
        "height_std_m": None if setup.height is None else _number(setup.height.std_m),
        "shell_m": _number(setup.shell_m),
        "levelled": setup.leveller.words,
        "notes": list(setup.notes),
    }


def _number(value: float) -> float | None:
    return round(float(value), 4) if np.isfinite(value) else None


def report_page(report: SeamReport, setup: SurroundSetup, title: str) -> str:
    """One HTML page that loads nothing from elsewhere."""
    frames = setup.samples[len(setup.samples) // 2]
    attitude = setup.attitude_at(frames)
    view = SurroundView(setup.rig, CylinderView(1600, 400, 25, -35), setup.masks, setup.colour)
    picture = view.picture(frames, attitude, setup.surface_at(frames, attitude))
    _mark_seams(picture, report)
    words = f"Panorama of {title}, the seams marked"
    return html_page(
        f"Seams of {title}",
        [
            card(
                "Panorama",
                figure(
                    Markup('<img class="wide" alt="{}" src="{}">').format(words, _data_uri(picture)), words
                ),
            ),
            card(
                "Seams",
                seam_table(report),
                note("A pixel is one of a panorama of 2048 around (0.18 degrees)."),
            ),
            card("Cameras", camera_table(report), listing((*report.lines(), *setup.notes))),
        ],
        f"{report.frame_sets} frame sets; {setup.leveller.words}; shell at {setup.shell_m:.0f} m.",
        _STYLE,
    )


def seam_table(report: SeamReport) -> Markup:
    """The table of seams as HTML."""
    heads = ["seam", "azimuth", "overlap", "matches", "misalignment"]
    bins = report.seams[0].bins if report.seams else ()
    heads += [_range_words(b) for b in bins] + ["colours", "uncorrected"]
    rows = [
        [
            f"{seam.first}|{seam.second}",
            _cell(seam.azimuth_deg, "deg", 0),
            _cell(seam.overlap_deg, "deg", 0),
            _cell(seam.matches, "", 0),
            _cell(seam.median_px, "px", 1),
            *(_cell(b.median_px, "px", 1) for b in seam.bins),
            _cell(seam.difference, "", 1),
            _cell(seam.difference_raw, "", 1),
        ]
        for seam in report.seams
    ]
    return table("Seams", heads, rows)


def camera_table(report: SeamReport) -> Markup:
    """The table of rotations as HTML."""
    rows = [
        [
            blame.name,
            *(f"{x:+.2f}" for x in blame.rotation_deg),
            f"{blame.std_deg:.2f}",
            "stands out" if blame.is_to_blame else "agrees",
        ]
        for blame in report.blames
    ]
    heads = ["camera", "about ahead, °", "about port, °", "about up, °", "std, °", "verdict"]
    return table("Cameras", heads, rows)


def _range_words(b: RangeBin) -> str:
    return f"{b.from_m:g}-{b.to_m:g} m" if np.isfinite(b.to_m) else f"beyond {b.from_m:g} m"


def _cell(value: float, unit: str, digits: int) -> str:
    return f"{value:.{digits}f} {unit}".strip() if np.isfinite(value) else "–"


def _mark_seams(picture: Image, report: SeamReport) -> None:
    width = picture.shape[1]
    for seam in report.seams:
        column = round((seam.azimuth_deg + 180) / 360 * width - 0.5) % width
        cv2.line(picture, (column, 0), (column, picture.shape[0]), (255, 255, 255), 1, cv2.LINE_AA)
        left = min(column + 4, width - 160)
        cv2.putText(
            picture, f"{seam.first}|{seam.second}", (left, 18), cv2.FONT_HERSHEY_SIMPLEX, 0.5, (255, 255, 255), 1
        )  # fmt: skip


def _data_uri(picture: Image) -> str:
    _, encoded = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, 88])
    return "data:image/jpeg;base64," + base64.b64encode(encoded.tobytes()).decode()
