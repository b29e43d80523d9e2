"""The page of a trajectory against a known one, in the report's style."""

from __future__ import annotations

from html import escape
from importlib import resources

import numpy as np

from rigwake.evaluation.trajectory_evaluation import TrajectoryEvaluation
from rigwake.report.charts import Series, line_chart, top_view

_MOST_POINTS = 2000  # of a line; more would not be seen


def trajectory_page(evaluation: TrajectoryEvaluation, found: str, truth: str) -> str:
    """One HTML file: the figures, both paths from above, the errors over time. found, truth: names of the files."""
    e = evaluation
    step = max(1, -(-len(e.times_s) // _MOST_POINTS))
    rows = "".join(
        f'<tr><td class="words">{escape(what)}</td><td>{escape(value)}</td></tr>'
        for what, value in figures_in_words(e)
    )
    paths = top_view(
        "Both paths from above",
        [
            Series("known", e.true_world[::step, 0], e.true_world[::step, 1], 0),
            Series("found", e.found_world[::step, 0], e.found_world[::step, 1], 1),
        ],
    )
    charts = [paths]
    for title, unit, values, colour in (
        ("Position error", "m", e.position_error_m, 0),
        ("Rotation error", "deg", e.rotation_error_deg, 1),
    ):
        line = Series(title, e.times_s[::step], np.asarray(values[::step], np.float64), colour)
        charts.append(line_chart(title, "s", unit, [line]))
    cards = "".join(f'<section class="card">{chart}</section>' for chart in charts)
    css = resources.files("rigwake.report").joinpath("assets", "report.css").read_text(encoding="utf-8")
    title = escape(f"{found} against {truth}")
    head = (
        '<meta charset="utf-8"><meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>{title}</title><style>{css}</style>"
    )
    return (
        f'<!doctype html><html lang="en"><head>{head}</head><body><header><h1>{title}</h1></header><main>'
        f'<section class="card"><h2>Errors</h2><table>{rows}</table></section>{cards}</main></body></html>'
    )


def figures_in_words(e: TrajectoryEvaluation) -> list[tuple[str, str]]:
    """Name and value of every figure."""
    a = e.absolute
    rows = [
        ("alignment", {None: "none", "se3": "SE(3)", "sim3": "Sim(3)"}.get(e.alignment, str(e.alignment))),
        ("matched poses", str(a.pairs)),
        ("ATE, RMS", f"{a.rmse_m:.4f} m"),
        ("ATE, median", f"{a.median_m:.4f} m"),
        ("ATE, largest", f"{a.max_m:.4f} m"),
        ("rotation, RMS", f"{a.rotation_rmse_deg:.4f} deg"),
        ("scale fitted", f"{a.scale:.5f}"),
    ]
    if e.relative is not None:
        words = f"{e.relative.rmse_m:.4f} m, {e.relative.rotation_rmse_deg:.4f} deg"
        rows.append(("RPE per pose, RMS", words))
    if e.kitti is None:
        rows.append(("KITTI", "none: the path is shorter than 100 m"))
    else:
        words = f"{e.kitti.t_rel_percent:.3f} %, {e.kitti.r_rel_deg_per_100m:.4f} deg / 100 m"
        rows.append(("KITTI t_rel, r_rel", words))
    return rows
