"""Cues of a recording, each with scores of its own, and all of them together."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from rigwake._types import Array
from rigwake.monitor.block_motion import BlockMotion
from rigwake.monitor.change_detection import BlockStatistics, glr
from rigwake.monitor.cross_views import score_cross_views
from rigwake.monitor.innovations import (
    ROTATION,
    Belief,
    discount_wrong_motion,
    innovations,
    spreads,
    with_offsets,
)
from rigwake.monitor.rig_motion import RigMotion
from rigwake.monitor.score import BLOCK_S, BlockScores, join_blocks
from rigwake.monitor.thresholds import Thresholds
from rigwake.rig import Rig
from rigwake.tracks import CrossViews

CUES = ("ego-motion", "overlap", "landmarks")
HORIZON = "horizon"  # from pictures alone, beside those
_SUSPECT_BLOCKS = 3
_LARGEST_TURN_DEG = 3.0
_LIVELY_RATE = np.deg2rad(15.0)  # rad/s


@dataclass(frozen=True, eq=False)
class CueSeries:
    """What one cue says for itself. value: (B, C) its likelihood ratio by block and camera; std_deg: (B, C, 3) how well
    it sees a step about the rig's axes, infinite where not. words: one line."""

    name: str
    value: Array
    std_deg: Array
    words: str


def score_cues(
    scores: BlockScores,
    motions: Sequence[BlockMotion | None],
    views: CrossViews,
    rig: Rig,
    motion: RigMotion,
) -> dict[str, BlockScores]:
    """Scores of every block by each of `CUES`.

    scores, motions: of `score_blocks_with_motion`. views: what two cameras saw.
    """
    first = views.rig_times_ns({name: camera.time_offset_s for name, camera in rig.cameras.items()})[0]
    parts: dict[str, list[BlockScores]] = {name: [] for name in CUES[1:]}
    for k, (start, found) in enumerate(zip(scores.starts_ns.tolist(), motions, strict=True)):
        own = views.take(np.flatnonzero((first >= start) & (first < start + round(BLOCK_S * 1e9))))
        pair = score_cross_views(own, rig, motion, found, scores.take(slice(k, k + 1)))
        for name, part in zip(CUES[1:], pair, strict=True):
            parts[name].append(part)
    return {CUES[0]: scores} | {name: join_blocks(p) if p else scores for name, p in parts.items()}


def weighted(scores: BlockScores, spread: Array) -> BlockScores:
    """Scores whose covariance is about their `H`: over what rotations scatter within and between blocks up to each.

    spread: of `spreads`.

    One number for each block: with one for each camera, `H x = g` of a change x would not hold any more.
    """
    wide = np.maximum((scores.inflation * spread[:, :, ROTATION]).mean(axis=1), 1.0)
    return replace(
        scores,
        H=scores.H / wide[:, None, None],
        g=scores.g / wide[:, None],
        inflation=scores.inflation / scores.inflation.mean(axis=1, keepdims=True),
        sectors=scores.sectors / wide[:, None, None, None, None],
    )


def weighted_cues(cues: Mapping[str, BlockScores]) -> dict[str, BlockScores]:
    """Every cue as it counts among the others: weighted, of the same columns, and landmarks only in turns.

    On straight and gentle courses over open water an error of the velocity, or of the gyro's bias, moves all ranges and
    with them every landmark alike, block after block; turns average it.
    """
    lively = cues[CUES[0]].turning >= _LIVELY_RATE
    size = max(scores.H.shape[1] for scores in cues.values())
    own = {}
    for name, scores in cues.items():
        counts = lively if name == "landmarks" else np.ones_like(lively)
        scores = replace(
            scores,
            H=scores.H * counts[:, None, None],
            g=scores.g * counts[:, None],
            rows=scores.rows * counts[:, None],
        )
        more = size - scores.H.shape[1]
        # the horizon's covariance is its scatter from block to block already
        spread = np.ones((*scores.rows.shape, 3)) if name == HORIZON else spreads(scores)
        scores = weighted(discount_wrong_motion(scores) if name == CUES[0] else scores, spread)
        own[name] = replace(
            scores,
            H=np.pad(scores.H, ((0, 0), (0, more), (0, more))),
            g=np.pad(scores.g, ((0, 0), (0, more))),
        )
    return own


def fuse(cues: Mapping[str, BlockScores]) -> BlockScores:
    """Scores of all cues together, each by its weight; conditions are those of the first."""
    return joint(list(weighted_cues(cues).values()))


def joint(cues: Sequence[BlockScores]) -> BlockScores:
    """The sum of weighted scores; conditions are those of the first."""
    return replace(
        cues[0],
        H=np.sum([scores.H for scores in cues], axis=0),
        g=np.sum([scores.g for scores in cues], axis=0),
        rows=np.sum([scores.rows for scores in cues], axis=0),
    )


def cue_series(
    cues: Mapping[str, BlockScores], belief: Belief, thresholds: Thresholds
) -> dict[str, CueSeries]:
    """Each cue's own statistic. cues: of `score_cues`."""
    series = {}
    for name, scores in weighted_cues(cues).items():
        found = innovations(scores, with_offsets(belief, scores.H.shape[1], thresholds), thresholds)
        statistics = glr(found, thresholds)
        words = _words(name, scores, statistics, thresholds)
        series[name] = CueSeries(name, statistics.value, statistics.std_deg, words)
    return series


def horizon_suspects(series: CueSeries, scores: BlockScores, thresholds: Thresholds) -> dict[str, str]:
    """Cameras whose horizon has long been far elsewhere than that of the others, and words on each.

    For cameras of which the motion tells nothing. A shore that comes into view looks the same: this is no blame.
    """
    recent = series.value[-_SUSPECT_BLOCKS:]
    if len(recent) < _SUSPECT_BLOCKS:
        return {}
    least = recent.min(axis=0)
    apart = (least >= thresholds.alone) & (least >= least.max() / 2)
    words = (
        f"its horizon moved against that of the others for {_SUSPECT_BLOCKS * BLOCK_S:.0f} s and more: "
        "it turned, or a shore came into view; what helps: sailing at 1 m/s or more, with turns"
    )
    return {scores.cameras[c]: words for c in np.flatnonzero(apart).tolist()}


def _words(name: str, scores: BlockScores, statistics: BlockStatistics, thresholds: Thresholds) -> str:
    if not scores.rows.any():
        return f"{name}: saw nothing"
    block, camera = np.unravel_index(int(statistics.value.argmax()), statistics.value.shape)
    at = f"after {(int(block) + 1) * BLOCK_S / 60:.1f} min"
    largest = f"largest {statistics.value[block, camera]:.0f} of {thresholds.alarm:g} ({scores.cameras[camera]}, {at})"
    seen = np.sort(statistics.std_deg[-1], axis=None)
    seen = seen[np.isfinite(seen)]
    # before a cue knows its offsets, it sees nothing
    sees = len(seen) > 0 and 5 * seen[0] < _LARGEST_TURN_DEG
    to = f"; sees turns of {5 * seen[0]:.2f} deg and more" if sees else ""
    return f"{name}: {largest}{to}"
