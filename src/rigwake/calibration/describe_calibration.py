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
    """A table and a picture from above; names are escaped."""
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
    return f"<table>{caption}<thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>{_from_above(calibration)}"


_SIDE_PX = 260.0


def _from_above(calibration: Calibration) -> str:
    """A small picture: cameras from above as dots, lines to where they look; x to the right, y up, a cross at the
    origin. Cameras whose place is unobservable are left out; empty without any."""
    placed = {
        name: camera.rig_from_cam
        for name, camera in calibration.cameras.items()
        if np.isfinite(camera.rig_from_cam.translation[:2]).all()
    }
    if not placed:
        return ""
    points = np.array([x.translation[:2] for x in placed.values()])
    reach = max(float(np.abs(points).max()), 0.1)
    scale, middle = 0.36 * _SIDE_PX / reach, _SIDE_PX / 2
    parts = [f'<path d="M{middle - 5},{middle}h10M{middle},{middle - 5}v10"/>']
    for name, x in placed.items():
        u, v = middle + scale * x.translation[0], middle - scale * x.translation[1]
        parts.append(f'<circle cx="{u:.1f}" cy="{v:.1f}" r="3" fill="currentColor"/>')
        parts.append(
            f'<text x="{u + 5:.1f}" y="{v - 5:.1f}" fill="currentColor" stroke="none">{escape(name)}</text>'
        )
        ahead = x.rotation[:2, 2]
        if np.isfinite(ahead).all():
            parts.append(f'<path d="M{u:.1f},{v:.1f}l{28 * ahead[0]:.1f},{-28 * ahead[1]:.1f}"/>')
    words = "cameras from above, lines to where they look"
    return (
        f'<svg width="{_SIDE_PX:.0f}" height="{_SIDE_PX:.0f}" viewBox="0 0 {_SIDE_PX:.0f} {_SIDE_PX:.0f}" role="img" '
        f'aria-label="{words}" stroke="currentColor" font-size="11" font-family="sans-serif">{"".join(parts)}</svg>'
    )
