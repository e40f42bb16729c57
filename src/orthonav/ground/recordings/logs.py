"""Telemetry logs of all kinds, detected by content."""

import math
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from orthonav.core.errors import FlightError
from orthonav.core.files import require_file
from orthonav.core.flight.folder import number_of, time_ns_of
from orthonav.core.flight.telemetry_track import (
    RecordedTrack,
    Samples,
    attitude_of_angles,
    measured,
)
from orthonav.core.geo.attitude import (
    GIMBAL_TILT_STD_DEG,
    Angles,
    enu_from_body_camera,
    enu_from_gimbal_camera,
    ned_from_angles,
)
from orthonav.core.geo.swapped import swapped_hint
from orthonav.core.tables import TableError, TableRows
from orthonav.ground.recordings.autopilot_logs import (
    DATAFLASH_MAGIC,
    MAVLINK_MAGICS,
    ULOG_MAGIC,
    read_dataflash,
    read_tlog,
    read_ulog,
)

_SRT = re.compile(rb"\d+:\d\d:\d\d[,.]\d{1,3}\s*-->")
MAX_BYTES = 500_000_000
_NUMBER = r"([-+]?\d+(?:\.\d+)?)"
_TIMES = re.compile(r"(\d+):(\d\d):(\d\d)[,.](\d{1,3})\s*-->\s*(\d+):(\d\d):(\d\d)[,.](\d{1,3})")
_ENDS = (">", "]", ")")  # what blocks end with that are whole, besides the end of a line
_TAG = re.compile(r"<[^<>]*>")
_FIELD = re.compile(rf"\b([a-z]+(?:_[a-z]+)*)\s*:\s*{_NUMBER}")
_GPS = re.compile(
    rf"\b(?:GPS|RTK)\s*\(\s*{_NUMBER}\s*,\s*{_NUMBER}\s*(?:,\s*{_NUMBER}\s*([Mm]?)\s*)?\)"
)
_BAROMETER = re.compile(rf"\b(?:BAROMETER|Hb)\s*:\s*{_NUMBER}(M?)")
_HOME = re.compile(r"\bHOME\s*\(")
_HEIGHT = re.compile(rf"\bH\s+{_NUMBER}m\b")
_GIMBAL = re.compile(rf"\bG\.PRY\s*\(\s*{_NUMBER}[^,]*,\s*{_NUMBER}[^,]*,\s*{_NUMBER}")
NEEDED = ("time_s", "pitch_deg", "roll_deg")
_COLUMNS = {
    "height": ("agl_m",),
    "home": ("home_m",),
    "amsl": ("amsl_m",),
    "hae": ("hae_m",),
    "velocity": ("vel_east_mps", "vel_north_mps"),
    "yaw_std": ("yaw_std_deg",),
    "agl_std": ("agl_std_m",),
    "tilt_std": ("tilt_std_deg",),
    "prior": ("prior_lat_deg", "prior_lon_deg", "prior_std_m"),
}
"""Columns of a table by the series of `RecordedTrack`."""
_HEIGHTS = ("height", "home", "amsl", "hae")
UNCLEAR_ORDER = (
    "subtitles do not show whether GPS(..) begins with the latitude or the longitude: positions "
    "are left out"
)


def log_kind(path: Path) -> str:
    """`ulog`, `dataflash`, `tlog`, `srt` or `table`, by content.

    Raises `MissingFileError`, or `FlightError` for any other file.
    """
    path = require_file(path, "telemetry log")
    with path.open("rb") as stream:
        head = stream.read(4096)
    if not head:
        raise FlightError(f"telemetry log is empty: {path}")
    if head.startswith(ULOG_MAGIC):
        return "ulog"
    if head.startswith(DATAFLASH_MAGIC):
        return "dataflash"
    if len(head) > 8 and head[0] == 0 and head[8] in MAVLINK_MAGICS:
        return "tlog"
    text = head.replace(b"\0", b"") if head[:2] in (b"\xff\xfe", b"\xfe\xff") else head
    if _SRT.search(text):
        return "srt"
    if b"time_s" in head.partition(b"\n")[0]:
        return "table"
    raise FlightError(
        "expected a PX4 log (.ulg), an ArduPilot log (.bin), a telemetry log (.tlog), subtitles "
        f"(.srt) or a table with a time_s column (.csv): {path}"
    )


def read_log(path: Path, mount_deg: Angles) -> RecordedTrack:
    """The track of a log. `mount_deg` applies where the log holds the attitude of the body."""
    kind = log_kind(path)
    if kind in ("srt", "table") and path.stat().st_size > MAX_BYTES:
        raise FlightError(f"file is larger than {MAX_BYTES // 10**6} MB: {path}")
    if kind == "ulog":
        return read_ulog(path, mount_deg)
    if kind == "dataflash":
        return read_dataflash(path, mount_deg)
    if kind == "tlog":
        return read_tlog(path, mount_deg)
    return read_srt(path) if kind == "srt" else read_table(path)


@dataclass(frozen=True)
class SubtitleBlock:
    """One subtitle; values it does not hold are NaN."""

    start_ns: int  # begin in the video
    end_ns: int  # end in the video
    lat_deg: float = math.nan
    lon_deg: float = math.nan
    alt_m: float = math.nan  # altitude in the drone's own reference
    height_m: float = math.nan  # height above take-off
    yaw_deg: float = math.nan  # yaw of the gimbal, as are pitch and roll
    pitch_deg: float = math.nan
    roll_deg: float = math.nan


def read_srt(path: Path) -> RecordedTrack:
    """The track of an SRT file; times are those of its video.

    Raises `FlightError` where it has no telemetry.
    """
    data = path.read_bytes()
    text = _decoded(data)
    doubtful = _GPS.search(text) is not None and _latitude_first(text) is None
    timed = [(block.start_ns, block) for block in blocks(data)]
    if not timed:
        raise FlightError(f"subtitles hold no telemetry: {path}")
    timed.append((timed[-1][1].end_ns, timed[-1][1]))
    attitude, position, height = Samples(3), Samples(3), Samples(1)
    for time_ns, block in timed:
        attitude.add(time_ns, block.yaw_deg, block.pitch_deg, block.roll_deg)
        position.add(time_ns, block.lat_deg, block.lon_deg, block.alt_m)
        height.add(time_ns, block.height_m)
    track = RecordedTrack(
        attitude=attitude_of_angles(attitude, enu_from_gimbal_camera),
        home=height.series(),
        position=position.positions(),
        tilt_std_deg=GIMBAL_TILT_STD_DEG,
        warnings=(UNCLEAR_ORDER,) * doubtful,
    )
    if track.attitude is None and track.position is None:
        raise FlightError(f"subtitles have neither position nor gimbal angles: {path}")
    return track


def end_ns(track: RecordedTrack) -> int:
    """Last time of a track from subtitles or a table."""
    series = (track.attitude, track.position, track.home, *track.heights)
    return max(int(one.time_ns[-1]) for one in series if one is not None)


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


def read_table(path: Path) -> RecordedTrack:
    """The track of a CSV with `time_s` and the columns of a flight's telemetry, and, where it was
    recorded, `lat_deg,lon_deg`. Angles are those of the camera, in the convention of orthonav.

    Raises `FlightError`, with the line, for an invalid table.
    """
    attitude, position = Samples(3), Samples(3)
    others = {name: Samples(len(columns)) for name, columns in _COLUMNS.items()}
    try:
        with path.open(encoding="utf-8-sig", newline="") as stream:
            rows = TableRows(stream)
            missing = [name for name in NEEDED if name not in rows.columns]
            if missing:
                raise FlightError(f"columns are missing: {', '.join(missing)}: {path}")
            held = [name for name in _COLUMNS if set(_COLUMNS[name]) & set(rows.columns)]
            for row in rows:
                time_ns = time_ns_of(row["time_s"])
                if time_ns is None:
                    raise FlightError(f"line {rows.line}: time_s is not a time: {path}")
                angles = (number_of(row.get(f"{name}_deg")) for name in ("yaw", "pitch", "roll"))
                attitude.add(time_ns, *angles)
                position.add(time_ns, *_position(row, rows.line, path), math.nan)
                for name in held:
                    values = [number_of(row.get(column)) for column in _COLUMNS[name]]
                    if name in _HEIGHTS:
                        values = [measured(value) for value in values]
                    others[name].add(time_ns, *values)
    except TableError as error:
        raise FlightError(f"{error}: {path}") from error
    found: dict[str, Any] = {name: each.series() for name, each in others.items()}
    height = found.pop("height")
    track = RecordedTrack(
        attitude_of_angles(attitude, lambda angles: enu_from_body_camera(ned_from_angles(angles))),
        heights=() if height is None else (height,),
        position=position.positions(),
        **found,
    )
    if track.attitude is None:
        raise FlightError(f"telemetry has no line with pitch and roll: {path}")
    return track


def _position(row: Mapping[str, str | None], line: int, path: Path) -> tuple[float, float]:
    lat_deg, lon_deg = number_of(row.get("lat_deg")), number_of(row.get("lon_deg"))
    prior = number_of(row.get("prior_lat_deg")), number_of(row.get("prior_lon_deg"))
    if hint := swapped_hint(lat_deg, lon_deg) or swapped_hint(*prior):
        raise FlightError(f"line {line}: position is out of range{hint}: {path}")
    return lat_deg, lon_deg
