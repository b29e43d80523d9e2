"""OUT/monitor.html: what is said of every camera, its timeline, and pictures before and after: one file, no network."""

from __future__ import annotations

import base64
from html import escape
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
from markupsafe import Markup

from rigwake._types import Array, Indices
from rigwake.atomic import write_text_atomic
from rigwake.monitor.monitor_charts import CLASSES, axis_chart, state_strip, statistic_chart
from rigwake.monitor.monitor_report import clock_words, verdict_line
from rigwake.monitor.run import CameraVerdict, MonitorResult
from rigwake.monitor.score import BLOCK_S
from rigwake.monitor.states import CameraState
from rigwake.monitor.vessel_rig import AXIS_WORDS, camera_axes
from rigwake.recording import CameraStream, Recording
from rigwake.report.html_page import html_page
from rigwake.report.picture_overlays import horizon_pixels

_STYLE = """
.state.ok { fill: var(--good) } .state.suspect { fill: var(--warn) } .state.drifted { fill: var(--bad) }
.state.recalibrating { fill: var(--accent) } .state.unobservable { fill: var(--line) }
.key { display: inline-block; width: .9rem; height: .9rem; margin: 0 .3rem 0 .9rem; vertical-align: -.1rem }
.key.ok { background: var(--good) } .key.suspect { background: var(--warn) } .key.drifted { background: var(--bad) }
.key.recalibrating { background: var(--accent) } .key.unobservable { background: var(--line) }
svg.strip { width: 100%; height: auto } figure { margin: 0 } figure img { width: 100%; height: auto; display: block }
"""
_MEAN_FRAMES = 12
_QUALITY = 80


def write_page(result: MonitorResult, recording: Recording, path: Path) -> None:
    """Write the page; pictures that cannot be read are left out."""
    write_text_atomic(path, render_page(result, recording))


def render_page(result: MonitorResult, recording: Recording) -> str:
    """The whole page as text."""
    scores = result.judgement.scores
    tone, summary = _summary(result)
    lines = "".join(
        f"<li>{escape(verdict_line(v, 'rigwake recalibrate ..'))}</li>" for v in result.verdicts.values()
    )
    notes = "".join(f'<p class="note">{escape(note)}</p>' for note in result.notes)
    keys = "".join(f'<span class="key {css}"></span>{state}' for state, css in CLASSES.items())
    strip = state_strip(scores.cameras, result.judgement.standings)
    ratio = statistic_chart(scores.cameras, result.judgement.statistics.value, result.thresholds.alarm)
    cues = "".join(f"<li>{escape(cue.words)}</li>" for cue in result.cues.values())
    parts = [
        f'<div class="verdict {tone}"><strong>{escape(summary)}</strong><ul>{lines}</ul>{notes}</div>',
        f'<section class="card"><h2>Timeline</h2>{strip}<p class="note">{keys}</p>{ratio}'
        f'<p class="note">Each cue by itself, likelihood ratio:</p><ul class="note">{cues}</ul></section>',
        *(_evidence(v, result) for v in result.verdicts.values() if v.state is CameraState.DRIFTED),
        *_camera_sections(result),
        _conditions(result),
    ]
    title = f"Have the cameras moved? {recording.path.name}"
    return html_page(title, [Markup(str(part)) for part in parts], style=_STYLE)


def _summary(result: MonitorResult) -> tuple[str, str]:
    if result.blamed:
        return "lost", f"{', '.join(result.blamed)} moved"
    suspects = [n for n, v in result.verdicts.items() if v.state is CameraState.SUSPECT]
    if suspects:
        return "usable", f"Something changed: {', '.join(suspects)} is suspect"
    if result.exit_code == 3:
        return "usable", "No sign of a camera that moved, but not all could be seen"
    return "good", "All cameras are where they were"


def _camera_sections(result: MonitorResult) -> list[str]:
    scores = result.judgement.scores
    up = scores.gravity.mean(axis=0)
    up = up / np.linalg.norm(up) if np.linalg.norm(up) > 0.1 else np.array([0.0, 0.0, 1.0])
    axes = camera_axes(result.monitored.rig, up)
    sections = []
    for k, name in enumerate(scores.cameras):
        step = np.rad2deg(result.judgement.step[:, k] @ axes[k].T)
        std = np.rad2deg(np.sqrt(np.square(result.judgement.step_std[:, k]) @ np.square(axes[k]).T))
        charts = [
            f"<figure><figcaption>about {words}</figcaption>"
            f"{axis_chart(f'{name} about {words}', step[:, a], std[:, a], k)}</figure>"
            for a, words in enumerate(AXIS_WORDS)
        ]
        sections.append(
            f'<section class="card"><h2>{escape(name)}</h2><p class="note">Rotation against the calibration by each '
            f'ten seconds alone, with two standard deviations.</p><div class="grid">{"".join(charts)}</div></section>'
        )
    return sections


def _conditions(result: MonitorResult) -> str:
    scores = result.judgement.scores
    rows = "".join(
        f"<tr><td>{k * BLOCK_S:.0f}</td><td>{scores.speed[k]:.1f}</td><td>{np.rad2deg(scores.turning[k]):.1f}</td>"
        + "".join(f"<td>{int(n)}</td>" for n in scores.rows[k])
        + "</tr>"
        for k in range(len(scores))
    )
    heads = "".join(f"<th>{escape(name)}, pairs</th>" for name in scores.cameras)
    return (
        '<section class="card"><h2>What there was to see</h2>'
        '<div class="scroll" tabindex="0" role="region" aria-label="What there was to see">'
        "<table><tr><th>s</th><th>speed, m/s"
        f"</th><th>turn rate, deg/s</th>{heads}</tr>{rows}</table></div></section>"
    )


def _evidence(verdict: CameraVerdict, result: MonitorResult) -> str:
    """The blamed camera before and after: its horizon, and means of frames: only the own hull is sharp."""
    stream = result.monitored.streams[verdict.name]
    if verdict.since_ns is None:
        return ""
    camera = result.monitored.rig.camera(verdict.name)
    on_rig = stream.timestamps_ns + round(camera.time_offset_s * 1e9)
    later = verdict.since_ns + round(BLOCK_S * 1e9)
    halves = (np.flatnonzero(on_rig < verdict.since_ns), np.flatnonzero(on_rig >= later))
    figures = []
    for words, rows in zip(("before", "after"), halves, strict=True):
        if not len(rows):
            figures.append(f"<p>{words}: not in this recording.</p>")
            continue
        shown = rows[len(rows) // 2]
        up_cam = (result.motion.up_rig_at(on_rig[[shown]]) @ camera.rig_from_cam.rotation)[0]
        figures.append(_figure(stream, int(shown), f"{words}: horizon of the calibration", up_cam))
        chosen = rows[np.unique(np.linspace(0, len(rows) - 1, _MEAN_FRAMES).astype(np.int64))]
        figures.append(
            _mean_figure(stream, chosen, f"{words}: mean of {len(chosen)} frames; the own hull is sharp")
        )
    if not any("<img" in figure for figure in figures):
        return ""
    return (
        f'<section class="card"><h2>{escape(verdict.name)} before and after '
        f'{escape(clock_words(verdict.since_ns))}</h2><div class="pair">{"".join(figures)}</div></section>'
    )


def _figure(stream: CameraStream, index: int, words: str, up_cam: Array) -> str:
    images = [frame.image for frame in stream.frames([index])]
    if not images or stream.model is None:
        return ""
    picture = cv2.cvtColor(images[0], cv2.COLOR_GRAY2BGR) if images[0].ndim == 2 else images[0].copy()
    line = horizon_pixels(stream.model, up_cam)
    for a, b in pairwise(line):
        if np.isfinite([*a, *b]).all() and np.abs(np.subtract(a, b)).max() < 50:
            cv2.line(
                picture,
                tuple(np.round(a).astype(int)),
                tuple(np.round(b).astype(int)),
                (0, 140, 255),
                1,
                cv2.LINE_AA,
            )
    return _embedded(picture, words)


def _mean_figure(stream: CameraStream, indices: Indices, words: str) -> str:
    images = [frame.image.astype(np.float32) for frame in stream.frames(indices)]
    return _embedded(np.mean(images, axis=0).astype(np.uint8), words) if images else ""


def _embedded(picture: np.ndarray, words: str) -> str:
    encoded = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])[1].tobytes()
    uri = f"data:image/jpeg;base64,{base64.b64encode(encoded).decode('ascii')}"
    return Markup('<figure><figcaption>{}</figcaption><img alt="{}" src="{}"></figure>').format(
        words, words, uri
    )
