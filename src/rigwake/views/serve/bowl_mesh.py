"""The bowl as a mesh: where every vertex lies, and where every camera sees it. Sent to a viewer once."""

from __future__ import annotations

import json
import struct

import numpy as np

from rigwake.views.attitude import LevelAttitude
from rigwake.views.lookup import extended_pixels
from rigwake.views.projections import Bowl
from rigwake.views.surround_view import SurroundView
from rigwake.views.weights import blending_weights, sampled_quality

_AROUND, _OUT = 144, 56
_NEAREST_M, _FARTHEST_M = 0.6, 45.0


def bowl_mesh(view: SurroundView, attitude: LevelAttitude) -> bytes:
    """The mesh as a message: length of a JSON header (uint32, little endian), the header, then float32 arrays.

    Arrays, for V vertices: positions (V, 3) in the level frame of `attitude`; then per camera u, v in [0, 1] and
    blending weight (V, 3). The mesh is fixed to the rig: when the rig tilts, it is drawn turned by the tilt.
    """
    bowl = Bowl()
    out = np.geomspace(_NEAREST_M, _FARTHEST_M, _OUT)
    around = np.linspace(-np.pi, np.pi, _AROUND + 1)
    distance, azimuth = np.meshgrid(out, around, indexing="ij")
    height = bowl.height_above_water(distance) - attitude.height_m
    points = np.stack([distance * np.cos(azimuth), -distance * np.sin(azimuth), height], axis=-1).reshape(
        -1, 3
    )
    rig = view.rig
    pixels, qualities = [], []
    for index, cam_from_level in enumerate(rig.cam_from_level(attitude.level_from_rig)):
        at = extended_pixels(rig.models[index], cam_from_level * points).astype(np.float32)
        pixels.append(at)
        qualities.append(sampled_quality(view.quality.quality[index], at.reshape(_OUT, _AROUND + 1, 2)))
    weights = blending_weights(np.array(qualities)).reshape(len(rig), -1)
    parts = [points.astype("<f4").tobytes()]
    for index, model in enumerate(rig.models):
        scale = np.array([model.width_px, model.height_px], dtype=np.float32)
        uv = np.clip((pixels[index] + 0.5) / scale, -1.0, 2.0)
        parts.append(np.column_stack([uv, weights[index]]).astype("<f4").tobytes())
    header = json.dumps(
        {
            "kind": "mesh",
            "rows": _OUT,
            "columns": _AROUND + 1,
            "cameras": list(rig.names),
            "height_m": float(attitude.height_m),
            "level_from_rig": attitude.level_from_rig.ravel().tolist(),
        }
    ).encode()
    header += b" " * (-len(header) % 4)
    return struct.pack("<I", len(header)) + header + b"".join(parts)
