"""What recordings of rigwake say of themselves beyond what their format can hold: `rig.yaml`, inside or beside.

In a ROS bag it is the text of one `std_msgs/String` on `RIG_TOPIC`, in a folder the file `rig.yaml`, and beside any
file `NAME.rig.yaml`. It holds lenses of every model, names of sensors, noise of IMUs, the origin of GNSS positions, the
known rig. The text inside bags is JSON, hence YAML too, and is read as JSON: nothing in it can expand.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from rigwake.cameras.protocol import CameraModel
from rigwake.errors import InputError
from rigwake.geometry.geodesy import enu_from_lla, lla_from_enu
from rigwake.geometry.se3 import SE3
from rigwake.readers.imu_noise_settings import with_noise_settings
from rigwake.readers.lens_choice import with_lenses
from rigwake.readers.printable import is_plain_name, printable
from rigwake.readers.rig_file import rig_from_mapping
from rigwake.recording import (
    AttitudeStream,
    CameraStream,
    Finding,
    GnssStream,
    ImuStream,
    Recording,
)
from rigwake.rig import Rig
from rigwake.yaml_input import read_yaml_settings

RIG_TOPIC = "/rigwake/rig"
TRUTH_PREFIX = "/rigwake/truth/"
RIG_FILE = "rig.yaml"
MAX_TEXT_BYTES = 2**22

IMU_NOISE = ("gyro_noise_density", "accel_noise_density", "gyro_bias_walk", "accel_bias_walk")
_KEYS = {"reference", "cameras", "antenna_rig_m", "rig_from_imu", "imu", "static_transforms"}
_KEYS |= {"imus", "gnss", "attitudes", "poses", "truth"}
_ROLES = {
    "camera": "cameras",
    "imu": "imus",
    "gnss": "gnss",
    "attitude": "attitudes",
    "pose": "poses",
    "truth": "truth",
}


@dataclass(frozen=True, eq=False)
class RigDescription:
    """Plain values of a `rig.yaml`, checked; names: role -> topic -> name."""

    names: Mapping[str, Mapping[str, str]] = field(default_factory=dict)
    lenses: Mapping[str, CameraModel] = field(default_factory=dict)
    rig: Rig | None = None
    imus: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    gnss: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    poses: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    transforms: Mapping[tuple[str, str], SE3] = field(default_factory=dict)
    findings: tuple[Finding, ...] = ()

    def name_of(self, role: str, topic: str, otherwise: str) -> str:
        """The name that the description gives a topic (or a folder), if it does."""
        return self.names.get(role, {}).get(topic, otherwise)


def description_of_text(text: str) -> RigDescription:
    """From the text inside a bag. Raises InputError if it is no description."""
    try:
        content = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise InputError(f"{RIG_TOPIC} does not describe a rig ({error}).") from error
    return description_of(content, RIG_TOPIC)


def description_of(content: Any, where: str) -> RigDescription:
    """From plain values. Raises InputError if they are of another form."""
    if not isinstance(content, Mapping):
        raise InputError(f"{where} does not describe a rig.")
    described = {key: _entries(content.get(key)) for key in _ROLES.values()}
    lenses: Mapping[str, CameraModel] = {}
    rig = None
    if described["cameras"]:
        lenses, rig = rig_from_mapping({**content, "cameras": described["cameras"]}, where)
    names = {
        role: {str(entry["topic"]): name for name, entry in described[key].items() if entry.get("topic")}
        for role, key in _ROLES.items()
    }
    transforms, findings = plain_to_transforms(content.get("static_transforms"))
    imus, gnss, poses = described["imus"], described["gnss"], described["poses"]
    settings = content.get("imu")  # of every IMU, or by name
    if isinstance(settings, Mapping):
        flat = {key: value for key, value in settings.items() if not isinstance(value, Mapping)}
        imus = {**({"": flat} if flat else {}), **_entries(settings), **imus}
    unread = [printable(str(key)) for key in content if key not in _KEYS]
    if unread:
        words = f"{RIG_FILE}: {', '.join(unread)} not read; known are {', '.join(sorted(_KEYS))}."
        findings = (*findings, Finding("warning", RIG_FILE, words))
    return RigDescription(names, lenses, rig, imus, gnss, poses, transforms, findings)


def _entries(content: Any) -> dict[str, dict[str, Any]]:
    """Of a mapping of sensors the entries that have a usable name."""
    if not isinstance(content, Mapping):
        return {}
    return {
        str(name): dict(entry)
        for name, entry in content.items()
        if isinstance(entry, Mapping) and is_plain_name(str(name).replace("/", "_"))
    }


def description_beside(path: Path) -> RigDescription | None:
    """From `rig.yaml` in a folder or `NAME.rig.yaml` beside a file; None if there is none. Raises InputError."""
    if path.is_dir():
        files = [path / RIG_FILE]
    else:
        stems = dict.fromkeys((path.stem, path.name, path.name.partition(".")[0]))
        files = [path.with_name(f"{stem}.{RIG_FILE}") for stem in stems]
    file = next((file for file in files if file.is_file()), None)
    return None if file is None else description_of(read_yaml_settings(file), str(file))


def with_description(recording: Recording, description: RigDescription) -> Recording:
    """The recording with the lenses, noise, origins and the rig that its description tells."""
    lenses = {name: lens for name, lens in description.lenses.items() if name in recording.cameras}
    completed = with_lenses(recording, lenses, RIG_FILE)
    described = {
        name: with_noise_settings(imu, description.imus.get(name, description.imus.get("", {})), RIG_FILE)
        for name, imu in completed.imus.items()
    }
    strange = tuple(finding for _, findings in described.values() for finding in findings)
    return replace(
        completed,
        imus={n: imu for n, (imu, _) in described.items()},
        gnss={n: _with_origin(gnss, description.gnss.get(n, {})) for n, gnss in completed.gnss.items()},
        poses={
            name: replace(poses, is_metric=bool(description.poses.get(name, {}).get("is_metric", True)))
            if name in description.poses
            else poses
            for name, poses in completed.poses.items()
        },
        static_transforms={**description.transforms, **completed.static_transforms},
        true_rig=description.rig or completed.true_rig,
        findings=(*completed.findings, *description.findings, *strange),
    )


def renamed(recording: Recording, description: RigDescription) -> Recording:
    """The recording with the names that its description gives topics, folders and files."""
    cameras, imus = recording.cameras.values(), recording.imus.values()
    gnss, attitudes = recording.gnss.values(), recording.attitudes.values()
    named = {old: new for names in description.names.values() for old, new in names.items()}
    findings = (replace(f, sensor=named.get(f.sensor, f.sensor)) for f in recording.findings)
    return replace(
        recording,
        findings=tuple(findings),
        cameras={n: replace(c, name=n) for n, c in _names(description, "camera", cameras).items()},
        imus={n: replace(i, name=n) for n, i in _names(description, "imu", imus).items()},
        gnss={n: replace(g, name=n) for n, g in _names(description, "gnss", gnss).items()},
        attitudes={n: replace(a, name=n) for n, a in _names(description, "attitude", attitudes).items()},
        poses={description.name_of("pose", n, n): poses for n, poses in recording.poses.items()},
        true_trajectories={
            description.name_of("truth", n, n): truth for n, truth in recording.true_trajectories.items()
        },
    )


_Sensor = TypeVar("_Sensor", CameraStream, ImuStream, GnssStream, AttitudeStream)


def _names(description: RigDescription, role: str, sensors: Iterable[_Sensor]) -> dict[str, _Sensor]:
    by_name: dict[str, _Sensor] = {}
    for sensor in sensors:
        name = description.name_of(role, sensor.topic or sensor.name, sensor.name)
        by_name[name if name not in by_name else sensor.name] = sensor
    return by_name


def _with_origin(gnss: GnssStream, entry: Mapping[str, Any]) -> GnssStream:
    """The same positions in the plane tangent at the origin that the entry names."""
    try:
        latitude, longitude, height = (float(value) for value in entry.get("origin_lla", ()))
    except (TypeError, ValueError):
        return gnss
    origin = (latitude, longitude, height)
    if origin == gnss.origin_lla or not np.isfinite(origin).all() or abs(latitude) > 90:
        return gnss
    position = enu_from_lla(lla_from_enu(gnss.position_enu, gnss.origin_lla), origin)
    if np.abs(position).max() > 1e6:  # an origin on another continent is not of this recording
        return gnss
    return replace(gnss, position_enu=position, origin_lla=origin)


def transforms_to_plain(transforms: Mapping[tuple[str, str], SE3]) -> list[dict[str, Any]]:
    """`parent_from_child` transforms as plain values."""
    return [
        {
            "parent": parent,
            "child": child,
            "quat_wxyz": parent_from_child.quat_wxyz.tolist(),
            "translation_m": parent_from_child.translation.tolist(),
        }
        for (parent, child), parent_from_child in transforms.items()
    ]


def plain_to_transforms(entries: Any) -> tuple[dict[tuple[str, str], SE3], tuple[Finding, ...]]:
    """Back from plain values; what is damaged is left out, and said."""
    transforms, damaged = {}, 0
    for entry in entries if isinstance(entries, list) else []:
        try:
            quat, position = np.array(entry["quat_wxyz"], float), np.array(entry["translation_m"], float)
            if abs(np.linalg.norm(quat.reshape(4)) - 1) > 1e-3 or not np.isfinite(position.reshape(3)).all():
                raise ValueError("not a transform")
            transforms[str(entry["parent"]), str(entry["child"])] = SE3.from_quat_wxyz(quat, position)
        except (KeyError, TypeError, ValueError):
            damaged += 1
    words = f"{damaged} static transforms in {RIG_FILE} are damaged; left out."
    return transforms, (Finding("warning", "", words),) if damaged else ()
