"""Ground that changed since a map was made: cells with scores, written and read as one GeoJSON.

Every cell that the flight showed is a square with the properties `row`, `col`, `score`, `views` and
`changed`; members beside `features` hold the grid, so that `orthonav check` reads the same file.
"""

import json
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from orthonav.core.errors import FlightError, OrthonavError, described
from orthonav.core.files import require_file, write_text
from orthonav.core.geo.frames import LocalFrame
from orthonav.core.mapfile.manifest import SheetInfo

FORMAT, VERSION = "orthonav-changes", 1
MAX_CELLS = 1_000_000
MAX_BYTES = 400_000_000
"""Limit of a file: about 350 bytes for each of so many cells."""
_CORNERS = np.array([(0, 0), (0, 1), (1, 1), (1, 0), (0, 0)])

Array = NDArray[np.float64]


@dataclass(frozen=True)
class CellGrid:
    """Square cells of `side_m` from a north-west corner, row 0 in the north."""

    west_m: float
    north_m: float
    side_m: float
    rows: int
    cols: int

    @classmethod
    def over(cls, extent: tuple[float, float, float, float], side_m: float) -> "CellGrid":
        west, south, east, north = extent
        rows, cols = (max(1, math.ceil(d / side_m - 1e-9)) for d in (north - south, east - west))
        return cls(west, north, side_m, rows, cols)

    @property
    def centres_en_m(self) -> Array:
        """Centres (rows * cols, 2) of the cells, row by row."""
        east = self.west_m + (np.arange(self.cols) + 0.5) * self.side_m
        north = self.north_m - (np.arange(self.rows) + 0.5) * self.side_m
        return np.stack(np.meshgrid(east, north), axis=-1).reshape(-1, 2)

    def drawn(self, rng: np.random.Generator) -> Array:
        off = rng.uniform(-0.5, 0.5, (self.rows * self.cols, 2)) * self.side_m
        return np.asarray(self.centres_en_m + off)

    def numbers(self, points_en_m: Array, margin: int = 0) -> NDArray[np.intp]:
        """Number (...) of the cell, row by row, under each of points (..., 2); -1 outside.

        `margin` cells are added and counted on each side.
        """
        cols = np.floor((points_en_m[..., 0] - self.west_m) / self.side_m).astype(np.intp) + margin
        rows = np.floor((self.north_m - points_en_m[..., 1]) / self.side_m).astype(np.intp) + margin
        height, width = self.rows + 2 * margin, self.cols + 2 * margin
        inside = (rows >= 0) & (cols >= 0) & (rows < height) & (cols < width)
        return np.where(inside, rows * width + cols, -1)

    def counts(self, points_en_m: Array) -> NDArray[np.int32]:
        found = np.bincount(self.numbers(points_en_m) + 1, minlength=self.rows * self.cols + 1)
        return found[1:].astype(np.int32).reshape(self.rows, self.cols)

    def ring_en_m(self, row: int, col: int) -> Array:
        """Corners (5, 2) of a cell, counter-clockwise, the first one again at the end."""
        corners = (_CORNERS + np.array([col, row])) * (self.side_m, -self.side_m)
        return np.asarray(corners + np.array([self.west_m, self.north_m]))


@dataclass(frozen=True)
class ChangeGrid(CellGrid):
    frame: LocalFrame

    def __post_init__(self) -> None:
        finite = all(map(math.isfinite, (self.west_m, self.north_m, self.side_m)))
        count = self.rows * self.cols
        if not (finite and self.side_m > 0 and self.rows > 0 and 0 < count <= MAX_CELLS):
            raise FlightError(
                f"a grid of changes needs 1 to {MAX_CELLS:,} cells of a positive side, got "
                f"{self.rows} x {self.cols} of {self.side_m} m"
            )

    @classmethod
    def of_sheet(cls, sheet: SheetInfo, side_m: float) -> "ChangeGrid":
        west, south, east, north = extent = sheet.grid.extent_en_m
        least_m = math.sqrt((east - west) * (north - south) / (0.9 * MAX_CELLS))
        return cls(**vars(CellGrid.over(extent, max(side_m, least_m))), frame=sheet.frame)


def lonlat(frame: LocalFrame, points_en_m: Array) -> list[list[float]]:
    """Longitude and latitude of points (N, 2) for GeoJSON, with no jump at the date line."""
    lat, lon = frame.latlon_from_en(points_en_m)
    lon = frame.lon_deg + (lon - frame.lon_deg + 180) % 360 - 180
    found: list[list[float]] = np.round(np.stack([lon, lat], axis=-1), 7).tolist()
    return found


@dataclass(frozen=True, eq=False)
class ChangedGround:
    """What a flight says of the ground of a map; arrays (rows, cols) are those of `grid`.

    `score`: 0 to 1, larger where view and map disagree; NaN where no view was compared.
    `views`: number of views that showed the cell.
    """

    grid: ChangeGrid
    score: Array
    views: NDArray[np.int32]
    changed: NDArray[np.bool_]
    map_name: str = ""
    map_sha256: str = ""

    @property
    def seen_m2(self) -> float:
        return float((self.views > 0).sum()) * self.grid.side_m**2

    @property
    def changed_m2(self) -> float:
        return float(self.changed.sum()) * self.grid.side_m**2

    def covers(self, points_en_m: Array, frame: LocalFrame) -> NDArray[np.bool_]:
        """Which of points (..., 2), in the plane `frame`, lie on ground that changed."""
        if frame != self.grid.frame:
            points_en_m = self.grid.frame.en_from_latlon(*frame.latlon_from_en(points_en_m))
        numbers = self.grid.numbers(points_en_m)
        return np.asarray((numbers >= 0) & self.changed.ravel()[numbers])

    def text(self) -> str:
        if not self.seen_m2:
            return "no view could be compared with the map"
        return (
            f"{100 * self.changed_m2 / self.seen_m2:.1f} % of the ground that was seen "
            f"({self.changed_m2 / 1e6:.2f} of {self.seen_m2 / 1e6:.2f} km2) no longer looks like "
            "the map"
        )


def write_changes(path: Path, found: ChangedGround) -> None:
    """Write the cells that were seen as GeoJSON (RFC 7946), whole or not at all."""
    grid = found.grid
    head = {
        "type": "FeatureCollection",
        "format": FORMAT,
        "version": VERSION,
        "map": {"name": found.map_name, "sha256": found.map_sha256},
        "plane": {"origin_lat_deg": grid.frame.lat_deg, "origin_lon_deg": grid.frame.lon_deg},
        "cells": {name: each for name, each in vars(grid).items() if name != "frame"},
    }
    lines = [json.dumps(_feature(found, row, col)) for row, col in np.argwhere(found.views > 0)]
    start = json.dumps(head, ensure_ascii=False, allow_nan=False)[:-1]
    body = ",\n".join(lines)
    write_text(path, f'{start}, "features": [\n{body}\n]}}\n')


def _feature(found: ChangedGround, row: int, col: int) -> dict[str, Any]:
    return {
        "type": "Feature",
        "properties": {
            "layer": "ground",
            "row": int(row),
            "col": int(col),
            "score": round(float(found.score[row, col]), 3),
            "views": int(found.views[row, col]),
            "changed": bool(found.changed[row, col]),
        },
        "geometry": {
            "type": "Polygon",
            "coordinates": [lonlat(found.grid.frame, found.grid.ring_en_m(row, col))],
        },
    }


def read_changes(path: Path) -> ChangedGround:
    """Read what `write_changes` wrote.

    Raises `MissingFileError` where there is no such file and `FlightError` where it is another.
    """
    path = require_file(path, "report of changed ground")
    if path.stat().st_size > MAX_BYTES:
        raise FlightError(f"a report of changed ground has at most {MAX_BYTES:,} bytes: {path}")
    try:
        plain = json.loads(path.read_bytes())
        if not isinstance(plain, dict) or plain.get("format") != FORMAT:
            raise FlightError("written by another program")
        if plain["version"] != VERSION:
            raise FlightError(f"version {plain['version']}, expected {VERSION}")
        return _from_plain(plain)
    except (
        *(ValueError, KeyError, TypeError, IndexError),
        *(OverflowError, RecursionError, OrthonavError),
    ) as error:
        raise FlightError(
            f"not a report of changed ground ({described(error)}); give a file written by "
            f"localize --report-changes: {path}"
        ) from error


def _from_plain(plain: dict[str, Any]) -> ChangedGround:
    plane, cells = plain["plane"], plain["cells"]
    frame = LocalFrame(float(plane["origin_lat_deg"]), float(plane["origin_lon_deg"]))
    west_m, north_m, side_m = (float(cells[name]) for name in ("west_m", "north_m", "side_m"))
    rows, cols = (int(cells[name]) for name in ("rows", "cols"))
    grid = ChangeGrid(west_m, north_m, side_m, rows, cols, frame)
    shape = grid.rows, grid.cols
    score, views = np.full(shape, np.nan), np.zeros(shape, np.int32)
    changed = np.zeros(shape, np.bool_)
    for feature in plain["features"]:
        values = feature["properties"]
        row, col = int(values["row"]), int(values["col"])
        if not (0 <= row < grid.rows and 0 <= col < grid.cols):
            raise FlightError(f"row {row}, column {col} outside the grid")
        if not 0 < int(values["views"]) < 2**31:
            raise FlightError(f"row {row}, column {col}: impossible number of views")
        score[row, col] = float(values["score"])
        views[row, col] = int(values["views"])
        changed[row, col] = values["changed"] is True
    about = plain["map"]
    return ChangedGround(grid, score, views, changed, str(about["name"]), str(about["sha256"]))
