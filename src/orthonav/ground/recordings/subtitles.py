"""Subtitles (SRT) of DJI, in the dialects of its models."""

import math
import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from orthonav.core.errors import FlightError
from orthonav.core.geo.attitude import enu_from_gimbal_camera
from orthonav.core.tilt import ASSUMED, GIMBAL, UNRECORDED
from orthonav.ground.recordings.telemetry_track import (
    RecordedTrack,
    Samples,
    attitude_of_angles,
    measured,
)

_NUMBER = r"([-+]?\d{1,20}(?:\.\d{1,20})?)"  # limited, as the time of a search is
_TIMES = re.compile(
    r"(?<!\d)(\d{1,9}):(\d\d):(\d\d)[,.](\d{1,3})\s*-->\s*(\d{1,9}):(\d\d):(\d\d)[,.](\d{1,3})"
)
_FIELD = re.compile(rf"\b([a-z]+(?:_[a-z]+)*)\s*:\s*{_NUMBER}")
_GPS = re.compile(
    rf"\b(?:GPS|RTK)\s*\(\s*{_NUMBER}\s*,\s*{_NUMBER}\s*(?:,\s*{_NUMBER}\s*([Mm]?)\s*)?\)"
)
_BAROMETER = re.compile(rf"\b(?:BAROMETER|Hb)\s*:\s*{_NUMBER}(M?)")
_DIGITAL_ZOOM = re.compile(
    rf"\bd(?:igital)?[_ ]?zoom[a-z_]*\s{{0,9}}(?::\s{{0,9}})?{_NUMBER}", re.IGNORECASE
)
SAME_ZOOM = 0.02  # zooms that differ by less, as a fraction, are one


class SubtitleBlock(NamedTuple):
    """One subtitle; values it does not hold are NaN."""

    start_ns: int  # begin in the video
    end_ns: int  # end in the video
    lat_deg: float
    lon_deg: float
    alt_m: float  # altitude in the drone's own reference
    height_m: float  # height above take-off
    yaw_deg: float  # yaw of the gimbal, as are pitch and roll
    pitch_deg: float
    roll_deg: float
    zoom: tuple[float, float]  # focal length, in any unit, and digital zoom


def read_srt(path: Path) -> RecordedTrack:
    """The track of an SRT file; times are those of its video."""
    data = path.read_bytes()
    text = data.decode("utf-8-sig", errors="replace")
    doubtful = _GPS.search(text) is not None and _latitude_first(text) is None
    found = list(blocks(data))
    if not found:
        raise FlightError(f"subtitles hold no telemetry: {path}")
    attitude, position, height, zoomed = Samples(3), Samples(3), Samples(1), Samples(1)
    unrecorded = not any(
        (each.yaw_deg, each.pitch_deg, each.roll_deg) != (0, 0, 0) for each in found
    )
    odd = _zoomed(found)
    ending = found[-1]._replace(start_ns=found[-1].end_ns)
    for block, other in zip([*found, ending], [*odd, odd[-1]], strict=True):
        gimbal = block.yaw_deg, block.pitch_deg, block.roll_deg
        attitude.add(block.start_ns, *((math.nan, -90.0, 0.0) if unrecorded else gimbal))
        position.add(block.start_ns, block.lat_deg, block.lon_deg, block.alt_m)
        height.add(block.start_ns, block.height_m)
        zoomed.add(block.start_ns, other)
    warnings = [f"{UNRECORDED}: {path}"] * unrecorded
    if doubtful:
        warnings.insert(
            0,
            "subtitles do not show whether GPS(..) begins with the latitude or the longitude: "
            "positions are left out",
        )
    if any(odd):
        warnings.append(
            f"{sum(odd)} of {len(odd)} subtitles state another zoom than most, the first at "
            f"{found[odd.index(True)].start_ns / 1e9:.1f} s; views there are left out: {path}"
        )
    most = (block.zoom[1] for block, other in zip(found, odd, strict=True) if not other)
    if (digital := next(most, 1.0)) > 1 + SAME_ZOOM:
        warnings.append(
            f"most of the subtitles state a digital zoom of {digital:g}: --camera or --fov-deg "
            f"must be that of this zoom: {path}"
        )
    track = RecordedTrack(
        attitude=attitude_of_angles(attitude, enu_from_gimbal_camera),
        home=height.series(),
        position=position.positions(),
        zoomed=zoomed.series(),
        tilt=ASSUMED if unrecorded else GIMBAL,
        warnings=tuple(warnings),
    )
    if track.attitude is None and track.position is None:
        raise FlightError(f"subtitles have neither position nor gimbal angles: {path}")
    return track


def _zoomed(found: Sequence[SubtitleBlock]) -> list[bool]:
    """Whether each states another focal length or digital zoom than most of them."""
    odd = np.zeros(len(found), bool)
    for zooms in np.array([each.zoom for each in found]).T:
        values, counts = np.unique(zooms[zooms > 0], return_counts=True)
        if len(values):
            odd |= np.abs(zooms / values[counts.argmax()] - 1) > SAME_ZOOM
    return list(map(bool, odd))


def blocks(data: bytes) -> Iterator[SubtitleBlock]:
    """The blocks of an SRT file in order; those without a line of times are left out, and so is the
    last one of a file that ends within it: its last number may be cut."""
    text = data.decode("utf-8-sig", errors="replace")
    latitude_first = _latitude_first(text)
    parts = re.split(r"\n\s*\n", text.replace("\r\n", "\n"))
    if not text.endswith(("\n", ">", "]", ")")):
        parts.pop()
    for part in parts:
        times = _TIMES.search(part)
        if times:
            start, end = _ns(times.groups()[:4]), _ns(times.groups()[4:])
            yield _block(start, end, re.sub(r"<[^<>]*>", " ", part[times.end() :]), latitude_first)


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
    longitude = longitude or re.search(r"\bHOME\s*\(", text) is not None
    return None if latitude == longitude else latitude


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
        height = _first(rf"\bH\s+{_NUMBER}m\b", text)
    pitch, roll, yaw = (fields.get(f"gb_{name}", math.nan) for name in ("pitch", "roll", "yaw"))
    turns = rf"\bG\.PRY\s*\(\s*{_NUMBER}[^,]*,\s*{_NUMBER}[^,]*,\s*{_NUMBER}"
    if gimbal := re.search(turns, text):
        pitch, roll, yaw = (float(gimbal[i]) for i in (1, 2, 3))
    altitude = fields.get("abs_alt", fields.get("altitude", math.nan))
    if not (abs(lat) <= 90 and abs(lon) <= 360):
        lat = lon = math.nan
    height, altitude = measured(height), measured(altitude)
    digital = _first(_DIGITAL_ZOOM, text)
    digital = digital / 10_000 if digital >= 10_000 else digital  # some write 10000 for 1
    zoom = fields.get("focal_len") or math.nan, digital if digital > 0 else 1.0
    return SubtitleBlock(start_ns, end, lat, lon, altitude, height, yaw, pitch, roll, zoom)


def _first(pattern: str | re.Pattern[str], text: str) -> float:
    found = re.search(pattern, text)
    return float(found[1]) if found else math.nan
