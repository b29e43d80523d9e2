"""An inspection as one page: verdict, sensors over time, pictures, motion, time offsets."""

from __future__ import annotations

from typing import Any

import numpy as np
from markupsafe import Markup
from numpy.typing import NDArray

from rigwake._types import Array
from rigwake.inspection.readiness import Readiness
from rigwake.inspection.recording_inspection import Inspection, sensors
from rigwake.inspection.timing import periods_s
from rigwake.inspection.told_over_time import ToldOverTime
from rigwake.recording import main_gnss
from rigwake.report.charts import Series, line_chart, top_view
from rigwake.report.html_page import (
    CLOCKS_ARE_SET_NS,
    card,
    figure,
    grid,
    html_page,
    legend,
    listing,
    note,
    picture,
    side_by_side,
    table,
    verdict,
)
from rigwake.report.strip_charts import interval_chart, presence_chart

_MAX_POINTS = 1500  # of one curve
_TONES = {"enough": "good", "partly": "usable", "not enough": "lost"}
_PASSED = {True: "yes", False: "no", None: "cannot tell"}


def inspection_page(inspection: Inspection, readiness: Readiness, told: ToldOverTime | None = None) -> str:
    """The page; it loads nothing from elsewhere. Pictures that cannot be read are left out."""
    recording = inspection.recording
    checks = [[check.name, check.measured, _PASSED[check.passed]] for check in readiness.checks]
    findings = [[f.severity, f.sensor, f.message] for f in inspection.findings]
    return html_page(
        f"Inspection of {recording.path.name}",
        [
            verdict(_TONES[readiness.word], readiness.word.capitalize(), [readiness.summary]),
            card("What to do differently", listing(readiness.advice)),
            card(
                "Requirements", table("Requirements", ["check", "measured", "enough"], checks, words=(1, 2))
            ),
            _sensors_card(inspection),
            card("Findings", table("Findings", ["", "sensor", "finding"], findings, words=(1, 2))),
            card("Pictures", grid(*_pictures(inspection))),
            _motion_card(inspection),
            _information_card(inspection, told),
            _time_offsets_card(inspection),
        ],
        f"{recording.kind}. {_when(inspection)}",
    )


def _when(inspection: Inspection) -> str:
    start, end = _span_ns(inspection)
    if end <= start:
        return ""
    if start < CLOCKS_ARE_SET_NS:
        return f"{(end - start) * 1e-9:.1f} s; its stamps are no dates."
    began = np.datetime64(start, "ns").astype("datetime64[s]")
    return f"{str(began).replace('T', ' ')} UTC by its own stamps, {(end - start) * 1e-9:.1f} s."


def _span_ns(inspection: Inspection) -> tuple[int, int]:
    filled = [t for t in inspection.timings.values() if t.samples]
    return min((t.start_ns for t in filled), default=0), max((t.end_ns for t in filled), default=0)


def _sensors_card(inspection: Inspection) -> Markup:
    rows = [
        [key, str(t.samples), f"{t.duration_s:.1f}", f"{t.rate_hz:.2f}", f"{t.jitter_ms:.2f}", str(t.dropped)]
        for key, t in inspection.timings.items()
    ]
    streams = {key: np.asarray(stream.timestamps_ns) for key, stream in sensors(inspection.recording).items()}
    return card(
        "Sensors over time",
        table("Sensors", ["sensor", "samples", "s", "Hz", "jitter, ms", "missing"], rows),
        legend(key for key, stamps in streams.items() if len(stamps) > 2),
        side_by_side(
            figure(
                presence_chart("When each sensor recorded", streams),
                "When each sensor recorded. A break in a bar: samples are missing.",
            ),
            figure(
                _waits_chart(inspection, streams),
                "Longest wait for the next sample, in periods of that sensor: 1 is regular, 2 is one sample missing.",
            ),
        ),
    )


def _waits_chart(inspection: Inspection, streams: dict[str, NDArray[np.int64]]) -> Markup:
    start, _ = _span_ns(inspection)
    series: list[Series] = []
    for stamps in (s for s in streams.values() if len(s) > 2):
        waits = periods_s(stamps)
        times, longest = _peaks_kept(
            np.asarray((stamps[1:] - start) * 1e-9), waits / max(float(np.median(waits)), 1e-9)
        )
        series.append(Series("", times, longest, len(series)))
    return line_chart("Longest wait between samples", "time, s", "periods", series)


def _peaks_kept(times: Array, values: Array, most: int = 300) -> tuple[Array, Array]:
    """Fewer points, of each block the largest value, so that no gap is lost."""
    block = max(-(-len(values) // most), 1)
    starts = np.arange(0, len(values), block)
    rows = np.array([start + int(values[start : start + block].argmax()) for start in starts])
    return times[rows], values[rows]


def _pictures(inspection: Inspection) -> list[Markup]:
    """The middle frame of every camera."""
    drawn = []
    for name, camera in inspection.recording.cameras.items():
        frame = next(iter(camera.frames([len(camera) // 2], colour=True)), None) if len(camera) else None
        if frame is None:
            continue
        lens = camera.model.model if camera.model is not None else "no intrinsics"
        after_s = (frame.timestamp_ns - _span_ns(inspection)[0]) * 1e-9
        words = f"{name}: {camera.width_px} x {camera.height_px}, {lens}, at {after_s:.1f} s"
        drawn.append(picture(frame.image, words))
    return drawn


def _thinned(*columns: NDArray[Any]) -> list[NDArray[Any]]:
    step = max(-(-len(columns[0]) // _MAX_POINTS), 1)
    return [column[::step] for column in columns]


def _motion_card(inspection: Inspection) -> Markup:
    turn, path = inspection.turning, inspection.travel
    start, _ = _span_ns(inspection)
    charts = []
    if turn is not None:
        times, rate, tilt = _thinned((turn.times_ns - start) * 1e-9, np.degrees(turn.yaw_rate), turn.tilt_deg)
        charts = [
            figure(
                line_chart("Turning", "time, s", "deg/s", [Series("", times, rate)], from_zero=False),
                f"Turning about the vertical: {turn.turned_deg:.0f} degrees in all, to both sides.",
            ),
            figure(
                line_chart("Tilt", "time, s", "deg", [Series("", times, tilt, 1)]),
                f"Tilt; standard deviations {turn.tilt_std_deg[0]:.1f} and {turn.tilt_std_deg[1]:.1f} degrees.",
            ),
        ]
    if path is not None:
        times, speed = _thinned((path.times_ns - start) * 1e-9, path.speed)
        charts.append(
            figure(
                line_chart("Speed", "time, s", "m/s", [Series("", times, speed, 2)]),
                f"Speed by GNSS; {path.path_m:.0f} m in all.",
            )
        )
    gnss = main_gnss(inspection.recording)
    if gnss is not None and len(gnss.timestamps_ns) > 1:
        east, north = _thinned(gnss.position_enu[:, 0], gnss.position_enu[:, 1])
        seen = top_view("Path of the antenna from above", [Series("", east, north)])
        charts.append(
            figure(seen, "Path of the antenna from above; east to the right. The square is the start.")
        )
    return card("Motion", side_by_side(*charts))


def _information_card(inspection: Inspection, told: ToldOverTime | None) -> Markup:
    """What each stretch tells about the rig, and which of them `calibrate` would use."""
    if told is None:
        return Markup("")
    begin = (told.starts_ns - _span_ns(inspection)[0]) * 1e-9
    edges = np.stack([begin, begin + told.lengths_s], axis=1)
    percent = 100 * told.told
    series = [Series("", edges.ravel(), np.repeat(percent, 2))]
    if told.chosen.any():
        middle = edges.mean(axis=1)[told.chosen]
        series.append(Series("", middle, percent[told.chosen], 1, is_dots=True))
    title = "Information about the rig over time"
    words = (
        f"What each stretch tells, in percent of the whole; dots: stretches that would be used. {told.words}"
    )
    return card(title, figure(line_chart(title, "time, s", "% of all", series), words))


def _time_offsets_card(inspection: Inspection) -> Markup:
    offsets = inspection.time_offsets
    if not offsets:
        return Markup("")
    known = {key: o for key, o in offsets.items() if o.offset_s is not None and o.std_s is not None}
    chart = interval_chart(
        "Time offsets to the IMU",
        "offset, ms",
        {key: (1e3 * (o.offset_s or 0.0), 1e3 * (o.std_s or 0.0)) for key, o in known.items()},
    )
    open_ones = [f"{key}: cannot tell, {o.why}." for key, o in offsets.items() if key not in known]
    return card(
        "Time offsets to the IMU",
        figure(chart, "t_imu = t_sensor + offset. Thick bar: one standard deviation; thin bar: three."),
        listing(open_ones),
        note("A rough look at the motion; the calibration estimates them again, finer."),
    )
