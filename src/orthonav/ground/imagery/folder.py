"""Selection of the orthophotos in a folder as producers deliver it."""

import logging
import re
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

from orthonav.core.errors import ImageryError, MissingFileError
from orthonav.ground.imagery.source import Source, open_sources

log = logging.getLogger(__name__)

RASTERS = {".tif", ".tiff", ".jp2", ".j2k", ".vrt", ".mbtiles", ".gpkg", ".img"}
PICTURES = {".png", ".jpg", ".jpeg", ".webp"}
"""Orthophotos only with a world file or GDAL's sidecar."""
CLOSED = {".ecw": "ECW", ".sid": "MrSID"}
_ARCHIVE = re.compile(r"\.(?:7z|zip|tar|gz|tgz|rar)(?:\.\d{3})?$", re.IGNORECASE)
_SMALL_PICTURE = re.compile(
    r"(?:^|[-_. ])(?:thumb(?:nail)?|quicklook|preview|browse|overview|assemblage|mask|msk|alpha)s?"
    r"(?:[-_. ]|$)",
    re.IGNORECASE,
)
_ARCHIVES = "archives"
_UNFIT = "rasters that are not orthophotos (heights, too small, or not georeferenced)"
MAX_FILES = 1_000_000
NAMED = 5


def sources_in(folder: Path) -> list[Source]:
    """The orthophotos of a folder, newest first, then the finest; other files are logged."""
    files, skipped = _orthophotos_in(folder)
    sources, unfit = open_sources(files, folder)
    skipped |= {_UNFIT: len(unfit)} if unfit else {}
    if not sources:
        raise _nothing(folder, skipped)
    for reason in unfit[:NAMED]:
        log.warning("skipped: %s", reason)
    if _ARCHIVES in skipped:
        log.warning("archives in the folder are not read; unpack them first: %s", folder)
    if skipped:
        log.info("%d orthophotos; skipped %s: %s", len(sources), _summary(skipped), folder)
    return sorted(sources, key=_preference)


def _orthophotos_in(folder: Path) -> tuple[list[Path], dict[str, int]]:
    """Files that may be orthophotos by their names, and the number of skipped ones by reason."""
    files: list[Path] = []
    skipped: Counter[str] = Counter()
    for path in _files(folder):
        reason = _why_not(path)
        if reason is None:
            files.append(path)
        elif reason:
            skipped[reason] += 1
    virtual = {path for path in files if path.suffix.lower() == ".vrt"}
    if virtual and len(virtual) < len(files):
        files = [path for path in files if path not in virtual]
        skipped["virtual rasters (.vrt), because their files are there"] += len(virtual)
    if not files:
        raise _nothing(folder, skipped)
    return sorted(files), dict(skipped)


def _summary(skipped: dict[str, int]) -> str:
    return "; ".join(f"{count} {reason}" for reason, count in sorted(skipped.items()))


def _files(folder: Path) -> Iterator[Path]:
    if not folder.is_dir():
        raise MissingFileError(f"folder of orthophotos does not exist: {folder}")
    for count, path in enumerate(folder.rglob("*")):
        if count > MAX_FILES:
            raise ImageryError(f"more than {MAX_FILES} files; choose a smaller folder: {folder}")
        if path.is_file() and not path.name.startswith("."):
            yield path


def _why_not(path: Path) -> str | None:
    """None where a file may be an orthophoto, "" for a sidecar."""
    suffix = path.suffix.lower()
    if suffix in CLOSED:
        return f"{CLOSED[suffix]} files, which GDAL as installed cannot read"
    if _ARCHIVE.search(path.name):
        return _ARCHIVES
    if suffix not in RASTERS | PICTURES:
        return ""
    if _SMALL_PICTURE.search(path.stem):
        return "thumbnails, overviews or masks, by their names"
    if suffix in PICTURES and not _has_sidecar(path):
        return "images without a world file"
    return None


def _has_sidecar(path: Path) -> bool:
    suffix = path.suffix
    short = f".{suffix[1]}{suffix[-1]}w"  # .jgw, .pgw
    names = [path.with_suffix(short), path.with_suffix(".wld"), path.with_suffix(".tab")]
    names += [path.with_name(path.name + ending) for ending in ("w", ".aux.xml")]
    return any(name.is_file() for name in names)


def _nothing(folder: Path, skipped: dict[str, int]) -> ImageryError:
    archives = sorted(path for path in _files(folder) if _ARCHIVE.search(path.name))
    if archives:
        first = archives[0]
        zipped = first.suffix.lower() == ".zip"
        how = f"unzip '{first}' -d '{folder}'" if zipped else f"7z x '{first}' -o'{folder}'"
        return ImageryError(
            f"folder holds archives ({len(archives)} files) but no orthophotos; unpack them first: "
            f"{how}"
        )
    counted = Counter(path.suffix.lower() or path.name for path in _files(folder))
    named = [f"{count} {suffix}" for suffix, count in counted.most_common(NAMED)]
    seen = _summary(skipped) or ", ".join(named) or "nothing, it is empty"
    return ImageryError(f"folder holds no usable orthophotos; seen: {seen}: {folder}")


def _preference(source: Source) -> tuple[object, ...]:
    date = tuple(-int(part) for part in (source.date or "0").split("-"))
    return date, round(source.gsd_m, 3), source.crs, source.dtype, source.colours, str(source.path)
