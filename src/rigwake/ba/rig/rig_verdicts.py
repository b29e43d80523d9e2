"""From an adjusted rig to calibrated cameras: seen from the wanted reference, with uncertainty and verdicts."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from rigwake._types import Array
from rigwake.ba.solver.covariance import RigCovariance
from rigwake.ba.solver.rig_problem import BundleCamera, RigSolution
from rigwake.calibration import CalibratedCamera, Calibration
from rigwake.calibration.rig_calibration import UnobservableDirection
from rigwake.errors import UnobservableError, UsageError
from rigwake.geometry import so3
from rigwake.geometry.se3 import SE3, covariance_in_axes_of_a
from rigwake.handeye.likelihood import USEFUL_ROTATION, USEFUL_TRANSLATION
from rigwake.handeye.observability import unobservable_directions

_OPEN_ROTATION, _OPEN_TRANSLATION = np.deg2rad(50.0), 10.0  # stands for "not at all" in a covariance
_CANCELLED = 1e-4  # shares below this are what directions known to 1e-5 leave of a difference
_GIVE_SCALE = "Give a scale: an IMU, GNSS, a known baseline (--prior), or metric --trajectories."


@dataclass(frozen=True, eq=False)
class ReferenceFrame:
    """The frame that the cameras are reported in.

    name: `imu`, `base_link` or a camera's. reference_from_rig: exact, for a frame known to sit on the rig; None
    when the reference is one of the cameras, whose own uncertainty then counts. is_metric: whether anything gave a
    scale.
    """

    name: str
    reference_from_rig: SE3 | None
    is_metric: bool = True


def calibrated_cameras(
    solution: RigSolution,
    covariance: RigCovariance,
    reference: ReferenceFrame,
    statistics: Mapping[str, Mapping[str, Any]],
    topics: Mapping[str, str],
) -> Calibration:
    """The rig as seen from the reference, with joint covariance, verdicts per axis, clocks and lever arm.

    Directions that nothing determines, or only so badly that a figure is as good as none (over 5 deg or 1 m),
    are marked; see `handeye.observability`.
    """
    cameras = {camera.name: camera for camera in solution.problem.cameras}
    if reference.reference_from_rig is None and reference.name not in cameras:
        raise UsageError(
            f"There is no frame {reference.name!r} to refer to.",
            remedy=f"Choose imu, base_link or one of: {', '.join(cameras)}.",
        )
    others = [name for name in cameras if name != reference.name]
    if not others:
        raise UnobservableError(
            f"Of all cameras only {reference.name} is left, the one that the others were to be seen from.",
            consequence="There is nothing to calibrate.",
            remedy="Use an IMU or GNSS, or see to it that the other cameras' motion can be estimated.",
        )
    mounted = {name: _seen_from(reference, cameras, name) for name in others}
    rows = np.concatenate([_rows(covariance, reference, cameras, mounted, name) for name in others])
    joint = _with_unobservable_directions(covariance, rows)
    rotations = _rotation_vectors(solution.problem.states.world_from_rig)
    found: dict[str, CalibratedCamera] = {}
    for index, name in enumerate(others):
        block = joint[6 * index : 6 * index + 6, 6 * index : 6 * index + 6]
        offset, offset_std = _time_offset(covariance, cameras[name])
        found[name] = CalibratedCamera(
            name=name,
            rig_from_cam=mounted[name],
            covariance=block,
            unobservable=_unobservable(reference, name, mounted[name], block, rotations),
            time_offset_s=offset,
            time_offset_std_s=offset_std,
            model=cameras[name].model,
            topic=topics.get(name, ""),
            statistics=statistics.get(name, {}),
        )
    if reference.name in cameras:
        found = {reference.name: _the_reference_itself(cameras[reference.name], statistics, topics), **found}
        joint = np.block([[np.zeros((6, 6)), np.zeros((6, len(joint)))], [np.zeros((len(joint), 6)), joint]])
    antenna, antenna_covariance = _antenna(solution, covariance, reference)
    return Calibration(reference.name, found, joint, antenna, antenna_covariance)


def _unobservable(
    reference: ReferenceFrame, name: str, reference_from_cam: SE3, covariance: Array, rotations: Array
) -> tuple[UnobservableDirection, ...]:
    """What the motion leaves open, and every offset where nothing gave a scale."""
    found = unobservable_directions(reference.name, name, reference_from_cam, covariance, rotations)
    if not reference.is_metric:
        turning = tuple(direction for direction in found if np.any(direction.direction[:3]))
        return turning + tuple(
            UnobservableDirection(
                axis, f"{_axis_words(axis, name, reference)}, for want of a scale", _GIVE_SCALE
            )
            for axis in np.eye(6)[3:]
        )
    return found + _drawn_along(found, reference, name, reference_from_cam, covariance)


def _drawn_along(
    found: tuple[UnobservableDirection, ...],
    reference: ReferenceFrame,
    name: str,
    reference_from_cam: SE3,
    covariance: Array,
) -> tuple[UnobservableDirection, ...]:
    """Axes that an open direction hardly touches, and yet by more than makes a figure useless: it is that open."""
    units = np.repeat([USEFUL_ROTATION, USEFUL_TRANSLATION], 3)
    stds = np.sqrt(np.diag(covariance_in_axes_of_a(reference_from_cam, covariance))) / units
    named = np.any([direction.direction != 0 for direction in found], axis=0) if found else np.zeros(6, bool)
    return tuple(
        UnobservableDirection(axis, _axis_words(axis, name, reference), found[0].remedy if found else "")
        for axis in np.eye(6)[(stds > 1.0) & ~named]
    )


def _axis_words(axis: Array, name: str, reference: ReferenceFrame) -> str:
    k = int(axis.argmax())
    kind = "rotation about" if k < 3 else "offset along"
    return f"{name}: {kind} {'xyz'[k % 3]} of {reference.name}"


def _the_reference_itself(
    camera: BundleCamera, statistics: Mapping[str, Mapping[str, Any]], topics: Mapping[str, str]
) -> CalibratedCamera:
    return CalibratedCamera(
        camera.name,
        SE3.identity(),
        np.zeros((6, 6)),
        time_offset_s=0.0,
        model=camera.model,
        topic=topics.get(camera.name, ""),
        statistics=statistics.get(camera.name, {}),
    )


def _seen_from(reference: ReferenceFrame, cameras: Mapping[str, BundleCamera], name: str) -> SE3:
    if reference.reference_from_rig is not None:
        return reference.reference_from_rig * cameras[name].rig_from_cam
    return cameras[reference.name].rig_from_cam.inverse() * cameras[name].rig_from_cam


def _free_rows(covariance: RigCovariance, camera: BundleCamera) -> Array:
    """(6, k) rows that select the camera's right tangent; zero for a camera that is held."""
    if "rig_from_cam" in camera.free:
        return covariance.rows_of(camera.name, "rig_from_cam")
    return np.zeros((6, len(covariance.scale)))


def _rows(
    covariance: RigCovariance,
    reference: ReferenceFrame,
    cameras: Mapping[str, BundleCamera],
    mounted: Mapping[str, SE3],
    name: str,
) -> Array:
    """(6, k) rows of the right tangent of `reference_from_cam`.

    With a camera as reference, `X = X_ref^-1 X_cam` gives `d = d_cam - Ad(X^-1) d_ref`.
    """
    rows = _free_rows(covariance, cameras[name])
    if reference.reference_from_rig is None:
        rows = rows - mounted[name].inverse().adjoint() @ _free_rows(covariance, cameras[reference.name])
    return rows


def _with_unobservable_directions(covariance: RigCovariance, rows: Array) -> Array:
    """Covariance of `rows @ parameters` in which unobservable directions have a size as good as none."""
    half = covariance.spread(rows)
    joint = half @ half.T
    lost = rows @ covariance.unobservable.T
    if lost.shape[1]:
        units = np.tile(np.repeat([_OPEN_ROTATION, _OPEN_TRANSLATION], 3), len(rows) // 6)
        # an open direction that all cameras share does not touch one as seen from another: what is left is rounding
        sizes = np.linalg.norm(lost / units[:, None], axis=0)
        without_cancelling = np.abs(rows) @ np.abs(covariance.unobservable.T) / units[:, None]
        touched = sizes > _CANCELLED * np.linalg.norm(without_cancelling, axis=0)
        # nor does one that lies elsewhere, as in the antenna alone
        lost = lost[:, touched & covariance.touched(rows).any(axis=0)]
        lost = lost / np.maximum(np.abs(lost / units[:, None]).max(axis=0), 1e-12)
        joint = joint + lost @ lost.T
    return np.asarray(joint)


def _rotation_vectors(world_from_rig: SE3) -> Array:
    """(N - 1, 3) rotation vectors between neighbouring states."""
    R = world_from_rig.rotation
    return so3.log(np.swapaxes(R[:-1], 1, 2) @ R[1:])


def _time_offset(covariance: RigCovariance, camera: BundleCamera) -> tuple[float | None, float | None]:
    if "time_offset" not in camera.free:
        return None, None
    spread, known = covariance.parameter(camera.name, "time_offset")
    if not known.all() or spread[0, 0] > 0.1**2:
        return None, None
    return camera.time_offset_s, float(np.sqrt(spread[0, 0]))


def _antenna(
    solution: RigSolution, covariance: RigCovariance, reference: ReferenceFrame
) -> tuple[Array | None, Array | None]:
    """The lever arm in the reference frame where it was estimated and is determined."""
    antenna = solution.problem.antenna
    if solution.problem.gnss is None or not antenna.free or reference.reference_from_rig is None:
        return None, None
    spread, known = covariance.parameter("antenna", "position_rig")
    if not known.all() or np.diag(spread).max() > 1.0:
        return None, None
    R = reference.reference_from_rig.rotation
    return reference.reference_from_rig * antenna.position_rig, np.asarray(R @ spread @ R.T)
