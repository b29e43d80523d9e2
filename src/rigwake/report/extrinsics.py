"""Where each camera sits, both directions, as people and programs want to read it."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from rigwake._types import Array
from rigwake.calibration import CalibratedCamera, Calibration
from rigwake.geometry.euler import yaw_pitch_roll
from rigwake.geometry.se3 import SE3, covariance_in_axes_of_a

UNOBSERVABLE = "unobservable"


@dataclass(frozen=True)
class Value:
    """A number as text, its standard deviation as text (or empty)."""

    label: str
    text: str
    std: str = ""

    @property
    def is_observable(self) -> bool:
        """Whether there is a number."""
        return self.text != UNOBSERVABLE


@dataclass(frozen=True)
class Direction:
    """One transform `a_from_b` in all the forms of the table; `copies`: label and text of the copy buttons."""

    key: str
    position: tuple[Value, ...]
    angles: tuple[Value, ...]
    quat_wxyz: tuple[Value, ...]
    matrix: tuple[tuple[str, ...], ...]
    copies: tuple[tuple[str, str], ...]


def directions(camera: CalibratedCamera) -> tuple[Direction, Direction]:
    """`rig_from_cam` and `cam_from_rig`."""
    forward = _direction("rig_from_cam", camera.rig_from_cam, _std(camera.covariance_rig_axes))
    backward = camera.rig_from_cam.inverse()
    adjoint = camera.rig_from_cam.adjoint()
    # x^-1 with x * exp(d) is x^-1 * exp(-Ad d): its right tangent is -Ad d
    covariance = covariance_in_axes_of_a(backward, adjoint @ camera.covariance @ adjoint.T)
    return forward, _direction("cam_from_rig", backward, _std(covariance))


def _std(covariance: Array) -> Array:
    diagonal = np.diag(covariance)
    return np.sqrt(np.where(diagonal >= 0, diagonal, np.nan))


def _direction(key: str, a_from_b: SE3, std: Array) -> Direction:
    known = bool(np.isfinite(a_from_b.rotation).all())
    quat = a_from_b.quat_wxyz if known else np.full(4, np.nan)
    angles = np.rad2deg(yaw_pitch_roll(a_from_b.rotation)) if known else np.full(3, np.nan)
    return Direction(
        key,
        tuple(
            Value(axis, number(1e3 * x, 1), plus_minus(1e3 * s, "mm"))
            for axis, x, s in zip("xyz", a_from_b.translation, std[3:], strict=True)
        ),
        tuple(Value(n, number(x, 3)) for n, x in zip(("yaw", "pitch", "roll"), angles, strict=True)),
        tuple(Value(n, number(x, 6)) for n, x in zip("wxyz", quat, strict=True)),
        tuple(tuple(number(x, 6) for x in row) for row in a_from_b.matrix),
        _copies(key, a_from_b, quat),
    )


def _copies(key: str, a_from_b: SE3, quat_wxyz: Array) -> tuple[tuple[str, str], ...]:
    """What the copy buttons hold: full precision; nothing at all if a part is unobservable."""
    matrix = a_from_b.matrix
    if not np.isfinite(matrix).all():
        return ()
    translation, q = a_from_b.translation.tolist(), quat_wxyz.tolist()
    w, x, y, z = q
    return (
        ("matrix", json.dumps(matrix.tolist())),
        ("YAML", f"{key}: {{quat_wxyz: {q}, translation_m: {translation}}}"),
        ("x y z qx qy qz qw", " ".join(repr(v) for v in (*translation, x, y, z, w))),
    )


def number(value: float, digits: int) -> str:
    """Fixed decimals with a true minus sign, or the words for what there is no number for."""
    if not np.isfinite(value):
        return UNOBSERVABLE
    return f"{round(value, digits) + 0.0:.{digits}f}".replace("-", "−")


def decimals(std: float) -> int:
    """How many decimals show two digits of a standard deviation."""
    return max(0, 1 - int(np.floor(np.log10(std)))) if std > 0 else 1


def two_digits(std: float) -> str:
    """A standard deviation with two digits, never as a power of ten: 0.017, 4.0, 52, 130."""
    return f"{std:.{decimals(std)}f}"


def plus_minus(std: float, unit: str) -> str:
    """`± 1.2 mm`, empty where the deviation is not known."""
    return f"± {two_digits(std)} {unit}" if np.isfinite(std) else ""


def looks(camera: CalibratedCamera, reference: str) -> str:
    """In words, where the camera looks in a rig whose x points ahead and z up."""
    rotation = camera.rig_from_cam.rotation
    if not np.isfinite(rotation).all():
        return "looking direction unobservable"
    if reference not in ("imu", "base_link"):
        return ""
    ahead, right = rotation[:, 2], rotation[:, 0]
    azimuth = float(np.rad2deg(np.arctan2(ahead[1], ahead[0])))
    elevation = float(np.rad2deg(np.arcsin(np.clip(ahead[2], -1, 1))))
    words = [
        _turned(azimuth, "left of x", "right of x", "along x"),
        _turned(elevation, "up", "down", "level"),
    ]
    level = np.array([ahead[1], -ahead[0], 0.0])
    if np.linalg.norm(level) > 0.05:  # a camera that looks straight up or down has no horizon
        roll = float(np.rad2deg(np.arctan2(np.cross(level, right) @ ahead, level @ right)))
        words.append("rolled " + _turned(roll, "clockwise", "anticlockwise", ""))
    return ", ".join(word for word in words if word != "rolled ")


def _turned(angle_deg: float, positive: str, negative: str, none: str) -> str:
    if round(abs(angle_deg), 1) == 0:
        return none
    return f"{abs(angle_deg):.1f}° {positive if angle_deg > 0 else negative}"


@dataclass(frozen=True)
class Row:
    """One line of the overview table."""

    camera: CalibratedCamera
    colour: int
    looks: str
    position_mm: tuple[Value, ...]
    std_rotation_deg: str
    time_offset_ms: Value


def overview(calibration: Calibration) -> list[Row]:
    """Every camera in one line."""
    return [
        Row(
            camera,
            index,
            looks(camera, calibration.reference),
            directions(camera)[0].position,
            worst_deg(camera.std_rotation_deg),
            time_offset(camera),
        )
        for index, camera in enumerate(calibration.cameras.values())
    ]


def worst_deg(std_deg: Sequence[float] | Array) -> str:
    """The largest of the standard deviations of rotation."""
    finite = np.asarray(std_deg)[np.isfinite(std_deg)]
    return f"{two_digits(finite.max())}°" if len(finite) else "unknown"


def time_offset(camera: CalibratedCamera) -> Value:
    """Milliseconds; a clock that was not estimated is said to be so."""
    if camera.time_offset_s is None:
        return Value(camera.name, "not estimated")
    std = camera.time_offset_std_s
    if std is None or not np.isfinite(std):
        return Value(camera.name, number(1e3 * camera.time_offset_s, 2))
    return Value(
        camera.name, number(1e3 * camera.time_offset_s, decimals(1e3 * std)), plus_minus(1e3 * std, "ms")
    )
