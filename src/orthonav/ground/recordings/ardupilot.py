"""ArduPilot's logs: DataFlash (.bin), and the ground station's telemetry log (.tlog).

Fields: https://ardupilot.org/copter/docs/logmessages.html and
https://mavlink.io/en/messages/common.html.
"""

import contextlib
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from orthonav.core.errors import FlightError
from orthonav.core.flight.telemetry_track import (
    RecordedTrack,
    Samples,
    altitude_series,
    attitude_of_angles,
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
