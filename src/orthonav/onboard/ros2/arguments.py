"""`--ros-args`: names, remapping rules and parameters, resolved as a ROS 2 node resolves them.

Sources: https://design.ros2.org/articles/topic_and_service_names.html,
https://design.ros2.org/articles/static_remapping.html,
https://design.ros2.org/articles/ros_command_line_arguments.html.
"""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields

from orthonav.errors import VariantError

MAX_DOMAIN_ID = 232
"""Beyond it the ports of the domain would exceed 65535."""
_TOKEN = r"[A-Za-z_][A-Za-z0-9_]*"
_NAME = re.compile(rf"(~|~?/?{_TOKEN}(/{_TOKEN})*)")
_NAMESPACE = re.compile(rf"/|(/{_TOKEN})+")
_TRUTH = {"true": True, "false": False}
_CHOICES = {
    "image_transport": ("raw", "compressed"),
    "image_reliability": ("best_effort", "reliable"),
}


@dataclass(frozen=True)
class Parameters:
    """Parameters of the node (`-p NAME:=VALUE`).

    `use_sim_time`: ROS time is that of `/clock`, not the system's. `image_transport`: "raw" or
    "compressed". `image_reliability`: "best_effort" (sensor data) or "reliable", which resends lost
    parts of large pictures and matches reliable writers only. `publish_tf`: publish the transform
    from `map_frame` to `base_frame` too.
    """

    use_sim_time: bool = False
    image_transport: str = "raw"
    image_reliability: str = "best_effort"
    publish_tf: bool = False
    map_frame: str = "map"
    base_frame: str = "base_link"


@dataclass(frozen=True)
class RosArguments:
    """Name and namespace of the node, remapping rules in their order, parameters and domain.

    `rules` are pairs of a name to match and its replacement, not yet expanded. `is_local`:
    discovery and traffic stay on the loopback interface. `distro`: whose message definitions.
    """

    node: str = "orthonav"
    namespace: str = "/"
    rules: tuple[tuple[str, str], ...] = ()
    parameters: Parameters = field(default_factory=Parameters)
    domain_id: int = 0
    is_local: bool = False
    distro: str = ""

    @property
    def full_name(self) -> str:
        """Name of the node with its namespace."""
        return f"{self.namespace.rstrip('/')}/{self.node}"

    def expanded(self, name: str) -> str:
        """Absolute form of a relative, private (`~/x`) or absolute name.

        Raises `VariantError` where it is no name of ROS 2.
        """
        if not _NAME.fullmatch(name) or (name.startswith("~") and name[1:2] not in ("", "/")):
            raise VariantError(f"not a topic name of ROS 2: '{name}'")
        if name.startswith("~"):
            return self.full_name + name[1:]
        return name if name.startswith("/") else f"{self.namespace.rstrip('/')}/{name}"

    def resolved(self, name: str) -> str:
        """Absolute name of a topic after remapping; the first matching rule applies."""
        full = self.expanded(name)
        for before, after in self.rules:
            if self.expanded(before) == full:
                return self.expanded(after)
        return full


def ros_arguments(words: Sequence[str], environment: Mapping[str, str]) -> RosArguments:
    """Arguments after `--ros-args`, and variables of the environment.

    Reads `-r FROM:=TO` (`--remap`; `__node`, `__name` and `__ns` too) and `-p NAME:=VALUE`
    (`--param`), `ROS_DOMAIN_ID`, `ROS_NAMESPACE`, `ROS_LOCALHOST_ONLY`,
    `ROS_AUTOMATIC_DISCOVERY_RANGE` and `ROS_DISTRO`. Raises `VariantError` for anything else.
    """
    remaps, parameters = _pairs(words)
    node, namespace = "orthonav", environment.get("ROS_NAMESPACE", "") or "/"
    rules = []
    for before, after in remaps:
        target, colon, rest = before.partition(":")
        if colon and re.fullmatch(_TOKEN, target):
            if target != node:
                continue  # a rule for another node of the same command line
            before = rest
        if before in ("__node", "__name"):
            node = after
        elif before == "__ns":
            namespace = after
        else:
            rules.append((before, after))
    namespace = namespace if namespace.startswith("/") else f"/{namespace}"
    if not re.fullmatch(_TOKEN, node):
        raise VariantError(f"not a node name of ROS 2: '{node}'")
    if not _NAMESPACE.fullmatch(namespace):
        raise VariantError(f"not a namespace of ROS 2: '{namespace}'")
    made = RosArguments(
        node,
        namespace,
        tuple(rules),
        _parameters(parameters),
        _domain_id(environment.get("ROS_DOMAIN_ID", "")),
        environment.get("ROS_LOCALHOST_ONLY") == "1"
        or environment.get("ROS_AUTOMATIC_DISCOVERY_RANGE", "").upper() == "LOCALHOST",
        environment.get("ROS_DISTRO", ""),
    )
    for rule in rules:
        for name in rule:
            made.expanded(name)  # raise for a rule that can never match
    return made


def _pairs(words: Sequence[str]) -> tuple[list[tuple[str, str]], list[tuple[str, str]]]:
    """Remapping rules and parameters of the words after `--ros-args`."""
    flags = {"-r": 0, "--remap": 0, "-p": 1, "--param": 1}
    found: tuple[list[tuple[str, str]], list[tuple[str, str]]] = [], []
    waiting = list(words)
    while waiting:
        flag = waiting.pop(0)
        if flag in ("--ros-args", "--") and (flag == "--ros-args" or not waiting):
            continue
        pair = waiting.pop(0) if flag in flags and waiting else ""
        name, separator, value = pair.partition(":=")
        if not (name and separator and value):
            raise VariantError(
                "after --ros-args expected -r FROM:=TO or -p NAME:=VALUE, "
                f"got '{' '.join((flag, pair)).strip()}'"
            )
        found[flags[flag]].append((name, value))
    return found


def _parameters(pairs: Sequence[tuple[str, str]]) -> Parameters:
    known = {each.name: each.type for each in fields(Parameters)}
    values: dict[str, str | bool] = {}
    for name, text in pairs:
        if name not in known:
            raise VariantError(f"parameters are {', '.join(known)}, got '{name}'")
        if known[name] is bool:
            if text.lower() not in _TRUTH:
                raise VariantError(f"parameter {name} is true or false, got '{text}'")
            values[name] = _TRUTH[text.lower()]
        elif text not in _CHOICES.get(name, (text,)):
            raise VariantError(f"parameter {name} is {' or '.join(_CHOICES[name])}, got '{text}'")
        else:
            values[name] = text.strip("\"'")
    return Parameters(**values)  # type: ignore[arg-type]  # each has the type of its field


def _domain_id(text: str) -> int:
    if not text:
        return 0
    if not (text.isascii() and text.isdigit() and int(text) <= MAX_DOMAIN_ID):
        raise VariantError(f"ROS_DOMAIN_ID is 0 to {MAX_DOMAIN_ID}, got '{text}'")
    return int(text)
