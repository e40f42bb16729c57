"""The common form of every service: cells of a grid, fetched one by one."""

import math
from collections.abc import Callable
from dataclasses import dataclass

from orthonav.ground.fetch.client import Client
from orthonav.ground.fetch.grid import CellGrid
from orthonav.ground.fetch.images import CellPixels, decode, decode_heights, image_or_absent
from orthonav.ground.fetch.options import HEIGHTS_FORMAT, Provenance

_BYTES_PER_PX = {"image/jpeg": 0.35, "image/webp": 0.25, "image/png": 1.9, HEIGHTS_FORMAT: 4.0}
"""Size of usual tiles of orthophotos relative to their pixels, for the estimate."""


@dataclass(frozen=True, eq=False)
class CellSource:
    """Cells of a service; functions take the row and the column of a cell."""

    provenance: Provenance
    """Origin and terms of the pixels."""
    grid: CellGrid
    """Positions of the cells."""
    bands: int
    """Number of bands."""
    dtype: str
    """Pixel type."""
    cell_bytes: float
    """Estimated bytes of a cell."""
    address: Callable[[int, int], str]
    """Unique name of a cell, without keys."""
    fetch: Callable[[Client, int, int], bytes | None]
    """A cell in the form that is stored, checked; None where there is no imagery.

    Raises `FetchError`.
    """
    decode: Callable[[bytes], CellPixels]
    """Pixels of what `fetch` returned. Raises `FetchError`."""


def tile_source(
    provenance: Provenance,
    grid: CellGrid,
    url_of: Callable[[int, int], str],
    format_: str,
    empty: str | None,
    *,
    tiled: bool = True,
) -> CellSource:
    """Cells that are one image, or one block of heights, per address.

    `empty` is the colour of missing imagery; `tiled`: whether 404 means that there is none.
    """
    shape, heights = (grid.cell_h_px, grid.cell_w_px), format_ == HEIGHTS_FORMAT

    def fetch(client: Client, row: int, col: int) -> bytes | None:
        return client.get(
            url_of(row, col),
            lambda reply: image_or_absent(reply, shape, empty, tiled=tiled, heights=heights),
        )

    def decoded(body: bytes) -> CellPixels:
        return decode_heights(body, shape) if heights else decode(body, shape, empty)

    size = math.prod(shape) * _BYTES_PER_PX.get(format_, 1.0)
    bands, dtype = (1, "float32") if heights else (3, "uint8")
    return CellSource(provenance, grid, bands, dtype, size, url_of, fetch, decoded)


def resolution(wanted_m: float, metres_per_unit: float) -> float:
    """Units of a coordinate system per pixel of `wanted_m` on the ground.

    Where the projection is true to scale within 1 %, its metres are used unchanged, so that a
    round number stays one.
    """
    if math.isclose(metres_per_unit, 1.0, rel_tol=0.01):
        return wanted_m
    return wanted_m / metres_per_unit
