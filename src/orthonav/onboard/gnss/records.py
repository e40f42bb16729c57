"""Records of the GNSS monitor: its inputs (also from MAVLink), its faults and its status."""

import math
from dataclasses import dataclass
from enum import Enum
from typing import Any

import numpy as np
from numpy.typing import NDArray

from orthonav.core.flight.gnss import FAULTS, GnssSample

Array = NDArray[np.float64]
NANOSECONDS = 1e-9


class Fault(Enum):
    """A fault of GNSS; the value is the reason in health, logs and pages. In order of priority."""

    LOST = "gnss_lost"
    """No messages, no 3D fix, or a useless stated accuracy."""
    FROZEN = "gnss_frozen"
    """The position or the timestamp stands still while the aircraft moves."""
    JUMP = "gnss_jump"
    """The position jumps against the receiver's own velocity."""
    STEP = "gnss_step"
    """The difference from the map changed within seconds."""
    DRIFT = "gnss_drift"
    """The difference from the map grows."""
    VELOCITY = "gnss_velocity"
    """The velocity contradicts the positions of the receiver."""
    OFFSET = "gnss_offset"
    """The difference from the map is too large, and did not begin within the window."""
    DISAGREES = "gnss_disagrees"
    """The difference changed, but the map jumped too: which of the two is wrong is not known."""

    @property
    def code(self) -> int:
        """Number of the fault, from 1, in evidence and NAMED_VALUE_FLOAT."""
        return FAULTS.index(self.value) + 1


RETURNING = FAULTS[-1]
"""Reason in health while GNSS agrees again, but not yet for long enough."""
RETURNING_CODE = len(FAULTS)


class GnssState(Enum):
    WAITING = "waiting"
    """Since the start: no fault, but no agreement with the map yet."""
    GOOD = "good"
    """GNSS and map agree; the biases of their difference are learnt."""
    ALARM = "alarm"
    """A fault."""
    RETURNING = "returning"
    """No fault is seen any more; not yet in agreement for long enough."""


@dataclass(frozen=True, eq=False)
class MapPosition:
    """A confident position by the map.

    `time_ns`: exposure, by the clock of the samples.
    `en_m` (2,): position in the plane of the map, uncorrected.
    `std_m`: standard deviation along the worst axis.
    `vel_en_mps` (2,): velocity of the track; None where not known.
    `heading_deg`: heading of the top of the image; errors of a tilted mount turn with it.
    `agl_m`: height above ground; errors of a tilted mount grow with it. 0 where not known.
    `as_stated`: whether the latency in use is the stated one, to which the learnt one belongs.
    """

    time_ns: int
    en_m: Array
    std_m: float
    vel_en_mps: Array | None = None
    heading_deg: float = 0.0
    agl_m: float = 0.0
    as_stated: bool = True


@dataclass(frozen=True)
class GnssStatus:
    """Status of one receiver.

    `state`, `fault`: the fault is that of the alarm, also while returning; None without one.
    `since_ns`: time at which the state began.
    `difference_en_m`: recent GNSS minus map, east and north; NaN where not known. A switch from the
    map to GNSS would make this jump.
    `fault_en_m`: estimated change of the difference by the fault; NaN where it has none.
    """

    state: GnssState = GnssState.WAITING
    fault: Fault | None = None
    since_ns: int = 0
    difference_en_m: tuple[float, float] = (math.nan, math.nan)
    fault_en_m: tuple[float, float] = (math.nan, math.nan)

    @property
    def reason(self) -> str | None:
        """Reason in the health; None while there is no alarm."""
        if self.state is GnssState.RETURNING:
            return RETURNING
        return self.fault.value if self.state is GnssState.ALARM and self.fault else None

    @property
    def code(self) -> int:
        """0 without a fault, else that of the fault, or `RETURNING_CODE`."""
        if self.state is GnssState.RETURNING:
            return RETURNING_CODE
        return self.fault.code if self.state is GnssState.ALARM and self.fault else 0


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
