"""The lens of a camera from its camera_info messages: which of them, for which part of the sensor, rectified or not."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from rigwake._types import Array
from rigwake.cameras.formats.camera_info import camera_from_info
from rigwake.cameras.protocol import CameraModel
from rigwake.cameras.registry import camera_from_params
from rigwake.errors import CameraError, InputError
from rigwake.readers.channels import Channel
from rigwake.readers.images import ImageSize
from rigwake.readers.ros_decoding import decode, read_header
from rigwake.recording import Finding

INFO = "sensor_msgs/msg/CameraInfo"
MAX_INFO_BYTES = 2**16
_MOST_DISTINCT = 1000  # camera_infos that all differ are damage or a zoom
_SAME_LENS = 2e-3  # relative change of the focal length below which a lens that changes is only mentioned


@dataclass(frozen=True)
class _DescribedCamera:
    """A distinct camera_info, how often it stands in the recording and where first."""

    message: Any
    count: int
    first_row: int


def lens_from_infos(
    name: str, channel: Channel, size: ImageSize, *, rectified: bool
) -> tuple[CameraModel | None, list[Finding]]:
    """The lens that a camera_info topic describes, or None and why not.

    Messages without a focal length are passed over, and said; where the lens changes during the recording
    (zoom, focus) it is refused, since none would hold for all images.
    """
    described, damaged = _distinct_infos(channel)
    if not described:
        return None, [Finding("warning", name, f"no message of {channel.topic} can be read.")]
    lenses: list[tuple[_DescribedCamera, CameraModel]] = []
    remarks: list[Finding] = []
    for one in described:
        model, remark = model_from_info(name, one.message, size, rectified=rectified)
        if model is not None:
            lenses.append((one, model))
        elif not remarks:
            remarks = list(remark)
    if not lenses:
        return None, remarks
    findings = []
    if damaged:
        words = f"{damaged} of {len(channel)} messages of {channel.topic} are damaged; they were dropped."
        findings.append(Finding("warning", name, words))
    unusable = sum(d.count for d in described) - sum(one.count for one, _ in lenses)
    if unusable:
        message = (
            f"{unusable} messages of {channel.topic} are not calibrated or for another size; passed over."
        )
        findings.append(Finding("note", name, message))
    values = {tuple(model.params.tolist()): model for _, model in lenses}
    if len(values) == 1:
        return lenses[0][1], findings
    return _changing(name, channel.topic, lenses, findings)


def _changing(
    name: str, topic: str, lenses: Sequence[tuple[_DescribedCamera, CameraModel]], findings: list[Finding]
) -> tuple[CameraModel | None, list[Finding]]:
    focal = np.array([model.params[0] for _, model in lenses])
    if len({model.model for _, model in lenses}) > 1 or np.ptp(focal) > _SAME_LENS * focal.max():
        message = (
            f"its lens changes during the recording (fx {focal.min():.6g} to {focal.max():.6g} in {topic}): "
            "no single lens holds for all images, so none is used. Switch off zoom and autofocus, or give intrinsics."
        )
        return None, [*findings, Finding("error", name, message)]
    _, model = max(lenses, key=lambda pair: pair[0].count)
    message = f"{topic} changes slightly during the recording; the lens stated most often is used."
    return model, [*findings, Finding("warning", name, message)]


def _distinct_infos(channel: Channel) -> tuple[list[_DescribedCamera], int]:
    """The distinct messages, apart from their headers, in the order of their first appearance; how many are
    damaged."""
    counts: Counter[bytes] = Counter()
    firsts: dict[bytes, tuple[int, bytes]] = {}
    damaged = 0
    for row, payload in enumerate(channel.payloads.read(range(len(channel)), MAX_INFO_BYTES)):
        header = read_header(payload, channel.encoding)
        if header is None or len(firsts) > _MOST_DISTINCT:
            damaged += 1
            continue
        content = payload[header.end :]
        counts[content] += 1
        firsts.setdefault(content, (row, payload))
    described = []
    for content, (row, payload) in firsts.items():
        try:
            described.append(_DescribedCamera(decode(payload, INFO, channel.encoding), counts[content], row))
        except InputError:
            damaged += counts[content]
    return described, damaged


def model_from_info(
    name: str, info: Any, size: ImageSize, *, rectified: bool = False
) -> tuple[CameraModel | None, Sequence[Finding]]:
    """The lens of a CameraInfo message (ROS 1 or 2), or None and why the message cannot be used.

    Binning and region of interest are those of `sensor_msgs/CameraInfo`: K and P are of the whole sensor at
    full resolution. rectified: the images are those of the ideal pinhole camera P.
    """
    shift_scale = _part_of_sensor(info, size)
    if shift_scale is None:
        message = (
            f"camera_info is for {_described_size(info)}, images are {size.width_px} x {size.height_px}: "
            "its intrinsics are not used."
        )
        return None, [Finding("error", name, message)]
    D, K, P = (info.D, info.K, info.P) if hasattr(info, "D") else (info.d, info.k, info.p)  # ROS 1: capitals
    try:
        if rectified:
            return _rectified_lens(np.asarray(K), np.asarray(D), np.asarray(P), shift_scale, size), []
        K = np.asarray(K)
        return camera_from_info(info.distortion_model, D, _moved(K, 3, shift_scale), *size), []
    except CameraError as error:
        return None, [Finding("warning", name, f"camera_info is not usable: {error.cause}")]


def _described_size(info: Any) -> str:
    words = f"{info.width} x {info.height}"
    if max(info.binning_x, info.binning_y) > 1:
        words += f" binned by {max(info.binning_x, 1)} x {max(info.binning_y, 1)}"
    if info.roi.width and info.roi.height:
        words += (
            f", of which {info.roi.width} x {info.roi.height} at {info.roi.x_offset}, {info.roi.y_offset}"
        )
    return words


def _part_of_sensor(info: Any, size: ImageSize) -> Array | None:
    """(4,) column and row at which the image begins on the sensor, and the binning along both; None if the
    image is of another size.

    Drivers that state the size after binning or cropping, but the binning or region as well, mean K of the image.
    """
    binning = max(int(info.binning_x), 1), max(int(info.binning_y), 1)
    roi, whole = info.roi, (int(info.width), int(info.height))
    part = (int(roi.width), int(roi.height)) if roi.width and roi.height else whole
    if (part[0] // binning[0], part[1] // binning[1]) == tuple(size) and whole != (0, 0):
        offset = (int(roi.x_offset), int(roi.y_offset)) if part != whole else (0, 0)
        return np.array([*offset, *binning], dtype=np.float64)
    if whole in ((0, 0), tuple(size)):
        return np.array([0.0, 0.0, 1.0, 1.0])
    return None


def _moved(matrix: Array, columns: int, shift_scale: Array) -> Array:
    """K (3 columns) or P (4) of the part of the sensor. Centres of pixels have whole coordinates, so binning by
    n maps u to `(u + 0.5) / n - 0.5`."""
    K = matrix.astype(np.float64).reshape(3, columns).copy()
    offset, scale = shift_scale[:2], shift_scale[2:]
    shifted = K[:2, 2] - offset
    K[:2, 2] = np.where(scale == 1, shifted, (shifted + 0.5) / scale - 0.5)
    K[:2, :2] /= scale[:, None]
    return K


def _rectified_lens(K: Array, D: Array, P: Array, shift_scale: Array, size: ImageSize) -> CameraModel:
    if P.size == 12 and P[0] > 0 and P[5] > 0:
        ideal = _moved(P, 4, shift_scale)
    elif K.size == 9 and K[0] > 0 and not np.any(D):
        ideal = _moved(K, 3, shift_scale)
    else:
        raise CameraError("The images are rectified, but the camera_info holds no P, their ideal camera.")
    fx, skew, fy, cx, cy = ideal[0, 0], ideal[0, 1], ideal[1, 1], ideal[0, 2], ideal[1, 2]
    return camera_from_params("pinhole", [fx, fy, cx, cy, skew, *[0.0] * 5], *size)
