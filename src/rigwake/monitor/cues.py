"""Cues of a recording, each with scores of its own, and all of them together."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from rigwake.monitor.block_motion import BlockMotion
from rigwake.monitor.cross_views import score_cross_views
from rigwake.monitor.innovations import PARTS, spreads
from rigwake.monitor.pair_kernels import MOUNTING
from rigwake.monitor.rig_motion import RigMotion
from rigwake.monitor.score import BLOCK_S, BlockScores, join_blocks
from rigwake.rig import Rig
from rigwake.tracks import CrossViews

CUES = ("ego-motion", "overlap", "landmarks")
_LIVELY_RATE = np.deg2rad(15.0)  # rad/s


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


def weighted(scores: BlockScores) -> BlockScores:
    """Scores whose covariance is their `H`: over what they scatter within and between blocks up to each."""
    wide = np.repeat(scores.inflation, MOUNTING, axis=1)
    spread = spreads(scores)
    for part in PARTS:
        for c in range(len(scores.cameras)):
            wide[:, scores.columns(c, part)] *= spread[:, c, part, None]
    root = np.sqrt(wide)
    return replace(
        scores,
        H=scores.H / (root[:, :, None] * root[:, None, :]),
        g=scores.g / wide,
        inflation=np.ones_like(scores.inflation),
        sectors=scores.sectors / scores.inflation[:, :, None, None, None],
    )


def weighted_cues(cues: Mapping[str, BlockScores]) -> dict[str, BlockScores]:
    """Every cue as it counts among the others: weighted, and landmarks only in turns.

    On straight and gentle courses over open water an error of the velocity, or of the gyro's bias, moves all ranges and
    with them every landmark alike, block after block; turns average it.
    """
    lively = cues[CUES[0]].turning >= _LIVELY_RATE
    own = dict(cues)
    if "landmarks" in own:
        marks = own["landmarks"]
        own["landmarks"] = replace(
            marks,
            H=marks.H * lively[:, None, None],
            g=marks.g * lively[:, None],
            rows=marks.rows * lively[:, None],
        )
    return {name: weighted(scores) for name, scores in own.items()}


def fuse(cues: Mapping[str, BlockScores]) -> BlockScores:
    """Scores of all cues together, each by its weight; conditions are those of the first."""
    own = list(weighted_cues(cues).values())
    return replace(
        own[0],
        H=np.sum([scores.H for scores in own], axis=0),
        g=np.sum([scores.g for scores in own], axis=0),
        rows=np.sum([scores.rows for scores in own], axis=0),
    )
