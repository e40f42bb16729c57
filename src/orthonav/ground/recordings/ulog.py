"""PX4 flight logs (ULog): https://docs.px4.io/main/en/dev_log/ulog_file_format.html."""

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from orthonav.core.errors import FlightError
from orthonav.core.flight.telemetry_track import (
    RecordedTrack,
    TimeSeries,
    altitude_series,
    attitude_series,
    position_series,
    series_of,
)
from orthonav.core.geo.attitude import Angles, enu_from_body_camera, rotations_of_wxyz
from orthonav.core.guard import needed, reading

MAGIC = b"ULog\x01\x12\x35"
_TOPICS = [
    "vehicle_attitude",
    "vehicle_local_position",
    "vehicle_global_position",
    "vehicle_gps_position",
    "sensor_gps",
    "distance_sensor",
    "home_position",
]
_DOWNWARD = 25  # distance_sensor.orientation, as MAV_SENSOR_ROTATION_PITCH_270
Columns = dict[str, NDArray[Any]]


def read_ulog(path: Path, mount_deg: Angles) -> RecordedTrack:
    """The track of a ULog; times are UTC where the log has a GPS fix, else since boot.

    Raises `FlightError` where it is not a ULog, damaged, or without attitude.
    """
    core = needed("pyulog.core", "PX4 logs")
    with reading("PX4 log", path, silent=True), path.open("rb") as stream:
        log = _watched(core.ULog)(stream, _TOPICS)
        topics: dict[str, Columns] = {one.name: one.data for one in reversed(log.data_list)}
        gps = topics.get("vehicle_gps_position") or topics.get("sensor_gps") or {}
        shift_us = _utc_shift_us(gps)
        attitude = _attitude(topics.get("vehicle_attitude", {}), shift_us, mount_deg)
        if attitude is None:
            damaged = "" if log.damaged_us is None else ", and is damaged"
            raise FlightError(f"PX4 log has no attitude (vehicle_attitude){damaged}: {path}")
        position = _position(gps, topics, shift_us)
        return RecordedTrack(
            attitude=attitude,
            heights=_heights(topics, shift_us),
            home=_home(topics, shift_us),
            amsl=altitude_series(position),
            hae=_hae(gps, shift_us),
            position=position,
            velocity=_velocity(topics.get("vehicle_local_position", {}), shift_us),
            origin_ns=int(attitude.time_ns[0]),
            warnings=_damage(log.damaged_us, int(attitude.time_ns[0]), shift_us),
        )


def _watched(reader: type[Any]) -> type[Any]:
    """The reader of pyulog, which notes the time of the message at which it finds corruption."""

    class WatchedULog(reader):  # type: ignore[misc]
        damaged_us: int | None = None

        @property
        def _file_corrupt(self) -> bool:
            return self.damaged_us is not None

        @_file_corrupt.setter
        def _file_corrupt(self, found: bool) -> None:
            if found and self.damaged_us is None:
                self.damaged_us = getattr(self, "_last_timestamp", 0)

    return WatchedULog


def _damage(damaged_us: int | None, first_ns: int, shift_us: int) -> tuple[str, ...]:
    """A warning about the time from which a log is damaged, after its first attitude."""
    if damaged_us is None:
        return ()
    after_s = max(0.0, ((damaged_us + shift_us) * 1000 - first_ns) / 1e9)
    return (
        f"log is damaged from {after_s:.1f} s after its first attitude: views from then on may "
        "lack telemetry",
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


def _heights(topics: dict[str, Columns], shift_us: int) -> tuple[TimeSeries, ...]:
    """Heights above ground by distance sensor: the estimator's, then the raw one."""
    local = topics.get("vehicle_local_position", {})
    sensor = topics.get("distance_sensor", {})
    found = []
    if "dist_bottom" in local:
        valid = local.get("dist_bottom_valid", np.ones(len(local["dist_bottom"]))) != 0
        # Without a sensor the estimator guesses, and calls its guess valid.
        sensors = local.get("dist_bottom_sensor_bitfield", np.full(len(valid), len(sensor)))
        valid &= sensors != 0
        found.append(_height(local, local["dist_bottom"], valid, shift_us))
    if "current_distance" in sensor:
        distance = sensor["current_distance"]
        valid = sensor.get("orientation", np.full(len(distance), _DOWNWARD)) == _DOWNWARD
        valid &= distance > sensor.get("min_distance", np.zeros(len(distance)))
        valid &= distance < sensor.get("max_distance", np.full(len(distance), np.inf))
        found.append(_height(sensor, distance, valid, shift_us))
    return tuple(series for series in found if series is not None)


def _home(topics: dict[str, Columns], shift_us: int) -> TimeSeries | None:
    """Height above home, or above the origin of the local frame, which is where PX4 started."""
    local = topics.get("vehicle_local_position", {})
    place, home = topics.get("vehicle_global_position", {}), topics.get("home_position", {})
    if "alt" in place and "alt" in home:
        above = place["alt"].astype(np.float64) - float(home["alt"][-1])
        return _height(place, above, np.ones(len(above), dtype=bool), shift_us)
    if "z" not in local:
        return None
    valid = local.get("z_valid", np.ones(len(local["z"]))) != 0
    return _height(local, -local["z"], valid, shift_us)


def _hae(gps: Columns, shift_us: int) -> TimeSeries | None:
    """Height of the GPS receiver above the ellipsoid."""
    if "altitude_ellipsoid_m" in gps:  # since PX4 1.14
        height = gps["altitude_ellipsoid_m"].astype(np.float64)
    elif "alt_ellipsoid" in gps:
        height = gps["alt_ellipsoid"] * 1e-3
    else:
        return None
    return _height(gps, height, gps.get("fix_type", np.full(len(height), 3)) >= 3, shift_us)


def _height(
    columns: Columns, height_m: NDArray[Any], valid: NDArray[np.bool_], shift_us: int
) -> TimeSeries | None:
    times = _time_ns(columns, shift_us)
    return series_of(times[valid], height_m[valid].astype(np.float64)[:, None])


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
    place = np.stack(parts, axis=1).astype(np.float64)
    sound = gps.get("fix_type", np.full(len(place), 3)) >= 3
    return position_series(_time_ns(gps, shift_us)[sound], place[sound])


def _velocity(local: Columns, shift_us: int) -> TimeSeries | None:
    if "vx" not in local:
        return None
    east_north = np.stack([local["vy"], local["vx"]], axis=1).astype(np.float64)
    sound = local.get("v_xy_valid", np.ones(len(east_north))) != 0
    return series_of(_time_ns(local, shift_us)[sound], east_north[sound])
