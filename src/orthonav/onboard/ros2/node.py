"""A node of a ROS 2 graph by `rclpy`, and the messages themselves.

Messages stay serialized in `rclpy`: they are decoded and encoded by the definitions that `rosbags`
has, by the code that decodes them from a recorded bag.
"""

import contextlib
import importlib
import logging
import math
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, fields
from functools import partial
from typing import Any

from orthonav.core.errors import (
    MissingExtraError,
    OutputError,
    UsageError,
    VariantError,
    described,
)
from orthonav.core.flight.ros_messages import Definitions

log = logging.getLogger(__name__)
_LOG = "rcl_interfaces/msg/Log"
Handler = Callable[[Any, bytes], None]
Writer = Callable[[Any], None]
"""Sends one message. Raises `OSError` where the middleware does not take it."""


@dataclass(frozen=True)
class Parameters:
    """`use_sim_time`: ROS time is that of `/clock`, not the system's. `image_transport`: "raw" or
    "compressed". `image_reliability`: "best_effort" (sensor data) or "reliable", which resends lost
    parts of large pictures and matches reliable writers only. `covariance`: "filter" (larger, for
    a filter that takes positions as independent) or "fix". `altitude` of the fix: "none" (NaN),
    that of the "terrain" of the map plus the height above ground, that of the origin plus the
    height above "home", or a number of metres.

    Raises `VariantError` for a value that is none of these.
    """

    use_sim_time: bool = False
    image_transport: str = "raw"
    image_reliability: str = "best_effort"
    map_frame: str = "map"
    base_frame: str = "base_link"
    covariance: str = "filter"
    altitude: str = "none"

    def __post_init__(self) -> None:
        choices = {
            "image_transport": ("raw", "compressed"),
            "image_reliability": ("best_effort", "reliable"),
            "covariance": ("filter", "fix"),
        }
        for name, allowed in choices.items():
            if getattr(self, name) not in allowed:
                raise VariantError(
                    f"parameter {name} is {' or '.join(allowed)}, got '{getattr(self, name)}'"
                )
        if self.altitude not in ("none", "terrain", "home") and not _is_number(self.altitude):
            raise VariantError(
                f"parameter altitude is none, terrain, home or metres, got '{self.altitude}'"
            )


def declared(declare: Callable[[str, Any], Any], given: Iterable[str]) -> Parameters:
    """Parameters whose values are what `declare` gives for a name and a default.

    Warns of names among those `given` that are no parameters. Raises `VariantError`."""
    values = {each.name: declare(each.name, each.default) for each in fields(Parameters)}
    for name in given:
        if name not in values and not name.startswith("qos_overrides."):  # those are of `rclpy`
            log.warning("parameter %s is ignored; parameters are %s", name, ", ".join(values))
    use_sim_time = values.pop("use_sim_time")
    if not isinstance(use_sim_time, bool):
        raise VariantError(f"parameter use_sim_time is true or false, got '{use_sim_time}'")
    return Parameters(use_sim_time, **{name: str(value) for name, value in values.items()})


def _is_number(text: str) -> bool:
    try:
        return math.isfinite(float(text))
    except ValueError:
        return False


def _ros_module(name: str) -> Any:
    """A module of ROS. Raises `MissingExtraError` where it is missing."""
    try:
        return importlib.import_module(name)
    except ImportError as error:
        package = name.partition(".")[0]
        raise MissingExtraError(
            f"--ros2 needs {package}: source a ROS 2 environment (Python of the same version), or "
            f"on x86-64 pip install 'orthonav[ros2]' (docs/ros2.md) ({described(error)})"
        ) from error


class Node:
    """Reads and writes topics. `spin` is for one thread, writers are for any.

    `problems` says by topic why little or nothing flows there; `rclpy` logs QoS that does not
    match. `undecodable` counts damaged messages by topic, `kinds` are the types of ours.
    """

    def __init__(self, words: Sequence[str] = (), distro: str = "") -> None:
        """`words`: those after `--ros-args`. `distro`: whose message definitions, see there.

        Raises `MissingExtraError`, `UsageError` for words that are none of ROS, `VariantError` for
        an invalid parameter, or `OutputError` where the middleware cannot join.
        """
        self.definitions = Definitions("flights", "--ros2", distro)
        self.problems: dict[str, str] = {}
        self.undecodable: Counter[str] = Counter()
        self.kinds: dict[str, str] = {}
        self._written: set[str] = set()
        self._said: set[tuple[str, str]] = set()
        self._subscriptions: list[Any] = []
        self._handled = 0
        self._opened = contextlib.ExitStack()
        try:
            self.name, self.full_name = self._join(words)
            self.parameters: Parameters = declared(self._declared, self._given())
        except BaseException:
            self.close()
            raise

    def _join(self, words: Sequence[str]) -> tuple[str, str]:
        """Name of the node, and with its namespace."""
        rclpy, self._qos = _ros_module("rclpy"), _ros_module("rclpy.qos")
        signals, executors = _ros_module("rclpy.signals"), _ros_module("rclpy.executors")
        self._context = rclpy.Context()
        try:
            rclpy.init(
                args=["--ros-args", *words],
                context=self._context,
                signal_handler_options=signals.SignalHandlerOptions.NO,
            )
            self._opened.callback(self._context.try_shutdown)
            self._node = rclpy.create_node(
                "orthonav",
                context=self._context,
                enable_rosout=False,  # see `Rosout`
            )
        except Exception as error:  # of the middleware, and of its parser of arguments
            raise _joining_error(error) from error
        self._opened.callback(self._node.destroy_node)
        self._executor = executors.SingleThreadedExecutor(context=self._context)
        self._opened.callback(self._executor.shutdown)
        self._executor.add_node(self._node)
        return self._node.get_name(), self._node.get_fully_qualified_name()

    def _declared(self, name: str, default: Any) -> Any:
        """Value of a parameter, which may be given in another type."""
        if self._node.has_parameter(name):
            return self._node.get_parameter(name).value
        messages = _ros_module("rcl_interfaces.msg")
        descriptor = messages.ParameterDescriptor(dynamic_typing=True)
        return self._node.declare_parameter(name, default, descriptor).value

    def _given(self) -> list[str]:
        """Names of the parameters that were given, but for those that `rclpy` declares itself."""
        given = getattr(self._node, "_parameter_overrides", {})  # has no public name
        return [name for name in given if not self._node.has_parameter(name)]

    def resolved(self, topic: str) -> str:
        """Absolute name of a topic after remapping."""
        return str(self._node.resolve_topic_name(topic))

    def is_remapped(self, topic: str) -> bool:
        expanded = self._node.resolve_topic_name(topic, only_expand=True)
        return bool(self._node.resolve_topic_name(topic) != expanded)

    def subscribe(
        self, topic: str, kind: str, handler: Handler, *, depth: int = 5, reliable: bool = False
    ) -> None:
        """Hand each message on `topic` (resolved already) to `handler`, with its raw sample.

        The QoS is that of sensor data: best effort, volatile, the last `depth` messages.
        """

        qos, message = self._made_qos(depth, reliable=reliable), _message(kind)
        take = partial(self._handle, topic, kind, handler)
        try:
            made = self._node.create_subscription(message, topic, take, qos, raw=True)
        except Exception as error:  # of the middleware
            raise OutputError(f"cannot subscribe to {topic}: {described(error)}") from error
        self._subscriptions.append(made)
        self.kinds[topic] = kind

    def advertise(self, topic: str, kind: str, *, depth: int = 10, latched: bool = False) -> Writer:
        """A writer of `topic` (resolved already): reliable, and transient local if `latched`.

        Where ROS lacks the package of the message nothing is sent, and that is logged.
        """
        try:
            qos = self._made_qos(depth, reliable=True, latched=latched)
            made = self._node.create_publisher(_message(kind), topic, qos)
        except MissingExtraError:
            log.warning("nothing is published on %s: ROS has no %s here", topic, kind)
            return lambda message: None
        except Exception as error:  # of the middleware
            raise OutputError(f"cannot publish on {topic}: {described(error)}") from error
        self.kinds[topic] = kind
        self._written.add(topic)
        return self._writing(topic, made.publish)

    def spin(self, timeout_s: float) -> int:
        """Wait at most so long for messages and handle those that are there; how many."""
        self._handled = 0
        self._executor.spin_once(timeout_s)
        for made in self._subscriptions:  # spin_once handles one message
            with made.handle:
                for _ in range(made.qos_profile.depth):
                    taken = made.handle.take_message(made.msg_type, True)
                    if taken is None:
                        break
                    made.callback(taken[0])
        return self._handled

    def close(self) -> None:
        """Leave the graph."""
        self._opened.close()

    def wrong_types(self) -> dict[str, str]:
        """By topic, where the others there have another type: nothing flows from or to them."""
        found = {}
        for topic, kind in self.kinds.items():
            others = self._types_of_others(topic) - {kind}
            if others:
                found[topic] = f"is of type {', '.join(sorted(others))}; expected {kind}"
        return found

    def _types_of_others(self, topic: str) -> set[str]:
        """Of those who write what we read, and read what we write."""
        find = self._node.get_publishers_info_by_topic
        if topic in self._written:
            find = self._node.get_subscriptions_info_by_topic
        return {each.topic_type for each in find(topic)}

    def note(self, problems: Mapping[str, str]) -> None:
        """Take these problems by topic as the present ones; each is logged once."""
        self.problems = dict(problems)
        for topic, text in problems.items():
            if (topic, text) not in self._said:
                self._said.add((topic, text))
                log.warning("topic %s %s", topic, text)

    def _made_qos(self, depth: int, *, reliable: bool, latched: bool = False) -> Any:
        reliability, durability = self._qos.ReliabilityPolicy, self._qos.DurabilityPolicy
        return self._qos.QoSProfile(
            depth=depth,
            reliability=reliability.RELIABLE if reliable else reliability.BEST_EFFORT,
            durability=durability.TRANSIENT_LOCAL if latched else durability.VOLATILE,
        )

    def _writing(self, topic: str, send: Callable[[bytes], None]) -> Writer:
        def write(message: Any) -> None:
            try:
                send(self.definitions.encoded(message))
            except Exception as error:  # of the middleware
                raise OSError(f"cannot publish on {topic} ({error})") from error

        return write

    def _handle(self, topic: str, kind: str, handler: Handler, cdr: bytes) -> None:
        """Decode a sample and hand it on; one odd message never ends a flight."""
        self._handled += 1
        try:
            handler(self.definitions.decoded(kind, cdr), cdr)
        except Exception as error:
            if not self.undecodable[topic]:
                log.warning("message on %s cannot be used (%s)", topic, described(error))
            self.undecodable[topic] += 1


def _joining_error(error: Exception) -> UsageError | OutputError:
    """`rclpy` has an exception of its own only for some of the words it does not understand."""
    if type(error).__name__.endswith("ROSArgsError") or "Couldn't parse" in str(error):
        return UsageError(f"--ros-args cannot be used: {described(error)}")
    return OutputError(f"cannot join the ROS graph: {described(error)}")


def _message(kind: str) -> Any:
    package, _, name = kind.split("/")
    return getattr(_ros_module(f"{package}.msg"), name)


class Rosout(logging.Handler):
    """Publishes records as `rcl_interfaces/Log`, whose levels are those of Python."""

    def __init__(self, node: Node) -> None:
        super().__init__()
        self._node = node
        self._write = node.advertise(node.resolved("/rosout"), _LOG, depth=100, latched=True)

    def emit(self, record: logging.LogRecord) -> None:
        definitions = self._node.definitions
        with contextlib.suppress(Exception):  # the code that logs must not fail
            message = definitions.new(
                _LOG,
                stamp=definitions.time(round(record.created * 1e9)),
                level=min(record.levelno, logging.CRITICAL),
                name=self._node.full_name.strip("/").replace("/", "."),
                msg=record.getMessage(),
                file=record.pathname,
                function=record.funcName or "",
                line=record.lineno,
            )
            self._write(message)
