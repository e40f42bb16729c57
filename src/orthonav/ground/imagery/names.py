"""Date, coordinate system and georeference from names and sidecars of rasters without them."""

import re
from collections.abc import Iterable
from pathlib import Path

import numpy as np

_TAGS = ("TIFFTAG_DATETIME", "ACQUISITION_DATE", "ACQUISITIONDATE", "DATE")
_DATE = re.compile(  # not 2000x2000, nor 2000px
    r"(?<!\d)(?<!\dx)(19\d\d|20[0-3]\d)"
    r"(?:[-_]?(0[1-9]|1[0-2])(?:[-_]?(0[1-9]|[12]\d|3[01]))?)?"
    r"(?![\dx]|[-_ ]?px)",
    re.IGNORECASE,
)
_IGN_SYSTEMS = {
    "LAMB93": "EPSG:2154",
    "LA93": "EPSG:2154",
    "RGAF09UTM20": "EPSG:5490",
    "UTM22RGFG95": "EPSG:2972",
    "RGR92UTM40S": "EPSG:2975",
    "RGM04UTM38S": "EPSG:4471",
    "RGSPM06U21": "EPSG:4467",
}
"""Coordinate systems in the names of packages, folders and tiles of IGN (France)."""
_IGN_SYSTEM = re.compile(rf"(?<![A-Za-z0-9])({'|'.join(_IGN_SYSTEMS)})(?![A-Za-z0-9])")
_IGN_TILE = re.compile(r"^[0-9][0-9AB]{1,2}-((?:19|20)\d\d)-\d{4}-\d{4}-")
"""A tile of BD ORTHO: department, year, kilometres east and north, and more."""
_IGN_PACKAGE = re.compile(r"_D\d?\d[0-9AB](?:_|-)((?:19|20)\d\d)(?![0-9])")
_TAB_POINT = re.compile(
    r"\(\s*([-+.\deE]+)\s*,\s*([-+.\deE]+)\s*\)\s*\(\s*([-+.\deE]+)\s*,\s*([-+.\deE]+)\s*\)"
)
_MAX_TAB_BYTES = 100_000
MAX_OFF_PX = 0.2
"""Largest residual of a sidecar's control points for them to be a geotransform."""


def date_of(tags: dict[str, str], names: Iterable[str]) -> str | None:
    """Date of acquisition as YYYY[-MM[-DD]]: from tags, else from the first name that has one.

    `names` are the file's, without suffix, and those of folders above it. From IGN's names only
    the year: the day in them is that of the edition, and kilometres follow the year of a tile.
    """
    for tag in _TAGS:
        found = _DATE.search(str(tags[tag]).replace(":", "-")) if tag in tags else None
        if found:
            return "-".join(part for part in found.groups() if part)
    for name in names:
        years = _IGN_TILE.search(name) or _IGN_PACKAGE.search(name)
        if years:
            return years.group(1)
        found = _DATE.search(name)
        if found:
            return "-".join(part for part in found.groups() if part)
    return None


def system_of(names: Iterable[str]) -> str | None:
    """EPSG code of a coordinate system in IGN's names of files and folders, such as LAMB93."""
    for name in names:
        found = _IGN_SYSTEM.search(name)
        if found:
            return _IGN_SYSTEMS[found.group(1)]
    return None


def tab_transform(path: Path) -> tuple[float, ...] | None:
    """Geotransform a..f of MapInfo's sidecar `NAME.tab`; None where there is no usable one.

    GDAL reads them for TIFF, but not for JPEG 2000.
    """
    for sidecar in (path.with_suffix(".tab"), path.with_suffix(".TAB")):
        if sidecar.is_file() and sidecar.stat().st_size <= _MAX_TAB_BYTES:
            return _affine(_TAB_POINT.findall(sidecar.read_text("latin-1")))
    return None


def _affine(points: list[tuple[str, str, str, str]]) -> tuple[float, ...] | None:
    """Least squares of control points x, y, column, row; None where they are not affine."""
    try:
        x, y, col, row = np.array(points, dtype=np.float64).reshape(-1, 4).T
    except ValueError:
        return None
    base = np.stack([col, row, np.ones_like(col)], axis=1)
    if len(points) < 3 or np.linalg.matrix_rank(base) < 3:
        return None
    solved = np.linalg.lstsq(base, np.stack([x, y], axis=1), rcond=None)[0]
    off = np.abs(base @ solved - np.stack([x, y], axis=1)).max()
    if off > MAX_OFF_PX * np.hypot(*solved[0]):
        return None
    return tuple(solved.T.ravel().tolist())
