"""`orthonav fly --ros2`: the node with its reader and publisher, made from the options."""

import argparse
import logging
import math
import os
import threading
from contextlib import ExitStack

from orthonav.core.geo.frames import LocalFrame
from orthonav.onboard.ros2.arguments import ros_arguments
from orthonav.onboard.ros2.graph import Rosout
from orthonav.onboard.ros2.node import joined_graph
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
    """Reader and publisher of a new node, which `stack` closes. The centre of `frame` is the origin
    of the ROS map frame unless `--origin` is given."""
    node = joined_graph(ros_arguments(options.ros_args, os.environ), os.environ)
    stack.callback(node.close)
    rosout, logger = Rosout(node), logging.getLogger("orthonav")
    logger.addHandler(rosout)
    stack.callback(logger.removeHandler, rosout)
    reader = Ros2Reader(
        node,
        TelemetryBuffer(heights=options.height or HEIGHT_SOURCES),
        clocks,
        stopping.is_set,
        mount_deg=tuple(options.mount_deg),
    )
    origin = LocalFrame(*options.origin[:2]) if options.origin else frame
    publisher = Ros2Publisher(
        node,
        origin,
        reader.now_ns,
        origin_alt_m=options.origin[2] if options.origin else math.nan,
        min_std_m=options.min_std_m,
        min_confidence=min_confidence,
        silent=options.dry_run,
    )
    reader.report_wait = lambda why: publisher.health(
        {"health": "FAILED", "reasons": ["no_camera"], "waiting": why}
    )
    return reader, publisher
