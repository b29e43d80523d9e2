"""Frozen values of a calibration. What the motion did not determine is NaN here and `null` in the file."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rigwake._types import Array
from rigwake.calibration.describe_calibration import as_html, as_text
from rigwake.cameras.protocol import CameraModel
from rigwake.errors import InputError, UsageError
from rigwake.geometry.se3 import SE3, covariance_in_axes_of_a
from rigwake.rig import Rig, RigCamera

AXIS_NAMES = ("rotation x", "rotation y", "rotation z", "translation x", "translation y", "translation z")
_TOUCHES = 0.02  # an axis is unobservable when an unobservable direction has at least this component along it


@dataclass(frozen=True, eq=False)
class UnobservableDirection:
    """A direction in which the camera could be moved without the recording noticing.

    direction: (6,) unit vector `[rotation about, translation along]` the axes of the rig.
    words: the same in the rig's own words ("vertical offset of port").
    remedy: which motion would determine it.
    """

    direction: Array
    words: str
    remedy: str = ""


@dataclass(frozen=True, eq=False)
class KnownOffset:
    """A combination of translation components that is determined although its components are not:
    `direction_rig . translation = value_m`, with its standard deviation."""

    direction_rig: Array
    value_m: float
    std_m: float


@dataclass(frozen=True, eq=False)
class CalibratedCamera:
    """Where one camera (or any other sensor with a trajectory) sits and looks, and how sure that is.

    rig_from_cam: rotation and translation; parts that are unobservable are replaced by NaN on construction.
    covariance: (6, 6) right tangent `[rotation, translation]`, i.e. in the camera's own axes.
    unobservable: directions that the motion did not determine. known_offsets: filled on construction.
    time_offset_s: `t_rig = t_cam + time_offset_s`; None when the clocks were not estimated.
    scale: metres per unit of the camera's own trajectory; None when it was metric.
    statistics: counts and residual figures, for reports. model, topic: as in the recording.
    """

    name: str
    rig_from_cam: SE3
    covariance: Array
    unobservable: tuple[UnobservableDirection, ...] = ()
    time_offset_s: float | None = None
    time_offset_std_s: float | None = None
    scale: float | None = None
    scale_std: float | None = None
    model: CameraModel | None = None
    topic: str = ""
    statistics: Mapping[str, Any] = field(default_factory=dict)
    known_offsets: tuple[KnownOffset, ...] = ()

    def __post_init__(self) -> None:
        covariance = np.asarray(self.covariance, dtype=np.float64)
        if covariance.shape != (6, 6):
            raise InputError(f"{self.name}: the covariance must be 6 x 6, it is {covariance.shape}.")
        object.__setattr__(self, "covariance", covariance)
        observable = self.observable_axes
        if observable.all():
            return
        rotation, translation = self.rig_from_cam.rotation, self.rig_from_cam.translation
        if not self.known_offsets and np.isfinite(rotation).all() and np.isfinite(translation).all():
            object.__setattr__(self, "known_offsets", self._offsets_still_known())
        object.__setattr__(
            self,
            "rig_from_cam",
            SE3(
                rotation if observable[:3].all() else np.full((3, 3), np.nan),
                np.where(observable[3:], translation, np.nan),
            ),
        )

    @property
    def observable_axes(self) -> NDArray[np.bool_]:
        """(6,) which of rotation x, y, z and translation x, y, z (axes of the rig) are determined."""
        directions = np.array([d.direction for d in self.unobservable]).reshape(-1, 6)
        return ~np.any(np.abs(directions) > _TOUCHES, axis=0)

    @property
    def is_observable(self) -> bool:
        """Whether every axis is determined."""
        return bool(self.observable_axes.all())

    @property
    def has_figures(self) -> bool:
        """Whether anything of it stands in files and tables as a number: the whole rotation, or one offset. (A rotation
        of which only one axis is determined has no number.)"""
        observable = self.observable_axes
        return bool(observable[:3].all() or observable[3:].any())

    @property
    def covariance_rig_axes(self) -> Array:
        """(6, 6) covariance about and along the axes of the rig; NaN where unobservable."""
        if not np.isfinite(self.rig_from_cam.rotation).all():
            return np.full((6, 6), np.nan)
        covariance = covariance_in_axes_of_a(self.rig_from_cam, self.covariance)
        lost = ~self.observable_axes
        covariance[lost, :] = np.nan
        covariance[:, lost] = np.nan
        return covariance

    @property
    def std_rotation_deg(self) -> Array:
        """(3,) standard deviations about the axes of the rig, degrees; NaN where unobservable."""
        return np.asarray(np.rad2deg(np.sqrt(np.diag(self.covariance_rig_axes)[:3])))

    @property
    def std_translation_m(self) -> Array:
        """(3,) standard deviations along the axes of the rig, metres; NaN where unobservable."""
        return np.asarray(np.sqrt(np.diag(self.covariance_rig_axes)[3:]))

    def _offsets_still_known(self) -> tuple[KnownOffset, ...]:
        """Oblique combinations of the lost translation components that the motion does determine."""
        lost = ~self.observable_axes[3:]
        directions = np.array([d.direction[3:] for d in self.unobservable]).reshape(-1, 3)[:, lost]
        if not lost.any() or not directions.size:
            return ()
        _, singular, Vt = np.linalg.svd(directions)
        rank = int((singular > _TOUCHES).sum())
        covariance = covariance_in_axes_of_a(self.rig_from_cam, self.covariance)[3:, 3:]
        known = []
        for row in Vt[rank:]:
            direction = np.zeros(3)
            direction[lost] = row
            variance = float(direction @ covariance @ direction)
            value = float(direction @ self.rig_from_cam.translation)
            if np.isfinite(variance) and variance >= 0:
                known.append(KnownOffset(direction, value, float(np.sqrt(variance))))
        return tuple(known)


@dataclass(frozen=True, eq=False, repr=False)
class Calibration:
    """A calibrated rig.

    reference: the frame called `rig`: `imu`, `base_link`, a camera's or a trajectory's name.
    cameras: by name. joint_covariance: (6n, 6n) right tangent of all cameras in the order of `cameras`.
    antenna_rig, antenna_covariance: GNSS lever arm in the rig frame and its (3, 3) covariance, if estimated.
    checks: split-half repeatability, cross-camera association errors, residual statistics: plain nested values.
    provenance: inputs' hashes, settings, versions: plain nested values, enough to compute it again.
    """

    reference: str
    cameras: Mapping[str, CalibratedCamera]
    joint_covariance: Array | None = None
    antenna_rig: Array | None = None
    antenna_covariance: Array | None = None
    checks: Mapping[str, Any] = field(default_factory=dict)
    provenance: Mapping[str, Any] = field(default_factory=dict)

    def __repr__(self) -> str:
        return as_text(self)

    def _repr_html_(self) -> str:
        """What a notebook shows."""
        return as_html(self)

    def camera(self, name: str) -> CalibratedCamera:
        """The camera of this name; UsageError lists what is there."""
        if name not in self.cameras:
            raise UsageError(
                f"No camera {name!r} in this calibration.", remedy=f"It has: {', '.join(self.cameras)}."
            )
        return self.cameras[name]

    @property
    def is_observable(self) -> bool:
        """Whether every axis of every camera is determined."""
        return all(camera.is_observable for camera in self.cameras.values())

    @property
    def rig(self) -> Rig:
        """The rig alone, without uncertainty; parts that are unobservable stay NaN."""
        cameras = {
            name: RigCamera(name, c.rig_from_cam, c.model, c.time_offset_s or 0.0, c.topic)
            for name, c in self.cameras.items()
        }
        antenna = None if self.antenna_rig is None else tuple(float(x) for x in self.antenna_rig)
        return Rig(self.reference, cameras, antenna)  # type: ignore[arg-type]

    def with_checks(self, **checks: Any) -> Calibration:
        """The same calibration with further checks noted."""
        return replace(self, checks={**self.checks, **checks})
