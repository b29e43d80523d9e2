"""What the node needs of ROS, whichever ROS it is: messages as bytes, two kinds of services, status, transforms."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from enum import IntEnum
from typing import NamedTuple, Protocol

from rigwake.geometry.se3 import SE3
from rigwake.readers.channels import Encoding

IMAGE, COMPRESSED_IMAGE = "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"
CAMERA_INFO, TRANSFORMS = "sensor_msgs/msg/CameraInfo", "tf2_msgs/msg/TFMessage"
STRING = "std_msgs/msg/String"

Answer = tuple[bool, str]
"""Whether a service did what was asked, and words."""


class ReceivedMessage(NamedTuple):
    """A message as it came: never decoded where it is received.

    message_type: `package/msg/Name`. received_ns: time of the ROS clock. publisher: the node that sent it, if known.
    """

    topic: str
    message_type: str
    encoding: Encoding
    received_ns: int
    payload: bytes
    publisher: str = ""


class StatusLevel(IntEnum):
    """As in diagnostic_msgs/DiagnosticStatus."""

    OK = 0
    WARN = 1
    ERROR = 2
    STALE = 3


@dataclass(frozen=True)
class NodeStatus:
    """One entry of /diagnostics."""

    name: str
    level: StatusLevel
    message: str
    values: Mapping[str, str] = field(default_factory=dict)


class Transport(Protocol):
    """ROS, as the node sees it. Callbacks come from any thread."""

    encoding: Encoding

    def own_name(self) -> str:
        """Of this node, as publishers are named."""

    def topics(self) -> dict[str, str]:
        """Type by topic, of all that is published now. Empty where nobody answers."""

    def subscribe(self, topic: str, message_type: str, callback: Callable[[ReceivedMessage], None]) -> None:
        """Receive a topic from now on, also after its publisher or the master was away."""

    def serve(self, name: str, call: Callable[[], Answer]) -> None:
        """A service without a request (std_srvs/Trigger), `~name`."""

    def serve_switch(self, name: str, call: Callable[[bool], Answer]) -> None:
        """A service that takes on or off (std_srvs/SetBool), `~name`."""

    def publish_static(self, edges: Mapping[tuple[str, str], SE3]) -> None:
        """`parent_from_child` by (parent, child) on /tf_static, kept for those who come later."""

    def publish_status(self, entries: Sequence[NodeStatus]) -> None:
        """On /diagnostics."""

    def publish_jpeg(self, name: str, timestamp_ns: int, frame_id: str, jpeg: bytes) -> None:
        """A compressed image on `~name/compressed`."""

    def listeners(self, name: str) -> int:
        """How many receive `~name/compressed` now: nobody draws a picture that nobody looks at."""

    def close(self) -> None:
        """Leave the graph."""
