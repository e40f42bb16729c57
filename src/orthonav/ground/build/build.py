"""Building a map: read the sheet, learn the embedding, calibrate, write the map.

Imagery is read block by block, so memory depends on the area, not on the orthophotos. In memory
stay seven numbers per micro-cell (about 0.5 MB per km2 at 1 m and 256 px tiles) and the compressed
registration layer (0.15 to 0.35 MB per km2 at 1 m).
"""

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from orthonav import __version__
from orthonav.core.files import Progress
from orthonav.core.localize.logistic import USUAL
from orthonav.core.localize.match import TileMatcher
from orthonav.core.localize.plan import SearchPlan
from orthonav.core.localize.propose import TileProposer
from orthonav.core.localize.registration import RegistrationLocalizer
from orthonav.core.mapfile.manifest import Manifest, SheetInfo
from orthonav.core.mapfile.reader import MapFile
from orthonav.core.mapfile.writer import write_map
from orthonav.core.tiles import embed, represent
from orthonav.core.tiles.contract import ViewEmbedder
from orthonav.core.tiles.network import TripletRecipe
from orthonav.core.tiles.whitened import WhitenedRecipe, learn
from orthonav.core.variants import variant_recipe
from orthonav.ground.build.caevl import learn_caevl
from orthonav.ground.build.calibrate import (
    RADIUS_STRIDES,
    Crop,
    CropSampler,
    TileCalibration,
    calibrate,
)
from orthonav.ground.build.calibrate_registration import FLOOR_PX, calibrate_registration
from orthonav.ground.build.cellparts import cell_parts
from orthonav.ground.build.encoders import Learning, learn_encoder
from orthonav.ground.build.layout import tiles_of
from orthonav.ground.build.methods import stored_representation
from orthonav.ground.build.pictures import SheetPictures, read_pictures
from orthonav.ground.build.request import BuildInputs, BuildRequest, BuildResult
from orthonav.ground.build.sheet import SheetReader
from orthonav.ground.imagery.mosaic import Mosaic
from orthonav.research.caevl_recipe import CaevlRecipe

__all__ = ["BuildRequest", "BuildResult", "build_map"]

log = logging.getLogger(__name__)

MIN_VIEW_VALID_SHARE = 0.4
"""Least share of a tile that a view must cover; below, tile matching fails."""
HEADING_STEP_DEG = 6.0
"""Spacing of the headings that tile matching tries."""
SEARCH_MS = 100.0
"""Largest estimated search time per view in calibration, which places many views."""
RADIUS_PX = 10.0
MIN_RADIUS_M = 35.0
"""A registered view is correct within this many pixels or metres, whichever is more: unreported
tilt alone displaces views by metres."""
Arrays = dict[str, NDArray[Any]]


@dataclass(frozen=True, eq=False)
class LearnedEmbedding:
    """Reference tiles with their embeddings.

    `centres_en_m` (N, 2) float32, `embeddings` (N, D) float16; `embedder` embeds views.
    """

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
    sheet = _sheet_reader(inputs)
    with sheet.block_cache(*_cache_folders(request)) as cache:
        sheet.read(progress, request.workers, cache)
        embedding = learn_embedding(inputs, sheet, progress)
        calibration = calibrate_tiles(sheet, embedding, progress)
        manifest, arrays = map_content(inputs, sheet, embedding, calibration)
        if request.registration:
            registration = registration_record(inputs, sheet, embedding, manifest, arrays, progress)
            manifest = replace(manifest, registration=registration)
        written = write_map(request.out, manifest, arrays)
    return BuildResult(written, request.out.stat().st_size)


def _sheet_reader(inputs: BuildInputs) -> SheetReader:
    grid, representation = inputs.grid, inputs.representation
    return SheetReader(
        inputs.mosaic,
        inputs.area,
        grid,
        representation,
        CropSampler(grid.tile_px, inputs.request.seed, min(grid.height_px, grid.width_px)),
        registration=inputs.request.registration,
        pictures=SheetPictures(grid, representation) if inputs.learns_network else None,
    )


def _cache_folders(request: BuildRequest) -> tuple[Path, Path | None]:
    """Folders for finished blocks: next to the map, and in the work folder if one is given."""
    default = request.out.with_name(f"{request.out.name}.work")
    return default, None if request.work is None else request.work / f"blocks-{request.out.name}"


def learn_embedding(
    inputs: BuildInputs, sheet: SheetReader, progress: Progress
) -> LearnedEmbedding:
    """Learn the embedding from the reference tiles of a sheet, and embed them.

    Raises `AreaError` if no tile has imagery.
    """
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
        learn_images = learn_caevl if isinstance(recipe, CaevlRecipe) else learn_encoder
        embedder, embeddings = learn_images(
            recipe,
            sheet.pictures,
            dates,
            tiles_px,
            inputs.representation,
            Learning(request.seed, request.work, request.device, request.workers),
            progress,
        )
    progress("learn", 1.0)
    return LearnedEmbedding(centres, embedder, embeddings)


def calibrate_tiles(
    sheet: SheetReader, embedding: LearnedEmbedding, progress: Progress
) -> TileCalibration:
    """Calibrate the confidence of tile matches on generated views of the sheet."""
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
        usual=USUAL if is_usual else None,
        slow=not represent.TABLE[name].flies,
    )


def map_content(
    inputs: BuildInputs,
    sheet: SheetReader,
    embedding: LearnedEmbedding,
    calibration: TileCalibration,
) -> tuple[Manifest, Arrays]:
    """Manifest and arrays of the map, without the calibration of registration."""
    request, grid, embedder = inputs.request, inputs.grid, embedding.embedder
    grey, grey_parts = (None, {}) if sheet.layer is None else sheet.layer.finish()
    tiles = len(embedding.centres_en_m)
    area_km2 = round(tiles * grid.stride_m**2 / 1e6, 6)
    terrain, terrain_parts = (None, {}) if inputs.terrain is None else inputs.terrain.content
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
    """The `registration` record of the manifest, calibrated on the map as it will be written."""
    request, grid = inputs.request, inputs.grid
    radius_m = max(RADIUS_PX * grid.gsd_m, MIN_RADIUS_M)
    unfitted = {"confidence": None, "radius_m": radius_m, "position_floor_px": FLOOR_PX}
    made = MapFile(request.out, 0, replace(manifest, registration=unfitted), arrays)
    tiles = TileMatcher(grid, embedding.centres_en_m, embedding.embeddings)
    localizer = RegistrationLocalizer.of_map(
        made,
        TileProposer.of(tiles, embedding.embedder, inputs.representation),
        SearchPlan(last_ms=SEARCH_MS),
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
    """Crops of another date at the positions of the reference crops, where fully covered."""
    found = []
    with mosaic.grid_sheet(inputs.area.frame, inputs.grid) as raster:
        for crop in crops:
            size = crop.grey.shape[0]
            col, row = round(crop.col_px - size / 2), round(crop.row_px - size / 2)
            pixels = raster.read_grey(col, row, size, size)
            if pixels.valid.all() and pixels.grey.std() > 1:
                found.append(Crop(pixels.grey, crop.row_px, crop.col_px))
    return found
