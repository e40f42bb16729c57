"""ROS 1 bags, ROS 2 bags (SQLite and MCAP) and plain MCAP files with ROS messages, without ROS.

Messages: https://docs.ros.org/en/rolling/p/sensor_msgs/, axes: REP 103 and REP 105.
"""

from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from orthonav.core.errors import CameraError, FlightError
from orthonav.core.flight.recording import fitted
from orthonav.core.flight.ros_images import camera_of_info, grey_of_message
from orthonav.core.flight.ros_topics import Topics, find_topics
from orthonav.core.flight.ros_track import read_track, stamp_ns
from orthonav.core.flight.source_options import SourceOptions
from orthonav.core.flight.telemetry_track import RecordedTrack
from orthonav.core.geo.camera import Camera
from orthonav.ground.recordings.logs import read_log
from orthonav.ground.recordings.recording import (
    Recording,
    SourceView,
    check_overlap,
    given_camera,
    known_at,
    warnings_of,
    with_mean_velocities,
)
from orthonav.ground.recordings.ros_files import opened

_COMPRESSED = "sensor_msgs/msg/CompressedImage"
_ENDINGS = {b"\xff\xd8": ".jpg", b"\x89PNG": ".png", b"II*\0": ".tif", b"MM\0*": ".tif"}


def open_ros(path: Path, options: SourceOptions) -> Recording:
    """The flight of a recording of ROS messages.

    Telemetry is read first, in one pass over its topics; images are read on request.
    Raises `FlightError`, `CameraError` or `MissingExtraError`.
    """
    with opened(path) as (reader, doubts):
        topics = find_topics(reader, options.topics, path)
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
        expected = topics.image.msgcount
    return Recording(
        kind="ros",
        path=path,
        camera=camera,
        note=f"{path.name}: {topics.summary()}",
        expected=expected,
        stream=lambda: with_mean_velocities(
            _views(path, topics.image.topic, track, options), track
        ),
        warnings=(*doubts, *warnings, *warnings_of(track, options)),
        take_off_latlon_deg=track.take_off_latlon_deg,
    )


def _first_image(reader: Any, topics: Topics, path: Path) -> tuple[tuple[int, int], int, int]:
    """Width and height of the first image that can be read, and times of the first and the last."""
    reason = "there is none"
    for _, time_ns, raw in reader.messages(connections=topics.of(topics.image)):
        try:
            message = reader.deserialize(raw, topics.image.msgtype)
            grey = grey_of_message(message, "the last")
        except Exception as error:  # reported when its turn comes
            reason = f"{type(error).__name__}: {error}"
            continue
        stamp = stamp_ns(message, time_ns)
        late_ns = max(0, reader.end_time - time_ns)
        return (grey.shape[1], grey.shape[0]), stamp, stamp + late_ns
    raise FlightError(f"no image of {topics.image.topic} can be read ({reason}): {path}")


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
    with opened(path) as (reader, _):
        connections = [one for one in reader.connections if one.topic == topic]
        messages = reader.messages(connections=connections)
        for number, (connection, time_ns, raw) in enumerate(messages):
            yield _view(reader, (connection.msgtype, time_ns, raw), number, path, track, options)


def _view(
    reader: Any,
    message: tuple[str, int, bytes],
    number: int,
    path: Path,
    track: RecordedTrack,
    options: SourceOptions,
) -> SourceView:
    """One view; a damaged message raises when its image is decoded."""
    kind, time_ns, raw = message
    where, data, ending = f"image {number} of {path}", None, ".png"
    try:
        image = reader.deserialize(raw, kind)
        time_ns = stamp_ns(image, time_ns)
        load = partial(grey_of_message, image, where)
        if kind == _COMPRESSED:
            encoded = np.asarray(image.data, dtype=np.uint8).tobytes()
            starts = (name for start, name in _ENDINGS.items() if encoded.startswith(start))
            ending, data = next(starts, ".bin"), partial(bytes, encoded)
    except Exception as error:
        load = partial(_broken, f"{type(error).__name__}: {error}", where)
    telemetry, truth = known_at(track, time_ns + options.time_offset_ns, options)
    return SourceView(f"{number:06d}{ending}", telemetry, truth, where, load, data)


def _broken(reason: str, where: str) -> NDArray[np.uint8]:
    raise FlightError(f"image message cannot be read ({reason}): {where}")
