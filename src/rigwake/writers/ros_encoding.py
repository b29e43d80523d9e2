"""Streams as ROS messages, for ROS 1 and ROS 2 alike."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from rigwake._types import Array, Image
from rigwake.cameras.formats.camera_info import CameraInfo
from rigwake.geometry import so3
from rigwake.geometry.geodesy import lla_from_enu
from rigwake.geometry.se3 import SE3
from rigwake.readers.channels import Encoding
from rigwake.readers.images import image_kind
from rigwake.readers.ros_decoding import typestore
from rigwake.recording import AttitudeStream, GnssStream, ImuStream

_ABSENT = np.array([-1.0, *[0.0] * 8])  # REP-145: this orientation is not measured
_COVARIANCE_KNOWN = 3


@dataclass(frozen=True)
class MessageFactory:
    """Builds and serialises messages in one encoding (`ros1` or `cdr`)."""

    encoding: Encoding

    def serialised(self, message_type: str, message: Any) -> bytes:
        """The bytes of a message of this type."""
        store = typestore(self.encoding)
        if self.encoding == "ros1":
            return bytes(store.serialize_ros1(message, message_type))
        return bytes(store.serialize_cdr(message, message_type))

    def _make(self, message_type: str, *fields: Any) -> Any:
        return typestore(self.encoding).types[message_type](*fields)

    def _header(self, timestamp_ns: int, frame_id: str) -> Any:
        stamp = self._make("builtin_interfaces/msg/Time", timestamp_ns // 10**9, timestamp_ns % 10**9)
        if self.encoding == "ros1":
            return self._make("std_msgs/msg/Header", 0, stamp, frame_id)
        return self._make("std_msgs/msg/Header", stamp, frame_id)

    def _vector(self, kind: str, xyz: Array) -> Any:
        return self._make(f"geometry_msgs/msg/{kind}", *(float(value) for value in xyz))

    def _quaternion(self, quat_wxyz: Array) -> Any:
        w, x, y, z = (float(value) for value in quat_wxyz)
        return self._make("geometry_msgs/msg/Quaternion", x, y, z, w)

    def raw_image(self, timestamp_ns: int, frame_id: str, image: Image) -> bytes:
        """A sensor_msgs/Image, mono8 or bgr8."""
        height_px, width_px = image.shape[:2]
        layout, channels = ("mono8", 1) if image.ndim == 2 else ("bgr8", 3)
        name = "sensor_msgs/msg/Image"
        header = self._header(timestamp_ns, frame_id)
        pixels = np.ascontiguousarray(image).ravel()
        fields = (header, height_px, width_px, layout, 0, width_px * channels, pixels)
        return self.serialised(name, self._make(name, *fields))

    def encoded_image(self, timestamp_ns: int, frame_id: str, encoded: bytes) -> bytes:
        """A sensor_msgs/CompressedImage of JPEG or PNG bytes."""
        name, layout = "sensor_msgs/msg/CompressedImage", image_kind(encoded)
        header = self._header(timestamp_ns, frame_id)
        return self.serialised(name, self._make(name, header, layout, np.frombuffer(encoded, np.uint8)))

    def text(self, text: str) -> bytes:
        """A std_msgs/String."""
        name = "std_msgs/msg/String"
        return self.serialised(name, self._make(name, text))

    def camera_info(self, timestamp_ns: int, frame_id: str, info: CameraInfo) -> bytes:
        """A sensor_msgs/CameraInfo without rectification."""
        K = np.array(info.K)
        P = np.hstack([K.reshape(3, 3), np.zeros((3, 1))]).ravel()
        region = self._make("sensor_msgs/msg/RegionOfInterest", 0, 0, 0, 0, False)
        name = "sensor_msgs/msg/CameraInfo"
        message = self._make(
            name,
            self._header(timestamp_ns, frame_id),
            info.height_px,
            info.width_px,
            info.distortion_model,
            np.array(info.D),
            K,
            np.eye(3).ravel(),
            P,
            0,
            0,
            region,
        )
        return self.serialised(name, message)

    def imu(self, imu: ImuStream, row: int, attitude: AttitudeStream | None) -> bytes:
        """A sensor_msgs/Imu, with orientation if an attitude of the same rows is given."""
        measured = (imu.gyro[row], np.zeros(9), imu.accel[row], np.zeros(9))
        return self._imu(int(imu.timestamps_ns[row]), imu.frame_id, attitude, row, *measured)

    def attitude(self, attitude: AttitudeStream, row: int) -> bytes:
        """A sensor_msgs/Imu that says of rates and accelerations that they are not measured (REP-145)."""
        absent = (np.zeros(3), _ABSENT, np.zeros(3), _ABSENT)
        return self._imu(int(attitude.timestamps_ns[row]), attitude.frame_id, attitude, row, *absent)

    def _imu(
        self,
        timestamp_ns: int,
        frame_id: str,
        attitude: AttitudeStream | None,
        row: int,
        gyro: Array,
        gyro_cov: Array,
        accel: Array,
        accel_cov: Array,
    ) -> bytes:
        quat_wxyz, orientation_cov = np.array([1.0, 0, 0, 0]), _ABSENT
        if attitude is not None:
            R = attitude.world_from_body[row]
            quat_wxyz = so3.quat_wxyz_from_matrix(R)
            orientation_cov = (R @ attitude.covariances[row] @ R.T).ravel()
        name = "sensor_msgs/msg/Imu"
        message = self._make(
            name,
            self._header(timestamp_ns, frame_id),
            self._quaternion(quat_wxyz),
            orientation_cov,
            self._vector("Vector3", gyro),
            gyro_cov,
            self._vector("Vector3", accel),
            accel_cov,
        )
        return self.serialised(name, message)

    def velocity(self, gnss: GnssStream, row: int) -> bytes:
        """A geometry_msgs/TwistStamped of a receiver's velocity (east, north, up)."""
        assert gnss.velocity_enu is not None
        name, inner = "geometry_msgs/msg/TwistStamped", "geometry_msgs/msg/Twist"
        linear = self._vector("Vector3", gnss.velocity_enu[row])
        twist = self._make(inner, linear, self._vector("Vector3", np.zeros(3)))
        header = self._header(int(gnss.timestamps_ns[row]), gnss.frame_id)
        return self.serialised(name, self._make(name, header, twist))

    def fix(self, gnss: GnssStream, row: int) -> bytes:
        """A sensor_msgs/NavSatFix."""
        latitude, longitude, height = lla_from_enu(gnss.position_enu[row], gnss.origin_lla)[0].tolist()
        status = self._make("sensor_msgs/msg/NavSatStatus", 0, 1)
        name = "sensor_msgs/msg/NavSatFix"
        header = self._header(int(gnss.timestamps_ns[row]), gnss.frame_id)
        covariance = gnss.covariances[row].ravel()
        fields = (header, status, latitude, longitude, height, covariance, _COVARIANCE_KNOWN)
        return self.serialised(name, self._make(name, *fields))

    def pose(self, timestamp_ns: int, frame_id: str, world_from_body: SE3) -> bytes:
        """A geometry_msgs/PoseStamped."""
        name = "geometry_msgs/msg/PoseStamped"
        header = self._header(timestamp_ns, frame_id)
        return self.serialised(name, self._make(name, header, self._pose(world_from_body)))

    def pose_with_covariance(
        self, timestamp_ns: int, frame_id: str, world_from_body: SE3, covariance: Array
    ) -> bytes:
        """A geometry_msgs/PoseWithCovarianceStamped of a right-tangent covariance (6, 6)."""
        B = np.zeros((6, 6))
        B[:3, :3] = B[3:, 3:] = world_from_body.rotation
        stated = np.roll(B @ covariance @ B.T, (3, 3), axis=(0, 1)).ravel()
        inner = "geometry_msgs/msg/PoseWithCovariance"
        name = f"{inner}Stamped"
        pose = self._make(inner, self._pose(world_from_body), stated)
        return self.serialised(name, self._make(name, self._header(timestamp_ns, frame_id), pose))

    def _pose(self, world_from_body: SE3) -> Any:
        position = self._vector("Point", world_from_body.translation)
        return self._make("geometry_msgs/msg/Pose", position, self._quaternion(world_from_body.quat_wxyz))

    def transforms(self, timestamp_ns: int, edges: dict[tuple[str, str], SE3]) -> bytes:
        """A tf2_msgs/TFMessage of `parent_from_child` by `(parent, child)`."""
        stamped = [
            self._make(
                "geometry_msgs/msg/TransformStamped",
                self._header(timestamp_ns, parent),
                child,
                self._make(
                    "geometry_msgs/msg/Transform",
                    self._vector("Vector3", parent_from_child.translation),
                    self._quaternion(parent_from_child.quat_wxyz),
                ),
            )
            for (parent, child), parent_from_child in edges.items()
        ]
        name = "tf2_msgs/msg/TFMessage"
        return self.serialised(name, self._make(name, stamped))
