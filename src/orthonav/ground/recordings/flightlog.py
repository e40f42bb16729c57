"""Flight logs of the on-board runner, read so that a flight can be repeated bit for bit.

Written by `orthonav.onboard.log`; messages as in `orthonav.core.flight.logged`. A log may end
anywhere: all chunks that are complete are read.
"""

import logging
import threading
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import islice
from pathlib import Path, PurePosixPath
from typing import Any, NamedTuple

from orthonav.core.errors import CameraError, FlightError, OrthonavError
from orthonav.core.flight import decode_image
from orthonav.core.flight.fixes import result_from_json, result_to_json
from orthonav.core.flight.logged import (
    FORMAT,
    MAX_JSON_BYTES,
    PROFILE,
    TOPICS,
    LoggedView,
    camera_of,
    from_json,
    grey_of_png,
    picture_of,
    view_of,
)
from orthonav.core.flight.mount import logged_mount
from orthonav.core.flight.recording import RecordedView
from orthonav.core.geo.camera import Camera
from orthonav.core.records import ViewResult
from orthonav.ground.recordings.mcap_files import (
    LoggedMessage,
    McapFile,
    chunk_at,
    chunks,
    messages,
    name_and_number,
    profile_of,
)
from orthonav.ground.recordings.recording import (
    Grey,
    Recording,
    SourceOptions,
    given_camera,
    with_options,
)

MAX_VIEWS = 500_000  # ten a second for 14 hours; a small damaged file can claim far more
MAX_MESSAGES = 10 * MAX_VIEWS
MAX_NAME = 200
MAX_THUMBNAIL_BYTES = 2**20


@dataclass(frozen=True, eq=False)
class LoggedFlight(Recording):
    """An open flight log.

    `session`: run, version, views, map and options as they were logged. `results`: reads the
    results of the flight. `arrivals`: all views in the order of arrival, also those that were
    withheld, each with the latency (s) that was subtracted from it.
    """

    session: Mapping[str, Any] = field(default_factory=dict)
    results: Callable[[], list[ViewResult]] = list
    arrivals: Callable[[], Iterable[tuple[RecordedView, float]]] = list


class ImagePlace(NamedTuple):
    """Where the image of a view is."""

    path: Path
    offset: int  # of its chunk in the file
    number: int  # in the chunk
    whole: bool  # whether it is the full image, not a thumbnail


class BrokenLogError(FlightError):
    """A log that cannot be read any further: of a newer format, or beyond the limits."""


class LogContent:
    """What the files of a log hold. Safe to share between threads."""

    def __init__(self) -> None:
        self.session: dict[str, Any] = {}  # of the last message
        self.views: list[LoggedView] = []
        self.places: dict[int, ImagePlace] = {}  # of images by index of the view
        self.broken, self.problem = 0, ""  # number of messages skipped; about the first one
        self._messages = 0
        self._lock = threading.Lock()
        self._held: tuple[Path, int] | None = None
        self._chunk = b""

    def read(
        self, file: McapFile, take: Callable[[str, bytes], None] = lambda topic, data: None
    ) -> None:
        """Read a file; `take` gets topic and data of every message but images.

        Messages that are damaged, or for which `take` raises, are skipped. Raises `BrokenLogError`.
        """
        for offset, chunk in chunks(file):
            for number, message in enumerate(messages(chunk, file.channels)):
                if message.topic in (TOPICS.view.name, TOPICS.thumbnail.name):
                    whole = message.topic == TOPICS.view.name
                    place = ImagePlace(file.path, offset, number, whole)
                    self.places.setdefault(message.number, place)
                else:
                    self._try(message, file.path, take)
                self._messages += 1
                views = max(len(self.views), len(self.places))
                if views > MAX_VIEWS or self._messages > MAX_MESSAGES:
                    raise BrokenLogError(
                        f"flight log holds more than {MAX_VIEWS} views: {file.path}"
                    )

    def _try(self, message: LoggedMessage, path: Path, take: Callable[[str, bytes], None]) -> None:
        try:
            if message.topic == TOPICS.telemetry.name:
                self.views.append(view_of(message.data))
            elif message.topic == TOPICS.session.name:
                self.session = _session(message.data, path)
            take(message.topic, message.data)
        except BrokenLogError:
            raise
        except (OrthonavError, UnicodeDecodeError) as error:
            self.broken += 1
            self.problem = self.problem or f"a message was skipped ({error}): {path}"

    def grey(self, place: ImagePlace, camera: Camera, where: str) -> Grey:
        """The image at a place; raises `FlightError` where it cannot be decoded."""
        try:
            data, kind = picture_of(self._data(place))
        except FlightError as error:
            raise FlightError(f"{error}: {where}") from error
        except OSError as error:
            raise FlightError(f"flight log cannot be read ({error.strerror}): {where}") from error
        if place.whole and kind == "png":
            return grey_of_png(data, camera.width_px, camera.height_px, where)
        if place.whole or kind != "jpeg" or len(data) > MAX_THUMBNAIL_BYTES:
            raise FlightError(f"image has an unknown format, {kind!r:.20}: {where}")
        return decode_image(data, where)

    def _data(self, place: ImagePlace) -> bytes:
        """The message at a place, empty where its chunk is damaged; the last chunk is cached."""
        with self._lock:
            if self._held != (place.path, place.offset):
                self._chunk = chunk_at(place.path, place.offset)
                self._held = place.path, place.offset
            found = islice(messages(self._chunk, {}), place.number, None)
            return next((message.data for message in found), b"")


def is_flight_log(path: Path) -> bool:
    files = sorted(path.glob("*.mcap")) if path.is_dir() else [path]
    return any(file.is_file() and profile_of(file) == PROFILE for file in files)


def open_flight_log(path: Path, options: SourceOptions) -> LoggedFlight:
    """The flight of a log: one of its files and those that follow, or the folder of one log.

    Views whose image was not logged are left out, with a warning. Raises `FlightError` where no
    image was logged or no chunk is complete, `CameraError` or `MissingExtraError`.
    """
    if options.telemetry is not None:
        raise FlightError(f"a flight log has its own telemetry; omit --telemetry: {path}")
    files, content, warnings = files_of_run(path), LogContent(), list[str]()
    for file in map(McapFile, files):
        before = content.broken
        content.read(file)
        if file.damaged or content.broken > before:
            broken = f"{file.damaged} chunks and {content.broken - before} messages"
            warnings.append(f"{broken} are damaged: {file.path}")
        if not file.ended:
            warnings.append(
                f"flight log was cut short, {file.lost_bytes} bytes after its last complete chunk "
                f"are lost: {file.path}"
            )
    if not content.session:
        raise FlightError(f"no chunk of the flight log is complete: {path}")
    try:
        camera = camera_of(content.session["camera"])
    except (FlightError, CameraError) as error:
        raise type(error)(f"{error}: {path}") from error
    replayable = _replayable(content, path)
    used = given_camera(options, camera.width_px, camera.height_px, str(path)) or camera
    run, version = content.session.get("run"), content.session.get("version")
    return LoggedFlight(
        kind="log",
        path=path,
        camera=used,
        note=f"{path.name}: flight log {run!s:.40} of orthonav {version!s:.40}",
        expected=len(replayable),
        stream=lambda: (_view(each, content, camera, options) for each in replayable),
        warnings=(*warnings, *_differences(content, replayable, options)),
        session=content.session,
        results=partial(_results, files),
        arrivals=lambda: (
            (_view(each, content, camera, options), (each.camera_latency_ms or 0.0) / 1e3)
            for each in content.views
            if _has_image(each, content)
        ),
    )


def files_of_run(path: Path) -> list[Path]:
    """The files of one run in order: of a folder, or from the one that is given."""
    if path.is_dir():
        files = [file for file in path.glob("*.mcap") if profile_of(file) == PROFILE]
        found = {file: run for file in sorted(files, key=name_and_number) if (run := run_of(file))}
        runs = {run: file for file, run in reversed(found.items())}
        if len(runs) > 1:
            names = ", ".join(sorted(file.name for file in runs.values())[:5])
            raise FlightError(
                f"folder holds {len(runs)} flights; give the first file of one ({names}): {path}"
            )
        return list(found)
    run, (name, number) = run_of(path), name_and_number(path)
    files = sorted(path.parent.glob("*.mcap"), key=name_and_number)
    parts = ((file, *name_and_number(file)) for file in files)
    later = [file for file, its_name, part in parts if its_name == name and part > number]
    return [path, *(file for file in later if run and run_of(file) == run)]


def run_of(path: Path) -> str | None:
    """The run that a file belongs to; None where no chunk states it."""
    for _, chunk in chunks(file := McapFile(path)):
        for message in messages(chunk, file.channels):
            if message.topic == TOPICS.session.name:
                return str(from_json(message.data).get("run"))
    return None


def _session(data: bytes, path: Path) -> dict[str, Any]:
    plain = from_json(data)
    number = plain.get("format")
    if isinstance(number, int) and number != FORMAT:
        update = "update orthonav" if number > FORMAT else "its images are stored in another way"
        raise BrokenLogError(
            f"flight log has format {number!s:.20}, this program reads {FORMAT}; {update}: {path}"
        )
    if not isinstance(plain.get("camera"), dict):
        raise FlightError("session of the log is damaged")
    return plain


def _replayable(content: LogContent, path: Path) -> list[LoggedView]:
    """The views that can be localized again: image logged, or unusable in flight already."""
    seen: set[str] = set()
    for view in content.views:
        if not _is_name(view.frame):
            raise FlightError(f"{view.frame!r:.80} is not a valid name of a view: {path}")
        if view.frame in seen:
            raise FlightError(f"view {view.frame} appears twice: {path}")
        seen.add(view.frame)
    if not any(place.whole for place in content.places.values()):
        raise FlightError(
            f"flight log holds no full images (views: {content.session.get('views')!s:.20}), so "
            f"nothing can be localized again: {path}"
        )
    return [
        each
        for each in content.views
        if not each.withheld and (_has_image(each, content) or each.picture == "bad")
    ]


def _has_image(view: LoggedView, content: LogContent) -> bool:
    place = content.places.get(view.index)
    return place is not None and place.whole


def _is_name(frame: str) -> bool:
    """Whether this names a file inside a folder on every system."""
    pure = PurePosixPath(frame)
    return (
        0 < len(frame) <= MAX_NAME
        and frame.isprintable()
        and "\\" not in frame
        and not pure.is_absolute()
        and ".." not in pure.parts
        and bool(pure.name)
        and str(pure) == frame
    )


def _differences(
    content: LogContent, replayable: list[LoggedView], options: SourceOptions
) -> Iterator[str]:
    """Warnings about what this replay has not and the flight had: its mask, and views, without
    which the track differs."""
    flown, views = content.session.get("options"), content.views
    mask = flown.get("mask") if isinstance(flown, dict) else None
    if mask and options.mask is None:
        said = f"the flight was flown with --mask {mask!s:.200}"
        yield f"{said}: give it again to see the same ground"
    begin, end = min(view.index for view in views), max(view.index for view in views) + 1
    if begin > 0:
        yield (
            f"the first {begin} views of the flight are not in the log: a track begins later than "
            "in flight"
        )
    if withheld := sum(view.withheld for view in views):
        yield (
            f"{withheld} views were not located in flight, because the latency of the camera was "
            "not known; only `orthonav calibrate --latency` uses them"
        )
    if (missing := end - begin - len(replayable) - withheld) > 0:
        yield f"{missing} views lack a full image and are left out: a track differs after them"


def _view(
    view: LoggedView, content: LogContent, camera: Camera, options: SourceOptions
) -> RecordedView:
    place = content.places.get(view.index) if _has_image(view, content) else None
    where = f"view {view.frame} of {'the flight log' if place is None else place.path}"
    load = (
        partial(_unusable, where) if place is None else partial(content.grey, place, camera, where)
    )
    return RecordedView(view.frame, with_options(view.telemetry, None, options), None, where, load)


def _unusable(where: str) -> Grey:
    raise FlightError(f"the camera delivered no usable image in flight: {where}")


def _results(files: list[Path]) -> list[ViewResult]:
    found: list[ViewResult] = []

    def take(topic: str, data: bytes) -> None:
        if topic == TOPICS.result.name:
            found.append(logged_result(data))

    for path in files:
        LogContent().read(McapFile(path), take)
    return found


def logged_result(data: bytes) -> ViewResult:
    """The result in a message of `Topics.result`. Raises `FlightError` or `UnicodeDecodeError`."""
    if len(data) > MAX_JSON_BYTES:
        raise FlightError(f"result of the log has {len(data)} bytes")
    return result_from_json(data.decode("utf-8"))


log = logging.getLogger(__name__)
LOCALIZE_CHOICES = {
    "heading": ("known", "unknown"),
    "prior": ("telemetry", "none"),
}
"""Options of localize that a log may state, and their values."""


def compare_with_flight(flight: Recording, results: Sequence[ViewResult]) -> None:
    if not isinstance(flight, LoggedFlight):
        return
    logged = {result.frame: _comparable(result) for result in flight.results()}
    both = [result for result in results if result.frame in logged]
    other = [result.frame for result in both if logged[result.frame] != _comparable(result)]
    if other:
        counts = len(other), len(both), other[0]
        log.warning("%d of %d results differ from those of the flight, first: %s", *counts)
    else:
        log.info("all %d results equal those of the flight", len(both))


def _comparable(result: ViewResult) -> str:
    return result_to_json(replace(result, latency_ms=0.0))


def logged_options(logged: Any) -> dict[str, Any]:
    """Options of a log, validated: a log is untrusted input."""
    if not isinstance(logged, dict):
        return {}
    found: dict[str, Any] = {}
    kinds_of = {"accept": str | None, "track": bool, "alert_limit_m": float | None, "risk": float}
    for name in (*kinds_of, *LOCALIZE_CHOICES):
        if name in logged:
            value = logged[name]
            kinds = kinds_of.get(name, str)
            if not isinstance(value, kinds) or value not in LOCALIZE_CHOICES.get(name, (value,)):
                raise FlightError(f"flight log: invalid option {name}: {value!r:.40}")
            found[name] = value
    if "mount" in logged:
        found["mount"] = logged_mount(logged)
    return found
