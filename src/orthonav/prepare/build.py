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
from orthonav.embed.contract import ViewEmbedder
from orthonav.embed.network import TripletRecipe
from orthonav.embed.whitened import WhitenedRecipe, learn
from orthonav.errors import AreaError, OutputError, VariantError
from orthonav.geo.area import Area
from orthonav.geo.estimate import estimate_map
from orthonav.geo.grid import TileGrid
from orthonav.geo.route import Route
from orthonav.imagery.mosaic import Mosaic
from orthonav.localizer.match import TileMatcher
from orthonav.localizer.plan import SearchPlan
from orthonav.localizer.propose import TileProposer
from orthonav.localizer.registration import RegistrationLocalizer
from orthonav.mapfile.manifest import Manifest, SheetInfo
from orthonav.mapfile.reader import MapFile
from orthonav.mapfile.writer import write_map
from orthonav.prepare.calibrate import (
    CROPS,
    RADIUS_STRIDES,
    Calibration,
    Crop,
    CropSampler,
    calibrate,
)
from orthonav.prepare.calibrate_registration import FLOOR_PX, calibrate_registration
from orthonav.prepare.cellparts import cell_parts
from orthonav.prepare.encoders import EncoderRecipe, learn_encoder
from orthonav.prepare.layout import grid_of, tiles_of
from orthonav.prepare.methods import method_recipe, stored_representation, usual_edges
from orthonav.prepare.pictures import SheetPictures, read_pictures
from orthonav.prepare.sheet import SheetReader
from orthonav.variants import make_variant, variant_recipe

log = logging.getLogger(__name__)

MAX_WORKERS = 64
MIN_VIEW_VALID_SHARE = 0.4
HEADING_STEP_DEG = 6.0
SEARCH_MS = 100.0
"""Dearest search of a view while the confidence is learnt, by estimate: there are many views."""
MAX_CALIBRATION_VIEWS = 2 * CROPS
RADIUS_PX = 10.0
MIN_RADIUS_M = 35.0
"""A registered view is right within so many pixels or metres: cameras tilt more than told."""
Progress = Callable[[str, float], None]


@dataclass(frozen=True)
class BuildRequest:
    """What to build. `bounds_deg` is west, south, east, north; with neither it nor a route, the
    whole imagery is the area. `band_m` is for the legs of the route that have no band of their own.
    `gsd_m` None takes that of the finest orthophoto. With `registration` the map carries the grey
    picture that places views below tile size; `other_dates` are orthophotos of the same ground to
    learn the confidence from, besides `calibration_views` views made of the reference itself; a
    triplet network learns from them too. `edges` None is what suits the method. `work` is a folder
    for checkpoints of networks and finished blocks, from which a build that was interrupted goes
    on; without it the blocks of a large map are kept in `OUT.work` until it is written. `workers`
    threads read the imagery, None: one for each core. With `cells` the map carries what new tiles
    are embedded from without the imagery (method gradient only): for sheets of an atlas."""

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
    workers: int | None = None
    cells: bool = False


@dataclass(frozen=True)
class BuildResult:
    """What came out: the manifest as written and the size of the file."""

    manifest: Manifest
    size_bytes: int


def build_map(
    request: BuildRequest,
    progress: Progress | None = None,
    tell: Callable[[str], None] = log.info,
) -> BuildResult:
    """Build a map and write it to `request.out`, whole or not at all.

    The same request gives the same bytes. `progress` is called with a stage and its share done,
    `tell` once with what will be built. Raises `MissingFileError`, `ImageryError`, `AreaError`,
    `VariantError` or `OutputError`.
    """
    report = progress or (lambda stage, share: None)
    representation = make_variant(represent.TABLE, request.edges or usual_edges(request.method))
    recipe = method_recipe(request.method, representation)
    mosaic = Mosaic.open(request.orthos)
    mosaic_of_dates = [Mosaic.open([path]) for path in request.other_dates]
    inputs = [source.path for each in (mosaic, *mosaic_of_dates) for source in each.sources]
    if request.out.exists() and any(request.out.samefile(path) for path in inputs):
        raise OutputError(f"the map would replace an orthophoto; name another file: {request.out}")
    area = _area(request, mosaic)
    grid = grid_of(area, mosaic.gsd_m, request.gsd_m, request.tile_px, request.overlap)
    if request.seed < 0:
        raise VariantError(f"seed must be 0 or more, got {request.seed}")
    if not 1 <= request.calibration_views <= MAX_CALIBRATION_VIEWS:
        raise VariantError(
            f"calibration views must be 1 to {MAX_CALIBRATION_VIEWS}, "
            f"got {request.calibration_views}"
        )
    if request.workers is not None and not 1 <= request.workers <= MAX_WORKERS:
        raise VariantError(f"workers must be 1 to {MAX_WORKERS}, got {request.workers}")
    pictures = None if isinstance(recipe, WhitenedRecipe) else SheetPictures(grid, representation)
    tell(_announced(area, grid, request))
    reader = SheetReader(
        mosaic,
        area,
        grid,
        representation,
        CropSampler(grid.tile_px, request.seed),
        registration=request.registration,
        pictures=pictures,
    )
    with reader.kept(*_folders(request)) as kept:
        reader.read(report, request.workers, kept)
        manifest, arrays = _learnt(request, recipe, mosaic, mosaic_of_dates, reader, report)
        written = write_map(request.out, manifest, arrays)
    return BuildResult(written, request.out.stat().st_size)


def _announced(area: Area, grid: TileGrid, request: BuildRequest) -> str:
    """What is about to be built, in a line."""
    need = estimate_map(
        area,
        gsd_m=grid.gsd_m,
        tile_px=grid.tile_px,
        overlap=1 - grid.stride_px / grid.tile_px,
        registration=request.registration,
    )
    least, most = need.map_mb
    size = f"{most:.1f} MB" if most - least < 0.1 else f"{least:.1f} to {most:.1f} MB"
    more = "" if request.method.startswith("gradient") else ", and learning the network"
    return (
        f"about {need.area_km2:.1f} km2, {need.tiles:,} tiles of {grid.tile_px} px at "
        f"{grid.gsd_m:g} m, a map of {size}, {need.build_s / 60:.1f} min on one core{more}"
    )


def _folders(request: BuildRequest) -> tuple[Path, Path | None]:
    """Where finished blocks are kept: beside the map, and in the work folder if one was named."""
    beside = request.out.with_name(f"{request.out.name}.work")
    return beside, None if request.work is None else request.work / f"blocks-{request.out.name}"


def _learnt(
    request: BuildRequest,
    recipe: WhitenedRecipe | EncoderRecipe,
    mosaic: Mosaic,
    other_dates: Sequence[Mosaic],
    read: SheetReader,
    report: Progress,
) -> tuple[Manifest, dict[str, NDArray[Any]]]:
    """Manifest and arrays of the map of a sheet that was read."""
    area, grid, representation = read.area, read.grid, read.representation
    tiles_rc = tiles_of(area, grid, read.cells)
    centres = grid.centres_en_m(tiles_rc).astype(np.float32)
    embedder, embeddings = _embedded(request, recipe, tiles_rc, other_dates, read, report)
    calibration = calibrate(
        read.sampler,
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
    grey, grey_parts = (None, {}) if read.layer is None else read.layer.finish()
    area_km2 = round(len(tiles_rc) * grid.stride_m**2 / 1e6, 6)
    sheet = SheetInfo(area.frame, grid, len(tiles_rc), area_km2, grey)
    manifest = _manifest(request, mosaic, sheet, representation, embedder, calibration)
    arrays: dict[str, NDArray[Any]] = {
        "sheet0/centres_en_m": centres,
        "sheet0/embeddings": embeddings,
        "sheet0/preview_jpeg": read.preview.jpeg(),
        **{f"embed/{name}": array for name, array in embedder.parts().items()},
        **grey_parts,
    }
    if request.cells and isinstance(recipe, WhitenedRecipe):
        arrays |= cell_parts(read.cells)
    if grey is not None:
        registration = _registration(request, other_dates, manifest, arrays, read, embedder, report)
        manifest = replace(manifest, registration=registration)
    return manifest, arrays


def _embedded(
    request: BuildRequest,
    recipe: WhitenedRecipe | EncoderRecipe,
    tiles_rc: NDArray[np.intp],
    other_dates: Sequence[Mosaic],
    read: SheetReader,
    report: Progress,
) -> tuple[ViewEmbedder, NDArray[np.float16]]:
    """What embeds views, learnt from the tiles, and the tiles' embeddings (N, D)."""
    tiles_px = tiles_rc * read.grid.stride_px
    report("learn", 0.0)
    embedder: ViewEmbedder
    if isinstance(recipe, WhitenedRecipe):
        embedder = whitened = learn(recipe, read.cells, tiles_px)
        embeddings = whitened.tiles(read.cells, tiles_px)
    else:
        assert read.pictures is not None
        dates = [
            read_pictures(date, read.area, read.grid, read.representation, report)
            for date in (other_dates if isinstance(recipe, TripletRecipe) else ())
        ]
        embedder, embeddings = learn_encoder(
            recipe,
            read.pictures,
            dates,
            tiles_px,
            read.representation,
            request.seed,
            request.work,
            report,
        )
    report("learn", 1.0)
    return embedder, embeddings


def _registration(
    request: BuildRequest,
    other_dates: Sequence[Mosaic],
    manifest: Manifest,
    arrays: dict[str, NDArray[Any]],
    read: SheetReader,
    embedder: ViewEmbedder,
    report: Progress,
) -> dict[str, Any]:
    """What the manifest says of registration: placed on the map as it will be written."""
    sheet = manifest.sheets[0]
    radius_m = max(RADIUS_PX * sheet.grid.gsd_m, MIN_RADIUS_M)
    unfitted = {"confidence": None, "radius_m": radius_m, "position_floor_px": FLOOR_PX}
    made = MapFile(request.out, 0, replace(manifest, registration=unfitted), arrays)
    tiles = TileMatcher(sheet.grid, arrays["sheet0/centres_en_m"], arrays["sheet0/embeddings"])
    localizer = RegistrationLocalizer.of_map(
        made,
        TileProposer.of(tiles, embedder, read.representation),
        SearchPlan(last_ms=SEARCH_MS),
    )
    assert localizer is not None
    later = [
        crop
        for each in other_dates
        for crop in _crops_of(each, read.area, sheet.grid, read.sampler)
    ]
    if other_dates and not later:
        log.warning("the other dates do not cover the area: nothing can be learnt from them")
    learnt = calibrate_registration(
        localizer, read.sampler.crops, later, request.calibration_views, request.seed, report
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
            pixels = raster.read_grey(col, row, size, size)
            if pixels.valid.all() and pixels.grey.std() > 1:
                found.append(Crop(pixels.grey, crop.row_px, crop.col_px))
    return found


def _area(request: BuildRequest, mosaic: Mosaic) -> Area:
    if request.route is not None and request.bounds_deg is not None:
        raise AreaError("give a route with a band, or bounds, not both")
    if request.route is not None:
        return Area.from_route(request.route, request.band_m)
    if request.band_m is not None:
        raise AreaError("a search band needs a route (--route)")
    if request.bounds_deg is not None:
        return Area.from_bounds(request.bounds_deg)
    outline = mosaic.outline_latlon_deg
    return Area.from_outline(outline[:, 0], outline[:, 1])


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
        imagery=mosaic.describe(),
        view={
            "heading_step_deg": HEADING_STEP_DEG,
            "min_valid_share": MIN_VIEW_VALID_SHARE,
            "position_std_m": calibration.position_std_m,
        },
        confidence=calibration.confidence.to_plain() if calibration.confidence else None,
        radius_m=RADIUS_STRIDES * sheet.grid.stride_m,
        created_by=f"orthonav {__version__}",
    )
