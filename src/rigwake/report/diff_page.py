"""The page of two calibrations of one rig: what moved, what that does to the pixels, both rigs from above."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from markupsafe import Markup

from rigwake.calibration import CalibratedCamera, Calibration
from rigwake.evaluation.rig_errors import CameraDifference
from rigwake.report.charts import arrow_scale, image_map
from rigwake.report.extrinsics import number
from rigwake.report.html_page import card, figure, grid, html_page, legend, listing, note, side_by_side, table
from rigwake.report.reduce import ImageMap
from rigwake.report.strip_charts import interval_chart, rig_from_above

_COLUMNS, _ROWS = 16, 12


def diff_page(
    first: Calibration,
    second: Calibration,
    differences: Mapping[str, CameraDifference],
    ranges_m: Sequence[float],
    names: tuple[str, str],
    notes: Sequence[str] = (),
) -> str:
    """One HTML page. first, second: in one frame; names: of their files."""
    before, after = names
    range_m = sorted(ranges_m)[len(ranges_m) // 2]
    rigs = [
        {n: c.rig_from_cam for n, c in rig.cameras.items() if n in differences} for rig in (first, second)
    ]
    maps = [
        _shift_map(k, first.cameras[name], second.cameras[name], range_m)
        for k, name in enumerate(differences)
    ]
    shifts = card(
        f"Shift of a point at {range_m:g} m",
        grid(*maps),
        note(f"Arrows: where the picture of a point at {range_m:g} m goes from {before} to {after}."),
    )
    return html_page(
        f"{after} against {before}",
        [
            card("How the cameras moved", _moved(differences), _sigma_note(differences), listing(notes)),
            card("What that does to pixels", _pixels(differences, ranges_m)),
            shifts if any(maps) else Markup(""),
            card(
                "Both rigs",
                legend(names),
                side_by_side(
                    figure(
                        rig_from_above("Both rigs from above", rigs),
                        f"From above, in the frame of {first.reference}: x to the right, y up; lines point where the "
                        f"cameras look. Dashed: {after}.",
                    ),
                    figure(_offsets(differences), f"Time offset of {after} minus that of {before}."),
                ),
            ),
        ],
        f"Differences of {len(differences)} cameras, in the frame of {first.reference}.",
    )


def _moved(differences: Mapping[str, CameraDifference]) -> Markup:
    rows = [
        [
            name,
            number(d.rotation_deg, 4),
            *(number(x, 1) for x in d.translation_mm),
            "–" if d.sigmas is None else f"{d.sigmas:.1f}",
        ]
        for name, d in differences.items()
    ]
    return table(
        "How the cameras moved", ["camera", "rotation, °", "x, mm", "y, mm", "z, mm", "sigmas"], rows
    )


def _sigma_note(differences: Mapping[str, CameraDifference]) -> Markup:
    if all(d.sigmas is None for d in differences.values()):
        return Markup("")
    return note(
        "Sigmas: the difference in units of both covariances together. About 1: the files agree; 3 and more: not."
    )


def _pixels(differences: Mapping[str, CameraDifference], ranges_m: Sequence[float]) -> Markup:
    def words(pair: tuple[float, float] | None) -> str:
        return "–" if pair is None else f"{pair[0]:.2f} / {pair[1]:.2f}"

    rows = [
        [name, *(words(d.shift_px.get(r)) for r in ranges_m), words(d.lens_px)]
        for name, d in differences.items()
    ]
    if all(cell == "–" for row in rows for cell in row[1:]):
        return Markup("")
    head = ["camera", *(f"at {r:g} m, px" for r in ranges_m), "lens alone, px"]
    return Markup("").join(
        [table("Shift of a point", head, rows), note("Median and largest over the image, in pixels.")]
    )


def _offsets(differences: Mapping[str, CameraDifference]) -> Markup:
    known = {n: (d.time_offset_ms, np.nan) for n, d in differences.items() if d.time_offset_ms is not None}
    return interval_chart("Time offsets", "difference of time offsets, ms", known)


def _shift_map(colour: int, first: CalibratedCamera, second: CalibratedCamera, range_m: float) -> Markup:
    """Arrows over the image: from where the first file puts points at one range to where the second does."""
    lens = first.model or second.model
    b_from_a = second.rig_from_cam.inverse() * first.rig_from_cam
    if lens is None or not np.isfinite(b_from_a.matrix).all():
        return Markup("")
    u = (np.arange(_COLUMNS) + 0.5) * lens.width_px / _COLUMNS - 0.5
    v = (np.arange(_ROWS) + 0.5) * lens.height_px / _ROWS - 0.5
    pixels = np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 2)
    bearings, seen = lens.unproject(pixels)
    shift = np.full((len(pixels), 2), np.nan)
    moved, still_seen = lens.project(b_from_a * (range_m * bearings[seen]))
    shift[seen] = np.where(still_seen[:, None], moved - pixels[seen], np.nan)
    drawn = ImageMap(
        lens.width_px, lens.height_px, np.zeros((_ROWS, _COLUMNS)), shift.reshape(_ROWS, _COLUMNS, 2)
    )
    words = f"{first.name}: an arrow as long as a cell is {arrow_scale(drawn):.2g} px."
    return figure(image_map(f"Shift over the image of {first.name}", drawn, colour), words)
