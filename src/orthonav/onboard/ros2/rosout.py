"""The log of the program on `/rosout`, where tools of ROS look for it."""

import contextlib
import logging

from orthonav.onboard.ros2.graph import Graph

TOPIC, KIND, DEPTH = "/rosout", "rcl_interfaces/msg/Log", 100


class Rosout(logging.Handler):
    """Publishes records as `rcl_interfaces/Log`, whose levels are those of Python."""

    def __init__(self, node: Graph) -> None:
        super().__init__()
        self._node = node
        self._writer = node.advertise(
            node.arguments.resolved(TOPIC), KIND, depth=DEPTH, latched=True
        )

    def emit(self, record: logging.LogRecord) -> None:
        """Publish a record; one that cannot be published is dropped."""
        definitions = self._node.definitions
        with contextlib.suppress(Exception):  # the code that logs must not fail
            message = definitions.new(
                KIND,
                stamp=definitions.time(round(record.created * 1e9)),
                level=min(record.levelno, logging.CRITICAL),
                name=self._node.arguments.full_name.strip("/").replace("/", "."),
                msg=record.getMessage(),
                file=record.pathname,
                function=record.funcName or "",
                line=record.lineno,
            )
            self._writer.write(message)
