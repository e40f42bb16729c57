"""The name of a node over DDS, for `ros2 node list` and `ros2 node info`.

A participant says by a topic of its own which readers and writers belong to which node, as
`rmw_dds_common` does: https://design.ros2.org/articles/Node_to_Participant_mapping.html.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np

from orthonav.onboard.ros2.arguments import RosArguments
from orthonav.onboard.ros2.messages import Definitions

TOPIC, KIND = "ros_discovery_info", "rmw_dds_common/msg/ParticipantEntitiesInfo"
USER_DATA = b"enclave=/;"
"""Of a participant with nodes of ROS 2."""
_HUMBLE_BYTES = 24


def node_entities(
    definitions: Definitions,
    arguments: RosArguments,
    participant: Any,
    readers: Sequence[Any],
    writers: Sequence[Any],
) -> Any:
    """The message with the one node of a DDS participant, its readers and its writers."""
    count = _HUMBLE_BYTES if arguments.distro == "humble" else 16

    def gid(entity: Any) -> Any:
        data = np.frombuffer(entity.guid.bytes.ljust(count, b"\0"), np.uint8)
        return definitions.new("rmw_dds_common/msg/Gid", data=data)

    node = definitions.new(
        "rmw_dds_common/msg/NodeEntitiesInfo",
        node_namespace=arguments.namespace,
        node_name=arguments.node,
        reader_gid_seq=[gid(each) for each in readers],
        writer_gid_seq=[gid(each) for each in writers],
    )
    return definitions.new(KIND, gid=gid(participant), node_entities_info_seq=[node])
