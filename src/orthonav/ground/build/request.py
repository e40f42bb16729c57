"""The request of a build, and its validated inputs: imagery, area, tile grid and recipe."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from orthonav.core.errors import AreaError, OutputError, VariantError
from orthonav.core.files import with_paths
from orthonav.core.geo.grid import TileGrid
from orthonav.core.geo.swapped import swapped_hint
from orthonav.core.mapfile.manifest import Manifest
from orthonav.core.tiles import represent
from orthonav.core.tiles.whitened import WhitenedRecipe
from orthonav.core.variants import make_variant
from orthonav.ground.build.calibrate import CROPS
from orthonav.ground.build.encoders import EncoderRecipe
from orthonav.ground.build.layout import grid_of
from orthonav.ground.build.methods import check_device, check_positives, method_recipe, usual_edges
from orthonav.ground.build.terrain import TerrainParts, terrain_of_dem
from orthonav.ground.imagery.mosaic import Mosaic
from orthonav.ground.imagery.terrain import open_dem
from orthonav.ground.planning.area import Area, Extent, require_one_area
from orthonav.ground.planning.estimate import estimate_map
from orthonav.ground.planning.route import Route

MAX_WORKERS = 64
"""Sanity limit on threads."""
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
    - `overlap`: overlap of neighbouring tiles as a share of their width, 0 to below 1; 0.875
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
      (`orthonav.ground.imagery.datum.OPTION`).
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
    """A finished build: the manifest as written, and the size of the file in bytes."""

    manifest: Manifest
    size_bytes: int


@dataclass(frozen=True, eq=False)
class BuildInputs:
    """Opened and validated inputs of a build.

    `mosaic`: reference imagery. `other_dates`: one mosaic per other date. `area`, `grid`: extent
    and tiles of the map. `representation`: variant of `represent`. `recipe`: embedding to learn.
    `terrain`: the map's terrain layer, None without one.
    """

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
        """Open the imagery and check the request.

        Raises `MissingFileError`, `ImageryError`, `AreaError`, `VariantError` or `OutputError`.
        """
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
        """Whether the embedding is learned from images of the tiles, not from cell means."""
        return not isinstance(self.recipe, WhitenedRecipe)

    def estimate_text(self) -> str:
        """Estimated size of the map and duration of the build, as one line."""
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
    if not 1 <= request.calibration_views <= MAX_CALIBRATION_VIEWS:
        raise VariantError(
            f"calibration views must be 1 to {MAX_CALIBRATION_VIEWS}, "
            f"got {request.calibration_views}"
        )
    if request.workers is not None and not 1 <= request.workers <= MAX_WORKERS:
        raise VariantError(f"workers must be 1 to {MAX_WORKERS}, got {request.workers}")


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
"""An area farther than this from the box of the imagery, about 2 km, is certainly outside it."""


def _check_not_far(area: Area, outline_deg: NDArray[np.float64]) -> None:
    """Raise `AreaError` for an area far from the imagery, or in it with swapped coordinates.

    `outline_deg` (N, 2): outline of the imagery. Areas that overlap its box are accepted.
    """
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
