"""ROS 1 bags, ROS 2 bags (SQLite and MCAP) and plain MCAP files with ROS messages, without ROS.

Messages: https://docs.ros.org/en/rolling/p/sensor_msgs/, axes: REP 103 and REP 105.
"""

import bz2
import contextlib
import io
import logging
import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from itertools import accumulate
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from orthonav.core.errors import CameraError, FlightError
from orthonav.core.files import require_file
from orthonav.core.flight.logged import MAX_CHUNK_BYTES
from orthonav.core.flight.recording import RecordedView, fitted
from orthonav.core.flight.ros_messages import (
    attitude_of_message,
    camera_of_info,
    grey_of_message,
    height_of_message,
    horizon_std_of_message,
    odd_word,
    stamp_ns,
)
from orthonav.core.geo.attitude import Angles, enu_from_ros_camera, rotations_of_wxyz
from orthonav.core.geo.camera import Camera
from orthonav.core.guard import needed, reading, without_plea
from orthonav.ground.recordings.logs import read_log
from orthonav.ground.recordings.mcap_files import MAGIC, complete_bytes, inflated, name_and_number
from orthonav.ground.recordings.recording import (
    ROLES,
    Recording,
    SourceOptions,
    check_overlap,
    given_camera,
    known_at,
    warnings_of,
    with_mean_velocities,
)
from orthonav.ground.recordings.telemetry_track import (
    RecordedTrack,
    Samples,
    Sources,
    TimeSeries,
    altitude_series,
    attitude_series,
)

MAGICS = {b"#ROSBAG V": ".bag", MAGIC: ".mcap", b"SQLite format 3\0": ".db3"}
METADATA = "metadata.yaml"
MAX_HELD_BYTES = 2**30
WHAT = "ROS recordings"
_ROS_2 = (".mcap", ".db3")
_END = b"\x0f" + (4).to_bytes(8, "little") + bytes(4)  # data end
_END += b"\x02" + (20).to_bytes(8, "little") + bytes(20) + MAGIC  # footer without a summary

_COMPRESSED = "sensor_msgs/msg/CompressedImage"
_PLAIN_NUMBERS = ("std_msgs/msg/Float64", "std_msgs/msg/Float32")
TYPES: dict[str, tuple[str, ...]] = {
    "image": ("sensor_msgs/msg/Image", _COMPRESSED),
    "camera_info": ("sensor_msgs/msg/CameraInfo",),
    "attitude": ("sensor_msgs/msg/Imu", "nav_msgs/msg/Odometry", "geometry_msgs/msg/PoseStamped"),
    "velocity": ("nav_msgs/msg/Odometry",),
    "position": ("sensor_msgs/msg/NavSatFix",),
    "height": ("sensor_msgs/msg/Range", "mavros_msgs/msg/Altitude", *_PLAIN_NUMBERS),
}
_ENDINGS = {b"\xff\xd8": ".jpg", b"\x89PNG": ".png", b"II*\0": ".tif", b"MM\0*": ".tif"}
_HOME_NAMES = ("/rel_alt", "/relative_altitude")
_HEIGHT_NAMES = (*_HOME_NAMES, "/agl", "/height_above_ground")
_IGNORED = ("/orthonav/fix", "/global_position/local")
"""Its own results; odometry of MAVROS whose velocity is not in the frame of the body."""
Topics = Mapping[str, Mapping[str, Any]]  # connections of a role by topic, the preferred first
log = logging.getLogger(__name__)


def bag_suffix(path: Path) -> str | None:
    """The suffix that fits the content of a file, None where it is not a bag."""
    with path.open("rb") as stream:
        head = stream.read(16)
    return next((suffix for magic, suffix in MAGICS.items() if head.startswith(magic)), None)


def storage_files(folder: Path) -> list[Path]:
    """The files of a ROS 2 bag in a folder, by name and number."""
    found = [path for path in folder.iterdir() if path.is_file() and path.suffix in _ROS_2]
    found = [path for path in found if bag_suffix(require_file(path, "file of the bag")) in _ROS_2]
    found.sort(key=name_and_number)
    if len({(name_and_number(path)[0], path.suffix) for path in found}) > 1:
        names = ", ".join(path.name for path in found[:5])
        raise FlightError(
            f"folder holds {len(found)} ROS 2 recordings ({names}); give one of the files: {folder}"
        )
    return found


@contextlib.contextmanager
def opened(path: Path) -> Iterator[tuple[Any, list[str]]]:
    bound_inflation()
    with contextlib.ExitStack() as stack:
        stack.enter_context(reading("ROS recording", path))
        warnings: list[str] = []
        reader = _entered(path, stack, warnings)
        try:
            yield reader, warnings
        except FlightError as error:
            raise FlightError("; ".join([*warnings, str(error)])) from error


def _entered(path: Path, stack: contextlib.ExitStack, warnings: list[str]) -> Any:
    if path.is_file():
        require_file(path, "ROS recording")
        if (suffix := bag_suffix(path)) not in (None, path.suffix):  # which selects the reader
            raise FlightError(f"ROS recording needs the suffix {suffix}; rename it: {path}")
        return _reader([_whole(path, warnings)], path, stack)
    doubt = None
    try:
        files = storage_files(path)
    except FlightError:
        if not (path / METADATA).is_file():
            raise
        files = []  # only the metadata can tell which they are
    if (path / METADATA).is_file() and not any(_is_cut(file) for file in files):
        try:
            return _reader([path], path, stack)
        except Exception as error:
            if not files:
                raise
            doubt = without_plea(" ".join(str(error).split()))[:160]
    if not files:
        raise FlightError(f"folder holds no complete file of a bag (.mcap, .db3): {path}")
    if doubt:
        warnings.append(f"{METADATA} is not used ({doubt}); the files beside it are read")
    return _reader([_whole(file, warnings) for file in files], path, stack)


def _reader(paths: Sequence[Any], path: Path, stack: contextlib.ExitStack) -> Any:
    highlevel = needed("rosbags.highlevel", WHAT)
    typesys = needed("rosbags.typesys", WHAT)
    known = typesys.get_typestore(typesys.Stores.LATEST)  # for old bags without definitions
    reader = highlevel.AnyReader(paths, default_typestore=known)
    reader.readers = [ParsableReader(each) for each in reader.readers]
    try:
        stack.enter_context(reader)
    except highlevel.AnyReaderError as error:
        if getattr(paths[0], "suffix", "") == ".bag":
            raise FlightError(
                f"ROS 1 bag has no complete index ({error}): it was not closed, or was cut off; "
                f"run `rosbag reindex` on it: {path}"
            ) from error
        if "malformed" in str(error):
            raise FlightError(
                "ROS 2 bag was cut off or is damaged; `sqlite3 BAG.db3 .recover | sqlite3 new.db3` "
                f"may restore it: {path}"
            ) from error
        raise
    check_held(reader.readers)
    return reader


class ParsableReader:
    """A reader of `rosbags` without the connections whose messages it cannot describe.

    `rosbags` refuses a whole recording for one of them. Such are events of services and actions:
    their definitions refer to types that messages do not have.
    """

    def __init__(self, reader: Any) -> None:
        self._reader = reader

    def __enter__(self) -> "ParsableReader":
        self._reader.__enter__()
        return self

    def __exit__(self, *raised: Any) -> None:
        self._reader.__exit__(*raised)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._reader, name)

    @cached_property
    def connections(self) -> list[Any]:
        return [one for one in self._reader.connections if _is_parsable(one)]


def _is_parsable(connection: Any) -> bool:
    typesys = needed("rosbags.typesys", WHAT)
    parsable = "/msg/" in connection.msgtype
    if parsable and connection.msgdef.format.name == "MSG":
        store = typesys.get_typestore(typesys.Stores.EMPTY)
        try:
            store.register(typesys.get_types_from_msg(connection.msgdef.data, connection.msgtype))
            store.hash_rihs01(connection.msgtype)
        except Exception as error:  # of the parser, or of a type that is not defined
            log.info("%s cannot be parsed: %s", connection.msgtype, error)
            parsable = False
    if not parsable:
        log.info("topic is ignored: %s carries %s", connection.topic, connection.msgtype)
    return parsable


def _is_cut(path: Path) -> bool:
    if path.suffix != ".mcap":
        return False
    with path.open("rb") as stream:
        size = stream.seek(0, io.SEEK_END)
        stream.seek(max(0, size - len(MAGIC)))
        return stream.read() != MAGIC


def _whole(path: Path, warnings: list[str]) -> "Path | _CutMcap":
    journal = path.with_name(f"{path.name}-wal")
    if journal.is_file() and journal.stat().st_size:
        warnings.append(
            f"bag was not closed, and data in {journal.name} are not read; write them into "
            f"the bag first: sqlite3 {path.name} 'pragma wal_checkpoint(truncate)': {path}"
        )
    if not _is_cut(path):
        return path
    complete = complete_bytes(path)
    warnings.append(
        "recording was cut short: it is read up to its last complete chunk; `mcap recover` "
        f"repairs it for other programs: {path}"
    )
    return _CutMcap(path, complete)


@dataclass(frozen=True)
class _CutMcap:
    """The path, for `rosbags`, of an MCAP file whose first `complete` bytes an end follows."""

    path: Path
    complete: int
    suffix: str = ".mcap"

    def exists(self) -> bool:
        return self.path.exists()

    def is_dir(self) -> bool:
        return False

    def open(self, mode: str = "rb") -> "_Ended":
        return _Ended(self.path.open(mode), self.complete)


class _Ended:
    """The first `complete` bytes of a file, then the end of an MCAP file without a summary."""

    def __init__(self, stream: Any, complete: int) -> None:
        self._stream, self._complete, self._at = stream, complete, 0

    def seek(self, offset: int, whence: int = io.SEEK_SET) -> int:
        starts = 0, self._at, self._complete + len(_END)
        self._at = max(0, starts[whence] + offset)
        return self._at

    def read(self, size: int | None = None) -> bytes:
        whole = self._complete + len(_END)
        end = whole if size is None or size < 0 else min(self._at + size, whole)
        self._stream.seek(self._at)
        data: bytes = self._stream.read(max(0, min(end, self._complete) - self._at))
        data += _END[max(0, self._at - self._complete) : max(0, end - self._complete)]
        self._at += len(data)
        return data

    def tell(self) -> int:
        return self._at

    def close(self) -> None:
        self._stream.close()


def bound_inflation() -> None:
    """Limit decompression by `rosbags` to the stated size of a chunk and `MAX_CHUNK_BYTES`.

    It decompresses a whole chunk before it compares its size with the stated one, so a small
    malicious file could exhaust memory. Violations raise `ValueError`, as damage does there.
    """
    lz4 = needed("lz4.frame", WHAT).LZ4FrameDecompressor

    def of_mcap(kind: str, data: bytes, size: int) -> bytes:
        _require(size)
        return inflated(kind, data, size + 1)  # which is then compared with the stated size

    def of_bag(decompressor: Callable[[], Any], data: bytes) -> bytes:
        unpacking = decompressor()
        plain: bytes = unpacking.decompress(data, max_length=MAX_CHUNK_BYTES + 1)
        if len(plain) > MAX_CHUNK_BYTES or not unpacking.eof:
            raise ValueError(f"a chunk is cut, or takes more than the {MAX_CHUNK_BYTES} it may")
        return plain

    mcap = needed("rosbags.rosbag2.storage_mcap", WHAT)
    mcap.DECOMPRESSORS.update({kind: partial(of_mcap, kind) for kind in ("zstd", "lz4")})
    bag = needed("rosbags.rosbag1.reader", WHAT)
    bag.decompressors.update(lz4=partial(of_bag, lz4), bz2=partial(of_bag, bz2.BZ2Decompressor))


def check_held(readers: Iterable[Any]) -> None:
    """Raises `ValueError` where chunks state too many bytes, singly or those of the same time,
    which are held at once.

    `readers` are those of an opened recording (`AnyReader.readers`).
    """
    for reader in readers:
        storage = getattr(reader, "storage", None)  # a ROS 1 bag has none: one chunk at a time
        for one in getattr(storage, "storages", [storage]):
            chunks = getattr(one, "chunks", [])
            _require(max((chunk.uncompressed_size for chunk in chunks), default=0))
            edges = [(each.message_start_time, 0, each.uncompressed_size) for each in chunks]
            edges += [
                (max(each.message_start_time, each.message_end_time), 1, -each.uncompressed_size)
                for each in chunks
            ]
            held = max(accumulate(step for _, _, step in sorted(edges)), default=0)
            if held > MAX_HELD_BYTES:
                raise ValueError(
                    f"chunks of the same time state {held} bytes, more than {MAX_HELD_BYTES}"
                )


def _require(size: int) -> None:
    if size > MAX_CHUNK_BYTES:
        raise ValueError(f"a chunk states {size} bytes, more than {MAX_CHUNK_BYTES}")


def all_on(reader: Any, connection: Any) -> list[Any]:
    """All connections on the topic of one (bags split or appended have several)."""
    return [one for one in reader.connections if one.topic == connection.topic]


def find_topics(reader: Any, sources: Sources) -> Topics:
    counted = {one.topic: one for one in reader.connections if one.msgcount}
    if not counted:
        raise FlightError(f"recording holds no whole message: {sources.path}")
    found: dict[str, dict[str, Any]] = {}
    for role, types in TYPES.items():
        named = role in sources.named
        of_type = [
            one for one in counted.values() if one.msgtype in types and (named or _fits(one))
        ]
        of_type.sort(key=lambda one: (types.index(one.msgtype), -one.msgcount, one.topic))
        found[role] = {one.topic: one for one in of_type}
    images, infos = found["image"], found["camera_info"]
    if len(images) != 1 and "image" not in sources.named:
        names = ", ".join(sorted(images)) or f"none among {', '.join(sorted(counted))}"
        raise FlightError(
            f"expected one topic of images, found {names}; give --topic: {sources.path}"
        )
    image = sources.first("image", images, lambda name: (name, ""))
    if "camera_info" not in sources.named:
        # In the namespace of the image (image_raw/compressed too).
        near = [name for name in infos if image.startswith(name.rpartition("/")[0] + "/")]
        near.sort(key=lambda name: -name.count("/"))
        infos = dict.fromkeys(near or list(infos)[: len(infos) == 1])
    sources.first("camera_info", infos, lambda name: (name, ""))
    return found


def _fits(connection: Any) -> bool:
    number, topic = connection.msgtype in _PLAIN_NUMBERS, connection.topic
    return topic.endswith(_HEIGHT_NAMES) if number else not topic.endswith(_IGNORED)


def open_ros(path: Path, options: SourceOptions) -> Recording:
    """The flight of a recording of ROS messages.

    Telemetry is read first, in one pass over its topics; images are read on request.
    """
    with opened(path) as (reader, doubts):
        own = ROLES if options.telemetry is None else ("image", "camera_info")  # else of the log
        asked = {role: name for role, name in options.topics.items() if role in own}
        sources = Sources(asked, path)
        topics = find_topics(reader, sources)
        image = topics["image"][sources.used["image"]]
        size, first_ns, last_ns = _first_image(reader, image, path)
        camera = given_camera(options, *size, str(path)) or fitted(
            _camera(reader, topics, sources), *size, str(path)
        )
        if options.telemetry is not None:
            track = read_log(options.telemetry, options.mount_deg, options.topics)
        else:
            track = read_track(reader, topics, sources, options.mount_deg)
        warnings = [] if track.attitude else ["no topic has the attitude of the aircraft"]
        if track.span_ns() is not None or options.telemetry is not None:
            offset = options.time_offset_ns
            check_overlap(track, first_ns + offset, last_ns + offset, options.telemetry or path)
    used = [f"{role} {name}" for role, name in sources.used.items() if name != "none"]
    return Recording(
        kind="ros",
        path=path,
        camera=camera,
        note=f"{path.name}: {', '.join(used)}",
        expected=image.msgcount,
        stream=lambda: with_mean_velocities(_views(path, image.topic, track, options), track),
        warnings=(*doubts, *warnings, *warnings_of(track, options)),
        choices=tuple(dict.fromkeys(sources.choices + track.choices)),
        take_off_latlon_deg=track.take_off_latlon_deg,
    )


def _first_image(reader: Any, image: Any, path: Path) -> tuple[tuple[int, int], int, int]:
    """Width and height of the first image that can be read, and times of the first and the last."""
    reason = "there is none"
    for _, time_ns, raw in reader.messages(connections=all_on(reader, image)):
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


def _camera(reader: Any, topics: Topics, sources: Sources) -> Camera:
    info = topics["camera_info"].get(sources.used["camera_info"])
    found = next(_messages(reader, info), None) if info else None
    if found is None:
        raise CameraError(f"no camera_info for the images; give --camera FILE: {sources.path}")
    try:
        return camera_of_info(found[1], sources.used["image"])
    except CameraError as error:
        raise CameraError(f"{error}: {sources.path}") from error


def _views(
    path: Path, topic: str, track: RecordedTrack, options: SourceOptions
) -> Iterator[RecordedView]:
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
            yield RecordedView(f"{number:06d}{ending}", telemetry, truth, where, load, data)


def _broken(reason: str, where: str) -> NDArray[np.uint8]:
    raise FlightError(f"image message cannot be read ({reason}): {where}")


def read_track(reader: Any, topics: Topics, sources: Sources, mount_deg: Angles) -> RecordedTrack:
    def value(role: str, read: Callable[[Any, Any], tuple[Any, str]], name: str) -> Any:
        one = topics[role][name]
        word = odd_word(next((each for _, each in _messages(reader, one)), None), name)
        odd = word and role not in sources.named
        return (None, f"'{word}' in its name") if odd else read(reader, one)

    def first(role: str, read: Callable[[Any, Any], tuple[Any, str]]) -> Any:
        return sources.first(role, topics[role], partial(value, role, read))

    def heights() -> tuple[tuple[TimeSeries, ...], TimeSeries | None, TimeSeries | None]:
        held, faults = dict[str, Any](), {}
        for name in topics["height"]:
            held[name], faults[name] = value("height", _heights, name)
        if "height" in sources.named:
            agl, *others = sources.first("height", held, lambda name: (held[name], ""))
            return (() if agl is None else (agl,)), others[0], others[1]
        known = [each for each in held.values() if each]
        measured = {name: each and each[0] for name, each in held.items() if not each or each[0]}
        agls = sources.all("height", measured, faults)
        home, amsl = (next((x[i] for x in known if x[i]), None) for i in (1, 2))
        return agls, home, amsl

    attitude, horizon = first("attitude", partial(_attitude, mount_deg)) or (None, None)
    agl, home, amsl = heights()
    receivers = topics["position"].items()
    fixes = {name: _samples(reader, one, _position, 3).positions() for name, one in receivers}
    places = sources.best("position", fixes)
    return RecordedTrack(
        attitude=attitude,
        heights=agl,
        home=home,
        amsl=amsl,
        hae=altitude_series(places),  # sensor_msgs/NavSatFix
        position=places,
        velocity=first(
            "velocity", lambda bag, one: (_samples(bag, one, _velocity, 2).series(), "")
        ),
        horizon_std=horizon,
        origin_ns=0 if attitude is None else int(attitude.time_ns[0]),
        choices=sources.choices,
    )


def _attitude(mount_deg: Angles, reader: Any, connection: Any) -> tuple[Any, str]:
    """The series of attitudes and, where it is stated, of the horizon's deviation."""
    times, wxyz = _samples(reader, connection, attitude_of_message, 4).arrays()
    enu_from_flu, sound = rotations_of_wxyz(wxyz)
    attitude = attitude_series(times[sound], enu_from_ros_camera(enu_from_flu, mount_deg))
    if attitude is None:
        return None, ""
    changes = np.ptp(wxyz[sound], axis=0).any()
    horizon = _samples(reader, connection, horizon_std_of_message, 1).series()
    return (attitude, horizon), "" if changes else "its orientation never changes"


def _messages(reader: Any, connection: Any) -> Iterator[tuple[int, Any]]:
    for one, recorded_ns, raw in reader.messages(connections=all_on(reader, connection)):
        try:
            message = reader.deserialize(raw, one.msgtype)
        except Exception:  # a damaged message is one sample less
            continue
        yield stamp_ns(message, recorded_ns), message


def _samples(reader: Any, connection: Any, values_of: Callable[[Any], Any], width: int) -> Samples:
    samples = Samples(width)
    for time_ns, message in _messages(reader, connection):
        if (values := values_of(message)) is not None:
            samples.add(time_ns, *np.atleast_1d(values))
    return samples


def _heights(reader: Any, connection: Any) -> tuple[Any, str]:
    agl, home, amsl = (Samples(1) for _ in range(3))
    for time_ns, message in _messages(reader, connection):
        if hasattr(message, "bottom_clearance"):
            agl.add(time_ns, message.bottom_clearance if message.bottom_clearance > 0 else math.nan)
            home.add(time_ns, message.relative)
            amsl.add(time_ns, message.amsl)
        elif (height := height_of_message(message)) is not None:
            (home if connection.topic.endswith(_HOME_NAMES) else agl).add(time_ns, height)
    found = agl.series(), home.series(), amsl.series()
    return found if any(found) else None, ""


def _velocity(message: Any) -> tuple[float, ...] | None:
    twist, wxyz = message.twist.twist.linear, attitude_of_message(message)
    for enu_from_flu in rotations_of_wxyz(np.array([wxyz or (0.0,) * 4]))[0]:
        east, north, _ = enu_from_flu @ [twist.x, twist.y, twist.z]
        return float(east), float(north)
    return None


def _position(message: Any) -> tuple[float, ...] | None:
    if message.status.status < 0:  # no fix
        return None
    return message.latitude, message.longitude, message.altitude
