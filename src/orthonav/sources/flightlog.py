"""Flight logs of the on-board runner, read so that what flew is flown again bit for bit.

Written by `orthonav.onboard.log`; messages as in `orthonav.flight.logged`. A log may be cut
anywhere: whatever comes before the cut in whole chunks is read.
"""

import re
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path, PurePosixPath
from typing import Any

from orthonav.errors import CameraError, FlightError
from orthonav.flight.fixes import result_from_json
from orthonav.flight.logged import (
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
from orthonav.flight.png import grey_of_png
from orthonav.geo.camera import Camera
from orthonav.records import ViewResult
from orthonav.sources.cameras import read_camera_file
from orthonav.sources.mcap_chunks import (
    Chunk,
    Found,
    LastChunk,
    Place,
    Walk,
    chunks,
    messages,
    profile_of,
)
from orthonav.sources.options import SourceOptions
from orthonav.sources.recording import Grey, Recording, SourceView, fitted, with_options

MAX_VIEWS = 500_000
"""Ten a second for 14 hours; a small file can claim far more."""
MAX_MESSAGES = 10 * MAX_VIEWS
MAX_NAME = 200
_NUMBERED = re.compile(r"(.+)_(\d{4,9})\.mcap")


@dataclass(frozen=True, eq=False)
class LoggedFlight(Recording):
    """A flight log opened. `session`: run, version, views, map and options as they were logged.

    `results` reads what came out in flight, in order.
    """

    session: Mapping[str, Any] = field(default_factory=dict)
    results: Callable[[], Iterator[ViewResult]] = lambda: iter(())


@dataclass
class _Index:
    """What is found in going through the files once."""

    session: dict[str, Any] = field(default_factory=dict)
    views: list[LoggedView] = field(default_factory=list)
    pictures: dict[int, Place] = field(default_factory=dict)
    warnings: list[str] = field(default_factory=list)
    messages: int = 0


def is_flight_log(path: Path) -> bool:
    """Whether a file is a flight log, cut or not, or a folder holds one."""
    files = sorted(path.glob("*.mcap")) if path.is_dir() else [path]
    return any(file.is_file() and profile_of(file) == PROFILE for file in files)


def open_flight_log(path: Path, options: SourceOptions) -> LoggedFlight:
    """The flight of a log: a file of it and those that follow, or the folder of one log.

    Views whose picture was not kept are left out, and it is told how many. Raises `FlightError`
    where none was kept or nothing whole is left, `CameraError` or `MissingExtraError`.
    """
    if options.telemetry is not None:
        raise FlightError(f"a flight log has telemetry of its own: no --telemetry: {path}")
    files = files_of_run(path)
    index = _Index()
    for file in files:
        _read_file(file, index)
    if not index.session:
        raise FlightError(f"no chunk of the flight log is whole: {path}")
    camera = _camera(index.session, path)
    kept = _kept(index, path)
    told = camera
    if options.camera is not None:
        read = read_camera_file(options.camera)
        told = fitted(read, camera.width_px, camera.height_px, str(path))
    _warn_of_gaps(index, kept)
    run, version = index.session.get("run"), index.session.get("version")
    return LoggedFlight(
        kind="log",
        path=path,
        camera=told,
        note=f"{path.name}: flight log {run!s:.40} of orthonav {version!s:.40}",
        expected=len(kept),
        stream=partial(_stream, kept, _Pictures(index.pictures, camera), options),
        warnings=tuple(index.warnings),
        session=index.session,
        results=partial(_results, files),
    )


def files_of_run(path: Path) -> list[Path]:
    """The files of one run in order: of a folder, or from the one that is named."""
    if path.is_dir():
        files = [file for file in path.glob("*.mcap") if profile_of(file) == PROFILE]
        found = {file: run for file in sorted(files, key=_order) if (run := run_of(file))}
        runs = {run: file for file, run in reversed(found.items())}
        if len(runs) > 1:
            names = ", ".join(sorted(file.name for file in runs.values())[:5])
            raise FlightError(
                f"folder holds {len(runs)} flights; name the first file of one ({names}): {path}"
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
    """The run that a file is of; None where no chunk tells."""
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
            f"{walk.damaged} chunks and {broken} messages are damaged and left out: {path}"
        )
    if not walk.ended:
        index.warnings.append(
            f"flight log was cut short, {walk.lost_bytes} bytes behind its last whole chunk are "
            f"lost: {path}"
        )


def _take(found: Found, chunk: Chunk, path: Path, index: _Index) -> None:
    if found.topic == VIEW.name:
        place = Place(path, chunk.offset, found.first, found.last)
        index.pictures.setdefault(found.number, place)
    elif found.topic == TELEMETRY.name:
        index.views.append(view_of(chunk.data[found.first : found.last]))
    elif found.topic == SESSION.name:
        index.session = _session(chunk.data[found.first : found.last], path)


class NewerFormatError(FlightError):
    """A log of a format that this program does not know."""


def session_of(data: bytes, path: Path) -> dict[str, Any]:
    """What a log says of its flight. Raises `NewerFormatError`, or `FlightError` where broken."""
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
        raise FlightError("session of the log is broken")
    return plain


def _camera(session: Mapping[str, Any], path: Path) -> Camera:
    try:
        return camera_of(session["camera"])
    except (FlightError, CameraError) as error:
        raise type(error)(f"{error}: {path}") from error


def _kept(index: _Index, path: Path) -> list[LoggedView]:
    """The views that can be flown again: pictures that were kept, or were bad in flight too."""
    seen: set[str] = set()
    for view in index.views:
        if not _is_name(view.frame):
            raise FlightError(f"{view.frame!r:.80} is no name of a view: {path}")
        if view.frame in seen:
            raise FlightError(f"view {view.frame} comes twice: {path}")
        seen.add(view.frame)
    kept = [each for each in index.views if each.index in index.pictures or each.picture == "bad"]
    if not kept or not index.pictures:
        raise FlightError(
            f"flight log holds no full pictures (views: {index.session.get('views')!s:.20}), so "
            f"nothing can be localized again: {path}"
        )
    return kept


def _is_name(frame: str) -> bool:
    """Whether this names a file inside a folder, wherever it is written."""
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


def _warn_of_gaps(index: _Index, kept: list[LoggedView]) -> None:
    """A track that lacks views is another track: say what is missing."""
    told = sorted(view.index for view in index.views)
    begin, end = told[0], told[-1] + 1
    if begin > 0:
        index.warnings.append(
            f"the first {begin} views of the flight are not in the log: a track begins later than "
            "it did in flight"
        )
    missing = end - begin - len(kept)
    if missing > 0:
        index.warnings.append(
            f"{missing} views were not kept whole and are left out: a track differs after them"
        )


def _stream(
    kept: list[LoggedView], pictures: "_Pictures", options: SourceOptions
) -> Iterator[SourceView]:
    for view in kept:
        where = f"view {view.frame} of {pictures.where(view.index)}"
        yield SourceView(
            frame=view.frame,
            telemetry=with_options(view.telemetry, None, options),
            truth_latlon_deg=None,
            where=where,
            load=partial(pictures.grey, view.index, where),
        )


class _Pictures:
    """Reads pictures when they are asked for; holds the chunk of the last one."""

    def __init__(self, places: Mapping[int, Place], camera: Camera) -> None:
        self._places, self._camera = places, camera
        self._chunk = LastChunk()

    def where(self, index: int) -> str:
        place = self._places.get(index)
        return "the flight log" if place is None else str(place.path)

    def grey(self, index: int, where: str) -> Grey:
        """Raises `FlightError` where it cannot be decoded."""
        place = self._places.get(index)
        if place is None:
            raise FlightError(f"the camera gave no usable picture in flight: {where}")
        message = self._chunk.message(place, where)
        try:
            data, kind = picture_of(message)
        except FlightError as error:
            raise FlightError(f"{error}: {where}") from error
        if kind != "png":
            raise FlightError(f"expected a PNG, got {kind!r:.20}: {where}")
        return grey_of_png(data, self._camera.width_px, self._camera.height_px, where)


def _results(files: list[Path]) -> Iterator[ViewResult]:
    """What came out in flight; what is damaged is left out."""
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
