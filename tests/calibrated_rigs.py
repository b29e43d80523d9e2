"""Calibrations for tests of what is made of them."""

import numpy as np

from rigwake.calibration import CalibratedCamera, Calibration, UnobservableDirection
from rigwake.cameras.protocol import CameraModel
from rigwake.cameras.registry import camera_from_params
from rigwake.geometry.se3 import SE3

FISHEYE = camera_from_params("kb4", [200.4, 201.4, 322.6, 236.9, -0.0115, 0.0062, -0.0034, 0.0005], 640, 480)
PINHOLE = camera_from_params("pinhole", [500.0, 501, 318, 243, 0, -0.2, 0.08, 0.001, 0.002, 0], 640, 480)
VERTICAL = np.eye(6)[5]
STD = np.array([2e-4, 3e-4, 4e-4, 0.004, 0.006, 0.011])


def optical(yaw_deg: float, pitch_deg: float, position: tuple[float, float, float]) -> SE3:
    """A camera on a vessel that looks `yaw_deg` to port of the bow and `pitch_deg` down."""
    yaw, pitch = np.deg2rad([yaw_deg, pitch_deg])
    bow_from_cam = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])
    turn = SE3.exp(np.array([0, 0, yaw, 0, 0, 0])) * SE3.exp(np.array([0, pitch, 0, 0, 0, 0]))
    return SE3(turn.rotation @ bow_from_cam, np.array(position))


def camera(name: str, rig_from_cam: SE3, lens: CameraModel | None = FISHEYE, **fields) -> CalibratedCamera:
    fields = {
        "time_offset_s": 0.0121,
        "time_offset_std_s": 2e-4,
        "topic": f"/cameras/{name}/image_raw",
    } | fields
    return CalibratedCamera(name, rig_from_cam, np.diag(STD**2), model=lens, **fields)


def boat(reference: str = "imu", lens: CameraModel | None = FISHEYE, **fields) -> Calibration:
    """Four cameras around a vessel of five metres."""
    places = {
        "front": optical(0, 12, (1.62, 0.04, 1.31)),
        "port": optical(88, 15, (0.41, 0.83, 1.22)),
        "starboard": optical(-91, 14, (0.38, -0.85, 1.24)),
        "aft": optical(178, 10, (-1.9, 0.02, 1.18)),
    }
    return Calibration(reference, {n: camera(n, x, lens) for n, x in places.items()}, **fields)


def without_vertical(calibration: Calibration, name: str) -> Calibration:
    """The same, but the motion left the vertical offset of one camera open."""
    lost = UnobservableDirection(VERTICAL, f"vertical offset of {name}", "record where waves roll the boat")
    old = calibration.cameras[name]
    changed = CalibratedCamera(
        name,
        old.rig_from_cam,
        old.covariance,
        (lost,),
        model=old.model,
        topic=old.topic,
        time_offset_s=old.time_offset_s,
    )
    return Calibration(calibration.reference, {**calibration.cameras, name: changed})
