"""Long watches: half-hour scenarios in the motions that monitoring meets, and the rig in the frame of its IMU."""

from __future__ import annotations

from typing import Any, Literal

import numpy as np

from rigwake.calibration import CalibratedCamera, Calibration
from rigwake.errors import UsageError
from rigwake.geometry.se3 import SE3
from rigwake.rig import Rig, RigCamera
from rigwake.simulation.scenario import Scenario, build_scenario, load_scenario

WatchMotion = Literal["eights", "gentle", "straight", "standstill"]

_HARBOUR: dict[str, Any] = {"layout": "harbour", "size_m": (140, 110), "density": 1.2, "seed": 4}
_BAY: dict[str, Any] = {"layout": "bay", "size_m": (600, 500), "density": 1.0, "seed": 4}
_SCENES: dict[str, dict[str, Any]] = {
    "eights": _HARBOUR,
    "gentle": _BAY,
    "straight": _BAY,
    "standstill": _HARBOUR,
}


def _leg(kind: str, speed_mps: float = 2.0, **numbers: float) -> dict[str, Any]:
    return {"type": kind, "speed_mps": speed_mps, **numbers}


_MANOEUVRES: dict[str, list[dict[str, Any]]] = {
    "eights": [
        _leg("turn", 2.4, rate_deg_s=26, angle_deg=270),
        _leg("straight", 2.4, duration_s=3.0),
        _leg("turn", 2.4, rate_deg_s=-26, angle_deg=270),
        _leg("straight", 2.4, duration_s=3.0),
        _leg("turn", 2.4, rate_deg_s=26, angle_deg=180),  # what one eight drifts, the next takes back
    ],
    "gentle": [
        _leg("turn", rate_deg_s=4, angle_deg=60),
        _leg("straight", duration_s=20),
        _leg("turn", rate_deg_s=-4, angle_deg=60),
        _leg("straight", duration_s=20),
        _leg("turn", rate_deg_s=4, angle_deg=240),
        _leg("straight", duration_s=10),
    ],
    # there and back, with a wide turn at either end
    "straight": [
        _leg("straight", duration_s=100),
        _leg("turn", rate_deg_s=6, angle_deg=180),
        _leg("straight", duration_s=100),
        _leg("turn", rate_deg_s=6, angle_deg=180),
    ],
    "standstill": [{"type": "standstill", "duration_s": 60}],
}


def watch_scenario(
    motion: WatchMotion, duration_s: float, seed: int, *, hs_m: float = 0.25, cameras: int = 4
) -> Scenario:
    """The demo's catamaran with its first cameras, for a while, in a motion; UsageError for an unknown one."""
    if motion not in _SCENES:
        raise UsageError(f"No motion {motion!r}.", remedy=f"Choose from {', '.join(_SCENES)}.")
    base = load_scenario("demo").model_dump()
    base |= {"name": "watch", "duration_s": duration_s, "seed": seed, "scene": _SCENES[motion]}
    base["sea"]["hs_m"] = hs_m
    base["vessel"]["manoeuvres"] = _MANOEUVRES[motion]
    base["cameras"] = base["cameras"][:cameras]
    return build_scenario(base)


def rig_in_imu_frame(rig: Rig) -> Rig:
    """The same rig, whose frame is now that of its IMU."""
    if rig.rig_from_imu is None:
        raise UsageError("This rig has no IMU.")
    imu_from_rig = rig.rig_from_imu.inverse()
    antenna = None if rig.antenna_rig is None else imu_from_rig * np.array(rig.antenna_rig)
    cameras = {
        name: RigCamera(name, imu_from_rig * c.rig_from_cam, c.model, c.time_offset_s, c.topic)
        for name, c in rig.cameras.items()
    }
    place = None if antenna is None else (float(antenna[0]), float(antenna[1]), float(antenna[2]))
    return Rig("imu", cameras, place, SE3.identity())


def calibration_of(
    rig: Rig, *, std_deg: float = 0.01, std_m: float = 0.005, seed: int | None = None
) -> Calibration:
    """A calibration of a known rig with errors of these sizes, and covariances that say so; exact without seed."""
    rng = None if seed is None else np.random.default_rng(seed)
    std = np.concatenate([np.full(3, np.deg2rad(std_deg)), np.full(3, std_m)])
    cameras = {}
    for name, camera in rig.cameras.items():
        error = np.zeros(6) if rng is None else rng.standard_normal(6) * std
        cameras[name] = CalibratedCamera(
            name,
            camera.rig_from_cam.retract(error),
            np.diag(std**2),
            time_offset_s=camera.time_offset_s,
            time_offset_std_s=5e-4,
            model=camera.model,
            topic=camera.topic,
        )
    antenna = None if rig.antenna_rig is None else np.array(rig.antenna_rig)
    return Calibration(rig.reference, cameras, antenna_rig=antenna)
