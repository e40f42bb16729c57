"""The common form of every service: cells of a grid, fetched one by one."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

from orthonav.fetch.client import Client
from orthonav.fetch.grid import CellGrid
from orthonav.fetch.images import CellPixels, decode, decode_heights, image_or_absent
from orthonav.fetch.options import HEIGHTS_FORMAT, Provenance

_BYTES_PER_PX = {"image/jpeg": 0.35, "image/webp": 0.25, "image/png": 1.9, HEIGHTS_FORMAT: 4.0}
"""Size of usual tiles of orthophotos relative to their pixels, for the estimate."""


class CellSource(Protocol):
    """Cells of a service."""

    @property
    def provenance(self) -> Provenance:
        """Origin and terms of the pixels."""

    @property
    def grid(self) -> CellGrid:
        """Positions of the cells."""

    @property
    def bands(self) -> int:
        """Number of bands."""

    @property
    def dtype(self) -> str:
        """Pixel type."""

    @property
    def cell_bytes(self) -> float:
        """Estimated bytes of a cell."""

    def address(self, row: int, col: int) -> str:
        """Unique name of the cell, without keys."""

    def fetch(self, client: Client, row: int, col: int) -> bytes | None:
        """The cell in the form that is stored, checked; None where there is no imagery.

        Raises `FetchError`.
        """

    def decode(self, body: bytes) -> CellPixels:
        """Pixels of what `fetch` returned. Raises `FetchError`."""


@dataclass(frozen=True, eq=False)
class TileSource:
    """Cells that are one image, or one block of heights, per address.

    `tiled`: whether 404 means that there is no imagery.
    """

    provenance: Provenance
    grid: CellGrid
    url_of: Callable[[int, int], str]
    format: str
    empty: str | None = None
    tiled: bool = True

    @property
    def is_heights(self) -> bool:
        """Whether cells hold heights."""
        return self.format == HEIGHTS_FORMAT

    @property
    def bands(self) -> int:
        """Number of bands."""
        return 1 if self.is_heights else 3

    @property
    def dtype(self) -> str:
        """Pixel type."""
        return "float32" if self.is_heights else "uint8"

    @property
    def cell_bytes(self) -> float:
        """Estimated bytes of a tile."""
        return self.grid.cell_w_px * self.grid.cell_h_px * _BYTES_PER_PX.get(self.format, 1.0)

    def address(self, row: int, col: int) -> str:
        """The address of the tile, without keys."""
        return self.url_of(row, col)

    def fetch(self, client: Client, row: int, col: int) -> bytes | None:
        """The image as sent, checked. Raises `FetchError`."""
        shape = (self.grid.cell_h_px, self.grid.cell_w_px)
        return client.get(
            self.url_of(row, col),
            lambda reply: image_or_absent(
                reply, shape, self.empty, tiled=self.tiled, heights=self.is_heights
            ),
        )

    def decode(self, body: bytes) -> CellPixels:
        """Its pixels. Raises `FetchError`."""
        shape = (self.grid.cell_h_px, self.grid.cell_w_px)
        return decode_heights(body, shape) if self.is_heights else decode(body, shape, self.empty)


def resolution(wanted_m: float, metres_per_unit: float) -> float:
    """Units of a coordinate system per pixel of `wanted_m` on the ground.

    Where the projection is true to scale within 1 %, its metres are used unchanged, so that a
    round number stays one.
    """
    if math.isclose(metres_per_unit, 1.0, rel_tol=0.01):
        return wanted_m
    return wanted_m / metres_per_unit
