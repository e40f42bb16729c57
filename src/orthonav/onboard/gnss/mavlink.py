"""Solutions of GNSS receivers from MAVLink messages."""

import math
from typing import Any

from orthonav.core.flight.gnss import GnssSample

_LATE_NS = 2 * 10**9
"""Timestamps of GNSS solutions that differ more from their arrival are of another clock."""
_UNKNOWN_16 = 65535
HDOP_STD_M = 3.0
"""Standard deviation of a GNSS position per unit of HDOP, where no accuracy is stated."""


def gnss_sample(message: Any, arrived_ns: int, arrived_boot_ns: int | None) -> GnssSample:
    """The solution of a GPS_RAW_INT or GPS2_RAW by our clock.

    `arrived_ns`: arrival by our clock; `arrived_boot_ns`: by the autopilot's, None where its offset
    is not known. The time of the solution is its timestamp where that is time since boot, else its
    arrival. `eph` is an HDOP; `h_acc`, an extension, is 0 where it is not known.
    """
    stamp_ns = int(message.time_usec) * 1000
    late_ns = math.inf if arrived_boot_ns is None else arrived_boot_ns - stamp_ns
    std_m = math.nan if message.eph == _UNKNOWN_16 else message.eph * 1e-2 * HDOP_STD_M
    std_m = message.h_acc * 1e-3 if message.h_acc > 0 else std_m
    velocity = None
    if _UNKNOWN_16 not in (message.vel, message.cog):
        speed, course = message.vel * 1e-2, math.radians(message.cog * 1e-2)
        velocity = speed * math.sin(course), speed * math.cos(course)
    return GnssSample(
        time_ns=arrived_ns - int(late_ns) if abs(late_ns) <= _LATE_NS else arrived_ns,
        arrived_ns=arrived_ns,
        lat_deg=message.lat * 1e-7,
        lon_deg=message.lon * 1e-7,
        fix_type=message.fix_type,
        std_m=std_m,
        vel_en_mps=velocity,
        satellites=-1 if message.satellites_visible == 255 else message.satellites_visible,
        stamp_ns=stamp_ns or None,
        receiver=int(message.get_type() == "GPS2_RAW"),
    )
