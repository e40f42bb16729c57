"""What fixes were computed from: digests of the map and of the flight, in their first line.

They are keys that readers of `fixes.jsonl` skip, so the file stays one view per line. A file
without them is of an unknown run.
"""

import hashlib
import json
from collections.abc import Iterable, Iterator
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import Any, TypeVar

from orthonav.core.files import require_file
from orthonav.core.flight.recording import RecordedView

FIRST_BYTES = 2**16
"""Longest first line that is read."""
View = TypeVar("View", bound=RecordedView)


@dataclass(frozen=True)
class Identity:
    """SHA-256 (hex) of the map and of the flight of a run; None where unknown."""

    map_sha256: str | None = None
    flight_sha256: str | None = None

    def added_to(self, line: str) -> str:
        """A line of JSON with the digests that are known at its end."""
        known = {name: value for name, value in asdict(self).items() if value is not None}
        return line[:-1] + ", " + json.dumps(known)[1:] if known else line

    def differences(self, other: "Identity", map_path: Path | None, flight: Path | None) -> str:
        """What is known of both and differs: the map or the flight at these paths; else ""."""
        pairs = (
            ("map", map_path, self.map_sha256, other.map_sha256),
            ("flight", flight, self.flight_sha256, other.flight_sha256),
        )
        return " and ".join(
            f"another {kind} ({own[:8]}) than {path} ({its[:8]})"
            for kind, path, own, its in pairs
            if own and its and own != its
        )


@dataclass
class FlightDigest:
    """SHA-256 of names, times and reported headings of the views of a flight, in order.

    The digest of a recording and of the flight folder that it was imported to is the same unless
    views were left out or renamed.
    """

    _sum: Any = field(default_factory=hashlib.sha256)

    def watching(self, views: Iterable[View]) -> Iterator[View]:
        """The same views, which are counted as they pass."""
        for view in views:
            telemetry = view.telemetry
            text = f"{view.frame}\t{telemetry.time_ns}\t{telemetry.yaw_deg:.6f}\n"
            self._sum.update(text.encode("utf-8", "surrogateescape"))
            yield view

    @property
    def sha256(self) -> str:
        """The digest (hex) of the views that have passed."""
        return str(self._sum.hexdigest())


def flight_digest(views: Iterable[RecordedView]) -> str:
    """SHA-256 (hex) of a flight with these views."""
    digest = FlightDigest()
    for _ in digest.watching(views):
        pass
    return digest.sha256


def read_identity(path: Path) -> Identity:
    """What the first line of a file of fixes states; raises `MissingFileError`."""
    with require_file(path, "file of fixes").open("rb") as stream:
        for raw in iter(lambda: stream.readline(FIRST_BYTES), b""):
            try:
                plain = json.loads(raw)
            except (ValueError, RecursionError):
                return Identity()
            if isinstance(plain, dict) and "frame" in plain:
                stated = (plain.get(each.name) for each in fields(Identity))
                return Identity(*(each if isinstance(each, str) else None for each in stated))
    return Identity()
