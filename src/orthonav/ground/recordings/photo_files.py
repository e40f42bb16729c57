"""Which photographs a source names: those of a folder, of a table of images, or single files."""

import logging
import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from orthonav.core.errors import FlightError
from orthonav.core.files import require_file
from orthonav.core.flight.source_options import SourceOptions
from orthonav.ground.recordings.image_table import ImageTable, is_image_table, read_image_table

log = logging.getLogger(__name__)

SUFFIXES = (".jpg", ".jpeg", ".png", ".tif", ".tiff")
_MAGICS = (b"\xff\xd8\xff", b"\x89PNG\r\n\x1a\n", b"II*\0", b"MM\0*")


def photo_paths(folder: Path) -> list[Path]:
    """Photographs below a folder, hidden ones left out, by name."""
    found = folder.rglob("*")
    return sorted(
        path
        for path in found
        if path.suffix.lower() in SUFFIXES
        and not any(part.startswith(".") for part in path.relative_to(folder).parts)
    )


def is_photo(path: Path) -> bool:
    """Whether a file begins as an image does."""
    with path.open("rb") as stream:
        return stream.read(8).startswith(_MAGICS)


@dataclass(frozen=True)
class ChosenPhotos:
    """The images of a source: below `folder`, with the table that describes them, if any.

    `singly`: whether they were named one by one, by the user or by the table. Then they need no
    time, and a camera that looks straight down is assumed where nothing else is known.
    """

    folder: Path
    paths: Sequence[Path]
    table: ImageTable | None
    singly: bool

    @classmethod
    def of(cls, sources: Sequence[Path], options: SourceOptions) -> "ChosenPhotos":
        """The images of a folder, of a table in it, or those named."""
        first, telemetry = sources[0], options.telemetry
        table = None
        if telemetry is not None and is_image_table(require_file(telemetry, "telemetry log")):
            table = read_image_table(telemetry)
        if len(sources) == 1 and first.is_dir():
            paths = photo_paths(first)
            if table is None and telemetry is None:
                table = image_table_in(first, paths)
            return cls(first, paths, table, table is not None)
        if len(sources) == 1 and is_image_table(first):
            return cls(first.parent, photo_paths(first.parent), read_image_table(first), True)
        for path in sources:
            if not is_photo(require_file(path, "photograph")):
                raise FlightError(f"expected photographs, where several files are given: {path}")
        folder = Path(os.path.commonpath([path.resolve().parent for path in sources]))
        return cls(folder, [path.resolve() for path in sources], table, True)


def image_table_in(folder: Path, photos: Sequence[Path]) -> ImageTable | None:
    """The table that lies in a folder and names some of these photographs below it.

    Raises `FlightError` where there are several.
    """
    names = [path.relative_to(folder).as_posix() for path in photos]
    found = []
    for path in sorted(path for path in folder.iterdir() if is_image_table(path)):
        table = read_image_table(path)
        if any(table.row(name) for name in names):
            found.append(table)
        else:
            log.warning("table that names none of the photographs is not used: %s", path)
    if len(found) > 1:
        several = ", ".join(table.path.name for table in found[:5])
        raise FlightError(
            f"folder has several tables of images ({several}); give one by --telemetry: {folder}"
        )
    return found[0] if found else None
