"""IMU topics of ROS bags as streams: whole ones, and the two halves that some drivers publish apart."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from rigwake._types import Array, Stamps
from rigwake.errors import InputError
from rigwake.geometry import so3
from rigwake.geometry.se3 import SE3
from rigwake.readers.channels import Channel
from rigwake.readers.ros_decoding import stamped_rows, trailing_doubles, whole_payloads
from rigwake.readers.streams import symmetric_psd, unit_quaternions, usable_rows
from rigwake.readers.topics import sensor_names
from rigwake.recording import AttitudeStream, Finding, ImuStream, transform_between

IMU = "sensor_msgs/msg/Imu"
_LONGEST_BRIDGE = (
    5.0  # times the usual period of the accelerometer: between samples further apart nothing is made up
)

StaticTransforms = Mapping[tuple[str, str], SE3]


@dataclass(frozen=True, eq=False)
class _ImuTopic:
    """What an Imu topic really carries: gyro and accel are None where the driver leaves them empty.

    REP-145: a covariance of -1 says that a quantity is not measured; many drivers just leave zeros or NaN.
    """

    topic: str
    frame_id: str
    timestamps_ns: Stamps
    gyro: Array | None
    accel: Array | None
    attitude: AttitudeStream | None
    findings: tuple[Finding, ...]


def read_imus(
    channels: Mapping[str, Channel], transforms: StaticTransforms
) -> tuple[dict[str, ImuStream], dict[str, AttitudeStream], list[Finding]]:
    """IMUs and attitudes by name; what was repaired, joined or left out.

    A topic with the gyroscope alone and one with the accelerometer alone become one IMU at the gyroscope's
    stamps; half an IMU without its other half is left out.
    """
    imus: dict[str, ImuStream] = {}
    attitudes: dict[str, AttitudeStream] = {}
    findings: list[Finding] = []
    gyros: list[_ImuTopic] = []
    accels: list[_ImuTopic] = []
    for name, channel in channels.items():
        try:
            read = _read_topic(name, channel)
        except InputError as error:
            findings.append(Finding("error", name, f"left out: {error.cause}"))
            continue
        findings += read.findings
        if read.attitude is not None:
            attitudes[name] = read.attitude
        if read.gyro is not None and read.accel is not None:
            imus[name] = ImuStream(
                name, read.timestamps_ns, read.gyro, read.accel, channel.topic, read.frame_id
            )
        elif read.gyro is not None:
            gyros.append(read)
        elif read.accel is not None:
            accels.append(read)
        elif read.attitude is None:
            words = f"left out: gyroscope and accelerometer of {channel.topic} are empty."
            findings.append(Finding("error", name, words))
    joined, more = _join_halves(gyros, accels, set(imus), transforms)
    return imus | joined, attitudes, findings + more


def _read_topic(name: str, channel: Channel) -> _ImuTopic:
    payloads = whole_payloads(channel)
    stamped = stamped_rows(name, channel, payloads)
    values = trailing_doubles([payloads[row] for row in stamped.rows], 37, channel.encoding)
    if not len(values):
        raise InputError(f"{channel.topic} holds no readable IMU sample.")
    gyro, accel = (_measured(values[:, at : at + 3], values[:, at + 3]) for at in (13, 25))
    present = [part for part in (gyro, accel) if part is not None] or [values[:, :4]]
    rows, repaired = usable_rows(name, stamped.timestamps_ns, *present)
    if not len(rows):
        raise InputError(f"{channel.topic} holds no readable IMU sample.")
    stamps = stamped.timestamps_ns[rows]
    attitude = _attitude(name, channel.topic, stamped.frame_id, stamps, values[rows])
    return _ImuTopic(
        channel.topic,
        stamped.frame_id,
        stamps,
        None if gyro is None else gyro[rows],
        None if accel is None else accel[rows],
        attitude,
        (*stamped.findings, *repaired),
    )


def _measured(vectors: Array, first_variance: Array) -> Array | None:
    """The vectors (N, 3), unless all are zero or NaN or marked as not measured."""
    empty = (np.isnan(vectors).all(axis=1)) | (vectors == 0).all(axis=1)
    return None if empty.all() or (first_variance == -1).all() else vectors


def _attitude(name: str, topic: str, frame_id: str, stamps: Stamps, values: Array) -> AttitudeStream | None:
    """The orientation, if the driver marks it as present (REP-145) and fills it in."""
    quat_xyzw, covariances = values[:, :4], values[:, 4:13].reshape(-1, 3, 3)
    if np.isnan(unit_quaternions(quat_xyzw)).any() or not covariances[0, 0, 0] >= 0:
        return None
    if np.ptp(quat_xyzw, axis=0).max() == 0:  # never filled in: identity all along
        return None
    rotations = so3.matrix_from_quat_wxyz(np.roll(quat_xyzw, 1, axis=1))
    # the message states covariances about the fixed axes of the world; ours are about body axes
    body = np.swapaxes(rotations, 1, 2) @ symmetric_psd(covariances, np.radians(5.0) ** 2) @ rotations
    return AttitudeStream(name, stamps, rotations, body, topic, frame_id)


def _join_halves(
    gyros: list[_ImuTopic], accels: list[_ImuTopic], taken: set[str], transforms: StaticTransforms
) -> tuple[dict[str, ImuStream], list[Finding]]:
    """IMUs of a gyroscope and the accelerometer whose topic is nearest in name, each used once."""
    pairs: list[tuple[_ImuTopic, _ImuTopic]] = []
    findings: list[Finding] = []
    waiting = list(accels)
    for gyro in sorted(gyros, key=lambda g: -max((_shared(g.topic, a.topic) for a in accels), default=0)):
        partners = [accel for accel in waiting if _are_of_one_device(gyro, accel)]
        if not partners:
            words = (
                f"left out: {gyro.topic} holds no accelerations, and no other topic holds its accelerometer."
            )
            findings.append(Finding("error", gyro.topic, words))
            continue
        nearest = max(partners, key=lambda a: _shared(gyro.topic, a.topic))
        waiting.remove(nearest)
        pairs.append((gyro, nearest))
    for accel in waiting:
        words = f"left out: {accel.topic} holds no angular rates, and no other topic holds its gyroscope."
        findings.append(Finding("error", accel.topic, words))
    bases = {gyro.topic: _common_base(gyro.topic, accel.topic) for gyro, accel in pairs}
    names = sensor_names(list(bases.values()), "imu")
    joined: dict[str, ImuStream] = {}
    for gyro, accel in pairs:
        name = names[bases[gyro.topic]]
        name = name if name not in taken | joined.keys() else f"{name}_{len(joined) + 1}_joined"
        try:
            joined[name], remark = _joined(name, gyro, accel, transforms)
        except InputError as error:
            remark = Finding("error", name, f"left out: {error.cause}")
        findings.append(remark)
    return joined, findings


def _are_of_one_device(gyro: _ImuTopic, accel: _ImuTopic) -> bool:
    """Whether two halves share a namespace or a frame, or are named for what they are (`/gyro`, `/accel`)."""
    if _shared(gyro.topic, accel.topic) > 1 or (gyro.frame_id and gyro.frame_id == accel.frame_id):
        return True
    heads = gyro.topic.strip("/").split("/")[0].lower(), accel.topic.strip("/").split("/")[0].lower()
    return "gyr" in heads[0] and "acc" in heads[1]


def _shared(first: str, second: str) -> int:
    """How many leading components two topics share."""
    pairs = zip(first.split("/"), second.split("/"), strict=False)
    return next((at for at, (a, b) in enumerate(pairs) if a != b), 99)


def _common_base(first: str, second: str) -> str:
    parts = first.split("/")[: _shared(first, second)]
    return "/".join([*parts, "imu"]) if not parts or parts[-1] != "imu" else "/".join(parts)


def _joined(
    name: str, gyro: _ImuTopic, accel: _ImuTopic, transforms: StaticTransforms
) -> tuple[ImuStream, Finding]:
    """The accelerometer between its samples at the gyroscope's stamps, in the gyroscope's axes."""
    assert gyro.gyro is not None
    assert accel.accel is not None
    stamps, known = gyro.timestamps_ns, accel.timestamps_ns
    after = np.searchsorted(known, stamps)
    inside = (after > 0) & (after < len(known)) | np.isin(stamps, known)
    low, high = np.maximum(after - 1, 0), np.minimum(after, len(known) - 1)
    period = float(np.median(np.diff(known))) if len(known) > 1 else 0.0
    kept = np.flatnonzero(inside & (known[high] - known[low] <= _LONGEST_BRIDGE * period))
    if len(kept) < 2:
        raise InputError(f"{gyro.topic} and {accel.topic} do not overlap in time.")
    seconds, known_s = (stamps[kept] - stamps[0]) * 1e-9, (known - stamps[0]) * 1e-9
    values = np.column_stack([np.interp(seconds, known_s, accel.accel[:, axis]) for axis in range(3)])
    between = transform_between(transforms, gyro.frame_id, accel.frame_id)
    if between is not None:
        values = values @ between.rotation.T
    stream = ImuStream(name, stamps[kept], gyro.gyro[kept], values, gyro.topic, gyro.frame_id)
    words = (
        f"gyroscope of {gyro.topic} and accelerometer of {accel.topic} ({1e9 / max(period, 1):.3g} Hz) joined, "
        "the accelerometer interpolated."
    )
    return stream, Finding("note", name, words)
