"""Gyroscope and accelerometer columns of tables by their usual names, in rad/s and m/s^2 whatever the unit."""

from __future__ import annotations

import re
from collections.abc import Sequence

import numpy as np

from rigwake._types import Array
from rigwake.recording import Finding

STANDARD_GRAVITY = 9.80665
_GYRO_WORDS = {"gyro", "gyr", "gyroscope", "w", "omega", "angular", "angvel", "gyros", "rate", "rotation"}
_ACCEL_WORDS = {
    "accel",
    "acc",
    "accelerometer",
    "acceleration",
    "a",
    "alpha",
    "linear",
    "accl",
    "accelerations",
    "f",
}
_OTHER_WORDS = {
    "covariance",
    "cov",
    "bias",
    "b",
    "std",
    "orientation",
    "mag",
    "magnetometer",
    "q",
    "var",
    "sigma",
}
_FUSED = re.compile(r"(g|w|omega|gyro|gyr|gyroscope|a|acc|accel|alpha)([xyz])")
_UNIT_TOKENS = {
    "deg",
    "rad",
    "s",
    "per",
    "sec",
    "dps",
    "m",
    "mps2",
    "ms2",
    "g",
    "mg",
    "s2",
    "rads",
    "degs",
    "radps",
    "ss",
}
_USUAL = {"m/s^2": (6.0, 14.0), "g": (0.6, 1.4), "mg": (600.0, 1400.0)}
_STEADY = 0.1
_FACTORS = {"m/s^2": 1.0, "g": STANDARD_GRAVITY, "mg": STANDARD_GRAVITY / 1000}


def inertial_columns(names: Sequence[str]) -> tuple[tuple[str, ...], tuple[str, ...]] | None:
    """The columns of the gyroscope and of the accelerometer, x y z each; None unless each is there just once."""
    found: dict[tuple[str, str], list[str]] = {}
    for name in names:
        kind = _kind_and_axis(name)
        if kind is not None:
            found.setdefault(kind, []).append(name)
    chosen = []
    for sensor in ("gyro", "accel"):
        columns = [found.get((sensor, axis), []) for axis in "xyz"]
        if any(len(matches) != 1 for matches in columns):
            return None
        chosen.append(tuple(matches[0] for matches in columns))
    return chosen[0], chosen[1]


def _tokens(name: str) -> list[str]:
    spaced = re.sub(r"([a-z])([A-Z])", r"\1_\2", name).lower()
    return [token for token in re.split(r"[^a-z0-9]+", spaced) if token]


def _kind_and_axis(name: str) -> tuple[str, str] | None:
    tokens = _tokens(name)
    while len(tokens) > 1 and tokens[-1] in _UNIT_TOKENS:
        tokens.pop()
    if not tokens or set(tokens) & _OTHER_WORDS:
        return None
    *before, last = tokens
    fused = _FUSED.fullmatch(last)
    if fused is not None:
        return ("gyro" if fused[1] in {"g", *_GYRO_WORDS} else "accel"), fused[2]
    if last not in ("x", "y", "z"):
        return None
    for token in before:
        if token in _GYRO_WORDS or token in _ACCEL_WORDS:
            return ("gyro" if token in _GYRO_WORDS else "accel"), last
    return None


def unit_words(name: str, unit: str) -> str:
    """The unit of a column: in brackets, else what follows the axis in its name (`gyro_x_deg_s`)."""
    if unit:
        return unit.lower()
    tokens = _tokens(name)
    axis = next((at for at in range(len(tokens) - 1, -1, -1) if tokens[at][-1:] in "xyz"), len(tokens))
    return "_".join(token for token in tokens[axis + 1 :] if token in _UNIT_TOKENS)


def gyro_in_si(gyro: Array, unit: str, name: str) -> tuple[Array, list[Finding]]:
    """Angular rates in rad/s; a note where they were converted, a warning where the unit is not known."""
    word = unit.replace(" ", "")
    if not word or word.startswith(("rad", "1/s", "s^-1", "s-1")):
        return gyro, []
    if word.startswith(("deg", "°", "dps", "\ufffd")) or "°" in word:
        return np.radians(gyro), [Finding("note", name, f"gyroscope in {unit}: converted to rad/s.")]
    if word.startswith(("mrad", "mdeg", "mdps")):
        factor = 1e-3 if word.startswith("mrad") else np.pi / 180e3
        return factor * gyro, [Finding("note", name, f"gyroscope in {unit}: converted to rad/s.")]
    return gyro, [
        Finding("warning", name, f"the unit {unit!r} of the gyroscope is not known: taken for rad/s.")
    ]


def accel_in_si(accel: Array, unit: str, name: str) -> tuple[Array, list[Finding]]:
    """Specific forces in m/s^2 by the unit of the header; where that is silent or cannot be, by the size of gravity."""
    word = unit.replace(" ", "")
    stated = (
        "g" if word in ("g", "gs", "g0") else "mg" if word in ("mg", "milli-g") else "m/s^2" if word else ""
    )
    finite = accel[np.isfinite(accel).all(axis=1)]
    sizes = np.linalg.norm(finite, axis=1)
    size = float(np.median(sizes)) if len(sizes) else 0.0
    by_size = next((known for known, (low, high) in _USUAL.items() if low < size < high), "")
    if len(sizes) and float(np.median(np.abs(sizes - size))) > _STEADY * size:
        by_size = ""  # not gravity: it would be steady
    chosen = by_size or stated or "m/s^2"
    converted = _FACTORS[chosen] * accel
    if chosen == "m/s^2" and stated in ("", chosen):
        if by_size or not len(finite):
            return converted, []
        message = f"accelerations of {size:.3g} are no gravity in m/s^2, g or mg: taken for m/s^2."
        return converted, [Finding("warning", name, message)]
    if stated and chosen != stated:
        message = f"the header says {unit}, but accelerations of {size:.3g} are {chosen}: taken so."
        return converted, [Finding("warning", name, message, is_guess=True)]
    said = "the header says so" if stated else f"their size, {size:.3g}, is that of gravity"
    severity = "note" if stated else "warning"
    message = f"accelerations in {chosen} ({said}): converted to m/s^2."
    return converted, [Finding(severity, name, message, is_guess=not stated)]


def headerless_columns(numbers: Array) -> tuple[tuple[int, ...], tuple[int, ...]] | None:
    """Gyroscope and accelerometer of rows (N, 7) `t, a, b` without a header: gravity tells which is which."""
    sizes = [float(np.median(np.linalg.norm(numbers[:, at : at + 3], axis=1))) for at in (1, 4)]
    is_gravity = [any(low < size < high for low, high in _USUAL.values()) for size in sizes]
    if is_gravity == [False, True]:
        return (1, 2, 3), (4, 5, 6)
    if is_gravity == [True, False]:
        return (4, 5, 6), (1, 2, 3)
    return None
