"""Building a map: area -> tile grid -> blocks of imagery -> cells -> embeddings -> file.

Imagery is read block by block, so memory depends on the area, not on the orthophotos: what stays
is a seven-number mean per micro-cell (about 0.5 MB per km2 at 1 m and 256 px tiles).
"""

import logging
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from orthonav import __version__, embed, represent
from orthonav.embed.cells import CellLayout
from orthonav.embed.whitened import CellSheet, WhitenedEmbedder, WhitenedRecipe, learn
from orthonav.errors import AreaError, VariantError
from orthonav.geo.area import Area
from orthonav.geo.grid import TileGrid
from orthonav.geo.route import Route
from orthonav.imagery.mosaic import Mosaic, Pixels, SheetRaster
from orthonav.mapfile.manifest import Manifest, SheetInfo
from orthonav.mapfile.writer import write_map
from orthonav.prepare.calibrate import RADIUS_STRIDES, Calibration, CropSampler, calibrate
from orthonav.variants import make_variant, variant_recipe

log = logging.getLogger(__name__)

BLOCK_PX = 1024
PREVIEW_PX = 384
MIN_TILE_VALID_SHARE = 0.5
MIN_VIEW_VALID_SHARE = 0.1
HEADING_STEP_DEG = 6.0
Progress = Callable[[str, float], None]


@dataclass(frozen=True)
class BuildRequest:
    """What to build. `bounds_deg` is west, south, east, north; with neither it nor a route, the
    whole imagery is the area. `gsd_m` None takes that of the finest orthophoto."""

    orthos: Sequence[Path]
    out: Path
    bounds_deg: tuple[float, float, float, float] | None = None
    route: Route | None = None
    band_m: float | None = None
    gsd_m: float | None = None
    tile_px: int = 256
    overlap: float = 0.875
    method: str = "gradient"
    edges: str = "gradient"
    seed: int = field(default=0)


@dataclass(frozen=True)
class BuildResult:
    """What came out: the manifest as written and the size of the file."""

    manifest: Manifest
    size_bytes: int


def build_map(request: BuildRequest, progress: Progress | None = None) -> BuildResult:
    """Build a map and write it to `request.out`, whole or not at all.

    The same request gives the same bytes. `progress` is called with a stage and its share done.
    Raises `MissingFileError`, `ImageryError`, `AreaError`, `VariantError` or `OutputError`.
    """
    report = progress or (lambda stage, share: None)
    representation = make_variant(represent.TABLE, request.edges)
    recipe = _embedding_recipe(request.method, representation)
    mosaic = Mosaic.open(request.orthos)
    area = _area(request, mosaic)
    gsd_m = _rounded(mosaic.gsd_m) if request.gsd_m is None else request.gsd_m
    grid = TileGrid.covering(
        area.extent_en_m, gsd_m=gsd_m, tile_px=request.tile_px, overlap=request.overlap
    )
    if gsd_m < 0.8 * mosaic.gsd_m:
        log.warning(
            "ground resolution of %.3g m is finer than the imagery's %.3g m", gsd_m, mosaic.gsd_m
        )
    sampler = CropSampler(grid, request.seed)
    cells, preview = _read_cells(mosaic, area, grid, representation, sampler, report)
    tiles_rc = _tiles(area, grid, cells)
    report("learn", 0.0)
    embedder = learn(recipe, cells, tiles_rc * grid.stride_px)
    report("learn", 1.0)
    embeddings = embedder.tiles(cells, tiles_rc * grid.stride_px)
    centres = grid.centres_en_m(tiles_rc).astype(np.float32)
    calibration = calibrate(
        sampler, grid, representation, embedder, embeddings, centres, HEADING_STEP_DEG, report
    )
    manifest = _manifest(
        request, mosaic, area, grid, representation, embedder, calibration, tiles_rc
    )
    arrays: dict[str, NDArray[Any]] = {
        "sheet0/centres_en_m": centres,
        "sheet0/embeddings": embeddings,
        "sheet0/preview_jpeg": preview,
        **{f"embed/{name}": array for name, array in embedder.parts().items()},
    }
    written = write_map(request.out, manifest, arrays)
    return BuildResult(written, request.out.stat().st_size)


def _embedding_recipe(method: str, representation: Any) -> WhitenedRecipe:
    """The method's recipe; one-channel pictures are compared on finer cells by default."""
    name, _, parameters = method.partition(":")
    if representation.channels == 1 and "cells=" not in parameters:
        method = f"{name}:{parameters},cells=16"
    recipe = make_variant(embed.TABLE, method)
    if not isinstance(recipe, WhitenedRecipe):
        raise VariantError(f"method '{method}' cannot be built by this program")
    return recipe


def _area(request: BuildRequest, mosaic: Mosaic) -> Area:
    if request.route is not None and request.bounds_deg is not None:
        raise AreaError("give a route with a band, or bounds, not both")
    if request.route is not None:
        if request.band_m is None:
            raise AreaError("a route needs the width of its search band in metres (--band-m)")
        return Area.from_route(request.route, request.band_m)
    if request.band_m is not None:
        raise AreaError("a search band needs a route (--route)")
    if request.bounds_deg is not None:
        return Area.from_bounds(request.bounds_deg)
    outline = mosaic.outline_latlon_deg
    return Area.from_outline(outline[:, 0], outline[:, 1])


def _rounded(gsd_m: float) -> float:
    """Ground resolution as people state it: 5.002 is 5, 0.2431 stays 0.243."""
    for digits in (1, 2, 3):
        rounded = float(f"{gsd_m:.{digits}g}")
        if abs(rounded / gsd_m - 1) < 0.005:
            return rounded
    return float(f"{gsd_m:.4g}")


def _read_cells(
    mosaic: Mosaic,
    area: Area,
    grid: TileGrid,
    representation: Any,
    sampler: CropSampler,
    report: Progress,
) -> tuple[CellSheet, NDArray[np.uint8]]:
    """Micro-cell means of the whole sheet, and a small grey picture of it as JPEG bytes."""
    layout = CellLayout.for_tiles(grid.tile_px, grid.stride_px)
    cells = CellSheet(layout, grid.height_px, grid.width_px, representation.channels)
    scale = min(1.0, PREVIEW_PX / max(grid.width_px, grid.height_px))
    preview = np.zeros(
        (max(1, round(grid.height_px * scale)), max(1, round(grid.width_px * scale))), np.uint8
    )
    raster = mosaic.sheet(
        area.frame,
        west_m=grid.west_m,
        north_m=grid.north_m,
        width_px=grid.width_px,
        height_px=grid.height_px,
        gsd_m=grid.gsd_m,
    )
    margin = layout.micro_px + getattr(representation, "margin_px", 8)
    with raster:
        blocks = list(_blocks(grid, layout))
        for done, (row, col, height, width) in enumerate(blocks):
            if _may_matter(area, grid, row, col, height, width):
                pixels, top, left = _with_margin(raster, row, col, height, width, margin)
                _fill(cells, pixels, representation, row, col, top, left, height, width)
                sampler.offer(pixels.grey, pixels.valid, row - top, col - left)
                _thumbnail(preview, pixels, scale, row, col, top, left, height, width)
            report("imagery", (done + 1) / len(blocks))
    if not cells.valid.any():
        raise AreaError("the area has no imagery: it lies outside the orthophotos or is all nodata")
    encoded = cv2.imencode(".jpg", preview, [int(cv2.IMWRITE_JPEG_QUALITY), 70])[1]
    return cells, np.asarray(encoded, dtype=np.uint8).reshape(-1)


def _blocks(grid: TileGrid, layout: CellLayout) -> Iterator[tuple[int, int, int, int]]:
    """Row, column, height, width in pixels of blocks that fill the sheet, on the cell raster."""
    side = max(layout.micro_px, BLOCK_PX // layout.micro_px * layout.micro_px)
    for row in range(0, grid.height_px, side):
        for col in range(0, grid.width_px, side):
            yield row, col, min(side, grid.height_px - row), min(side, grid.width_px - col)


def _may_matter(area: Area, grid: TileGrid, row: int, col: int, height: int, width: int) -> bool:
    """Whether a tile of the area could need the block (False may only come far from a route)."""
    if area.route is None:
        return True
    centre = np.array(
        [
            [
                grid.west_m + (col + width / 2) * grid.gsd_m,
                grid.north_m - (row + height / 2) * grid.gsd_m,
            ]
        ]
    )
    reach_m = (np.hypot(height, width) / 2 + grid.tile_px + grid.stride_px) * grid.gsd_m
    return bool(area.contains(centre, reach_m)[0])


def _with_margin(
    raster: SheetRaster, row: int, col: int, height: int, width: int, margin: int
) -> tuple[Pixels, int, int]:
    """A block with up to `margin` pixels around it, and how many of them are above and left."""
    top, left = min(margin, row), min(margin, col)
    bottom = min(margin, raster.height_px - row - height)
    right = min(margin, raster.width_px - col - width)
    pixels = raster.read(col - left, row - top, left + width + right, top + height + bottom)
    return pixels, top, left


def _fill(
    cells: CellSheet,
    pixels: Pixels,
    representation: Any,
    row: int,
    col: int,
    top: int,
    left: int,
    height: int,
    width: int,
) -> None:
    if not pixels.valid.any():
        return
    maps = representation(pixels.grey, pixels.valid)
    # Cells that begin in the block may end beyond it, within the margin.
    end = cells.layout.micro_px - cells.layout.spacing_px
    part = np.s_[top : top + height + end, left : left + width + end]
    cells.fill(row, col, maps[:, part[0], part[1]], pixels.valid[part])


def _thumbnail(
    preview: NDArray[np.uint8],
    pixels: Pixels,
    scale: float,
    row: int,
    col: int,
    top: int,
    left: int,
    height: int,
    width: int,
) -> None:
    y0, y1 = round(row * scale), min(preview.shape[0], round((row + height) * scale))
    x0, x1 = round(col * scale), min(preview.shape[1], round((col + width) * scale))
    if y1 > y0 and x1 > x0:
        block = pixels.grey[top : top + height, left : left + width]
        preview[y0:y1, x0:x1] = cv2.resize(block, (x1 - x0, y1 - y0), interpolation=cv2.INTER_AREA)


def _tiles(area: Area, grid: TileGrid, cells: CellSheet) -> NDArray[np.intp]:
    """Grid rows and columns (N, 2) of the tiles that lie in the area and have imagery."""
    rows, cols = np.mgrid[: grid.rows, : grid.cols]
    tiles = np.stack([rows.ravel(), cols.ravel()], axis=1).astype(np.intp)
    reach_m = grid.stride_m * np.sqrt(0.5)
    tiles = tiles[area.contains(grid.centres_en_m(tiles), reach_m)]
    share = cells.valid_share(tiles * grid.stride_px)
    if not (share >= MIN_TILE_VALID_SHARE).any():
        best = share.max(initial=0.0)
        raise AreaError(
            f"no tile of {grid.tile_px} px ({grid.tile_m:.0f} m) has imagery under at least "
            f"{MIN_TILE_VALID_SHARE:.0%} of it (best {best:.0%}): the area lies outside the "
            "orthophotos, or tiles are larger than the imagery; use smaller tiles or a finer "
            "ground resolution"
        )
    return tiles[share >= MIN_TILE_VALID_SHARE]


def _manifest(
    request: BuildRequest,
    mosaic: Mosaic,
    area: Area,
    grid: TileGrid,
    representation: Any,
    embedder: WhitenedEmbedder,
    calibration: Calibration,
    tiles_rc: NDArray[np.intp],
) -> Manifest:
    area_km2 = len(tiles_rc) * grid.stride_m**2 / 1e6
    return Manifest(
        recipe={
            "method": request.method.partition(":")[0],
            "represent": variant_recipe(represent.TABLE, representation),
            "embed": variant_recipe(embed.TABLE, embedder.recipe),
            "overlap": request.overlap,
            "seed": request.seed,
        },
        sheets=(SheetInfo(area.frame, grid, len(tiles_rc), round(area_km2, 6)),),
        imagery=tuple(source.describe() for source in mosaic.sources),
        view={
            "heading_step_deg": HEADING_STEP_DEG,
            "min_valid_share": MIN_VIEW_VALID_SHARE,
            "position_std_m": calibration.position_std_m,
        },
        confidence=calibration.confidence.to_plain() if calibration.confidence else None,
        radius_m=RADIUS_STRIDES * grid.stride_m,
        created_by=f"orthonav {__version__}",
    )
