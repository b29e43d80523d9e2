"""How a vessel's cameras are turned from recording to recording, in little memory however many there are."""

from __future__ import annotations

from array import array
from collections import defaultdict
from collections.abc import Iterable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from rigwake.fleet.fleet_jobs import FleetOutcome
from rigwake.geometry import so3

_OUTLIER_SIGMAS = 5.0
FLOOR_DEG = 0.02  # differences below say nothing about a mount
_SAMPLE = 200  # rotations that the middle one is chosen among


@dataclass(frozen=True, slots=True)
class DriftPoint:
    """One camera in one recording: how far it is turned from the vessel's median, with its standard deviation."""

    started_ns: int
    recording: str
    camera: str
    turned_deg: float
    std_deg: float

    @property
    def is_outlier(self) -> bool:
        """Beyond what its own uncertainty explains."""
        return self.turned_deg > _OUTLIER_SIGMAS * max(self.std_deg, FLOOR_DEG)


@dataclass
class _CameraHistory:
    """values: four numbers of a quaternion (w, x, y, z) per recording, or one angle in degrees."""

    started_ns: array[int] = field(default_factory=lambda: array("q"))
    values: array[float] = field(default_factory=lambda: array("d"))
    std_deg: array[float] = field(default_factory=lambda: array("d"))
    recordings: list[str] = field(default_factory=list)

    def add(self, outcome: FleetOutcome, values: Iterable[float], std_deg: float) -> None:
        self.started_ns.append(outcome.started_ns or 0)
        self.values.extend(values)
        self.std_deg.append(std_deg)
        self.recordings.append(outcome.recording)

    def points(self, camera: str, turned_deg: Iterable[float]) -> Iterable[DriftPoint]:
        rows = zip(self.started_ns, self.recordings, turned_deg, self.std_deg, strict=True)
        return (
            DriftPoint(started, recording, camera, float(turned), std)
            for started, recording, turned, std in rows
        )


class DriftHistory:
    """Of one vessel; told every outcome of its recordings."""

    def __init__(self) -> None:
        self._mounted: dict[tuple[str, str], _CameraHistory] = defaultdict(_CameraHistory)
        self._monitored: dict[str, _CameraHistory] = defaultdict(_CameraHistory)

    def add(self, outcome: FleetOutcome) -> None:
        """Note where the cameras of a recording look, or how far the monitor says that they moved."""
        for name, camera in outcome.cameras.items():
            quat, size = camera.get("quat_wxyz"), camera.get("size_deg")
            if quat and None not in quat:
                stds = [s for s in camera.get("std_rotation_deg") or [] if s is not None]
                self._mounted[outcome.reference, name].add(outcome, quat, max(stds, default=0.0))
            elif size is not None:
                self._monitored[name].add(outcome, [size], camera.get("size_std_deg") or 0.0)

    def points(self) -> list[DriftPoint]:
        """How far every camera is turned from its median over all recordings, in the order of time.

        The median is the recording's rotation that is nearest to all others. Rigs in other frames are not compared; of
        a monitored vessel it is the size of the drift that the monitor states.
        """
        points: list[DriftPoint] = []
        for (_, name), seen in self._mounted.items():
            rotations = so3.matrix_from_quat_wxyz(np.array(seen.values).reshape(-1, 4))
            points += seen.points(name, _turned_from_median(rotations))
        for name, seen in self._monitored.items():
            points += seen.points(name, seen.values)
        return sorted(points, key=lambda p: (p.started_ns, p.recording, p.camera))


def _turned_from_median(rotations: NDArray[np.float64]) -> NDArray[np.float64]:
    """Degrees of every rotation from the one in the middle, judged by at most some hundred others."""
    sample = rotations[:: max(len(rotations) // _SAMPLE, 1)]
    cosines = (np.einsum("nij,mij->nm", sample, sample) - 1) / 2
    middle = sample[int(np.arccos(np.clip(cosines, -1, 1)).sum(axis=1).argmin())]
    return np.asarray(
        np.rad2deg(np.linalg.norm(so3.log(np.swapaxes(rotations, 1, 2) @ middle), axis=1)), dtype=np.float64
    )
