"""Cues of a recording, each with scores of its own, and all of them together."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from rigwake._types import Indices
from rigwake.monitor.cross_views import score_cross_views
from rigwake.monitor.innovations import PARTS, spreads
from rigwake.monitor.pair_kernels import MOUNTING
from rigwake.monitor.rig_motion import RigMotion
from rigwake.monitor.score import BLOCK_S, BlockScores, GyroBias, join_blocks, score_blocks_with_motion
from rigwake.rig import Rig
from rigwake.tracks import CrossViews, Tracks

CUES = ("ego-motion", "overlap", "landmarks")


def score_cues(
    tracks: Mapping[str, Tracks],
    views: CrossViews,
    rig: Rig,
    motion: RigMotion,
    *,
    starts_ns: Indices | None = None,
    bias: GyroBias | None = None,
) -> dict[str, BlockScores]:
    """Scores of every block by each of `CUES`. Arguments as of `score_blocks`; views: what two cameras saw."""
    scores, motions = score_blocks_with_motion(tracks, rig, motion, starts_ns=starts_ns, bias=bias)
    offsets = np.array([round(rig.camera(name).time_offset_s * 1e9) for name in views.cameras])
    first = views.first_ns + offsets[views.source]
    parts: dict[str, list[BlockScores]] = {name: [] for name in CUES[1:]}
    for k, (start, found) in enumerate(zip(scores.starts_ns.tolist(), motions, strict=True)):
        own = views.take(np.flatnonzero((first >= start) & (first < start + round(BLOCK_S * 1e9))))
        pair = score_cross_views(own, rig, motion, found, scores.take(slice(k, k + 1)))
        for name, part in zip(CUES[1:], pair, strict=True):
            parts[name].append(part)
    return {CUES[0]: scores} | {name: join_blocks(p) if p else scores for name, p in parts.items()}


def fuse(cues: Sequence[BlockScores]) -> BlockScores:
    """Scores of all cues together, each weighted by how much it scatters within and between blocks so far."""
    first = cues[0]
    if len(cues) == 1:
        return first
    H, g = np.zeros_like(first.H), np.zeros_like(first.g)
    for scores in cues:
        wide = np.repeat(scores.inflation, MOUNTING, axis=1)
        spread = spreads(scores)
        for part in PARTS:
            for c in range(len(scores.cameras)):
                wide[:, scores.columns(c, part)] *= spread[:, c, part, None]
        root = np.sqrt(wide)
        H += scores.H / (root[:, :, None] * root[:, None, :])
        g += scores.g / wide
    rows = np.sum([scores.rows for scores in cues], axis=0)
    return replace(first, H=H, g=g, rows=rows, inflation=np.ones_like(first.inflation))
