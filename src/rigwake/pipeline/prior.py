"""What is known of a rig beforehand: tape measures with their uncertainty, fixed degrees of freedom, known baselines.

cameras:
  front:
    rig_from_cam: {quat_wxyz: [w, x, y, z], translation_m: [x, y, z]}   # either may be left out
    std: {rotation_deg: [x, y, z], translation_m: [x, y, z]}            # rig axes; null: not known, 0: fixed
baselines:
  - {cameras: [left, right], distance_m: 1.20, std_m: 0.005}
antenna: {position_rig_m: [x, y, z], std_m: [x, y, z]}
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from rigwake._types import Array
from rigwake.ba.rig.gauge import with_gauge
from rigwake.ba.rig.rig_values import InitialRig
from rigwake.ba.solver.rig_problem import (
    BundleCamera,
    CameraDistance,
    CameraParameter,
    PosePrior,
    RigProblem,
    VectorPrior,
)
from rigwake.config import CalibrateConfig
from rigwake.errors import InputError, UsageError
from rigwake.fingerprint import input_fingerprint
from rigwake.geometry.se3 import SE3
from rigwake.trajectory import Trajectory
from rigwake.yaml_input import read_yaml_settings

# as good as nothing, yet it keeps an offset that nothing determines, and whatever it draws along, from running away
_ABOARD_STD_M = 10.0
_UNIT = 0.05
_FIXED_STD = 1e-7  # radians or metres: what a fixed degree of freedom is held with


@dataclass(frozen=True, eq=False)
class Baseline:
    """A known distance between two cameras, metres."""

    first: str
    second: str
    distance_m: float
    std_m: float


@dataclass(frozen=True, eq=False)
class RigPrior:
    """Priors of cameras by name (transform and six standard deviations in rig axes), baselines, antenna.

    origin: the file that it was read from and what stood in it, for the provenance of a result.
    """

    cameras: Mapping[str, PosePrior] = field(default_factory=dict)
    baselines: tuple[Baseline, ...] = ()
    antenna: VectorPrior | None = None
    origin: Mapping[str, Any] = field(default_factory=dict)

    def applied_to(self, first: InitialRig, config: CalibrateConfig) -> InitialRig:
        """Initial values with these priors, with the scale of a known baseline if there is no other, and with what
        the settings hold fixed. Raises UsageError for cameras that are not there."""
        cameras = dict(first.cameras)
        for name in self.cameras:
            if name not in cameras:
                raise UsageError(
                    f"The prior names a camera {name!r}.", remedy=f"There are: {', '.join(cameras)}."
                )
        if first.scale_source == "none" and self.baselines:
            first = _scaled(first, self.baselines)
            cameras = dict(first.cameras)
        for name, camera in cameras.items():
            cameras[name] = _prepared(camera, self.cameras.get(name), config)
        return replace(first, cameras=cameras)

    def constrained(self, problem: RigProblem) -> RigProblem:
        """The problem with what is known of antenna and baselines, and with the gauge held that nothing determines."""
        antenna = self.antenna or VectorPrior.from_std(np.zeros(3), np.full(3, _ABOARD_STD_M))
        problem = replace(problem, antenna=replace(problem.antenna, prior=antenna))
        names = [camera.name for camera in problem.cameras]
        known = tuple(
            CameraDistance(names.index(b.first), names.index(b.second), b.distance_m, b.std_m)
            for b in self.baselines
            if b.first in names and b.second in names
        )
        return with_gauge(replace(problem, camera_distances=known))


def _prepared(camera: BundleCamera, prior: PosePrior | None, config: CalibrateConfig) -> BundleCamera:
    free: set[CameraParameter] = set(camera.free)
    if not config.time_offsets:
        free.discard("time_offset")
    delay = config.line_delay_s.get(camera.name, 0.0)
    if config.estimate_line_delay and camera.name in config.line_delay_s:
        free.add("line_delay")
    return replace(
        camera,
        free=frozenset(free),
        rig_from_cam_prior=prior or _aboard(camera),
        line_delay_s=delay,
        reference_row_px=0.0,
        time_offset_s=camera.time_offset_s if config.time_offsets else 0.0,
    )


def _aboard(camera: BundleCamera) -> PosePrior | None:
    """All that is known of a camera of which nothing is known: it is on the same vessel."""
    if "rig_from_cam" not in camera.free:
        return None
    mean = SE3(camera.rig_from_cam.rotation, np.zeros(3))
    return PosePrior.in_axes_of_a(mean, np.repeat([np.inf, _ABOARD_STD_M], 3))


def _scaled(first: InitialRig, baselines: tuple[Baseline, ...]) -> InitialRig:
    """Everything in metres, by the ratio of the known to the estimated baselines."""
    cameras, ratios = first.cameras, []
    for baseline in baselines:
        if baseline.first in cameras and baseline.second in cameras:
            a, b = cameras[baseline.first].rig_from_cam, cameras[baseline.second].rig_from_cam
            ratios.append(baseline.distance_m / float(np.linalg.norm(a.translation - b.translation)))
    if not ratios:
        return first
    scale = float(np.median(ratios))

    def grown(x: SE3) -> SE3:
        return SE3(x.rotation, scale * x.translation)

    trajectory: Trajectory = replace(
        first.world_from_rig, world_from_body=grown(first.world_from_rig.world_from_body)
    )
    return replace(
        first,
        world_from_rig=trajectory,
        cameras={name: replace(c, rig_from_cam=grown(c.rig_from_cam)) for name, c in cameras.items()},
        scale_source="baseline",
    )


def load_prior(path: Path | str) -> RigPrior:
    """Read a prior; raises InputError that names what is wrong."""
    path = Path(path)
    content = read_yaml_settings(path)
    unknown = set(content) - {"cameras", "baselines", "antenna"}
    if unknown:
        raise InputError(f"{path}: unknown keys {', '.join(sorted(map(str, unknown)))}.")
    try:
        cameras = {str(name): _camera_prior(entry) for name, entry in (content.get("cameras") or {}).items()}
        baselines = tuple(
            Baseline(str(b["cameras"][0]), str(b["cameras"][1]), float(b["distance_m"]), float(b["std_m"]))
            for b in content.get("baselines") or ()
        )
        antenna = content.get("antenna")
        known = (
            None
            if antenna is None
            else VectorPrior.from_std(_vector(antenna["position_rig_m"], 0.0), _std(antenna["std_m"], 1.0))
        )
    except (KeyError, TypeError, ValueError, IndexError, AttributeError) as error:
        raise InputError(
            f"{path} is no prior: {type(error).__name__}: {error}.",
            remedy="See docs/calibrate.md: cameras.NAME.{rig_from_cam, std}, baselines, antenna.",
        ) from error
    return RigPrior(cameras, baselines, known, {**input_fingerprint(path), "content": dict(content)})


def _camera_prior(entry: Mapping[str, Any]) -> PosePrior:
    transform, std = entry["rig_from_cam"], entry.get("std") or {}
    quat = transform.get("quat_wxyz")
    translation = transform.get("translation_m")
    quat_wxyz = np.array([1.0, 0.0, 0.0, 0.0] if quat is None else quat, dtype=np.float64)
    if quat_wxyz.shape != (4,) or not abs(np.linalg.norm(quat_wxyz) - 1) < _UNIT:
        raise ValueError(f"quat_wxyz must be four numbers of norm 1, not {quat!r}")
    mean = SE3.from_quat_wxyz(quat_wxyz, _vector(translation, 0.0))
    nothing = [None, None, None]
    rotation_std = _std(nothing if quat is None else std.get("rotation_deg", nothing), np.deg2rad(1.0))
    translation_std = _std(nothing if translation is None else std.get("translation_m", nothing), 1.0)
    if translation is not None:
        translation_std = np.where([x is None for x in translation], np.inf, translation_std)
    return PosePrior.in_axes_of_a(mean, np.concatenate([rotation_std, translation_std]))


def _vector(values: Any, otherwise: float) -> Array:
    array = np.array([otherwise if v is None else float(v) for v in (values or [None] * 3)])
    if array.shape != (3,):
        raise ValueError(f"three numbers are wanted, not {values!r}")
    return array


def _std(values: Any, unit: float) -> Array:
    """Standard deviations: null is unknown, 0 is fixed."""
    array = np.array([np.inf if v is None else max(float(v) * unit, _FIXED_STD) for v in values])
    if array.shape != (3,):
        raise ValueError(f"three standard deviations are wanted, not {values!r}")
    return array
