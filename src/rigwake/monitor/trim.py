"""Did the boat's trim or list change? The mean vertical on the rig over time."""

from __future__ import annotations

import numpy as np

from rigwake.monitor.score import BlockScores

_TRIM_BLOCKS, _TRIM_LEAST_DEG, _TRIM_STDS = 6, 0.3, 6.0


def trim_change(scores: BlockScores) -> tuple[int, float] | None:
    """Block and degrees of the largest lasting change of the mean vertical on the rig; None if there is none."""
    seen = np.flatnonzero(np.linalg.norm(scores.gravity, axis=1) > 0.5)
    if len(seen) < 2 * _TRIM_BLOCKS:
        return None
    up = scores.gravity[seen]
    best: tuple[float, int, float] | None = None
    for at in range(_TRIM_BLOCKS, len(up) - _TRIM_BLOCKS + 1):
        before, after = up[:at], up[at:]
        change = after.mean(axis=0) - before.mean(axis=0)
        spread = np.sqrt((before.var(axis=0).sum() / len(before)) + (after.var(axis=0).sum() / len(after)))
        score = float(np.linalg.norm(change)) / max(float(spread), np.deg2rad(0.02))
        if best is None or score > best[0]:
            best = score, int(seen[at]), float(np.rad2deg(np.linalg.norm(change)))
    if best is None or best[0] < _TRIM_STDS or best[2] < _TRIM_LEAST_DEG:
        return None
    return best[1], best[2]
