"""mrcal: a folder with one `NAME.cameramodel` per camera, a Python literal that is read as such, never run.

`extrinsics` (mrcal before 2.5) and `rt_cam_ref` (from 2.5 on) hold the same: Rodrigues rotation and translation
that map the reference frame to the camera. Pixel (0, 0) is the centre of the first pixel, as here. mrcal's
parametric lenses are OpenCV's pinholes; a fisheye must fit one of them over its whole image or is refused.
Source: https://mrcal.secretsauce.net/cameramodels.html
"""

from __future__ import annotations

import ast
import pprint
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from rigwake.calibration import CalibratedCamera, Calibration
from rigwake.cameras.protocol import CameraModel
from rigwake.cameras.registry import camera_from_params
from rigwake.errors import CameraError, InputError
from rigwake.exporters.export_base import (
    REF,
    ExportOptions,
    Notes,
    external_calibration,
    external_camera,
    file_stem,
    header,
    read_text,
    require_lenses,
    write_files,
)
from rigwake.exporters.lenses import write_lens
from rigwake.geometry import so3
from rigwake.geometry.se3 import SE3

SUFFIX = ".cameramodel"
_LENSES = ("rational", "pinhole")
_COEFFICIENTS = {
    "LENSMODEL_PINHOLE": 0,
    "LENSMODEL_OPENCV4": 4,
    "LENSMODEL_OPENCV5": 5,
    "LENSMODEL_OPENCV8": 8,
}


def _lens(camera: CameraModel) -> tuple[str, list[float]]:
    """mrcal's name and `fx, fy, cx, cy, k1, k2, p1, p2, k3, ...`."""
    if camera.model not in ("pinhole", "rational") or camera.params[4] != 0:
        raise CameraError(
            f"mrcal has no form for a {camera.model} lens{' with skew' * (camera.model in _LENSES)}."
        )
    focal, coefficients = camera.params[:4].tolist(), camera.params[5:].tolist()
    used = len(np.trim_zeros(coefficients, "b"))
    name = next(name for name, count in _COEFFICIENTS.items() if count >= used)
    return name, [*focal, *coefficients[: _COEFFICIENTS[name]]]


def write_mrcal(calibration: Calibration, path: Path, options: ExportOptions, notes: Notes) -> Notes:
    """The folder, `NAME.cameramodel` per camera."""
    more: Notes = []
    files: dict[Path, str] = {}
    comments = [f"# {line}" for line in header(calibration, notes)]
    for name, lens in require_lenses(calibration, "mrcal").items():
        (model, intrinsics), written, lens_notes = write_lens(
            lens, _lens, _LENSES, options.max_fit_error_px, name
        )
        more += lens_notes
        cam_from_rig = calibration.cameras[name].rig_from_cam.inverse()
        rt_cam_ref = [*so3.log(cam_from_rig.rotation).tolist(), *cam_from_rig.translation.tolist()]
        content = {
            "lensmodel": model,
            "intrinsics": intrinsics,
            "extrinsics": rt_cam_ref,
            "rt_cam_ref": rt_cam_ref,
            "imagersize": [written.width_px, written.height_px],
        }
        text = pprint.pformat(content, sort_dicts=False, width=110)
        files[path / f"{file_stem(name)}{SUFFIX}"] = "\n".join([*comments, text]) + "\n"
    return [*more, *write_files(files)]


def read_mrcal(path: Path) -> Calibration:
    """One camera model, or all of a folder; other lenses than OpenCV's keep their place but not their lens."""
    files = sorted(path.glob(f"*{SUFFIX}")) if path.is_dir() else [path]
    return external_calibration(REF, [_camera(file) for file in files], path)


def _camera(file: Path) -> CalibratedCamera:
    try:
        content = ast.literal_eval(read_text(file))
        rt = _six(content["rt_cam_ref"] if "rt_cam_ref" in content else content["extrinsics"])
        model = _camera_model(str(content["lensmodel"]), content["intrinsics"], content["imagersize"])
    except (SyntaxError, ValueError, KeyError, TypeError, MemoryError, RecursionError) as error:
        raise InputError(f"{file} is not a cameramodel: {type(error).__name__}: {error}.") from error
    return external_camera(file.stem, SE3(so3.exp(rt[:3]), rt[3:]).inverse(), model)


def _six(values: Sequence[float]) -> np.ndarray[Any, np.dtype[np.float64]]:
    rt = np.array(values, dtype=np.float64)
    if rt.shape != (6,) or not np.isfinite(rt).all():
        raise ValueError("the extrinsics must be six finite numbers")
    return rt


def _camera_model(name: str, intrinsics: Sequence[float], size: Sequence[int]) -> CameraModel | None:
    if name not in _COEFFICIENTS:
        return None
    fx, fy, cx, cy, *coefficients = (float(value) for value in intrinsics)
    model, count = ("rational", 8) if len(coefficients) > 5 else ("pinhole", 5)
    padded = [*coefficients, *[0.0] * (count - len(coefficients))]
    width_px, height_px = (int(value) for value in size)
    return camera_from_params(model, [fx, fy, cx, cy, 0.0, *padded], width_px, height_px)
