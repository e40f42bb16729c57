"""A node by `rclpy`, where a ROS environment is sourced: with its middleware, security, parameters.

Messages stay serialized on both sides: their definitions are those of the node over DDS.
"""

import logging
from collections.abc import Mapping
from dataclasses import asdict
from importlib import import_module
from typing import Any

from orthonav.core.errors import OutputError
from orthonav.onboard.ros2.arguments import RosArguments
from orthonav.onboard.ros2.graph import Definitions, Graph, Handler, Writer
from orthonav.onboard.ros2.node import Node

log = logging.getLogger(__name__)
_NEEDS_ROS = {
    "RMW_IMPLEMENTATION": "zenoh",
    "ROS_SECURITY_ENABLE": "true",
    "ROS_DISCOVERY_SERVER": "",
}
"""Variables, and what in their values, only ROS itself can do."""


def joined_graph(arguments: RosArguments, environment: Mapping[str, str]) -> Graph:
    """A node by `rclpy` where a ROS environment is sourced, else over DDS."""
    if environment.get("AMENT_PREFIX_PATH"):
        try:
            import_module("rclpy")
        except ImportError as error:
            log.warning("rclpy of the sourced ROS environment cannot be used (%s)", error)
        else:
            return RclNode(arguments)
    for name, part in _NEEDS_ROS.items():
        value = environment.get(name, "")
        if value and part in value:
            log.warning("%s=%s has no effect without a sourced ROS environment", name, value)
    return Node(arguments)


class RclWriter:
    def __init__(self, topic: str, definitions: Definitions, publisher: Any) -> None:
        """`publisher` is None where ROS has no such message: nothing is sent."""
        self._topic, self._definitions, self._publisher = topic, definitions, publisher

    def write(self, message: Any) -> None:
        if self._publisher is None:
            return
        try:
            self._publisher.publish(self._definitions.encoded(message))
        except Exception as error:  # of the middleware
            raise OSError(f"cannot publish on {self._topic} ({error})") from error


class RclNode(Graph):
    def __init__(self, arguments: RosArguments) -> None:
        super().__init__(arguments)
        self._rclpy, self._qos = import_module("rclpy"), import_module("rclpy.qos")
        self._subscriptions: list[tuple[Any, str]] = []
        self._handled = 0
        self._publishers: list[tuple[Any, str]] = []
        try:
            self._context = self._rclpy.Context()
            self._rclpy.init(
                args=["--ros-args", *arguments.passed],
                context=self._context,
                signal_handler_options=import_module("rclpy.signals").SignalHandlerOptions.NO,
            )
            own = asdict(arguments.parameters)
            made = import_module("rclpy.parameter").Parameter
            self._node = self._rclpy.create_node(
                arguments.node,
                namespace=arguments.namespace,
                context=self._context,
                use_global_arguments=False,  # names are resolved already
                enable_rosout=False,  # as over DDS, see `rosout`
                parameter_overrides=[made(name, value=value) for name, value in own.items()],
            )
        except Exception as error:  # of the middleware
            raise OutputError(f"cannot join the ROS graph: {error}") from error
        read_only = import_module("rcl_interfaces.msg").ParameterDescriptor(read_only=True)
        for name, value in own.items():
            if not self._node.has_parameter(name):
                self._node.declare_parameter(name, value, read_only)
        self._executor = import_module("rclpy.executors").SingleThreadedExecutor(
            context=self._context
        )
        self._executor.add_node(self._node)

    def subscribe(
        self, topic: str, kind: str, handler: Handler, *, depth: int = 5, reliable: bool = False
    ) -> None:
        def take(cdr: bytes) -> None:
            self._handled += 1
            self._handle(topic, kind, handler, cdr)

        qos = self._made_qos(depth, reliable=reliable)
        made = self._node.create_subscription(_message(kind), topic, take, qos, raw=True)
        self._subscriptions.append((made, kind))

    def advertise(self, topic: str, kind: str, *, depth: int = 10, latched: bool = False) -> Writer:
        """See `Graph.advertise`; without a message of ROS nothing is sent, and that is logged."""
        made = None
        try:
            qos = self._made_qos(depth, reliable=True, latched=latched)
            made = self._node.create_publisher(_message(kind), topic, qos)
        except ImportError:
            log.warning("nothing is published on %s: ROS has no %s here", topic, kind)
        else:
            self._publishers.append((made, kind))
        return RclWriter(topic, self.definitions, made)

    def spin(self, timeout_s: float) -> int:
        self._handled = 0
        self._executor.spin_once(timeout_s)
        for made, _ in self._subscriptions:  # spin_once handles one message
            with made.handle:
                for _ in range(made.qos_profile.depth):
                    taken = made.handle.take_message(made.msg_type, True)
                    if taken is None:
                        break
                    made.callback(taken[0])
        return self._handled

    def close(self) -> None:
        self._executor.shutdown()
        self._node.destroy_node()
        self._context.try_shutdown()

    def _mismatches(self) -> dict[str, str]:
        found: dict[str, str] = {}
        for made, kind in self._subscriptions:
            for other in self._node.get_publishers_info_by_topic(made.topic_name):
                why = self._unmatched(other.qos_profile, made.qos_profile, "a publisher")
                self._mismatch(found, made.topic_name, kind, other.topic_type, why)
        for made, kind in self._publishers:
            for other in self._node.get_subscriptions_info_by_topic(made.topic_name):
                why = self._unmatched(made.qos_profile, other.qos_profile, "a subscriber")
                self._mismatch(found, made.topic_name, kind, other.topic_type, why)
        return found

    def _unmatched(self, offered: Any, requested: Any, other: str) -> str:
        """Why a subscription does not match a publisher; "" where it does."""
        reliability, durability = self._qos.ReliabilityPolicy, self._qos.DurabilityPolicy
        policy = ""
        if requested.reliability == reliability.RELIABLE != offered.reliability:
            policy = "reliability"
        elif requested.durability == durability.TRANSIENT_LOCAL != offered.durability:
            policy = "durability"
        return f"{other} has QoS that does not match ours: {policy}" if policy else ""

    def _made_qos(self, depth: int, *, reliable: bool, latched: bool = False) -> Any:
        qos = self._qos
        return qos.QoSProfile(
            depth=depth,
            reliability=qos.ReliabilityPolicy.RELIABLE
            if reliable
            else qos.ReliabilityPolicy.BEST_EFFORT,
            durability=qos.DurabilityPolicy.TRANSIENT_LOCAL
            if latched
            else qos.DurabilityPolicy.VOLATILE,
        )


def _message(kind: str) -> Any:
    """The class of a message type of ROS. Raises `ImportError` where ROS does not have it."""
    package, _, name = kind.split("/")
    return getattr(import_module(f"{package}.msg"), name)
