"""NMEA sentences: as recorded here, and as pynmeagps reads them, which shares no code with us."""

import math
from dataclasses import replace
from datetime import date, time

import numpy as np
import pynmeagps
import pytest
from hypothesis import given
from hypothesis import strategies as st

from orthonav.onboard.messages.estimate import NavigationEstimate
from orthonav.onboard.messages.nmea import MPS_PER_KNOT, Quality, sentences

UTC_NS = 1_789_000_000_123_456_789  # 2026-09-10 00:26:40
ESTIMATE = NavigationEstimate(
    48.1234567,
    -4.3210987,
    np.array([[16.0, 3.0], [3.0, 9.0]]),
    0.95,
    time_ns=1,
    utc_ns=UTC_NS,
    alt_amsl_m=134.56,
    alt_std_m=2.5,
    vel_en_mps=(12.0, -3.5),
    state="tracking",
)


def read(estimate, *more):
    """GGA, RMC and GST as pynmeagps reads them: it checks the checksum."""
    lines = sentences(estimate, *more).splitlines(keepends=True)
    assert all(len(line) <= 82 for line in lines)  # with `$` and the line end, NMEA 0183
    return [pynmeagps.NMEAReader.parse(line, validate=pynmeagps.VALCKSUM) for line in lines]


@pytest.mark.parametrize(
    ("made", "recorded"),
    [
        (
            sentences(ESTIMATE),
            b"$GPGGA,002640.123,4807.40740,N,00419.26592,W,6,00,,134.6,M,,,,*3E\r\n"
            b"$GPRMC,002640.123,V,4807.40740,N,00419.26592,W,24.30,106.3,100926,,,E*68\r\n"
            b"$GPGST,002640.123,,4.14,2.81,69.7,3.00,4.00,2.50*4B\r\n",
        ),
        (
            sentences(ESTIMATE, quality=Quality.AUTONOMOUS),
            b"$GPGGA,002640.123,4807.40740,N,00419.26592,W,1,00,,134.6,M,,,,*39\r\n"
            b"$GPRMC,002640.123,A,4807.40740,N,00419.26592,W,24.30,106.3,100926,,,A*7B\r\n"
            b"$GPGST,002640.123,,4.14,2.81,69.7,3.00,4.00,2.50*4B\r\n",
        ),
        (
            sentences(None, UTC_NS),
            b"$GPGGA,002640.123,,,,,0,00,,,,,,,*78\r\n"
            b"$GPRMC,002640.123,V,,,,,,,100926,,,N*41\r\n"
            b"$GPGST,002640.123,,,,,,,*49\r\n",
        ),
        (sentences(None).splitlines(keepends=True)[2], b"$GPGST,,,,,,,,*57\r\n"),
    ],
)
def test_sentences_equal_recorded_ones(made, recorded):
    assert made == recorded


def test_pynmeagps_reads_every_field():
    fix, minimum, errors = read(ESTIMATE)
    assert (fix.quality, fix.numSV, fix.alt, fix.altUnit, fix.HDOP) == (6, 0, 134.6, "M", "")
    assert fix.time == minimum.time == errors.time == time(0, 26, 40, 123000)
    assert minimum.date == date(2026, 9, 10)
    assert (minimum.status, minimum.posMode) == ("V", "E")
    assert minimum.spd * MPS_PER_KNOT == pytest.approx(12.5, abs=0.005)
    assert minimum.cog == pytest.approx(math.degrees(math.atan2(12.0, -3.5)), abs=0.05)
    values, vectors = np.linalg.eigh(ESTIMATE.cov_en_m2)
    assert [errors.stdMinor, errors.stdMajor] == pytest.approx(np.sqrt(values), abs=0.005)
    east, north = vectors[:, 1]
    assert math.tan(math.radians(errors.orient)) == pytest.approx(east / north, rel=0.01)
    assert (errors.stdLat, errors.stdLong, errors.stdAlt) == (3.0, 4.0, 2.5)


@pytest.mark.parametrize(
    "change",
    [
        None,
        {"confidence": 0.89},
        {"confidence": math.nan},
        {"state": "lost"},
        {"cov_en_m2": np.full((2, 2), math.nan)},
    ],
)
@pytest.mark.parametrize("quality", list(Quality))
def test_low_confidence_is_marked_and_has_no_position(change, quality):
    estimate = None if change is None else replace(ESTIMATE, **change)
    fix, minimum, errors = read(estimate, None, quality)
    assert (fix.quality, minimum.status, minimum.posMode) == (0, "V", "N")
    for message in (fix, minimum):
        assert (message.lat, message.lon, message.NS, message.EW) == ("", "", "", "")
    assert (minimum.spd, minimum.cog, errors.stdMajor, errors.stdLat) == ("", "", "", "")


latitudes = st.floats(-90, 90) | st.sampled_from([90.0, -90.0, 0.0, -0.0, 47.99999999, 59.9999999])
longitudes = st.floats(-180, 180) | st.sampled_from([180.0, -180.0, 179.99999999, -9.99999999])


@given(latitudes, longitudes)
def test_any_position_round_trips_within_two_centimetres(lat_deg, lon_deg):
    estimate = replace(ESTIMATE, lat_deg=lat_deg, lon_deg=lon_deg)
    lines = sentences(estimate).decode().splitlines()
    for message, line in zip(read(estimate)[:2], lines, strict=False):
        assert message.lat == pytest.approx(lat_deg, abs=0.51e-5 / 60)
        assert message.lon == pytest.approx(lon_deg, abs=0.51e-5 / 60)
        minutes = [field[-8:] for field in line.split(",") if field[-6:-5] == "."]
        assert len(minutes) == 2 and all(float(minute) < 60 for minute in minutes)


numbers = st.floats() | st.sampled_from([1e9, -1e9, 1e300, math.nan, math.inf])


@given(numbers, numbers, numbers, numbers, st.integers(-(2**70), 2**70))
def test_values_are_limited_to_their_fields(altitude, deviation, east, north, utc_ns):
    values = {"alt_amsl_m": altitude, "alt_std_m": abs(deviation), "vel_en_mps": (east, north)}
    estimate = replace(ESTIMATE, **values, cov_en_m2=np.eye(2) * 1e10, utc_ns=utc_ns)
    fix, minimum, errors = read(estimate)
    assert fix.alt == "" or abs(fix.alt - altitude) <= 0.051
    assert errors.stdMajor == 9999.99
    assert minimum.spd == "" or 0 <= minimum.spd <= 999.99
    assert minimum.cog == "" or 0 <= minimum.cog < 360


def test_an_unknown_time_is_an_empty_field():
    at_boot = replace(ESTIMATE, utc_ns=None)
    assert b"$GPRMC,,V,4807.40740,N" in sentences(at_boot)
    assert read(at_boot)[0].time == ""


@pytest.mark.parametrize(
    ("velocity", "speed", "course"),
    [((0.0, 5.0), 9.72, 0.0), ((-1e-6, 5.0), 9.72, 0.0), ((-5.0, 0.0), 9.72, 270.0)],
)
def test_course_is_from_north_and_below_360(velocity, speed, course):
    _, message, _ = read(replace(ESTIMATE, vel_en_mps=velocity))
    assert (message.spd, message.cog) == (speed, course)
