"""The page of lenses calibrated with a board: corners in a picture, undistorted sample, residuals, and how uncertain
the projection is over the image."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import cv2
import numpy as np
from markupsafe import Markup

from rigwake._types import Array, Image
from rigwake.cameras.models.lens import axis_focal_px
from rigwake.cameras.models.pinhole import Pinhole
from rigwake.cameras.virtual_views import remap_table
from rigwake.intrinsics.board_calibration import IntrinsicCalibration
from rigwake.intrinsics.projection_uncertainty import projection_std_px
from rigwake.report.charts import Series, arrow_scale, image_map, line_chart
from rigwake.report.extrinsics import two_digits
from rigwake.report.html_page import card, figure, grid, html_page, listing, note, picture, table, verdict
from rigwake.report.reduce import map_over_image

_COLUMNS, _ROWS = 16, 12
_WIDEST = np.deg2rad(60.0)  # off the axis, of the undistorted sample
_LARGEST_PX = 900
_LIMITS_PX = (0.1, 0.3, 1.0, 3.0)
_TONES = ("#2cc59a", "#b9d84a", "#f5b83d", "#ff8a3c", "#d6336c")


@dataclass(frozen=True, eq=False)
class CalibratedLens:
    """What the page shows of one camera. load: the image of a view by its name, None where it cannot be had.
    unused: names of views or images that did not serve, with the reason."""

    result: IntrinsicCalibration
    load: Callable[[str], Image | None] = lambda name: None
    unused: tuple[tuple[str, str], ...] = ()


def intrinsics_page(
    source: str, lenses: Mapping[str, CalibratedLens], failed: Mapping[str, str] | None = None
) -> str:
    """One HTML page. source: what the images came from; failed: reasons of cameras without a result."""
    failed = failed or {}
    reservations = [f"{name}: {why}" for name, why in failed.items()]
    reservations += [
        f"{name}: unobservable by these views: {', '.join(lens.result.unobservable)}."
        for name, lens in lenses.items()
        if lens.result.unobservable
    ]
    tone = "lost" if not lenses else "usable" if reservations else "good"
    rows = [_row(name, lens.result) for name, lens in lenses.items()]
    head = ["camera", "model", "size, px", "focal, px", "views", "corners", "RMS, px", "farthest off axis, °"]
    return html_page(
        f"Lenses of {source}",
        [
            verdict(tone, f"{len(lenses)} of {len(lenses) + len(failed)} lenses calibrated", reservations),
            card("Lenses", table("Lenses", head, rows)),
            *(_lens_card(name, lens) for name, lens in lenses.items()),
        ],
    )


def _row(name: str, result: IntrinsicCalibration) -> list[str]:
    camera = result.camera
    return [
        name,
        camera.model,
        f"{camera.width_px} x {camera.height_px}",
        f"{axis_focal_px(camera):.1f} ± {two_digits(result.axis_focal_std_px)}",
        str(len(result.view_names)),
        f"{result.corners.used.sum():,}",
        f"{result.rms_px:.3f}",
        f"{np.rad2deg(result.max_observed_angle):.1f}",
    ]


def _lens_card(name: str, lens: CalibratedLens) -> Markup:
    result = lens.result
    view = int(np.bincount(result.corners.view_index).argmax())
    image = lens.load(result.view_names[view])
    parameters = [
        [parameter, f"{value:.8g}" if np.isfinite(std) else "–", _std_words(parameter, std, result)]
        for (parameter, std), value in zip(result.stds.items(), result.camera.params.tolist(), strict=True)
    ]
    left_out = [f"{what}: {why}" for what, why in (*result.dropped_views, *lens.unused)]
    more = [f"and {len(left_out) - 12} more"] if len(left_out) > 12 else []
    return card(
        f"Camera {name}",
        table(f"Parameters of {name}", ["parameter", "value", "± 1 σ"], parameters),
        grid(
            _corners(name, result, view, image),
            _undistorted(name, result, image),
            _uncertainty(name, result, image),
            _residual_map(name, result),
            figure(
                line_chart(f"Residuals of each view of {name}", "view", "RMS, px", [_per_view(result)]),
                f"RMS of each of {len(result.view_names)} views. One that stands out moved or is blurred.",
            ),
            figure(
                line_chart(
                    f"Residuals of {name} off the axis", "degrees off the axis", "px", [_over_angle(result)]
                ),
                "Size of each residual against the angle off the axis. No pattern: the model fits the lens.",
            ),
        ),
        note(
            f"Noise of a corner: {result.sigma_px:.3f} px per coordinate; {result.dropped_corners} corners left out."
        ),
        listing([*left_out[:12], *more]),
    )


def _std_words(parameter: str, std: float, result: IntrinsicCalibration) -> str:
    if parameter in result.fixed:
        return "held"
    return f"{std:.3g}" if np.isfinite(std) else "unobservable"


def _blank(result: IntrinsicCalibration) -> Image:
    return np.full((result.camera.height_px, result.camera.width_px), 70, np.uint8)


def _corners(name: str, result: IntrinsicCalibration, view: int, image: Image | None) -> Markup:
    rows = result.corners.slices[view]
    radius = result.camera.width_px / 110
    overlay = []
    for (u, v), (du, dv), used in zip(
        result.corners.pixels[rows].tolist(),
        (20 * result.residuals_px[rows]).tolist(),
        result.corners.used[rows].tolist(),
        strict=True,
    ):
        colour = "#56b4e9" if used else "#ff5c5c"
        overlay.append(
            f'<circle cx="{u:.1f}" cy="{v:.1f}" r="{radius:.1f}" fill="none" stroke="{colour}" stroke-width="2"/>'
        )
        overlay.append(f'<path style="stroke:#ffd400" d="M{u:.1f},{v:.1f}l{du:.1f},{dv:.1f}"/>')
    words = (
        f"{result.view_names[view]}: corners as found (circles; red: left out); yellow: residual, 20 times."
    )
    return picture(_blank(result) if image is None else image, words, overlay)


def _undistorted(name: str, result: IntrinsicCalibration, image: Image | None) -> Markup:
    """What a pinhole would have seen: the lines of the board must be straight."""
    if image is None:
        return Markup("")
    half = _half_view(result)
    focal = min(axis_focal_px(result.camera), 0.5 * _LARGEST_PX / np.tan(half))
    width = 2 * int(focal * np.tan(half))
    height = max(2, min(width, round(width * result.camera.height_px / result.camera.width_px)))
    view = Pinhole((focal, focal, (width - 1) / 2, (height - 1) / 2, *[0.0] * 6), width, height)
    seen = remap_table(result.camera, view).apply(image)
    return picture(seen, f"Undistorted, {2 * np.rad2deg(half):.0f}° wide: straight lines are straight.")


def _half_view(result: IntrinsicCalibration) -> float:
    """Radians from the axis to the middle of the farther side of the image, as far as a pinhole may show it."""
    w, h = result.camera.width_px - 1.0, result.camera.height_px - 1.0
    sides = np.array([[0.0, h / 2], [w, h / 2], [w / 2, 0.0], [w / 2, h]])
    bearings, seen = result.camera.unproject(sides)
    angles = np.arccos(np.clip(bearings[seen, 2], -1, 1))
    return min(float(angles.max()) if len(angles) else result.camera.max_angle, _WIDEST)


def _uncertainty(name: str, result: IntrinsicCalibration, image: Image | None) -> Markup:
    camera = result.camera
    width, height = camera.width_px / _COLUMNS, camera.height_px / _ROWS
    centres = np.stack(
        np.meshgrid((np.arange(_COLUMNS) + 0.5) * width - 0.5, (np.arange(_ROWS) + 0.5) * height - 0.5),
        axis=-1,
    ).reshape(-1, 2)
    std = projection_std_px(result, centres)
    overlay = []
    for k, ((u, v), value) in enumerate(zip(centres.tolist(), std.tolist(), strict=True)):
        if np.isnan(value):
            continue
        tone = _TONES[int(np.searchsorted(_LIMITS_PX, value))]
        overlay.append(
            f'<rect x="{u - width / 2:.1f}" y="{v - height / 2:.1f}" width="{width:.1f}" height="{height:.1f}" '
            f'fill="{tone}" fill-opacity="0.45"/>'
        )
        if (k // _COLUMNS) % 3 == 1 and (k % _COLUMNS) % 3 == 1:
            text = two_digits(value) if np.isfinite(value) else "∞"
            overlay.append(
                f'<text x="{u:.1f}" y="{v:.1f}" text-anchor="middle" fill="#fff" stroke="#000" stroke-width="3" '
                f'paint-order="stroke" style="font:600 {camera.width_px / 32:.0f}px system-ui">{text}</text>'
            )
    limits = "green to 0.1, yellow to 0.3, orange to 1, dark orange to 3, red beyond"
    words = (
        f"Uncertainty of the projection of distant points, 1 σ in px: {limits}. It grows where no corner was."
    )
    dimmed = _blank(result) if image is None else cv2.convertScaleAbs(image, alpha=0.8)
    return picture(dimmed, words, overlay)


def _residual_map(name: str, result: IntrinsicCalibration) -> Markup:
    used = result.corners.used
    drawn = map_over_image(result.corners.pixels[used], result.camera, result.residuals_px[used])
    words = f"Coverage (shade) and mean residuals; an arrow as long as a cell is {arrow_scale(drawn):.2g} px."
    return figure(image_map(f"Residuals over the image of {name}", drawn, 0), words)


def _per_view(result: IntrinsicCalibration) -> Series:
    squares = np.where(result.corners.used, np.sum(result.residuals_px**2, axis=1), 0.0)
    sums = np.bincount(result.corners.view_index, squares)
    counts = np.bincount(result.corners.view_index, result.corners.used)
    rms: Array = np.sqrt(sums / np.maximum(counts, 1))
    return Series("", np.arange(1.0, len(rms) + 1), rms, is_dots=True)


def _over_angle(result: IntrinsicCalibration, most: int = 1500) -> Series:
    used = np.flatnonzero(result.corners.used)
    used = used[:: max(1, -(-len(used) // most))]
    bearings, valid = result.camera.unproject(result.corners.pixels[used])
    angles = np.rad2deg(np.arccos(np.clip(bearings[valid, 2], -1, 1)))
    return Series("", angles, np.linalg.norm(result.residuals_px[used][valid], axis=1), 1, is_dots=True)
