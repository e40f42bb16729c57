"""Nodes of a ROS 2 graph, over DDS, without ROS, and by `rclpy`, and the messages themselves.

DDS types and CDR come from the definitions that `rosbags` has: a message is decoded by the code
that decodes it from a recorded bag. Over DDS: readers and writers under the names, types and QoS of
ROS 2: https://design.ros2.org/articles/topic_and_service_names.html (`rt/NAME`),
https://design.ros2.org/articles/mapping_dds_types.html (`PACKAGE::msg::dds_::NAME_`) and
https://docs.ros.org/en/rolling/Concepts/Intermediate/About-Quality-of-Service-Settings.html.
For `ros2 node list` and `ros2 node info` a participant says by a topic of its own which readers and
writers belong to which node, as `rmw_dds_common` does:
https://design.ros2.org/articles/Node_to_Participant_mapping.html.
"""

import contextlib
import importlib
import logging
import os
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any
from xml.sax.saxutils import quoteattr

import numpy as np

from orthonav.core.errors import MissingExtraError, OutputError, described
from orthonav.onboard.ros2.arguments import RosArguments

TIME_NS = 10**9
_LOG = "rcl_interfaces/msg/Log"
_GEOGRAPHIC = {
    "geographic_msgs/msg/GeoPoint": "float64 latitude\nfloat64 longitude\nfloat64 altitude\n",
    "geographic_msgs/msg/GeoPointStamped": (
        "std_msgs/Header header\ngeographic_msgs/GeoPoint position\n"
    ),
}
_SAME_NAME = (
    *("int8", "int16", "int32", "int64", "uint8", "uint16", "uint32", "uint64"),
    *("float32", "float64", "byte"),
)


def ros2_module(name: str) -> Any:
    """A module of the extra `ros2`. Raises `MissingExtraError` where it is missing."""
    try:
        return importlib.import_module(name)
    except ImportError as error:
        package = name.partition(".")[0]
        raise MissingExtraError(
            f"--ros2 needs {package}: pip install 'orthonav[ros2]'; where cyclonedds has no wheel "
            f"(docs/ros2.md), source a ROS 2 environment ({error})"
        ) from error


class Definitions:
    def __init__(self, distro: str = "") -> None:
        """`distro` as in ROS_DISTRO ("humble"); one that is not known stands for the newest.

        Raises `MissingExtraError`.
        """
        typesys = ros2_module("rosbags.typesys")
        stores = {store.value: store for store in typesys.Stores}
        self._store = typesys.get_typestore(stores.get(f"ros2_{distro}", typesys.Stores.LATEST))
        for name, text in _GEOGRAPHIC.items():
            self._store.register(typesys.get_types_from_msg(text, name))
        self._nested: dict[str, Any] = {}

    def new(self, name: str, /, **values: Any) -> Any:
        """A message of the type `name` ("sensor_msgs/msg/NavSatFix")."""
        return self._store.types[name](**values)

    def header(self, stamp_ns: int, frame: str) -> Any:
        return self.new("std_msgs/msg/Header", stamp=self.time(stamp_ns), frame_id=frame)

    def time(self, stamp_ns: int) -> Any:
        sec, nanosec = divmod(stamp_ns, TIME_NS)
        return self.new("builtin_interfaces/msg/Time", sec=sec, nanosec=nanosec)

    def vector(self, kind: str, names: str, values: Sequence[float]) -> Any:
        """A message of `geometry_msgs` of plain numbers, such as Point and Quaternion."""
        numbers = map(float, values)
        return self.new(f"geometry_msgs/msg/{kind}", **dict(zip(names, numbers, strict=True)))

    def decoded(self, name: str, cdr: bytes) -> Any:
        return self._store.deserialize_cdr(cdr, name)

    def encoded(self, message: Any) -> bytes:
        return bytes(self._store.serialize_cdr(message, message.__msgtype__))

    def type_hash(self, name: str) -> bytes:
        """The type hash (REP 2016) as ROS 2 announces it in the user data of a DDS endpoint."""
        return f"typehash={self._store.hash_rihs01(name)};".encode("ascii")

    def dds_type(self, name: str) -> Any:
        """A DDS type whose samples hold their CDR bytes in `cdr`, encoded already.

        Cyclone DDS checks what comes in against the type before anybody reads it.
        """
        idl = ros2_module("cyclonedds.idl")
        made = idl.make_idl_struct(
            name.rpartition("/")[2], _dotted(name), self._members(name), dataclassify=False
        )
        made.serialize = lambda self, **_: self.cdr
        made.deserialize = classmethod(_sample)
        made.deserialize_key = classmethod(lambda kind, data, **_: kind())  # of a writer that left
        return made

    def _members(self, name: str) -> dict[str, Any]:
        return {member: self._idl(kind) for member, kind in self._store.fielddefs[name][1]}

    def _idl(self, kind: Any) -> Any:
        """The type of a member as `cyclonedds.idl` writes it."""
        types = ros2_module("cyclonedds.idl.types")
        node, detail = kind
        if node.name == "NAME":
            return self._nested_struct(detail)
        if node.name == "ARRAY":
            return types.array[self._idl(detail[0]), detail[1]]
        if node.name == "SEQUENCE":
            return types.sequence[self._idl(detail[0])]
        plain = {"bool": bool, "string": str, "char": types.uint8}
        plain |= {each: getattr(types, each) for each in _SAME_NAME}
        return plain[detail[0]]

    def _nested_struct(self, name: str) -> Any:
        if name not in self._nested:
            idl = ros2_module("cyclonedds.idl")
            self._nested[name] = idl.make_idl_struct(
                name.rpartition("/")[2], _dotted(name), self._members(name)
            )
        return self._nested[name]


def ros_type_name(dds_name: str) -> str:
    """The message type of a name in DDS ("sensor_msgs::msg::dds_::Image_"); others stay."""
    parts = dds_name.split("::")
    if len(parts) != 4 or parts[2] != "dds_":
        return dds_name
    return "/".join((parts[0], parts[1], parts[3].removesuffix("_")))


def _dotted(name: str) -> str:
    package, kind, short = name.split("/")
    return f"{package}.{kind}.dds_.{short}_"


def _sample(kind: Any, /, data: bytes, **_: Any) -> Any:
    sample = kind()
    sample.cdr = data
    return sample


log = logging.getLogger(__name__)
Handler = Callable[[Any, bytes], None]


Writer = Callable[[Any], None]
"""Sends one message. Raises `OSError` where the middleware does not take it."""


class Graph(ABC):
    """Reads and writes topics. `spin` is for one thread, writers are for any.

    `problems` says by topic why little or nothing can flow there: another type, QoS that does not
    match. `undecodable` counts damaged messages by topic.
    """

    def __init__(self, arguments: RosArguments) -> None:
        """Raises `MissingExtraError` without the message definitions."""
        self.arguments, self.definitions = arguments, Definitions(arguments.distro)
        self.problems: dict[str, str] = {}
        self.undecodable: Counter[str] = Counter()
        self._said: set[tuple[str, str]] = set()

    @abstractmethod
    def subscribe(
        self, topic: str, kind: str, handler: Handler, *, depth: int = 5, reliable: bool = False
    ) -> None:
        """Hand each message on `topic` (resolved already) to `handler`, with its raw sample.

        The QoS is that of sensor data: best effort, volatile, the last `depth` messages.
        """

    @abstractmethod
    def advertise(self, topic: str, kind: str, *, depth: int = 10, latched: bool = False) -> Writer:
        """A writer of `topic` (resolved already): reliable, and transient local if `latched`."""

    @abstractmethod
    def spin(self, timeout_s: float) -> int:
        """Wait at most so long for messages and handle those that are there; how many."""

    @abstractmethod
    def close(self) -> None:
        """Leave the graph."""

    @abstractmethod
    def _mismatches(self) -> dict[str, str]:
        """Topics whose endpoints cannot match now, and why."""

    def check_graph(self, others: Mapping[str, str]) -> None:
        """Look for endpoints that cannot match now, beside `others`, further problems by topic;
        each problem is logged once."""
        self.problems = {**others, **self._mismatches()}
        for topic, text in self.problems.items():
            if (topic, text) not in self._said:
                self._said.add((topic, text))
                log.warning("topic %s %s", topic, text)

    def _mismatch(
        self, found: dict[str, str], topic: str, kind: str, other_kind: str, why: str
    ) -> None:
        """Note that an endpoint of our topic has another type, or `why` it does not match."""
        if other_kind != kind:
            why = f"is of type {other_kind}; expected {kind}"
        if why:
            found.setdefault(topic, why)

    def _writing(self, topic: str, send: Callable[[bytes], None]) -> Writer:
        def write(message: Any) -> None:
            try:
                send(self.definitions.encoded(message))
            except Exception as error:  # of the middleware
                raise OSError(f"cannot publish on {topic} ({error})") from error

        return write

    def _handle(self, topic: str, kind: str, handler: Handler, cdr: bytes) -> None:
        """Decode a sample and hand it on; one odd message never ends a flight."""
        try:
            handler(self.definitions.decoded(kind, cdr), cdr)
        except Exception as error:
            if not self.undecodable[topic]:
                log.warning("message on %s cannot be used (%s)", topic, described(error))
            self.undecodable[topic] += 1


class Rosout(logging.Handler):
    """Publishes records as `rcl_interfaces/Log`, whose levels are those of Python."""

    def __init__(self, node: Graph) -> None:
        super().__init__()
        self._node = node
        self._write = node.advertise(
            node.arguments.resolved("/rosout"), _LOG, depth=100, latched=True
        )

    def emit(self, record: logging.LogRecord) -> None:
        definitions = self._node.definitions
        with contextlib.suppress(Exception):  # the code that logs must not fail
            message = definitions.new(
                _LOG,
                stamp=definitions.time(round(record.created * 1e9)),
                level=min(record.levelno, logging.CRITICAL),
                name=self._node.arguments.full_name.strip("/").replace("/", "."),
                msg=record.getMessage(),
                file=record.pathname,
                function=record.funcName or "",
                line=record.lineno,
            )
            self._write(message)


TOPIC, KIND = "ros_discovery_info", "rmw_dds_common/msg/ParticipantEntitiesInfo"
USER_DATA = b"enclave=/;"
"""Of a participant with nodes of ROS 2."""
_HUMBLE_BYTES = 24


CONFIGURATION = """<CycloneDDS><Domain>
<Compatibility><IgnoreTypeInformation>1.15</IgnoreTypeInformation></Compatibility>
<Internal><SocketReceiveBufferSize min="default" max="10MB"/></Internal>
</Domain></CycloneDDS>"""
"""Ours of Cyclone DDS. It rejects the type objects of Fast DDS 3 (vendor 1.15) of types with arrays
or sequences, and would not match these topics. Its default buffer is smaller than an image."""
LOOPBACK_ONLY = """<CycloneDDS><Domain><General><AllowMulticast>false</AllowMulticast><Interfaces>
<NetworkInterface address="127.0.0.1"/></Interfaces></General></Domain></CycloneDDS>"""
"""Configuration for ROS_LOCALHOST_ONLY=1."""
_POLICIES = {
    **{2: "durability", 4: "deadline", 6: "ownership", 8: "liveliness", 11: "reliability"},
    24: "type consistency (message definitions of another distribution: set ROS_DISTRO)",
}
_BLOCK_NS = 10_000_000
_MOST_ENDPOINTS = 10_000
_ALIVE = 16
"""State of an instance in DDS."""


class Node(Graph):
    def __init__(self, arguments: RosArguments) -> None:
        """Raises `MissingExtraError`, or `OutputError` where DDS has no network interface."""
        super().__init__(arguments)
        self._core, self._qos = ros2_module("cyclonedds.core"), ros2_module("cyclonedds.qos")
        builtin = ros2_module("cyclonedds.builtin")
        domain = ros2_module("cyclonedds.domain")
        self._domain = self._opened(domain, arguments)
        made = self._qos.Qos(self._qos.Policy.Userdata(USER_DATA))
        self._participant = domain.DomainParticipant(arguments.domain_id, made)
        self._subscriptions: list[tuple[str, str, Any, int, Handler]] = []
        self._writers: list[tuple[str, str, Any]] = []
        self._conditions: list[Any] = []
        self._names, _ = self._writer(TOPIC, KIND, depth=1, latched=True)
        self._waitset = self._core.WaitSet(self._participant)
        self._publishers, self._subscribers = (
            Endpoints(builtin.BuiltinDataReader(self._participant, topic))
            for topic in (
                builtin.BuiltinTopicDcpsPublication,
                builtin.BuiltinTopicDcpsSubscription,
            )
        )

    def subscribe(
        self, topic: str, kind: str, handler: Handler, *, depth: int = 5, reliable: bool = False
    ) -> None:
        qos = self._made_qos(kind, reliable=reliable, depth=depth)
        sub = ros2_module("cyclonedds.sub")
        reader = sub.DataReader(self._participant, self._topic(f"rt{topic}", kind), qos)
        states = self._core
        mask = states.ViewState.Any | states.InstanceState.Any | states.SampleState.NotRead
        self._conditions.append(states.ReadCondition(reader, mask))
        self._waitset.attach(self._conditions[-1])
        self._subscriptions.append((topic, kind, reader, depth, handler))
        self._announce()

    def advertise(self, topic: str, kind: str, *, depth: int = 10, latched: bool = False) -> Writer:
        write, made = self._writer(f"rt{topic}", kind, depth=depth, latched=latched)
        self._writers.append((topic, kind, made))
        self._announce()
        return write

    def spin(self, timeout_s: float) -> int:
        self._waitset.wait(round(timeout_s * 1e9))
        return sum(self._taken(*each) for each in self._subscriptions)

    def close(self) -> None:
        del self._publishers, self._subscribers, self._names
        for held in (self._conditions, self._subscriptions, self._writers):
            held.clear()
        self._waitset = self._participant = self._domain = None

    def _opened(self, domain: Any, arguments: RosArguments) -> Any:
        """The DDS domain by our configuration, then that of the user; None where this process has
        joined it already."""
        own = arguments.cyclonedds_uri
        # An interface must not be named twice.
        local = LOOPBACK_ONLY if arguments.is_local and "NetworkInterface" not in own else ""
        parts = filter(None, (CONFIGURATION, _discovery(arguments), local, own))
        try:
            return domain.Domain(arguments.domain_id, ",".join(parts))
        except self._core.DDSException as error:
            if error.code == error.DDS_RETCODE_PRECONDITION_NOT_MET:
                return None
            where = f"DDS domain {arguments.domain_id}"
            if own:
                where += f" with CYCLONEDDS_URI={own}"
            raise OutputError(f"cannot join {where}: {error}") from error

    def _mismatches(self) -> dict[str, str]:
        found: dict[str, str] = {}
        self._publishers.update()
        self._subscribers.update()
        for topic, kind, reader, _, _ in self._subscriptions:
            why = _unmatched(reader.get_requested_incompatible_qos_status(), "a publisher")
            for other in self._publishers.others(topic, reader.get_matched_publications()):
                self._mismatch(found, topic, kind, other, why)
        for topic, kind, writer in self._writers:
            why = _unmatched(writer.get_offered_incompatible_qos_status(), "a subscriber")
            for other in self._subscribers.others(topic, writer.get_matched_subscriptions()):
                self._mismatch(found, topic, kind, other, why)
        return found

    def _announce(self) -> None:
        count = _HUMBLE_BYTES if self.arguments.distro == "humble" else 16

        def gid(entity: Any) -> Any:
            data = np.frombuffer(entity.guid.bytes.ljust(count, b"\0"), np.uint8)
            return self.definitions.new("rmw_dds_common/msg/Gid", data=data)

        node = self.definitions.new(
            "rmw_dds_common/msg/NodeEntitiesInfo",
            node_namespace=self.arguments.namespace,
            node_name=self.arguments.node,
            reader_gid_seq=[gid(reader) for _, _, reader, _, _ in self._subscriptions],
            writer_gid_seq=[gid(writer) for _, _, writer in self._writers],
        )
        own = gid(self._participant)
        self._names(self.definitions.new(KIND, gid=own, node_entities_info_seq=[node]))

    def _writer(self, name: str, kind: str, *, depth: int, latched: bool) -> tuple[Writer, Any]:
        qos = self._made_qos(kind, reliable=True, depth=depth, latched=latched)
        pub = ros2_module("cyclonedds.pub")
        made = pub.DataWriter(self._participant, self._topic(name, kind), qos)

        def send(cdr: bytes) -> None:
            sample = made.topic.data_type()
            sample.cdr = cdr
            made.write(sample)

        return self._writing(name.removeprefix("rt"), send), made

    def _topic(self, name: str, kind: str) -> Any:
        made = ros2_module("cyclonedds.topic")
        return made.Topic(self._participant, name, self.definitions.dds_type(kind))

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

    def _taken(self, topic: str, kind: str, reader: Any, depth: int, handler: Handler) -> int:
        samples = [getattr(sample, "cdr", None) for sample in reader.take(depth)]
        received = [cdr for cdr in samples if cdr is not None]  # None only says that a writer left
        for cdr in received:
            self._handle(topic, kind, handler, cdr)
        return len(received)


class Endpoints:
    """Topic and type of the publishers or subscribers of a domain, by handle. Mutable."""

    def __init__(self, reader: Any) -> None:
        self._reader = reader
        self._alive: dict[int, tuple[str, str]] = {}

    def others(self, topic: str, matched: Sequence[int]) -> Iterator[str]:
        """Message types of those of a topic beside the handles that are matched."""
        handles = {handle % 2**64 for handle in matched}
        for handle, (name, kind) in self._alive.items():
            if name == f"rt{topic}" and handle not in handles:
                yield ros_type_name(kind)

    def update(self) -> None:
        try:
            changes = self._reader.take(_MOST_ENDPOINTS)
        except Exception as error:  # a policy of another vendor that the library cannot name
            log.debug("discovery: %r", error)
            return
        for each in changes:
            info = each.sample_info
            if info.instance_state != _ALIVE:
                self._alive.pop(info.instance_handle, None)
            elif info.valid_data:
                self._alive[info.instance_handle] = str(each.topic_name), str(each.type_name)


def _discovery(arguments: RosArguments) -> str:
    """Configuration of Cyclone DDS for the discovery that the variables of ROS ask for."""
    if arguments.is_alone:
        inner = f"<ParticipantIndex>none</ParticipantIndex><Tag>orthonav_{os.getpid()}</Tag>"
    else:
        local = ("127.0.0.1",) if arguments.is_local else ()
        peers = [f"<Peer address={quoteattr(peer)}/>" for peer in (*local, *arguments.peers)]
        if not peers:
            return ""
        inner = f"<ParticipantIndex>auto</ParticipantIndex><Peers>{''.join(peers)}</Peers>"
    return f"<CycloneDDS><Domain><Discovery>{inner}</Discovery></Domain></CycloneDDS>"


def _unmatched(status: Any, other: str) -> str:
    """Why an endpoint did not match ours lately; "" where it is only not matched yet."""
    if not status.total_count:
        return ""
    policy = _POLICIES.get(status.last_policy_id, f"policy {status.last_policy_id}")
    return f"{other} has QoS that does not match ours: {policy}"


class RclNode(Graph):
    """A node by `rclpy`, where a ROS environment is sourced: with its middleware and security.
    Messages stay serialized: their definitions are those of the node over DDS."""

    def __init__(self, arguments: RosArguments) -> None:
        super().__init__(arguments)
        self._rclpy, self._qos = (
            importlib.import_module("rclpy"),
            importlib.import_module("rclpy.qos"),
        )
        self._subscriptions: list[tuple[Any, str]] = []
        self._handled = 0
        self._publishers: list[tuple[Any, str]] = []
        try:
            self._context = self._rclpy.Context()
            self._rclpy.init(
                args=["--ros-args", *arguments.passed],
                context=self._context,
                signal_handler_options=importlib.import_module(
                    "rclpy.signals"
                ).SignalHandlerOptions.NO,
            )
            self._node = self._rclpy.create_node(
                arguments.node,
                namespace=arguments.namespace,
                context=self._context,
                use_global_arguments=False,  # names are resolved already
                enable_rosout=False,  # as over DDS, see `rosout`
            )
        except Exception as error:  # of the middleware
            raise OutputError(f"cannot join the ROS graph: {error}") from error
        self._executor = importlib.import_module("rclpy.executors").SingleThreadedExecutor(
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
        try:
            qos = self._made_qos(depth, reliable=True, latched=latched)
            made = self._node.create_publisher(_message(kind), topic, qos)
        except ImportError:
            log.warning("nothing is published on %s: ROS has no %s here", topic, kind)
            return lambda message: None
        self._publishers.append((made, kind))
        return self._writing(topic, made.publish)

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
    package, _, name = kind.split("/")
    return getattr(importlib.import_module(f"{package}.msg"), name)


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
            importlib.import_module("rclpy")
        except ImportError as error:
            log.warning("rclpy of the sourced ROS environment cannot be used (%s)", error)
        else:
            return RclNode(arguments)
    for name, part in _NEEDS_ROS.items():
        value = environment.get(name, "")
        if value and part in value:
            log.warning("%s=%s has no effect without a sourced ROS environment", name, value)
    return Node(arguments)
