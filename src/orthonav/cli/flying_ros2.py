"""`orthonav fly --ros2`: the node with its reader and publisher, made from the options."""

import argparse
import os
import threading
from contextlib import ExitStack

from orthonav.geo.frames import LocalFrame
from orthonav.onboard.ros2.arguments import ros_arguments
from orthonav.onboard.ros2.node import Node
from orthonav.onboard.ros2.publisher import Ros2Publisher
from orthonav.onboard.ros2.reader import Ros2Reader
from orthonav.onboard.telemetry import HEIGHT_SOURCES, Clocks, TelemetryBuffer


def joined(
    options: argparse.Namespace,
    clocks: Clocks,
    stopping: threading.Event,
    stack: ExitStack,
    frame: LocalFrame,
    min_confidence: float,
) -> tuple[Ros2Reader, Ros2Publisher]:
    """Reader and publisher of a new node; `stack` closes the node.

    `frame` is the local frame of the map; its centre is the origin of the ROS map frame unless
    `--origin` is given.
    """
    node = Node(ros_arguments(options.ros_args, os.environ))
    stack.callback(node.close)
    reader = Ros2Reader(
        node,
        TelemetryBuffer(heights=options.height or HEIGHT_SOURCES),
        clocks,
        stopping.is_set,
        mount_deg=tuple(options.mount_deg),
        wait_s=options.telemetry_wait_ms / 1e3,
    )
    origin = LocalFrame(*options.origin[:2]) if options.origin else frame
    publisher = Ros2Publisher(
        node,
        origin,
        reader.now_ns,
        min_std_m=options.min_std_m,
        min_confidence=min_confidence,
        silent=options.dry_run,
    )
    return reader, publisher
