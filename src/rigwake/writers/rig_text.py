"""The text of `rig.yaml` for a recording that is written: all that its format has no place for."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

import yaml

from rigwake.cameras.protocol import CameraModel
from rigwake.cameras.registry import camera_to_dict
from rigwake.geometry.se3 import SE3
from rigwake.readers.rig_description import IMU_NOISE, transforms_to_plain
from rigwake.recording import Recording
from rigwake.rig import Rig

HEADER = "# a_from_b maps coordinates in b to coordinates in a; metres; quaternions w x y z\n"

Topics = Mapping[tuple[str, str], str]
"""Where the written recording holds each sensor, by kind (`cameras`, `imus`, ...) and name."""


def describe(recording: Recording, topics: Topics, *, transforms: bool) -> dict[str, Any]:
    """Plain values of the rig.yaml of a recording, as `readers.rig_description` reads them.

    transforms: whether the static transforms are to stand here, for formats without tf.
    """
    models = {name: camera.model for name, camera in recording.cameras.items()}
    content = rig_to_dict(models, recording.true_rig)
    for name, camera in recording.cameras.items():
        entry = content["cameras"].setdefault(name, {})
        entry |= _where(topics, "cameras", name, camera.frame_id)
    for kind, streams in (
        ("imus", recording.imus),
        ("gnss", recording.gnss),
        ("attitudes", recording.attitudes),
    ):
        content[kind] = {
            name: _where(topics, kind, name, stream.frame_id) for name, stream in streams.items()
        }
    for name, imu in recording.imus.items():
        values = {key: getattr(imu, key) for key in IMU_NOISE}
        content["imus"][name] |= {key: float(value) for key, value in values.items() if value is not None}
    for name, gnss in recording.gnss.items():
        content["gnss"][name]["origin_lla"] = [float(value) for value in gnss.origin_lla]
    content["poses"] = {
        name: {**_where(topics, "poses", name), "is_metric": bool(poses.is_metric)}
        for name, poses in recording.poses.items()
    }
    content["truth"] = {name: _where(topics, "truth", name) for name in recording.true_trajectories}
    if transforms and recording.static_transforms:
        content["static_transforms"] = transforms_to_plain(recording.static_transforms)
    return {key: value for key, value in content.items() if value}


def _where(topics: Topics, kind: str, name: str, frame_id: str = "") -> dict[str, Any]:
    given = {"topic": topics.get((kind, name), ""), "frame_id": frame_id}
    return {key: value for key, value in given.items() if value}


def yaml_text(content: Mapping[str, Any]) -> str:
    """For a file."""
    return HEADER + yaml.safe_dump(
        dict(content), sort_keys=False, default_flow_style=None, allow_unicode=True
    )


def json_text(content: Mapping[str, Any]) -> str:
    """For the inside of a bag."""
    return json.dumps(content, indent=1, allow_nan=False)


def rig_to_dict(models: Mapping[str, CameraModel | None], rig: Rig | None) -> dict[str, Any]:
    """Plain values of `rig.yaml`, as `readers.rig_file` reads them."""
    cameras: dict[str, dict[str, Any]] = {
        name: {"camera": camera_to_dict(model)} for name, model in models.items() if model is not None
    }
    content: dict[str, Any] = {"cameras": cameras}
    if rig is None:
        return content
    for name, camera in rig.cameras.items():
        entry = cameras.setdefault(
            name, {} if camera.model is None else {"camera": camera_to_dict(camera.model)}
        )
        entry |= {
            "rig_from_cam": _transform(camera.rig_from_cam),
            "time_offset_s": float(camera.time_offset_s),
        }
        if camera.topic:
            entry["topic"] = camera.topic
    content["reference"] = rig.reference
    if rig.antenna_rig is not None:
        content["antenna_rig_m"] = [float(x) for x in rig.antenna_rig]
    if rig.rig_from_imu is not None:
        content["rig_from_imu"] = _transform(rig.rig_from_imu)
    return content


def _transform(a_from_b: SE3) -> dict[str, list[float]]:
    return {"quat_wxyz": a_from_b.quat_wxyz.tolist(), "translation_m": a_from_b.translation.tolist()}
