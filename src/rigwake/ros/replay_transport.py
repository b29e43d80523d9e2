"""A recorded bag in place of a ROS graph: the same node, without ROS. ROS 2 bags come through here."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from heapq import merge
from operator import itemgetter

from rigwake.geometry.se3 import SE3
from rigwake.readers.channels import BagIndex, Channel, Encoding
from rigwake.ros.transport import Answer, NodeStatus, ReceivedMessage


class ReplayTransport:
    """Plays the channels of a bag in the order of their recording, as fast as the node takes them.

    static, statuses, images: what the node has published. services: what it serves, by name. listening: who receives
    images, by the name of their topic.
    """

    def __init__(self, bag: BagIndex) -> None:
        self.encoding: Encoding = bag.channels[0].encoding if bag.channels else "cdr"
        self.static: dict[tuple[str, str], SE3] = {}
        self.statuses: list[NodeStatus] = []
        self.images: list[tuple[str, int, bytes]] = []
        self.services: dict[str, Callable[..., Answer]] = {}
        self.listening: dict[str, int] = {}
        self._channels = {channel.topic: channel for channel in bag.channels}
        self._callbacks: dict[str, Callable[[ReceivedMessage], None]] = {}

    def play(self) -> int:
        """Send every message of the subscribed topics; how many."""
        count = 0
        streams = [_stamped(self._channels[topic]) for topic in self._callbacks]
        for received_ns, topic, payload in merge(*streams, key=itemgetter(0)):
            kind = self._channels[topic].message_type
            self._callbacks[topic](ReceivedMessage(topic, kind, self.encoding, received_ns, payload))
            count += 1
        return count

    def own_name(self) -> str:
        """See `Transport.own_name`."""
        return "/rigwake"

    def topics(self) -> dict[str, str]:
        """See `Transport.topics`."""
        return {topic: channel.message_type for topic, channel in self._channels.items()}

    def subscribe(self, topic: str, message_type: str, callback: Callable[[ReceivedMessage], None]) -> None:
        """See `Transport.subscribe`."""
        self._callbacks[topic] = callback

    def serve(self, name: str, call: Callable[[], Answer]) -> None:
        """See `Transport.serve`."""
        self.services[name] = call

    def serve_switch(self, name: str, call: Callable[[bool], Answer]) -> None:
        """See `Transport.serve_switch`."""
        self.services[name] = call

    def publish_static(self, edges: Mapping[tuple[str, str], SE3]) -> None:
        """See `Transport.publish_static`."""
        self.static.update(edges)

    def publish_status(self, entries: Sequence[NodeStatus]) -> None:
        """See `Transport.publish_status`."""
        self.statuses = list(entries)

    def publish_jpeg(self, name: str, timestamp_ns: int, frame_id: str, jpeg: bytes) -> None:
        """See `Transport.publish_jpeg`."""
        self.images.append((name, timestamp_ns, jpeg))

    def listeners(self, name: str) -> int:
        """See `Transport.listeners`."""
        return self.listening.get(name, 0)

    def close(self) -> None:
        """See `Transport.close`."""


def _stamped(channel: Channel):  # type: ignore[no-untyped-def]
    order = channel.log_times_ns.argsort(kind="stable")
    for row, payload in zip(order, channel.payloads.read(order), strict=True):
        yield int(channel.log_times_ns[row]), channel.topic, payload
