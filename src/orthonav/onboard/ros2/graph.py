"""A node of a ROS 2 graph, whichever library carries its messages, and the messages themselves.

DDS types and CDR come from the definitions that `rosbags` has: a message is decoded by the code
that decodes it from a recorded bag. DDS names:
https://design.ros2.org/articles/topic_and_service_names.html (`rt/NAME`) and
https://design.ros2.org/articles/mapping_dds_types.html (`PACKAGE::msg::dds_::NAME_`).
"""

import contextlib
import importlib
import logging
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from orthonav.core.errors import MissingExtraError, described
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
    """The message definitions of one distribution of ROS 2, and their DDS types."""

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
        """The message in a sample. Raises whatever `rosbags` raises for a damaged one."""
        return self._store.deserialize_cdr(cdr, name)

    def encoded(self, message: Any) -> bytes:
        """The sample (XCDR1, little endian) of a message."""
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
        """Publish a record; one that cannot be published is dropped."""
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
