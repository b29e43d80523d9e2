"""What tells one vessel from another: its cameras' names, sizes and lenses."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from rigwake.calibration import Calibration
from rigwake.cameras.protocol import CameraModel
from rigwake.recording import Recording

_LENS_TOLERANCE = 1e-3  # of the parameter, or of one where it is smaller


@dataclass(frozen=True)
class CameraFingerprint:
    """width_px, height_px, lens: zero and empty where unknown. params: by name."""

    width_px: int = 0
    height_px: int = 0
    lens: str = ""
    params: tuple[tuple[str, float], ...] = ()


@dataclass(frozen=True)
class VesselFingerprint:
    """cameras: by name."""

    cameras: tuple[tuple[str, CameraFingerprint], ...]

    def to_json(self) -> dict[str, Any]:
        """Plain values."""
        return {
            name: {
                "width_px": c.width_px,
                "height_px": c.height_px,
                "lens": c.lens,
                "params": dict(c.params),
            }
            for name, c in self.cameras
        }

    @classmethod
    def from_json(cls, content: Mapping[str, Any]) -> VesselFingerprint:
        """What `to_json` gave."""
        return cls(
            tuple(
                (
                    str(name),
                    CameraFingerprint(
                        int(c["width_px"]),
                        int(c["height_px"]),
                        str(c["lens"]),
                        tuple((str(k), float(v)) for k, v in c["params"].items()),
                    ),
                )
                for name, c in content.items()
            )
        )

    @property
    def digest(self) -> str:
        """Twelve characters that stand for names, sizes and lens models; refined lens parameters do not change them."""
        plain = [(name, c.width_px, c.height_px, c.lens) for name, c in sorted(self.cameras)]
        return hashlib.sha256(json.dumps(plain).encode()).hexdigest()[:12]

    def differences(self, other: VesselFingerprint) -> list[str]:
        """In words, what `other` lacks or has otherwise; what either does not know and further cameras do not count."""
        theirs = dict(other.cameras)
        found = []
        for name, mine in self.cameras:
            if name not in theirs:
                found.append(f"there is no camera {name} (there: {', '.join(theirs) or 'none'})")
                continue
            found += _differences(name, mine, theirs[name])
        return found


def _differences(name: str, mine: CameraFingerprint, theirs: CameraFingerprint) -> list[str]:
    size, other_size = (mine.width_px, mine.height_px), (theirs.width_px, theirs.height_px)
    if 0 not in size and 0 not in other_size and size != other_size:
        return [f"{name} has {other_size[0]}x{other_size[1]} pixels, not {size[0]}x{size[1]}"]
    if not mine.lens or not theirs.lens:
        return []
    if mine.lens != theirs.lens:
        return [f"the lens of {name} is {theirs.lens}, not {mine.lens}"]
    other_params = dict(theirs.params)
    for key, value in mine.params:
        there = other_params.get(key)
        if there is None or abs(there - value) > _LENS_TOLERANCE * max(abs(value), 1.0):
            return [f"the lens of {name} differs ({key} {there} against {value:g})"]
    return []


def _of_camera(model: CameraModel | None, width_px: int = 0, height_px: int = 0) -> CameraFingerprint:
    if model is None:
        return CameraFingerprint(width_px, height_px)
    params = tuple(zip(model.param_names, (float(v) for v in model.params), strict=True))
    return CameraFingerprint(model.width_px, model.height_px, model.model, params)


def fingerprint_of_calibration(calibration: Calibration) -> VesselFingerprint:
    """Of the vessel that was calibrated."""
    return VesselFingerprint(tuple((name, _of_camera(c.model)) for name, c in calibration.cameras.items()))


def fingerprint_of_recording(recording: Recording) -> VesselFingerprint:
    """Of the vessel that was recorded."""
    return VesselFingerprint(
        tuple((name, _of_camera(c.model, c.width_px, c.height_px)) for name, c in recording.cameras.items())
    )
