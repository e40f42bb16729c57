"""Logs of autopilots: PX4 (ULog), ArduPilot (DataFlash), and of ground stations (.tlog).

Fields: https://docs.px4.io/main/en/dev_log/ulog_file_format.html,
https://ardupilot.org/copter/docs/logmessages.html, https://mavlink.io/en/messages/common.html.
"""

import contextlib
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from orthonav.core.errors import FlightError
from orthonav.core.flight.telemetry_track import (
    RecordedTrack,
    Samples,
    TimeSeries,
    altitude_series,
    attitude_of_angles,
    attitude_series,
    position_series,
    series_of,
)
from orthonav.core.geo.attitude import (
    Angles,
    enu_from_body_camera,
    ned_from_angles,
    rotations_of_wxyz,
)
from orthonav.core.geo.camera import attitude_of
from orthonav.core.guard import needed, reading

DATAFLASH_MAGIC = b"\xa3\x95\x80"  # starts with a record of formats
MAVLINK_MAGICS = (0xFE, 0xFD)
_DOWNWARD = 25  # MAV_SENSOR_ROTATION_PITCH_270
_RANGE_IS_GOOD = 4
_DAY_US, _LATEST_US = 86_400 * 10**6, 2**52
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
DAMAGED = "log is damaged: views from the damage on may lack telemetry"
Columns = dict[str, NDArray[Any]]


class _Collected:
    """Samples collected from a log."""

    def __init__(self, mount_deg: Angles) -> None:
        self.mount = mount_deg
        self.attitude, self.velocity, self.position = Samples(3), Samples(2), Samples(3)
        self.distance, self.above_home, self.hae = Samples(1), Samples(1), Samples(1)

    def track(self, what: str, path: Path) -> RecordedTrack:
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
            origin_ns=int(attitude.time_ns[0]),
        )


def read_dataflash(path: Path, mount_deg: Angles) -> RecordedTrack:
    """The track of a DataFlash log; times are UTC where it has a GPS fix, else since boot.

    Raises `FlightError` where it is another file, damaged, or without attitude.
    """
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
            _close(log)
    return collected.track("ArduPilot log", path)


def _close(log: Any) -> None:
    for name in ("data_map", "filehandle"):
        with contextlib.suppress(AttributeError, BufferError):
            getattr(log, name).close()


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

    Only the first vehicle that sends its attitude is read. Raises `FlightError` where there is no
    attitude, or no MAVLink message.
    """
    dialect = needed("pymavlink.dialects.v20.ardupilotmega", "telemetry logs")
    collected = _Collected(mount_deg)
    vehicle = None
    with reading("telemetry log", path), path.open("rb") as stream:
        for time_ns, message in _messages(stream, dialect):
            if vehicle is None and message.get_type().startswith("ATTITUDE"):
                vehicle = message.get_srcSystem()
            if message.get_srcSystem() == vehicle:
                _from_tlog(collected, message, time_ns)
    return collected.track("telemetry log", path)


def _messages(stream: BinaryIO, dialect: Any) -> Iterator[tuple[int, Any]]:
    """Time in ns and message of the wanted kinds; damaged bytes are skipped."""
    decoder = dialect.MAVLink(None)
    before_us = None
    wanted = {number for number, kind in dialect.mavlink_map.items() if kind.msgname in _WANTED}
    while len(head := stream.read(11)) == 11:
        start = stream.tell() - 11
        if (size := _frame_size(head[8:])) is None:
            stream.seek(start + 1)
            continue
        frame = head[8:] + stream.read(size - 3)
        if len(frame) < size:
            return
        number = frame[5] if frame[0] == 0xFE else int.from_bytes(frame[7:10], "little")
        if number not in wanted:
            continue
        try:
            message = decoder.decode(bytearray(frame))
        except dialect.MAVError:
            stream.seek(start + 1)
            continue
        stamp_us = int.from_bytes(head[:8], "big")
        near = before_us is None or abs(stamp_us - before_us) < _DAY_US
        if stamp_us < _LATEST_US and near:  # otherwise the time stamp is damaged
            before_us = stamp_us
            yield stamp_us * 1000, message


def _frame_size(head: bytes) -> int | None:
    """Length of a MAVLink frame by its first three bytes, None where it is not one."""
    if head[0] == 0xFE:
        return head[1] + 8
    if head[0] == 0xFD and head[2] in (0, 1):
        return head[1] + (25 if head[2] & 1 else 12)
    return None


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
    """The track of a ULog; times are UTC where the log has a GPS fix, else since boot.

    Raises `FlightError` where it is not a ULog, damaged, or without attitude.
    """
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
        position, local = _position(gps, topics, shift_us), topics.get("vehicle_local_position", {})
        return RecordedTrack(
            attitude=attitude,
            heights=_heights(local, topics.get("distance_sensor", {}), shift_us),
            home=_home(local, topics, shift_us),
            amsl=altitude_series(position),
            hae=_hae(gps, shift_us),
            position=position,
            velocity=None
            if "vx" not in local
            else _series(
                local, [local["vy"], local["vx"]], shift_us, _flag(local, "v_xy_valid", 1) != 0
            ),
            origin_ns=int(attitude.time_ns[0]),
            warnings=(DAMAGED,) if log.file_corruption else (),
        )


def _utc_shift_us(gps: Columns) -> int:
    """Microseconds from the log's clock to UTC; 0 where the GPS never had the time."""
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
