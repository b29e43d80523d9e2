"""The pictures that the live page shows, drawn once per scene however many look."""

from __future__ import annotations

import json
import struct
import threading
from collections.abc import Mapping
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from rigwake._types import Image, Mask
from rigwake.errors import UsageError
from rigwake.views.colour import ColourModel
from rigwake.views.present import Decoration, Presenter
from rigwake.views.projections import CylinderView, TopDown
from rigwake.views.serve.bowl_mesh import bowl_mesh
from rigwake.views.serve.feed import LiveScene
from rigwake.views.surround_rig import SurroundRig
from rigwake.views.surround_view import SurroundView

SCREENS = ("panorama", "topdown", "camera", "bowl")
_QUALITY = 80
_BOWL_WIDTH_PX = 640  # of a camera's picture in the bowl


class Screens:
    """Draws the screens of one rig. Thread-safe: one scene is drawn at a time, and kept until the next."""

    def __init__(
        self,
        rig: SurroundRig,
        masks: Mapping[str, Mask] | None,
        colour: ColourModel | None,
        decoration: Decoration,
        is_height_known: bool,
    ) -> None:
        self.rig = rig
        self.is_height_known = is_height_known
        self._presenters = {}
        for name, projection in (
            ("panorama", CylinderView(1600, 500, 32.0, -42.0)),
            ("topdown", TopDown(800, 800)),
        ):
            view = SurroundView(rig, projection, masks, colour)
            self._presenters[name] = Presenter(view, decoration)
        self._lock = threading.Lock()
        self._drawn: dict[tuple[str, str], tuple[int, bytes]] = {}
        self._mesh: bytes | None = None

    def set_colour(self, colour: ColourModel) -> None:
        """Show the next scenes with these gains."""
        for presenter in self._presenters.values():
            presenter.view.colour = colour

    def message(self, scene: LiveScene, screen: str, camera: str) -> bytes:
        """A binary message: length of a JSON header (uint32, little endian), the header, JPEG pictures.

        The header holds kind, number, taken_s, missing, and the lengths of the pictures. UsageError for an unknown
        screen or camera, or if the height above the water is needed and unknown.
        """
        if screen not in SCREENS or (screen == "camera" and camera not in self.rig.names):
            raise UsageError("There is no such view.")
        if screen in ("topdown", "bowl") and not self.is_height_known:
            raise UsageError(
                "The height of the cameras above the water is not known.",
                remedy="Start with --height-m METRES.",
            )
        key = (screen, camera if screen == "camera" else "")
        with self._lock:
            kept = self._drawn.get(key)
            if kept is not None and kept[0] == scene.number:
                return kept[1]
            message = self._bias_response(scene, screen, camera)
            self._drawn[key] = (scene.number, message)
            return message

    def mesh(self, scene: LiveScene) -> bytes:
        """The mesh of the bowl, made at the first scene."""
        with self._lock:
            if self._mesh is None:
                self._mesh = bowl_mesh(self._presenters["panorama"].view, scene.attitude)
            return self._mesh

    def _bias_response(self, scene: LiveScene, screen: str, camera: str) -> bytes:
        header: dict[str, Any] = {
            "kind": screen,
            "number": scene.number,
            "taken_s": scene.taken_s,
            "missing": dict(scene.frames.missing),
            "levelled": scene.attitude.source,
        }
        if screen == "bowl":
            pictures = [self._camera(scene, name, _BOWL_WIDTH_PX) for name in self.rig.names]
            header["level_from_rig"] = scene.attitude.level_from_rig.ravel().tolist()
            gains = self._gains()
            header["gains"] = gains.tolist()
        elif screen == "camera":
            pictures = [self._camera(scene, camera, None)]
        else:
            pictures = [self._presenters[screen].picture(scene.frames, scene.attitude, scene.surface)]
        jpegs = [_jpeg(p) if p is not None else b"" for p in pictures]
        header["lengths"] = [len(j) for j in jpegs]
        encoded = json.dumps(header).encode()
        return struct.pack("<I", len(encoded)) + encoded + b"".join(jpegs)

    def _gains(self) -> NDArray[Any]:
        colour = self._presenters["panorama"].view.colour
        return np.ones((len(self.rig), 3)) if colour is None else colour.gains.astype(float)

    def _camera(self, scene: LiveScene, name: str, width_px: int | None) -> Image | None:
        """A camera's own picture; None if it is missing."""
        picture = scene.frames.images(self.rig).get(name)
        if picture is None:
            return None
        if width_px is None or picture.shape[1] <= width_px:
            return np.ascontiguousarray(picture)
        height = round(picture.shape[0] * width_px / picture.shape[1])
        return cv2.resize(picture, (width_px, height), interpolation=cv2.INTER_AREA)


def _jpeg(picture: Image) -> bytes:
    _, encoded = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])
    return bytes(encoded.tobytes())
