"""Views of a flight with their truth. Measured processes import this: flight code only."""

import csv
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from orthonav.core.files import replacing
from orthonav.core.flight import open_flight, read_truth
from orthonav.core.flight.folder import read_image
from orthonav.core.geo.camera import Camera
from orthonav.core.records import View


@dataclass(frozen=True, eq=False)
class FlownView:
    """A view of a flight, the file of its picture, and where it was taken."""

    path: Path
    view: View
    truth_latlon_deg: tuple[float, float]


@dataclass(frozen=True, eq=False)
class Flight:
    """Views of one camera."""

    folder: Path
    camera: Camera
    views: tuple[FlownView, ...]


def read_views(folder: Path) -> tuple[Camera, Iterator[FlownView]]:
    """The camera of a flight folder and its views, each read on demand."""
    recorded = open_flight(folder)
    truth = read_truth(folder / "truth.csv")
    views = (
        FlownView(
            each.path,
            View(read_image(each.path), recorded.camera, each.telemetry),
            truth[each.frame],
        )
        for each in recorded.views
    )
    return recorded.camera, views


def read_rows(path: Path) -> list[dict[str, str]]:
    """Rows of a table with a header, as text."""
    with path.open(encoding="utf-8", newline="") as stream:
        return list(csv.DictReader(stream))


def write_rows(path: Path, rows: Sequence[dict[str, str]]) -> None:
    """Write what `read_rows` reads."""
    with replacing(path) as temporary, temporary.open("w", encoding="utf-8", newline="") as stream:
        writer = csv.DictWriter(stream, list(rows[0]), lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)
