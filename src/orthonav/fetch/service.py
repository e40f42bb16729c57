"""What every kind of service comes down to: cells of a grid, fetched one by one."""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Protocol

from orthonav.errors import FetchError
from orthonav.fetch.client import Client
from orthonav.fetch.grid import CellGrid
from orthonav.fetch.pictures import Picture, decode, picture_or_absent

DEFAULT_GSD_M = 0.5
FINER = 1.05
"""Pixels may be so much coarser than asked for: zooms do not fall on round numbers."""
MAX_COARSER = 1.5
_BYTES_PER_PX = {"image/jpeg": 0.35, "image/webp": 0.25, "image/png": 1.9}


@dataclass(frozen=True)
class Wish:
    """What is asked of a service; None where the service, or its preset, may choose.

    `gsd_m` is metres on the ground per pixel, `zoom` a zoom level or the name of a tile matrix,
    `empty` the colour ("black" or "white") that stands for no imagery. `usual_style` and
    `usual_format` are taken where the layer has them and nothing else is asked for.
    """

    layer: str | None = None
    style: str | None = None
    format: str | None = None
    crs: str | None = None
    matrix_set: str | None = None
    zoom: str | None = None
    gsd_m: float | None = None
    time: str | None = None
    tile_px: int | None = None
    min_zoom: int | None = None
    max_zoom: int | None = None
    empty: str | None = None
    collection: str | None = None
    asset: str | None = None
    bands: tuple[int, ...] | None = None
    version: str | None = None
    subdomains: str = "abc"
    usual_style: str | None = None
    usual_format: str | None = None

    def over(self, preset: "Wish") -> "Wish":
        """This wish where it says something, else what the preset says."""
        said = {name: value for name, value in vars(self).items() if value is not None}
        if self.subdomains == Wish.subdomains:
            said.pop("subdomains")
        return replace(preset, **said)

    @property
    def ground_m(self) -> float:
        """Metres per pixel asked for."""
        return self.gsd_m if self.gsd_m is not None else DEFAULT_GSD_M


@dataclass(frozen=True)
class About:
    """What travels with the pixels: where they come from and under which terms.

    `source` is an address without keys; `date` is YYYY[-MM[-DD]], or two of them with a slash
    between where the imagery was taken over a time; `note` is what a user should know of it.
    """

    source: str
    layer: str
    date: str | None = None
    licence: str | None = None
    attribution: str | None = None
    note: str | None = None


class CellSource(Protocol):
    """Cells of a service."""

    @property
    def about(self) -> About:
        """Where the pixels come from."""

    @property
    def grid(self) -> CellGrid:
        """Where the cells lie."""

    @property
    def bands(self) -> int:
        """Bands of the pixels."""

    @property
    def dtype(self) -> str:
        """Kind of the pixels."""

    @property
    def cell_bytes(self) -> float:
        """Bytes of a usual cell: an estimate."""

    def address(self, row: int, col: int) -> str:
        """What names the cell, without keys."""

    def fetch(self, client: Client, row: int, col: int) -> bytes | None:
        """The cell as it is kept, checked; None where the service has nothing there.

        Raises `FetchError`.
        """

    def decode(self, body: bytes) -> Picture:
        """Pixels of what `fetch` gave. Raises `FetchError`."""

    def close(self) -> None:
        """Close what is open."""


@dataclass(frozen=True, eq=False)
class TileSource:
    """Cells that are pictures at an address each; `tiled` where 404 says that there is none."""

    about: About
    grid: CellGrid
    url_of: Callable[[int, int], str]
    format: str
    empty: str | None = None
    tiled: bool = True
    bands: int = 3
    dtype: str = "uint8"

    @property
    def cell_bytes(self) -> float:
        """Bytes of a usual tile: an estimate."""
        return self.grid.cell_w_px * self.grid.cell_h_px * _BYTES_PER_PX.get(self.format, 1.0)

    def address(self, row: int, col: int) -> str:
        """The address of the tile, without keys."""
        return self.url_of(row, col)

    def fetch(self, client: Client, row: int, col: int) -> bytes | None:
        """The picture as it came, checked. Raises `FetchError`."""
        shape = (self.grid.cell_h_px, self.grid.cell_w_px)
        return client.get(
            self.url_of(row, col),
            lambda reply: picture_or_absent(reply, shape, self.empty, tiled=self.tiled),
        )

    def decode(self, body: bytes) -> Picture:
        """Its pixels. Raises `FetchError`."""
        return decode(body, (self.grid.cell_h_px, self.grid.cell_w_px), self.empty)

    def close(self) -> None:
        """Nothing is open."""


def finest_fitting(gsds_m: list[float], wanted_m: float, what: str) -> int:
    """Index of the coarsest level that is as fine as wanted; the finest one if nearly so.

    Raises `FetchError` naming `what` there is.
    """
    fitting = [index for index, gsd_m in enumerate(gsds_m) if gsd_m <= wanted_m * FINER]
    if fitting:
        return max(fitting, key=lambda index: gsds_m[index])
    finest = min(range(len(gsds_m)), key=lambda index: gsds_m[index])
    if gsds_m[finest] > wanted_m * MAX_COARSER:
        raise FetchError(
            f"no imagery of {wanted_m:g} m per pixel: the finest is {gsds_m[finest]:.3g} m; "
            f"there is {what}"
        )
    return finest


def listed(names: list[str], asked: str = "", most: int = 12) -> str:
    """Names for an error: those like what was asked first, then the others, not too many."""
    asked = asked.lower()
    words = {word for word in asked.replace(".", " ").replace("_", " ").split() if len(word) > 2}

    def likeness(name: str) -> tuple[float, str]:
        low = name.lower()
        hits = sum(word in low for word in words) + (2 if asked and asked[:12] in low else 0)
        return (-hits, low)

    ordered = sorted(names, key=likeness)
    more = f" and {len(ordered) - most} more" if len(ordered) > most else ""
    return ", ".join(ordered[:most]) + more if ordered else "none"


def resolution(wanted_m: float, metres_per_unit: float) -> float:
    """Units of a coordinate system per pixel of `wanted_m` on the ground.

    Where the projection is true to scale within 1 %, its metres are taken as they are, so that a
    round number stays one.
    """
    if math.isclose(metres_per_unit, 1.0, rel_tol=0.01):
        return wanted_m
    return wanted_m / metres_per_unit
