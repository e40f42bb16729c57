"""Routes as tables: CSV with comma, semicolon or tab, one waypoint a row."""

import io
import re
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
    comma = delimiter != ","  # then a comma in a number is a decimal comma
    points = [
        tuple(_number(row, column, number, comma) for column in (lat, lon))
        for number, row in enumerate(rows, 2)
    ]
    return [
        Route(
            tuple((lat_deg, lon_deg) for lat_deg, lon_deg in points),
            _heights(names, rows, comma),
            _bands_m(names, rows, comma),
        )
    ]


def _heights(
    names: dict[str, Any], rows: list[dict[str, Any]], comma: bool
) -> tuple[Height | None, ...]:
    for frame, aliases in _HEIGHTS:
        column = _column(names, aliases)
        if column is not None:
            factor = _metres_of(str(column))
            frames = _frames(names, rows, comma) if frame is None else [frame] * len(rows)
            found = [_optional(row, column, line, comma) for line, row in enumerate(rows, 2)]
            heights = tuple(
                None if value is None else Height(factor * value, each)
                for value, each in zip(found, frames, strict=True)
            )
            return heights
    return ()


def _metres_of(column: str) -> float:
    """Metres of the unit in the name of a column of heights, which are metres without one."""
    unit = _UNIT.search(column.strip().lower())
    if unit is not None and unit[1] not in _METRES:
        raise RouteError(f"heights must be in m or ft, got the column {column!r:.60}")
    return 1.0 if unit is None else _METRES[unit[1]]


def _frames(
    names: dict[str, Any], rows: list[dict[str, Any]], comma: bool
) -> list[HeightFrame | None]:
    column = _column(names, _MODE)
    if column is None:
        return [None] * len(rows)
    modes = [_optional(row, column, line, comma) for line, row in enumerate(rows, 2)]
    for line, mode in enumerate(modes, 2):
        if mode is not None and mode not in _FRAME_OF_MODE:
            raise RouteError(
                f"row {line}, {column}: must be 0 (above take-off) or 1 (above ground), got "
                f"{mode:g}"
            )
    return [None if mode is None else _FRAME_OF_MODE[mode] for mode in modes]


def _bands_m(
    names: dict[str, Any], rows: list[dict[str, Any]], comma: bool
) -> tuple[float | None, ...]:
    column = _column(names, _BAND)
    if column is None:
        return ()
    bands = [_optional(row, column, line, comma) for line, row in enumerate(rows, 2)]
    return tuple(bands[:-1] if len(bands) > 1 else bands)


def _column(names: dict[str, Any], aliases: tuple[str, ...]) -> Any:
    return next((names[alias] for alias in aliases if alias in names), None)


def _optional(row: dict[str, Any], column: Any, line: int, comma: bool) -> float | None:
    if not (row.get(column) or "").strip():
        return None
    return _number(row, column, line, comma)


def _number(row: dict[str, Any], column: Any, line: int, comma: bool) -> float:
    text = row.get(column) or ""
    if comma and "." not in text:
        text = text.replace(",", ".")
    return parsed(text, f"route table cannot be read: row {line}, {column}")
