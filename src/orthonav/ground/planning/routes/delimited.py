"""Routes as tables: CSV with comma, semicolon or tab, one waypoint a row."""

import io
import re
from collections.abc import Callable
from functools import partial
from typing import Any

from orthonav.core.errors import RouteError
from orthonav.core.tables import MAX_LINE_CHARS, TableError, TableRows
from orthonav.ground.planning.routes.record import (
    Height,
    HeightFrame,
    Route,
    decoded,
    parsed,
    require_few_waypoints,
)

_LAT = ("lat_deg", "lat", "latitude", "latitude_deg")
_LON = ("lon_deg", "lon", "lng", "long", "longitude", "longitude_deg")
_HEIGHTS: tuple[tuple[HeightFrame | None, tuple[str, ...]], ...] = (
    ("agl", ("agl_m", "agl", "altitude_agl_m", "altitudeagl")),
    ("home", ("home_m", "height_above_home_m")),
    ("amsl", ("amsl_m", "amsl", "altitude_amsl_m", "altitudeamsl")),
    ("hae", ("hae_m",)),
    (None, ("alt_m", "alt", "altitude_m", "altitude", "height_m", "height", "ele")),
)
_BAND = ("band_m",)
_MODE = ("altitudemode", "altitude_mode")  # column of Litchi
_FRAME_OF_MODE: dict[float, HeightFrame] = {0: "home", 1: "agl"}
_UNIT = re.compile(r"\s*[(\[]\s*([a-z]+)\.?\s*[)\]]$")  # as in altitude(m)
_METRES = {"m": 1.0, "meter": 1.0, "meters": 1.0, "ft": 0.3048, "feet": 0.3048}
_Values = Callable[..., list[float | None]]


def read_delimited(data: bytes) -> list[Route]:
    stream = io.StringIO(decoded(data), newline=None)
    header = stream.readline(MAX_LINE_CHARS)
    stream.seek(0)
    delimiter = max(",;\t", key=header.count)
    try:
        table = TableRows(stream, delimiter=delimiter)
        names = {_UNIT.sub("", name.strip().lower()): name for name in table.columns}
        rows = []
        for row in table:
            rows.append(row)
            require_few_waypoints(len(rows))
    except TableError as error:
        raise RouteError(f"route table cannot be read ({error})") from error
    lat, lon = _column(names, _LAT), _column(names, _LON)
    if lat is None or lon is None:
        raise RouteError(
            "route CSV needs the columns lat_deg,lon_deg (or lat,lon or latitude,longitude), got "
            f"{','.join(names) or 'none'!s:.80}"
        )
    values = partial(_values, rows, delimiter != ",")  # then commas in numbers are decimal commas
    lats, lons = values(lat, needed=True), values(lon, needed=True)
    waypoints = tuple((float(a or 0), float(b or 0)) for a, b in zip(lats, lons, strict=True))
    band = _column(names, _BAND)
    bands = [] if band is None else values(band)
    return [Route(waypoints, _heights(names, values), tuple(bands[:-1] if bands[1:] else bands))]


def _heights(names: dict[str, Any], values: _Values) -> tuple[Height | None, ...]:
    for frame, aliases in _HEIGHTS:
        column = _column(names, aliases)
        if column is not None:
            factor, heights = _metres_of(str(column)), values(column)
            frames = _frames(names, values) if frame is None else [frame] * len(heights)
            return tuple(
                None if height is None else Height(factor * height, each)
                for height, each in zip(heights, frames or [None] * len(heights), strict=True)
            )
    return ()


def _metres_of(column: str) -> float:
    """Metres of the unit in the name of a column of heights, which are metres without one."""
    unit = _UNIT.search(column.strip().lower())
    if unit is not None and unit[1] not in _METRES:
        raise RouteError(f"heights must be in m or ft, got the column {column!r:.60}")
    return 1.0 if unit is None else _METRES[unit[1]]


def _frames(names: dict[str, Any], values: _Values) -> list[HeightFrame | None]:
    """Reference of each height by its altitude mode; empty without such a column."""
    column = _column(names, _MODE)
    modes = [] if column is None else values(column)
    for line, mode in enumerate(modes, 2):
        if mode is not None and mode not in _FRAME_OF_MODE:
            raise RouteError(
                f"row {line}, {column}: must be 0 (above take-off) or 1 (above ground), got "
                f"{mode:g}"
            )
    return [None if mode is None else _FRAME_OF_MODE[mode] for mode in modes]


def _column(names: dict[str, Any], aliases: tuple[str, ...]) -> Any:
    return next((names[alias] for alias in aliases if alias in names), None)


def _values(
    rows: list[dict[str, Any]], comma: bool, column: Any, needed: bool = False
) -> list[float | None]:
    """The numbers of a column; None where there is none, unless it is needed."""
    found = []
    for line, row in enumerate(rows, 2):
        text = row.get(column) or ""
        if comma and "." not in text:
            text = text.replace(",", ".")
        what = f"route table cannot be read: row {line}, {column}"
        found.append(parsed(text, what) if needed or text.strip() else None)
    return found
