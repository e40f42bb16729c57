"""Flight logs of the on-board runner, read so that a flight can be repeated bit for bit.

Written by `orthonav.onboard.log`; messages as in `orthonav.core.flight.logged`. A log may end
anywhere: all chunks that are complete are read.
"""

import re
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path, PurePosixPath
from typing import Any

from orthonav.core.errors import CameraError, FlightError
from orthonav.core.flight.fixes import result_from_json
from orthonav.core.flight.logged import (
    FORMAT,
    MAX_JSON_BYTES,
    PROFILE,
    RESULT,
    SESSION,
    TELEMETRY,
    VIEW,
    LoggedView,
    camera_of,
    from_json,
    picture_of,
    view_of,
)
from orthonav.core.flight.png import grey_of_png
from orthonav.core.flight.source_options import SourceOptions
from orthonav.core.geo.camera import Camera
from orthonav.core.records import ViewResult
from orthonav.ground.recordings.mcap_chunks import (
    Chunk,
    LastChunk,
    MessageLocation,
    MessageSpan,
    Walk,
    chunks,
    messages,
    profile_of,
)
from orthonav.ground.recordings.recording import (
    Grey,
    Recording,
    SourceView,
    given_camera,
    with_options,
)

MAX_VIEWS = 500_000
"""Ten a second for 14 hours; a small damaged file can claim far more."""
MAX_MESSAGES = 10 * MAX_VIEWS
MAX_NAME = 200
_NUMBERED = re.compile(r"(.+)_(\d{4,9})\.mcap")


@dataclass(frozen=True, eq=False)
class LoggedFlight(Recording):
    """An open flight log. `session`: run, version, views, map and options as they were logged.

    `results` reads the results of the flight, in order. `arrivals` reads all views in the order of
    arrival, also those that were withheld, each with the latency that was subtracted from it.
    """

    session: Mapping[str, Any] = field(default_factory=dict)
    results: Callable[[], Iterator[ViewResult]] = lambda: iter(())
    arrivals: Callable[[], Iterator[tuple[SourceView, float]]] = lambda: iter(())


@dataclass
class _Index:
    """Content of the files, collected in one pass."""

    session: dict[str, Any] = field(default_factory=dict)
    views: list[LoggedView] = field(default_factory=list)
    pictures: dict[int, MessageLocation] = field(default_factory=dict)
    warnings: list[str] = field(default_factory=list)
    messages: int = 0


def is_flight_log(path: Path) -> bool:
    """Whether a file is a flight log, complete or not, or a folder holds one."""
    files = sorted(path.glob("*.mcap")) if path.is_dir() else [path]
    return any(file.is_file() and profile_of(file) == PROFILE for file in files)


def open_flight_log(path: Path, options: SourceOptions) -> LoggedFlight:
    """The flight of a log: one of its files and those that follow, or the folder of one log.

    Views whose image was not logged are left out, with a warning. Raises `FlightError` where no
    image was logged or no chunk is complete, `CameraError` or `MissingExtraError`.
    """
    if options.telemetry is not None:
        raise FlightError(f"a flight log has its own telemetry; omit --telemetry: {path}")
    files = files_of_run(path)
    index = _Index()
    for file in files:
        _read_file(file, index)
    if not index.session:
        raise FlightError(f"no chunk of the flight log is complete: {path}")
    camera = _camera(index.session, path)
    replayable = _replayable(index, path)
    images = _LoggedImages(index.pictures, camera)
    used = given_camera(options, camera.width_px, camera.height_px, str(path)) or camera
    _warn_of_gaps(index, replayable)
    run, version = index.session.get("run"), index.session.get("version")
    return LoggedFlight(
        kind="log",
        path=path,
        camera=used,
        note=f"{path.name}: flight log {run!s:.40} of orthonav {version!s:.40}",
        expected=len(replayable),
        stream=partial(_stream, replayable, images, options),
        warnings=tuple(index.warnings),
        session=index.session,
        results=partial(_results, files),
        arrivals=partial(_arrivals, index, images, options),
    )


def files_of_run(path: Path) -> list[Path]:
    """The files of one run in order: of a folder, or from the one that is given."""
    if path.is_dir():
        files = [file for file in path.glob("*.mcap") if profile_of(file) == PROFILE]
        found = {file: run for file in sorted(files, key=_order) if (run := run_of(file))}
        runs = {run: file for file, run in reversed(found.items())}
        if len(runs) > 1:
            names = ", ".join(sorted(file.name for file in runs.values())[:5])
            raise FlightError(
                f"folder holds {len(runs)} flights; give the first file of one ({names}): {path}"
            )
        return list(found)
    match = _NUMBERED.fullmatch(path.name)
    run = run_of(path)
    if match is None or run is None:
        return [path]
    name, number = match[1], int(match[2])
    later = []
    for file in path.parent.glob("*.mcap"):
        other = _NUMBERED.fullmatch(file.name)
        if other and other[1] == name and int(other[2]) > number and profile_of(file) == PROFILE:
            later.append(file)
    return [path, *(file for file in sorted(later, key=_order) if run_of(file) == run)]


def _order(path: Path) -> tuple[str, int]:
    match = _NUMBERED.fullmatch(path.name)
    return (match[1], int(match[2])) if match else (path.name, 0)


def run_of(path: Path) -> str | None:
    """The run that a file belongs to; None where no chunk states it."""
    for chunk in chunks(path, Walk()):
        for found in messages(chunk, {}):
            if found.topic == SESSION.name:
                return str(from_json(chunk.data[found.first : found.last]).get("run"))
    return None


def _read_file(path: Path, index: _Index) -> None:
    walk, channels, broken = Walk(), dict[int, str](), 0
    for chunk in chunks(path, walk):
        for found in messages(chunk, channels):
            index.messages += 1
            try:
                _take(found, chunk, path, index)
            except NewerFormatError:
                raise
            except FlightError:
                broken += 1
            views = max(len(index.views), len(index.pictures))
            if views > MAX_VIEWS or index.messages > MAX_MESSAGES:
                raise FlightError(f"flight log holds more than {MAX_VIEWS} views: {path}")
    if walk.damaged or broken:
        index.warnings.append(
            f"{walk.damaged} chunks and {broken} messages are damaged and ignored: {path}"
        )
    if not walk.ended:
        index.warnings.append(
            f"flight log was cut short, {walk.lost_bytes} bytes after its last complete chunk are "
            f"lost: {path}"
        )


def _take(found: MessageSpan, chunk: Chunk, path: Path, index: _Index) -> None:
    if found.topic == VIEW.name:
        place = MessageLocation(path, chunk.offset, found.first, found.last)
        index.pictures.setdefault(found.number, place)
    elif found.topic == TELEMETRY.name:
        index.views.append(view_of(chunk.data[found.first : found.last]))
    elif found.topic == SESSION.name:
        index.session = _session(chunk.data[found.first : found.last], path)


class NewerFormatError(FlightError):
    """A log of a newer format."""


def session_of(data: bytes, path: Path) -> dict[str, Any]:
    """The session of a log. Raises `NewerFormatError`, or `FlightError` where it is damaged."""
    plain = from_json(data)
    number = plain.get("format")
    if isinstance(number, int) and number > FORMAT:
        raise NewerFormatError(
            f"flight log has format {number!s:.20}, this program reads up to {FORMAT}; update "
            f"orthonav: {path}"
        )
    return plain


def _session(data: bytes, path: Path) -> dict[str, Any]:
    plain = session_of(data, path)
    if not isinstance(plain.get("camera"), dict):
        raise FlightError("session of the log is damaged")
    return plain


def _camera(session: Mapping[str, Any], path: Path) -> Camera:
    try:
        return camera_of(session["camera"])
    except (FlightError, CameraError) as error:
        raise type(error)(f"{error}: {path}") from error


def _replayable(index: _Index, path: Path) -> list[LoggedView]:
    """The views that can be localized again: image logged, or unusable in flight already."""
    seen: set[str] = set()
    for view in index.views:
        if not _is_name(view.frame):
            raise FlightError(f"{view.frame!r:.80} is not a valid name of a view: {path}")
        if view.frame in seen:
            raise FlightError(f"view {view.frame} appears twice: {path}")
        seen.add(view.frame)
    replayable = [
        each
        for each in index.views
        if not each.withheld and (each.index in index.pictures or each.picture == "bad")
    ]
    if not index.pictures:
        raise FlightError(
            f"flight log holds no full images (views: {index.session.get('views')!s:.20}), so "
            f"nothing can be localized again: {path}"
        )
    return replayable


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


def _warn_of_gaps(index: _Index, replayable: list[LoggedView]) -> None:
    """Warn of missing views: without them the track differs from the one in flight."""
    logged = sorted(view.index for view in index.views)
    begin, end = logged[0], logged[-1] + 1
    if begin > 0:
        index.warnings.append(
            f"the first {begin} views of the flight are not in the log: a track begins later than "
            "in flight"
        )
    withheld = sum(view.withheld for view in index.views)
    missing = end - begin - len(replayable) - withheld
    if withheld:
        index.warnings.append(
            f"{withheld} views were not located in flight, because the latency of the camera was "
            "not known; only `orthonav calibrate --latency` uses them"
        )
    if missing > 0:
        index.warnings.append(
            f"{missing} views lack a full image and are left out: a track differs after them"
        )


def _stream(
    replayable: list[LoggedView], pictures: "_LoggedImages", options: SourceOptions
) -> Iterator[SourceView]:
    for view in replayable:
        where = f"view {view.frame} of {pictures.where(view.index)}"
        yield SourceView(
            frame=view.frame,
            telemetry=with_options(view.telemetry, None, options),
            truth_latlon_deg=None,
            where=where,
            load=partial(pictures.grey, view.index, where),
        )


def _arrivals(
    index: _Index, pictures: "_LoggedImages", options: SourceOptions
) -> Iterator[tuple[SourceView, float]]:
    """Views with an image, and the latency (s) that was subtracted from their arrival."""
    views = [each for each in index.views if each.index in index.pictures]
    latencies = [(each.camera_latency_ms or 0.0) / 1e3 for each in views]
    yield from zip(_stream(views, pictures, options), latencies, strict=True)


class _LoggedImages:
    """Reads images on request; caches the chunk of the last one."""

    def __init__(self, places: Mapping[int, MessageLocation], camera: Camera) -> None:
        self._places, self._camera = places, camera
        self._chunk = LastChunk()

    def where(self, index: int) -> str:
        place = self._places.get(index)
        return "the flight log" if place is None else str(place.path)

    def grey(self, index: int, where: str) -> Grey:
        """Raises `FlightError` where it cannot be decoded."""
        place = self._places.get(index)
        if place is None:
            raise FlightError(f"the camera delivered no usable image in flight: {where}")
        message = self._chunk.message(place, where)
        try:
            data, kind = picture_of(message)
        except FlightError as error:
            raise FlightError(f"{error}: {where}") from error
        if kind != "png":
            raise FlightError(f"expected a PNG, got {kind!r:.20}: {where}")
        return grey_of_png(data, self._camera.width_px, self._camera.height_px, where)


def _results(files: list[Path]) -> Iterator[ViewResult]:
    """The results of the flight; damaged ones are skipped."""
    for path in files:
        channels: dict[int, str] = {}
        for chunk in chunks(path, Walk()):
            for found in messages(chunk, channels):
                if found.topic == RESULT.name and found.last - found.first <= MAX_JSON_BYTES:
                    try:
                        text = chunk.data[found.first : found.last].decode("utf-8")
                        yield result_from_json(text)
                    except (FlightError, UnicodeDecodeError):
                        continue
