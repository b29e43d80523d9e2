"""A calibration in a few lines: for the prompt and for notebooks."""

from __future__ import annotations

from html import escape
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from rigwake.calibration.rig_calibration import CalibratedCamera, Calibration

_UNOBSERVABLE = "unobservable"


def _position(camera: CalibratedCamera) -> list[str]:
    """x, y, z in millimetres with their standard deviations."""
    cells = []
    pairs = zip(camera.rig_from_cam.translation, camera.std_translation_m, strict=True)
    for value, std in pairs:
        if not np.isfinite(value):
            cells.append(_UNOBSERVABLE)
        else:
            cells.append(f"{1e3 * value:.1f}" + (f" ± {1e3 * std:.2g}" if np.isfinite(std) else ""))
    return cells


def _rotation_std(camera: CalibratedCamera) -> str:
    if not np.isfinite(camera.rig_from_cam.rotation).all():
        return _UNOBSERVABLE
    std = camera.std_rotation_deg
    return f"{np.nanmax(std):.2g}" if np.isfinite(std).any() else "unknown"


def as_text(calibration: Calibration) -> str:
    """One line per camera."""
    lines = [f"Calibration of {len(calibration.cameras)} cameras in the frame {calibration.reference!r}"]
    for name, camera in calibration.cameras.items():
        lines.append(
            f"  {name}: x y z {', '.join(_position(camera))} mm; largest rotation std {_rotation_std(camera)} deg"
        )
    return "\n".join(lines)


def as_html(calibration: Calibration) -> str:
    """A table; names are escaped."""
    head = "".join(
        f"<th>{h}</th>" for h in ("camera", "x, mm", "y, mm", "z, mm", "largest rotation std, deg")
    )
    body = "".join(
        "<tr>"
        + "".join(f"<td>{escape(c)}</td>" for c in (name, *_position(camera), _rotation_std(camera)))
        + "</tr>"
        for name, camera in calibration.cameras.items()
    )
    caption = f"<caption>cameras in the frame {escape(calibration.reference)}</caption>"
    return f"<table>{caption}<thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>"
