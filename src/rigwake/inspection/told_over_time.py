"""What each stretch of a recording tells about the rig, for the page of `inspect`."""

from __future__ import annotations

from dataclasses import dataclass

from rigwake._types import Array, Mask, Stamps


@dataclass(frozen=True, eq=False)
class ToldOverTime:
    """starts_ns, lengths_s: (S,) of stretches. told: (S,) what each tells of the rig, as a fraction of the whole.
    chosen: (S,) whether `calibrate` would use it. words: which those are, and why."""

    starts_ns: Stamps
    lengths_s: Array
    told: Array
    chosen: Mask
    words: str
