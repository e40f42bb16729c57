"""What fixes were computed from: digests of the map and of the flight, in their first line.

They are keys that readers of `fixes.jsonl` skip, so the file stays one view per line. A file
without them is of an unknown run.
"""

import hashlib
import json
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

from orthonav.files import require_file
from orthonav.flight.recording import RecordedView

FIRST_BYTES = 2**16
"""Longest first line that is read."""
View = TypeVar("View", bound=RecordedView)


@dataclass(frozen=True)
class Source:
    """A map or a flight: its name, for messages, and its SHA-256 (hex)."""

    name: str
    sha256: str


@dataclass(frozen=True)
class Identity:
    """The map and the flight of a run; None where unknown."""

    map: Source | None = None
    flight: Source | None = None

    def added_to(self, line: str) -> str:
        """A line of JSON with the keys `map` and `flight`, those that are known, at its end."""
        known = {
            name: {"name": each.name, "sha256": each.sha256}
            for name, each in (("map", self.map), ("flight", self.flight))
            if each is not None
        }
        return line[:-1] + ", " + json.dumps(known)[1:] if known else line

    def differences(self, other: "Identity") -> list[str]:
        """What is known of both and differs, as `map area.onav (1a2b3c4d), not ...`."""
        pairs = (("map", self.map, other.map), ("flight", self.flight, other.flight))
        return [
            f"{kind} {own.name:.80} ({own.sha256[:8]}), not {its.name:.80} ({its.sha256[:8]})"
            for kind, own, its in pairs
            if own is not None and its is not None and own.sha256 != its.sha256
        ]


@dataclass
class FlightDigest:
    """SHA-256 of names, times and reported headings of the views of a flight, in order.

    The digest of a recording and of the flight folder that it was imported to is the same.
    """

    _sum: Any = field(default_factory=hashlib.sha256)

    def watching(self, views: Iterable[View]) -> Iterator[View]:
        """The same views, which are counted as they pass."""
        for view in views:
            telemetry = view.telemetry
            text = f"{view.frame}\t{telemetry.time_ns}\t{telemetry.yaw_deg:.6f}\n"
            self._sum.update(text.encode("utf-8", "surrogateescape"))
            yield view

    def source(self, path: Path) -> Source:
        """The flight at `path`, once all of its views have passed."""
        return Source(Path(path).resolve().name, self._sum.hexdigest())


def flight_source(path: Path, views: Iterable[RecordedView]) -> Source:
    """The flight at `path` with these views."""
    digest = FlightDigest()
    for _ in digest.watching(views):
        pass
    return digest.source(path)


def read_identity(path: Path) -> Identity:
    """What the first line of a file of fixes states; raises `MissingFileError`."""
    with require_file(path, "file of fixes").open("rb") as stream:
        for raw in iter(lambda: stream.readline(FIRST_BYTES), b""):
            try:
                plain = json.loads(raw)
            except (ValueError, RecursionError):
                return Identity()
            if isinstance(plain, dict) and "frame" in plain:
                return Identity(_source(plain.get("map")), _source(plain.get("flight")))
    return Identity()


def _source(plain: Any) -> Source | None:
    known = isinstance(plain, dict) and all(
        isinstance(plain.get(key), str) for key in ("name", "sha256")
    )
    return Source(plain["name"], plain["sha256"]) if known else None
