"""The rig, its motion and its pictures in the rerun viewer (optional extra `rerun`)."""

from __future__ import annotations

import os
import sys
from pathlib import Path
from typing import Any

import numpy as np

from rigwake.errors import UsageError
from rigwake.geometry.se3 import SE3
from rigwake.report.content import RIG_TRAJECTORY, ReportContent
from rigwake.report.motion_figures import thin

# as in the report's own charts
_COLOURS = (
    (0, 114, 178),
    (213, 94, 0),
    (0, 158, 115),
    (204, 121, 167),
    (86, 180, 233),
    (230, 159, 0),
    (143, 132, 0),
    (77, 77, 77),
)
_SIGMAS_DRAWN = 20  # as the report's slider at first: true sizes would hardly be seen


def log_to_rerun(content: ReportContent, rrd: Path | None, view: bool) -> None:
    """Write an `.rrd` file, show it in the viewer, or both.

    Raises UsageError if rerun is not installed, or if the viewer cannot start.
    """
    try:
        import rerun
    except ImportError as error:
        raise UsageError(
            "The rerun viewer is not installed.", remedy="pip install 'rigwake[rerun]', then run this again."
        ) from error
    if rrd is not None:
        rrd.parent.mkdir(parents=True, exist_ok=True)
        stream = rerun.RecordingStream("rigwake")
        stream.save(rrd)
        _log(rerun, stream, content)
    if view:
        stream = rerun.RecordingStream("rigwake")
        _show(rerun, stream, content)


def _show(rerun: Any, stream: Any, content: ReportContent) -> None:
    """Start the viewer, which pip puts beside the interpreter, where the PATH need not lead."""
    remedy = "Write a file with --rrd rig.rrd, and open it where there is a display: rerun rig.rrd"
    if sys.platform == "linux" and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
        raise UsageError("There is no display for the rerun viewer.", remedy=remedy)
    beside = str(Path(sys.executable).parent)
    os.environ["PATH"] = os.pathsep.join([beside, os.environ.get("PATH", "")])
    try:
        stream.spawn()
        _log(rerun, stream, content)
    except RuntimeError as error:
        reason = str(error).strip().partition("\n")[0]
        raise UsageError(f"The rerun viewer did not start: {reason}", remedy=remedy) from error


def _log(rerun: Any, stream: Any, content: ReportContent) -> None:
    stream.log("world", rerun.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    _log_cameras(rerun, stream, content)
    _log_motion(rerun, stream, content)
    _log_landmarks(rerun, stream, content)
    _log_sigmas(rerun, stream, content)
    _log_residuals(rerun, stream, content)
    _log_pictures(rerun, stream, content)
    stream.flush()


def _transform(rerun: Any, parent_from_child: SE3) -> Any:
    w, x, y, z = parent_from_child.quat_wxyz.tolist()
    return rerun.Transform3D(
        translation=parent_from_child.translation.tolist(), quaternion=rerun.Quaternion(xyzw=[x, y, z, w])
    )


def _log_cameras(rerun: Any, stream: Any, content: ReportContent) -> None:
    """Cameras that are fully determined; a partly known transform has no place in a tree of transforms."""
    for name, camera in content.calibration.cameras.items():
        if not camera.is_observable:
            words = ", ".join(d.words for d in camera.unobservable)
            stream.log(f"world/rig/{name}", rerun.TextLog(f"unobservable: {words}"), static=True)
            continue
        stream.log(f"world/rig/{name}", _transform(rerun, camera.rig_from_cam), static=True)
        if camera.model is not None:
            size = camera.model.width_px, camera.model.height_px
            focal = 0.5 * size[0]  # a frustum to look at: the viewer knows pinholes only
            pinhole = rerun.Pinhole(
                focal_length=focal, width=size[0], height=size[1], camera_xyz=rerun.ViewCoordinates.RDF
            )
            stream.log(f"world/rig/{name}/image", pinhole, static=True)


def _log_motion(rerun: Any, stream: Any, content: ReportContent) -> None:
    rig = content.trajectories.get(RIG_TRAJECTORY)
    if rig is None:
        return
    path = rig.world_from_body.translation[thin(len(rig))]
    stream.log("world/path", rerun.LineStrips3D([path]), static=True)
    for k in thin(len(rig), 3000).tolist():
        stream.set_time("time", timestamp=np.datetime64(int(rig.timestamps_ns[k]), "ns"))
        stream.log("world/rig", _transform(rerun, rig.world_from_body[k]))


def _log_landmarks(rerun: Any, stream: Any, content: ReportContent) -> None:
    """Landmarks of the adjustment, in colours by the camera that saw each first."""
    cloud = content.adjustment.landmarks
    if cloud is None:
        return
    names = list(content.calibration.cameras)
    places = [names.index(name) if name in names else len(_COLOURS) - 1 for name in cloud.cameras]
    colours = [_COLOURS[place % len(_COLOURS)] for place in places]
    stream.log("world/landmarks", rerun.Points3D(cloud.points_world, colors=colours, radii=0.05), static=True)


def _log_sigmas(rerun: Any, stream: Any, content: ReportContent) -> None:
    """Per camera an ellipsoid of its position, as many sigmas large as the report's; only where every axis is known."""
    for name, camera in content.calibration.cameras.items():
        covariance = camera.covariance_rig_axes[3:, 3:]
        if not camera.is_observable or not np.isfinite(covariance).all():
            continue
        variances, axes = np.linalg.eigh(covariance)
        axes[:, 2] *= np.sign(np.linalg.det(axes))
        w, x, y, z = SE3(axes, np.zeros(3)).quat_wxyz.tolist()
        drawn = rerun.Ellipsoids3D(
            half_sizes=[_SIGMAS_DRAWN * np.sqrt(np.maximum(variances, 0.0))],
            centers=[camera.rig_from_cam.translation],
            quaternions=[rerun.Quaternion(xyzw=[x, y, z, w])],
            labels=[f"{name}, {_SIGMAS_DRAWN} sigma"],
        )
        stream.log(f"world/rig/sigma/{name}", drawn, static=True)


def _log_residuals(rerun: Any, stream: Any, content: ReportContent) -> None:
    """Median reprojection error over time, a curve per camera."""
    rig = content.trajectories.get(RIG_TRAJECTORY)
    if rig is None:
        return
    for name, residuals in content.residuals.items():
        curve = residuals.over_time
        for at_s, median in zip(curve.at.tolist(), curve.median.tolist(), strict=True):
            if np.isfinite(median):
                stamp = int(rig.timestamps_ns[0]) + round(at_s * 1e9)
                stream.set_time("time", timestamp=np.datetime64(stamp, "ns"))
                stream.log(f"residuals_px/{name}", rerun.Scalars(median))


def _log_pictures(rerun: Any, stream: Any, content: ReportContent) -> None:
    """The pictures of the report in the frustum of their camera; landmarks where they are and where they must be."""
    for shown in content.pictures:
        if not shown.file.is_file() or shown.kind == "patches":
            continue
        stream.set_time("time", timestamp=np.datetime64(shown.timestamp_ns, "ns"))
        place = f"world/rig/{shown.camera}/image"
        stream.log(place, rerun.EncodedImage(path=shown.file))
        for what, points, colour in (
            ("predicted", [p.predicted_px for p in shown.points], [255, 212, 0]),
            ("seen", [p.observed_px for p in shown.points], [86, 180, 233]),
        ):
            stream.log(
                f"{place}/{what}", rerun.Points2D(np.reshape(points, (-1, 2)), colors=[colour], radii=[3.0])
            )
