"""Selection of the topics of a ROS recording by type, or as requested."""

import logging
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from orthonav.core.errors import FlightError
from orthonav.core.guard import needed

TYPES: dict[str, tuple[str, ...]] = {
    "image": ("sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"),
    "camera_info": ("sensor_msgs/msg/CameraInfo",),
    "attitude": (
        "sensor_msgs/msg/Imu",
        "nav_msgs/msg/Odometry",
        "geometry_msgs/msg/PoseStamped",
    ),
    "velocity": ("nav_msgs/msg/Odometry",),
    "position": ("sensor_msgs/msg/NavSatFix",),
    "height": (
        "sensor_msgs/msg/Range",
        "mavros_msgs/msg/Altitude",
        "std_msgs/msg/Float64",
        "std_msgs/msg/Float32",
    ),
}
_PLAIN_NUMBERS = ("std_msgs/msg/Float64", "std_msgs/msg/Float32")
log = logging.getLogger(__name__)
_HOME_NAMES = ("rel_alt", "relative_altitude")
_HEIGHT_NAMES = (*_HOME_NAMES, "agl", "height_above_ground")


@dataclass(frozen=True, eq=False)
class Topics:
    """The connection of each role that was found, and all candidates for attitude."""

    image: Any
    roles: Mapping[str, Any]
    attitudes: tuple[Any, ...]
    connections: tuple[Any, ...]

    def of(self, connection: Any) -> list[Any]:
        """All connections on the topic of one (bags split or appended have several)."""
        return [one for one in self.connections if one.topic == connection.topic]

    def summary(self) -> str:
        """Role and topic of each connection, for people."""
        named = {"image": self.image, **self.roles}
        return ", ".join(f"{role} {one.topic}" for role, one in named.items())


class ParsableReader:
    """A reader of `rosbags` without the connections whose messages it cannot describe.

    `rosbags` refuses a whole recording for one of them. Such are events of services and actions:
    their definitions refer to types that messages do not have.
    """

    def __init__(self, reader: Any) -> None:
        self._reader = reader

    def __enter__(self) -> "ParsableReader":
        self._reader.__enter__()
        return self

    def __exit__(self, *raised: Any) -> None:
        self._reader.__exit__(*raised)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._reader, name)

    @cached_property
    def connections(self) -> list[Any]:
        """The connections whose messages can be parsed, once the reader is open."""
        return [one for one in self._reader.connections if _is_parsable(one)]


def _is_parsable(connection: Any) -> bool:
    """Whether a topic carries messages whose definition is complete."""
    typesys = needed("rosbags.typesys", "ROS recordings")
    parsable = "/msg/" in connection.msgtype
    if parsable and connection.msgdef.format.name == "MSG":
        store = typesys.get_typestore(typesys.Stores.EMPTY)
        try:
            store.register(typesys.get_types_from_msg(connection.msgdef.data, connection.msgtype))
            store.hash_rihs01(connection.msgtype)
        except Exception as error:  # of the parser, or of a type that is not defined
            log.info("%s cannot be parsed: %s", connection.msgtype, error)
            parsable = False
    if not parsable:
        log.info("topic is ignored: %s carries %s", connection.topic, connection.msgtype)
    return parsable


def find_topics(reader: Any, asked: Mapping[str, str], path: Path) -> Topics:
    """The topics of a recording by role.

    Raises `FlightError` where a requested topic is missing or has another type, and where there is
    no image topic, or more than one.
    """
    connections = tuple(reader.connections)
    counted = {one.topic: one for one in connections if one.msgcount}
    found: dict[str, list[Any]] = {}
    for role, types in TYPES.items():
        if role in asked:
            found[role] = [_asked(role, asked[role], counted, path)]
        else:
            of_type = [one for one in counted.values() if _fits(one, role)]
            found[role] = sorted(
                of_type, key=lambda one: (types.index(one.msgtype), -one.msgcount, one.topic)
            )
    images = found.pop("image")
    if len(images) != 1:
        found_names = ", ".join(sorted(one.topic for one in images))
        if not images:
            found_names = f"none among {', '.join(sorted(counted)) or 'no topic'}"
        raise FlightError(
            f"expected one topic of images, found {found_names}; give --topic: {path}"
        )
    infos = found["camera_info"]
    near = [one for one in infos if _beside(one.topic, images[0].topic)]
    found["camera_info"] = near or (infos if len(infos) == 1 else [])
    roles = {role: ones[0] for role, ones in found.items() if ones}
    return Topics(images[0], roles, tuple(found["attitude"]), connections)


def _asked(role: str, name: str, counted: Mapping[str, Any], path: Path) -> Any:
    if name not in counted:
        raise FlightError(
            f"no messages on {name}; available: {', '.join(sorted(counted)) or 'none'}: {path}"
        )
    if counted[name].msgtype not in TYPES[role]:
        raise FlightError(
            f"{name} carries {counted[name].msgtype}; {role} is one of "
            f"{', '.join(TYPES[role])}: {path}"
        )
    return counted[name]


def _fits(connection: Any, role: str) -> bool:
    if connection.msgtype not in TYPES[role]:
        return False
    named = connection.topic.rpartition("/")[2] in _HEIGHT_NAMES
    return named or connection.msgtype not in _PLAIN_NUMBERS


def is_above_home(topic: str) -> bool:
    """Whether a topic of plain numbers has the height above take-off, by its name."""
    return topic.rpartition("/")[2] in _HOME_NAMES


def _beside(info: str, image: str) -> bool:
    """Whether a camera_info is in the namespace of an image (image_raw/compressed too)."""
    return image.startswith(info.rpartition("/")[0] + "/")
