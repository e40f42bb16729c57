"""A flight log as a feed of results and a source of images, also while it is written."""

import contextlib
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

from orthonav.core.errors import FlightError, MissingFileError, OrthonavError
from orthonav.core.files import require_file
from orthonav.core.flight import decode_image
from orthonav.core.flight.fixes import result_from_json
from orthonav.core.flight.logged import (
    HEALTH,
    MAX_JSON_BYTES,
    RESULT,
    SESSION,
    TELEMETRY,
    THUMBNAIL,
    VIEW,
    LoggedView,
    camera_of,
    from_json,
    picture_of,
    view_of,
)
from orthonav.core.flight.mount import Mount, logged_mount
from orthonav.core.flight.png import grey_of_png
from orthonav.core.geo.camera import Camera
from orthonav.ground.recordings.flightlog import (
    NewerFormatError,
    files_of_run,
    is_flight_log,
    run_of,
    session_of,
)
from orthonav.ground.recordings.mcap_chunks import (
    Chunk,
    LastChunk,
    MessageLocation,
    MessageSpan,
    Walk,
    chunks,
    messages,
)
from orthonav.ground.view.feed import MAX_HEALTH, MAX_VIEWS, Batch, checked_health
from orthonav.ground.view.images import Grey, Shot

RESCAN_S = 1.0
MAX_THUMBNAIL_BYTES = 2**20
_WHY_NONE = {
    "none": "the log has no images",
    "dropped": "this image was dropped for lack of time or space",
    "bad": "the camera delivered no usable image",
}


@dataclass
class _LogFile:
    """A file of the log and how far it was read."""

    path: Path
    walk: Walk = field(default_factory=Walk)
    channels: dict[int, str] = field(default_factory=dict)


@dataclass(frozen=True)
class _ImagePlace(MessageLocation):
    """Where the data of an image is; `whole` for the full view, else a thumbnail."""

    whole: bool


class LogReader:
    """Results, health and images of one flight. Safe to share between threads."""

    def __init__(self, path: Path, *, live: bool = False) -> None:
        """`path` is a folder, the first file, or the name given to `orthonav fly --log`.

        With `live` it need not exist yet; of several flights the newest is taken.
        """
        self._path, self._live = Path(path), live
        self._lock = threading.Lock()
        self._files: list[_LogFile] = []
        self._names: set[Path] = set()
        self._run: str | None = None
        self._scanned_s = -RESCAN_S
        self._chunk = LastChunk()
        self._reset()

    def _reset(self) -> None:
        self.camera: Camera | None = None
        self.session: dict[str, Any] = {}
        self.mount: Mount | None = None
        self._views: dict[str, LoggedView] = {}
        self._places: dict[int, _ImagePlace] = {}
        self._results, self._health, self._broken = 0, 0, 0

    def poll(self) -> Batch:
        """See `orthonav.ground.view.feed.Feed.poll`."""
        with self._lock:
            batch = Batch()
            self._rescan(batch)
            for file in self._files:
                if not file.walk.ended:
                    self._read(file, batch)
            return batch

    def shot(self, frame: str) -> Shot:
        """See `orthonav.ground.view.images.ViewImages.shot`."""
        with self._lock:
            view, camera = self._views.get(frame), self.camera
            place = None if view is None else self._places.get(view.index)
        if view is None or camera is None:
            raise FlightError("this view is not in the log")
        if place is None:
            raise FlightError(_WHY_NONE.get(view.picture, "the image of this view is missing"))
        return Shot(view.telemetry, camera, partial(self._grey, place, camera, frame))

    def _rescan(self, batch: Batch) -> None:
        """Add new files; start over where another flight began."""
        now = time.monotonic()
        if self._files and (not self._live or now - self._scanned_s < RESCAN_S):
            return
        self._scanned_s = now
        cut = any(_was_cut(file) for file in self._files)
        names = set(_candidates(self._path))
        if self._files and names == self._names and not cut:
            return
        found = run_files(self._path, live=self._live)
        run = run_of(found[-1]) if found else None
        if self._files and (cut or run not in (None, self._run)):
            self._files, batch.restarted = [], True
            self._reset()
        self._names, self._run = names, run or self._run
        known = {file.path for file in self._files}
        self._files += [_LogFile(path) for path in found if path not in known]

    def _read(self, file: _LogFile, batch: Batch) -> None:
        damaged = file.walk.damaged
        with contextlib.suppress(FileNotFoundError):  # deleted to make room; what was read remains
            for chunk in chunks(file.path, file.walk):
                for found in messages(chunk, file.channels):
                    self._try(found, chunk, file.path, batch)
        if file.walk.damaged > damaged == 0:
            batch.problems.append(f"damaged chunks were skipped: {file.path}")

    def _try(self, found: MessageSpan, chunk: Chunk, path: Path, batch: Batch) -> None:
        try:
            self._take(found, chunk, path, batch)
        except (_EndError, NewerFormatError):
            raise
        except (OrthonavError, UnicodeDecodeError) as error:
            self._broken += 1
            if self._broken == 1:
                batch.problems.append(f"a message was skipped ({error}): {path}")

    def _take(self, found: MessageSpan, chunk: Chunk, path: Path, batch: Batch) -> None:
        if found.topic in (VIEW.name, THUMBNAIL.name):
            whole = found.topic == VIEW.name
            place = _ImagePlace(path, chunk.offset, found.first, found.last, whole)
            self._places.setdefault(found.number, place)
            return
        data = chunk.data[found.first : found.last]
        if found.topic == TELEMETRY.name:
            view = view_of(data)
            self._views.setdefault(view.frame, view)
        elif found.topic == SESSION.name:
            self.session = session_of(data, path)
            self.camera = camera_of(self.session.get("camera"))
            options = self.session.get("options")
            self.mount = logged_mount(options if isinstance(options, dict) else {})
        elif found.topic == RESULT.name and len(data) <= MAX_JSON_BYTES:
            batch.results.append(result_from_json(data.decode("utf-8")))
            self._results += 1
        elif found.topic == HEALTH.name:
            self._health += 1
            if self._health <= MAX_HEALTH:
                batch.health.append((self._results, checked_health(from_json(data))))
        if max(self._results, len(self._views), len(self._places)) > MAX_VIEWS:
            raise _EndError(f"more than {MAX_VIEWS} views: {path}")

    def _grey(self, place: _ImagePlace, camera: Camera, frame: str) -> Grey:
        data, kind = picture_of(self._message(place))
        where = f"view {frame} of {place.path}"
        if place.whole and kind == "png":
            return grey_of_png(data, camera.width_px, camera.height_px, where)
        if place.whole or kind != "jpeg" or len(data) > MAX_THUMBNAIL_BYTES:
            raise FlightError(f"image has an unknown format: {where}")
        return decode_image(data, where)

    def _message(self, place: _ImagePlace) -> bytes:
        with self._lock:
            return self._chunk.message(place, str(place.path))


class _EndError(FlightError):
    """A log that cannot be read any further."""


def run_files(path: Path, *, live: bool) -> list[Path]:
    """The files of the flight that `path` names, in order; see `LogReader`.

    Raises `MissingFileError` or `FlightError` where there is none, unless `live`.
    """
    if path.is_file():
        return files_of_run(require_file(path, "flight log"))
    if path.is_dir() and not live:
        found = files_of_run(path)
        if not found:
            raise FlightError(f"no complete chunk of a flight log in this folder: {path}")
        return found
    runs = {file: run_of(file) for file in _candidates(path) if is_flight_log(file)}
    named = sorted((file for file in runs if runs[file]), key=lambda file: file.stat().st_mtime)
    if not named:
        if live:
            return []
        raise MissingFileError(f"flight log does not exist: {path}")
    newest = runs[named[-1]]
    if not live and any(runs[file] != newest for file in named):
        names = ", ".join(file.name for file in named[:5])
        raise FlightError(f"several flights have this name; name a file ({names}): {path}")
    ours = [file for file in named if runs[file] == newest]
    return sorted(ours, key=lambda file: (len(file.name), file.name))


def _candidates(path: Path) -> Iterator[Path]:
    """Files that may belong to a log."""
    if path.is_dir():
        yield from path.glob("*.mcap")
    elif path.is_file():
        yield from path.parent.glob("*.mcap")
    elif path.suffix == ".mcap":
        yield from path.parent.glob(f"{path.stem}_*.mcap")


def _was_cut(file: _LogFile) -> bool:
    """Whether a file is shorter than what was already read."""
    try:
        return file.path.stat().st_size < file.walk.next_offset and not file.walk.ended
    except OSError:
        return False  # deleted to make room
