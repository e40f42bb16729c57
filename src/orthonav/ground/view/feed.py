"""Results, health and images of a flight, from files that may still grow: fixes or a flight log."""

import contextlib
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from orthonav.core.errors import FlightError, MissingFileError
from orthonav.core.files import require_file
from orthonav.core.flight.fixes import is_health, result_from_json
from orthonav.core.flight.logged import (
    TOPICS,
    LoggedView,
    camera_of,
    from_json,
)
from orthonav.core.flight.mount import Mount, logged_mount
from orthonav.core.geo.camera import Camera
from orthonav.core.records import Telemetry, ViewResult
from orthonav.ground.recordings.flightlog import (
    BrokenLogError,
    LogContent,
    files_of_run,
    is_flight_log,
    logged_result,
    run_of,
)
from orthonav.ground.recordings.mcap_files import McapFile

MAX_LINE_BYTES = 2**20
MAX_VIEWS = 500_000
"""Ten per second for 14 hours."""
MAX_HEALTH = 200_000
RESCAN_S = 1.0
_WHY_NONE = {
    "none": "the log has no images",
    "dropped": "this image was dropped for lack of time or space",
    "bad": "the camera delivered no usable image",
}


@dataclass
class Batch:
    """What is new since the last poll.

    `health`: lines of health, each with the number of results before it.
    `restarted`: the file was replaced, so everything read before is void.
    """

    results: list[ViewResult] = field(default_factory=list)
    health: list[tuple[int, dict[str, Any]]] = field(default_factory=list)
    restarted: bool = False
    problems: list[str] = field(default_factory=list)


@dataclass(frozen=True, eq=False)
class Shot:
    """One recorded view; `load` returns the image (H, W), or raises `FlightError`."""

    telemetry: Telemetry
    camera: Camera
    load: Callable[[], NDArray[np.uint8]]


class LineFeed:
    """`fixes.jsonl`, or the output of `orthonav fly --jsonl`: results, and health between them.

    Lines that are neither are skipped and reported: a file that a full disk cut short is better
    than none. With `live` the file need not exist yet, and its last line may be incomplete.
    """

    def __init__(self, path: Path, *, live: bool = False) -> None:
        self._path, self._live = Path(path), live
        self._reset()

    def _reset(self) -> None:
        self._offset, self._file, self._lines, self._views = 0, (0, 0), 0, 0
        self._health, self._broken = 0, 0

    def poll(self) -> Batch:
        batch = Batch()
        if self._live and not self._path.exists():
            return batch
        with require_file(self._path, "file of fixes").open("rb") as stream:
            batch.restarted = self._was_replaced()
            stream.seek(self._offset)
            while line := stream.readline(MAX_LINE_BYTES + 1):
                whole = line.endswith(b"\n")
                if not whole and self._live and len(line) <= MAX_LINE_BYTES:
                    break  # incomplete
                self._offset += len(line)
                self._lines += whole
                self._take(line, batch)
        return batch

    def _was_replaced(self) -> bool:
        found = self._path.stat()
        file = found.st_dev, found.st_ino
        replaced = self._file != (0, 0) and (file != self._file or found.st_size < self._offset)
        if replaced:
            self._reset()
        self._file = file
        return replaced

    def _take(self, line: bytes, batch: Batch) -> None:
        try:
            if len(line) > MAX_LINE_BYTES:
                raise FlightError(f"more than {MAX_LINE_BYTES} bytes")
            text = line.decode("utf-8").strip()
            if is_health(text):
                self._health += 1
                if self._health <= MAX_HEALTH:
                    batch.health.append((self._views, checked_health(from_json(line))))
            elif text:
                batch.results.append(result_from_json(text))
                self._views += 1
        except (FlightError, UnicodeDecodeError) as error:
            self._broken += 1
            if self._broken == 1:
                batch.problems.append(f"line {self._lines} was skipped ({error}): {self._path}")
        if self._views > MAX_VIEWS:
            raise FlightError(f"more than {MAX_VIEWS} views: {self._path}")


def checked_health(plain: dict[str, Any]) -> dict[str, Any]:
    level, reasons = plain.get("health"), plain.get("reasons")
    if not isinstance(level, str):
        raise FlightError("health has no level")
    known: dict[str, Any] = {
        "level": level[:20],
        "reasons": [str(each)[:40] for each in reasons[:20]] if isinstance(reasons, list) else [],
    }
    for name in ("utc_s", "age_p50_ms", "age_p95_ms"):
        value = plain.get(name)
        if isinstance(value, int | float) and not isinstance(value, bool) and abs(value) < 1e12:
            known[name] = value
    for name in ("counts", "sent", "withheld", "log_lost"):
        value = plain.get(name)
        if isinstance(value, dict):
            known[name] = {str(k)[:40]: v for k, v in value.items() if isinstance(v, int)}
    return known


class LogReader:
    """Results, health and images of one flight log. Safe to share between threads."""

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
            if not self._files or (self._live and time.monotonic() - self._scanned_s >= RESCAN_S):
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
        self._scanned_s = time.monotonic()
        names, cut = set(_candidates(self._path)), any(_was_cut(file) for file in self._files)
        if self._files and names == self._names and not cut:
            return
        found = _files_of(self._path, live=self._live)
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
        if topic == TOPICS.telemetry.name:
            view = self._content.views[-1]
            self._views.setdefault(view.frame, view)
        elif topic == TOPICS.session.name:
            self.camera = camera_of(self.session["camera"])
            options = self.session.get("options")
            self.mount = logged_mount(options if isinstance(options, dict) else {})
        elif topic == TOPICS.result.name:
            batch.results.append(logged_result(data))
            self._results += 1
            if self._results > MAX_VIEWS:
                raise BrokenLogError(f"flight log holds more than {MAX_VIEWS} results")
        elif topic == TOPICS.health.name:
            self._health += 1
            if self._health <= MAX_HEALTH:
                batch.health.append((self._results, checked_health(from_json(data))))


def _files_of(path: Path, *, live: bool) -> list[Path]:
    """The files of the flight that `path` names, in order; see `LogReader`.

    Raises `MissingFileError` or `FlightError` where there is none, unless `live`.
    """
    if path.is_file() or (path.is_dir() and not live):
        found = files_of_run(path)
        if not found:
            raise FlightError(f"no complete chunk of a flight log in this folder: {path}")
        return found
    runs = {file: run_of(file) for file in _candidates(path) if is_flight_log(file)}
    named = sorted((file for file in runs if runs[file]), key=lambda file: file.stat().st_mtime)
    if not named and not live:
        raise MissingFileError(f"flight log does not exist: {path}")
    ours = [file for file in named if runs[file] == runs[named[-1]]]
    if len(ours) < len(named) and not live:
        names = ", ".join(file.name for file in named[:5])
        raise FlightError(f"several flights have this name; name a file ({names}): {path}")
    return sorted(ours, key=lambda file: (len(file.name), file.name))


def _candidates(path: Path) -> Iterator[Path]:
    if path.is_dir():
        return path.glob("*.mcap")
    pattern = "*.mcap" if path.is_file() else f"{path.stem}_*.mcap"
    return path.parent.glob(pattern)


def _was_cut(file: McapFile) -> bool:
    """Whether another flight has written a file of this name."""
    try:
        return file.path.stat().st_size < file.next_offset and not file.ended
    except OSError:
        return False  # deleted to make room
