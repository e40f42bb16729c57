"""Building a map: read the sheet, learn the embedding, calibrate, write the map.

Imagery is read by blocks. In memory stay seven numbers per micro-cell (about 0.5 MB per km2 at 1 m
and 256 px tiles) and the compressed registration layer (0.15 to 0.35 MB per km2 at 1 m).
"""

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from orthonav import __version__
from orthonav.core.errors import AreaError, OutputError, VariantError
from orthonav.core.files import Progress, with_paths
from orthonav.core.geo.grid import TileGrid
from orthonav.core.geo.swapped import swapped_hint
from orthonav.core.localize.confidence import USUAL_TILES
from orthonav.core.localize.localizer import RegistrationLocalizer
from orthonav.core.localize.policy import SearchPlan, SearchPolicy
from orthonav.core.localize.tiles import TileMatcher, TileProposer
from orthonav.core.mapfile.manifest import Manifest, SheetInfo
from orthonav.core.mapfile.reader import MapFile, write_map
from orthonav.core.tiles import embed, represent
from orthonav.core.tiles.embed import ViewEmbedder
from orthonav.core.tiles.network import TripletRecipe
from orthonav.core.tiles.whitened import WhitenedRecipe, learn
from orthonav.core.variants import make_variant, variant_recipe
from orthonav.ground.build.calibrate import (
    CROPS,
    FLOOR_PX,
    RADIUS_STRIDES,
    Crop,
    CropSampler,
    TileCalibration,
    calibrate,
    calibrate_registration,
)
from orthonav.ground.build.encoders import (
    EncoderRecipe,
    check_device,
    check_positives,
    learn_encoder,
    method_recipe,
    stored_representation,
    usual_edges,
)
from orthonav.ground.build.layer import cell_parts
from orthonav.ground.build.sheet import SheetPictures, SheetReader, grid_of, read_pictures, tiles_of
from orthonav.ground.build.terrain import TerrainParts, terrain_of_dem
from orthonav.ground.imagery.mosaic import Mosaic
from orthonav.ground.imagery.terrain import open_dem
from orthonav.ground.planning.area import Area, Extent, require_one_area
from orthonav.ground.planning.route import Route
from orthonav.ground.planning.spacing import estimate_map

MAX_WORKERS = 64
MAX_CALIBRATION_VIEWS = 2 * CROPS
"""Number of crops collected while the imagery is read."""


@dataclass(frozen=True)
class BuildRequest:
    """Parameters of a build. With neither `bounds_deg` nor `route`, all of the imagery is mapped.

    - `orthos`: orthophotos; earlier ones take precedence. At least one.
    - `out`: map file to write.
    - `bounds_deg`: area as west, south, east, north, degrees.
    - `route`: route whose search band is the area.
    - `band_m`: width of the search band for legs without a width of their own, metres, above 0.
    - `gsd_m`: ground resolution, metres per pixel, above 0; None: that of the finest orthophoto.
    - `tile_px`: width of a tile, pixels, 16 to 4096.
    - `overlap`: overlap of neighbouring tiles as a fraction of their width, 0 to below 1; 0.875
      gives a stride of 32 pixels at 256.
    - `method`: embedding, `name:field=value,..`, a row of `embed.TABLE`.
    - `edges`: image representation, a row of `represent.TABLE`; None: the default of the method.
    - `seed`: of all random draws, 0 or more; equal requests give equal bytes.
    - `registration`: whether the map carries the grey layer that locates views below tile size.
    - `other_dates`: orthophotos of the same area at other dates, from which the confidence is
      calibrated, and a triplet network learns. They do not become part of the map.
    - `calibration_views`: mirrored views of the reference that measure the scores of chance of
      registration, 1 to 384; as many views of other dates are located.
    - `work`: folder for finished blocks and checkpoints of networks, from which an interrupted
      build resumes; None: blocks of a large map in `OUT.work` until it is written.
    - `workers`: threads that read the imagery and make batches for a network, 1 to 64; None: one
      per core that read, and 2 or, for a GPU, up to 16 that make batches.
    - `device`: where a network is learnt, "auto" (a GPU if there is one), "cpu" or "cuda".
    - `dem`: terrain model from which the map gets a terrain layer; None: it has none.
    - `dem_datum`: what its heights count from, where the file does not state it
      (`orthonav.ground.imagery.terrain.OPTION`).
    - `dem_needed`: whether an area in which the model has no height is refused; else the map has
      no terrain layer.
    - `cells`: whether the map carries the cell means from which new tiles are embedded without
      imagery, for sheets of an atlas; method gradient only.
    """

    orthos: Sequence[Path]
    out: Path
    bounds_deg: Extent | None = None
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
    calibration_views: int = 24
    work: Path | None = None
    workers: int | None = None
    dem: Path | None = None
    dem_datum: str | None = None
    dem_needed: bool = True
    epoch: float | None = None
    device: str = "auto"
    cells: bool = False

    def __post_init__(self) -> None:
        if isinstance(self.orthos, str | Path):
            object.__setattr__(self, "orthos", (self.orthos,))
        with_paths(self, "orthos", "out", "other_dates", "work", "dem")


@dataclass(frozen=True)
class BuildResult:
    manifest: Manifest
    size_bytes: int


@dataclass(frozen=True, eq=False)
class BuildInputs:
    """`representation`: variant of `represent`. `recipe`: embedding to learn."""

    request: BuildRequest
    mosaic: Mosaic
    other_dates: tuple[Mosaic, ...]
    area: Area
    grid: TileGrid
    representation: Any
    recipe: WhitenedRecipe | EncoderRecipe
    terrain: TerrainParts | None = None

    @classmethod
    def open(cls, request: BuildRequest) -> "BuildInputs":
        edges = request.edges or usual_edges(request.method)
        representation = make_variant(represent.TABLE, edges)
        recipe = method_recipe(request.method, representation)
        check_device(request.device)
        if not request.other_dates:
            check_positives(recipe, representation)
        mosaic = Mosaic.open(request.orthos, request.epoch)
        other_dates = tuple(Mosaic.open([path], request.epoch) for path in request.other_dates)
        inputs = [source.path for each in (mosaic, *other_dates) for source in each.sources]
        inputs += [] if request.dem is None else [request.dem]
        if request.out.exists() and any(request.out.samefile(path) for path in inputs):
            raise OutputError(
                f"the map would replace an orthophoto or terrain; name another file: {request.out}"
            )
        area = _area(request, mosaic)
        grid = grid_of(area, mosaic.gsd_m, request.gsd_m, request.tile_px, request.overlap)
        _check_numbers(request)
        terrain = None
        if request.dem is not None:
            dem = open_dem(request.dem, request.dem_datum)
            terrain = terrain_of_dem(dem, area, grid, needed=request.dem_needed)
        return cls(request, mosaic, other_dates, area, grid, representation, recipe, terrain)

    @property
    def learns_network(self) -> bool:
        """From images of the tiles, not from cell means."""
        return not isinstance(self.recipe, WhitenedRecipe)

    def estimate_text(self) -> str:
        grid = self.grid
        need = estimate_map(
            self.area,
            gsd_m=grid.gsd_m,
            tile_px=grid.tile_px,
            overlap=1 - grid.stride_px / grid.tile_px,
            registration=self.request.registration,
        )
        least, most = need.map_mb
        size = f"{most:.1f} MB" if most - least < 0.1 else f"{least:.1f} to {most:.1f} MB"
        more = ", and training the network" if self.learns_network else ""
        return (
            f"about {need.area_km2:.1f} km2, {need.tiles:,} tiles of {grid.tile_px} px at "
            f"{grid.gsd_m:g} m, a map of {size}, {need.build_s / 60:.1f} min on one core{more}"
        )


def _check_numbers(request: BuildRequest) -> None:
    if request.seed < 0:
        raise VariantError(f"seed must be 0 or more, got {request.seed}")
    for name, value, most in (
        ("calibration views", request.calibration_views, MAX_CALIBRATION_VIEWS),
        ("workers", 1 if request.workers is None else request.workers, MAX_WORKERS),
    ):
        if not 1 <= value <= most:
            raise VariantError(f"{name} must be 1 to {most}, got {value}")


def _area(request: BuildRequest, mosaic: Mosaic) -> Area:
    require_one_area(request.route, request.band_m, request.bounds_deg)
    outline = mosaic.outline_latlon_deg
    if request.route is not None:
        area = Area.from_route(request.route, request.band_m)
    elif request.bounds_deg is not None:
        area = Area.from_bounds(request.bounds_deg)
    else:
        return Area.from_outline(outline[:, 0], outline[:, 1])
    _check_not_far(area, outline)
    return area


_FAR_DEG = 0.02
"""About 2 km: an area farther from the box of the imagery is certainly outside it."""


def _check_not_far(area: Area, outline_deg: NDArray[np.float64]) -> None:
    """Refuse an area far from the imagery (outline (N, 2)), or in it with swapped coordinates."""
    south, west = outline_deg.min(axis=0)
    north, east = outline_deg.max(axis=0)

    def within(lat_deg: float, lon_deg: float) -> bool:
        turned = lon_deg + 360 * np.round(((west + east) / 2 - lon_deg) / 360)
        return bool(south <= lat_deg <= north and west <= turned <= east)

    centre = area.frame.lat_deg, area.frame.lon_deg
    lat, lon = area.frame.latlon_from_en(np.array(area.extent_en_m).reshape(2, 2))
    lon += 360 * np.round(((west + east) / 2 - centre[1]) / 360)
    apart_deg = max(south - lat[1], lat[0] - north, west - lon[1], lon[0] - east)
    hint = swapped_hint(*centre, within)
    if apart_deg > _FAR_DEG or (apart_deg > 0 and hint):
        raise AreaError(
            f"the area, at {centre[0]:.4f}, {centre[1]:.4f}, has no imagery: the orthophotos cover "
            f"{south:.4f} to {north:.4f} N, {west:.4f} to {east:.4f} E{hint}"
        )


log = logging.getLogger(__name__)

MIN_VIEW_VALID_SHARE = 0.4
"""Of a tile that a view must cover; below, tile matching fails."""
HEADING_STEP_DEG = 6.0
"""Spacing of the headings that tile matching tries."""
SEARCH_MS = 100.0
"""Per view in calibration, which places many views."""
RADIUS_PX = 10.0
MIN_RADIUS_M = 35.0
"""A registered view is correct within this many pixels or metres, whichever is more: unreported
tilt alone displaces views by metres."""
Arrays = dict[str, NDArray[Any]]


@dataclass(frozen=True, eq=False)
class LearnedEmbedding:
    """Tile centres (N, 2) float32, embeddings (N, D) float16, and what embeds views."""

    centres_en_m: NDArray[np.float32]
    embedder: ViewEmbedder
    embeddings: NDArray[np.float16]


def build_map(
    request: BuildRequest,
    progress: Progress | None = None,
    announce: Callable[[str], None] = log.info,
) -> BuildResult:
    """Build a map and write it to `request.out`, complete or not at all.

    Equal requests give equal bytes. `progress` is called with a stage and its finished share
    (0..1), `announce` once with the estimated size and duration. Raises `MissingFileError`,
    `ImageryError`, `AreaError`, `VariantError` or `OutputError`.
    """
    progress = progress or (lambda stage, share: None)
    inputs = BuildInputs.open(request)
    announce(inputs.estimate_text())
    grid, representation = inputs.grid, inputs.representation
    sheet = SheetReader(
        inputs.mosaic,
        inputs.area,
        grid,
        representation,
        CropSampler(grid.tile_px, request.seed, min(grid.height_px, grid.width_px)),
        registration=request.registration,
        pictures=SheetPictures(grid, representation) if inputs.learns_network else None,
    )
    cache = sheet.block_cache(request.out, request.work)
    sheet.read(progress, request.workers, cache)
    embedding = learn_embedding(inputs, sheet, progress)
    calibration = calibrate_tiles(sheet, embedding, progress)
    manifest, arrays = map_content(inputs, sheet, embedding, calibration)
    if request.registration:
        registration = registration_record(inputs, sheet, embedding, manifest, arrays, progress)
        manifest = replace(manifest, registration=registration)
    written = write_map(request.out, manifest, arrays)
    if cache is not None:
        cache.discard()
    return BuildResult(written, request.out.stat().st_size)


def learn_embedding(
    inputs: BuildInputs, sheet: SheetReader, progress: Progress
) -> LearnedEmbedding:
    grid, recipe, request = inputs.grid, inputs.recipe, inputs.request
    tiles_rc = tiles_of(inputs.area, grid, sheet.cells)
    tiles_px = tiles_rc * grid.stride_px
    centres = grid.centres_en_m(tiles_rc).astype(np.float32)
    embedder: ViewEmbedder
    progress("learn", 0.0)
    if isinstance(recipe, WhitenedRecipe):
        embedder = whitened = learn(recipe, sheet.cells, tiles_px)
        embeddings = whitened.tiles(sheet.cells, tiles_px)
    else:
        assert sheet.pictures is not None
        dates = [
            read_pictures(date, inputs.area, grid, inputs.representation, progress)
            for date in (inputs.other_dates if isinstance(recipe, TripletRecipe) else ())
        ]
        embedder, embeddings = learn_encoder(
            recipe,
            sheet.pictures,
            dates,
            tiles_px,
            inputs.representation,
            request,
            progress,
        )
    progress("learn", 1.0)
    return LearnedEmbedding(centres, embedder, embeddings)


def calibrate_tiles(
    sheet: SheetReader, embedding: LearnedEmbedding, progress: Progress
) -> TileCalibration:
    representation = sheet.representation
    name = stored_representation(representation)["name"]
    is_usual = isinstance(embedding.embedder.recipe, WhitenedRecipe) and name == "gradient"
    return calibrate(
        sheet.sampler,
        sheet.grid,
        representation,
        embedding.embedder,
        embedding.embeddings,
        embedding.centres_en_m,
        HEADING_STEP_DEG,
        progress,
        usual=USUAL_TILES if is_usual else None,
        slow=not represent.TABLE[name].flies,
    )


def map_content(
    inputs: BuildInputs,
    sheet: SheetReader,
    embedding: LearnedEmbedding,
    calibration: TileCalibration,
) -> tuple[Manifest, Arrays]:
    """Without the calibration of registration."""
    request, grid, embedder = inputs.request, inputs.grid, embedding.embedder
    grey, grey_parts = (None, {}) if sheet.layer is None else sheet.layer.finish()
    tiles = len(embedding.centres_en_m)
    area_km2 = round(tiles * grid.stride_m**2 / 1e6, 6)
    terrain, terrain_parts = (None, {}) if inputs.terrain is None else inputs.terrain
    sheet_info = SheetInfo(inputs.area.frame, grid, tiles, area_km2, grey, terrain)
    manifest = Manifest(
        recipe={
            "method": request.method.partition(":")[0],
            "represent": stored_representation(inputs.representation),
            "embed": variant_recipe(embed.TABLE, embedder.recipe),
            "overlap": request.overlap,
            "seed": request.seed,
        },
        sheets=(sheet_info,),
        imagery=inputs.mosaic.describe(),
        view={
            "heading_step_deg": HEADING_STEP_DEG,
            "min_valid_share": MIN_VIEW_VALID_SHARE,
            "position_std_m": calibration.position_std_m,
        },
        confidence=calibration.confidence.to_plain(),
        radius_m=RADIUS_STRIDES * grid.stride_m,
        created_by=f"orthonav {__version__}",
    )
    arrays: Arrays = {
        "sheet0/centres_en_m": embedding.centres_en_m,
        "sheet0/embeddings": embedding.embeddings,
        "sheet0/preview_jpeg": sheet.preview.jpeg(),
        **{f"embed/{name}": array for name, array in embedder.parts().items()},
        **grey_parts,
        **terrain_parts,
    }
    if request.cells and isinstance(inputs.recipe, WhitenedRecipe):
        arrays |= cell_parts(sheet.cells)
    return manifest, arrays


def registration_record(
    inputs: BuildInputs,
    sheet: SheetReader,
    embedding: LearnedEmbedding,
    manifest: Manifest,
    arrays: Arrays,
    progress: Progress,
) -> dict[str, Any]:
    """Calibrated on the map as it will be written."""
    request, grid = inputs.request, inputs.grid
    radius_m = max(RADIUS_PX * grid.gsd_m, MIN_RADIUS_M)
    unfitted = {"confidence": None, "radius_m": radius_m, "position_floor_px": FLOOR_PX}
    made = MapFile(request.out, 0, replace(manifest, registration=unfitted), arrays)
    tiles = TileMatcher(grid, embedding.centres_en_m, embedding.embeddings)
    localizer = RegistrationLocalizer.of_map(
        made,
        TileProposer.of(tiles, embedding.embedder, inputs.representation),
        SearchPlan(policy=SearchPolicy(last_ms=SEARCH_MS)),
    )
    assert localizer is not None
    crops = sheet.sampler.crops
    later = [crop for date in inputs.other_dates for crop in _crops_of(date, inputs, crops)]
    if inputs.other_dates and not later:
        log.warning("the other dates do not cover the area: nothing can be learned from them")
    learned = calibrate_registration(
        localizer, crops, later, request.calibration_views, request.seed, progress
    )
    return {
        "confidence": learned.confidence.to_plain(),
        "radius_m": radius_m,
        "position_floor_px": learned.floor_px,
    }


def _crops_of(mosaic: Mosaic, inputs: BuildInputs, crops: Sequence[Crop]) -> list[Crop]:
    """Crops of another date at the positions of the reference crops."""
    found = []
    with mosaic.grid_sheet(inputs.area.frame, inputs.grid) as raster:
        for crop in crops:
            size = crop.grey.shape[0]
            col, row = round(crop.col_px - size / 2), round(crop.row_px - size / 2)
            pixels = raster.read_grey(col, row, size, size)
            if pixels.valid.all() and pixels.grey.std() > 1:
                found.append(Crop(pixels.grey, crop.row_px, crop.col_px))
    return found
