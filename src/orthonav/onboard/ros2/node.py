"""A node of a ROS 2 graph: DDS readers and writers under the names, types and QoS of ROS 2.

QoS profiles: https://docs.ros.org/en/rolling/Concepts/Intermediate/About-Quality-of-Service-Settings.html
"""

import logging
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from orthonav.errors import OutputError, described
from orthonav.onboard.ros2.arguments import RosArguments
from orthonav.onboard.ros2.messages import (
    Definitions,
    dds_type_name,
    ros2_module,
    ros_type_name,
)

log = logging.getLogger(__name__)
LOOPBACK_ONLY = """<CycloneDDS><Domain><General><AllowMulticast>false</AllowMulticast><Interfaces>
<NetworkInterface address="127.0.0.1"/></Interfaces></General><Discovery><ParticipantIndex>auto
</ParticipantIndex><Peers><Peer address="127.0.0.1"/></Peers></Discovery></Domain></CycloneDDS>"""
"""Configuration of Cyclone DDS for ROS_LOCALHOST_ONLY=1."""
_POLICIES = {
    **{2: "durability", 4: "deadline", 6: "ownership", 8: "liveliness", 11: "reliability"},
    24: "type consistency (message definitions of another distribution: set ROS_DISTRO)",
}
_BLOCK_NS = 10_000_000
Handler = Callable[[Any, bytes], None]


@dataclass(frozen=True)
class Subscription:
    """A topic that is read: its resolved name, message type, DDS reader and handler."""

    topic: str
    kind: str
    reader: Any
    depth: int
    handler: Handler


class Writer:
    """Sends messages of one topic."""

    def __init__(self, topic: str, kind: str, definitions: Definitions, writer: Any) -> None:
        self.topic, self.kind, self.writer = topic, kind, writer
        self._definitions, self._sample = definitions, writer.topic.data_type

    def write(self, message: Any) -> None:
        """Send one message. Raises `OSError` where DDS does not take it."""
        sample = self._sample()
        sample.cdr = self._definitions.encoded(message)
        try:
            self.writer.write(sample)
        except Exception as error:  # DDSException
            raise OSError(f"cannot publish on {self.topic} ({error})") from error


class Node:
    """Reads and writes topics of one DDS domain. `spin` is for one thread, writers for any.

    `problems` says by topic why nothing can flow there: another type, or QoS that does not match.
    `undecodable` counts damaged messages by topic.
    """

    def __init__(self, arguments: RosArguments) -> None:
        """Raises `MissingExtraError`, or `OutputError` where DDS has no network interface."""
        self.arguments, self.definitions = arguments, Definitions(arguments.distro)
        self.problems: dict[str, str] = {}
        self.undecodable: Counter[str] = Counter()
        self._core, self._qos = ros2_module("cyclonedds.core"), ros2_module("cyclonedds.qos")
        domain, builtin = ros2_module("cyclonedds.domain"), ros2_module("cyclonedds.builtin")
        self._domain = None
        try:
            if arguments.is_local:
                self._domain = domain.Domain(arguments.domain_id, LOOPBACK_ONLY)
            self._participant = domain.DomainParticipant(arguments.domain_id)
        except self._core.DDSException as error:
            raise OutputError(f"cannot join DDS domain {arguments.domain_id}: {error}") from error
        self._subscriptions: list[Subscription] = []
        self._writers: list[Writer] = []
        self._conditions: list[Any] = []
        self._waitset = self._core.WaitSet(self._participant)
        self._endpoints = [
            builtin.BuiltinDataReader(self._participant, topic)
            for topic in (
                builtin.BuiltinTopicDcpsPublication,
                builtin.BuiltinTopicDcpsSubscription,
            )
        ]

    def subscribe(
        self, topic: str, kind: str, handler: Handler, *, depth: int = 5, reliable: bool = False
    ) -> None:
        """Hand each message on `topic` (resolved already) to `handler`, with its raw sample.

        The QoS is that of sensor data: best effort, volatile, the last `depth` messages.
        """
        qos = self._made_qos(kind, reliable=reliable, depth=depth)
        sub = ros2_module("cyclonedds.sub")
        reader = sub.DataReader(self._participant, self._topic(topic, kind), qos)
        states = self._core
        mask = states.ViewState.Any | states.InstanceState.Any | states.SampleState.NotRead
        self._conditions.append(states.ReadCondition(reader, mask))
        self._waitset.attach(self._conditions[-1])
        self._subscriptions.append(Subscription(topic, kind, reader, depth, handler))

    def advertise(self, topic: str, kind: str, *, depth: int = 10, latched: bool = False) -> Writer:
        """A writer of `topic` (resolved already): reliable, and transient local if `latched`."""
        qos = self._made_qos(kind, reliable=True, depth=depth, latched=latched)
        pub = ros2_module("cyclonedds.pub")
        made = pub.DataWriter(self._participant, self._topic(topic, kind), qos)
        self._writers.append(Writer(topic, kind, self.definitions, made))
        return self._writers[-1]

    def spin(self, timeout_s: float) -> int:
        """Wait at most so long for messages and handle those that are there; how many."""
        self._waitset.wait(round(timeout_s * 1e9))
        return sum(self._taken(each) for each in self._subscriptions)

    def check_graph(self) -> None:
        """Look for endpoints of our topics that cannot match; each problem is logged once."""
        expected = {each.topic: each.kind for each in self._subscriptions}
        expected |= {each.topic: each.kind for each in self._writers}
        for reader in self._endpoints:
            for endpoint in self._discovered(reader):
                topic = str(endpoint.topic_name).removeprefix("rt")
                kind = expected.get(topic)
                if kind is not None and endpoint.type_name != dds_type_name(kind):
                    found = ros_type_name(str(endpoint.type_name))
                    self._problem(topic, f"is of type {found}; expected {kind}")
        for each in self._subscriptions:
            status = each.reader.get_requested_incompatible_qos_status()
            self._qos_problem(each.topic, status, "a publisher")
        for writer in self._writers:
            status = writer.writer.get_offered_incompatible_qos_status()
            self._qos_problem(writer.topic, status, "a subscriber")

    def close(self) -> None:
        """Leave the graph."""
        for held in (self._endpoints, self._conditions, self._subscriptions, self._writers):
            held.clear()
        self._waitset = self._participant = self._domain = None

    def _topic(self, name: str, kind: str) -> Any:
        made = ros2_module("cyclonedds.topic")
        return made.Topic(self._participant, f"rt{name}", self.definitions.dds_type(kind))

    def _made_qos(self, kind: str, *, reliable: bool, depth: int, latched: bool = False) -> Any:
        policy = self._qos.Policy
        reliability = policy.Reliability
        return self._qos.Qos(
            reliability.Reliable(_BLOCK_NS) if reliable else reliability.BestEffort,
            policy.Durability.TransientLocal if latched else policy.Durability.Volatile,
            policy.History.KeepLast(depth),
            policy.DataRepresentation(use_cdrv0_representation=True),
            policy.Userdata(self.definitions.type_hash(kind)),
        )

    def _taken(self, subscription: Subscription) -> int:
        handled = 0
        for sample in subscription.reader.take(subscription.depth):
            cdr = getattr(sample, "cdr", None)
            if cdr is None:  # only says that a writer left
                continue
            try:
                message = self.definitions.decoded(subscription.kind, cdr)
                subscription.handler(message, cdr)
            except Exception as error:  # one odd message never ends a flight
                if not self.undecodable[subscription.topic]:
                    why = described(error)
                    log.warning("message on %s cannot be used (%s)", subscription.topic, why)
                self.undecodable[subscription.topic] += 1
            handled += 1
        return handled

    def _discovered(self, reader: Any) -> list[Any]:
        try:
            return list(reader.take(100))
        except Exception as error:  # a policy of another vendor that the library cannot name
            log.debug("discovery: %r", error)
            return []

    def _qos_problem(self, topic: str, status: Any, other: str) -> None:
        if status.total_count > 0 and topic not in self.problems:
            policy = _POLICIES.get(status.last_policy_id, f"policy {status.last_policy_id}")
            self._problem(topic, f"{other} has QoS that does not match ours: {policy}")

    def _problem(self, topic: str, text: str) -> None:
        if self.problems.get(topic) != text:
            self.problems[topic] = text
            log.warning("topic %s %s", topic, text)
