"""ROS 1 bags, ROS 2 bags (SQLite and MCAP) and plain MCAP files with ROS messages, without ROS.

Messages: https://docs.ros.org/en/rolling/p/sensor_msgs/, axes: REP 103 and REP 105.
"""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from orthonav.core.errors import CameraError, FlightError
from orthonav.core.flight.recording import fitted
from orthonav.core.flight.ros_messages import (
    attitude_of_message,
    camera_of_info,
    grey_of_message,
    height_of_message,
    stamp_ns,
)
from orthonav.core.flight.telemetry_track import (
    RecordedTrack,
    Samples,
    TimeSeries,
    altitude_series,
    attitude_series,
)
from orthonav.core.geo.attitude import Angles, enu_from_ros_camera, rotations_of_wxyz
from orthonav.core.geo.camera import Camera
from orthonav.ground.recordings.logs import read_log
from orthonav.ground.recordings.recording import (
    Recording,
    SourceOptions,
    SourceView,
    check_overlap,
    given_camera,
    known_at,
    warnings_of,
    with_mean_velocities,
)
from orthonav.ground.recordings.ros_files import opened

TYPES: dict[str, tuple[str, ...]] = {
    "image": ("sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"),
    "camera_info": ("sensor_msgs/msg/CameraInfo",),
    "attitude": (
        "sensor_msgs/msg/Imu",
        "nav_msgs/msg/Odometry",
        "geometry_msgs/msg/PoseStamped",
    ),
    "velocity": ("nav_msgs/msg/Odometry",),
    "position": ("sensor_msgs/msg/NavSatFix",),
    "height": (
        "sensor_msgs/msg/Range",
        "mavros_msgs/msg/Altitude",
        "std_msgs/msg/Float64",
        "std_msgs/msg/Float32",
    ),
}
_COMPRESSED = "sensor_msgs/msg/CompressedImage"
_ENDINGS = {b"\xff\xd8": ".jpg", b"\x89PNG": ".png", b"II*\0": ".tif", b"MM\0*": ".tif"}
_PLAIN_NUMBERS = ("std_msgs/msg/Float64", "std_msgs/msg/Float32")
_HOME_NAMES = ("rel_alt", "relative_altitude")
_HEIGHT_NAMES = (*_HOME_NAMES, "agl", "height_above_ground")


@dataclass(frozen=True, eq=False)
class Topics:
    """The connection of each role that was found, and all candidates for attitude."""

    roles: Mapping[str, Any]  # "image" first
    attitudes: tuple[Any, ...]
    connections: tuple[Any, ...]

    def of(self, connection: Any) -> list[Any]:
        """All connections on the topic of one (bags split or appended have several)."""
        return [one for one in self.connections if one.topic == connection.topic]

    def summary(self) -> str:
        """Role and topic of each connection, for people."""
        return ", ".join(f"{role} {one.topic}" for role, one in self.roles.items())


def find_topics(reader: Any, asked: Mapping[str, str], path: Path) -> Topics:
    """The topics of a recording by role.

    Raises `FlightError` where a requested topic is missing or has another type, and where there is
    no image topic, or more than one.
    """
    connections = tuple(reader.connections)
    counted = {one.topic: one for one in connections if one.msgcount}
    found: dict[str, list[Any]] = {}
    for role, types in TYPES.items():
        if role in asked:
            found[role] = [_asked(role, asked[role], counted, path)]
        else:
            of_type = [one for one in counted.values() if _fits(one, role)]
            found[role] = sorted(
                of_type, key=lambda one: (types.index(one.msgtype), -one.msgcount, one.topic)
            )
    images = found["image"]
    if len(images) != 1:
        found_names = ", ".join(sorted(one.topic for one in images))
        if not images:
            found_names = f"none among {', '.join(sorted(counted)) or 'no topic'}"
        raise FlightError(
            f"expected one topic of images, found {found_names}; give --topic: {path}"
        )
    infos = found["camera_info"]
    # In the namespace of the image (image_raw/compressed too).
    near = [one for one in infos if images[0].topic.startswith(one.topic.rpartition("/")[0] + "/")]
    found["camera_info"] = near or (infos if len(infos) == 1 else [])
    roles = {role: ones[0] for role, ones in found.items() if ones}
    return Topics(roles, tuple(found["attitude"]), connections)


def _asked(role: str, name: str, counted: Mapping[str, Any], path: Path) -> Any:
    if name not in counted:
        raise FlightError(
            f"no messages on {name}; available: {', '.join(sorted(counted)) or 'none'}: {path}"
        )
    if counted[name].msgtype not in TYPES[role]:
        raise FlightError(
            f"{name} carries {counted[name].msgtype}; {role} is one of "
            f"{', '.join(TYPES[role])}: {path}"
        )
    return counted[name]


def _fits(connection: Any, role: str) -> bool:
    named = connection.topic.rpartition("/")[2] in _HEIGHT_NAMES
    return connection.msgtype in TYPES[role] and (named or connection.msgtype not in _PLAIN_NUMBERS)


def open_ros(path: Path, options: SourceOptions) -> Recording:
    """The flight of a recording of ROS messages.

    Telemetry is read first, in one pass over its topics; images are read on request.
    Raises `FlightError`, `CameraError` or `MissingExtraError`.
    """
    with opened(path) as (reader, doubts):
        topics = find_topics(reader, options.topics, path)
        image = topics.roles["image"]
        size, first_ns, last_ns = _first_image(reader, topics, path)
        camera = given_camera(options, *size, str(path)) or fitted(
            _camera(reader, topics, path), *size, str(path)
        )
        if options.telemetry is not None:
            track = read_log(options.telemetry, options.mount_deg)
        else:
            track = read_track(reader, topics, options.mount_deg)
        warnings = [] if track.attitude else ["no topic has the attitude of the aircraft"]
        if track.span_ns() is not None or options.telemetry is not None:
            offset = options.time_offset_ns
            check_overlap(track, first_ns + offset, last_ns + offset, options.telemetry or path)
    return Recording(
        kind="ros",
        path=path,
        camera=camera,
        note=f"{path.name}: {topics.summary()}",
        expected=image.msgcount,
        stream=lambda: with_mean_velocities(_views(path, image.topic, track, options), track),
        warnings=(*doubts, *warnings, *warnings_of(track, options)),
        take_off_latlon_deg=track.take_off_latlon_deg,
    )


def _first_image(reader: Any, topics: Topics, path: Path) -> tuple[tuple[int, int], int, int]:
    """Width and height of the first image that can be read, and times of the first and the last."""
    reason, image = "there is none", topics.roles["image"]
    for _, time_ns, raw in reader.messages(connections=topics.of(image)):
        try:
            message = reader.deserialize(raw, image.msgtype)
            grey = grey_of_message(message, "the last")
        except Exception as error:  # reported when its turn comes
            reason = f"{type(error).__name__}: {error}"
            continue
        stamp = stamp_ns(message, time_ns)
        late_ns = max(0, reader.end_time - time_ns)
        return (grey.shape[1], grey.shape[0]), stamp, stamp + late_ns
    raise FlightError(f"no image of {image.topic} can be read ({reason}): {path}")


def _camera(reader: Any, topics: Topics, path: Path) -> Camera:
    info = topics.roles.get("camera_info")
    if info is None:
        raise CameraError(f"no camera_info for the images; give --camera FILE: {path}")
    for _, _, raw in reader.messages(connections=topics.of(info)):
        try:
            return camera_of_info(reader.deserialize(raw, info.msgtype))
        except CameraError as error:
            raise CameraError(f"{error}: {path}") from error
    raise CameraError(f"no message on {info.topic}; give --camera FILE: {path}")


def _views(
    path: Path, topic: str, track: RecordedTrack, options: SourceOptions
) -> Iterator[SourceView]:
    """The views; a damaged message raises when its image is decoded."""
    with opened(path) as (reader, _):
        connections = [one for one in reader.connections if one.topic == topic]
        messages = reader.messages(connections=connections)
        for number, (connection, time_ns, raw) in enumerate(messages):
            where, data, ending = f"image {number} of {path}", None, ".png"
            try:
                image = reader.deserialize(raw, connection.msgtype)
                time_ns = stamp_ns(image, time_ns)
                load = partial(grey_of_message, image, where)
                if connection.msgtype == _COMPRESSED:
                    encoded = np.asarray(image.data, dtype=np.uint8).tobytes()
                    starts = (name for start, name in _ENDINGS.items() if encoded.startswith(start))
                    ending, data = next(starts, ".bin"), partial(bytes, encoded)
            except Exception as error:
                load = partial(_broken, f"{type(error).__name__}: {error}", where)
            telemetry, truth = known_at(track, time_ns + options.time_offset_ns, options)
            yield SourceView(f"{number:06d}{ending}", telemetry, truth, where, load, data)


def _broken(reason: str, where: str) -> NDArray[np.uint8]:
    raise FlightError(f"image message cannot be read ({reason}): {where}")


def read_track(reader: Any, topics: Topics, mount_deg: Angles) -> RecordedTrack:
    """The track of the selected topics.

    The attitude is that of the first topic that has one (raw IMUs do not).
    """
    attitude: TimeSeries | None = None
    for connection in topics.attitudes:
        times, wxyz = _samples(reader, topics, connection, 4, attitude_of_message).arrays()
        enu_from_flu, sound = rotations_of_wxyz(wxyz)
        attitude = attitude_series(times[sound], enu_from_ros_camera(enu_from_flu, mount_deg))
        if attitude is not None:
            break
    agl, home, amsl = _heights(reader, topics)
    places = _samples(reader, topics, topics.roles.get("position"), 3, _position).positions()
    velocity = _samples(reader, topics, topics.roles.get("velocity"), 2, _velocity)
    return RecordedTrack(
        attitude=attitude,
        heights=() if agl is None else (agl,),
        home=home,
        amsl=amsl,
        hae=altitude_series(places),  # sensor_msgs/NavSatFix
        position=places,
        velocity=velocity.series(),
        origin_ns=0 if attitude is None else int(attitude.time_ns[0]),
    )


def _messages(reader: Any, topics: Topics, connection: Any) -> Iterator[tuple[int, Any]]:
    if connection is None:
        return
    for one, recorded_ns, raw in reader.messages(connections=topics.of(connection)):
        try:
            message = reader.deserialize(raw, one.msgtype)
        except Exception:  # a damaged message is one sample less
            continue
        yield stamp_ns(message, recorded_ns), message


def _samples(
    reader: Any,
    topics: Topics,
    connection: Any,
    width: int,
    values_of: Callable[[Any], tuple[float, ...] | None],
) -> Samples:
    samples = Samples(width)
    for time_ns, message in _messages(reader, topics, connection):
        if (values := values_of(message)) is not None:
            samples.add(time_ns, *values)
    return samples


def _heights(reader: Any, topics: Topics) -> tuple[TimeSeries | None, ...]:
    agl, home, amsl = (Samples(1) for _ in range(3))
    connection: Any = topics.roles.get("height")
    for time_ns, message in _messages(reader, topics, connection):
        if hasattr(message, "bottom_clearance"):
            agl.add(time_ns, message.bottom_clearance)
            home.add(time_ns, message.relative)
            amsl.add(time_ns, message.amsl)
        elif (height := height_of_message(message)) is not None:
            above_home = connection.topic.rpartition("/")[2] in _HOME_NAMES
            (home if above_home else agl).add(time_ns, height)
    return agl.series(), home.series(), amsl.series()


def _velocity(message: Any) -> tuple[float, ...] | None:
    turn, twist = message.pose.pose.orientation, message.twist.twist.linear
    for enu_from_flu in rotations_of_wxyz(np.array([[turn.w, turn.x, turn.y, turn.z]]))[0]:
        east, north, _ = enu_from_flu @ [twist.x, twist.y, twist.z]
        return float(east), float(north)
    return None


def _position(message: Any) -> tuple[float, ...] | None:
    if message.status.status < 0:  # no fix
        return None
    return message.latitude, message.longitude, message.altitude
