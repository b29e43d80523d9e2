"""The page of a trajectory against a known one, in the report's style."""

from __future__ import annotations

import numpy as np

from rigwake.evaluation.trajectory_evaluation import TrajectoryEvaluation
from rigwake.report.charts import Series, line_chart, top_view
from rigwake.report.html_page import card, figure, html_page, legend, side_by_side, table

_MOST_POINTS = 2000  # of a line; more would not be seen


def trajectory_page(evaluation: TrajectoryEvaluation, found: str, truth: str) -> str:
    """One HTML file: the figures, both paths from above, the errors over time. found, truth: names of the files."""
    e = evaluation
    step = max(1, -(-len(e.times_s) // _MOST_POINTS))
    paths = top_view(
        "Both paths from above",
        [
            Series("known", e.true_world[::step, 0], e.true_world[::step, 1], 0),
            Series("found", e.found_world[::step, 0], e.found_world[::step, 1], 1),
        ],
    )
    charts = [figure(paths, "From above; the squares mark the starts.")]
    for title, unit, values, colour in (
        ("Position error", "m", e.position_error_m, 0),
        ("Rotation error", "deg", e.rotation_error_deg, 1),
    ):
        line = Series(title, e.times_s[::step], np.asarray(values[::step], np.float64), colour)
        charts.append(figure(line_chart(title, "time, s", unit, [line]), f"{title} over time."))
    rows = [list(row) for row in figures_in_words(e)]
    return html_page(
        f"{found} against {truth}",
        [
            card("Errors", table("Errors", ["figure", "value"], rows)),
            card("Paths", legend(("known", "found")), charts[0]),
            card("Over time", side_by_side(*charts[1:])),
        ],
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
