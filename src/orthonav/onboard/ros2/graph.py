"""A node of a ROS 2 graph, whichever library carries its messages."""

import logging
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Any, Protocol

from orthonav.core.errors import described
from orthonav.onboard.ros2.arguments import RosArguments
from orthonav.onboard.ros2.messages import Definitions

log = logging.getLogger(__name__)
Handler = Callable[[Any, bytes], None]


class Writer(Protocol):
    """Sends messages of one topic."""

    def write(self, message: Any) -> None:
        """Send one message. Raises `OSError` where the middleware does not take it."""


class Graph(ABC):
    """Reads and writes topics. `spin` is for one thread, writers are for any.

    `problems` says by topic why little or nothing can flow there: another type, QoS that does not
    match, lost messages. `undecodable` counts damaged messages by topic.
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

    def check_graph(self, others: Mapping[str, str] = MappingProxyType({})) -> None:
        """Look for endpoints that cannot match now; `others` are further problems by topic.

        Each problem is logged once.
        """
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

    def _handle(self, topic: str, kind: str, handler: Handler, cdr: bytes) -> None:
        """Decode a sample and hand it on; one odd message never ends a flight."""
        try:
            handler(self.definitions.decoded(kind, cdr), cdr)
        except Exception as error:
            if not self.undecodable[topic]:
                log.warning("message on %s cannot be used (%s)", topic, described(error))
            self.undecodable[topic] += 1
