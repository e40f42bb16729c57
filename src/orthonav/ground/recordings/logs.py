"""Telemetry logs of all kinds, detected by content."""

import contextlib
import math
import re
from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from orthonav.core.errors import FlightError
from orthonav.core.files import require_file
from orthonav.core.flight.folder import number_of, time_ns_of
from orthonav.core.flight.telemetry_track import (
    RecordedTrack,
    Samples,
    TimeSeries,
    altitude_series,
    attitude_of_angles,
    attitude_series,
    measured,
    position_series,
    series_of,
)
from orthonav.core.geo.attitude import (
    Angles,
    enu_from_body_camera,
    enu_from_gimbal_camera,
    ned_from_angles,
    rotations_of_wxyz,
)
from orthonav.core.geo.camera import attitude_of
from orthonav.core.geo.swapped import swapped_hint
from orthonav.core.guard import needed, reading
from orthonav.core.tables import TableError, TableRows
from orthonav.core.tilt import (
    ARDUPILOT,
    ASSUMED,
    AUTOPILOT,
    GIMBAL,
    UNRECORDED,
    UNSTATED,
    TiltSource,
)

DATAFLASH_MAGIC = b"\xa3\x95\x80"  # starts with a record of formats
MAVLINK_MAGICS = (0xFE, 0xFD)
_DOWNWARD = 25  # MAV_SENSOR_ROTATION_PITCH_270
_RANGE_IS_GOOD = 4
_WANTED = {
    "ATTITUDE",
    "ATTITUDE_QUATERNION",
    "GLOBAL_POSITION_INT",
    "GPS_RAW_INT",
    "DISTANCE_SENSOR",
    "RANGEFINDER",
}
ULOG_MAGIC = b"ULog\x01\x12\x35"
_TOPICS = [
    "vehicle_attitude",
    "vehicle_local_position",
    "vehicle_global_position",
    "vehicle_gps_position",
    "sensor_gps",
    "distance_sensor",
    "home_position",
]
Columns = dict[str, NDArray[Any]]


class _Collected:
    def __init__(self, mount_deg: Angles) -> None:
        self.mount = mount_deg
        self.attitude, self.velocity, self.position = Samples(3), Samples(2), Samples(3)
        self.distance, self.above_home, self.hae = Samples(1), Samples(1), Samples(1)

    def track(self, what: str, path: Path, tilt: TiltSource = AUTOPILOT) -> RecordedTrack:
        """The track of all samples; raises `FlightError` without attitude."""
        attitude = attitude_of_angles(
            self.attitude, lambda angles: enu_from_body_camera(ned_from_angles(angles), self.mount)
        )
        if attitude is None:
            raise FlightError(f"{what} has no attitude: {path}")
        distance, position = self.distance.series(), self.position.positions()
        return RecordedTrack(
            attitude=attitude,
            heights=() if distance is None else (distance,),
            home=self.above_home.series(),
            amsl=altitude_series(position),
            hae=self.hae.series(),
            position=position,
            velocity=self.velocity.series(),
            tilt=tilt,
            origin_ns=int(attitude.time_ns[0]),
        )


def read_dataflash(path: Path, mount_deg: Angles) -> RecordedTrack:
    """The track of a DataFlash log; times are UTC where it has a GPS fix, else since boot."""
    reader = needed("pymavlink.DFReader", "ArduPilot logs")
    collected = _Collected(mount_deg)
    with reading("ArduPilot log", path, silent=True):
        log = reader.DFReader_binary.__new__(reader.DFReader_binary)
        try:
            log.__init__(str(path))  # separately, so that its file is closed where this fails
            base_ns = round(getattr(log.clock, "timebase", 0.0) * 1e6) * 1000
            while (message := log.recv_match(type=["ATT", "GPS", "POS", "RFND"])) is not None:
                if hasattr(message, "TimeUS"):
                    _from_dataflash(collected, message, base_ns + int(message.TimeUS) * 1000)
        finally:
            with contextlib.suppress(AttributeError, BufferError):
                log.filehandle.close()
                log.data_map.close()
    return collected.track("ArduPilot log", path, ARDUPILOT)


def _from_dataflash(collected: _Collected, message: Any, time_ns: int) -> None:
    kind = message.get_type()
    if kind == "ATT":
        collected.attitude.add(time_ns, message.Yaw, message.Pitch, message.Roll)
    elif kind == "GPS" and message.Status >= 3 and getattr(message, "I", 0) == 0:
        collected.position.add(time_ns, message.Lat, message.Lng, message.Alt)
        course = math.radians(message.GCrs)
        east, north = math.sin(course) * message.Spd, math.cos(course) * message.Spd
        collected.velocity.add(time_ns, east, north)
    elif kind == "POS":
        collected.above_home.add(time_ns, message.RelHomeAlt)
    elif kind == "RFND" and message.Dist > 0:
        good = getattr(message, "Stat", _RANGE_IS_GOOD) == _RANGE_IS_GOOD
        if good and getattr(message, "Orient", _DOWNWARD) == _DOWNWARD:
            collected.distance.add(time_ns, message.Dist)


def read_tlog(path: Path, mount_deg: Angles) -> RecordedTrack:
    """The track of a telemetry log; times are UTC of the ground station at reception.

    Only the first vehicle that sends its attitude is read.
    """
    mavutil = needed("pymavlink.mavutil", "telemetry logs")
    collected = _Collected(mount_deg)
    vehicle = None
    with reading("telemetry log", path, silent=True):
        log = mavutil.mavlogfile(str(path), robust_parsing=True)
        try:
            while (message := log.recv_match(type=_WANTED)) is not None:
                if vehicle is None and message.get_type().startswith("ATTITUDE"):
                    vehicle = message.get_srcSystem()
                if message.get_srcSystem() == vehicle:
                    _from_tlog(collected, message, round(message._timestamp * 1e6) * 1000)
        finally:
            log.f.close()
    return collected.track("telemetry log", path)


def _from_tlog(collected: _Collected, message: Any, time_ns: int) -> None:
    kind = message.get_type()
    if kind == "ATTITUDE":
        angles = map(math.degrees, (message.yaw, message.pitch, message.roll))
        collected.attitude.add(time_ns, *angles)
    elif kind == "ATTITUDE_QUATERNION":
        wxyz = np.array([[message.q1, message.q2, message.q3, message.q4]])
        for turn in rotations_of_wxyz(wxyz)[0]:
            # A camera that looks straight down has the angles of the body.
            collected.attitude.add(time_ns, *attitude_of(enu_from_body_camera(turn)))
    elif kind == "GLOBAL_POSITION_INT":
        collected.above_home.add(time_ns, message.relative_alt * 1e-3)
        collected.velocity.add(time_ns, message.vy * 1e-2, message.vx * 1e-2)
    elif kind == "GPS_RAW_INT" and message.fix_type >= 3:
        place = message.lat * 1e-7, message.lon * 1e-7, message.alt * 1e-3
        collected.position.add(time_ns, *place)
        if message.alt_ellipsoid:  # 0 without this extension
            collected.hae.add(time_ns, message.alt_ellipsoid * 1e-3)
    elif kind == "DISTANCE_SENSOR" and message.orientation == _DOWNWARD:
        if message.min_distance < message.current_distance < message.max_distance:
            collected.distance.add(time_ns, message.current_distance * 1e-2)
    elif kind == "RANGEFINDER" and message.distance > 0:
        collected.distance.add(time_ns, message.distance)


def read_ulog(path: Path, mount_deg: Angles) -> RecordedTrack:
    """The track of a ULog; times are UTC where the log has a GPS fix, else since boot."""
    core = needed("pyulog.core", "PX4 logs")
    with reading("PX4 log", path, silent=True), path.open("rb") as stream:
        log = core.ULog(stream, _TOPICS)
        topics: dict[str, Columns] = {one.name: one.data for one in reversed(log.data_list)}
        gps = topics.get("vehicle_gps_position") or topics.get("sensor_gps") or {}
        shift_us = _utc_shift_us(gps)
        attitude = _attitude(topics.get("vehicle_attitude", {}), shift_us, mount_deg)
        if attitude is None:
            damaged = ", and is damaged" if log.file_corruption else ""
            raise FlightError(f"PX4 log has no attitude (vehicle_attitude){damaged}: {path}")
        warnings: tuple[str, ...] = ()
        if log.file_corruption:
            read_s = float(attitude.time_ns[-1] - attitude.time_ns[0]) / 1e9
            warnings = (
                f"log is damaged: views from {read_s:.1f} s on, or in gaps, may lack telemetry",
            )
        position, local = _position(gps, topics, shift_us), topics.get("vehicle_local_position", {})
        return RecordedTrack(
            attitude=attitude,
            heights=_heights(local, topics.get("distance_sensor", {}), shift_us),
            home=_home(local, topics, shift_us),
            amsl=altitude_series(position),
            hae=_hae(gps, shift_us),
            position=position,
            tilt=AUTOPILOT if gps else replace(AUTOPILOT, aided_deg=AUTOPILOT.unaided_deg),
            velocity=None
            if "vx" not in local
            else _series(
                local, [local["vy"], local["vx"]], shift_us, _flag(local, "v_xy_valid", 1) != 0
            ),
            origin_ns=int(attitude.time_ns[0]),
            warnings=warnings,
        )


def _utc_shift_us(gps: Columns) -> int:
    if "time_utc_usec" not in gps:
        return 0
    utc, own = gps["time_utc_usec"].astype(np.int64), gps["timestamp"].astype(np.int64)
    sound = utc > 0
    return int(np.median((utc - own)[sound])) if sound.any() else 0


def _time_ns(columns: Columns, shift_us: int) -> NDArray[np.int64]:
    return np.asarray((columns["timestamp"].astype(np.int64) + shift_us) * 1000)


def _attitude(columns: Columns, shift_us: int, mount_deg: Angles) -> TimeSeries | None:
    if "q[3]" not in columns:
        return None
    wxyz = np.stack([columns[f"q[{i}]"] for i in range(4)], axis=1).astype(np.float64)
    ned_from_frd, sound = rotations_of_wxyz(wxyz)
    rotations = enu_from_body_camera(ned_from_frd, mount_deg)
    return attitude_series(_time_ns(columns, shift_us)[sound], rotations)


def _series(
    columns: Columns, values: list[NDArray[Any]], shift_us: int, sound: NDArray[Any] | None = None
) -> TimeSeries | None:
    table, times = np.stack(values, axis=1).astype(np.float64), _time_ns(columns, shift_us)
    return series_of(times, table) if sound is None else series_of(times[sound], table[sound])


def _flag(columns: Columns, name: str, otherwise: float) -> NDArray[Any]:
    """A column, or one value everywhere where it was not logged."""
    return np.asarray(columns.get(name, np.full(len(columns["timestamp"]), otherwise)))


def _heights(local: Columns, sensor: Columns, shift_us: int) -> tuple[TimeSeries, ...]:
    """Heights above ground by distance sensor: the estimator's, then the raw one."""
    found = []
    if "dist_bottom" in local:
        # Without a sensor the estimator guesses, and calls its guess valid.
        sound = _flag(local, "dist_bottom_sensor_bitfield", len(sensor)) != 0
        sound &= _flag(local, "dist_bottom_valid", 1) != 0
        found.append(_series(local, [local["dist_bottom"]], shift_us, sound))
    if "current_distance" in sensor:
        distance = sensor["current_distance"]
        sound = _flag(sensor, "orientation", _DOWNWARD) == _DOWNWARD
        sound &= distance > _flag(sensor, "min_distance", 0)
        sound &= distance < _flag(sensor, "max_distance", np.inf)
        found.append(_series(sensor, [distance], shift_us, sound))
    return tuple(series for series in found if series is not None)


def _home(local: Columns, topics: dict[str, Columns], shift_us: int) -> TimeSeries | None:
    """Height above home, or above the origin of the local frame, which is where PX4 started."""
    place, home = topics.get("vehicle_global_position", {}), topics.get("home_position", {})
    if "alt" in place and "alt" in home:
        above = place["alt"].astype(np.float64) - float(home["alt"][-1])
        return _series(place, [above], shift_us)
    if "z" not in local:
        return None
    return _series(local, [-local["z"]], shift_us, _flag(local, "z_valid", 1) != 0)


def _hae(gps: Columns, shift_us: int) -> TimeSeries | None:
    for name, metres in (("altitude_ellipsoid_m", 1), ("alt_ellipsoid", 1e-3)):  # since PX4 1.14
        if name in gps:
            return _series(gps, [gps[name] * metres], shift_us, _flag(gps, "fix_type", 3) >= 3)
    return None


def _position(gps: Columns, topics: dict[str, Columns], shift_us: int) -> TimeSeries | None:
    """Position of the GPS receiver, or of the estimator where the log has no receiver."""
    if "latitude_deg" in gps:  # since PX4 1.14
        parts = gps["latitude_deg"], gps["longitude_deg"], gps["altitude_msl_m"]
    elif "lat" in gps:
        parts = gps["lat"] * 1e-7, gps["lon"] * 1e-7, gps["alt"] * 1e-3
    else:
        gps = topics.get("vehicle_global_position", {})
        if "lat" not in gps:
            return None
        parts = gps["lat"], gps["lon"], gps["alt"]
    place, sound = np.stack(parts, axis=1).astype(np.float64), _flag(gps, "fix_type", 3) >= 3
    return position_series(_time_ns(gps, shift_us)[sound], place[sound])


_SRT = re.compile(rb"\d+:\d\d:\d\d[,.]\d{1,3}\s*-->")
MAX_BYTES = 500_000_000
_NUMBER = r"([-+]?\d{1,20}(?:\.\d{1,20})?)"  # limited, as the time of a search is
_TIMES = re.compile(
    r"(?<!\d)(\d{1,9}):(\d\d):(\d\d)[,.](\d{1,3})\s*-->\s*(\d{1,9}):(\d\d):(\d\d)[,.](\d{1,3})"
)
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
    "mount_std": ("mount_std_deg",),
    "prior": ("prior_lat_deg", "prior_lon_deg", "prior_std_m"),
}
"""Columns of a table by the series of `RecordedTrack`."""
_HEIGHTS = ("height", "home", "amsl", "hae")
UNCLEAR_ORDER = (
    "subtitles do not show whether GPS(..) begins with the latitude or the longitude: positions "
    "are left out"
)


def log_kind(path: Path) -> str:
    """`ulog`, `dataflash`, `tlog`, `srt` or `table`, by content."""
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


def read_log(
    path: Path, mount_deg: Angles, named: Mapping[str, str] | None = None
) -> RecordedTrack:
    """The track of a log. `mount_deg` applies where the log holds the attitude of the body; `named`:
    the source of a role, such as {"position": "GPS[1]"}, where the log has several.

    Raises `FlightError` where it is damaged, of another kind, or without attitude.
    """
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


def read_srt(path: Path) -> RecordedTrack:
    """The track of an SRT file; times are those of its video."""
    data = path.read_bytes()
    text = _decoded(data)
    doubtful = _GPS.search(text) is not None and _latitude_first(text) is None
    found = list(blocks(data))
    if not found:
        raise FlightError(f"subtitles hold no telemetry: {path}")
    attitude, position, height = Samples(3), Samples(3), Samples(1)
    unrecorded = not any(
        (each.yaw_deg, each.pitch_deg, each.roll_deg) != (0, 0, 0) for each in found
    )
    for block in [*found, found[-1]._replace(start_ns=found[-1].end_ns)]:
        gimbal = block.yaw_deg, block.pitch_deg, block.roll_deg
        attitude.add(block.start_ns, *((math.nan, -90.0, 0.0) if unrecorded else gimbal))
        position.add(block.start_ns, block.lat_deg, block.lon_deg, block.alt_m)
        height.add(block.start_ns, block.height_m)
    track = RecordedTrack(
        attitude=attitude_of_angles(attitude, enu_from_gimbal_camera),
        home=height.series(),
        position=position.positions(),
        tilt=ASSUMED if unrecorded else GIMBAL,
        warnings=(UNCLEAR_ORDER,) * doubtful + (f"{UNRECORDED}: {path}",) * unrecorded,
    )
    if track.attitude is None and track.position is None:
        raise FlightError(f"subtitles have neither position nor gimbal angles: {path}")
    return track


def end_ns(track: RecordedTrack) -> int:
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
                position.add(time_ns, *_table_position(row, rows.line, path), math.nan)
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
        tilt=UNSTATED,
        **found,
    )
    if track.attitude is None:
        raise FlightError(f"telemetry has no line with pitch and roll: {path}")
    return track


def _table_position(row: Mapping[str, str | None], line: int, path: Path) -> tuple[float, float]:
    lat_deg, lon_deg = number_of(row.get("lat_deg")), number_of(row.get("lon_deg"))
    prior = number_of(row.get("prior_lat_deg")), number_of(row.get("prior_lon_deg"))
    if hint := swapped_hint(lat_deg, lon_deg) or swapped_hint(*prior):
        raise FlightError(f"line {line}: position is out of range{hint}: {path}")
    return lat_deg, lon_deg
