"""Errors of a calibration against a known rig, and the difference between two calibrations."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Any, Literal

import numpy as np

from rigwake._types import Array
from rigwake.calibration import CalibratedCamera, Calibration
from rigwake.cameras.protocol import CameraModel
from rigwake.errors import InputError
from rigwake.geometry import so3
from rigwake.geometry.se3 import SE3
from rigwake.rig import Rig

Gauge = Literal["reference", "align"]


@dataclass(frozen=True, eq=False)
class CameraDeviation:
    """Error of one camera; NaN and None where the calibration does not determine it.

    rotation_error_deg: angle of the rotation error. translation_error_m: (3,) along the axes of the rig.
    nees: squared error in units of the calibration's own covariance, over `nees_dof` determined axes.
    """

    name: str
    rotation_error_deg: float
    translation_error_m: Array
    nees: float | None
    nees_dof: int
    time_offset_error_s: float | None

    @property
    def translation_error_norm_m(self) -> float:
        """Length of the translation error."""
        return float(np.linalg.norm(self.translation_error_m))


@dataclass(frozen=True, eq=False)
class PairError:
    """Error of one camera as seen from another: independent of the reference frame."""

    first: str
    second: str
    rotation_error_deg: float
    translation_error_m: float


@dataclass(frozen=True, eq=False)
class RigErrors:
    """Errors of all cameras and of all pairs of cameras."""

    gauge: Gauge
    cameras: dict[str, CameraDeviation]
    pairs: tuple[PairError, ...]

    def to_json(self) -> dict[str, Any]:
        """Plain values for `--json`; null for what is unobservable."""
        return {
            "gauge": self.gauge,
            "cameras": {
                name: {
                    "rotation_error_deg": _number(e.rotation_error_deg),
                    "translation_error_m": [_number(x) for x in e.translation_error_m],
                    "translation_error_norm_m": _number(e.translation_error_norm_m),
                    "nees": e.nees,
                    "nees_dof": e.nees_dof,
                    "time_offset_error_s": e.time_offset_error_s,
                }
                for name, e in self.cameras.items()
            },
            "pairs": [
                {
                    "cameras": [p.first, p.second],
                    "rotation_error_deg": _number(p.rotation_error_deg),
                    "translation_error_m": _number(p.translation_error_m),
                }
                for p in self.pairs
            ],
        }


def evaluate_calibration(calibration: Calibration, truth: Rig, *, gauge: Gauge = "reference") -> RigErrors:
    """Errors of the cameras that both know; `truth` must be given in the calibration's reference frame.

    gauge `reference`: as they stand. `align`: after the rigid motion of the whole rig that fits the cameras best,
    for rigs whose reference frame is of no interest; the covariance does not apply then, so there is no NEES.
    Raises InputError when there is no camera in common.
    """
    names = [name for name in calibration.cameras if name in truth.cameras]
    if not names:
        raise InputError(
            f"The calibration ({', '.join(calibration.cameras)}) and the truth ({', '.join(truth.cameras)}) "
            "have no camera in common.",
        )
    true = {name: truth.cameras[name].rig_from_cam for name in names}
    found = {name: calibration.cameras[name].rig_from_cam for name in names}
    if gauge == "align":
        true_from_found = _best_alignment(list(true.values()), list(found.values()))
        found = {name: true_from_found * x for name, x in found.items()}
    cameras = {
        name: _camera_error(
            calibration.cameras[name], found[name], true[name], truth.cameras[name].time_offset_s, gauge
        )
        for name in names
    }
    pairs = tuple(
        _pair_error(a, b, found[a].inverse() * found[b], true[a].inverse() * true[b])
        for a, b in combinations(names, 2)
    )
    return RigErrors(gauge, cameras, pairs)


def _error_in_rig_axes(found: SE3, true: SE3) -> Array:
    """(6,) `[log(R_found R_true^T), t_found - t_true]`, NaN where unobservable."""
    difference = found.translation - true.translation
    if not np.isfinite(found.rotation).all():
        return np.concatenate([np.full(3, np.nan), difference])
    return np.concatenate([so3.log(found.rotation @ true.rotation.T), difference])


def _camera_error(
    camera: CalibratedCamera, found: SE3, true: SE3, true_offset_s: float, gauge: Gauge
) -> CameraDeviation:
    error = _error_in_rig_axes(found, true)
    covariance = camera.covariance_rig_axes
    known = np.isfinite(error) & np.isfinite(np.diag(covariance)) & (np.diag(covariance) > 0)
    nees = None
    if gauge == "reference" and known.any():
        nees = float(error[known] @ np.linalg.solve(covariance[np.ix_(known, known)], error[known]))
    is_known = camera.time_offset_s is not None and np.isfinite(true_offset_s)
    offset = camera.time_offset_s - true_offset_s if camera.time_offset_s is not None and is_known else None
    return CameraDeviation(
        camera.name,
        float(np.rad2deg(np.linalg.norm(error[:3]))),
        error[3:],
        nees,
        int(known.sum()) if nees is not None else 0,
        offset,
    )


def _pair_error(first: str, second: str, found: SE3, true: SE3) -> PairError:
    error = _error_in_rig_axes(found, true)
    return PairError(
        first, second, float(np.rad2deg(np.linalg.norm(error[:3]))), float(np.linalg.norm(error[3:]))
    )


def _best_alignment(true: Sequence[SE3], found: Sequence[SE3]) -> SE3:
    """The rigid motion of the found rig nearest to the true one: chordal mean rotation, then mean position."""
    pairs = [(t, f) for t, f in zip(true, found, strict=True) if np.isfinite(f.matrix).all()]
    if not pairs:
        raise InputError("No camera is fully determined: the rigs cannot be aligned.")
    rotation = so3.nearest_rotation(np.sum([t.rotation @ f.rotation.T for t, f in pairs], axis=0))
    translation = np.mean([t.translation - rotation @ f.translation for t, f in pairs], axis=0)
    return SE3(rotation, translation)


@dataclass(frozen=True, eq=False)
class CameraDifference:
    """How far a camera of B is from the same camera of A.

    translation_mm: (3,) along the axes of the rig. sigmas: the difference in units of both covariances (square
    root of the mean squared whitened difference), None without covariances. shift_px: by range in metres, median
    and largest displacement over the image of a point at that range; empty without a lens model. lens_px: median and
    largest displacement over the image by the lenses alone, None where one has none or they are for other image sizes
    (`sizes_px`: width and height of both where they differ). time_offset_ms: of B minus that of A, None without both.
    """

    name: str
    rotation_deg: float
    translation_mm: Array
    sigmas: float | None
    shift_px: dict[float, tuple[float, float]]
    lens_px: tuple[float, float] | None = None
    sizes_px: tuple[int, int, int, int] | None = None
    time_offset_ms: float | None = None

    def to_json(self) -> dict[str, Any]:
        """Plain values for `--json`."""
        return {
            "rotation_deg": self.rotation_deg,
            "translation_mm": self.translation_mm,
            "sigmas": self.sigmas,
            "shift_px": {f"{r:g}": {"median": m, "max": x} for r, (m, x) in self.shift_px.items()},
            "lens_px": None if self.lens_px is None else {"median": self.lens_px[0], "max": self.lens_px[1]},
            "time_offset_ms": self.time_offset_ms,
        }


def compare_calibrations(
    a: Calibration, b: Calibration, ranges_m: Sequence[float] = (5.0, 20.0, 100.0)
) -> dict[str, CameraDifference]:
    """Differences B against A of the cameras that both know; both in the same reference frame.

    Raises InputError when the references differ or no camera is common.
    """
    if a.reference != b.reference:
        raise InputError(
            f"The calibrations refer to different frames: {a.reference} and {b.reference}.",
            remedy="Calibrate both with the same --reference, or compare a camera pair.",
        )
    names = [name for name in a.cameras if name in b.cameras]
    if not names:
        raise InputError("The calibrations have no camera in common.")
    return {name: _difference(a.cameras[name], b.cameras[name], ranges_m) for name in names}


def _difference(a: CalibratedCamera, b: CalibratedCamera, ranges_m: Sequence[float]) -> CameraDifference:
    error = _error_in_rig_axes(b.rig_from_cam, a.rig_from_cam)
    covariance = a.covariance_rig_axes + b.covariance_rig_axes
    known = np.isfinite(error) & np.isfinite(np.diag(covariance)) & (np.diag(covariance) > 0)
    sigmas = None
    if known.any():
        whitened = error[known] @ np.linalg.solve(covariance[np.ix_(known, known)], error[known])
        sigmas = float(np.sqrt(whitened / known.sum()))
    model = a.model or b.model
    shift = {}
    if model is not None and np.isfinite(error).all():
        b_from_a = b.rig_from_cam.inverse() * a.rig_from_cam
        shift = {float(r): _pixel_shift(model, b_from_a, r) for r in ranges_m}
    offsets_s = (a.time_offset_s, b.time_offset_s)
    lens_px, sizes_px = _lens_shift(a.model, b.model)
    return CameraDifference(
        a.name,
        float(np.rad2deg(np.linalg.norm(error[:3]))),
        1e3 * error[3:],
        sigmas,
        shift,
        lens_px,
        sizes_px,
        None if offsets_s[0] is None or offsets_s[1] is None else 1e3 * (offsets_s[1] - offsets_s[0]),
    )


def _lens_shift(
    first: CameraModel | None, second: CameraModel | None
) -> tuple[tuple[float, float] | None, tuple[int, int, int, int] | None]:
    """Median and largest displacement (px) over the image when the lens is exchanged, or the sizes that differ."""
    if first is None or second is None:
        return None, None
    sizes = (first.width_px, first.height_px, second.width_px, second.height_px)
    if sizes[:2] != sizes[2:]:
        return None, sizes
    return _displacement(first, second, SE3.identity(), 1.0), None


def _pixel_shift(model: CameraModel, second_from_first: SE3, range_m: float) -> tuple[float, float]:
    """Median and largest displacement (px) over the image of points at one range when the camera is moved."""
    return _displacement(model, model, second_from_first, range_m)


def _displacement(
    first: CameraModel, second: CameraModel, second_from_first: SE3, range_m: float
) -> tuple[float, float]:
    """Median and largest displacement (px) over the image of points at one range, from one camera to another."""
    u = np.linspace(0, first.width_px - 1, 33)
    v = np.linspace(0, first.height_px - 1, 25)
    pixels = np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 2)
    bearings, seen = first.unproject(pixels)
    moved, still_seen = second.project(second_from_first * (range_m * bearings[seen]))
    if not still_seen.any():
        return float("nan"), float("nan")
    shift = np.linalg.norm(moved - pixels[seen], axis=1)[still_seen]
    return float(np.median(shift)), float(shift.max())


def _number(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None
