"""Delay of the monitor over false alarms, by cue: its figures and its picture, for `benchmarks/monitor.py`."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from monitor_watches import AFTER, BEFORE, Run, excerpts
from rigwake.monitor.cues import CUES
from rigwake.monitor.score import BLOCK_S

FUSED = "all together"
RATES = (60, 30, 20, 10, 6, 3)  # of false alarms per hour, in the picture


def roc(
    motion: str, runs: list[Run], draws: int, size_deg: float = 0.2
) -> dict[str, list[tuple[float, float]]]:
    """Mean delay (s, at most three minutes) of a step about any axis at rates of false alarms per hour, by cue."""
    choices: dict[str, tuple[str, ...]] = {name: (name,) for name in CUES} | {FUSED: CUES}
    moved: dict[str, list[np.ndarray]] = {label: [] for label in choices}
    for axis in range(3):
        for _, part in excerpts(runs, draws, [axis], np.deg2rad(size_deg)):
            for label, names in choices.items():
                moved[label].append(part.statistic(names)[BEFORE:])
    hours = sum(len(run.alone) for run in runs) * BLOCK_S / 3600
    curves = {}
    for label, names in choices.items():
        quiet = [run.with_errors(seed).statistic(names) for seed, run in enumerate(runs)]
        curves[label] = [
            (float(rate), delay_at(level_of(quiet, rate * hours), moved[label]))
            for rate in RATES
            if rate * hours >= 1
        ]
        words = ", ".join(f"{delay:.0f} s at {rate:g}/h" for rate, delay in curves[label])
        print(f"  {motion}, {size_deg:g} deg by {label}: {words}", flush=True)
    best = [min(curves[name][k][1] for name in CUES) for k in range(len(curves[FUSED]))]
    worst = max(delay / least for (_, delay), least in zip(curves[FUSED], best, strict=True))
    print(f"  {motion}: delay by all together over that of the best cue, at worst {worst:.2f}", flush=True)
    return curves


def level_of(quiet: list[np.ndarray], alarms: float) -> float:
    """The level that the statistics of quiet watches cross upwards so many times."""
    levels = np.unique(np.concatenate(quiet))
    for level in levels:
        crossings = sum(int(((v[1:] > level) & (v[:-1] <= level)).sum()) + int(v[0] > level) for v in quiet)
        if crossings <= alarms and level >= np.median(levels):
            return float(level)
    return float(levels[-1])


def delay_at(level: float, moved: list[np.ndarray]) -> float:
    """Mean seconds to the first value above a level; three minutes where there is none."""
    delays = []
    for values in moved:
        over = np.flatnonzero(values > level)
        delays.append((over[0] + 0.5) * BLOCK_S if len(over) else AFTER * BLOCK_S)
    return float(np.mean(delays))


WIDTH, HEIGHT, LEFT, TOP = 250, 190, 40, 24  # of a panel


def _to_x(first: float, rate: float) -> float:
    return float(first + (np.log10(rate) - 0.3) / 1.6 * (WIDTH - LEFT))


def _to_y(delay: float) -> float:
    return TOP + (1 - delay / 190) * (HEIGHT - TOP - 30)


def draw_roc(curves: Mapping[str, Mapping[str, list[tuple[float, float]]]], path: Path) -> None:
    """One small panel per motion: delay over false alarms per hour, a line per cue."""
    colours = dict(zip([*CUES, FUSED], ("#c2410c", "#0f766e", "#7c3aed", "#111827"), strict=True))
    parts = []
    for k, (motion, by_cue) in enumerate(curves.items()):
        x0 = k * (WIDTH + 20) + LEFT
        parts.append(f'<text x="{x0}" y="14" font-weight="bold">{motion}</text>')
        for delay in (0, 60, 120, 180):
            y = _to_y(delay)
            parts.append(f'<path d="M{x0} {y:.1f}H{x0 + WIDTH - LEFT}" stroke="#d1d5db"/>')
            parts.append(f'<text x="{x0 - 5}" y="{y + 4:.1f}" text-anchor="end">{delay}</text>')
        for rate in (3, 10, 30):
            x = _to_x(x0, rate)
            parts.append(f'<text x="{x:.1f}" y="{HEIGHT - 14}" text-anchor="middle">{rate}</text>')
        for label, curve in by_cue.items():
            points = " ".join(f"{_to_x(x0, rate):.1f},{_to_y(delay):.1f}" for rate, delay in curve)
            width = 2.5 if label == FUSED else 1.5
            parts.append(
                f'<polyline points="{points}" fill="none" stroke="{colours[label]}" stroke-width="{width}"/>'
            )
    for k, (label, colour) in enumerate(colours.items()):
        parts.append(f'<text x="{LEFT + 110 * k}" y="{HEIGHT + 12}" fill="{colour}">{label}</text>')
    total = max(len(curves), 2) * (WIDTH + 20) + 10
    path.write_text(
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {total} {HEIGHT + 20}" font-family="sans-serif" '
        f'font-size="11" role="img" aria-label="Delay in seconds over false alarms per hour, by cue">'
        f'<rect width="100%" height="100%" fill="#ffffff"/>{"".join(parts)}</svg>\n',
        encoding="utf-8",
    )
