"""The track of a ROS recording: attitude, velocity, position and height over time."""

import math
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

from orthonav.core.flight.ros_topics import Topics, is_above_home
from orthonav.core.flight.telemetry_track import (
    RecordedTrack,
    Samples,
    TimeSeries,
    altitude_series,
    attitude_series,
)
from orthonav.core.geo.attitude import (
    AUTOPILOT_TILT_STD_DEG,
    Angles,
    enu_from_ros_camera,
    rotations_of_wxyz,
)

Reader = Any
LEAST_TILT_STD_DEG, MOST_TILT_STD_DEG = 1.5, 10.0
"""An orientation of an IMU counts as stated between them; MAVROS states 57 deg by default."""


def read_track(reader: Reader, topics: Topics, mount_deg: Angles) -> RecordedTrack:
    """The track of the selected topics.

    The attitude is that of the first topic that has one (raw IMUs do not).
    """
    attitude: TimeSeries | None = None
    for connection in topics.attitudes:
        attitude = _attitude(reader, topics, connection, mount_deg)
        if attitude is not None:
            break
    heights = _heights(reader, topics)
    velocity = _collected(reader, topics, "velocity", 2, _velocity)
    position = _collected(reader, topics, "position", 3, _position)
    places = None if position is None else position.positions()
    return RecordedTrack(
        attitude=attitude,
        heights=() if heights["agl"] is None else (heights["agl"],),
        home=heights["home"],
        amsl=heights["amsl"],
        hae=altitude_series(places),  # sensor_msgs/NavSatFix
        position=places,
        velocity=None if velocity is None else velocity.series(),
        origin_ns=0 if attitude is None else int(attitude.time_ns[0]),
    )


def stamp_ns(message: Any, recorded_ns: int) -> int:
    """Time stamp of a message, or the time of its recording where it has none."""
    stamp = getattr(getattr(message, "header", None), "stamp", None)
    stamped = 0 if stamp is None else int(stamp.sec) * 10**9 + int(stamp.nanosec)
    return stamped or recorded_ns


def attitude_of_message(message: Any) -> tuple[float, float, float, float] | None:
    """The orientation w, x, y, z in a `sensor_msgs/Imu`, `nav_msgs/Odometry` or
    `geometry_msgs/PoseStamped`: from forward-left-up to east-north-up (REP 103).

    None for an `Imu` that says it has none.
    """
    if hasattr(message, "orientation_covariance"):
        if message.orientation_covariance[0] == -1:
            return None
        turn = message.orientation
    elif hasattr(message.pose, "pose"):
        turn = message.pose.pose.orientation
    else:
        turn = message.pose.orientation
    return float(turn.w), float(turn.x), float(turn.y), float(turn.z)


def tilt_std_of_message(message: Any) -> float:
    """Standard deviation of pitch and roll (deg) by the covariance of a `sensor_msgs/Imu`.

    That of an autopilot where it is not stated, or is a placeholder. A smaller one than
    `LEAST_TILT_STD_DEG` leaves out the errors of the mount and of accelerations.
    """
    covariance = getattr(message, "orientation_covariance", (0.0,) * 9)
    variance = max(float(covariance[0]), float(covariance[4]))
    std_deg = math.degrees(math.sqrt(variance)) if variance > 0 else math.inf
    if not std_deg <= MOST_TILT_STD_DEG:
        return AUTOPILOT_TILT_STD_DEG
    return max(std_deg, LEAST_TILT_STD_DEG)


def height_of_message(message: Any) -> float | None:
    """Metres above ground of a `sensor_msgs/Range`, `mavros_msgs/Altitude` or a plain number.

    None for a range outside the limits of its sensor.
    """
    if hasattr(message, "range"):
        sound = message.min_range <= message.range <= message.max_range
        return float(message.range) if sound else None
    if hasattr(message, "bottom_clearance"):
        clearance = message.bottom_clearance
        return float(clearance if math.isfinite(clearance) else message.relative)
    return float(message.data)


def _messages(reader: Reader, topics: Topics, connection: Any) -> Iterator[tuple[int, Any]]:
    """Time and message; damaged messages are skipped."""
    for one, recorded_ns, raw in reader.messages(connections=topics.of(connection)):
        try:
            message = reader.deserialize(raw, one.msgtype)
        except Exception:  # a damaged message is one sample less
            continue
        yield stamp_ns(message, recorded_ns), message


def _attitude(
    reader: Reader, topics: Topics, connection: Any, mount_deg: Angles
) -> TimeSeries | None:
    samples = Samples(4)
    for time_ns, message in _messages(reader, topics, connection):
        turn = attitude_of_message(message)
        if turn is not None:
            samples.add(time_ns, *turn)
    times, wxyz = samples.arrays()
    enu_from_flu, sound = rotations_of_wxyz(wxyz)
    return attitude_series(times[sound], enu_from_ros_camera(enu_from_flu, mount_deg))


def _collected(
    reader: Reader,
    topics: Topics,
    role: str,
    width: int,
    values_of: Callable[[Any], tuple[float, ...] | None],
) -> Samples | None:
    if role not in topics.roles:
        return None
    samples = Samples(width)
    for time_ns, message in _messages(reader, topics, topics.roles[role]):
        values = values_of(message)
        if values is not None:
            samples.add(time_ns, *values)
    return samples


def _heights(reader: Reader, topics: Topics) -> dict[str, TimeSeries | None]:
    """Heights above ground (agl), take-off (home) and sea level (amsl)."""
    found = {name: Samples(1) for name in ("agl", "home", "amsl")}
    if "height" in topics.roles:
        connection = topics.roles["height"]
        for time_ns, message in _messages(reader, topics, connection):
            if hasattr(message, "bottom_clearance"):
                found["agl"].add(time_ns, message.bottom_clearance)
                found["home"].add(time_ns, message.relative)
                found["amsl"].add(time_ns, message.amsl)
            elif (height := height_of_message(message)) is not None:
                found["home" if is_above_home(connection.topic) else "agl"].add(time_ns, height)
    return {name: samples.series() for name, samples in found.items()}


def _velocity(message: Any) -> tuple[float, ...] | None:
    """East and north velocity of an odometry, whose twist is in body axes."""
    turn, twist = message.pose.pose.orientation, message.twist.twist.linear
    for enu_from_flu in rotations_of_wxyz(np.array([[turn.w, turn.x, turn.y, turn.z]]))[0]:
        east, north, _ = enu_from_flu @ [twist.x, twist.y, twist.z]
        return float(east), float(north)
    return None


def _position(message: Any) -> tuple[float, ...] | None:
    if message.status.status < 0:  # no fix
        return None
    return message.latitude, message.longitude, message.altitude
