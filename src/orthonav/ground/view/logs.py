"""A flight log as a feed of results and a source of images, also while it is written."""

import contextlib
import threading
import time
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

from orthonav.core.errors import FlightError, MissingFileError
from orthonav.core.files import require_file
from orthonav.core.flight.logged import (
    HEALTH,
    RESULT,
    SESSION,
    TELEMETRY,
    LoggedView,
    camera_of,
    from_json,
)
from orthonav.core.flight.mount import Mount, logged_mount
from orthonav.core.geo.camera import Camera
from orthonav.ground.recordings.flightlog import (
    BrokenLogError,
    LogContent,
    files_of_run,
    is_flight_log,
    logged_result,
    run_of,
)
from orthonav.ground.recordings.mcap_files import McapFile
from orthonav.ground.view.feed import MAX_HEALTH, MAX_VIEWS, Batch, Shot, checked_health

RESCAN_S = 1.0
_WHY_NONE = {
    "none": "the log has no images",
    "dropped": "this image was dropped for lack of time or space",
    "bad": "the camera delivered no usable image",
}


class LogReader:
    """Results, health and images of one flight. Safe to share between threads."""

    def __init__(self, path: Path, *, live: bool = False) -> None:
        """`path` is a folder, the first file, or the name given to `orthonav fly --log`.

        With `live` it need not exist yet; of several flights the newest is taken.
        """
        self._path, self._live = Path(path), live
        self._lock = threading.Lock()
        self._files: list[McapFile] = []
        self._names: set[Path] = set()
        self._run: str | None = None
        self._scanned_s = -RESCAN_S
        self._reset()

    def _reset(self) -> None:
        self.camera: Camera | None = None
        self.mount: Mount | None = None
        self._content = LogContent()
        self._views: dict[str, LoggedView] = {}
        self._results, self._health = 0, 0

    @property
    def session(self) -> dict[str, Any]:
        return self._content.session

    def poll(self) -> Batch:
        with self._lock:
            batch = Batch()
            self._rescan(batch)
            for file in self._files:
                if not file.ended:
                    self._read(file, batch)
            return batch

    def shot(self, frame: str) -> Shot:
        with self._lock:
            view, camera, content = self._views.get(frame), self.camera, self._content
            place = None if view is None else content.places.get(view.index)
        if view is None or camera is None:
            raise FlightError("this view is not in the log")
        if place is None:
            raise FlightError(_WHY_NONE.get(view.picture, "the image of this view is missing"))
        where = f"view {frame} of {place.path}"
        return Shot(view.telemetry, camera, partial(content.grey, place, camera, where))

    def _rescan(self, batch: Batch) -> None:
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
        self._files += [McapFile(path) for path in found if path not in known]

    def _read(self, file: McapFile, batch: Batch) -> None:
        content, damaged, broken = self._content, file.damaged, self._content.broken
        with contextlib.suppress(FileNotFoundError):  # deleted to make room; what was read remains
            content.read(file, partial(self._take, batch))
        if content.broken > broken == 0:
            batch.problems.append(content.problem)
        if file.damaged > damaged == 0:
            batch.problems.append(f"damaged chunks were skipped: {file.path}")

    def _take(self, batch: Batch, topic: str, data: bytes) -> None:
        if topic == TELEMETRY.name:
            view = self._content.views[-1]
            self._views.setdefault(view.frame, view)
        elif topic == SESSION.name:
            self.camera = camera_of(self.session["camera"])
            options = self.session.get("options")
            self.mount = logged_mount(options if isinstance(options, dict) else {})
        elif topic == RESULT.name:
            batch.results.append(logged_result(data))
            self._results += 1
            if self._results > MAX_VIEWS:
                raise BrokenLogError(f"flight log holds more than {MAX_VIEWS} results")
        elif topic == HEALTH.name:
            self._health += 1
            if self._health <= MAX_HEALTH:
                batch.health.append((self._results, checked_health(from_json(data))))


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
    if path.is_dir():
        yield from path.glob("*.mcap")
    elif path.is_file():
        yield from path.parent.glob("*.mcap")
    elif path.suffix == ".mcap":
        yield from path.parent.glob(f"{path.stem}_*.mcap")


def _was_cut(file: McapFile) -> bool:
    try:
        return file.path.stat().st_size < file.next_offset and not file.ended
    except OSError:
        return False  # deleted to make room
