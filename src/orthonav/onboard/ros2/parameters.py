"""Parameters of the ROS 2 node (`-p NAME:=VALUE`), which `rclpy` reads."""

import logging
import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass, fields
from typing import Any

from orthonav.core.errors import VariantError

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Parameters:
    """`use_sim_time`: ROS time is that of `/clock`, not the system's. `image_transport`: "raw" or
    "compressed". `image_reliability`: "best_effort" (sensor data) or "reliable", which resends lost
    parts of large pictures and matches reliable writers only. `covariance`: "filter" (larger, for
    a filter that takes positions as independent) or "fix". `altitude` of the fix: "none" (NaN),
    that of the "terrain" of the map plus the height above ground, that of the origin plus the
    height above "home", or a number of metres.

    Raises `VariantError` for a value that is none of these.
    """

    use_sim_time: bool = False
    image_transport: str = "raw"
    image_reliability: str = "best_effort"
    map_frame: str = "map"
    base_frame: str = "base_link"
    covariance: str = "filter"
    altitude: str = "none"

    def __post_init__(self) -> None:
        choices = {
            "image_transport": ("raw", "compressed"),
            "image_reliability": ("best_effort", "reliable"),
            "covariance": ("filter", "fix"),
        }
        for name, allowed in choices.items():
            if getattr(self, name) not in allowed:
                raise VariantError(
                    f"parameter {name} is {' or '.join(allowed)}, got '{getattr(self, name)}'"
                )
        if self.altitude not in ("none", "terrain", "home") and not _is_number(self.altitude):
            raise VariantError(
                f"parameter altitude is none, terrain, home or metres, got '{self.altitude}'"
            )


def declared(declare: Callable[[str, Any], Any], given: Iterable[str]) -> Parameters:
    """Parameters whose values are what `declare` gives for a name and a default.

    Warns of names among those `given` that are no parameters. Raises `VariantError`."""
    values = {each.name: declare(each.name, each.default) for each in fields(Parameters)}
    for name in given:
        if name not in values and not name.startswith("qos_overrides."):  # those are of `rclpy`
            log.warning("parameter %s is ignored; parameters are %s", name, ", ".join(values))
    use_sim_time = values.pop("use_sim_time")
    if not isinstance(use_sim_time, bool):
        raise VariantError(f"parameter use_sim_time is true or false, got '{use_sim_time}'")
    return Parameters(use_sim_time, **{name: str(value) for name, value in values.items()})


def _is_number(text: str) -> bool:
    try:
        return math.isfinite(float(text))
    except ValueError:
        return False
