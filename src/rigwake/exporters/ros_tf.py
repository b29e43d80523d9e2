"""Static transforms for ROS: a launch file, or a bag with the latched topic /tf_static.

| suffix | what |
|---|---|
| `.launch` | ROS 1: one `tf2_ros static_transform_publisher` per camera |
| `.launch.py`, `.py` | ROS 2: the same as a launch description |
| `.bag`, `.mcap`, none | ROS 1 bag, MCAP file, ROS 2 bag folder: one message on /tf_static |

A transform of tf maps child to parent coordinates, so that `rig -> camera` is `rig_from_cam`.
"""

from __future__ import annotations

import ast
import re
import xml.etree.ElementTree as ET
from pathlib import Path
from xml.sax.saxutils import quoteattr

from rigwake.atomic import write_text_atomic
from rigwake.calibration import CalibratedCamera, Calibration
from rigwake.errors import InputError, UsageError
from rigwake.exporters.export_base import (
    ExportOptions,
    Notes,
    external_calibration,
    external_camera,
    header,
    read_text,
    transform_from_parts,
)
from rigwake.geometry.se3 import SE3
from rigwake.readers.open import open_recording
from rigwake.recording import Recording
from rigwake.writers.rosbag import write_rosbag1, write_rosbag2

Edges = dict[tuple[str, str], SE3]
_FRAME = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_/\-]*")


def camera_frames(calibration: Calibration, options: ExportOptions) -> Edges:
    """`rig_from_cam` by `(parent frame, child frame)`; UsageError if a frame's name is none for ROS."""
    parent = options.parent_frame or calibration.reference
    edges: Edges = {}
    for name, camera in calibration.cameras.items():
        child = options.child_frame.replace("{name}", name)
        for frame in (parent, child):
            if not _FRAME.fullmatch(frame):
                raise UsageError(
                    f"{frame!r} is no name for a ROS frame.",
                    remedy="Choose --parent-frame and --child-frame, such as '{name}_optical_frame'.",
                )
        if (parent, child) in edges or child == parent:
            raise UsageError(
                f"The frame {child} would be there twice.", remedy="Use {name} in --child-frame."
            )
        edges[parent, child] = camera.rig_from_cam
    return edges


def write_ros_static_tf(calibration: Calibration, path: Path, options: ExportOptions, notes: Notes) -> Notes:
    """The form that the suffix of the path asks for."""
    edges = camera_frames(calibration, options)
    comments = header(calibration, notes)
    if path.name.endswith(".py"):
        write_text_atomic(path, _ros2_launch(edges, comments))
    elif path.suffix in (".launch", ".xml"):
        write_text_atomic(path, _ros1_launch(edges, comments))
    elif path.suffix == ".bag":
        write_rosbag1(Recording(path, "calibration", static_transforms=edges), path)
    elif path.suffix in (".mcap", ""):
        write_rosbag2(Recording(path, "calibration", static_transforms=edges), path)
    else:
        raise UsageError(
            f"ros-static-tf does not know the suffix {path.suffix}.",
            remedy="Use .launch (ROS 1), .launch.py (ROS 2), .bag, .mcap or a folder.",
        )
    return []


def _arguments(edge: tuple[str, str], parent_from_child: SE3) -> list[str]:
    """`x y z qx qy qz qw parent child`, the arguments of tf2's static_transform_publisher."""
    w, x, y, z = parent_from_child.quat_wxyz
    return [repr(float(v)) for v in (*parent_from_child.translation, x, y, z, w)] + list(edge)


def _ros1_launch(edges: Edges, comments: list[str]) -> str:
    lines = ["<launch>", *(f"  <!-- {line.replace('--', '- -')} -->" for line in comments)]
    for edge, transform in edges.items():
        node = re.sub(r"\W", "_", f"rigwake_{edge[1]}")
        lines.append(
            f'  <node pkg="tf2_ros" type="static_transform_publisher" name={quoteattr(node)}\n'
            f"        args={quoteattr(' '.join(_arguments(edge, transform)))} />"
        )
    return "\n".join([*lines, "</launch>"]) + "\n"


_FLAGS = ("--x", "--y", "--z", "--qx", "--qy", "--qz", "--qw", "--frame-id", "--child-frame-id")


def _ros2_launch(edges: Edges, comments: list[str]) -> str:
    entries = []
    for edge, transform in edges.items():
        pairs = [word for pair in zip(_FLAGS, _arguments(edge, transform), strict=True) for word in pair]
        entries.append(f"    {pairs!r},")
    return "\n".join(
        [
            *(f"# {line}" for line in comments),
            "from launch import LaunchDescription",
            "from launch_ros.actions import Node",
            "",
            "TRANSFORMS = [",
            *entries,
            "]",
            "",
            "",
            "def generate_launch_description():",
            '    publisher = {"package": "tf2_ros", "executable": "static_transform_publisher"}',
            "    return LaunchDescription([Node(**publisher, arguments=arguments) for arguments in TRANSFORMS])",
            "",
        ]
    )


def read_ros_static_tf(path: Path) -> Calibration:
    """The transforms of a launch file or of the /tf_static of a bag; the common parent is the reference.

    Frames that end in `_optical_frame` or `_optical` are cameras; without any, all children are taken as such.
    """
    if path.is_file() and path.name.endswith(".py"):
        edges = _read_ros2_launch(path)
    elif path.is_file() and path.suffix in (".launch", ".xml"):
        edges = _read_ros1_launch(path)
    else:
        edges = dict(open_recording(path).static_transforms)
    return calibration_of_frames(edges, path)


def calibration_of_frames(edges: Edges, path: Path) -> Calibration:
    """The calibration of a tree of frames: its optical frames relative to its root."""
    parents = {child: (parent, transform) for (parent, child), transform in edges.items()}
    roots = {parent for parent, _ in edges} - set(parents)
    if len(roots) != 1:
        raise InputError(f"{path}: the frames have {len(roots)} roots ({', '.join(sorted(roots))}), not one.")
    optical = [frame for frame in parents if re.search(r"_optical(_frame)?$", frame)]
    cameras = [_camera(frame, parents) for frame in optical or parents]
    return external_calibration(roots.pop(), cameras, path)


def _camera(frame: str, parents: dict[str, tuple[str, SE3]]) -> CalibratedCamera:
    root_from_cam, at = SE3.identity(), frame
    for _ in parents:  # a tree is no deeper than it has frames
        if at not in parents:
            break
        at, transform = parents[at]
        root_from_cam = transform * root_from_cam
    return external_camera(re.sub(r"_optical(_frame)?$", "", frame), root_from_cam)


def _edge(words: list[str], where: str) -> tuple[tuple[str, str], SE3]:
    if len(words) not in (9, 10):  # tf's own publisher takes a period as well
        raise InputError(
            f"{where}: {len(words)} arguments where x y z qx qy qz qw parent child are expected."
        )
    qx, qy, qz, qw = words[3:7]
    return (words[7].lstrip("/"), words[8].lstrip("/")), transform_from_parts(
        [qw, qx, qy, qz], words[:3], where
    )


def _read_ros1_launch(path: Path) -> Edges:
    text = read_text(path)
    if "<!DOCTYPE" in text or "<!ENTITY" in text:
        raise InputError(f"{path} declares entities, which a launch file has no use for.")
    try:
        root = ET.fromstring(text)
    except ET.ParseError as error:
        raise InputError(f"{path} is not XML: {error}.") from error
    edges: Edges = {}
    for node in root.iter("node"):
        if node.get("type") == "static_transform_publisher":
            edge, transform = _edge(node.get("args", "").split(), f"{path}: {node.get('name')}")
            edges[edge] = transform
    return edges


def _read_ros2_launch(path: Path) -> Edges:
    """The literal `TRANSFORMS` of a launch file that rigwake wrote; the file is parsed, never run."""
    try:
        tree = ast.parse(read_text(path))
        literals = [
            ast.literal_eval(node.value)
            for node in tree.body
            if isinstance(node, ast.Assign)
            and any(isinstance(t, ast.Name) and t.id == "TRANSFORMS" for t in node.targets)
        ]
        words = [
            [dict(zip(row[::2], row[1::2], strict=True))[flag] for flag in _FLAGS] for row in literals[0]
        ]
    except (SyntaxError, ValueError, IndexError, KeyError, TypeError, RecursionError) as error:
        raise InputError(
            f"{path} is not a launch file that rigwake wrote: {type(error).__name__}: {error}.",
            remedy="Of other ROS 2 launch files rigwake reads what they publish: record /tf_static.",
        ) from error
    return dict(_edge([str(w) for w in row], str(path)) for row in words)
