"""Building a map: read the sheet, learn the embedding, calibrate, write the map.

Imagery is read by blocks. In memory stay seven numbers per micro-cell (about 0.5 MB per km2 at 1 m
and 256 px tiles) and the compressed registration layer (0.15 to 0.35 MB per km2 at 1 m).
"""

import logging
import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from orthonav import __version__
from orthonav.core.errors import AreaError, OutputError, VariantError
from orthonav.core.files import GivenPath, Progress, no_progress, with_paths
from orthonav.core.geo.ground import RELIEF_SLOPES
from orthonav.core.geo.swapped import swapped_hint
from orthonav.core.localize.confidence import DEFAULT_TILE_CONFIDENCE
from orthonav.core.localize.plan import SearchPlan
from orthonav.core.localize.prepared import PreparedMap
from orthonav.core.localize.tiles import TileMatcher, TileProposer
from orthonav.core.mapfile.manifest import Manifest, SheetInfo
from orthonav.core.mapfile.reader import MapFile, write_map
from orthonav.core.tiles import embed, represent
from orthonav.core.tiles.embed import ViewEmbedder
from orthonav.core.tiles.network import TripletRecipe
from orthonav.core.tiles.whitened import WhitenedRecipe
from orthonav.core.variants import make_variant, variant_recipe
from orthonav.ground.build.calibrate import (
    CALIBRATION,
    CROPS,
    Crop,
    CropSampler,
    TileCalibration,
    calibrate,
    calibrate_registration,
)
from orthonav.ground.build.encoders import (
    EncoderRecipe,
    check_device,
    learn_encoder,
    method_recipe,
    stored_representation,
    usual_edges,
)
from orthonav.ground.build.layer import HeightLayers, height_layers
from orthonav.ground.build.sheet import SheetPictures, SheetReader, grid_of, read_pictures, tiles_of
from orthonav.ground.build.whitening import learn
from orthonav.ground.imagery.mosaic import Mosaic
from orthonav.ground.imagery.terrain import open_dem
from orthonav.ground.planning.area import Area, Extent, require_one_area
from orthonav.ground.planning.route import Route

MAX_WORKERS = 64
MAX_CALIBRATION_VIEWS = 2 * CROPS
"""Number of crops collected while the imagery is read."""


@dataclass(frozen=True)
class BuildRequest:
    """Parameters of a build; with neither `bounds_deg` nor `route` of all of the imagery."""

    orthos: Sequence[GivenPath]  # at least one; earlier ones take precedence
    out: GivenPath  # map file to write
    bounds_deg: Extent | None = None  # area as west, south, east, north
    route: Route | None = None  # whose search band is the area
    band_m: float | None = None  # width of the band for legs without a width of their own
    gsd_m: float | None = None  # metres per pixel; None: that of the finest orthophoto
    tile_px: int = 256  # width of a tile, 16 to 4096
    overlap: float = 0.875  # of neighbouring tiles, as a fraction of their width, 0 to below 1
    method: str = "gradient"  # embedding, `name:field=value,..`, a row of `embed.TABLE`
    edges: str | None = None  # a row of `represent.TABLE`; None: the default of the method
    seed: int = 0  # of all random draws; equal requests give equal bytes
    registration: bool = True  # whether it carries the grey layer that locates below tile size
    other_dates: Sequence[GivenPath] = ()
    """Orthophotos of the same area at other dates, from which the confidence is calibrated, and a
    triplet network learns. They do not become part of the map."""
    calibration_views: int = 24
    """Mirrored views, and views of other dates, that are located, 1 to 384."""
    work: GivenPath | None = None
    """Folder of checkpoints of a network, from which an interrupted training resumes."""
    workers: int | None = None  # threads, 1 to 64; None: one per core
    dem: GivenPath | None = None  # terrain model; None: the map has no terrain layer
    surface: Sequence[GivenPath] = ()
    """Surface models with houses and trees; earlier ones take precedence. Without `dem` their lower
    envelope is the terrain."""
    true_ortho: bool = False
    """Houses stand upright in the orthophotos; else how far they lean is estimated."""
    bands: tuple[int, ...] | None = None
    """That are used, one or three, from 1; None: colours, or the first."""
    dem_datum: str | None = None
    """What heights count from, where the files do not state it (`imagery.terrain.OPTION`)."""
    dem_needed: bool = True  # whether an area in which a model has no height is refused
    relief: str | None = None
    """What the land is like where there is no terrain, a key of `RELIEF_SLOPES`; None: not stated.
    Not with `dem` or `surface`."""
    epoch: float | None = None  # decimal year of positions that drift with a plate
    device: str = "auto"  # where a network is learnt; or "cpu", "cuda"

    def __post_init__(self) -> None:
        if isinstance(self.orthos, str | os.PathLike):
            object.__setattr__(self, "orthos", (self.orthos,))
        with_paths(self, "orthos", "out", "other_dates", "work", "dem", "surface")


@dataclass(frozen=True)
class BuildResult:
    manifest: Manifest
    size_bytes: int


@dataclass(frozen=True, eq=False)
class _Inputs:
    request: BuildRequest
    mosaic: Mosaic
    other_dates: tuple[Mosaic, ...]
    recipe: WhitenedRecipe | EncoderRecipe
    sheet: SheetReader
    heights: HeightLayers

    @classmethod
    def open(cls, request: BuildRequest) -> "_Inputs":
        representation = make_variant(represent.TABLE, request.edges or usual_edges(request.method))
        recipe = method_recipe(request.method, representation)
        check_device(request.device)
        mosaic = Mosaic.open(request.orthos, request.epoch, request.bands)
        other_dates = tuple(
            Mosaic.open([path], request.epoch, request.bands) for path in request.other_dates
        )
        inputs = [source.path for each in (mosaic, *other_dates) for source in each.sources]
        inputs += [*request.surface, *([] if request.dem is None else [request.dem])]
        if request.out.exists() and any(request.out.samefile(path) for path in inputs):
            raise OutputError(
                f"the map would replace an orthophoto or terrain; name another file: {request.out}"
            )
        area = _area(request, mosaic)
        grid = grid_of(area, mosaic.gsd_m, request.gsd_m, request.tile_px, request.overlap)
        _check_numbers(request)
        dem = None if request.dem is None else open_dem(request.dem, request.dem_datum)
        models = [open_dem(path, request.dem_datum) for path in request.surface]
        imagery = None if request.true_ortho else mosaic
        heights = height_layers(dem, models, area, grid, imagery, needed=request.dem_needed)
        # Networks and visual words learn from images of the tiles, not from cell means.
        needs_pictures = not isinstance(recipe, WhitenedRecipe)
        sheet = SheetReader(
            area,
            grid,
            representation,
            CropSampler(grid.tile_px, request.seed, min(grid.height_px, grid.width_px)),
            registration=request.registration,
            pictures=SheetPictures(grid, representation) if needs_pictures else None,
        )
        return cls(request, mosaic, other_dates, recipe, sheet, heights)


def _check_numbers(request: BuildRequest) -> None:
    if request.seed < 0:
        raise VariantError(f"seed must be 0 or more, got {request.seed}")
    if not 1 <= request.calibration_views <= MAX_CALIBRATION_VIEWS:
        raise VariantError(
            f"calibration views must be 1 to {MAX_CALIBRATION_VIEWS}, "
            f"got {request.calibration_views}"
        )
    if request.workers is not None and not 1 <= request.workers <= MAX_WORKERS:
        raise VariantError(f"workers must be 1 to {MAX_WORKERS}, got {request.workers}")
    require_relief(request.relief, request.dem, request.surface)
    require_surface(request.surface, true_ortho=request.true_ortho)


def require_surface(surface: Sequence[Path], *, true_ortho: bool) -> None:
    """Raise `VariantError` for true orthophotos without a surface, where it changes nothing."""
    if true_ortho and not surface:
        raise VariantError("--true-ortho says how houses of --surface stand: give one")


def require_relief(relief: str | None, dem: Path | None, surface: Sequence[Path]) -> None:
    """Raise `VariantError` for an unknown relief, and for one beside a terrain or surface model."""
    if relief is not None and relief not in RELIEF_SLOPES:
        raise VariantError(f"relief must be {', '.join(RELIEF_SLOPES)}, got '{relief:.40}'")
    if relief is not None and (dem is not None or surface):
        raise VariantError(
            "the terrain model says what the land is like: give --dem, --surface or --relief"
        )


def _area(request: BuildRequest, mosaic: Mosaic) -> Area:
    require_one_area(request.route, request.band_m, request.bounds_deg)
    outline = mosaic.outline_latlon_deg
    if request.route is not None:
        area = Area.from_route(request.route, request.band_m)
    elif request.bounds_deg is not None:
        area = Area.from_bounds(request.bounds_deg)
    else:
        return Area.from_outline(outline[:, 0], outline[:, 1])
    _check_near(area, outline)
    return area


def _check_near(area: Area, outline_deg: NDArray[np.float64]) -> None:
    """Refuse an area outside the box around the imagery (outline (N, 2))."""
    turns = np.round((outline_deg[:, 1] - outline_deg[0, 1]) / 360)  # across the antimeridian
    outline_deg = outline_deg - turns[:, None] * [0, 360]
    (south, west), (north, east) = outline_deg.min(axis=0), outline_deg.max(axis=0)

    def is_within(lat_deg: float, lon_deg: float) -> bool:
        return bool(south <= lat_deg <= north and 0 <= (lon_deg - west) % 360 <= east - west)

    centre = area.frame.lat_deg, area.frame.lon_deg
    lat, lon = area.frame.latlon_from_en(np.array(area.extent_en_m).reshape(2, 2))
    lon += 360 * np.round(((west + east) / 2 - lon) / 360)
    if lat[1] < south or lat[0] > north or lon[1] < west or lon[0] > east:
        raise AreaError(
            f"the area, at {centre[0]:.4f}, {centre[1]:.4f}, has no imagery: the orthophotos cover "
            f"{south:.4f} to {north:.4f} N, {west:.4f} to {east:.4f} E"
            f"{swapped_hint(*centre, is_within)}"
        )


log = logging.getLogger(__name__)

MIN_VIEW_VALID_SHARE = 0.4
"""Of a tile that a view must cover; below, tile matching fails."""
SEARCH_MS = 100.0
"""Per view in calibration, which places many views."""
RADIUS_PX = 10.0
MIN_RADIUS_M = 35.0
"""A registered view is correct within this many pixels or metres, whichever is more: unreported
tilt alone displaces views by metres."""


def build_map(request: BuildRequest, progress: Progress | None = None) -> BuildResult:
    """Build a map and write it to `request.out`, complete or not at all.

    Equal requests give equal bytes. `progress` is called with a stage and its finished share
    (0..1). Raises `MissingFileError`, `ImageryError`, `AreaError`, `VariantError` or `OutputError`.
    """
    progress = progress or no_progress
    inputs = _Inputs.open(request)
    sheet, grid = inputs.sheet, inputs.sheet.grid
    with inputs.mosaic.grid_sheet(sheet.area.frame, grid, threads=1) as raster:
        sheet.read(raster, progress, request.workers)
    tiles_rc = tiles_of(sheet.area, grid, sheet.cells)
    embedder, embeddings = _learned(inputs, tiles_rc * grid.stride_px, progress)
    tiles = TileMatcher(grid, grid.centres_en_m(tiles_rc).astype(np.float32), embeddings)
    name = stored_representation(sheet.representation)["name"]
    is_usual = isinstance(embedder.recipe, WhitenedRecipe) and name == "gradient"
    calibration = calibrate(
        sheet.crops,
        tiles,
        sheet.representation,
        embedder,
        progress,
        usual=DEFAULT_TILE_CONFIDENCE if is_usual else None,
        slow=not represent.TABLE[name].flies,
    )
    info, arrays = sheet.finish(tiles_rc, embedder, embeddings, inputs.heights, request.relief)
    manifest = _manifest(inputs, info, embedder, calibration)
    if request.registration:
        found = _registration(inputs, tiles, embedder, manifest, arrays, progress)
        manifest = replace(manifest, registration=found)
    written = write_map(request.out, manifest, arrays)
    return BuildResult(written, request.out.stat().st_size)


def _learned(
    inputs: _Inputs, tiles_px: NDArray[np.intp], progress: Progress
) -> tuple[ViewEmbedder, NDArray[np.float16]]:
    """What embeds views, and embeddings (N, D) of the tiles with these first pixels (N, 2)."""
    sheet, recipe = inputs.sheet, inputs.recipe
    progress("learn", 0.0)
    embedder: ViewEmbedder
    if isinstance(recipe, WhitenedRecipe):
        embedder = whitened = learn(recipe, sheet.cells, tiles_px)
        embeddings = whitened.tiles(sheet.cells, tiles_px)
    else:
        assert sheet.pictures is not None
        dates = [
            read_pictures(date, sheet.area, sheet.grid, sheet.representation, progress)
            for date in (inputs.other_dates if isinstance(recipe, TripletRecipe) else ())
        ]
        embedder, embeddings = learn_encoder(
            *(recipe, sheet.pictures, dates, tiles_px, sheet.representation),
            inputs.request,
            progress,
        )
    progress("learn", 1.0)
    return embedder, embeddings


def _manifest(
    inputs: _Inputs, info: SheetInfo, embedder: ViewEmbedder, calibration: TileCalibration
) -> Manifest:
    """Without the calibration of registration."""
    request, sheet = inputs.request, inputs.sheet
    return Manifest(
        recipe={
            "method": request.method.partition(":")[0],
            "represent": stored_representation(sheet.representation),
            "embed": variant_recipe(embed.TABLE, embedder.recipe),
            "overlap": request.overlap,
            "seed": request.seed,
        },
        sheets=(info,),
        imagery=inputs.mosaic.describe(),
        view={
            "heading_step_deg": CALIBRATION.heading_step_deg,
            "min_valid_share": MIN_VIEW_VALID_SHARE,
            "position_std_m": calibration.position_std_m,
        },
        confidence=calibration.confidence.to_plain(),
        radius_m=CALIBRATION.radius_strides * sheet.grid.stride_m,
        created_by=f"orthonav {__version__}",
    )


def _registration(
    inputs: _Inputs,
    tiles: TileMatcher,
    embedder: ViewEmbedder,
    manifest: Manifest,
    arrays: dict[str, NDArray[Any]],
    progress: Progress,
) -> dict[str, Any]:
    """Its record in the manifest, calibrated on the map as it will be written."""
    request, sheet = inputs.request, inputs.sheet
    radius_m = max(RADIUS_PX * sheet.grid.gsd_m, MIN_RADIUS_M)
    unfitted = {"confidence": None, "radius_m": radius_m, "position_floor_px": CALIBRATION.floor_px}
    prepared = PreparedMap.of(
        MapFile(request.out, 0, replace(manifest, registration=unfitted), arrays),
        TileProposer.of(tiles, embedder, sheet.representation),
        SearchPlan(last_ms=SEARCH_MS),
        level_ground=True,
    )
    assert prepared is not None
    crops = sheet.crops
    later = [crop for date in inputs.other_dates for crop in _crops_of(date, sheet, crops)]
    if inputs.other_dates and not later:
        log.warning(
            "the other dates do not cover the area, or are the map's own imagery: nothing can be "
            "learned from them"
        )
    found = calibrate_registration(
        prepared, crops, later, request.calibration_views, request.seed, progress
    )
    return unfitted | {
        "confidence": found.confidence.to_plain(),
        "position_floor_px": found.floor_px,
    }


def _crops_of(mosaic: Mosaic, sheet: SheetReader, crops: Sequence[Crop]) -> list[Crop]:
    """The same ground in other imagery; places that were not flown again are left out."""
    found = []
    with mosaic.grid_sheet(sheet.area.frame, sheet.grid) as raster:
        for crop in crops:
            size = crop.grey.shape[0]
            col, row = round(crop.col_px - size / 2), round(crop.row_px - size / 2)
            pixels = raster.read_grey(col, row, size, size)
            again = not np.allclose(pixels.grey, crop.grey, rtol=0, atol=1)  # but for rounding
            if pixels.valid.all() and pixels.grey.std() > 1 and again:
                found.append(Crop(pixels.grey, crop.row_px, crop.col_px))
    return found
