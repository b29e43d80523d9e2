"""What the node publishes in ROS 2, as serialized bytes (CDR): no message class of ROS is needed to make them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from rigwake.geometry.se3 import SE3
from rigwake.readers.ros_decoding import typestore
from rigwake.ros.transport import COMPRESSED_IMAGE, TRANSFORMS, NodeStatus

_HARDWARE = "rigwake"


def transforms_cdr(edges: Mapping[tuple[str, str], SE3], now_ns: int) -> bytes:
    """tf2_msgs/TFMessage of `parent_from_child` by (parent, child)."""
    types = typestore("cdr").types
    transforms = []
    for (parent, child), transform in edges.items():
        x, y, z = map(float, transform.translation)
        qw, qx, qy, qz = map(float, transform.quat_wxyz)
        moved = types["geometry_msgs/msg/Transform"](
            types["geometry_msgs/msg/Vector3"](x, y, z),
            types["geometry_msgs/msg/Quaternion"](qx, qy, qz, qw),
        )
        transforms.append(types["geometry_msgs/msg/TransformStamped"](_header(now_ns, parent), child, moved))
    return _serialized(types[TRANSFORMS](transforms), TRANSFORMS)


def diagnostics_cdr(entries: Sequence[NodeStatus], node: str, now_ns: int) -> bytes:
    """diagnostic_msgs/DiagnosticArray; every entry is named `NODE: NAME`."""
    types = typestore("cdr").types
    pair, status = types["diagnostic_msgs/msg/KeyValue"], types["diagnostic_msgs/msg/DiagnosticStatus"]
    array = types["diagnostic_msgs/msg/DiagnosticArray"](
        _header(now_ns, ""),
        [
            status(
                int(entry.level),
                f"{node}: {entry.name}",
                entry.message,
                _HARDWARE,
                [pair(key, value) for key, value in entry.values.items()],
            )
            for entry in entries
        ],
    )
    return _serialized(array, "diagnostic_msgs/msg/DiagnosticArray")


def jpeg_cdr(jpeg: bytes, timestamp_ns: int, frame_id: str) -> bytes:
    """sensor_msgs/CompressedImage."""
    kind = typestore("cdr").types[COMPRESSED_IMAGE]
    message = kind(_header(timestamp_ns, frame_id), "jpeg", np.frombuffer(jpeg, np.uint8))
    return _serialized(message, COMPRESSED_IMAGE)


def _header(timestamp_ns: int, frame_id: str) -> Any:
    types = typestore("cdr").types
    seconds, nanoseconds = divmod(timestamp_ns, 10**9)
    return types["std_msgs/msg/Header"](types["builtin_interfaces/msg/Time"](seconds, nanoseconds), frame_id)


def _serialized(message: Any, message_type: str) -> bytes:
    return bytes(typestore("cdr").serialize_cdr(message, message_type))
