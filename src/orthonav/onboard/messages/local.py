"""Metres north and east of an origin, by the formula with which the autopilot converts them back.

Messages in a local frame contain metres from an origin. PX4 converts them on an
azimuthal-equidistant plane of a sphere of 6371 km, ArduPilot by a constant per degree; neither uses
the ellipsoid. True metres, 10 km from the origin, would become positions up to 30 m away at 48
degrees north, and up to 67 m at the equator. The inverse of the receiver's formula avoids this.

Sources: PX4-Autopilot `src/lib/geo/geo.cpp` (`MapProjection::project`); ArduPilot
`libraries/AP_Common/Location.cpp` (`Location::get_distance_NE`, `longitude_scale`) and its
`LOCATION_SCALING_FACTOR`.
"""

import math
from dataclasses import dataclass
from enum import Enum

from orthonav.core.geo.swapped import swapped_hint
from orthonav.onboard.messages.estimate import EstimateError

PX4_RADIUS_M = 6371000.0
ARDUPILOT_M_PER_DEG = 0.011131884502145034 * 1e7
_LEAST_SCALE = 0.01  # ArduPilot's, near the poles


class Autopilot(Enum):
    """Autopilot whose conventions a message in a local frame follows."""

    PX4 = "px4"
    ARDUPILOT = "ardupilot"


@dataclass(frozen=True)
class Origin:
    """Origin of an autopilot's local frame.

    `lat_deg`, `lon_deg`: WGS84. `alt_amsl_m`: metres above mean sea level; needed, because the
    message that sets the origin cannot omit it. Raises `EstimateError` for invalid values.
    """

    lat_deg: float
    lon_deg: float
    alt_amsl_m: float

    def __post_init__(self) -> None:
        placed = abs(self.lat_deg) <= 90 and abs(self.lon_deg) <= 180
        if not (placed and math.isfinite(self.alt_amsl_m)):
            raise EstimateError(
                f"an origin needs latitude, longitude and altitude, got {self.lat_deg}, "
                f"{self.lon_deg}, {self.alt_amsl_m}{swapped_hint(self.lat_deg, self.lon_deg)}"
            )


def north_east_m(
    origin: Origin, lat_deg: float, lon_deg: float, autopilot: Autopilot
) -> tuple[float, float]:
    """Metres north and east of `origin` that `autopilot` converts to this position."""
    if autopilot is Autopilot.PX4:
        return _px4(origin, lat_deg, lon_deg)
    turned_deg = (lon_deg - origin.lon_deg + 180.0) % 360.0 - 180.0
    scale = max(math.cos(math.radians((lat_deg + origin.lat_deg) / 2)), _LEAST_SCALE)
    north_m = (lat_deg - origin.lat_deg) * ARDUPILOT_M_PER_DEG
    return north_m, turned_deg * ARDUPILOT_M_PER_DEG * scale


def ardupilot_variance(std_m: float) -> float:
    """Variance of each of three axes that ArduPilot reads as the standard deviation `std_m`.

    It takes the root of the sum of the variances of all three axes; older versions the cube root of
    the sum of their squares, which gives `std_m` at 3 m and more than it above
    (`libraries/GCS_MAVLink/GCS_Common.cpp`).
    """
    return std_m**2 / 3


def _px4(origin: Origin, lat_deg: float, lon_deg: float) -> tuple[float, float]:
    """Azimuthal-equidistant projection of a sphere; atan2 is also accurate near zero."""
    lat, lat0 = math.radians(lat_deg), math.radians(origin.lat_deg)
    turned = math.radians(lon_deg - origin.lon_deg)
    north = math.cos(lat0) * math.sin(lat) - math.sin(lat0) * math.cos(lat) * math.cos(turned)
    east = math.cos(lat) * math.sin(turned)
    along = math.sin(lat0) * math.sin(lat) + math.cos(lat0) * math.cos(lat) * math.cos(turned)
    across = math.hypot(north, east)
    scale = math.atan2(across, along) / across if across > 0 else 1.0
    return north * scale * PX4_RADIUS_M, east * scale * PX4_RADIUS_M
