"""Positions, the origin of their local frame and health as messages of ROS 2.

Frames by REP 103 and REP 105: `map` is east, north, up at the origin, the aircraft forward, left,
up. Positions reach this module only through the gate.
"""

import math
from collections.abc import Callable, Iterator, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from orthonav.core.flight.ros_messages import NO_ALTITUDE_M2
from orthonav.core.geo.attitude import ros_xyzw_from_ned
from orthonav.core.geo.frames import LocalFrame
from orthonav.onboard.messages.estimate import NavigationEstimate, floored
from orthonav.onboard.ros2.node import Node, Writer
from orthonav.onboard.telemetry import VehicleState

NOT_MEASURED_RAD2 = math.pi**2
"""Variance of an angle that is not measured: (180 deg)^2."""
_LEVELS = {"OK": 0, "DEGRADED": 1, "FAILED": 2}
Array = NDArray[np.float64]


class Ros2Publisher:
    """Publishes positions that passed the gate. The origin is latched for later subscribers."""

    def __init__(
        self,
        node: Node,
        origin: LocalFrame,
        now_ns: Callable[[], int],
        *,
        origin_alt_m: float = math.nan,
        min_std_m: float = 0.0,
        silent: bool = False,
    ) -> None:
        """`origin`: origin of the map frame, `origin_alt_m` its altitude. `now_ns`: reads ROS time.
        `min_std_m`: lower bound of the standard deviation in any direction. `silent`: send no
        positions."""
        self._node, self._frame, self._now_ns = node, origin, now_ns
        self._floor_m, self._silent = min_std_m, silent
        self._origin_alt_m, self._parameters = origin_alt_m, node.parameters
        self.for_filter = self._parameters.covariance == "filter"

        def topic(name: str, kind: str, **options: Any) -> Writer:
            return node.advertise(node.resolved(name), kind, **options)

        self._fix = topic("~/fix", "sensor_msgs/msg/NavSatFix")
        self._pose = topic("~/pose", "geometry_msgs/msg/PoseWithCovarianceStamped")
        self._origin = topic(
            "~/origin", "geographic_msgs/msg/GeoPointStamped", depth=1, latched=True
        )
        self._health = topic("/diagnostics", "diagnostic_msgs/msg/DiagnosticArray")
        self._send_origin()

    def position(
        self, estimate: NavigationEstimate, vehicle: VehicleState, stamp_ns: int
    ) -> tuple[str, ...]:
        """The names of the topics. Raises `EstimateError`, also for a low confidence."""
        estimate.require_confident("NavSatFix")
        if self._silent:
            return ()
        cov = floored(np.asarray(estimate.cov_en_m2), self._floor_m)
        definitions, place = self._node.definitions, (estimate.lat_deg, estimate.lon_deg)
        header = definitions.header(stamp_ns, self._parameters.base_frame)
        self._fix(definitions.navsatfix(header, place, cov, self._altitude_m(vehicle)))
        turn = np.array([0.0, 0.0, 0.0, 1.0])  # where the attitude is not known
        if vehicle.ned_from_body is not None:
            turn = ros_xyzw_from_ned(vehicle.ned_from_body)
        self._pose(self._posed(self._frame.en_from_latlon(*place), cov, turn, stamp_ns))
        return "NavSatFix", "PoseWithCovarianceStamped"

    def health(self, plain: dict[str, Any]) -> None:
        new = self._node.definitions.new
        problems = {f"topic {name}": text for name, text in self._node.problems.items()}
        damaged = {f"damaged on {name}": n for name, n in self._node.undecodable.items()}
        level = _LEVELS[plain["health"]]
        values = [
            new("diagnostic_msgs/msg/KeyValue", key=name, value=value)
            for name, value in _flat({**plain, **problems, **damaged})
        ]
        status = new(
            "diagnostic_msgs/msg/DiagnosticStatus",
            level=max(level, 1) if problems else level,
            name=f"{self._node.name}: position",
            message=", ".join([*plain["reasons"], *problems]) or "OK",
            hardware_id="orthonav",
            values=values,
        )
        header = self._node.definitions.header(self._now_ns(), "")
        self._health(new("diagnostic_msgs/msg/DiagnosticArray", header=header, status=[status]))

    def _send_origin(self) -> None:
        definitions = self._node.definitions
        place = definitions.new(
            "geographic_msgs/msg/GeoPoint",
            latitude=self._frame.lat_deg,
            longitude=self._frame.lon_deg,
            altitude=self._origin_alt_m,  # NaN: not specified
        )
        header = definitions.header(self._now_ns(), self._parameters.map_frame)
        self._origin(
            definitions.new("geographic_msgs/msg/GeoPointStamped", header=header, position=place)
        )

    def _altitude_m(self, vehicle: VehicleState) -> float:
        chosen = self._parameters.altitude
        if chosen == "terrain":
            return vehicle.amsl_m
        if chosen == "home":
            return self._origin_alt_m + vehicle.home_m
        return math.nan if chosen == "none" else float(chosen)

    def _posed(self, position_en_m: Array, cov: Array, turn: Array, stamp_ns: int) -> Any:
        """Pose whose x and y are measured. z is 0 and the orientation is the reported one, both
        with large variances. Order: x, y, z, rotations about X, Y, Z."""
        definitions = self._node.definitions
        full = np.diag([0.0, 0, NO_ALTITUDE_M2, *[NOT_MEASURED_RAD2] * 3])
        full[:2, :2] = cov
        pose = definitions.new(
            "geometry_msgs/msg/Pose",
            position=definitions.vector("Point", "xyz", (*position_en_m, 0.0)),
            orientation=definitions.vector("Quaternion", "xyzw", turn.tolist()),
        )
        return definitions.new(
            "geometry_msgs/msg/PoseWithCovarianceStamped",
            header=definitions.header(stamp_ns, self._parameters.map_frame),
            pose=definitions.new(
                "geometry_msgs/msg/PoseWithCovariance", pose=pose, covariance=full.ravel()
            ),
        )


def _flat(values: Mapping[str, Any], before: str = "") -> Iterator[tuple[str, str]]:
    """Names and texts of nested values, as tools for diagnostics show them."""
    for name, value in values.items():
        if isinstance(value, Mapping):
            yield from _flat(value, f"{before}{name}.")
        elif isinstance(value, list | tuple):
            yield f"{before}{name}", ", ".join(map(str, value))
        else:
            yield f"{before}{name}", "" if value is None else str(value)
