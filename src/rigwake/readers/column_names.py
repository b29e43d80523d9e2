"""What the name of a column says: which quantity of a pose it holds, in which unit.

`p_RS_R_x [m]`, `field.pose.pose.position.x`, `/odom/pose/orientation/w`, `q[0]`, `tx`, `#timestamp(s)`.
"""

from __future__ import annotations

import re
from collections.abc import Sequence

from rigwake.readers.stamp_units import UNIT_OF_WORD

_POSITION = {
    "p",
    "t",
    "pos",
    "position",
    "positions",
    "translation",
    "trans",
    "location",
    "loc",
    "tr",
    "pose",
}
_ROTATION = {"q", "quat", "quaternion", "orientation", "rot", "rotation", "att", "attitude", "ori"}
_OTHER = (
    {"v", "vel", "velocity", "twist", "linear", "angular", "bias", "b", "bg", "ba", "bw", "cov", "covariance"}
    | {"std", "sigma", "sd", "err", "error", "acc", "accel", "acceleration", "gyro", "omega", "alpha"}
    | {"variance", "var", "gravity", "mag"}
)
_AXES = {"x": "x", "y": "y", "z": "z", "w": "w"}
_IMAGINARY = {"i": "x", "j": "y", "k": "z", "real": "w", "re": "w", "scalar": "w"}
_INDEXED = {"position": {"0": "x", "1": "y", "2": "z"}, "rotation": {"0": "w", "1": "x", "2": "y", "3": "z"}}
_TIMES = {"t", "time", "timestamp", "timestamps", "stamp", "secs", "sec", "seconds", "times", "datetime"}
_TIME_PREFIXES = {
    *_TIMES,
    "header",
    "ros",
    "rosbag",
    "field",
    "unix",
    "epoch",
    "elapsed",
    "relative",
    "utc",
    "gps",
}
_FUSED = re.compile(r"(p|t|q|pos|quat|position|orientation|rot)([xyzw])")
METRES_PER_UNIT = {"m": 1.0, "mm": 1e-3, "cm": 1e-2, "km": 1e3, "ft": 0.3048}


def name_and_unit(cell: str) -> tuple[str, str]:
    """A name in lower case without its unit, and the unit in brackets or parentheses (digits are no unit)."""
    text = cell.strip().lstrip("#%").strip().lower()
    found = re.fullmatch(r"(.*?)\s*[\[(]\s*([^\])]*?)\s*[\])]\s*", text)
    if found is None or found[2].isdigit():
        return text, ""
    return found[1].strip(), found[2]


def metres_per_unit(cell: str) -> float:
    """What one unit of a position column is in metres, as its name says: 0.001 for `x [mm]` or `x_mm`."""
    name, unit = name_and_unit(cell)
    return METRES_PER_UNIT.get(unit or name.rpartition("_")[2], 1.0)


def quantity_of(cell: str) -> str:
    """What a column holds: `t`, `t_s`..`t_ns`, `sec`, `nsec`, `x`.., `qw`.., `r00`.., `roll`.., or nothing."""
    name, unit = name_and_unit(cell)
    matrix = re.fullmatch(r"(?:r|rot|m|t)_?\[?([0-3])[\]_,\[]*([0-3])\]?", name)
    if matrix is not None:
        return f"r{matrix[1]}{matrix[2]}"
    tokens = [token for token in re.split(r"[^a-z0-9µμ]+", name) if token]
    if not tokens:
        return ""
    if tokens[-1] in METRES_PER_UNIT and len(tokens) > 1:  # x_m
        tokens = tokens[:-1]
    time = _time_of(tokens, unit)
    if time:
        return time
    angle_unit = "deg" if "deg" in (unit, *tokens) or unit in ("°", "degrees") else ""
    angle_unit = "rad" if "rad" in (unit, *tokens) or unit == "radians" else angle_unit
    angle = next((token for token in tokens if token in ("roll", "pitch", "yaw")), "")
    if angle and not set(tokens) & _OTHER:
        return f"{angle}_{angle_unit}" if angle_unit else angle
    return _axis_of(tokens)


def _time_of(tokens: Sequence[str], unit: str) -> str:
    last = tokens[-1]
    if last in ("secs", "sec") and len(tokens) > 1 and "stamp" in tokens[:-1]:
        return "sec"
    if last in ("nsecs", "nsec", "nanosec", "nanosecs") and (len(tokens) == 1 or "stamp" in tokens[:-1]):
        return "nsec"
    named = UNIT_OF_WORD.get(unit, "")
    if len(tokens) > 1 and tokens[-2] in _TIMES and last in UNIT_OF_WORD:
        return f"t_{UNIT_OF_WORD[last]}"
    if (last in _TIMES or last.endswith("timestamp")) and (len(tokens) == 1 or tokens[-2] in _TIME_PREFIXES):
        return f"t_{named}" if named else "t"
    return ""


def _axis_of(tokens: Sequence[str]) -> str:
    last = tokens[-1]
    before = list(tokens[:-1])
    fused = _FUSED.fullmatch(last)
    if fused is not None:
        before, last = [*before, fused[1]], fused[2]
    if re.fullmatch(r"q[0-3]", last) and not before:
        before, last = ["q"], last[1]
    kinds = {**dict.fromkeys(_POSITION, "position"), **dict.fromkeys(_ROTATION, "rotation")}
    kinds |= dict.fromkeys(_OTHER, "other")
    kind = next((kinds[token] for token in reversed(before) if token in kinds), "")
    if not kind and not before:
        kind = "rotation" if last == "w" else "position"
    axis = _AXES.get(last) or _INDEXED.get(kind, {}).get(last, "")
    if kind == "rotation":
        axis = axis or _IMAGINARY.get(last, "")
    if not axis or kind in ("other", "") or (kind == "position" and axis == "w"):
        return ""
    return f"q{axis}" if kind == "rotation" else axis
