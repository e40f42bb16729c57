"""The track of a ROS recording: attitude, velocity, position and height over time."""

import math
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

from orthonav.sources.attitude import Angles, enu_from_ros_camera, rotations_of_wxyz
from orthonav.sources.ros_topics import Topics
from orthonav.sources.track import Samples, Series, Track, attitude_series

Reader = Any


def read_track(reader: Reader, topics: Topics, mount_deg: Angles) -> Track:
    """The track of the topics found; what no topic tells is not in it.

    The attitude is that of the first topic that tells any (raw IMUs do not).
    """
    attitude: Series | None = None
    for connection in topics.attitudes:
        attitude = _attitude(reader, topics, connection, mount_deg)
        if attitude is not None:
            break
    height = _collected(reader, topics, "height", 1, _height)
    velocity = _collected(reader, topics, "velocity", 2, _velocity)
    position = _collected(reader, topics, "position", 3, _position)
    heights = None if height is None else height.series()
    return Track(
        attitude=attitude,
        heights=() if heights is None else (heights,),
        position=None if position is None else position.positions(),
        velocity=None if velocity is None else velocity.series(),
        origin_ns=0 if attitude is None else int(attitude.time_ns[0]),
    )


def stamp_ns(message: Any, recorded_ns: int) -> int:
    """When a message was stamped, or, where it was not, recorded."""
    stamp = getattr(getattr(message, "header", None), "stamp", None)
    stamped = 0 if stamp is None else int(stamp.sec) * 10**9 + int(stamp.nanosec)
    return stamped or recorded_ns


def _messages(reader: Reader, topics: Topics, connection: Any) -> Iterator[tuple[int, Any]]:
    """Time of the stamp, else of recording, and message; what is broken is left out."""
    for one, recorded_ns, raw in reader.messages(connections=topics.of(connection)):
        try:
            message = reader.deserialize(raw, one.msgtype)
        except Exception:  # one broken message is one sample less
            continue
        yield stamp_ns(message, recorded_ns), message


def _attitude(reader: Reader, topics: Topics, connection: Any, mount_deg: Angles) -> Series | None:
    samples = Samples(4)
    for time_ns, message in _messages(reader, topics, connection):
        if connection.msgtype == "sensor_msgs/msg/Imu":
            if message.orientation_covariance[0] == -1:  # so a message says "none"
                continue
            turn = message.orientation
        elif connection.msgtype == "nav_msgs/msg/Odometry":
            turn = message.pose.pose.orientation
        else:
            turn = message.pose.orientation
        samples.add(time_ns, turn.w, turn.x, turn.y, turn.z)
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


def _height(message: Any) -> tuple[float, ...] | None:
    if hasattr(message, "range"):
        sound = message.min_range <= message.range <= message.max_range
        return (message.range,) if sound else None
    if hasattr(message, "bottom_clearance"):
        clearance = message.bottom_clearance
        return (clearance if math.isfinite(clearance) else message.relative,)
    return (message.data,)


def _velocity(message: Any) -> tuple[float, ...] | None:
    """East and north of an odometry, whose twist is in the axes of the body."""
    turn, twist = message.pose.pose.orientation, message.twist.twist.linear
    for enu_from_flu in rotations_of_wxyz(np.array([[turn.w, turn.x, turn.y, turn.z]]))[0]:
        east, north, _ = enu_from_flu @ [twist.x, twist.y, twist.z]
        return float(east), float(north)
    return None


def _position(message: Any) -> tuple[float, ...] | None:
    if message.status.status < 0:  # no fix
        return None
    return message.latitude, message.longitude, message.altitude
