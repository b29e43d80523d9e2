"""A new mounting for the camera that moved; everything else stays as it was, to the bit."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from rigwake._types import Array
from rigwake.calibration import CalibratedCamera, Calibration
from rigwake.errors import EstimationError, UnobservableError, UsageError
from rigwake.geometry import so3
from rigwake.geometry.se3 import SE3
from rigwake.monitor.innovations import belief_of
from rigwake.monitor.judge import Alarm
from rigwake.monitor.run import MonitorResult, refined_step
from rigwake.monitor.score import BlockScores
from rigwake.monitor.states import CameraState

_FEWEST_BLOCKS = 2
_LARGEST_STD_DEG = 0.1
_SEEN_PLACE_M, _LARGEST_SHIFT_M = 0.01, 0.3  # standard deviation; more is no camera that slipped on its mount


@dataclass(frozen=True, eq=False)
class Recalibration:
    """calibration: the new one. camera: whose. rotation: (3,) rad in rig axes and covariance (3, 3), against the old.

    blocks: how many were used, from since_ns on. shift: (3,) m in rig axes, of its place; zero where none is sure.
    """

    calibration: Calibration
    camera: str
    rotation: Array
    covariance: Array
    blocks: int
    shift: Array
    since_ns: int


@dataclass(frozen=True, eq=False)
class _Shift:
    """How a camera's place changed along the directions (3, k) in which the motion shows it: (3,) m in rig axes with
    covariance (3, 3), and what it turned besides, (3,) rad with covariance (3, 3)."""

    directions: Array
    shift: Array
    covariance: Array
    rotation: Array
    rotation_covariance: Array


def recalibrate(calibration: Calibration, result: MonitorResult) -> Recalibration:
    """Measure the blamed camera's rotation from the blocks since it moved, all other cameras held.

    Its place, too, along directions that the motion shows to a centimetre, if it is surely elsewhere; else it stays.
    result: of `monitor` with this calibration. Raises UsageError where no camera, or more than one, is blamed, or the
    change goes on (ramp); UnobservableError where the rest of the recording does not show the rotation well enough, or
    not where a camera is that shifted.
    """
    name, alarm = _measured_camera(result)
    begin, turned = (
        (alarm.since, np.zeros(3)) if alarm.change is None else (alarm.change.block, alarm.change.rotation)
    )
    starts = result.judgement.scores.starts_ns[begin + (1 if begin > 0 else 0) :]
    if len(starts) < _FEWEST_BLOCKS:
        raise UnobservableError(
            f"Only {len(starts)} whole block of ten seconds was recorded since {name} moved.",
            consequence="Its new mounting was not measured.",
            remedy="Record half a minute or more, and run `rigwake recalibrate` on that.",
        )
    monitored = result.monitored
    rotation, noise, at_new = refined_step(result.tracks, monitored.rig, result.motion, name, turned, starts)
    covariance = noise + _from_others(at_new, name, result)
    moved = _shift(at_new, name, result)
    if moved is None and alarm.change is None:
        raise UnobservableError(
            f"{name} shifted, and the rest of the recording does not show to where.",
            consequence="A rotation in place of the shift would be wrong: no new calibration was made.",
            remedy="Record turns to both sides within 15 m of structure, and run `rigwake recalibrate` on that.",
        )
    if moved is not None:
        rotation = so3.log(so3.exp(moved.rotation) @ so3.exp(rotation))
        covariance = moved.rotation_covariance
    std = float(np.rad2deg(np.sqrt(np.linalg.eigvalsh(covariance)[-1])))
    if not np.isfinite(std) or std > _LARGEST_STD_DEG:
        raise UnobservableError(
            f"The rest of the recording shows the new rotation of {name} to {std:.2f} deg only.",
            consequence="No new calibration was made.",
            remedy="Record turns to both sides near structure, and run `rigwake recalibrate` on that.",
        )
    back = monitored.rig_from_imu.rotation
    since_ns = int(result.judgement.scores.starts_ns[begin])
    in_rig, covariance = back @ rotation, back @ covariance @ back.T
    camera = _turned(calibration.cameras[name], in_rig, covariance)
    shift = np.zeros(3)
    if moved is not None:
        camera, shift = _shifted(camera, moved, back), back @ moved.shift
    new = replace(
        calibration,
        cameras={**calibration.cameras, name: camera},
        joint_covariance=_joint(calibration, name, camera),
        provenance={
            **calibration.provenance,
            "recalibrated": {
                "camera": name,
                "rotation_rig_deg": np.rad2deg(in_rig).tolist(),
                "shift_rig_m": shift.tolist(),
                "since_ns": since_ns,
                "blocks": len(starts),
            },
        },
    )
    return Recalibration(new, name, in_rig, covariance, len(starts), shift, since_ns)


def camera_to_measure(result: MonitorResult) -> str:
    """The one camera that turned or shifted. Raises as `recalibrate` where there is no such one."""
    return _measured_camera(result)[0]


def _measured_camera(result: MonitorResult) -> tuple[str, Alarm]:
    return _shifted_camera(result) or _blamed(result)


def _shifted_camera(result: MonitorResult) -> tuple[str, Alarm] | None:
    """The camera whose shift explains the only alarm, if that is what happened."""
    alarms = result.judgement.alarms
    if len(alarms) != 1 or alarms[0].explanations[0].cause != "translation":
        return None
    return alarms[0].explanations[0].camera, alarms[0]


def _blamed(result: MonitorResult) -> tuple[str, Alarm]:
    """The one camera that the monitor blames for a step, and its alarm."""
    blamed = result.blamed
    suspects = [n for n, v in result.verdicts.items() if v.state is CameraState.SUSPECT]
    if len(blamed) != 1:
        what = "No camera" if not blamed else f"More than one camera ({', '.join(blamed)})"
        hint = f" {', '.join(suspects)} is suspect: {result.verdicts[suspects[0]].words}." if suspects else ""
        raise UsageError(
            f"{what} is blamed by the monitor.{hint}",
            consequence="No new calibration was made.",
            remedy="`rigwake calibrate` measures the whole rig anew."
            if blamed
            else "`rigwake monitor` shows why.",
        )
    alarm = result.verdicts[blamed[0]].alarm
    if alarm is None:
        raise UnobservableError(
            f"Only the own hull in the picture shows that {blamed[0]} moved; the motion does not.",
            consequence="A shift of some millimetres looks like a rotation there: no new calibration was made.",
            remedy="Record turns to both sides near structure, and run `rigwake recalibrate` on that.",
        )
    if result.verdicts[blamed[0]].kind == "ramp":
        raise EstimationError(
            f"{blamed[0]} is still turning ({result.verdicts[blamed[0]].rate_deg_per_hour:.2f} deg per hour).",
            consequence="A new mounting would be wrong when it is written.",
            remedy="Fasten the camera, record again, and run `rigwake recalibrate` on that.",
        )
    return blamed[0], alarm


def _from_others(scores: BlockScores, name: str, result: MonitorResult) -> Array:
    """(3, 3): what the covariances of the held cameras, and of the camera's own place and clock, leave open."""
    k = scores.cameras.index(name)
    at = scores.columns(k)
    H = scores.H.sum(axis=0)
    belief = belief_of(result.monitored.calibration, scores.cameras, result.thresholds).covariance.copy()
    belief[at, :], belief[:, at] = 0.0, 0.0
    gain = np.linalg.pinv(H[at, at], rcond=1e-9, hermitian=True) @ H[at]
    return np.asarray(gain @ belief @ gain.T)


def _shift(scores: BlockScores, name: str, result: MonitorResult) -> _Shift | None:
    """Where the place surely changed; None where it is within what the motion tells, or the motion tells nothing."""
    k = scores.cameras.index(name)
    at = slice(scores.columns(k).start, scores.columns(k).start + 6)
    whole = scores.H.sum(axis=0)
    H, g = whole[at, at], scores.g[:, at].sum(axis=0)
    noise = np.einsum("bij,b->ij", scores.H[:, at, at], scores.inflation[:, k])
    belief = belief_of(result.monitored.calibration, scores.cameras, result.thresholds).covariance.copy()
    belief[at, :], belief[:, at] = 0.0, 0.0
    spread = noise + whole[at] @ belief @ whole[at].T
    inverse = np.linalg.pinv(H, rcond=1e-12, hermitian=True)
    values, vectors = np.linalg.eigh((inverse @ spread @ inverse)[3:, 3:])
    seen = (values < _SEEN_PLACE_M**2) & (values > 0)
    if not seen.any():
        return None
    basis = np.zeros((6, 3 + int(seen.sum())))  # the rotation, and the place along what is seen
    basis[:3, :3], basis[3:, 3:] = np.eye(3), vectors[:, seen]
    inverse = np.linalg.inv(basis.T @ H @ basis)
    covariance = inverse @ (basis.T @ spread @ basis) @ inverse
    change = inverse @ (basis.T @ g)
    along = change[3:]
    sure = along @ np.linalg.solve(covariance[3:, 3:], along) >= result.thresholds.alarm
    if not sure or np.linalg.norm(along) > _LARGEST_SHIFT_M:
        return None
    directions = vectors[:, seen]
    place = directions @ covariance[3:, 3:] @ directions.T
    return _Shift(directions, directions @ along, place, change[:3], covariance[:3, :3])


def _shifted(camera: CalibratedCamera, moved: _Shift, back: Array) -> CalibratedCamera:
    """The camera at its new place. back: (3, 3), from the IMU's axes to the rig's."""
    R = camera.rig_from_cam.rotation
    rest = np.eye(3) - back @ moved.directions @ moved.directions.T @ back.T
    own = camera.covariance.copy()
    kept = rest @ R @ own[3:, 3:] @ R.T @ rest
    own[3:, 3:] = R.T @ (kept + back @ moved.covariance @ back.T) @ R
    place = camera.rig_from_cam.translation + back @ moved.shift
    return replace(camera, rig_from_cam=SE3(R, place), covariance=own)


def _turned(camera: CalibratedCamera, rotation: Array, covariance: Array) -> CalibratedCamera:
    """The camera with its new rotation; the place and what is known of it stay."""
    R = so3.exp(rotation) @ camera.rig_from_cam.rotation
    own = camera.covariance.copy()
    # place: right tangent, in the camera's axes; the same point with the same uncertainty, told in turned axes
    old_from_new = camera.rig_from_cam.rotation.T @ R
    own[3:, 3:] = old_from_new.T @ own[3:, 3:] @ old_from_new
    own[:3, :3] = R.T @ covariance @ R
    own[:3, 3:], own[3:, :3] = 0.0, 0.0
    return replace(
        camera, rig_from_cam=SE3(R, camera.rig_from_cam.translation), covariance=own, statistics={}
    )


def _joint(calibration: Calibration, name: str, camera: CalibratedCamera) -> Array | None:
    joint = calibration.joint_covariance
    if joint is None:
        return None
    joint = joint.copy()
    at = 6 * list(calibration.cameras).index(name)
    joint[at : at + 6, :], joint[:, at : at + 6] = 0.0, 0.0
    joint[at : at + 6, at : at + 6] = camera.covariance
    return joint
