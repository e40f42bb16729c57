"""`--ros-args`: names, remapping rules and parameters, resolved as a ROS 2 node resolves them.

Sources: https://design.ros2.org/articles/topic_and_service_names.html,
https://design.ros2.org/articles/static_remapping.html,
https://design.ros2.org/articles/ros_command_line_arguments.html.
"""

import logging
import math
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any

from orthonav.core.errors import VariantError, described
from orthonav.core.extras import needed
from orthonav.core.files import require_file

log = logging.getLogger(__name__)
_TOKEN = r"[A-Za-z_][A-Za-z0-9_]*"
_NAME = re.compile(rf"(~|~?/?{_TOKEN}(/{_TOKEN})*)")
_NAMESPACE = re.compile(rf"/|(/{_TOKEN})+")
_TRUTH = {"true": True, "false": False}
_CHOICES = {
    "image_transport": ("raw", "compressed"),
    "image_reliability": ("best_effort", "reliable"),
    "covariance": ("filter", "fix"),
}
_ALTITUDES = ("none", "terrain", "home")
_PASSED = ("-e", "--enclave", "--log-level", "--log-config-file", "--log-file-name")
_STREAMS = re.compile("--(enable|disable)-(rosout|stdout|external-lib)-logs")


@dataclass(frozen=True)
class Parameters:
    """Parameters of the node (`-p NAME:=VALUE`).

    `use_sim_time`: ROS time is that of `/clock`, not the system's. `image_transport`: "raw" or
    "compressed". `image_reliability`: "best_effort" (sensor data) or "reliable", which resends lost
    parts of large pictures and matches reliable writers only. `covariance`: "filter" (larger, for
    a filter that takes positions as independent) or "fix". `altitude` of the fix: "none" (NaN),
    that of the "terrain" of the map plus the height above ground, that of the origin plus the
    height above "home", or a number of metres.
    """

    use_sim_time: bool = False
    image_transport: str = "raw"
    image_reliability: str = "best_effort"
    map_frame: str = "map"
    base_frame: str = "base_link"
    covariance: str = "filter"
    altitude: str = "none"


@dataclass(frozen=True)
class RosArguments:
    """Name and namespace of the node, remapping rules in their order, and parameters.

    `rules` are pairs of a name to match and its replacement, not yet expanded. `distro`: whose
    message definitions. `passed`: arguments about security and logging, for `rclpy`.
    """

    node: str = "orthonav"
    namespace: str = "/"
    rules: tuple[tuple[str, str], ...] = ()
    parameters: Parameters = field(default_factory=Parameters)
    distro: str = ""
    passed: tuple[str, ...] = ()

    @property
    def full_name(self) -> str:
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

    Reads `-r FROM:=TO` (`--remap`; `__node`, `__name` and `__ns` too), `-p NAME:=VALUE`
    (`--param`), `--params-file`, and `ROS_NAMESPACE` and `ROS_DISTRO`; `rclpy` reads the other
    variables of ROS. As in ROS, an unknown parameter is ignored. Raises `VariantError` for an
    argument that ROS does not have either, and `MissingFileError`.
    """
    given, parameters, passed = _words(words)
    node, namespace = "orthonav", environment.get("ROS_NAMESPACE", "") or "/"
    rules = []
    for before, after in given:
        name = _for_node(before, node)
        if name in ("__node", "__name"):
            node = after
        elif name == "__ns":
            namespace = after
        elif name is not None:
            rules.append((name, after))
    namespace = namespace if namespace.startswith("/") else f"/{namespace}"
    if not re.fullmatch(_TOKEN, node):
        raise VariantError(f"not a node name of ROS 2: '{node}'")
    if not _NAMESPACE.fullmatch(namespace):
        raise VariantError(f"not a namespace of ROS 2: '{namespace}'")
    full_name = f"{namespace.rstrip('/')}/{node}"
    made = RosArguments(
        node,
        namespace,
        tuple(rules),
        _parameters(list(_values(parameters, node, full_name))),
        environment.get("ROS_DISTRO", ""),
        tuple(passed),
    )
    for rule in rules:
        for name in rule:
            made.expanded(name)  # raise for a rule that can never match
    return made


_Given = tuple[str, str] | Path
"""Name and value of a parameter, or a file of them."""


def _words(words: Sequence[str]) -> tuple[list[tuple[str, str]], list[_Given], list[str]]:
    rules: list[tuple[str, str]] = []
    parameters: list[_Given] = []
    passed: list[str] = []
    waiting = list(words)
    while waiting:
        flag = waiting.pop(0)
        if flag in ("--ros-args", "--") and (flag == "--ros-args" or not waiting):
            continue
        if _STREAMS.fullmatch(flag):
            passed.append(flag)
            continue
        text = waiting.pop(0) if waiting else ""
        name, separator, value = text.partition(":=")
        if flag in ("-r", "--remap") and name and separator and value:
            rules.append((name, value))
        elif flag in ("-p", "--param") and name and separator and value:
            parameters.append((name, value))
        elif flag == "--params-file" and text:
            parameters.append(Path(text))
        elif flag in _PASSED and text:
            passed += [flag, text]
        else:
            raise VariantError(
                "after --ros-args expected -r FROM:=TO, -p NAME:=VALUE or --params-file FILE, got "
                f"'{' '.join((flag, text)).strip()}'"
            )
    return rules, parameters, passed


def _for_node(name: str, node: str) -> str | None:
    """A name without the node that it is for; None where that is another node."""
    target, colon, rest = name.partition(":")
    if not (colon and re.fullmatch(_TOKEN, target)):
        return name
    return rest if target == node else None


def _values(given: Sequence[_Given], node: str, full_name: str) -> Iterator[tuple[str, str]]:
    """Names and values of the parameters that are meant for the node, in their order."""
    for each in given:
        if isinstance(each, Path):
            yield from _values_of_file(each, full_name)
        else:
            name = _for_node(each[0], node)
            if name is not None:
                yield name, each[1]


def _values_of_file(path: Path, full_name: str) -> Iterator[tuple[str, str]]:
    """Those of a parameter file of ROS: nodes by name or pattern, each with `ros__parameters`."""
    yaml = needed("yaml", "flights", "--params-file")
    try:
        content = yaml.safe_load(require_file(path, "parameter file").read_text("utf-8"))
    except (ValueError, RecursionError, yaml.YAMLError) as error:
        raise VariantError(f"parameter file is not YAML ({described(error)}): {path}") from error
    flat = dict(_flat(content if isinstance(content, dict) else {}, "/"))
    marker = "/ros__parameters"
    if not any(marker in name for name in flat):
        raise VariantError(f"parameter file: expected NODE: ros__parameters: NAME: VALUE: {path}")
    for name, value in flat.items():
        node, _, parameter = name.partition(marker + "/")
        pattern = re.sub("/+", "/", f"/{node}").replace("/**", "*")
        if parameter and fnmatchcase(full_name, pattern):
            yield parameter.replace("/", "."), value


def _flat(values: Mapping[Any, Any], separator: str) -> Iterator[tuple[str, str]]:
    for name, value in values.items():
        if isinstance(value, dict):
            for inner, leaf in _flat(value, separator):
                yield f"{name}{separator}{inner}", leaf
        else:
            yield str(name), str(value)


def _parameters(pairs: Sequence[tuple[str, str]]) -> Parameters:
    known = {each.name: each.type for each in fields(Parameters)}
    values: dict[str, str | bool] = {}
    for name, given in pairs:
        text = given.strip("\"'")
        if name not in known:
            log.warning("parameter %s is ignored; parameters are %s", name, ", ".join(known))
        elif known[name] is bool:
            if text.lower() not in _TRUTH:
                raise VariantError(f"parameter {name} is true or false, got '{text}'")
            values[name] = _TRUTH[text.lower()]
        elif text not in _CHOICES.get(name, (text,)):
            raise VariantError(f"parameter {name} is {' or '.join(_CHOICES[name])}, got '{text}'")
        elif name == "altitude" and text not in _ALTITUDES and not _is_number(text):
            raise VariantError(
                f"parameter altitude is {', '.join(_ALTITUDES)} or metres, got '{text}'"
            )
        else:
            values[name] = text
    return Parameters(**values)  # type: ignore[arg-type]  # each has the type of its field


def _is_number(text: str) -> bool:
    try:
        return math.isfinite(float(text))
    except ValueError:
        return False
