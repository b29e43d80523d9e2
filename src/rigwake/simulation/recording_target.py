"""Where a simulated recording may be written; imported before anything that computes."""

from __future__ import annotations

import os
from pathlib import Path

from rigwake.errors import UsageError

_SUFFIXES = (".bag", ".mcap", "")  # others are more likely a slip than the name of a folder


def require_recording_target(output: Path | None) -> Path:
    """Raises UsageError for a recording that could not be written after it was rendered."""
    if output is None:
        raise UsageError("Where to? -o names the recording.", remedy="For example: -o harbour.bag")
    if os.path.lexists(output):
        raise UsageError(f"{output} is already there.", remedy="Remove it, or choose another name.")
    if output.suffix not in _SUFFIXES:
        raise UsageError(
            f"-o {output}: no recording has the suffix {output.suffix}.",
            remedy=f"-o {output.stem}.bag (ROS 1), {output.stem}.mcap (ROS 2), or {output.stem} (a folder).",
        )
    return output
