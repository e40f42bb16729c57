"""The sheets of an area that have imagery, each as a task for a worker."""

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import rasterio
from numpy.typing import NDArray

from orthonav import __version__
from orthonav.core.errors import AreaError, AtlasError
from orthonav.core.files import with_paths
from orthonav.core.geo.swapped import swapped_hint
from orthonav.core.tiles.cells import CellLayout
from orthonav.ground.atlas.coarse import coarse_grid
from orthonav.ground.atlas.coverage import box_around, box_deg, turned
from orthonav.ground.atlas.item import Sheet
from orthonav.ground.atlas.recipe import AtlasRecipe
from orthonav.ground.build.block_cache import digest
from orthonav.ground.build.sheet import grid_of
from orthonav.ground.imagery.mosaic import Mosaic
from orthonav.ground.planning.area import Area, Extent, require_one_area
from orthonav.ground.planning.route import Route
from orthonav.ground.planning.sheets import sheets_of_route

MARGIN_PX = 64
"""Pixels beyond a tile that gradients and resampling use, and some more."""
TOUCH_DEG = 1e-9
"""Boxes that overlap by less than this only touch: a tenth of a millimetre."""
_POINTS = 17
"""Points along a side of a sheet at which it is compared with a search band."""


@dataclass(frozen=True)
class AtlasRequest:
    """What to build into an atlas.

    `url`: the atlas, a folder or an fsspec URL, created where it does not exist.
    `orthos`: files and folders of orthophotos; the first covers the next.
    `recipe`: fields of `AtlasRecipe` that were requested, `coarse` with some or all of its own; the
    others are the atlas's, or the defaults (`gsd_m`: that of the imagery).
    `bounds_deg`: area: west, south, east, north.
    `route`, `band_m`: area: a search band around a route, in metres. Without bounds or route all
    imagery is the area.
    `replace`: rebuild sheets of other imagery or program versions instead of refusing them.
    `index`: also make the index of the coarse tiles.
    `dem`, `dem_datum`: terrain model of which sheets get a terrain layer where it has heights, and
    what its heights count from.
    """

    url: str
    orthos: Sequence[Path]
    recipe: Mapping[str, Any] = field(default_factory=dict)
    bounds_deg: Extent | None = None
    route: Route | None = None
    band_m: float | None = None
    replace: bool = False
    index: bool = True
    dem: Path | None = None
    dem_datum: str | None = None

    def __post_init__(self) -> None:
        with_paths(self, "orthos", "dem")


@dataclass(frozen=True)
class SheetTask:
    """A sheet to be built, with all that a worker on another machine needs.

    `sheet`: its description, without tiles and area yet.
    `atlas`: folder or URL of the atlas.
    `orthos`: the files and folders that may show it.
    `recipe`: how it is made.
    `dem`, `dem_datum`: terrain model and what its heights count from, as for a map.
    """

    sheet: Sheet
    atlas: str
    orthos: tuple[Path, ...]
    recipe: AtlasRecipe
    dem: Path | None = None
    dem_datum: str | None = None


def versions() -> dict[str, str]:
    """The versions that determine the bytes of a map."""
    return {
        "orthonav": __version__,
        "numpy": np.__version__,
        "opencv": cv2.__version__,
        "gdal": str(rasterio.__gdal_version__),
        "rasterio": rasterio.__version__,
    }


def version_differences(wanted: Mapping[str, str], found: Mapping[str, str]) -> list[str]:
    """The differences, each as `name this, not that`."""
    return [
        f"{name} {found.get(name, 'absent')}, not {version}"
        for name, version in wanted.items()
        if found.get(name) != version
    ]


def plan_sheets(request: AtlasRequest, recipe: AtlasRecipe, mosaic: Mosaic) -> list[SheetTask]:
    """A task for each sheet of an area that imagery may touch, from south to north, west to east.

    `mosaic`: that of the orthophotos of the request. Raises `AreaError` where there is no sheet,
    and for recipes by which no sheet could be built.
    """
    imagery = Imagery(mosaic)
    names = sorted(_names(recipe, imagery, request))
    if not names:
        hint = _swapped(recipe, imagery, request)
        raise AreaError(f"the area lies outside the orthophotos{hint}")
    made_by, terrain = versions(), (request.dem, request.dem_datum)
    tasks = []
    for name in names:
        bounds_deg = recipe.sheets.bounds_deg(name)
        _require_possible(recipe, bounds_deg, mosaic.gsd_m)
        part = imagery.under(bounds_deg, margin_m(recipe))
        sheet = Sheet(
            id=name,
            bounds_deg=bounds_deg,
            gsd_m=recipe.gsd_m,
            tiles=0,
            area_km2=0.0,
            dates=tuple(sorted({s.date for s in part.sources if s.date is not None})),
            imagery=part.describe(),
            request=request_digest(recipe, part, made_by, *terrain),
            made_by=made_by,
        )
        needed = _orthos_of(request.orthos, mosaic, part)
        tasks.append(SheetTask(sheet, request.url, needed, recipe, *terrain))
    return tasks


def request_digest(
    recipe: AtlasRecipe,
    part: Mosaic,
    made_by: Mapping[str, str],
    dem: Path | None = None,
    dem_datum: str | None = None,
) -> str:
    """Digest of what a sheet depends on: recipe, versions, the imagery under it, and the terrain.

    Each file counts with its name, size and second of change, in the order in which files cover
    each other; its folder does not count, as it may differ between machines.
    """
    stamps = [
        [Path(name).name, size, changed_ns // 10**9]
        for source in part.sources
        for name, size, changed_ns in source.stamp
    ]
    depends: list[Any] = [recipe.to_plain(), dict(made_by), part.common_stamp, stamps]
    if dem is not None:
        found = dem.stat()
        depends.append([dem.name, found.st_size, found.st_mtime_ns // 10**9, dem_datum])
    return digest(depends)


def margin_m(recipe: AtlasRecipe) -> float:
    """Width of the margin around its box on which a sheet may depend."""
    reach_m = (recipe.tile_px + MARGIN_PX) * recipe.gsd_m
    if recipe.coarse is None:
        return reach_m
    return max(reach_m, (recipe.coarse.tile_px + MARGIN_PX) * recipe.coarse.gsd_m)


class Imagery:
    """The sources of a mosaic by place."""

    def __init__(self, mosaic: Mosaic) -> None:
        self.mosaic = mosaic

    def under(self, bounds_deg: Extent, reach_m: float) -> Mosaic:
        """The sources that may show a box and a margin of `reach_m` around it."""
        west, south, east, north = box_around(Area.from_bounds(bounds_deg), reach_m)
        boxes = self._boxes
        middle = (west + east) / 2
        shift = 360 * np.round((middle - (boxes[:, 0] + boxes[:, 2]) / 2) / 360)
        near = (boxes[:, 0] + shift < east) & (boxes[:, 2] + shift > west)
        near &= (boxes[:, 1] < north) & (boxes[:, 3] > south)
        chosen = np.flatnonzero(near).tolist()
        sources = tuple(self.mosaic.sources[index] for index in chosen)
        return Mosaic(sources, tuple(self.mosaic.stretches[index] for index in chosen))

    def sheets(self, recipe: AtlasRecipe) -> set[str]:
        """Names of the sheets that the boxes of the sources touch."""
        found: set[str] = set()
        for west, south, east, north in self._boxes.tolist():
            around = turned(west) if east - west < 360 else -180.0
            found.update(recipe.sheets.over((around, south, around + east - west, north)))
        return found

    @cached_property
    def _boxes(self) -> NDArray[np.float64]:
        """West, south, east, north (N, 4) in degrees; east may be above 180."""
        outlines = [source.outline_latlon_deg for source in self.mosaic.sources]
        boxes = []
        for outline in outlines:
            lat, lon = outline[:, 0], outline[:, 1]
            lon = lon - 360 * np.round((lon - lon[0]) / 360)
            boxes.append([lon.min(), lat.min(), lon.max(), lat.max()])
        return np.array(boxes, np.float64)


def _swapped(recipe: AtlasRecipe, imagery: Imagery, request: AtlasRequest) -> str:
    """A hint if the middle of the bounds, or the start of the route, lies on imagery with latitude
    and longitude swapped."""
    there = imagery.sheets(recipe)
    if request.bounds_deg is not None:
        west, south, east, north = request.bounds_deg
        place = (south + north) / 2, (west + east) / 2
    elif request.route is not None:
        place = request.route.waypoints[0]
    else:
        return ""
    return swapped_hint(*place, lambda lat, lon: recipe.sheets.name_at(lat, lon) in there)


def _names(recipe: AtlasRecipe, imagery: Imagery, request: AtlasRequest) -> Iterable[str]:
    """Names of the sheets of an area that imagery may touch."""
    route, bounds_deg = request.route, request.bounds_deg
    require_one_area(route, request.band_m, bounds_deg)
    there = imagery.sheets(recipe)
    if bounds_deg is not None:
        west, south, east, north = bounds_deg
        if not (west != east and south < north):
            raise AreaError(f"bounds are empty: {','.join(map(str, bounds_deg))}")
        asked = (west, south, east + 360 if east < west else east, north)
        return {name for name in there if _overlap(recipe.sheets.bounds_deg(name), asked)}
    return there if route is None else set(_along(recipe, route, request.band_m, there))


def _along(
    recipe: AtlasRecipe, route: Route, band_m: float | None, there: set[str]
) -> Iterator[str]:
    """The sheets that the search band of a route crosses, and some that it nearly touches."""
    world = recipe.sheets
    for part in sheets_of_route(route, band_m):
        area = Area.from_route(part, band_m)
        for name in there.intersection(world.over(box_deg(area, 0.0))):
            west, south, east, north = world.bounds_deg(name)
            lon, lat = np.meshgrid(
                np.linspace(west, east, _POINTS), np.linspace(south, north, _POINTS)
            )
            points = area.frame.en_from_latlon(lat.ravel(), lon.ravel())
            if area.contains(points, world.side_m / (_POINTS - 1) * math.sqrt(0.5)).any():
                yield name


def _overlap(bounds_deg: Extent, other: Extent) -> bool:
    """Whether two boxes share more than an edge."""
    west, south, east, north = bounds_deg
    shift = 360 * round(((other[0] + other[2]) / 2 - (west + east) / 2) / 360)
    across = min(east + shift, other[2]) - max(west + shift, other[0])
    return across > TOUCH_DEG and min(north, other[3]) - max(south, other[1]) > TOUCH_DEG


def _require_possible(recipe: AtlasRecipe, bounds_deg: Extent, imagery_gsd_m: float) -> None:
    """Raise `AreaError` for recipes by which this sheet cannot be built with any imagery.

    An `AreaError` of a worker then means that there is no imagery.
    """
    area = Area.from_bounds(bounds_deg)
    grid = grid_of(
        area, min(imagery_gsd_m, recipe.gsd_m), recipe.gsd_m, recipe.tile_px, recipe.overlap
    )
    CellLayout.for_tiles(grid.tile_px, grid.stride_px)
    if recipe.coarse is not None:
        coarse = coarse_grid(area, recipe.coarse)
        CellLayout.for_tiles(coarse.tile_px, coarse.stride_px)


def _orthos_of(orthos: Sequence[Path], mosaic: Mosaic, part: Mosaic) -> tuple[Path, ...]:
    """The files and folders that a worker needs to read the same pixels as from all of them.

    All of them where the stretch to 8 bits, or whether a fourth band is a mask, was derived from
    many files together.
    """
    common = any(each is not None for each in mosaic.stretches)
    if common or any(source.marked_alpha for source in mosaic.sources):
        return tuple(orthos)
    needed = {source.path for source in part.sources if source.folder is None}
    folders = {source.folder for source in part.sources if source.folder is not None}
    return tuple(path for path in orthos if path in needed or path in folders)


def require_same(tasks: Sequence[SheetTask], known: Mapping[str, Sheet]) -> None:
    """Raise `AtlasError` naming the sheets of the atlas (`known`) of other imagery or versions."""
    sheets = [task.sheet for task in tasks if task.sheet.id in known]
    other = [sheet for sheet in sheets if known[sheet.id].request != sheet.request]
    if not other:
        return
    why = sorted(
        {
            line
            for sheet in other
            for line in version_differences(sheet.made_by, known[sheet.id].made_by)
            or ["their imagery has changed"]
        }
    )
    named = ", ".join(sheet.id for sheet in other[:5]) + (", .." if len(other) > 5 else "")
    raise AtlasError(
        f"{len(other)} of {len(tasks)} sheets of the atlas are of other imagery or versions "
        f"({'; '.join(why[:4])}): {named}; rebuild them with --replace"
    )
