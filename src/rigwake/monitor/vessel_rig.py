"""A calibration made ready for monitoring one recording: checked against it, in the IMU's frame, every number known."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from rigwake._types import Array
from rigwake.calibration import CalibratedCamera, Calibration
from rigwake.errors import InputError, UnobservableError
from rigwake.geometry.se3 import SE3
from rigwake.logbook.vessel_fingerprint import (
    VesselFingerprint,
    fingerprint_of_calibration,
    fingerprint_of_recording,
)
from rigwake.recording import (
    CameraStream,
    GnssStream,
    ImuStream,
    Recording,
    main_gnss,
    main_imu,
    static_transform,
)
from rigwake.rig import Rig, RigCamera

_TOO_FEW = 2


@dataclass(frozen=True, eq=False)
class MonitoredRig:
    """calibration: in the IMU's frame, of the cameras that are monitored. rig: the same, unknown offsets set to zero.

    rig_from_imu: of the calibration's own frame. left_out: cameras that cannot be monitored, and why.
    """

    calibration: Calibration
    rig: Rig
    imu: ImuStream
    gnss: GnssStream | None
    streams: Mapping[str, CameraStream]
    rig_from_imu: SE3
    left_out: Mapping[str, str] = field(default_factory=dict)

    @property
    def places(self) -> dict[str, Array]:
        """(3,) of every camera on the rig."""
        return {name: camera.rig_from_cam.translation for name, camera in self.rig.cameras.items()}


def prepare_rig(calibration: Calibration, recording: Recording, *, is_its_own: bool = False) -> MonitoredRig:
    """Check that the recording is of the calibrated vessel and has what monitoring needs.

    is_its_own: the calibration is of this very recording: lenses may have been refined, and no vessel is mixed up.

    Raises InputError (another vessel, no IMU, a frame that cannot be tied to the IMU), UnobservableError with one
    camera only.
    """
    if not is_its_own:
        require_same_vessel(fingerprint_of_calibration(calibration), fingerprint_of_recording(recording))
    imu, gnss = main_imu(recording), main_gnss(recording)
    if imu is None:
        raise InputError(
            f"{recording.path.name} has no IMU.",
            consequence="Without the rig's turns a camera cannot be tested against them.",
            remedy="Record the IMU, or name it with --topic imu=/TOPIC.",
        )
    if len(imu.timestamps_ns) < 2 or np.any(np.diff(imu.timestamps_ns) <= 0):
        raise InputError(
            f"The clock of {imu.name} stands still or runs back.",
            consequence="Its turns cannot be integrated.",
            remedy="`rigwake inspect` shows the clocks of a recording.",
        )
    rig_from_imu = _rig_from_imu(calibration, recording, imu)
    cameras, streams, left_out = {}, {}, {}
    for name, camera in calibration.cameras.items():
        if not np.isfinite(camera.rig_from_cam.rotation).all():
            left_out[name] = "the calibration does not say where it looks"
            continue
        cameras[name] = _in_imu_frame(camera, rig_from_imu)
        stream = recording.cameras[name]
        streams[name] = replace(stream, model=camera.model or stream.model)
    if len(cameras) < _TOO_FEW:
        raise UnobservableError(
            f"Only {len(cameras)} camera of {recording.path.name} can be monitored.",
            consequence="Nothing tells whether the camera or the IMU moved.",
            remedy="Monitor two cameras or more together.",
        )
    moved = _calibration_in_imu_frame(calibration, cameras, rig_from_imu)
    return MonitoredRig(moved, _known(moved, streams), imu, gnss, streams, rig_from_imu, left_out)


def require_same_vessel(calibrated: VesselFingerprint, recorded: VesselFingerprint) -> None:
    """InputError that names every difference between the vessel of a calibration and that of a recording."""
    differences = calibrated.differences(recorded)
    if differences:
        raise InputError(
            "The recording is not of the calibrated vessel: " + "; ".join(differences) + ".",
            consequence="Nothing was computed.",
            remedy="Give the calibration of this vessel; `rigwake log list` shows what a logbook holds.",
        )


def _rig_from_imu(calibration: Calibration, recording: Recording, imu: ImuStream) -> SE3:
    if calibration.reference in ("imu", imu.name):
        return SE3.identity()
    found = static_transform(recording, calibration.reference, imu.frame_id) if imu.frame_id else None
    if found is None:
        raise InputError(
            f"The calibration is in the frame of {calibration.reference}, and the recording does not say where the IMU "
            "sits on it.",
            consequence="Tracks cannot be tested against the IMU.",
            remedy="Calibrate with --reference imu, or record /tf_static.",
        )
    return found


def _in_imu_frame(camera: CalibratedCamera, rig_from_imu: SE3) -> CalibratedCamera:
    """The camera on the IMU; offsets that are unobservable count as zero, with directions turned along."""
    known = SE3(camera.rig_from_cam.rotation, np.nan_to_num(camera.rig_from_cam.translation))
    back = np.kron(np.eye(2), rig_from_imu.rotation.T)
    unobservable = tuple(replace(d, direction=back @ d.direction) for d in camera.unobservable)
    return replace(
        camera, rig_from_cam=rig_from_imu.inverse() * known, unobservable=unobservable, known_offsets=()
    )


def _calibration_in_imu_frame(
    calibration: Calibration, cameras: dict[str, CalibratedCamera], rig_from_imu: SE3
) -> Calibration:
    names = list(calibration.cameras)
    joint = calibration.joint_covariance
    if joint is not None:
        rows = np.concatenate([6 * names.index(name) + np.arange(6) for name in cameras])
        joint = joint[np.ix_(rows, rows)]
    antenna = calibration.antenna_rig
    if antenna is not None:
        antenna = rig_from_imu.inverse() * np.nan_to_num(antenna)
    return replace(calibration, reference="imu", cameras=cameras, joint_covariance=joint, antenna_rig=antenna)


def _known(calibration: Calibration, streams: Mapping[str, CameraStream]) -> Rig:
    """The rig of numbers alone."""
    cameras = {
        name: RigCamera(
            name,
            SE3(camera.rig_from_cam.rotation, np.nan_to_num(camera.rig_from_cam.translation)),
            streams[name].model,
            camera.time_offset_s or 0.0,
        )
        for name, camera in calibration.cameras.items()
    }
    antenna = calibration.antenna_rig
    place = None if antenna is None else (float(antenna[0]), float(antenna[1]), float(antenna[2]))
    return Rig("imu", cameras, place, SE3.identity())


def camera_axes(rig: Rig, up_rig: Array) -> Array:
    """(C, 3, 3) rows: about each camera's optical axis (level), the vertical, and the axis across both."""
    axes = []
    for camera in rig.cameras.values():
        R = camera.rig_from_cam.rotation
        ahead = R[:, 2] - (R[:, 2] @ up_rig) * up_rig
        if np.linalg.norm(ahead) < 0.2:  # it looks straight up or down
            ahead = R[:, 1] - (R[:, 1] @ up_rig) * up_rig
        ahead = ahead / np.linalg.norm(ahead)
        axes.append(np.stack([ahead, up_rig, np.cross(up_rig, ahead)]))
    return np.stack(axes)


AXIS_WORDS = ("its optical axis", "the vertical", "its transverse axis")
AXIS_REMEDIES = (
    "waves or manoeuvres that roll and pitch the boat, or turns",
    "sailing past structure within some tens of metres",
    "waves or manoeuvres that roll and pitch the boat, or turns",
)
