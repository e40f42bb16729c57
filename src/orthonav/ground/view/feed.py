"""Results and health of a flight, read from a file that may still grow, and images of its views."""

import json
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from orthonav.core.errors import FlightError
from orthonav.core.files import require_file
from orthonav.core.flight import open_flight
from orthonav.core.flight.fixes import is_health, result_from_json
from orthonav.core.geo.camera import Camera
from orthonav.core.records import Telemetry, ViewResult

MAX_LINE_BYTES = 2**20
MAX_VIEWS = 500_000
"""Ten per second for 14 hours."""
MAX_HEALTH = 200_000


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


class Feed(Protocol):
    def poll(self) -> Batch:
        """What is new since the last call. Raises `OrthonavError` or `OSError`."""
        ...


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
            text = line.decode("utf-8").strip()
            if not text:
                return
            if len(line) > MAX_LINE_BYTES:
                raise FlightError(f"more than {MAX_LINE_BYTES} bytes")
            health = _health_of(text)
            if health is not None:
                self._health += 1
                if self._health <= MAX_HEALTH:
                    batch.health.append((self._views, health))
                return
            result = result_from_json(text)
        except (FlightError, UnicodeDecodeError) as error:
            self._broken += 1
            if self._broken == 1:
                batch.problems.append(f"line {self._lines} was skipped ({error}): {self._path}")
            return
        self._views += 1
        if self._views > MAX_VIEWS:
            raise FlightError(f"more than {MAX_VIEWS} views: {self._path}")
        batch.results.append(result)


def _health_of(text: str) -> dict[str, Any] | None:
    if not is_health(text):
        return None
    try:
        plain = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise FlightError(f"not JSON ({error})") from error
    return checked_health(plain)


def checked_health(plain: Any) -> dict[str, Any]:
    level = plain.get("health") if isinstance(plain, dict) else None
    if not isinstance(level, str):
        raise FlightError("health has no level")
    reasons = plain.get("reasons")
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


@dataclass(frozen=True, eq=False)
class Shot:
    """One recorded view; `load` returns the image (H, W), or raises `FlightError`."""

    telemetry: Telemetry
    camera: Camera
    load: Callable[[], NDArray[np.uint8]]


class ViewImages(Protocol):
    def shot(self, frame: str) -> Shot:
        """The view `frame`; raises `FlightError` with the reason where it has no image."""
        ...


class NoImages:
    def shot(self, frame: str) -> Shot:
        raise FlightError("there are no images; name the flight with --flight")


class FolderImages:
    def __init__(self, path: Path) -> None:
        self.folder = open_flight(path, images_needed=False)
        self._views = {view.frame: view for view in self.folder.views}

    def shot(self, frame: str) -> Shot:
        view = self._views.get(frame)
        if view is None:
            raise FlightError("this view is not in the flight")
        return Shot(view.telemetry, self.folder.camera, view.grey)
