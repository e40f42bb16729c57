"""What comes out of a flight, read from a file that may still be growing."""

import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

from orthonav.errors import FlightError
from orthonav.files import require_file
from orthonav.flight.fixes import result_from_json
from orthonav.records import ViewResult

MAX_LINE_BYTES = 2**20
MAX_VIEWS = 500_000
"""Ten a second for 14 hours."""
MAX_HEALTH = 200_000


@dataclass
class Batch:
    """What is new: results in order, and health with the number of results that came before it.

    `restarted`: what was told before is void, the file was begun anew. `problems`: what people
    should know.
    """

    results: list[ViewResult] = field(default_factory=list)
    health: list[tuple[int, dict[str, Any]]] = field(default_factory=list)
    restarted: bool = False
    problems: list[str] = field(default_factory=list)


class Feed(Protocol):
    """Where results come from."""

    def poll(self) -> Batch:
        """What came since the last time. Raises `OrthonavError` or `OSError`."""
        ...


class LineFeed:
    """`fixes.jsonl`, or what `orthonav fly --jsonl` writes: results, and health between them.

    Lines that are neither are passed over and told of: a flight log of a disk that was full is
    better than none. With `live` the file may not be there yet, and its last line may not be whole.
    """

    def __init__(self, path: Path, *, live: bool = False) -> None:
        self._path, self._live = path, live
        self._begin()

    def _begin(self) -> None:
        self._offset, self._file, self._lines, self._views = 0, (0, 0), 0, 0
        self._health, self._broken = 0, 0

    def poll(self) -> Batch:
        """See `Feed.poll`."""
        batch = Batch()
        if self._live and not self._path.exists():
            return batch
        with require_file(self._path, "file of fixes").open("rb") as stream:
            batch.restarted = self._begun_anew()
            stream.seek(self._offset)
            while line := stream.readline(MAX_LINE_BYTES + 1):
                whole = line.endswith(b"\n")
                if not whole and self._live and len(line) <= MAX_LINE_BYTES:
                    break  # the rest of it is still to come
                self._offset += len(line)
                self._lines += whole
                self._take(line, batch)
        return batch

    def _begun_anew(self) -> bool:
        """Whether the file is another one than before, or was cut."""
        found = self._path.stat()
        file = found.st_dev, found.st_ino
        anew = self._file != (0, 0) and (file != self._file or found.st_size < self._offset)
        if anew:
            self._begin()
        self._file = file
        return anew

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
                batch.problems.append(f"line {self._lines} is left out ({error}): {self._path}")
            return
        self._views += 1
        if self._views > MAX_VIEWS:
            raise FlightError(f"more than {MAX_VIEWS} views: {self._path}")
        batch.results.append(result)


def _health_of(text: str) -> dict[str, Any] | None:
    """The health that a line tells, None where it is a result or nothing."""
    if not text.startswith('{"health"'):
        return None
    try:
        plain = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise FlightError(f"not JSON ({error})") from error
    return checked_health(plain)


def checked_health(plain: Any) -> dict[str, Any]:
    """Health as the page shows it: its level, reasons, time and counts; raises `FlightError`."""
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
