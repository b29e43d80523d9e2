"""A stand-in for ROS 2's Python packages: the calls and rules of rclpy's documentation, in one process, no network.

It holds what rclpy holds to: a subscription that asks for more than a publisher offers receives nothing; the last
messages of a transient-local publisher reach those who come later; raw subscriptions receive bytes; publishers take
bytes or messages of their own class; callbacks run in the thread of the executor.
"""

from __future__ import annotations

import queue
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from enum import IntEnum
from types import ModuleType, SimpleNamespace
from typing import Any

import pytest


class ReliabilityPolicy(IntEnum):
    RELIABLE = 1
    BEST_EFFORT = 2


class DurabilityPolicy(IntEnum):
    TRANSIENT_LOCAL = 1
    VOLATILE = 2


@dataclass(frozen=True)
class QoSProfile:
    depth: int
    reliability: ReliabilityPolicy = ReliabilityPolicy.RELIABLE
    durability: DurabilityPolicy = DurabilityPolicy.VOLATILE

    def satisfies(self, asked: QoSProfile) -> bool:
        return self.reliability <= asked.reliability and self.durability <= asked.durability


class ExternalShutdownException(Exception):  # noqa: N818 - as rclpy names it
    pass


class SignalHandlerOptions(IntEnum):
    NO = 0
    ALL = 3


@dataclass
class FakePublisher:
    graph: FakeGraph
    topic: str
    kind: type
    quality: QoSProfile
    sent: list[bytes] = field(default_factory=list)

    def publish(self, message: Any) -> None:
        if not isinstance(message, (bytes, self.kind)):
            raise TypeError(f"Expected {self.kind}, got {type(message)}")
        assert isinstance(message, bytes), "the tests publish bytes"
        self.sent.append(message)
        for subscription in self.graph.matched(self):
            self.graph.calls.put((subscription.callback, message))

    def get_subscription_count(self) -> int:
        return len(self.graph.matched(self)) + self.graph.outside.get(self.topic, 0)


@dataclass
class FakeSubscription:
    topic: str
    kind: type
    callback: Callable[[bytes], None]
    quality: QoSProfile


@dataclass
class FakeGraph:
    """Everything that is in the graph. outside: subscribers of other processes, by topic. now_ns: the ROS clock."""

    publishers: list[FakePublisher] = field(default_factory=list)
    subscriptions: list[FakeSubscription] = field(default_factory=list)
    services: dict[str, tuple[type, Callable[[Any, Any], Any]]] = field(default_factory=dict)
    outside: dict[str, int] = field(default_factory=dict)
    calls: queue.Queue[Any] = field(default_factory=queue.Queue)
    now_ns: int = 1_700_000_000_123_456_789
    init_args: list[str] = field(default_factory=list)
    is_on: bool = False

    def matched(self, publisher: FakePublisher) -> list[FakeSubscription]:
        return [
            s
            for s in self.subscriptions
            if s.topic == publisher.topic
            and s.kind is publisher.kind
            and publisher.quality.satisfies(s.quality)
        ]

    def advertise(self, topic: str, message_type: str, quality: QoSProfile) -> FakePublisher:
        """Another node's publisher."""
        publisher = FakePublisher(self, topic, message_class(message_type), quality)
        self.publishers.append(publisher)
        return publisher

    def call(self, service: str, **request: Any) -> tuple[bool, str]:
        """As a client of another node calls a service."""
        kind, answer = self.services[service]
        response = answer(SimpleNamespace(**request), kind.Response())  # type: ignore[attr-defined]
        return response.success, response.message


class FakeNode:
    def __init__(self, graph: FakeGraph, name: str) -> None:
        self._graph, self._name = graph, name

    def get_fully_qualified_name(self) -> str:
        return f"/{self._name}"

    def _expanded(self, topic: str) -> str:
        return topic.replace("~", f"/{self._name}", 1) if topic.startswith("~") else topic

    def get_topic_names_and_types(self) -> list[tuple[str, list[str]]]:
        kinds: dict[str, set[str]] = {}
        for end in (*self._graph.publishers, *self._graph.subscriptions):
            kinds.setdefault(end.topic, set()).add(end.kind.__name__)
        return [(topic, sorted(found)) for topic, found in kinds.items()]

    def count_publishers(self, topic: str) -> int:
        return len(self.get_publishers_info_by_topic(topic))

    def get_publishers_info_by_topic(self, topic: str) -> list[Any]:
        return [SimpleNamespace(qos_profile=p.quality) for p in self._graph.publishers if p.topic == topic]

    def create_subscription(
        self,
        kind: type,
        topic: str,
        callback: Callable[[bytes], None],
        quality: QoSProfile,
        *,
        raw: bool = False,
    ) -> FakeSubscription:
        assert raw, "the node receives bytes"
        subscription = FakeSubscription(topic, kind, callback, quality)
        self._graph.subscriptions.append(subscription)
        for publisher in self._graph.publishers:
            both = {publisher.quality.durability, quality.durability}
            if both == {DurabilityPolicy.TRANSIENT_LOCAL} and subscription in self._graph.matched(publisher):
                for message in publisher.sent[-publisher.quality.depth :]:
                    self._graph.calls.put((callback, message))
        return subscription

    def create_publisher(self, kind: type, topic: str, quality: QoSProfile) -> FakePublisher:
        publisher = FakePublisher(self._graph, self._expanded(topic), kind, quality)
        self._graph.publishers.append(publisher)
        return publisher

    def create_service(self, kind: type, name: str, answer: Callable[[Any, Any], Any]) -> object:
        self._graph.services[self._expanded(name)] = (kind, answer)
        return object()

    def get_clock(self) -> Any:
        return SimpleNamespace(now=lambda: SimpleNamespace(nanoseconds=self._graph.now_ns))

    def destroy_node(self) -> None:
        self._graph.subscriptions.clear()


_CLASSES: dict[str, type] = {}


def message_class(message_type: str) -> type:
    package, kind, _ = message_type.split("/")
    assert package, kind == "msg"
    return _CLASSES.setdefault(message_type, type(message_type, (), {}))


class _Executor:
    def __init__(self, graph: FakeGraph) -> None:
        self._graph, self._on = graph, True

    def add_node(self, node: FakeNode) -> None:
        assert isinstance(node, FakeNode)

    def spin(self) -> None:
        while self._on:
            try:
                callback, payload = self._graph.calls.get(timeout=0.02)
            except queue.Empty:
                continue
            callback(payload)

    def shutdown(self) -> None:
        self._on = False


def _service() -> type:
    return type("Service", (), {"Response": lambda: SimpleNamespace(success=False, message="")})


def install(monkeypatch: pytest.MonkeyPatch) -> FakeGraph:
    """Make the stand-in importable as rclpy; the graph that its nodes are in."""
    graph = FakeGraph()

    def init(
        args: list[str] | None = None, signal_handler_options: SignalHandlerOptions | None = None
    ) -> None:
        assert signal_handler_options is SignalHandlerOptions.NO
        graph.is_on, graph.init_args = True, list(args or [])

    def try_shutdown() -> None:
        graph.is_on = False

    modules = {
        "rclpy": {
            "init": init,
            "create_node": lambda name: FakeNode(graph, name),
            "try_shutdown": try_shutdown,
        },
        "rclpy.executors": {
            "SingleThreadedExecutor": lambda: _Executor(graph),
            "ExternalShutdownException": ExternalShutdownException,
        },
        "rclpy.signals": {"SignalHandlerOptions": SignalHandlerOptions},
        "rclpy.qos": {
            "QoSProfile": QoSProfile,
            "ReliabilityPolicy": ReliabilityPolicy,
            "DurabilityPolicy": DurabilityPolicy,
        },
        "rosidl_runtime_py": {},
        "rosidl_runtime_py.utilities": {"get_message": message_class},
        "std_srvs": {},
        "std_srvs.srv": {"Trigger": _service(), "SetBool": _service()},
    }
    for name, members in modules.items():
        module = ModuleType(name)
        module.__dict__.update(members)
        monkeypatch.setitem(sys.modules, name, module)
    return graph


def settle(graph: FakeGraph, seconds: float = 10.0) -> None:
    """Wait until all messages were received."""
    end = time.monotonic() + seconds
    while not graph.calls.empty():
        assert time.monotonic() < end
        time.sleep(0.01)
    time.sleep(0.05)
