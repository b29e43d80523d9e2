"""The report's plots as PNG or SVG files for papers (matplotlib)."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.figure import Figure

from rigwake.atomic import atomic_path
from rigwake.report.content import RIG_TRAJECTORY, ReportContent
from rigwake.report.motion_figures import paths_in_one_world
from rigwake.report.reduce import BinnedCurve, ResidualSummary

# Okabe and Ito: told apart also by the colour-blind
PALETTE = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#56B4E9", "#E69F00", "#8F8400", "#4D4D4D")
_COLUMN_INCHES = 3.5


def write_figures(content: ReportContent, folder: Path, file_format: str = "png") -> list[Path]:
    """Rig from above with 3-sigma ellipses, paths, residuals over angle and time, standard deviations.

    Returns the files written; a figure whose data are missing is left out. Also opens no window.
    """
    makers: Mapping[str, Callable[[ReportContent], Figure | None]] = {
        "rig": _rig,
        "paths": _paths,
        "residuals_angle": lambda c: _curves(c, lambda r: r.over_angle, "angle from the axis (deg)"),
        "residuals_time": lambda c: _curves(c, lambda r: r.over_time, "time (s)"),
        "sigmas": _sigmas,
    }
    files = []
    for name, make in makers.items():
        with matplotlib.rc_context({"font.size": 8, "axes.spines.top": False, "axes.spines.right": False}):
            figure = make(content)
            if figure is None:
                continue
            canvas = {"png": FigureCanvasAgg, "svg": FigureCanvasSVG}[file_format](figure)
            path = folder / f"{name}.{file_format}"
            with atomic_path(path) as temporary:
                canvas.print_figure(temporary, format=file_format, dpi=300)
            files.append(path)
    return files


def _axes(content: ReportContent, x_label: str, y_label: str, height: float = 2.4) -> tuple[Figure, Any]:
    figure = Figure(figsize=(_COLUMN_INCHES, height), layout="constrained")
    axes = figure.add_subplot()
    axes.set(xlabel=x_label, ylabel=y_label)
    return figure, axes


def _colour(content: ReportContent, name: str) -> str:
    names = list(content.calibration.cameras)
    return PALETTE[names.index(name) % len(PALETTE)] if name in names else PALETTE[-1]


def _rig(content: ReportContent) -> Figure | None:
    figure, axes = _axes(content, "x (m)", "y (m)", 3.0)
    drawn = False
    for camera in content.calibration.cameras.values():
        position, colour = camera.rig_from_cam.translation[:2], _colour(content, camera.name)
        if not np.isfinite(position).all():
            continue
        drawn = True
        axes.plot(*position, "o", ms=3, color=colour, label=camera.name)
        ahead = camera.rig_from_cam.rotation[:2, 2]
        if np.isfinite(ahead).all():
            tip = position + 0.5 * ahead
            axes.annotate(
                "", tip, position, arrowprops={"arrowstyle": "->", "color": colour}, annotation_clip=False
            )
            axes.update_datalim([tip])
        covariance = camera.covariance_rig_axes[3:5, 3:5]
        if np.isfinite(covariance).all():
            turn = np.linspace(0, 2 * np.pi, 60)
            values, vectors = np.linalg.eigh(covariance)
            ring = vectors @ (3 * np.sqrt(np.maximum(values, 0))[:, None] * [np.cos(turn), np.sin(turn)])
            axes.plot(position[0] + ring[0], position[1] + ring[1], lw=0.8, color=colour)
    axes.autoscale_view()
    axes.set_aspect("equal", adjustable="datalim")
    _legend(figure)
    return figure if drawn else None


def _legend(figure: Figure) -> None:
    """The cameras' names above everything, where they cover nothing."""
    handles, labels = figure.axes[0].get_legend_handles_labels()
    figure.legend(
        handles, labels, loc="outside upper center", ncols=5, frameon=False, fontsize=7, columnspacing=1.0
    )


def _paths(content: ReportContent) -> Figure | None:
    paths = paths_in_one_world(content.trajectories, RIG_TRAJECTORY)
    if not paths:
        return None
    figure, axes = _axes(content, "east (m)", "north (m)", 3.0)
    for name, path in paths.items():
        axes.plot(path[:, 0], path[:, 1], lw=0.9, color=_colour(content, name), label=name)
    axes.set_aspect("equal", adjustable="datalim")
    _legend(figure)
    return figure


def _curves(
    content: ReportContent, pick: Callable[[ResidualSummary], BinnedCurve], x_label: str
) -> Figure | None:
    if not content.residuals:
        return None
    figure, axes = _axes(content, x_label, "median residual (px)")
    for name, residuals in content.residuals.items():
        curve = pick(residuals)
        axes.plot(curve.at, curve.median, lw=1, color=_colour(content, name), label=name)
    axes.set_ylim(bottom=0)
    _legend(figure)
    return figure


def _sigmas(content: ReportContent) -> Figure | None:
    """Per camera the six standard deviations; what is unobservable has no point."""
    cameras = content.calibration.cameras
    if not any(np.isfinite(c.std_rotation_deg).any() for c in cameras.values()):
        return None
    figure = Figure(figsize=(_COLUMN_INCHES, 2.4), layout="constrained")
    left, right = figure.subplots(1, 2)
    for axes, label, factor in ((left, "about x y z (deg)", 1.0), (right, "along x y z (mm)", 1e3)):
        for k, (name, camera) in enumerate(cameras.items()):
            std = camera.std_rotation_deg if axes is left else camera.std_translation_m
            beside = np.arange(3) + 0.5 * ((k + 0.5) / len(cameras) - 0.5)
            axes.plot(beside, factor * std, "o", ms=3, color=_colour(content, name), label=name)
        axes.set_xticks(range(3), ["x", "y", "z"])
        axes.set_xlabel(label)
        axes.margins(y=0.1)
        axes.set_ylim(bottom=0)
    _legend(figure)
    return figure
