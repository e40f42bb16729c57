"""NMEA 0183 sentences of a position: GGA, RMC and GST, for displays, loggers and old receivers.

Fields are as in version 2.3 to 4.0; unknown values, and altitudes that do not fit, are empty.
Without a confident position: quality 0 (GGA), status V and mode N (RMC), empty fields (GST). The
writer of pynmeagps writes 60.00000 minutes, zeros for unknown numbers and the time of now.
"""

import math
from datetime import UTC, datetime, timedelta
from enum import Enum
from functools import reduce
from operator import xor

from orthonav.core.records import error_ellipse
from orthonav.onboard.messages.estimate import NavigationEstimate

MPS_PER_KNOT = 1852 / 3600
_MINUTE = 10**5
"""Resolution of minutes: five decimals, 2 cm."""
_LARGEST_M, _LARGEST_KNOTS = 9999.99, 999.99
_UNIX = datetime(1970, 1, 1, tzinfo=UTC)


class Quality(Enum):
    ESTIMATED = ("6", "V", "E")
    """Receivers that need satellites, such as ArduPilot, do not take it for GPS."""
    AUTONOMOUS = ("1", "A", "A")
    """As a GPS fix, for receivers that accept nothing else."""


def sentences(
    estimate: NavigationEstimate | None,
    utc_ns: int | None = None,
    quality: Quality = Quality.ESTIMATED,
) -> bytes:
    """GGA: time, position, quality, altitude above mean sea level where known; 00 satellites.
    RMC: time and date, status, position, speed in knots and course where velocity is known.
    GST: one-sigma error ellipse (m, direction of the major axis from true north) and standard
    deviations of latitude, longitude and altitude (m); the RMS of ranges is empty.

    `utc_ns`: time of sentences without an estimate.
    """
    time, date = _time_and_date(utc_ns if estimate is None else estimate.utc_ns)
    if estimate is None or not estimate.is_confident:
        gga = [*[""] * 4, "0", "00", *[""] * 7]
        rmc = ["V", *[""] * 6, date, "", "", "N"]
        gst = [""] * 7
    else:
        fix, status, mode = quality.value
        lat, lon, alt_m = estimate.lat_deg, estimate.lon_deg, estimate.alt_amsl_m
        north_south, east_west = "S" if lat < 0 else "N", "W" if lon < 0 else "E"
        place = _minutes(lat, 2), north_south, _minutes(lon, 3), east_west
        altitude = (f"{alt_m:.1f}", "M") if -9999.9 <= alt_m <= 99999.9 else ("", "")  # NaN too
        gga = [*place, fix, "00", "", *altitude, "", "", "", ""]
        rmc = [status, *place, *_speed_and_course(estimate.vel_en_mps), date, "", "", mode]
        *axes_m, direction_deg = error_ellipse(estimate.cov_en_m2)
        east_m, north_m = (math.sqrt(max(v, 0.0)) for v in estimate.cov_en_m2.diagonal().tolist())
        axes = [_number(each, _LARGEST_M) for each in axes_m]
        spread = [_number(each, _LARGEST_M) for each in (north_m, east_m, estimate.alt_std_m)]
        gst = ["", *axes, f"{round(direction_deg, 1) % 180.0:.1f}", *spread]
    made = ("GPGGA", time, *gga), ("GPRMC", time, *rmc), ("GPGST", time, *gst)
    return b"".join(map(_sentence, made))


def _sentence(fields: tuple[str, ...]) -> bytes:
    """With its checksum: exclusive or of all characters between `$` and `*`."""
    body = ",".join(fields).encode("ascii")
    return b"$%s*%02X\r\n" % (body, reduce(xor, body))


def _minutes(degrees: float, width: int) -> str:
    """Degrees and minutes as `ddmm.mmmmm`, rounded together so that minutes stay below 60."""
    whole, rest = divmod(round(abs(degrees) * 60 * _MINUTE), 60 * _MINUTE)
    minutes, parts = divmod(rest, _MINUTE)
    return f"{whole:0{width}d}{minutes:02d}.{parts:05d}"


def _time_and_date(utc_ns: int | None) -> tuple[str, str]:
    """Empty where the time is not known, or no date has it."""
    if utc_ns is None:
        return "", ""
    try:
        moment = _UNIX + timedelta(milliseconds=utc_ns // 1_000_000)
    except OverflowError:
        return "", ""
    time = f"{moment:%H%M%S}.{moment.microsecond // 1000:03d}"
    return time, f"{moment:%d%m}{moment.year % 100:02d}"


def _number(value: float, largest: float) -> str:
    return f"{min(value, largest):.2f}" if math.isfinite(value) else ""


def _speed_and_course(vel_en_mps: tuple[float, float] | None) -> tuple[str, str]:
    if vel_en_mps is None or not all(map(math.isfinite, vel_en_mps)):
        return "", ""
    east, north = vel_en_mps
    speed = math.hypot(east, north) / MPS_PER_KNOT
    course = round(math.degrees(math.atan2(east, north)) % 360.0, 1) % 360.0
    return _number(speed, _LARGEST_KNOTS), f"{course:.1f}" if speed > 0 else ""
