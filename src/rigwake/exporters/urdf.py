"""URDF: one link and one fixed joint per camera; with the suffix `.xacro` as a macro to include.

The origin of a fixed joint maps child to parent coordinates: `parent -> camera` is `rig_from_cam`, its rotation
as fixed-axis roll, pitch, yaw.
"""

from __future__ import annotations

import re
import xml.etree.ElementTree as ET
from pathlib import Path
from xml.sax.saxutils import quoteattr

import numpy as np

from rigwake.atomic import write_text_atomic
from rigwake.calibration import Calibration
from rigwake.errors import InputError
from rigwake.exporters.export_base import ExportOptions, Notes, header, read_text
from rigwake.exporters.ros_tf import Edges, calibration_of_frames, camera_frames
from rigwake.geometry.euler import rotation_from_yaw_pitch_roll, yaw_pitch_roll
from rigwake.geometry.se3 import SE3

_XACRO = 'xmlns:xacro="http://www.ros.org/wiki/xacro"'


def write_urdf(calibration: Calibration, path: Path, options: ExportOptions, notes: Notes) -> Notes:
    """A URDF with the parent link, or a macro `rigwake_cameras` with the parent and a prefix as parameters."""
    edges = camera_frames(calibration, options)
    comments = [f"  <!-- {line.replace('--', '- -')} -->" for line in header(calibration, notes)]
    parent = next(iter(edges))[0]
    if path.suffix == ".xacro":
        lines = [
            f"<robot {_XACRO}>",
            *comments,
            f'  <xacro:macro name="rigwake_cameras" params="parent:={parent} prefix:=\'\'">',
            *_joints(edges, "${parent}", "${prefix}"),
            "  </xacro:macro>",
        ]
    else:
        lines = ['<robot name="rig">', *comments, f"  <link name={quoteattr(parent)} />"]
        lines += _joints(edges, parent, "")
    write_text_atomic(path, "\n".join(['<?xml version="1.0"?>', *lines, "</robot>"]) + "\n")
    return []


def _joints(edges: Edges, parent: str, prefix: str) -> list[str]:
    lines = []
    for (_, child), parent_from_child in edges.items():
        yaw, pitch, roll = yaw_pitch_roll(parent_from_child.rotation)
        xyz = " ".join(repr(float(v)) for v in parent_from_child.translation)
        rpy = " ".join(repr(float(v)) for v in (roll, pitch, yaw))
        lines += [
            f"  <link name={quoteattr(prefix + child)} />",
            f'  <joint name={quoteattr(f"{prefix}{child}_joint")} type="fixed">',
            f'    <origin xyz="{xyz}" rpy="{rpy}" />',
            f"    <parent link={quoteattr(parent)} />",
            f"    <child link={quoteattr(prefix + child)} />",
            "  </joint>",
        ]
    return lines


def read_urdf(path: Path) -> Calibration:
    """The optical frames of a URDF relative to its root, along fixed joints."""
    text = read_text(path)
    if "<!DOCTYPE" in text or "<!ENTITY" in text:
        raise InputError(f"{path} declares entities, which a URDF has no use for.")
    try:
        root = ET.fromstring(text)
    except ET.ParseError as error:
        raise InputError(f"{path} is not XML: {error}.") from error
    if re.search(r"\$\{|<xacro:", text):
        raise InputError(f"{path} is a xacro.", remedy="Expand it first: xacro FILE > robot.urdf")
    edges: Edges = {}
    for joint in root.iter("joint"):
        if joint.get("type") != "fixed":
            continue
        origin, where = joint.find("origin"), f"{path}: joint {joint.get('name')}"
        xyz = _triple(origin, "xyz", where)
        rpy = _triple(origin, "rpy", where)
        edge = _link(joint, "parent", where), _link(joint, "child", where)
        edges[edge] = SE3(rotation_from_yaw_pitch_roll(rpy[::-1]), xyz)
    if not edges:
        raise InputError(f"{path} has no fixed joint.")
    return calibration_of_frames(edges, path)


def _triple(origin: ET.Element | None, key: str, where: str) -> np.ndarray:
    text = "0 0 0" if origin is None else origin.get(key, "0 0 0")
    try:
        values = np.array([float(word) for word in text.split()])
    except ValueError as error:
        raise InputError(f"{where}: {key} holds something that is not a number.") from error
    if values.shape != (3,) or not np.isfinite(values).all():
        raise InputError(f"{where}: {key} must be three finite numbers, it is {text!r}.")
    return values


def _link(joint: ET.Element, role: str, where: str) -> str:
    element = joint.find(role)
    if element is None or not element.get("link"):
        raise InputError(f"{where} has no {role} link.")
    return str(element.get("link"))
