"""Images of a service, read by GDAL's drivers of WMS and TMS one cell at a time.

GDAL requests, caches and decodes. Here every cell is requested again after a temporary failure,
and what comes is told apart: imagery, a gap that the service reports, or an error.
"""

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from xml.sax.saxutils import escape

import cv2
import numpy as np
import rasterio
from numpy.typing import NDArray
from rasterio.windows import Window

from orthonav.core.errors import FetchError
from orthonav.core.geo.ground import HIGHEST_M, LOWEST_M
from orthonav.ground.fetch.grid import CellGrid, Selection
from orthonav.ground.fetch.presets import HEIGHTS_FORMAT, Provenance, SourceSpec
from orthonav.ground.fetch.urls import checked_url, shown
from orthonav.ground.fetch.web import TIMEOUTS_S, USER_AGENT, Web, is_temporary

GDAL_OPTIONS = {
    "GDAL_HTTP_CONNECTTIMEOUT": TIMEOUTS_S[0],
    "GDAL_HTTP_LOW_SPEED_TIME": TIMEOUTS_S[1],
    "GDAL_HTTP_LOW_SPEED_LIMIT": 1,
    "GDAL_HTTP_USERAGENT": USER_AGENT,
    "GDAL_ERROR_ON_LIBJPEG_WARNING": True,  # half a JPEG would be grey in its lower half
    "GDAL_CACHEMAX": 64 * 2**20,
}
MIN_EMPTY_PX = 4096
"""Smallest patch of the empty colour that is masked, 64 x 64 px: larger than a roof or shadow."""


@dataclass(frozen=True, eq=False)
class CellPixels:
    """Pixels of a cell: `bands` (C, H, W) and `valid` (H, W) bool."""

    bands: NDArray[Any]
    valid: NDArray[np.bool_]

    @property
    def blank(self) -> bool:
        """Whether all is pure black or white. Heights, which are signed, are never blank."""
        first = self.bands[:, 0, 0]
        if self.bands.dtype.kind != "u" or first[0] not in (0, np.iinfo(np.uint8).max):
            return False
        return bool((self.bands == first[0]).all())


CellReader = Callable[[int, int], CellPixels]
"""Reads a cell by row and column, in any thread. Raises `FetchError`."""


@dataclass(frozen=True, eq=False)
class CellSource:
    """Imagery as cells of a grid; `reader` also takes a folder for GDAL's cache."""

    provenance: Provenance
    grid: CellGrid
    bands: int
    dtype: str
    cell_bytes: float  # estimated bytes of a cell
    reader: Callable[[Web, Selection, Path], CellReader]


def service_source(
    spec: SourceSpec,
    grid: CellGrid,
    format_: str,
    service: dict[str, str],
    level: int = 0,
    *,
    from_south: bool = False,
) -> CellSource:
    """Cells that are one image each, or one block of heights.

    `service` is GDAL's description of it, by tags of its element `Service`; the address may hold
    `{key}`. With `from_south` the rows of `level` are counted from the south.
    """
    address, heights = service["ServerUrl"], format_ == HEIGHTS_FORMAT
    checked_url(re.sub(r"\$?\{[^{}]*\}", "0", address))
    is_tiled = service["name"] == "TMS"
    width, height = grid.cell_w_px, grid.cell_h_px

    def reader(web: Web, selection: Selection, cache: Path) -> CellReader:
        (row0, col0), (rows_px, cols_px) = selection.first, selection.shape_px
        west, north = grid.transform(row0, col0) * (0, 0)
        first_row = rows_px // height - 2**level + row0 if from_south else row0
        tile = {"TileLevel": level, "TileX": col0, "TileY": first_row} if is_tiled else {}
        window = {
            "UpperLeftX": repr(west),
            "UpperLeftY": repr(north),
            "LowerRightX": repr(west + cols_px * grid.res_x),
            "LowerRightY": repr(north - rows_px * grid.res_y),
            "SizeX": cols_px,
            "SizeY": rows_px,
            "YOrigin": "bottom" if from_south else "top",
            **tile,
        }
        more = {
            "Projection": grid.crs,
            "BandsCount": 1 if heights else 4,
            "DataType": "Float32" if heights else "Byte",
            "BlockSizeX": width,
            "BlockSizeY": height,
            "OverviewCount": 0,
            "ZeroBlockHttpCodes": "204,404,410" if is_tiled else "204",
            "Timeout": 120,
            "UserAgent": USER_AGENT,
        }
        # By default GDAL removes every file of the folder that is older than a week.
        kept = {"Path": cache, "Unique": False, "Expires": 2**31 - 1, "CleanTimeout": 0}
        # Blocks without content are filled with it, and `_heights` refuses it.
        no_data = '<DataValues NoData="-32768"/>' if heights else ""
        description = (
            f"<GDAL_WMS><Service>{_xml(service | {'ServerUrl': web.with_keys(address)})}</Service>"
            f"<DataWindow>{_xml(window)}</DataWindow>{_xml(more)}{no_data}"
            f"<Cache>{_xml(kept)}</Cache></GDAL_WMS>"
        )

        def read(row: int, col: int) -> CellPixels:
            cell = Window((col - col0) * width, (row - row0) * height, width, height)
            where = f"{shown(address.replace('$', ''))} (row {row}, column {col})"
            pixels = _read(web, description, cell, where)
            return _heights(pixels) if heights else _imagery(pixels, spec.options.empty)

        return read

    # Size of usual tiles of orthophotos, for the estimate.
    bytes_per_px = {"image/jpeg": 0.35, "image/webp": 0.25, "image/png": 1.9, HEIGHTS_FORMAT: 4.0}
    size = width * height * bytes_per_px.get(format_, 1.0)
    bands, dtype = (1, "float32") if heights else (3, "uint8")
    return CellSource(spec.provenance, grid, bands, dtype, size, reader)


def _xml(elements: Mapping[str, object]) -> str:
    return "".join(f"<{tag}>{escape(str(value))}</{tag}>" for tag, value in elements.items())


def _read(web: Web, description: str, window: Window, where: str) -> NDArray[Any]:
    for attempt in range(web.limits.attempts):
        web.limits.pause(attempt)
        try:
            with rasterio.Env(**GDAL_OPTIONS), rasterio.open(description) as dataset:
                return np.asarray(dataset.read(window=window))
        except MemoryError:
            raise
        except Exception as error:  # whatever GDAL raises may quote the address with its key
            reason, is_worth_it = reason_of(error)
        if not is_worth_it:
            break
    raise FetchError(web.redacted(f"{reason}: {where}"))


def reason_of(error: BaseException) -> tuple[str, bool]:
    """What GDAL says of a failed request, without addresses; whether another may succeed."""
    chain: list[BaseException] = [error]
    while cause := chain[-1].__cause__ or chain[-1].__context__:
        chain.append(cause)
    text = " ".join(" ".join(map(str, chain)).split())
    if found := re.search(
        r"CURL error: (.{,200}?)(?: CURL|$)|HTTP status code: 0, error: (.*?)\. ?Add", text
    ):
        return found.group(1) or found.group(2), True
    if found := re.search(r"HTTP (?:status|response) code: (\d+)", text):
        status = int(found.group(1))
        return ("empty answer", True) if status == 200 else (f"HTTP {status}", is_temporary(status))
    if found := re.search(r"Incorrect size (.*?) of downloaded block, expected (.*?),", text):
        return f"image of {found.group(1)} px instead of {found.group(2)}", False
    if found := re.search(r"server returned exception: (.{,300}?)( GDAL|$)", text):
        return f"an error of the service ({found.group(1)})", True
    if "not recognized as being in a supported file format" in text:
        return "not an image", True
    inner = re.sub(r"\S*(://|/vsi)\S*", "", " ".join(str(chain[-1]).split()))
    return f"image is broken ({inner[:200]})", True


def _heights(pixels: NDArray[Any]) -> CellPixels:
    """Heights in metres; values that no ground can have stand for no data."""
    with np.errstate(invalid="ignore"):
        valid = (pixels[0] >= LOWEST_M) & (pixels[0] <= HIGHEST_M)
    return CellPixels(np.where(valid, pixels, np.float32(0)), valid)


def _imagery(pixels: NDArray[np.uint8], empty: str | None) -> CellPixels:
    """Red, green, blue and validity; `empty` is the colour of which large patches are invalid."""
    valid = pixels[3] > 0
    if empty is not None:
        pure = (pixels[:3] == (0 if empty == "black" else 255)).all(axis=0).astype(np.uint8)
        if int(pure.sum()) >= MIN_EMPTY_PX:
            _, labels, stats, _ = cv2.connectedComponentsWithStats(pure, connectivity=4)
            large = stats[:, cv2.CC_STAT_AREA] >= MIN_EMPTY_PX
            large[0] = False  # the other colours
            valid &= ~large[labels]
    return CellPixels(pixels[:3], valid)
