"""ROS 2 through rclpy. Messages are received and published as serialized bytes, so that nothing is converted."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from rigwake.errors import HostError
from rigwake.geometry.se3 import SE3
from rigwake.readers.channels import Encoding
from rigwake.ros.cdr_messages import diagnostics_cdr, jpeg_cdr, transforms_cdr
from rigwake.ros.recorder import is_sent_once
from rigwake.ros.transport import COMPRESSED_IMAGE, TRANSFORMS, Answer, NodeStatus, ReceivedMessage

_DEPTH = 50  # messages of a topic that wait for the callback
_OWN_STATIC = 8  # of our last messages on /tf_static, to know them when they come back
_DIAGNOSTICS = "diagnostic_msgs/msg/DiagnosticArray"


def provide_rclpy() -> None:
    """Raises HostError where rclpy cannot be imported."""
    try:
        import rclpy
        import rosidl_runtime_py.utilities  # noqa: F401
    except ImportError as error:
        raise HostError(
            f"ROS 2 is not usable here: {error}.",
            consequence="The node cannot run; everything else of rigwake can.",
            remedy="source /opt/ros/DISTRIBUTION/setup.bash, and run rigwake with the Python that this ROS was "
            "built for.",
        ) from error
    assert rclpy is not None


class RclpyTransport:
    """A node of a ROS 2 graph; callbacks come from a thread of its own.

    remappings: `NAME:=VALUE`; `__name:=x`, as in ROS 1, is understood as `__node:=x`. Raises HostError without ROS 2.
    """

    encoding: Encoding = "cdr"

    def __init__(self, name: str, remappings: Sequence[str] = ()) -> None:
        provide_rclpy()
        import rclpy
        from rclpy.executors import SingleThreadedExecutor
        from rclpy.signals import SignalHandlerOptions

        words = [
            part for remapping in remappings for part in ("-r", remapping.replace("__name:=", "__node:="))
        ]
        rclpy.init(
            args=["rigwake", "--ros-args", *words] if words else ["rigwake"],
            signal_handler_options=SignalHandlerOptions.NO,  # Ctrl-C is the command line's
        )
        self._rclpy, self._node = rclpy, rclpy.create_node(name)
        self._publishers: dict[str, Any] = {}
        self._static: dict[tuple[str, str], SE3] = {}
        self._sent_static: deque[bytes] = deque(maxlen=_OWN_STATIC)
        self._kept: list[Any] = []  # rclpy forgets what nobody holds
        self._executor = SingleThreadedExecutor()
        self._executor.add_node(self._node)
        self._thread = threading.Thread(target=self._spin, daemon=True, name="rclpy")
        self._thread.start()

    def _spin(self) -> None:
        from rclpy.executors import ExternalShutdownException

        try:
            self._executor.spin()
        except ExternalShutdownException:
            return

    def own_name(self) -> str:
        """See `Transport.own_name`."""
        return str(self._node.get_fully_qualified_name())

    def topics(self) -> dict[str, str]:
        """See `Transport.topics`. Of a topic with several types none is taken: nobody could tell them apart."""
        return {
            topic: kinds[0]
            for topic, kinds in self._node.get_topic_names_and_types()
            if len(kinds) == 1 and self._node.count_publishers(topic) > 0
        }

    def subscribe(self, topic: str, message_type: str, callback: Callable[[ReceivedMessage], None]) -> None:
        """See `Transport.subscribe`."""

        def received(payload: bytes) -> None:
            own = topic == "/tf_static" and any(payload.startswith(sent) for sent in self._sent_static)
            publisher = self.own_name() if own else ""
            callback(ReceivedMessage(topic, message_type, "cdr", self._now_ns(), bytes(payload), publisher))

        quality = self._quality_of_publishers(topic)
        kind = _message_class(message_type)
        self._kept.append(self._node.create_subscription(kind, topic, received, quality, raw=True))

    def _quality_of_publishers(self, topic: str) -> Any:
        """A subscription that asks for more than a publisher offers receives nothing from it."""
        from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

        offered = [info.qos_profile for info in self._node.get_publishers_info_by_topic(topic)]
        all_reliable = bool(offered) and all(o.reliability == ReliabilityPolicy.RELIABLE for o in offered)
        all_kept = bool(offered) and all(o.durability == DurabilityPolicy.TRANSIENT_LOCAL for o in offered)
        return QoSProfile(
            depth=_DEPTH,
            reliability=ReliabilityPolicy.RELIABLE if all_reliable else ReliabilityPolicy.BEST_EFFORT,
            durability=DurabilityPolicy.TRANSIENT_LOCAL
            if all_kept and is_sent_once(topic)
            else DurabilityPolicy.VOLATILE,
        )

    def serve(self, name: str, call: Callable[[], Answer]) -> None:
        """See `Transport.serve`."""
        from std_srvs.srv import Trigger

        self._serve(Trigger, name, lambda request: call())

    def serve_switch(self, name: str, call: Callable[[bool], Answer]) -> None:
        """See `Transport.serve_switch`."""
        from std_srvs.srv import SetBool

        self._serve(SetBool, name, lambda request: call(bool(request.data)))

    def _serve(self, kind: Any, name: str, call: Callable[[Any], Answer]) -> None:
        def answer(request: Any, response: Any) -> Any:
            response.success, response.message = call(request)
            return response

        self._kept.append(self._node.create_service(kind, f"~/{name}", answer))

    def publish_static(self, edges: Mapping[tuple[str, str], SE3]) -> None:
        """See `Transport.publish_static`. One message, kept for those who come later, holds all that was published."""
        self._static.update(edges)
        payload = transforms_cdr(self._static, self._now_ns())
        self._sent_static.append(payload)
        self._publisher("/tf_static", TRANSFORMS, kept=True).publish(payload)

    def publish_status(self, entries: Sequence[NodeStatus]) -> None:
        """See `Transport.publish_status`."""
        payload = diagnostics_cdr(entries, self.own_name().lstrip("/"), self._now_ns())
        self._publisher("/diagnostics", _DIAGNOSTICS).publish(payload)

    def publish_jpeg(self, name: str, timestamp_ns: int, frame_id: str, jpeg: bytes) -> None:
        """See `Transport.publish_jpeg`."""
        self._publisher(f"~/{name}/compressed", COMPRESSED_IMAGE).publish(
            jpeg_cdr(jpeg, timestamp_ns, frame_id)
        )

    def listeners(self, name: str) -> int:
        """See `Transport.listeners`."""
        return int(self._publisher(f"~/{name}/compressed", COMPRESSED_IMAGE).get_subscription_count())

    def _publisher(self, topic: str, message_type: str, *, kept: bool = False) -> Any:
        from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

        if topic not in self._publishers:
            quality = QoSProfile(
                depth=1 if kept else 10,
                reliability=ReliabilityPolicy.RELIABLE,
                durability=DurabilityPolicy.TRANSIENT_LOCAL if kept else DurabilityPolicy.VOLATILE,
            )
            self._publishers[topic] = self._node.create_publisher(
                _message_class(message_type), topic, quality
            )
        return self._publishers[topic]

    def _now_ns(self) -> int:
        return int(self._node.get_clock().now().nanoseconds)

    def close(self) -> None:
        """See `Transport.close`."""
        self._executor.shutdown()
        self._thread.join(5.0)
        self._node.destroy_node()
        self._rclpy.try_shutdown()


def _message_class(message_type: str) -> Any:
    from rosidl_runtime_py.utilities import get_message

    return get_message(message_type)
