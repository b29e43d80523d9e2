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
from rigwake.monitor.run import MonitorResult, refined_step
from rigwake.monitor.score import BlockScores
from rigwake.monitor.states import CameraState

_FEWEST_BLOCKS = 2
_LARGEST_STD_DEG = 0.1


@dataclass(frozen=True, eq=False)
class Recalibration:
    """calibration: the new one. camera: whose. rotation: (3,) rad in rig axes and covariance (3, 3), against the old.

    blocks: how many were used. The place of the camera is kept.
    """

    calibration: Calibration
    camera: str
    rotation: Array
    covariance: Array
    blocks: int


def recalibrate(calibration: Calibration, result: MonitorResult) -> Recalibration:
    """Measure the blamed camera's rotation from the blocks since it moved, all other cameras held.

    result: of `monitor` with this calibration. Raises UsageError where no camera, or more than one, is blamed, or the
    change goes on (ramp); UnobservableError where the rest of the recording does not show the rotation well enough.
    """
    name = _blamed(result)
    verdict = result.verdicts[name]
    assert verdict.alarm is not None
    assert verdict.alarm.change is not None
    scores = result.judgement.scores
    first = verdict.alarm.change.block + (1 if verdict.alarm.change.block > 0 else 0)
    starts = scores.starts_ns[first:]
    if len(starts) < _FEWEST_BLOCKS:
        raise UnobservableError(
            f"Only {len(starts)} whole block of ten seconds was recorded since {name} moved.",
            consequence="Its new mounting was not measured.",
            remedy="Record half a minute or more, and run `rigwake recalibrate` on that.",
        )
    monitored = result.monitored
    rotation, noise, at_new = refined_step(
        result.tracks, monitored.rig, result.motion, name, verdict.alarm.change.rotation, starts
    )
    covariance = noise + _from_others(at_new, name, result)
    std = float(np.rad2deg(np.sqrt(np.linalg.eigvalsh(covariance)[-1])))
    if not np.isfinite(std) or std > _LARGEST_STD_DEG:
        raise UnobservableError(
            f"The rest of the recording shows the new rotation of {name} to {std:.2f} deg only.",
            consequence="No new calibration was made.",
            remedy="Record turns to both sides near structure, and run `rigwake recalibrate` on that.",
        )
    back = monitored.rig_from_imu.rotation
    in_rig, covariance = back @ rotation, back @ covariance @ back.T
    camera = _turned(calibration.cameras[name], in_rig, covariance)
    new = replace(
        calibration,
        cameras={**calibration.cameras, name: camera},
        joint_covariance=_joint(calibration, name, camera),
        provenance={
            **calibration.provenance,
            "recalibrated": {
                "camera": name,
                "rotation_rig_deg": np.rad2deg(in_rig).tolist(),
                "since_ns": verdict.since_ns,
                "blocks": len(starts),
            },
        },
    )
    return Recalibration(new, name, in_rig, covariance, len(starts))


def _blamed(result: MonitorResult) -> str:
    """The one camera that the monitor blames for a step."""
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
    if result.verdicts[blamed[0]].alarm is None:
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
    return blamed[0]


def _from_others(scores: BlockScores, name: str, result: MonitorResult) -> Array:
    """(3, 3): what the covariances of the held cameras, and of the camera's own place and clock, leave open."""
    k = scores.cameras.index(name)
    at = scores.columns(k)
    H = scores.H.sum(axis=0)
    belief = belief_of(result.monitored.calibration, scores.cameras, result.thresholds).covariance.copy()
    belief[at, :], belief[:, at] = 0.0, 0.0
    gain = np.linalg.pinv(H[at, at], rcond=1e-9, hermitian=True) @ H[at]
    return np.asarray(gain @ belief @ gain.T)


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
