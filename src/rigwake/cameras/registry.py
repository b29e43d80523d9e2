"""All camera models by name, and their form in YAML and JSON files."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from rigwake.cameras.models.double_sphere import DoubleSphere
from rigwake.cameras.models.eucm import EnhancedUnified
from rigwake.cameras.models.fov import FieldOfView
from rigwake.cameras.models.kannala_brandt import KannalaBrandt4
from rigwake.cameras.models.kannala_brandt_full import KannalaBrandtFull
from rigwake.cameras.models.lens import Lens
from rigwake.cameras.models.mei import Mei
from rigwake.cameras.models.pinhole import Pinhole, RationalPinhole
from rigwake.cameras.models.scaramuzza import Scaramuzza
from rigwake.cameras.protocol import CameraModel
from rigwake.errors import CameraError

CAMERA_CLASSES: dict[str, type[Lens]] = {
    lens.model: lens
    for lens in (
        Pinhole,
        RationalPinhole,
        KannalaBrandt4,
        KannalaBrandtFull,
        Mei,
        Scaramuzza,
        EnhancedUnified,
        DoubleSphere,
        FieldOfView,
    )
}


def camera_class(model: str) -> type[Lens]:
    """The class of this model name; CameraError lists the known ones."""
    if model not in CAMERA_CLASSES:
        raise CameraError(
            f"There is no camera model {model!r}.", remedy=f"Known: {', '.join(sorted(CAMERA_CLASSES))}."
        )
    return CAMERA_CLASSES[model]


def camera_from_params(
    model: str, params: ArrayLike, width_px: int, height_px: int, max_angle: float | None = None
) -> CameraModel:
    """The camera of this model name with parameters in the model's own order.

    max_angle: where the lens ends (half its field of view, radians), if known. CameraError for an unknown
    name, or values that the model refuses.
    """
    values = tuple(float(value) for value in np.asarray(params, dtype=np.float64).ravel())
    return camera_class(model)(values, int(width_px), int(height_px), max_angle)


def camera_to_dict(camera: CameraModel) -> dict[str, Any]:
    """Plain values for YAML and JSON: `model`, `width_px`, `height_px`, `params` by name, `max_angle_deg`.

    `max_angle_deg` stands there only where the lens's end was given; else it follows from the parameters.
    """
    plain: dict[str, Any] = {
        "model": camera.model,
        "width_px": camera.width_px,
        "height_px": camera.height_px,
        "params": dict(zip(camera.param_names, camera.params.tolist(), strict=True)),
    }
    limit = getattr(camera, "angle_limit", None)
    if limit is not None:
        plain["max_angle_deg"] = float(np.rad2deg(limit))
    return plain


def camera_from_dict(plain: Mapping[str, Any]) -> CameraModel:
    """The camera that `camera_to_dict` described, parameters in any order.

    CameraError names what is missing or unknown.
    """
    missing = {"model", "width_px", "height_px", "params"} - plain.keys()
    if missing:
        raise CameraError(f"A camera lacks {', '.join(sorted(missing))}.")
    if not isinstance(plain["params"], Mapping):
        raise CameraError("A camera's params must map names to values.")
    given = plain["params"]
    names = _param_names(str(plain["model"]), len(given))
    if given.keys() != set(names):
        raise CameraError(
            f"{plain['model']} takes the parameters {', '.join(names)}; the file has {', '.join(map(str, given))}."
        )
    limit = plain.get("max_angle_deg")
    try:
        values = [float(given[name]) for name in names]
        max_angle = None if limit is None else float(np.deg2rad(float(limit)))
        size = int(plain["width_px"]), int(plain["height_px"])
    except (TypeError, ValueError) as error:
        raise CameraError(
            f"A camera of model {plain['model']!r} has a value that is not a number."
        ) from error
    return camera_from_params(str(plain["model"]), values, *size, max_angle)


def _param_names(model: str, count: int) -> tuple[str, ...]:
    """Names of a model's parameters, in order. Only the length of Scaramuzza's polynomial depends on the count."""
    lens = camera_class(model)
    nominal = lens.nominal_values(1.0, 0.0, 0.0)
    return lens((*nominal[:count], *[0.0] * (count - len(nominal))), 1, 1).param_names
