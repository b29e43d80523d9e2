"""OUT/report.html: one file, no network, nothing but what stands in the folder."""

from __future__ import annotations

import json
from collections.abc import Mapping
from functools import cache
from importlib import resources
from pathlib import Path
from typing import Any

import jinja2
import numpy as np
from markupsafe import Markup

from rigwake import __version__
from rigwake._types import Array
from rigwake.atomic import write_text_atomic
from rigwake.calibration.yaml_file import plain
from rigwake.report.adjustment_file import LandmarkCloud
from rigwake.report.charts import Series, arrow_scale, image_map, line_chart, top_view
from rigwake.report.content import RIG_TRAJECTORY, ReportContent, load_report_content
from rigwake.report.extrinsics import directions, number, overview, plus_minus, time_offset, two_digits
from rigwake.report.html_page import CLOCKS_ARE_SET_NS
from rigwake.report.lens_displacement import lens_displacements
from rigwake.report.motion_figures import MotionFigures, motion_of, paths_in_one_world
from rigwake.report.picture_overlays import embed_pictures, mask_uri
from rigwake.report.report_verdict import judge, odd_limit_px, odd_pairs
from rigwake.report.scene import path_scene, rig_scene
from rigwake.report.seamless import load_seamless
from rigwake.report.sensor_charts import sensor_charts
from rigwake.trajectory import Trajectory


def build_report(source: ReportContent | Path | str) -> Path:
    """Write `report.html` into the folder of a calibration and return its path; InputError without calibration.

    source: the folder, or what was read from it.
    """
    content = source if isinstance(source, ReportContent) else load_report_content(source)
    path = content.folder / "report.html"
    write_text_atomic(path, render(content))
    return path


def render(content: ReportContent) -> str:
    """The whole page."""
    return _environment().get_template("report.html.j2").render(_values(content))


@cache
def _environment() -> jinja2.Environment:
    # names come from recordings: everything is escaped unless it is Markup made here
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("rigwake.report", "templates"),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters["number"] = number
    environment.filters["plus_minus"] = plus_minus
    environment.globals["image_map"] = image_map
    environment.globals["arrow_scale"] = arrow_scale
    environment.globals["mask_uri"] = mask_uri
    environment.globals["zip"] = zip
    return environment


def _values(content: ReportContent) -> dict[str, Any]:
    calibration = content.calibration
    names = dict.fromkeys([*calibration.cameras, *content.tracks, *content.masks])  # also those given up
    colours = {name: index for index, name in enumerate(names)}
    paths = paths_in_one_world(content.trajectories, RIG_TRAJECTORY)
    rig = content.trajectories.get(RIG_TRAJECTORY)
    motion = motion_of(rig) if rig is not None else None
    embedded, unreadable = embed_pictures(content.pictures)
    landmarks = content.adjustment.landmarks
    scenes = {"rig": rig_scene(calibration), "paths": path_scene(paths, colours, landmarks)}
    association = calibration.checks.get("hand_over")
    return {
        "version": __version__,
        "css": _asset("report.css"),
        "js": _asset("report.js"),
        "scenes": _json(scenes),
        "content": content,
        "calibration": calibration,
        "recorded": _recorded(calibration.provenance, rig),
        "lenses": {name: c.model for name, c in calibration.cameras.items() if c.model is not None},
        "colours": colours,
        "verdict": judge(calibration),
        "rows": overview(calibration),
        "halves": _halves(calibration.checks),
        "odd_pairs": odd_pairs(association),
        "odd_limit_px": _odd_limit_px(association),
        "sensors": sensor_charts(content.adjustment),
        "landmarks": landmarks,
        "rig_dimensions": scenes["rig"]["dimensions"],
        "landmarks_shown": sum(len(cloud["points"]) for cloud in scenes["paths"]["cloud"]),
        "directions": {name: directions(camera) for name, camera in calibration.cameras.items()},
        "offsets": [time_offset(camera) for camera in calibration.cameras.values()],
        "sigma_rows": _sigma_rows(content),
        "charts": _charts(content, motion, paths, colours),
        "motion": motion,
        "pictures": embedded,
        "unreadable": unreadable,
        "seamless": load_seamless(content.folder),
        "checks": plain(calibration.checks),
        "provenance": plain(calibration.provenance),
        "steps": _first_guess(content),
        "displacements": lens_displacements(calibration),
        "refined": {
            name: _refined(found)
            for name, c in calibration.cameras.items()
            if isinstance(found := c.statistics.get("intrinsics"), Mapping)
        },
        "statistics": {name: plain(c.statistics) for name, c in calibration.cameras.items() if c.statistics},
        "statistic_names": list(
            # what was found of the lens has a table of its own
            dict.fromkeys(k for c in calibration.cameras.values() for k in c.statistics if k != "intrinsics")
        ),
    }


def _recorded(provenance: Mapping[str, Any], rig: Trajectory | None) -> str:
    """Which recording, when and how long, as far as it is known."""
    inputs = provenance.get("inputs")
    names = (
        [str(i.get("path", "")) for i in inputs if isinstance(i, Mapping)]
        if isinstance(inputs, list | tuple)
        else []
    )
    words = [", ".join(Path(name).name for name in names if name)]
    if rig is not None:
        start = int(rig.timestamps_ns[0])
        if start >= CLOCKS_ARE_SET_NS:
            words.append(str(np.datetime64(start, "ns").astype("datetime64[s]")).replace("T", " ") + " UTC")
        words.append(f"{rig.duration_s:.0f} s")
    return ", ".join(word for word in words if word)


def _asset(name: str) -> Markup:
    return Markup(resources.files("rigwake.report").joinpath("assets", name).read_text(encoding="utf-8"))


def _json(value: Any) -> Markup:
    """JSON that cannot end the script element it stands in."""
    text = json.dumps(plain(value), separators=(",", ":"), allow_nan=False)
    return Markup(text.replace("&", "\\u0026").replace("<", "\\u003c").replace(">", "\\u003e"))


def _first_guess(content: ReportContent) -> dict[str, tuple[Array, Array]]:
    """Per camera the position (metres) of the initial guess and of the result, in the frame of the initial guess."""
    first, result = content.initial, content.calibration
    if first is None:
        return {}
    pairs = {
        name: (c.rig_from_cam, result.cameras[name].rig_from_cam)
        for name, c in first.cameras.items()
        if name in result.cameras
    }
    if first.reference == result.reference:
        return {name: (a.translation, b.translation) for name, (a, b) in pairs.items()}
    if first.reference not in result.cameras:
        return {}
    first_from_rig = result.cameras[first.reference].rig_from_cam.inverse()
    return {name: (a.translation, (first_from_rig * b).translation) for name, (a, b) in pairs.items()}


_SIGMA_FLOOR, _SIGMA_CEILING = 1e-4, 1.0  # degrees and metres alike: the ends of the bars


def _odd_limit_px(association: Any) -> float:
    median = association.get("median_px") if isinstance(association, Mapping) else None
    return odd_limit_px(float(median)) if isinstance(median, int | float) else float("inf")


def _refined(found: Mapping[str, Any]) -> dict[str, Any]:
    """What is said of a refined lens, of a file that may hold anything."""
    std, names = plain(found.get("std")), plain(found.get("not_determined"))
    return {
        "std": std if isinstance(std, Mapping) else {},
        "not_determined": [str(name) for name in names] if isinstance(names, list) else [],
    }


def _halves(checks: Mapping[str, Any]) -> dict[str, list[list[tuple[str, str]]]]:
    """Per camera and half: x, y, z (mm) and the rotation, as text and their own sigma; of older files nothing."""
    found: dict[str, list[list[tuple[str, str]]]] = {}
    split = plain(checks.get("split_half"))
    for name, one in split.items() if isinstance(split, Mapping) else ():
        halves = one.get("halves") if isinstance(one, Mapping) else None
        for half in halves if isinstance(halves, list) else ():
            told = half if isinstance(half, Mapping) else {}
            positions, stds, turns = (_three(told.get(key)) for key in _HALF)
            cells = [
                (number(1e3 * x, 1), plus_minus(1e3 * s, "mm")) for x, s in zip(positions, stds, strict=True)
            ]
            known = turns[np.isfinite(turns)]
            cells.append(("", plus_minus(known.max(), "°") if len(known) else "unobservable"))
            found.setdefault(str(name), []).append(cells)
    return found


_HALF = ("translation_m", "std_translation_m", "std_rotation_deg")


def _three(values: Any) -> Array:
    """Three figures of a file that may hold anything; NaN where there is none."""
    given = values if isinstance(values, list) and len(values) == 3 else [None] * 3
    return np.array([float(x) if isinstance(x, int | float) else np.nan for x in given])


def _sigma_rows(content: ReportContent) -> list[tuple[str, list[tuple[str, float | None]]]]:
    """Per camera six standard deviations as text and as the length (percent) of a logarithmic bar."""
    rows = []
    for name, camera in content.calibration.cameras.items():
        cells: list[tuple[str, float | None]] = []
        observable = camera.observable_axes
        values = np.concatenate([camera.std_rotation_deg, camera.std_translation_m])
        for axis, value in enumerate(values.tolist()):
            if not observable[axis]:
                cells.append(("unobservable", None))
            elif not np.isfinite(value):
                cells.append(("unknown", None))
            else:
                text = f"{two_digits(value)}°" if axis < 3 else f"{two_digits(1e3 * value)} mm"
                span = np.log(max(value, _SIGMA_FLOOR) / _SIGMA_FLOOR) / np.log(_SIGMA_CEILING / _SIGMA_FLOOR)
                cells.append((text, float(np.clip(100 * span, 1, 100))))
        rows.append((name, cells))
    return rows


def _cloud_from_above(landmarks: LandmarkCloud | None, colours: Mapping[str, int]) -> list[Series]:
    """Landmarks by the camera that saw them first."""
    if landmarks is None:
        return []
    names = np.array(landmarks.cameras)
    points = landmarks.points_world
    return [
        Series(name, points[names == name, 0], points[names == name, 1], colours.get(name, 7))
        for name in dict.fromkeys(landmarks.cameras)
    ]


def _charts(
    content: ReportContent,
    motion: MotionFigures | None,
    paths: dict[str, np.ndarray],
    colours: dict[str, int],
) -> dict[str, Markup]:
    residuals, tracks = content.residuals, content.tracks

    def over(axis: str, values: str) -> list[Series]:
        curves = {name: getattr(r, axis) for name, r in residuals.items()}
        return [Series(n, c.at, getattr(c, values), colours.get(n, 0)) for n, c in curves.items()]

    angle, time = "angle from the axis, degrees", "time, s"
    return {
        "angle": line_chart(
            "Residuals against the angle from the optical axis",
            angle,
            "median, px",
            over("over_angle", "median"),
        ),
        "time": line_chart("Residuals over time", time, "median, px", over("over_time", "median")),
        "angle_counts": line_chart(
            "Observations against the angle from the optical axis",
            angle,
            "observations",
            over("over_angle", "counts"),
        ),
        "time_counts": line_chart(
            "Observations over time", time, "observations", over("over_time", "counts")
        ),
        "tracks": line_chart(
            "Tracked points per frame",
            "time, s",
            "points",
            [Series(n, t.per_frame_at_s, t.per_frame, colours.get(n, 0)) for n, t in tracks.items()],
        ),
        "sizes": line_chart(
            "Histogram of the residuals' sizes",
            "size, px",
            "observations",
            [Series(n, r.histogram_px, r.histogram, colours.get(n, 0)) for n, r in residuals.items()],
        ),
        "top": top_view(
            "Paths and landmarks seen from above",
            [Series(n, p[:, 0], p[:, 1], colours.get(n, 7)) for n, p in reversed(list(paths.items()))],
            cloud=_cloud_from_above(content.adjustment.landmarks, colours),
        ),
        **_motion_charts(motion),
    }


def _motion_charts(motion: MotionFigures | None) -> dict[str, Markup]:
    """How the rig turned and how fast it went; none without a trajectory of it."""
    if motion is None:
        return {}
    time = "time, s"
    yaw, pitch, roll = motion.yaw_pitch_roll_deg.T
    turned = [Series("yaw", motion.at_s, yaw, 0)]
    tilted = [Series("roll", motion.at_s, roll, 0), Series("pitch", motion.at_s, pitch, 1)]
    speed = [Series("speed", motion.at_s, motion.speed, 0)]
    return {
        "yaw": line_chart("Yaw over time", time, "yaw, deg", turned, from_zero=False),
        "tilt": line_chart("Roll and pitch over time", time, "roll, pitch, deg", tilted, from_zero=False),
        "speed": line_chart("Speed over time", time, "speed, m/s", speed),
    }
