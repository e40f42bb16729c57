"""Building a map: area -> tile grid -> blocks of imagery -> cells -> embeddings -> file.

Imagery is read block by block, so memory depends on the area, not on the orthophotos: what stays
is a seven-number mean per micro-cell (about 0.5 MB per km2 at 1 m and 256 px tiles) and the
compressed registration layer (0.15 to 0.35 MB per km2 at 1 m).
"""

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from orthonav import __version__, embed, represent
from orthonav.embed.cells import MICRO, CellLayout
from orthonav.embed.contract import ViewEmbedder
from orthonav.embed.network import TripletRecipe
from orthonav.embed.whitened import CellSheet, WhitenedRecipe, learn
from orthonav.errors import AreaError, OutputError, VariantError
from orthonav.geo.area import Area
from orthonav.geo.grid import TileGrid
from orthonav.geo.route import Route
from orthonav.imagery.mosaic import Mosaic
from orthonav.localizer.propose import TileProposer
from orthonav.localizer.registration import RegistrationLocalizer
from orthonav.mapfile.layer import GreyLayer
from orthonav.mapfile.manifest import Manifest, SheetInfo
from orthonav.mapfile.reader import MapFile
from orthonav.mapfile.writer import write_map
from orthonav.prepare.blocks import BlockPixels, Preview, blocks_of, read_block
from orthonav.prepare.calibrate import (
    CROPS,
    RADIUS_STRIDES,
    Calibration,
    Crop,
    CropSampler,
    calibrate,
)
from orthonav.prepare.calibrate_registration import FLOOR_PX, calibrate_registration
from orthonav.prepare.encoders import learn_encoder
from orthonav.prepare.layer import CHUNK_PX, GreyLayerWriter
from orthonav.prepare.methods import method_recipe, stored_representation, usual_edges
from orthonav.prepare.pictures import SheetPictures, read_pictures
from orthonav.search.exact import ExactIndex
from orthonav.search.peak import TileNeighbours
from orthonav.variants import make_variant, variant_recipe

log = logging.getLogger(__name__)

BLOCK_PX = 1024
PREVIEW_PX = 384
MIN_TILE_VALID_SHARE = 0.5
MIN_VIEW_VALID_SHARE = 0.4
HEADING_STEP_DEG = 6.0
SEARCH_MS = 100.0
"""Dearest search of a view while the confidence is learnt, by estimate: there are many views."""
MAX_CALIBRATION_VIEWS = 2 * CROPS
RADIUS_PX = 10.0
MIN_RADIUS_M = 35.0
"""A registered view is right within so many pixels or metres: cameras lean more than told."""
Progress = Callable[[str, float], None]


@dataclass(frozen=True)
class BuildRequest:
    """What to build. `bounds_deg` is west, south, east, north; with neither it nor a route, the
    whole imagery is the area. `gsd_m` None takes that of the finest orthophoto. With
    `registration` the map carries the grey picture that places views below tile size;
    `other_dates` are orthophotos of the same ground to learn the confidence from, besides
    `calibration_views` views made of the reference itself; a triplet network learns from them too.
    `edges` None is what suits the method; `work` keeps checkpoints of networks, from which a build
    that was interrupted goes on."""

    orthos: Sequence[Path]
    out: Path
    bounds_deg: tuple[float, float, float, float] | None = None
    route: Route | None = None
    band_m: float | None = None
    gsd_m: float | None = None
    tile_px: int = 256
    overlap: float = 0.875
    method: str = "gradient"
    edges: str | None = None
    seed: int = 0
    registration: bool = True
    other_dates: Sequence[Path] = ()
    calibration_views: int = 48
    work: Path | None = None


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
    representation = make_variant(represent.TABLE, request.edges or usual_edges(request.method))
    recipe = method_recipe(request.method, representation)
    mosaic = Mosaic.open(request.orthos)
    inputs = [*request.orthos, *request.other_dates]
    if any(request.out.exists() and request.out.samefile(path) for path in inputs):
        raise OutputError(f"the map would replace an orthophoto; name another file: {request.out}")
    mosaic_of_dates = [Mosaic.open([path]) for path in request.other_dates]
    area = _area(request, mosaic)
    grid = _grid(request, area, mosaic)
    if request.seed < 0:
        raise VariantError(f"seed must be 0 or more, got {request.seed}")
    if not 1 <= request.calibration_views <= MAX_CALIBRATION_VIEWS:
        raise VariantError(
            f"calibration views must be 1 to {MAX_CALIBRATION_VIEWS}, "
            f"got {request.calibration_views}"
        )
    sampler = CropSampler(grid.tile_px, request.seed)
    layer = GreyLayerWriter(grid.height_px, grid.width_px) if request.registration else None
    pictures = None
    if not isinstance(recipe, WhitenedRecipe):
        pictures = SheetPictures(grid, representation)
    cells, preview = _read_cells(
        mosaic, area, grid, representation, sampler, layer, pictures, report
    )
    tiles_rc = _tiles(area, grid, cells)
    tiles_px = tiles_rc * grid.stride_px
    embedder: ViewEmbedder
    report("learn", 0.0)
    if isinstance(recipe, WhitenedRecipe):
        embedder = whitened = learn(recipe, cells, tiles_px)
        embeddings = whitened.tiles(cells, tiles_px)
    else:
        assert pictures is not None
        dates = [
            read_pictures(date, area, grid, representation, report)
            for date in (mosaic_of_dates if isinstance(recipe, TripletRecipe) else ())
        ]
        embedder, embeddings = learn_encoder(
            recipe, pictures, dates, tiles_px, representation, request.seed, request.work, report
        )
    report("learn", 1.0)
    centres = grid.centres_en_m(tiles_rc).astype(np.float32)
    calibration = calibrate(
        sampler,
        grid,
        representation,
        embedder,
        embeddings,
        centres,
        HEADING_STEP_DEG,
        report,
        slow=not represent.TABLE[stored_representation(representation)["name"]].flies,
    )
    if calibration.confidence is None:
        log.warning("too little imagery to calibrate: fixes on this map will have no confidence")
    grey, grey_parts = (None, {}) if layer is None else layer.finish()
    area_km2 = round(len(tiles_rc) * grid.stride_m**2 / 1e6, 6)
    sheet = SheetInfo(area.frame, grid, len(tiles_rc), area_km2, grey)
    manifest = _manifest(request, mosaic, sheet, representation, embedder, calibration)
    arrays: dict[str, NDArray[Any]] = {
        "sheet0/centres_en_m": centres,
        "sheet0/embeddings": embeddings,
        "sheet0/preview_jpeg": preview,
        **{f"embed/{name}": array for name, array in embedder.parts().items()},
        **grey_parts,
    }
    if grey is not None:
        registration = _registration(
            request,
            mosaic_of_dates,
            area,
            manifest,
            arrays,
            sampler,
            representation,
            embedder,
            report,
        )
        manifest = replace(manifest, registration=registration)
    written = write_map(request.out, manifest, arrays)
    return BuildResult(written, request.out.stat().st_size)


def _registration(
    request: BuildRequest,
    other_dates: Sequence[Mosaic],
    area: Area,
    manifest: Manifest,
    arrays: dict[str, NDArray[Any]],
    sampler: CropSampler,
    representation: Any,
    embedder: ViewEmbedder,
    report: Progress,
) -> dict[str, Any]:
    """What the manifest says of registration: placed on the map as it will be written."""
    sheet = manifest.sheets[0]
    radius_m = max(RADIUS_PX * sheet.grid.gsd_m, MIN_RADIUS_M)
    made = MapFile(request.out, 0, manifest, arrays)
    layer = GreyLayer.of(made)
    assert layer is not None
    propose = TileProposer.of(
        sheet.grid,
        arrays["sheet0/centres_en_m"],
        ExactIndex(arrays["sheet0/embeddings"]),
        embedder,
        representation,
        TileNeighbours(sheet.grid, arrays["sheet0/centres_en_m"]),
    )
    localizer = RegistrationLocalizer(
        sheet, layer, None, radius_m, FLOOR_PX, propose, last_ms=SEARCH_MS
    )
    later = [crop for each in other_dates for crop in _crops_of(each, area, sheet.grid, sampler)]
    if other_dates and not later:
        log.warning("the other dates do not cover the area: nothing can be learnt from them")
    learnt = calibrate_registration(
        localizer, sampler.crops, later, request.calibration_views, request.seed, report
    )
    if learnt.confidence is None:
        log.warning("too little imagery to calibrate registration: fixes will have no confidence")
    return {
        "confidence": None if learnt.confidence is None else learnt.confidence.to_plain(),
        "radius_m": radius_m,
        "position_floor_px": learnt.floor_px,
    }


def _crops_of(mosaic: Mosaic, area: Area, grid: TileGrid, sampler: CropSampler) -> list[Crop]:
    """What another date shows at the places of the crops, where it shows all of them."""
    found = []
    with mosaic.grid_sheet(area.frame, grid) as raster:
        for crop in sampler.crops:
            size = crop.grey.shape[0]
            col, row = round(crop.col_px - size / 2), round(crop.row_px - size / 2)
            pixels = raster.read(col, row, size, size)
            if pixels.valid.all() and pixels.grey.std() > 1:
                found.append(Crop(pixels.grey, crop.row_px, crop.col_px))
    return found


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


def _grid(request: BuildRequest, area: Area, mosaic: Mosaic) -> TileGrid:
    """The tile grid; refuses tiles larger than an area that is not the band of a route."""
    gsd_m = _rounded(mosaic.gsd_m) if request.gsd_m is None else request.gsd_m
    overlap = _whole_cells(request.tile_px, request.overlap)
    grid = TileGrid.covering(
        area.extent_en_m, gsd_m=gsd_m, tile_px=request.tile_px, overlap=overlap
    )
    west, south, east, north = area.extent_en_m
    side_m = min(east - west, north - south)
    if area.route is None and side_m < 0.999 * grid.tile_m:
        raise AreaError(
            f"a tile of {grid.tile_px} px is {grid.tile_m:.0f} m wide, larger than the area, "
            f"{east - west:.0f} x {north - south:.0f} m; use smaller tiles, a finer ground "
            "resolution or a larger area"
        )
    if gsd_m < 0.8 * mosaic.gsd_m:
        log.warning(
            "ground resolution of %.3g m is finer than the imagery's %.3g m", gsd_m, mosaic.gsd_m
        )
    return grid


def _rounded(gsd_m: float) -> float:
    """Ground resolution as people state it: 5.002 is 5, 0.2431 stays 0.243."""
    for digits in (1, 2, 3):
        rounded = float(f"{gsd_m:.{digits}g}")
        if abs(rounded / gsd_m - 1) < 0.005:
            return rounded
    return float(f"{gsd_m:.4g}")


def _whole_cells(tile_px: int, overlap: float) -> float:
    """The overlap that makes tiles whole micro-cells apart, where they are at least one apart.

    Tiles then share all their cells; memory would grow with the square of what is left over.
    """
    micro_px = max(1, tile_px // MICRO)
    stride_px = tile_px * (1 - overlap)
    if not micro_px <= stride_px <= tile_px:
        return overlap
    return 1 - round(stride_px / micro_px) * micro_px / tile_px


def _read_cells(
    mosaic: Mosaic,
    area: Area,
    grid: TileGrid,
    representation: Any,
    sampler: CropSampler,
    layer: GreyLayerWriter | None,
    pictures: SheetPictures | None,
    report: Progress,
) -> tuple[CellSheet, NDArray[np.uint8]]:
    """Micro-cell means of the whole sheet, and a small grey picture of it as JPEG bytes.

    The sampler and the layer take in what they need as the blocks pass by.
    """
    layout = CellLayout.for_tiles(grid.tile_px, grid.stride_px)
    cells = CellSheet(layout, grid.height_px, grid.width_px, representation.channels)
    preview = Preview(grid, PREVIEW_PX)
    # Cells that begin in a block may end beyond it, within the margin.
    beyond_px = layout.micro_px - layout.spacing_px
    margin_px = layout.micro_px + representation.margin_px
    side_px = -(-max(BLOCK_PX, 2 * grid.tile_px) // layout.micro_px) * layout.micro_px
    blocks = [block for block in blocks_of(grid, side_px) if block.may_matter(area, grid)]
    total_px = sum(block.height * block.width for block in blocks)
    with mosaic.grid_sheet(area.frame, grid) as raster:
        for done, block in enumerate(blocks):
            read = read_block(raster, block, margin_px)
            grey, valid = read.pixels.grey, read.pixels.valid
            if valid.any():
                part = read.part(beyond_px)
                maps = representation(grey, valid)
                cells.fill(block.row, block.col, maps[:, part[0], part[1]], valid[part])
                if pictures is not None:
                    pictures.fill(read, maps)
            share = block.height * block.width / total_px
            sampler.offer(grey, valid, block.row - read.top, block.col - read.left, share)
            preview.add(read)
            if layer is not None:
                _add_to_layer(layer, read, area, grid)
            report("imagery", (done + 1) / len(blocks))
    if not cells.valid.any():
        raise AreaError("the area has no imagery: it lies outside the orthophotos or is all nodata")
    return cells, preview.jpeg()


def _add_to_layer(layer: GreyLayerWriter, read: BlockPixels, area: Area, grid: TileGrid) -> None:
    """Hand a block to the layer, less the chunks that are too far from the route."""
    for chunk in read.block.cut(CHUNK_PX):
        if chunk.may_matter(area, grid):
            where = read.within(chunk)
            layer.add(chunk.row, chunk.col, read.pixels.grey[where], read.pixels.valid[where])


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
    sheet: SheetInfo,
    representation: Any,
    embedder: ViewEmbedder,
    calibration: Calibration,
) -> Manifest:
    return Manifest(
        recipe={
            "method": request.method.partition(":")[0],
            "represent": stored_representation(representation),
            "embed": variant_recipe(embed.TABLE, embedder.recipe),
            "overlap": request.overlap,
            "seed": request.seed,
        },
        sheets=(sheet,),
        imagery=tuple(source.describe() for source in mosaic.sources),
        view={
            "heading_step_deg": HEADING_STEP_DEG,
            "min_valid_share": MIN_VIEW_VALID_SHARE,
            "position_std_m": calibration.position_std_m,
        },
        confidence=calibration.confidence.to_plain() if calibration.confidence else None,
        radius_m=RADIUS_STRIDES * sheet.grid.stride_m,
        created_by=f"orthonav {__version__}",
    )
