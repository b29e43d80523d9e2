"""From one camera model to another, by fitting."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rigwake._types import Array
from rigwake.cameras.models.lens import Lens, axis_focal_px
from rigwake.cameras.protocol import CameraModel
from rigwake.cameras.registry import camera_class
from rigwake.errors import CameraError

_SAMPLES_ALONG_WIDTH = 60
_MAX_STEPS = 200
_CEILING_MARGIN = np.deg2rad(15.0)  # fits towards a pinhole end well before its 90 degrees


@dataclass(frozen=True)
class Conversion:
    """A camera of another model, and how far it departs from the original.

    rms_px, max_px: distance between both cameras' pixels of the same ray, over the original's image as far as
    `fitted_angle` (radians off the axis); the new camera ends there.
    """

    camera: CameraModel
    rms_px: float
    max_px: float
    fitted_angle: float


def convert_camera(camera: CameraModel, model: str, max_angle: float | None = None) -> Conversion:
    """The camera of another model that comes closest, in the least squares of pixels over the image.

    max_angle: how far off the axis to fit, radians; by default as far as both models reach (75 degrees for a
    pinhole). Raises CameraError for an unknown model, or if too little of the image lies inside.
    """
    target = camera_class(model)
    ceiling = target.angle_ceiling if target.angle_ceiling > np.pi / 2 else np.pi / 2 - _CEILING_MARGIN
    reach = min(camera.max_angle, ceiling if max_angle is None else min(max_angle, target.angle_ceiling))
    bearings, pixels = _image_rays(camera, reach)
    cx, cy = camera.project(np.array([[0.0, 0.0, 1.0]]))[0][0].tolist()
    start = target(target.nominal_values(axis_focal_px(camera), cx, cy), camera.width_px, camera.height_px)
    fitted = _fit(start, bearings, pixels)
    end = min(reach, fitted.max_angle)
    final = target(fitted.values, camera.width_px, camera.height_px, end)
    error = np.linalg.norm(fitted.project(bearings)[0] - pixels, axis=1)
    return Conversion(final, float(np.sqrt(np.mean(error**2))), float(error.max()), end)


def _image_rays(camera: CameraModel, reach: float) -> tuple[Array, Array]:
    step = max(camera.width_px / _SAMPLES_ALONG_WIDTH, 1.0)
    columns, rows = np.arange(0, camera.width_px, step), np.arange(0, camera.height_px, step)
    pixels = np.stack(np.meshgrid(columns, rows), axis=-1).reshape(-1, 2)
    bearings, valid = camera.unproject(pixels)
    with np.errstate(invalid="ignore"):
        used = valid & (bearings[:, 2] >= np.cos(reach))
    if used.sum() < 50:
        raise CameraError(
            f"Only {used.sum()} of {len(used)} sampled pixels lie within {np.rad2deg(reach):.1f} deg of the axis.",
            consequence="That is too little to fit another model to.",
            remedy="Fit over a wider angle.",
        )
    return bearings[used], pixels[used]


def _fit(lens: Lens, bearings: Array, pixels: Array) -> Lens:
    """Levenberg-Marquardt over the parameters that are not fixed by default."""
    free = np.array([name not in lens.fixed_by_default for name in lens.param_names])
    cost, damping = _cost(lens, bearings, pixels), 1e-3
    for _ in range(_MAX_STEPS):
        projection = lens.project_with_jacobians(bearings)
        J = projection.d_params[:, :, free].reshape(-1, int(free.sum()))
        scale = np.maximum(np.linalg.norm(J, axis=0), 1e-12)
        J = J / scale
        gradient = J.T @ (pixels - projection.pixels).ravel()
        step = np.linalg.solve(J.T @ J + damping * np.eye(J.shape[1]), gradient) / scale
        values = lens.params
        values[free] += step
        candidate, candidate_cost = _candidate(lens, values, bearings, pixels)
        if candidate is None or not candidate_cost < cost:
            damping *= 10
            if damping > 1e12:
                return lens
            continue
        gain, cost, lens = cost - candidate_cost, candidate_cost, candidate
        damping = max(damping / 10, 1e-15)
        if gain <= 1e-14 * (cost + 1e-20):
            return lens
    return lens


def _candidate(lens: Lens, values: Array, bearings: Array, pixels: Array) -> tuple[Lens | None, float]:
    try:
        candidate = lens.with_params(values)
    except CameraError:  # the step left what the model can be: a shorter one is tried next
        return None, np.inf
    return candidate, _cost(candidate, bearings, pixels)


def _cost(lens: Lens, bearings: Array, pixels: Array) -> float:
    projected, valid = lens.project(bearings)
    return float(np.sum((projected - pixels) ** 2)) if valid.all() else np.inf
