"""Trajectory files: TUM, which every tool reads, with covariances in a file beside it."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from rigwake.atomic import write_text_atomic
from rigwake.trajectory import Trajectory


def write_tum(trajectory: Trajectory, path: Path | str) -> None:
    """Write `t x y z qx qy qz qw` rows (seconds with nine decimals: stamps survive exactly).

    Segments and covariances, if any, go to `NAME.cov.csv` beside it: `stamp_ns, segment` and the 21 entries
    of the upper triangle, right tangent `[rotation, translation]`.
    """
    path = Path(path)
    poses = trajectory.world_from_body
    lines = [
        "# world_from_body: t_s x y z qx qy qz qw, written by rigwake",
        f"# is_metric: {str(trajectory.is_metric).lower()}",
    ]
    values = np.concatenate([poses.translation, np.roll(poses.quat_wxyz, -1, axis=1)], axis=1)
    for stamp, row in zip(trajectory.timestamps_ns.tolist(), values.tolist(), strict=True):
        sign, magnitude = ("-", -stamp) if stamp < 0 else ("", stamp)
        seconds = f"{sign}{magnitude // 10**9}.{magnitude % 10**9:09d}"
        lines.append(seconds + " " + " ".join(f"{value:.12g}" for value in row))
    write_text_atomic(path, "\n".join(lines) + "\n")
    sidecar = path.with_suffix(".cov.csv")
    segments = trajectory.segment_ids
    assert segments is not None
    if trajectory.covariances is None and not segments.any():
        sidecar.unlink(missing_ok=True)
        return
    _write_sidecar(trajectory, sidecar)


def _write_sidecar(trajectory: Trajectory, sidecar: Path) -> None:
    segments = trajectory.segment_ids
    assert segments is not None
    cells = [
        [str(stamp), str(segment)]
        for stamp, segment in zip(trajectory.timestamps_ns.tolist(), segments.tolist(), strict=True)
    ]
    lines = ["# stamp_ns, segment"]
    if trajectory.covariances is not None:
        upper = np.triu_indices(6)
        for row, values in zip(cells, trajectory.covariances[:, upper[0], upper[1]].tolist(), strict=True):
            row.extend(f"{value:.9g}" for value in values)
        lines = [
            f"# covariances of {trajectory.covariance_kind}, right tangent [rotation, translation]",
            "# stamp_ns, segment, upper triangle row by row",
        ]
    write_text_atomic(sidecar, "\n".join([*lines, *(",".join(row) for row in cells)]) + "\n")
