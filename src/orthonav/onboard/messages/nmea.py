"""NMEA 0183 sentences of a position: GGA, RMC and GST, for displays, loggers and old receivers.

Fields are as in version 2.3 to 4.0; unknown values, and altitudes that do not fit, are empty.
Without a confident position: quality 0 (GGA), status V and mode N (RMC), empty fields (GST). The
writer of pynmeagps writes 60.00000 minutes, zeros for unknown numbers and the time of now.
"""

import math
from datetime import UTC, datetime, timedelta
from enum import Enum

from orthonav.core.records import error_ellipse
from orthonav.onboard.messages.estimate import NavigationEstimate

MPS_PER_KNOT = 1852 / 3600
_MINUTE = 10**5
"""Resolution of minutes: five decimals, 2 cm."""
_LARGEST_M, _LARGEST_KNOTS = 9999.99, 999.99
_ALTITUDES_M = (-9999.9, 99999.9)
_UNIX = datetime(1970, 1, 1, tzinfo=UTC)


class Quality(Enum):
    ESTIMATED = ("6", "V", "E")
    """Receivers that need satellites, such as ArduPilot, do not take it for GPS."""
    AUTONOMOUS = ("1", "A", "A")
    """As a GPS fix, for receivers that accept nothing else."""


def gga(
    estimate: NavigationEstimate | None,
    utc_ns: int | None = None,
    quality: Quality = Quality.ESTIMATED,
) -> bytes:
    """GGA: time, position, quality, altitude above mean sea level where known; 00 satellites.

    `utc_ns`: time of a sentence without an estimate.
    """
    time_ns, confident = _when_and_whether(estimate, utc_ns)
    if estimate is None or not confident:
        return _sentence(["GGA", _time(time_ns), *_NO_PLACE, "0", "00", *[""] * 7])
    altitude, place = _altitude(estimate.alt_amsl_m), _place(estimate)
    tail = ["00", "", altitude, "M" if altitude else "", "", "", "", ""]
    return _sentence(["GGA", _time(time_ns), *place, quality.value[0], *tail])


def rmc(
    estimate: NavigationEstimate | None,
    utc_ns: int | None = None,
    quality: Quality = Quality.ESTIMATED,
) -> bytes:
    """RMC: time and date, status, position, speed in knots and course where velocity is known."""
    time_ns, confident = _when_and_whether(estimate, utc_ns)
    if estimate is None or not confident:
        fields = ["V", *_NO_PLACE, "", "", _date(time_ns), "", "", "N"]
    else:
        _, status, mode = quality.value
        speed, course = _speed_and_course(estimate.vel_en_mps)
        fields = [status, *_place(estimate), speed, course, _date(time_ns), "", "", mode]
    return _sentence(["RMC", _time(time_ns), *fields])


def gst(estimate: NavigationEstimate | None, utc_ns: int | None = None) -> bytes:
    """GST: one-sigma error ellipse (m, direction of the major axis from true north) and standard
    deviations of latitude, longitude and altitude (m). The RMS of ranges is empty."""
    time_ns, confident = _when_and_whether(estimate, utc_ns)
    if estimate is None or not confident:
        return _sentence(["GST", _time(time_ns), *[""] * 7])
    major, minor, direction_deg = error_ellipse(estimate.cov_en_m2)
    direction = f"{round(direction_deg, 1) % 180.0:.1f}"
    north, east = (math.sqrt(max(float(estimate.cov_en_m2[i, i]), 0.0)) for i in (1, 0))
    axes = [_number(major, _LARGEST_M), _number(minor, _LARGEST_M), direction]
    spread = [_number(value, _LARGEST_M) for value in (north, east, estimate.alt_std_m)]
    return _sentence(["GST", _time(time_ns), "", *axes, *spread])


def checksum(body: str) -> str:
    """Two hexadecimal digits: exclusive or of all characters between `$` and `*`."""
    value = 0
    for byte in body.encode("ascii"):
        value ^= byte
    return f"{value:02X}"


_NO_PLACE = ("", "", "", "")


def _sentence(fields: list[str]) -> bytes:
    body = "GP" + ",".join(fields)
    return f"${body}*{checksum(body)}\r\n".encode("ascii")


def _when_and_whether(
    estimate: NavigationEstimate | None, utc_ns: int | None
) -> tuple[int | None, bool]:
    if estimate is None:
        return utc_ns, False
    return estimate.utc_ns, estimate.is_confident


def _place(estimate: NavigationEstimate) -> list[str]:
    lat, lon = estimate.lat_deg, estimate.lon_deg
    north_south, east_west = "S" if lat < 0 else "N", "W" if lon < 0 else "E"
    return [_minutes(lat, 2), north_south, _minutes(lon, 3), east_west]


def _minutes(degrees: float, width: int) -> str:
    """Degrees and minutes as `ddmm.mmmmm`, rounded together so that minutes stay below 60."""
    whole, rest = divmod(round(abs(degrees) * 60 * _MINUTE), 60 * _MINUTE)
    minutes, parts = divmod(rest, _MINUTE)
    return f"{whole:0{width}d}{minutes:02d}.{parts:05d}"


def _moment(utc_ns: int | None) -> datetime | None:
    if utc_ns is None:
        return None
    try:
        return _UNIX + timedelta(milliseconds=utc_ns // 1_000_000)
    except OverflowError:
        return None


def _time(utc_ns: int | None) -> str:
    moment = _moment(utc_ns)
    return "" if moment is None else f"{moment:%H%M%S}.{moment.microsecond // 1000:03d}"


def _date(utc_ns: int | None) -> str:
    moment = _moment(utc_ns)
    return "" if moment is None else f"{moment:%d%m}{moment.year % 100:02d}"


def _number(value: float, largest: float) -> str:
    return f"{min(value, largest):.2f}" if math.isfinite(value) else ""


def _altitude(alt_amsl_m: float) -> str:
    low, high = _ALTITUDES_M
    return f"{alt_amsl_m:.1f}" if low <= alt_amsl_m <= high else ""  # NaN too


def _speed_and_course(vel_en_mps: tuple[float, float] | None) -> tuple[str, str]:
    if vel_en_mps is None or not all(map(math.isfinite, vel_en_mps)):
        return "", ""
    east, north = vel_en_mps
    speed = math.hypot(east, north) / MPS_PER_KNOT
    course = round(math.degrees(math.atan2(east, north)) % 360.0, 1) % 360.0
    return _number(speed, _LARGEST_KNOTS), f"{course:.1f}" if speed > 0 else ""
