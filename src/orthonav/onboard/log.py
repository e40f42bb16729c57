"""The flight log: images, telemetry and results in MCAP files that can be replayed.

The flight never waits for the log. Messages go into a bounded queue; a thread encodes them and
writes a chunk about once a second. Where it falls behind or the disk is full, images are dropped
first and other messages last. A chunk that cannot be written completely is truncated, so a file
ends with a complete one. Then, and after a power cut, the index that `finish` writes is missing:
readers scan the file from the start. `docs/flights.md` describes the files.
"""

import contextlib
import logging
import math
import os
import re
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np

# Some functions of mcap have no types: calling them needs `type: ignore[no-untyped-call]`.
from mcap.writer import CompressionType, Writer
from numpy.typing import NDArray

from orthonav import __version__
from orthonav.core.errors import CameraError, OutputError, described
from orthonav.core.flight.fixes import result_to_json
from orthonav.core.flight.folder import encoded
from orthonav.core.flight.logged import (
    FORMAT,
    MAX_JSON_BYTES,
    MAX_PICTURE_BYTES,
    PROFILE,
    TOPICS,
    LoggedView,
    Message,
    calibration_message,
    lossless_png,
    navsat_message,
    picture_message,
    telemetry_message,
    to_json,
)
from orthonav.core.flight.recording import fitted
from orthonav.core.geo.camera import Camera
from orthonav.core.records import Fix, Telemetry, ViewResult

log = logging.getLogger(__name__)

Views = Literal["none", "thumbnails", "full"]
CHUNK_S = 1.0
CHUNK_BYTES = 8 * 2**20
"""A chunk ends with the view that exceeds this size."""
SEGMENT_BYTES = 256 * 2**20
QUEUE_BYTES = 64 * 2**20
SPARE_BYTES = 16 * 2**20
"""Part of the queue that is reserved for messages other than images."""
QUEUE_MESSAGES = 10_000
LARGEST_BYTES = MAX_PICTURE_BYTES - 2**20
"""Largest image; the rest of the limit is for its header."""
FILES_KEPT = 8
"""Least number of files that `max_bytes` is divided into."""
PAUSE_S = 30.0
"""Time without images after one could not be written."""
THUMBNAIL_PX, THUMBNAIL_QUALITY = 320, 60
RESULTS_LATE = 1000
"""Number of views that may be logged before the result of an earlier one."""
CLOSE_S = 30.0
Grey = NDArray[np.uint8]


class FlightLog:
    """A flight log being written. No method waits or raises. `lost` counts dropped messages."""

    def __init__(
        self,
        path: Path,
        camera: Camera,
        map_info: Mapping[str, Any],
        *,
        views: Views = "full",
        max_bytes: int | None = None,
        segment_bytes: int | None = None,
        chunk_s: float = CHUNK_S,
    ) -> None:
        """Write files `NAME_0001.mcap` and so on beside `path`, which is `NAME.mcap`.

        `map_info`: its `name` and `manifest_sha256`. `max_bytes`: of all files of this name; the
        oldest are deleted. `segment_bytes`: of a file, unless a single chunk is larger. `chunk_s`:
        the most that a power cut loses. Raises `OutputError` or `MissingExtraError`.
        """
        path = Path(path)
        self._folder, self._name = path.parent, path.stem if path.suffix == ".mcap" else path.name
        try:
            self._folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise OutputError(f"cannot write ({error.strerror}): {self._folder}") from error
        if not os.access(self._folder, os.W_OK):
            raise OutputError(f"cannot write (no permission): {self._folder}")
        TOPICS.view.definition()  # a missing package is an error now, not in flight
        self.lost = {"views": 0, "messages": 0}
        self._camera, self._views = camera, views
        self._max_bytes = max_bytes
        most = SEGMENT_BYTES if max_bytes is None else min(SEGMENT_BYTES, max_bytes // FILES_KEPT)
        self._segment_bytes = segment_bytes or most
        self._chunk_s = chunk_s
        self._session: dict[str, Any] = {
            "format": FORMAT,
            "run": os.urandom(8).hex(),  # distinguishes files of two runs of one name
            "version": __version__,
            "views": views,
            "camera": camera.numbers(),
            "map": dict(map_info),
            "options": {},
        }
        self._time_ns = 0
        self._indices: dict[str, int] = {}
        self._index = 0
        self._sized = False
        self._segment: Segment | None = None
        self._no_views_until = -math.inf
        self._warned = False
        self._queue: list[Callable[[], list[Message]]] = []
        self._queued_bytes = 0
        self._closing = False
        self._change = threading.Condition()
        self._thread = threading.Thread(target=self._work, name="flight log", daemon=True)
        self._thread.start()

    def options(self, options: Mapping[str, Any]) -> None:
        """Log the options of the flight, named as those of `orthonav localize`, for a replay."""
        session = {**self._session, "options": dict(options)}
        if self._json(session):  # options that cannot be encoded must not block later messages
            self._begin_session(session)

    def view(
        self,
        number: int,
        frame: str,
        grey: Grey | None,
        telemetry: Telemetry,
        latency_ms: float | None = None,
        withheld: bool = False,
    ) -> None:
        """Log a view before it is located: `grey` (H, W), which is copied, None for an unusable
        image; `telemetry` uncorrected by the mount. The first image sets the size of the camera."""
        self._time_ns = telemetry.time_ns
        if grey is not None and not self._sized:
            self._fit(grey.shape)
        index, self._index = self._index, self._index + 1
        self._indices[frame] = index
        while len(self._indices) > RESULTS_LATE:
            self._indices.pop(next(iter(self._indices)))
        picture, kept = self._kept(grey)
        seen = LoggedView(index, number, frame, telemetry, picture, latency_ms, withheld)
        size = 1000 if kept is None else kept.nbytes
        self._add(lambda: self._view(seen, kept), size, has_view=picture == "full")

    def _kept(self, grey: Grey | None) -> tuple[str, Grey | None]:
        """One of `PICTURES`, and what is logged of an image."""
        if grey is None:
            return "bad", None
        if self._views == "none":
            return "none", None
        if self._views == "thumbnails":
            return "thumbnail", _thumbnail(grey)
        if not self._has_room(grey.nbytes):
            self._lose("views", "the writer falls behind, or an image is too large")
            return "dropped", None
        return "full", np.array(grey, dtype=np.uint8, order="C")

    def result(self, result: ViewResult) -> None:
        index = self._indices.get(result.frame, 0)
        self._add(lambda: _result(result, index), 1000)

    def health(self, health: Mapping[str, Any]) -> None:
        time_ns, data = self._time_ns, self._json({**health, "log_lost": dict(self.lost)})
        if data:
            self._add(lambda: [_message(TOPICS.health, time_ns, data)], len(data))

    def gnss(self, time_ns: int, cdr: bytes) -> None:
        # A `sensor_msgs/NavSatFix` (CDR).
        self._add(lambda: [_message(TOPICS.gnss, time_ns, cdr)], len(cdr))

    def _json(self, values: Mapping[str, Any]) -> bytes:
        """Empty for values that cannot be encoded, which is counted."""
        try:
            return to_json(values)
        except Exception as error:
            self._lose("messages", error)
            return b""

    def _begin_session(self, session: dict[str, Any]) -> None:
        self._session = session
        self._add(lambda: [self._session_message(session)], 1000)

    def close(self) -> None:
        with self._change:
            self._closing = True
            self._change.notify()
        self._thread.join(CLOSE_S)
        if self._thread.is_alive():
            log.warning("the flight log could not be finished within %.0f s", CLOSE_S)

    def _fit(self, shape: tuple[int, ...]) -> None:
        self._sized = True
        try:
            camera = fitted(self._camera, shape[1], shape[0], "the flight log")
        except CameraError as error:
            log.warning("%s", error)
            return
        if camera != self._camera:
            self._camera = camera
            self._begin_session({**self._session, "camera": camera.numbers()})

    def _has_room(self, size_bytes: int) -> bool:
        with self._change:
            return size_bytes <= min(LARGEST_BYTES, QUEUE_BYTES - self._queued_bytes)

    def _add(
        self, make: Callable[[], list[Message]], size_bytes: int, *, has_view: bool = False
    ) -> None:
        with self._change:
            room = self._queued_bytes + size_bytes <= QUEUE_BYTES + SPARE_BYTES
            if not self._closing and room and len(self._queue) < QUEUE_MESSAGES:
                self._queue.append(make)
                self._queued_bytes += size_bytes
                if self._queued_bytes >= CHUNK_BYTES:
                    self._change.notify()
                return
        self._lose("messages", "the writer falls behind, or the log is closed")
        if has_view:
            self._lose("views", "the writer falls behind, or the log is closed")

    def _lose(self, what: str, why: object, count: int = 1) -> None:
        with self._change:
            self.lost[what] += count
            warned, self._warned = self._warned, True
        if not warned:  # once; further losses are only counted
            log.warning("the flight log drops %s (%s): %s", what, why, self._folder)

    # What follows runs in the thread.

    def _work(self) -> None:
        while True:
            with self._change:
                self._change.wait_for(
                    lambda: self._closing or self._queued_bytes >= CHUNK_BYTES, self._chunk_s
                )
                taken, self._queue, self._queued_bytes = self._queue, [], 0
                closing = self._closing
            try:
                messages: list[Message] = []
                for make in taken:
                    try:
                        messages += make()
                    except Exception as error:
                        self._lose("messages", described(error))
                self._write(messages)
                if closing:
                    self._end_segment()
            except Exception as error:  # must not end the log
                self._lose("messages", described(error), len(taken))
                self._segment = None
            if closing:
                return

    def _view(self, seen: LoggedView, kept: Grey | None) -> list[Message]:
        time_ns, images = seen.telemetry.time_ns, []
        if kept is not None:
            try:
                images = [_image(seen, kept)]
            except Exception as error:  # must not lose the telemetry
                self._lose("views", described(error))
                seen = replace(seen, picture="none")
        return [_message(TOPICS.telemetry, time_ns, telemetry_message(seen), seen.index), *images]

    def _write(self, messages: list[Message]) -> None:
        """Write a chunk; without its images where that fails, and for a while after."""
        others = [each for each in messages if not each.is_view]
        views = len(messages) - len(others)
        if views and time.monotonic() >= self._no_views_until:
            if self._put(messages):
                return
            self._no_views_until = time.monotonic() + PAUSE_S
        if views:
            self._lose("views", "no room", views)
        if others and not self._put(others):
            self._lose("messages", "no room", len(others))

    def _put(self, messages: list[Message]) -> bool:
        size = sum(len(message.data) + 100 for message in messages)
        try:
            segment = self._segment
            if segment is not None and segment.finished_bytes + size > self._segment_bytes:
                self._end_segment()
            if self._segment is None:
                needed = max(self._segment_bytes, size)
                self._segment = next_segment(self._folder, self._name, needed, self._max_bytes)
                messages = [*self._head(), *messages]
            self._segment.write(messages)
        except OSError as error:
            log.debug("flight log: %s", error)
            self._segment = None
            return False
        return True

    def _end_segment(self) -> None:
        segment, self._segment = self._segment, None
        if segment is not None:
            try:
                segment.finish()
            except OSError as error:
                log.debug("flight log ends without an index: %s", error)

    def _head(self) -> list[Message]:
        data = calibration_message(self._camera, self._time_ns)
        camera = _message(TOPICS.camera, self._time_ns, data)
        return [self._session_message(self._session), camera]

    def _session_message(self, session: dict[str, Any]) -> Message:
        return _message(TOPICS.session, self._time_ns, to_json(session))


def _message(topic: Any, time_ns: int, data: bytes, index: int = 0) -> Message:
    limit = MAX_PICTURE_BYTES if topic in (TOPICS.view, TOPICS.thumbnail) else MAX_JSON_BYTES
    if len(data) > limit:
        raise ValueError(f"{len(data)} bytes for {topic.name}")
    return Message(topic, time_ns, data, index)


def _image(seen: LoggedView, kept: Grey) -> Message:
    time_ns = seen.telemetry.time_ns
    if seen.picture == "full":
        topic, kind, data = TOPICS.view, "png", lossless_png(kept)
    else:
        data = encoded(kept, "thumbnail.jpg", THUMBNAIL_QUALITY)
        topic, kind = TOPICS.thumbnail, "jpeg"
    return _message(topic, time_ns, picture_message(data, kind, time_ns), seen.index)


def _thumbnail(grey: Grey) -> Grey:
    share = min(1.0, THUMBNAIL_PX / max(grey.shape))
    size = tuple(max(1, round(share * side)) for side in grey.shape[::-1])
    return np.asarray(cv2.resize(grey, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)


def _result(result: ViewResult, index: int) -> list[Message]:
    line = result_to_json(result).encode("ascii")
    messages = [_message(TOPICS.result, result.time_ns, line, index)]
    if isinstance(result.outcome, Fix):
        with contextlib.suppress(ValueError):  # a value that is not finite
            confident = result.is_recognized
            data = navsat_message(result.outcome, result.time_ns, confident=confident)
            messages.append(_message(TOPICS.navsat, result.time_ns, data, index))
    return messages


_INDEX_BYTES = 64_000, 300
"""Upper bound of the size of the index: constant part, and per chunk."""


class _Tail:
    """Buffers the writer's output until it is written to disk; offsets are those of the file."""

    def __init__(self) -> None:
        self._parts: list[bytes] = []
        self._count = 0

    def write(self, data: bytes) -> int:
        self._parts.append(bytes(data))
        self._count += len(data)
        return len(data)

    def tell(self) -> int:
        return self._count

    def flush(self) -> None: ...

    def taken(self) -> bytes:
        parts, self._parts = self._parts, []
        return b"".join(parts)


class Segment:
    """A new file. A method that raises `OSError` leaves it closed, ending with a chunk."""

    def __init__(self, path: Path) -> None:
        """Raises `OSError`, also where `path` exists."""
        self.path = path
        self.size_bytes = 0
        self.chunks = 0
        self._file = path.open("xb", buffering=0)
        self._tail = _Tail()
        self._writer = Writer(
            self._tail,  # type: ignore[arg-type]  # has what the writer calls
            chunk_size=2**62,  # chunks end by `flush` only
            compression=CompressionType.ZSTD,
        )
        self._writer.start(profile=PROFILE, library=f"orthonav {__version__}")
        schemas: dict[str, int] = {}
        self._channels: dict[str, int] = {}
        for topic in vars(TOPICS).values():
            if topic.schema not in schemas:
                encoding = "ros2msg" if topic.is_ros else "jsonschema"
                schemas[topic.schema] = self._writer.register_schema(
                    topic.schema, encoding, topic.definition().encode()
                )
            self._channels[topic.name] = self._writer.register_channel(
                topic.name, "cdr" if topic.is_ros else "json", schemas[topic.schema]
            )

    @property
    def finished_bytes(self) -> int:
        """Upper bound of the size of the file if it is finished now."""
        return self.size_bytes + _INDEX_BYTES[0] + _INDEX_BYTES[1] * self.chunks

    def write(self, messages: Sequence[Message]) -> None:
        """Write one chunk and sync it to disk. Raises `OSError`."""
        for message in messages:
            time_ns = max(0, message.time_ns)
            self._writer.add_message(
                self._channels[message.topic.name],
                log_time=time_ns,
                publish_time=time_ns,
                sequence=message.index & 0xFFFFFFFF,
                data=message.data,
            )
        self._writer.flush()  # type: ignore[no-untyped-call]
        self._put(self._tail.taken())
        self.chunks += 1

    def finish(self) -> None:
        """Write the index and close. Raises `OSError`."""
        self._writer.finish()  # type: ignore[no-untyped-call]
        self._put(self._tail.taken())
        self._file.close()

    def _put(self, data: bytes) -> None:
        try:
            rest = memoryview(data)
            while rest:
                rest = rest[os.write(self._file.fileno(), rest) :]
            os.fsync(self._file.fileno())
        except OSError:
            self._abandon()
            raise
        self.size_bytes += len(data)

    def _abandon(self) -> None:
        """Truncate to complete chunks and close; a file without a chunk is removed."""
        with contextlib.suppress(OSError):
            os.ftruncate(self._file.fileno(), self.size_bytes)
        with contextlib.suppress(OSError):
            self._file.close()
        if not self.chunks:
            with contextlib.suppress(OSError):
                self.path.unlink()


def next_segment(folder: Path, name: str, needed_bytes: int, max_bytes: int | None) -> Segment:
    """Next file `NAME_0001.mcap` of a log; the oldest are deleted until the rest and `needed_bytes`
    fit into `max_bytes`. Raises `OSError`."""
    pattern = re.compile(re.escape(name) + r"_(\d{4,9})\.mcap")
    found = ((pattern.fullmatch(path.name), path) for path in folder.iterdir())
    files = {int(match[1]): path for match, path in found if match}
    if max_bytes is not None:
        sizes = {number: file.stat().st_size for number, file in files.items()}
        for number in sorted(files):
            if sum(sizes.values()) + needed_bytes <= max_bytes:
                break
            files[number].unlink()
            del sizes[number]
    segment = Segment(folder / f"{name}_{max(files, default=0) + 1:04d}.mcap")
    handle = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(handle)  # the entry of the file must survive a power cut
    finally:
        os.close(handle)
    return segment
