"""Pictures that let the eye judge an intrinsic calibration."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from rigwake._types import Array
from rigwake.atomic import atomic_path
from rigwake.intrinsics.board_calibration import IntrinsicCalibration

_CELLS_ALONG_WIDTH = 24


def save_plots(result: IntrinsicCalibration, folder: Path, name: str) -> list[Path]:
    """Write `NAME_coverage.png` and `NAME_residuals.png`; returns their paths."""
    paths = [folder / f"{name}_coverage.png", folder / f"{name}_residuals.png"]
    for path, figure in zip(paths, (_coverage(result), _residual_field(result)), strict=True):
        FigureCanvasAgg(figure)
        with atomic_path(path) as temporary:
            figure.savefig(temporary, dpi=110)
    return paths


def _image_axes(axes: Axes, result: IntrinsicCalibration, title: str) -> None:
    axes.set_xlim(-0.5, result.camera.width_px - 0.5)
    axes.set_ylim(result.camera.height_px - 0.5, -0.5)
    axes.set_aspect("equal")
    axes.set_title(title, fontsize=10)
    axes.set_xlabel("column (px)")
    axes.set_ylabel("row (px)")


def _coverage(result: IntrinsicCalibration) -> Figure:
    figure = Figure(figsize=(8, 6), layout="constrained")
    axes = figure.add_subplot()
    corners = result.corners
    used = corners.used
    columns, rows = corners.pixels.T
    axes.scatter(columns[used], rows[used], s=3, c=corners.view_index[used], cmap="turbo", label="used")
    if not used.all():
        axes.scatter(columns[~used], rows[~used], s=22, marker="x", color="red", label="dropped")
    circle = _circle_at(result, result.max_observed_angle)
    axes.plot(
        *circle.T, color="black", lw=1, label=f"{np.rad2deg(result.max_observed_angle):.1f} deg off axis"
    )
    axes.legend(loc="upper right", fontsize=8)
    _image_axes(axes, result, f"{used.sum()} corners in {len(result.view_names)} views, one colour per view")
    return figure


def _circle_at(result: IntrinsicCalibration, angle: float) -> Array:
    phi = np.linspace(0, 2 * np.pi, 361)
    rays = np.column_stack(
        [np.sin(angle) * np.cos(phi), np.sin(angle) * np.sin(phi), np.full(361, np.cos(angle))]
    )
    return result.camera.project(rays)[0]


def _residual_field(result: IntrinsicCalibration) -> Figure:
    """Mean residual per image cell: a good model leaves no pattern."""
    figure = Figure(figsize=(13, 5.5), layout="constrained")
    field, rings = figure.subplots(1, 2, width_ratios=[3, 2])
    used = result.corners.used
    pixels, r = result.corners.pixels[used], result.residuals_px[used]
    cell = result.camera.width_px / _CELLS_ALONG_WIDTH
    keys, inverse, counts = np.unique(
        (pixels // cell).astype(int), axis=0, return_inverse=True, return_counts=True
    )
    means = np.zeros((len(keys), 2))
    np.add.at(means, inverse.ravel(), r)
    means /= counts[:, None]
    arrow = 0.5 * cell / max(result.sigma_px, 1e-9)
    centres = (keys + 0.5) * cell
    field.quiver(
        *centres.T,
        *(means * arrow).T,
        counts,
        angles="xy",
        scale_units="xy",
        scale=1,
        cmap="viridis",
        width=2e-3,
    )
    _image_axes(field, result, f"mean residual per cell; half a cell is sigma = {result.sigma_px:.3f} px")
    bearings, valid = result.camera.unproject(pixels)
    angle = np.rad2deg(np.arccos(np.clip(bearings[valid, 2], -1, 1)))
    rings.scatter(angle, np.linalg.norm(r[valid], axis=1), s=3, alpha=0.4)
    rings.set_xlabel("angle off the axis (deg)")
    rings.set_ylabel("residual (px)")
    rings.set_title(f"{result.camera.model}: RMS {result.rms_px:.3f} px", fontsize=10)
    return figure
