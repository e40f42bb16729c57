"""DJI's telemetry in subtitle files (SRT), in its variants; see `docs/flights.md`."""

import math
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from orthonav.core.errors import FlightError
from orthonav.core.flight.telemetry_track import (
    RecordedTrack,
    Samples,
    attitude_of_angles,
    measured,
)
from orthonav.core.geo.attitude import GIMBAL_TILT_STD_DEG, enu_from_gimbal_camera

MAX_BYTES = 500_000_000
_NUMBER = r"([-+]?\d+(?:\.\d+)?)"
_TIMES = re.compile(r"(\d+):(\d\d):(\d\d)[,.](\d{1,3})\s*-->\s*(\d+):(\d\d):(\d\d)[,.](\d{1,3})")
_ENDS = (">", "]", ")")
"""What blocks end with that are whole, besides the end of a line."""
_TAG = re.compile(r"<[^<>]*>")
_FIELD = re.compile(rf"\b([a-z]+(?:_[a-z]+)*)\s*:\s*{_NUMBER}")
_GPS = re.compile(
    rf"\b(?:GPS|RTK)\s*\(\s*{_NUMBER}\s*,\s*{_NUMBER}\s*(?:,\s*{_NUMBER}\s*([Mm]?)\s*)?\)"
)
_BAROMETER = re.compile(rf"\b(?:BAROMETER|Hb)\s*:\s*{_NUMBER}(M?)")
_HOME = re.compile(r"\bHOME\s*\(")
_HEIGHT = re.compile(rf"\bH\s+{_NUMBER}m\b")
_GIMBAL = re.compile(rf"\bG\.PRY\s*\(\s*{_NUMBER}[^,]*,\s*{_NUMBER}[^,]*,\s*{_NUMBER}")


@dataclass(frozen=True)
class SubtitleBlock:
    """One subtitle; values it does not hold are NaN."""

    start_ns: int
    """Begin in the video."""
    end_ns: int
    """End in the video."""
    lat_deg: float = math.nan
    lon_deg: float = math.nan
    alt_m: float = math.nan
    """Altitude in the drone's own reference."""
    height_m: float = math.nan
    """Height above take-off."""
    yaw_deg: float = math.nan
    """Yaw of the gimbal, as are pitch and roll."""
    pitch_deg: float = math.nan
    roll_deg: float = math.nan


def read_srt(path: Path) -> RecordedTrack:
    """The track of an SRT file; times are those of its video.

    Raises `FlightError` where it has no telemetry.
    """
    if path.stat().st_size > MAX_BYTES:
        raise FlightError(f"file is larger than {MAX_BYTES // 10**6} MB: {path}")
    attitude, position, height = Samples(3), Samples(3), Samples(1)
    last = None
    data = path.read_bytes()
    for last in blocks(data):
        _add(last, last.start_ns, attitude, position, height)
    if last is None:
        raise FlightError(f"subtitles hold no telemetry: {path}")
    _add(last, last.end_ns, attitude, position, height)
    track = RecordedTrack(
        attitude=attitude_of_angles(attitude, enu_from_gimbal_camera),
        home=height.series(),
        position=position.positions(),
        tilt_std_deg=GIMBAL_TILT_STD_DEG,
        warnings=_warnings(data),
    )
    if track.attitude is None and track.position is None:
        raise FlightError(f"subtitles have neither position nor gimbal angles: {path}")
    return track


def end_ns(track: RecordedTrack) -> int:
    """Last time of a track from subtitles or a table."""
    series = (track.attitude, track.position, track.home, *track.heights)
    return max(int(one.time_ns[-1]) for one in series if one is not None)


def _add(
    block: SubtitleBlock, time_ns: int, attitude: Samples, position: Samples, height: Samples
) -> None:
    attitude.add(time_ns, block.yaw_deg, block.pitch_deg, block.roll_deg)
    position.add(time_ns, block.lat_deg, block.lon_deg, block.alt_m)
    height.add(time_ns, block.height_m)


def blocks(data: bytes) -> Iterator[SubtitleBlock]:
    """The blocks of an SRT file in order; those without a line of times are left out, and so is the
    last one of a file that ends within it: its last number may be cut."""
    text = _decoded(data)
    latitude_first = _latitude_first(text)
    parts = re.split(r"\n\s*\n", text.replace("\r\n", "\n"))
    if not text.endswith(("\n", *_ENDS)):
        parts.pop()
    for part in parts:
        times = _TIMES.search(part)
        if times:
            start, end = _ns(times.groups()[:4]), _ns(times.groups()[4:])
            yield _block(start, end, _TAG.sub(" ", part[times.end() :]), latitude_first)


def _decoded(data: bytes) -> str:
    if data.startswith((b"\xff\xfe", b"\xfe\xff")):
        return data.decode("utf-16", errors="replace")
    return data.decode("utf-8-sig", errors="replace")


def _ns(parts: tuple[str, ...]) -> int:
    hours, minutes, seconds = (int(part) for part in parts[:3])
    return ((hours * 60 + minutes) * 60 + seconds) * 10**9 + int(parts[3].ljust(3, "0")) * 10**6


def _latitude_first(text: str) -> bool | None:
    """Whether the file writes GPS(latitude, longitude, ..), as the Matrice 300 does; None where its
    marks contradict each other, or there are none.

    Most models write the longitude first, then the number of satellites, and HOME(..); the Matrice
    300 writes an altitude with its unit in their place, and BAROMETER with a unit.
    """
    found = _GPS.findall(text)
    beyond = [any(abs(float(each[i])) > 90 for each in found) for i in (0, 1)]
    if any(beyond):
        return None if all(beyond) else beyond[1]
    barometer = _BAROMETER.search(text)
    unit = barometer is not None and bool(barometer[2])
    latitude = any(each[3] for each in found) or unit
    longitude = any(each[2].isdecimal() and not each[3] for each in found)
    longitude = longitude or _HOME.search(text) is not None
    return None if latitude == longitude else latitude


def _warnings(data: bytes) -> tuple[str, ...]:
    text = _decoded(data)
    if _GPS.search(text) is None or _latitude_first(text) is not None:
        return ()
    return (
        "subtitles do not show whether GPS(..) begins with the latitude or the longitude: "
        "positions are left out",
    )


def _block(start_ns: int, end: int, text: str, latitude_first: bool | None) -> SubtitleBlock:
    fields = {name: float(value) for name, value in _FIELD.findall(text)}
    lat, lon = fields.get("latitude", math.nan), fields.get("longitude", math.nan)
    lon = fields.get("longtitude", lon)  # misspelt by some models
    if latitude_first is not None and (gps := _GPS.search(text)):
        lat, lon = float(gps[1]), float(gps[2])
        if not latitude_first:
            lat, lon = lon, lat
    height = fields.get("rel_alt", _first(_BAROMETER, text))
    if math.isnan(height):
        height = _first(_HEIGHT, text)
    pitch, roll, yaw = (fields.get(f"gb_{name}", math.nan) for name in ("pitch", "roll", "yaw"))
    if gimbal := _GIMBAL.search(text):
        pitch, roll, yaw = (float(gimbal[i]) for i in (1, 2, 3))
    altitude = fields.get("abs_alt", fields.get("altitude", math.nan))
    if not (abs(lat) <= 90 and abs(lon) <= 360):
        lat = lon = math.nan
    height, altitude = measured(height), measured(altitude)
    return SubtitleBlock(start_ns, end, lat, lon, altitude, height, yaw, pitch, roll)


def _first(pattern: re.Pattern[str], text: str) -> float:
    found = pattern.search(text)
    return float(found[1]) if found else math.nan
