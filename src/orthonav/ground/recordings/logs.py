"""Telemetry logs of all kinds, detected by content."""

import contextlib
import io
import math
import mmap
import re
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from orthonav.core.errors import FlightError
from orthonav.core.files import require_file
from orthonav.core.flight.folder import csv_rows, number_of, time_ns_of
from orthonav.core.geo.attitude import (
    Angles,
    enu_from_body_camera,
    ned_from_angles,
    rotations_of_wxyz,
)
from orthonav.core.geo.camera import attitude_of
from orthonav.core.geo.swapped import swapped_hint
from orthonav.core.guard import needed, reading
from orthonav.core.tables import MAX_ROWS
from orthonav.core.tilt import ARDUPILOT, AUTOPILOT, UNSTATED, TiltSource
from orthonav.ground.recordings.subtitles import read_srt
from orthonav.ground.recordings.telemetry_track import (
    RecordedTrack,
    Samples,
    Sources,
    TimeSeries,
    altitude_series,
    attitude_of_angles,
    attitude_series,
    measured,
    position_series,
    series_of,
)
from orthonav.onboard.messages import mavlink

DATAFLASH_MAGIC = b"\xa3\x95\x80"  # starts with a record of formats
MAVLINK_MAGICS = (0xFE, 0xFD)
ULOG_MAGIC = b"ULog\x01\x12\x35"
Columns = dict[str, NDArray[Any]]


def _add(held: dict[str, Samples], name: str, sound: bool, time_ns: int, *values: float) -> None:
    samples = held.setdefault(name, Samples(len(values)))
    if sound:
        samples.add(time_ns, *values)


class _Collected:
    def __init__(self, mount_deg: Angles) -> None:
        self.mount, self.autopilot = mount_deg, mavlink.NO_AUTOPILOT
        self.attitude, self.velocity, self.above_home = Samples(3), Samples(2), Samples(1)
        self.fixes: dict[str, Samples] = {}
        """By receiver: latitude, longitude, altitude, height above the ellipsoid, velocity."""
        self.distances: dict[str, Samples] = {}
        self.has_limits = False  # a DISTANCE_SENSOR that looks down, with its limits

    def add_attitude(self, time_ns: int, yaw: float, pitch: float, roll: float) -> None:
        if yaw or pitch or roll:  # all are 0 where none is known
            self.attitude.add(time_ns, yaw, pitch, roll)

    def track(self, what: str, sources: Sources, tilt: TiltSource = AUTOPILOT) -> RecordedTrack:
        """The track of all samples; raises `FlightError` without attitude."""
        attitude = attitude_of_angles(
            self.attitude, lambda angles: enu_from_body_camera(ned_from_angles(angles), self.mount)
        )
        if attitude is None:
            raise FlightError(f"{what} has no attitude other than 0: {sources.path}")
        # The first receiver first, whichever sent first: GPS_RAW_INT before GPS2_RAW.
        ordered = sorted(self.fixes.items(), key=lambda item: item[0].replace("_", " "))
        fixes = {name: each.arrays() for name, each in ordered}
        places = {name: position_series(time, fix[:, :3]) for name, (time, fix) in fixes.items()}
        position = sources.best("position", places)
        times, fix = fixes.get(sources.used["position"], Samples(6).arrays())
        distances = {name: each.series() for name, each in self.distances.items()}
        return RecordedTrack(
            attitude=attitude,
            heights=sources.all("height", distances, {}),
            home=self.above_home.series(),
            amsl=altitude_series(position),
            hae=series_of(times, fix[:, 3:4]),
            position=position,
            velocity=self.velocity.series() or series_of(times, fix[:, 4:]),
            tilt=tilt,
            origin_ns=int(attitude.time_ns[0]),
            choices=sources.choices,
        )


def read_dataflash(path: Path, mount_deg: Angles, sources: Sources) -> RecordedTrack:
    """The track of a DataFlash log; times are UTC where it has a GPS fix, else since boot."""
    reader = needed("pymavlink.DFReader", "ArduPilot logs")
    collected = _Collected(mount_deg)
    with reading("ArduPilot log", path, silent=True):
        log = reader.DFReader_binary.__new__(reader.DFReader_binary)
        try:
            log.__init__(str(path))  # separately, so that its file is closed where this fails
            base_ns = round(getattr(log.clock, "timebase", 0.0) * 1e6) * 1000
            kinds = ["ATT", "GPS", "GPS2", "POS", "RFND"]
            while (message := log.recv_match(type=kinds)) is not None:
                with contextlib.suppress(AttributeError):  # of a damaged or unknown layout
                    _from_dataflash(collected, message, base_ns + int(message.TimeUS) * 1000)
        finally:
            with contextlib.suppress(AttributeError, BufferError):
                log.filehandle.close()
                log.data_map.close()
    sources.first("attitude", ["ATT"], lambda name: (name, ""))
    return collected.track("ArduPilot log", sources, ARDUPILOT)


def _from_dataflash(collected: _Collected, message: Any, time_ns: int) -> None:
    kind = message.get_type()
    if kind == "ATT":
        collected.add_attitude(time_ns, message.Yaw, message.Pitch, message.Roll)
    elif kind == "POS":
        collected.above_home.add(time_ns, message.RelHomeAlt)
    elif kind == "RFND":
        good = getattr(message, "Stat", 4) == 4  # of the states the one of a valid range
        for number in ("", "1", "2"):  # numbered up to ArduPilot 3.6
            if (distance_m := getattr(message, f"Dist{number}", None)) is not None:
                instance = int(number) - 1 if number else getattr(message, "Instance", 0)
                down = getattr(message, f"Orient{number}", mavlink.DOWNWARD) == mavlink.DOWNWARD
                sound = good and down and distance_m > 0
                _add(collected.distances, f"RFND[{instance}]", sound, time_ns, distance_m)
    else:
        receiver = f"GPS[{message.I}]" if hasattr(message, "I") else kind
        course = math.radians(message.GCrs)
        velocity = math.sin(course) * message.Spd, math.cos(course) * message.Spd
        place = message.Lat, message.Lng, message.Alt, math.nan
        _add(collected.fixes, receiver, message.Status >= 3, time_ns, *place, *velocity)


def read_tlog(path: Path, mount_deg: Angles, sources: Sources) -> RecordedTrack:
    """The track of a telemetry log; times are UTC of the ground station at reception.

    Its first autopilot is read: gimbals and other vehicles send attitudes too.
    """
    mavutil = needed("pymavlink.mavutil", "telemetry logs")
    wanted = {
        *("HEARTBEAT", "ATTITUDE", "ATTITUDE_QUATERNION", "GLOBAL_POSITION_INT", "GPS_RAW_INT"),
        *("GPS2_RAW", "DISTANCE_SENSOR", "RANGEFINDER"),
    }
    parts: dict[str, _Collected] = {}
    with reading("telemetry log", path, silent=True):
        log = mavutil.mavlogfile(str(path), robust_parsing=True)
        try:
            while (message := log.recv_match(type=wanted)) is not None:
                name = f"ATTITUDE[{message.get_srcSystem()}:{message.get_srcComponent()}]"
                part = parts.setdefault(name, _Collected(mount_deg))
                _from_tlog(part, message, round(message._timestamp * 1e6) * 1000)
        finally:
            log.f.close()
    senders = [name for name, part in parts.items() if part.attitude.series()]
    trusted = [name for name in senders if parts[name].autopilot != mavlink.NO_AUTOPILOT]
    trusted = trusted or [name for name in senders if name.endswith((":0]", ":1]"))]
    usable = [*trusted, sources.named.get("attitude")]
    used = sources.first("attitude", senders, lambda name: (name if name in usable else None, ""))
    if used is None:
        why = "; ".join(("telemetry log has no attitude", *sources.choices))
        raise FlightError(f"{why}: {path}")
    own = [name for name in trusted if name.partition(":")[0] == used.partition(":")[0]]
    body = parts[used if used in own or not own else own[0]]
    body.attitude = parts[used].attitude
    return body.track("telemetry log", sources)


def _from_tlog(collected: _Collected, message: Any, time_ns: int) -> None:
    kind = message.get_type()
    if kind == "HEARTBEAT" and mavlink.is_of_autopilot(message):
        collected.autopilot = message.autopilot
    elif kind == "ATTITUDE":
        angles = map(math.degrees, (message.yaw, message.pitch, message.roll))
        collected.add_attitude(time_ns, *angles)
    elif kind == "ATTITUDE_QUATERNION":
        wxyz = np.array([[message.q1, message.q2, message.q3, message.q4]])
        for turn in rotations_of_wxyz(wxyz)[0]:
            # A camera that looks straight down has the angles of the body.
            collected.add_attitude(time_ns, *attitude_of(enu_from_body_camera(turn)))
    elif kind == "GLOBAL_POSITION_INT":
        kind_of = mavlink.KINDS.get(collected.autopilot)
        if kind_of is mavlink.Autopilot.ARDUPILOT or not mavlink.repeats_height(message):
            collected.above_home.add(time_ns, message.relative_alt * 1e-3)
        collected.velocity.add(time_ns, message.vy * 1e-2, message.vx * 1e-2)
    elif kind in ("GPS_RAW_INT", "GPS2_RAW"):
        hae_m = message.alt_ellipsoid * 1e-3 or math.nan  # 0 without this extension
        place = message.lat * 1e-7, message.lon * 1e-7, message.alt * 1e-3, hae_m
        _add(collected.fixes, kind, message.fix_type >= 3, time_ns, *place, math.nan, math.nan)
    elif kind in ("DISTANCE_SENSOR", "RANGEFINDER"):
        _distance_of_tlog(collected, kind, message, time_ns)


def _distance_of_tlog(collected: _Collected, kind: str, message: Any, time_ns: int) -> None:
    if kind == "DISTANCE_SENSOR":
        name, distance_m = f"{kind}[{message.id}]", message.current_distance * 1e-2
        _add(collected.distances, name, mavlink.is_height(message), time_ns, distance_m)
        if message.orientation == mavlink.DOWNWARD:  # RANGEFINDER is the same without its limits
            collected.has_limits = True
            collected.distances.pop("RANGEFINDER", None)
    elif not collected.has_limits:
        _add(collected.distances, kind, message.distance > 0, time_ns, message.distance)


def read_ulog(path: Path, mount_deg: Angles, sources: Sources) -> RecordedTrack:
    """The track of a ULog; times are UTC where the log has a GPS fix, else since boot."""
    core = needed("pyulog.core", "PX4 logs")
    names = [
        *("vehicle_attitude", "vehicle_local_position", "vehicle_global_position"),
        *("home_position", "vehicle_gps_position", "sensor_gps", "distance_sensor"),
    ]
    with reading("PX4 log", path, silent=True), path.open("rb") as whole:
        with mmap.mmap(whole.fileno(), 0, access=mmap.ACCESS_READ) as data:
            end = data.find(ULOG_MAGIC, 1)  # of a log behind it, on a card that was not erased
            stream: Any = whole if end < 0 else io.BytesIO(data[:end])
        log = core.ULog(stream, names)
        topics: dict[str, dict[str, Columns]] = {name: {} for name in names}
        for one in log.data_list:
            topics[one.name][f"{one.name}[{one.multi_id}]"] = one.data
        topics = {name: dict(sorted(each.items())) for name, each in topics.items()}
        gps = topics["vehicle_gps_position"] | topics["sensor_gps"]
        shift_us = next(filter(None, map(_utc_shift_us, gps.values())), 0)
        for one in log.data_list:
            one.data["time_ns"] = (one.data["timestamp"].astype(np.int64) + shift_us) * 1000

        def series(name: str, of: Callable[[Columns], Any]) -> dict[str, TimeSeries | None]:
            return {key: of(columns) for key, columns in topics[name].items()}

        attitudes = series("vehicle_attitude", partial(_attitude, mount_deg))
        attitude = sources.best("attitude", attitudes)
        if attitude is None:
            damaged = ", and is damaged" if log.file_corruption else ""
            raise FlightError(f"PX4 log has no attitude (vehicle_attitude){damaged}: {path}")
        warnings: tuple[str, ...] = ()
        if log.file_corruption or end > 0:
            read_s = float(attitude.time_ns[-1] - attitude.time_ns[0]) / 1e9
            why = "damaged" if end < 0 else f"followed by another one from byte {end} on"
            warnings = (
                f"log is {why}: views from {read_s:.1f} s on, or in gaps, may lack telemetry",
            )
        positions = series("vehicle_gps_position", _position)
        if "position" in sources.named or not any(positions.values()):  # else made of the others
            positions |= series("sensor_gps", _position)
        if not gps and (positions := series("vehicle_global_position", _position)):
            warnings += ("positions are an estimate: the log has no receiver",)
        position = sources.best("position", positions)
        distances = sources.all("height", series("distance_sensor", _distance), {})
        single = {name: next(iter(each.values()), {}) for name, each in topics.items()}
        local = single["vehicle_local_position"]
        bottom = _bottom(local, len(topics["distance_sensor"]))
        heights = distances if "height" in sources.named else (bottom, *distances)
        return RecordedTrack(
            attitude=attitude,
            heights=tuple(filter(None, heights)),
            home=_home(local, single),
            amsl=altitude_series(position),
            hae=_hae(gps.get(sources.used["position"], {})),
            position=position,
            tilt=AUTOPILOT if gps else replace(AUTOPILOT, aided_deg=AUTOPILOT.unaided_deg),
            velocity=_series(local, ("vy", "vx"), _flag(local, "v_xy_valid", 1) != 0),
            origin_ns=int(attitude.time_ns[0]),
            warnings=warnings,
            choices=sources.choices,
        )


def _utc_shift_us(gps: Columns) -> int:
    if "time_utc_usec" not in gps:
        return 0
    utc, own = gps["time_utc_usec"].astype(np.int64), gps["timestamp"].astype(np.int64)
    sound = (utc > 0) & (_flag(gps, "fix_type", 3) >= 3)
    return int(np.median((utc - own)[sound])) if sound.any() else 0


def _attitude(mount_deg: Angles, columns: Columns) -> TimeSeries | None:
    if "q[3]" not in columns:
        return None
    wxyz = np.stack([columns[f"q[{i}]"] for i in range(4)], axis=1).astype(np.float64)
    wxyz[~wxyz[:, 1:].any(axis=1)] = math.nan  # 1 0 0 0 where none is known
    ned_from_frd, sound = rotations_of_wxyz(wxyz)
    rotations = enu_from_body_camera(ned_from_frd, mount_deg)
    return attitude_series(columns["time_ns"][sound], rotations)


def _series(
    columns: Columns, names: tuple[str, ...], sound: NDArray[Any], scale: float = 1.0
) -> TimeSeries | None:
    if names[0] not in columns:
        return None
    table = np.stack([columns[name] for name in names], axis=1).astype(np.float64) * scale
    return series_of(columns["time_ns"][sound], table[sound])


def _flag(columns: Columns, name: str, otherwise: float) -> NDArray[Any]:
    """A column, or one value everywhere where it was not logged."""
    return np.asarray(columns.get(name, np.full(len(columns.get("timestamp", ())), otherwise)))


def _bottom(local: Columns, sensors: int) -> TimeSeries | None:
    """Height above ground by the estimator, from distance sensors."""
    # Without a sensor the estimator guesses, and calls its guess valid.
    sound = _flag(local, "dist_bottom_sensor_bitfield", sensors) != 0
    sound &= _flag(local, "dist_bottom_valid", 1) != 0
    return _series(local, ("dist_bottom",), sound)


def _distance(sensor: Columns) -> TimeSeries | None:
    distance = _flag(sensor, "current_distance", math.nan)
    sound = _flag(sensor, "orientation", mavlink.DOWNWARD) == mavlink.DOWNWARD
    sound &= _flag(sensor, "signal_quality", -1) != 0
    sound &= distance > _flag(sensor, "min_distance", 0)
    sound &= distance < _flag(sensor, "max_distance", np.inf)
    return _series(sensor, ("current_distance",), sound)


def _home(local: Columns, single: dict[str, Columns]) -> TimeSeries | None:
    """Height above home, or above the origin of the local frame, which is where PX4 started."""
    place, home = single["vehicle_global_position"], single["home_position"]
    if "alt" in place and "alt" in home:
        above = place["alt"].astype(np.float64) - float(home["alt"][-1])
        return series_of(place["time_ns"], above[:, None])
    return _series(local, ("z",), _flag(local, "z_valid", 1) != 0, -1)


def _hae(gps: Columns) -> TimeSeries | None:
    for name, scale in (("altitude_ellipsoid_m", 1.0), ("alt_ellipsoid", 1e-3)):  # since 1.14
        if name in gps:
            known = (_flag(gps, "fix_type", 3) >= 3) & (gps[name] != 0)
            return _series(gps, (name,), known, scale)
    return None


def _position(columns: Columns) -> TimeSeries | None:
    """Positions of a receiver, or of the estimator."""
    if "latitude_deg" in columns:  # since PX4 1.14
        parts = columns["latitude_deg"], columns["longitude_deg"], columns["altitude_msl_m"]
    elif "fix_type" in columns:
        parts = columns["lat"] * 1e-7, columns["lon"] * 1e-7, columns["alt"] * 1e-3
    else:
        parts = columns["lat"], columns["lon"], columns["alt"]
    place, sound = np.stack(parts, axis=1).astype(np.float64), _flag(columns, "fix_type", 3) >= 3
    sound &= _flag(columns, "lat_lon_valid", 1) != 0
    return position_series(columns["time_ns"][sound], place[sound])


MAX_BYTES = 500_000_000
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
    if re.search(rb"\d+:\d\d:\d\d[,.]\d{1,3}\s*-->", head):
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
    """The track of a log. `mount_deg` applies where the log holds the attitude of the body.

    `named`: the source of a role, such as {"position": "GPS[1]"}, where the log has several.

    Raises `FlightError` where it is damaged, of another kind, or without attitude.
    """
    kind, sources = log_kind(path), Sources(named or {}, path)
    if unknown := sources.named.keys() - {"image", "camera_info", "attitude", "position", "height"}:
        raise FlightError(f"logs have no sources of {', '.join(unknown)}: {path}")
    if kind in ("srt", "table"):
        if sources.named.keys() & {"attitude", "position", "height"}:
            raise FlightError(f"a file of this kind has one source each; omit --topic: {path}")
        if path.stat().st_size > MAX_BYTES:
            raise FlightError(f"file is larger than {MAX_BYTES // 10**6} MB: {path}")
        return read_srt(path) if kind == "srt" else read_table(path)
    read = {"ulog": read_ulog, "dataflash": read_dataflash, "tlog": read_tlog}[kind]
    return read(path, mount_deg, sources)


def end_ns(track: RecordedTrack) -> int:
    series = (track.attitude, track.position, track.home, *track.heights)
    return max(int(one.time_ns[-1]) for one in series if one is not None)


def read_table(path: Path) -> RecordedTrack:
    """The track of a CSV with `time_s` and the columns of a flight's telemetry, and, where it was
    recorded, `lat_deg,lon_deg`. Angles are those of the camera, in the convention of orthonav.

    Raises `FlightError`, with the line, for an invalid table.
    """
    attitude, position = Samples(3), Samples(3)
    others = {name: Samples(len(columns)) for name, columns in _COLUMNS.items()}
    needed = "time_s", "pitch_deg", "roll_deg"
    for line, row in csv_rows(path, needed, MAX_ROWS, short=True):
        time_ns = time_ns_of(row["time_s"])
        if time_ns is None:
            raise FlightError(f"line {line}: time_s is not a time: {path}")
        angles = (number_of(row.get(f"{name}_deg")) for name in ("yaw", "pitch", "roll"))
        attitude.add(time_ns, *angles)
        position.add(time_ns, *_table_position(row, line, path), math.nan)
        for name, columns in _COLUMNS.items():
            if not row.keys().isdisjoint(columns):
                values = [number_of(row.get(column)) for column in columns]
                if name in ("height", "home", "amsl", "hae"):
                    values = [measured(value) for value in values]
                others[name].add(time_ns, *values)
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


def _table_position(row: Mapping[str, str], line: int, path: Path) -> tuple[float, float]:
    lat_deg, lon_deg = number_of(row.get("lat_deg")), number_of(row.get("lon_deg"))
    prior = number_of(row.get("prior_lat_deg")), number_of(row.get("prior_lon_deg"))
    if hint := swapped_hint(lat_deg, lon_deg) or swapped_hint(*prior):
        raise FlightError(f"line {line}: position is out of range{hint}: {path}")
    return lat_deg, lon_deg
