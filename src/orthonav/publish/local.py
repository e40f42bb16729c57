"""North and east of an origin as the autopilot itself will turn them back into a position.

Messages in a local frame are metres from an origin, and each autopilot has a formula of its own for
that: PX4 an azimuthal-equidistant plane on a sphere of 6371 km, ArduPilot degrees times a constant.
Neither is the ellipsoid: 10 km from the origin true metres come back as a place up to 30 m away at
48 degrees north, and up to 67 m at the equator. So the metres sent are those which the receiver's
own formula takes for the fix.

Sources: PX4-Autopilot `src/lib/geo/geo.cpp` (`MapProjection::project`); ArduPilot
`libraries/AP_Common/Location.cpp` (`Location::get_distance_NE`, `longitude_scale`) and its
`LOCATION_SCALING_FACTOR`.
"""

import math
from dataclasses import dataclass
from enum import Enum

from orthonav.publish.estimate import EstimateError

PX4_RADIUS_M = 6371000.0
ARDUPILOT_M_PER_DEG = 0.011131884502145034 * 1e7
_LEAST_SCALE = 0.01  # ArduPilot's, near the poles


class Autopilot(Enum):
    """Whose conventions a message in a local frame follows."""

    PX4 = "px4"
    ARDUPILOT = "ardupilot"


@dataclass(frozen=True)
class Origin:
    """Where an autopilot's local frame has its zero (WGS84, metres above mean sea level).

    Raises `EstimateError` where it is no place; an altitude is needed, because the message that
    sets the origin has no way to leave it out.
    """

    lat_deg: float
    lon_deg: float
    alt_amsl_m: float

    def __post_init__(self) -> None:
        placed = abs(self.lat_deg) <= 90 and abs(self.lon_deg) <= 180
        if not (placed and math.isfinite(self.alt_amsl_m)):
            raise EstimateError(
                f"an origin needs latitude, longitude and altitude, got {self.lat_deg}, "
                f"{self.lon_deg}, {self.alt_amsl_m}"
            )


def north_east_m(
    origin: Origin, lat_deg: float, lon_deg: float, autopilot: Autopilot
) -> tuple[float, float]:
    """Metres north and east of `origin` that `autopilot` takes for this latitude and longitude."""
    if autopilot is Autopilot.PX4:
        return _px4(origin, lat_deg, lon_deg)
    turned_deg = (lon_deg - origin.lon_deg + 180.0) % 360.0 - 180.0
    scale = max(math.cos(math.radians((lat_deg + origin.lat_deg) / 2)), _LEAST_SCALE)
    north_m = (lat_deg - origin.lat_deg) * ARDUPILOT_M_PER_DEG
    return north_m, turned_deg * ARDUPILOT_M_PER_DEG * scale


def _px4(origin: Origin, lat_deg: float, lon_deg: float) -> tuple[float, float]:
    """Azimuthal-equidistant on a sphere; the angle by atan2, which is exact near zero too."""
    lat, lat0 = math.radians(lat_deg), math.radians(origin.lat_deg)
    turned = math.radians(lon_deg - origin.lon_deg)
    north = math.cos(lat0) * math.sin(lat) - math.sin(lat0) * math.cos(lat) * math.cos(turned)
    east = math.cos(lat) * math.sin(turned)
    along = math.sin(lat0) * math.sin(lat) + math.cos(lat0) * math.cos(lat) * math.cos(turned)
    across = math.hypot(north, east)
    scale = math.atan2(across, along) / across if across > 0 else 1.0
    return north * scale * PX4_RADIUS_M, east * scale * PX4_RADIUS_M
