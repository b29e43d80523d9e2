"""The rig as a view needs it: cameras with a lens and a place, the viewpoint between them, and what is ahead."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from rigwake._types import Array
from rigwake.cameras.protocol import CameraModel
from rigwake.errors import UsageError
from rigwake.geometry.se3 import SE3
from rigwake.rig import Rig


@dataclass(frozen=True, eq=False)
class SurroundRig:
    """Cameras of a rig around one viewpoint.

    names, models, rig_from_cam, time_offsets_s (`t_rig = t_cam + time_offset_s`): one per camera, in the same order.
    viewpoint_rig: (3,) where views are seen from: the mean of the cameras' positions, in the rig frame.
    forward_rig: (3,) unit vector ahead, in the rig frame. notes: sentences about what had to be assumed.
    """

    names: tuple[str, ...]
    models: tuple[CameraModel, ...]
    rig_from_cam: tuple[SE3, ...]
    time_offsets_s: tuple[float, ...]
    viewpoint_rig: Array
    forward_rig: Array
    notes: tuple[str, ...] = ()

    def __len__(self) -> int:
        return len(self.names)

    def cam_from_level(self, level_from_rig: Array) -> tuple[SE3, ...]:
        """`cam_from_level` of every camera; the level frame has its origin in the viewpoint.

        level_from_rig: (3, 3) rotation (`LevelAttitude.level_from_rig`).
        """
        rig_from_level = SE3(np.asarray(level_from_rig).T, self.viewpoint_rig)
        return tuple(rig_from_cam.inverse() * rig_from_level for rig_from_cam in self.rig_from_cam)

    def positions_level(self, level_from_rig: Array) -> Array:
        """(cameras, 3) positions in the level frame, metres."""
        positions = np.array([x.translation for x in self.rig_from_cam]) - self.viewpoint_rig
        return np.asarray(positions @ np.asarray(level_from_rig).T)


def surround_rig(rig: Rig) -> SurroundRig:
    """The rig of a calibration, ready for views.

    Cameras whose direction was unobservable are left out; a coordinate of a position that was unobservable is
    replaced by the mean of the other cameras (zero if there is none): both are said in `notes`.
    Ahead is the x axis of the rig, or the optical axis if the rig frame is a camera's.
    Raises UsageError if no camera is left, or if one has no lens.
    """
    notes: list[str] = []
    kept = {}
    for name, camera in rig.cameras.items():
        if not np.isfinite(camera.rig_from_cam.rotation).all():
            notes.append(f"{name}: its direction is unobservable, so it is not shown.")
        elif camera.model is None:
            raise UsageError(
                f"The calibration has no lens for {name}.",
                consequence="Its pixels have no directions.",
                remedy="Calibrate with intrinsics (`rigwake intrinsics`), or take it out of the file.",
            )
        else:
            kept[name] = camera
    if not kept:
        raise UsageError("No camera of this calibration has a known direction.", remedy="Calibrate again.")
    positions = np.array([c.rig_from_cam.translation for c in kept.values()])
    known = np.isfinite(positions)
    mean = np.where(known, positions, 0.0).sum(axis=0) / np.maximum(known.sum(axis=0), 1)
    for index, (name, camera) in enumerate(list(kept.items())):
        if known[index].all():
            continue
        axes = ", ".join("xyz"[k] for k in np.flatnonzero(~known[index]))
        notes.append(f"{name}: its position along {axes} is unobservable; the mean of the others is taken.")
        place = SE3(camera.rig_from_cam.rotation, np.where(known[index], positions[index], mean))
        kept[name] = replace(camera, rig_from_cam=place)
    places = tuple(c.rig_from_cam for c in kept.values())
    forward = np.array([1.0, 0.0, 0.0])
    if rig.reference in rig.cameras and rig.reference in kept:
        forward = kept[rig.reference].rig_from_cam.rotation[:, 2]
    return SurroundRig(
        tuple(kept),
        tuple(c.model for c in kept.values() if c.model is not None),
        places,
        tuple(c.time_offset_s for c in kept.values()),
        np.mean([p.translation for p in places], axis=0),
        forward,
        tuple(notes),
    )
