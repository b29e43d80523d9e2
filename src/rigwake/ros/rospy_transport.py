"""ROS 1 through rospy. Messages are received and published as bytes where their content does not matter."""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from rigwake.errors import HostError
from rigwake.geometry.se3 import SE3
from rigwake.readers.channels import Encoding, standard_type_name
from rigwake.ros.debian_packages import provide_rospy
from rigwake.ros.transport import Answer, NodeStatus, ReceivedMessage

_BUFFER_BYTES = 64 << 20  # of a connection: a smaller one delays large images
_LOOK_EVERY_S = 1.0


class RospyTransport:
    """A node of a ROS 1 graph. Registers again when the master was restarted.

    remappings: as roslaunch gives them (`__name:=x`). Raises HostError where ROS or its master is missing.
    """

    encoding: Encoding = "ros1"

    def __init__(self, name: str, remappings: Sequence[str] = ()) -> None:
        provide_rospy()
        import rosgraph
        import rospy

        if not rosgraph.is_master_online():
            raise HostError(
                f"No ROS master answers at {rosgraph.get_master_uri()}.",
                consequence="The node was not started.",
                remedy="Start `roscore`, or set ROS_MASTER_URI to where it runs.",
            )
        self._rospy = rospy
        rospy.init_node(name, argv=["rigwake", *remappings], disable_signals=True)
        self._master = rosgraph.Master(rospy.get_name())
        self._static: dict[tuple[str, str], SE3] = {}
        self._publishers: dict[str, Any] = {}
        self._stopped = threading.Event()
        self._watcher = threading.Thread(target=self._watch_master, daemon=True, name="master")
        self._watcher.start()

    def own_name(self) -> str:
        """See `Transport.own_name`."""
        return str(self._rospy.get_name())

    def topics(self) -> dict[str, str]:
        """See `Transport.topics`."""
        try:
            return {topic: standard_type_name(kind) for topic, kind in self._master.getPublishedTopics("")}
        except Exception:  # the master is away: sockets, timeouts, faults of XML-RPC
            return {}

    def subscribe(self, topic: str, message_type: str, callback: Callable[[ReceivedMessage], None]) -> None:
        """See `Transport.subscribe`. What has another type than it had at first is not passed on."""
        rospy = self._rospy

        def received(message: Any) -> None:
            header = getattr(message, "_connection_header", None) or {}
            kind = standard_type_name(header.get("type", message_type))
            if kind == message_type:
                now_ns = rospy.get_rostime().to_nsec()
                publisher = header.get("callerid", "")
                callback(ReceivedMessage(topic, kind, "ros1", now_ns, message._buff, publisher))

        rospy.Subscriber(topic, rospy.AnyMsg, received, buff_size=_BUFFER_BYTES, tcp_nodelay=True)

    def serve(self, name: str, call: Callable[[], Answer]) -> None:
        """See `Transport.serve`."""
        from std_srvs.srv import Trigger, TriggerResponse

        self._rospy.Service(f"~{name}", Trigger, lambda request: TriggerResponse(*call()))

    def serve_switch(self, name: str, call: Callable[[bool], Answer]) -> None:
        """See `Transport.serve_switch`."""
        from std_srvs.srv import SetBool, SetBoolResponse

        self._rospy.Service(f"~{name}", SetBool, lambda request: SetBoolResponse(*call(bool(request.data))))

    def publish_static(self, edges: Mapping[tuple[str, str], SE3]) -> None:
        """See `Transport.publish_static`. One latched message holds all that was published so far."""
        from geometry_msgs.msg import TransformStamped
        from tf2_msgs.msg import TFMessage

        self._static.update(edges)
        message = TFMessage()
        for (parent, child), transform in self._static.items():
            stamped = TransformStamped()
            stamped.header.stamp, stamped.header.frame_id = self._rospy.get_rostime(), parent
            stamped.child_frame_id = child
            place, turn = stamped.transform.translation, stamped.transform.rotation
            place.x, place.y, place.z = map(float, transform.translation)
            turn.w, turn.x, turn.y, turn.z = map(float, transform.quat_wxyz)
            message.transforms.append(stamped)
        self._publisher("/tf_static", TFMessage, latch=True).publish(message)

    def publish_status(self, entries: Sequence[NodeStatus]) -> None:
        """See `Transport.publish_status`."""
        from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue

        array = DiagnosticArray()
        array.header.stamp = self._rospy.get_rostime()
        for entry in entries:
            values = [KeyValue(key, value) for key, value in entry.values.items()]
            name = f"{self.own_name().lstrip('/')}: {entry.name}"
            array.status.append(DiagnosticStatus(int(entry.level), name, entry.message, "rigwake", values))
        self._publisher("/diagnostics", DiagnosticArray).publish(array)

    def publish_jpeg(self, name: str, timestamp_ns: int, frame_id: str, jpeg: bytes) -> None:
        """See `Transport.publish_jpeg`."""
        from sensor_msgs.msg import CompressedImage

        message = CompressedImage(format="jpeg", data=jpeg)
        message.header.stamp = self._rospy.Time(*divmod(timestamp_ns, 10**9))
        message.header.frame_id = frame_id
        self._publisher(f"~{name}/compressed", CompressedImage).publish(message)

    def listeners(self, name: str) -> int:
        """See `Transport.listeners`."""
        from sensor_msgs.msg import CompressedImage

        return int(self._publisher(f"~{name}/compressed", CompressedImage).get_num_connections())

    def _publisher(self, topic: str, kind: Any, *, latch: bool = False) -> Any:
        if topic not in self._publishers:
            self._publishers[topic] = self._rospy.Publisher(topic, kind, queue_size=2, latch=latch)
        return self._publishers[topic]

    def _watch_master(self) -> None:
        """rospy registers once; a master that was restarted knows nobody."""
        process = self._pid_of_master()
        while not self._stopped.wait(_LOOK_EVERY_S):
            now = self._pid_of_master()
            if now is not None and now != process:
                with contextlib.suppress(Exception):  # it may be gone again: the next look tries anew
                    self._register_again()
                    process = now

    def _pid_of_master(self) -> int | None:
        try:
            return int(self._master.getPid())
        except Exception:  # sockets, timeouts, faults of XML-RPC
            return None

    def _register_again(self) -> None:
        from rospy.impl.registration import Registration, get_service_manager, get_topic_manager
        from rospy.impl.registration import get_registration_listeners as listeners

        for topic, kind in get_topic_manager().get_publications():
            listeners().notify_added(topic, kind, Registration.PUB)
        for topic, kind in get_topic_manager().get_subscriptions():
            listeners().notify_added(topic, kind, Registration.SUB)
        manager = get_service_manager()
        for service, _ in manager.get_services():
            listeners().notify_added(service, manager.get_service(service).uri, Registration.SRV)

    def close(self) -> None:
        """See `Transport.close`."""
        self._stopped.set()
        self._rospy.signal_shutdown("closed")
