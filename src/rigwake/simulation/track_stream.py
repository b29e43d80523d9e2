"""Long recordings without pictures, a stretch at a time, with faults that set in on the way.

`simulate_tracks` holds a whole recording in memory; here hours pass in stretches, and a camera may move on its mount,
lose its clock or catch a drop of water on its lens.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields

import numpy as np
from numpy.typing import NDArray

from rigwake._types import Array
from rigwake.geometry import so3
from rigwake.geometry.se3 import SE3
from rigwake.rig import Rig, RigCamera
from rigwake.simulation.cross_sightings import simulate_cross_views
from rigwake.simulation.scenario import Camera
from rigwake.simulation.scene_layout import sample_landmarks
from rigwake.simulation.setup import Simulation
from rigwake.simulation.tracks_only import CameraTruth, _land_and_water, _observe, _sort
from rigwake.tracks import CrossViews, Tracks

PixelFault = Callable[[Array, Array], Array]
"""Pixels (N, 2) as a faulty lens shows them, from the true ones and the times (N,) in seconds."""


@dataclass(frozen=True, eq=False)
class MountFault:
    """A camera that moves: step at `at_s` and ramp from there.

    turned_rad, moved_m: (3,) in rig axes, of the step. ramp_rad_s: (3,) per second. late_s: the camera's stamps run
    late by so much from then on. pixels: what happens to its pictures from then on.
    """

    camera: str
    at_s: float = 0.0
    turned_rad: Array = field(default_factory=lambda: np.zeros(3))
    moved_m: Array = field(default_factory=lambda: np.zeros(3))
    ramp_rad_s: Array = field(default_factory=lambda: np.zeros(3))
    late_s: float = 0.0
    pixels: PixelFault | None = None

    def mounted(self, rig_from_cam: SE3, times_s: Array) -> SE3:
        """`rig_from_cam` at times (F,)."""
        since = np.maximum(times_s - self.at_s, 0.0)[:, None]
        begun = (times_s >= self.at_s)[:, None]
        turned = so3.exp(begun * self.turned_rad + since * self.ramp_rad_s)
        return SE3(turned @ rig_from_cam.rotation, rig_from_cam.translation + begun * self.moved_m)


@dataclass(frozen=True, eq=False)
class _Stretch(Simulation):
    """A simulation between two times, with cameras that move on their mounts."""

    first_s: float = 0.0
    last_s: float = 0.0
    fault: MountFault | None = None

    def camera_stamps(self, camera: Camera) -> NDArray[np.int64]:
        """Stamps within the stretch."""
        stamps = super().camera_stamps(camera)
        seconds = (stamps - self.start_ns) * 1e-9
        return stamps[(seconds >= self.first_s) & (seconds < self.last_s)]

    def scene_times_s(self, camera: Camera) -> Array:
        """With the delay of a faulty clock."""
        times = (self.camera_stamps(camera) - self.start_ns) * 1e-9 + camera.time_offset_ms * 1e-3
        fault = self.fault
        if fault is not None and fault.camera == camera.name:
            times = times - np.where(times >= fault.at_s, fault.late_s, 0.0)
        return np.asarray(times)


def stream_tracks(
    simulation: Simulation,
    stretch_s: float,
    *,
    overlap_s: float = 1.3,
    fault: MountFault | None = None,
    until_s: float | None = None,
) -> Iterator[tuple[float, Mapping[str, Tracks]]]:
    """Start (s) and tracks by camera of one stretch after the other; each reaches `overlap_s` into the next.

    What reaches over is drawn anew in the next stretch; the same tracks never appear in two stretches.
    """
    for first, tracks, _ in stream_sightings(
        simulation, stretch_s, overlap_s=overlap_s, fault=fault, until_s=until_s, cross_views=0
    ):
        yield first, tracks


def stream_sightings(
    simulation: Simulation,
    stretch_s: float,
    *,
    overlap_s: float = 1.3,
    fault: MountFault | None = None,
    until_s: float | None = None,
    cross_views: int = 30,
) -> Iterator[tuple[float, Mapping[str, Tracks], CrossViews]]:
    """As `stream_tracks`, and what a search for tracked landmarks in the other cameras' pictures would find.

    cross_views: per second, pair of cameras and time (the same, or up to a second apart), at most.
    """
    scenario = simulation.scenario
    landmarks = sample_landmarks(simulation.layout, simulation.rng(10), scenario.tracking.landmarks)
    end = until_s if until_s is not None else scenario.duration_s
    for number, first in enumerate(np.arange(0.0, end, stretch_s).tolist()):
        last = min(first + stretch_s + overlap_s, end)
        stretches, tracks, truths = {}, {}, {}
        for index, camera in enumerate(scenario.cameras):
            stretch, seen, truth = _tracks(simulation, index, camera, landmarks, fault, first, last, number)
            stretches[camera.name], tracks[camera.name], truths[camera.name] = stretch, seen, truth
        rng = simulation.rng(14, number)
        views = simulate_cross_views(stretches, tracks, truths, landmarks, cross_views, rng)
        yield first, tracks, views


def tracks_within(
    simulation: Simulation, spans_s: Sequence[tuple[float, float]], landmarks: Array | None = None
) -> dict[str, Tracks]:
    """Tracks by camera of these spans (s since the start, in order) alone; nothing is followed from one to the next.

    landmarks: (L, 3), by default those of `simulate_tracks`.
    """
    scenario = simulation.scenario
    if landmarks is None:
        landmarks = sample_landmarks(simulation.layout, simulation.rng(10), scenario.tracking.landmarks)
    return {
        camera.name: _joined(
            [
                _tracks(simulation, index, camera, landmarks, None, first, last, round(first * 1e3))[1]
                for first, last in spans_s
            ]
        )
        for index, camera in enumerate(scenario.cameras)
    }


def _joined(pieces: Sequence[Tracks]) -> Tracks:
    """Tracks of one camera one after the other, their frames and tracks numbered through."""
    frames = np.cumsum([0, *(len(piece.timestamps_ns) for piece in pieces)])
    ids = np.cumsum([0, *(int(piece.track_ids.max(initial=-1)) + 1 for piece in pieces)])
    return Tracks(
        pieces[0].camera,
        np.concatenate([piece.timestamps_ns for piece in pieces]),
        np.concatenate([p.frame_indices + first for p, first in zip(pieces, frames, strict=False)]),
        np.concatenate([p.track_ids + first for p, first in zip(pieces, ids, strict=False)]),
        np.concatenate([piece.pixels for piece in pieces]),
        np.concatenate([piece.bearings_cam for piece in pieces]),
        np.concatenate([piece.std_px for piece in pieces]),
    )


def _tracks(
    simulation: Simulation,
    index: int,
    camera: Camera,
    landmarks: Array,
    fault: MountFault | None,
    first_s: float,
    last_s: float,
    number: int,
) -> tuple[Simulation, Tracks, CameraTruth]:
    given = {part.name: getattr(simulation, part.name) for part in fields(Simulation)}
    stretch = _Stretch(**given, first_s=first_s, last_s=last_s, fault=fault)
    mine = fault if fault is not None and fault.camera == camera.name else None
    if mine is not None:
        fixed = simulation.rig.camera(camera.name)
        moved = mine.mounted(fixed.rig_from_cam, stretch.scene_times_s(camera))
        changed = RigCamera(camera.name, moved, fixed.model, fixed.time_offset_s)
        rig = Rig(simulation.rig.reference, {**simulation.rig.cameras, camera.name: changed})
        stretch = _Stretch(**{**given, "rig": rig}, first_s=first_s, last_s=last_s, fault=fault)
    rng = simulation.rng(12, index, number)
    exact = _sort(_land_and_water(stretch, camera, landmarks, rng))
    if mine is not None and mine.pixels is not None:
        times = stretch.scene_times_s(camera)[exact.frame]
        pixels = np.where((times >= mine.at_s)[:, None], mine.pixels(exact.pixels, times), exact.pixels)
        exact = type(exact)(exact.frame, exact.track, exact.landmark, pixels)
    return stretch, *_observe(stretch, camera, exact, simulation.scenario.tracking, rng)
