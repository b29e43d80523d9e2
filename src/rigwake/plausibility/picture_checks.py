"""Pictures that are no new pictures, as the tracker counted them."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from rigwake.plausibility.values import SensorCheck
from rigwake.tracks import Tracks

_MOST_REPEATED = 0.02  # of the frames


def check_pictures(tracks: Mapping[str, Tracks]) -> tuple[SensorCheck, ...]:
    """Cameras whose pictures repeat an earlier one to the last bit; such pictures were never tracked.

    Where they begin is where the longest time passes between frames that were used.
    """
    checks = []
    for name, seen in tracks.items():
        report = seen.report
        if report is None or report.frames_repeated <= max(2.0, _MOST_REPEATED * report.frames):
            continue
        used = np.unique(seen.timestamps_ns[seen.frame_indices])
        at = ""
        if len(used) > 1:
            k = int(np.argmax(np.diff(used)))
            at = f", the longest from {(used[k] - used[0]) * 1e-9:.1f} s to {(used[k + 1] - used[0]) * 1e-9:.1f} s"
        count = f"{report.frames_repeated} of {report.frames} pictures"
        words = f"{count} repeat an earlier one (frozen, or shown again){at}; left out."
        fraction = report.frames_repeated / max(report.frames, 1)
        check = SensorCheck(
            f"camera {name}",
            False,
            fraction,
            _MOST_REPEATED,
            words,
            "Check its cable and driver.",
            "repeated pictures",
        )
        checks.append(check.with_action("repaired"))
    return tuple(checks)
