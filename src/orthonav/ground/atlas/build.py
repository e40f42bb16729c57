"""Building an atlas: every sheet with imagery is a task of its own, for any worker on any machine.

A sheet is finished when its item is written, so an interrupted build keeps its finished sheets and
the same command resumes it. The same imagery, recipe and versions give the same atlas byte for
byte, with any number of workers, on processors that round alike."""

import hashlib
import json
import logging
import math
import platform
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import rasterio

from orthonav import __version__
from orthonav.core.errors import AreaError, AtlasError, WorkerError
from orthonav.core.files import Progress, no_progress, with_paths
from orthonav.core.geo.frames import wrapped_deg
from orthonav.core.tiles.whitened import CellLayout
from orthonav.ground.atlas.catalog import CATALOG, Atlas, AtlasRecipe, CoarseRecipe, Sheet
from orthonav.ground.atlas.cluster import TaskRunner
from orthonav.ground.atlas.coarse import coarse_grid, write_coarse
from orthonav.ground.atlas.cut import box_around, box_deg
from orthonav.ground.atlas.store import Store
from orthonav.ground.build.build import BuildRequest, build_map, require_relief, require_surface
from orthonav.ground.build.layer import rounded_gsd_m
from orthonav.ground.build.sheet import grid_of
from orthonav.ground.imagery.mosaic import Mosaic
from orthonav.ground.imagery.terrain import open_dem
from orthonav.ground.planning.area import Area, Extent, require_one_area
from orthonav.ground.planning.route import Route
from orthonav.ground.planning.sheets import sheets_of_route

log = logging.getLogger(__name__)

GIVE_UP_AFTER = 8  # sheets in a row that could not be stored: the disk is full or gone


@dataclass(frozen=True)
class AtlasRequest:
    """What to build into an atlas. `recipe`: fields of `AtlasRecipe` that were requested, `coarse`
    with some or all of its own; the others are the atlas's, or the defaults (`gsd_m`: that of the
    imagery). Without bounds or route all imagery is the area. `replace`: rebuild sheets of other
    imagery or program versions instead of refusing them."""

    url: str  # the atlas, a folder or an fsspec URL, created where it does not exist
    orthos: Sequence[Path]  # files and folders of orthophotos; the first covers the next
    recipe: Mapping[str, Any] = field(default_factory=dict)
    bounds_deg: Extent | None = None  # area: west, south, east, north
    route: Route | None = None  # area: a search band around it
    band_m: float | None = None
    replace: bool = False
    index: bool = True  # also make the index of the coarse tiles
    dem: Path | None = None  # terrain model of which sheets get a terrain layer
    surface: Sequence[Path] = ()  # surface models, of which they get a surface layer
    true_ortho: bool = False  # houses stand upright in the orthophotos
    dem_datum: str | None = None  # what its heights count from
    relief: str | None = None  # what the land is like, as in `BuildRequest`; not with heights

    def __post_init__(self) -> None:
        with_paths(self, "orthos", "dem", "surface")


@dataclass(frozen=True)
class SheetTask:
    sheet: Sheet  # its description, without tiles and area yet
    request: AtlasRequest  # with those orthophotos that may show it
    recipe: AtlasRecipe  # how it is made


def versions() -> dict[str, str]:
    return {
        "orthonav": __version__,
        "numpy": np.__version__,
        "opencv": cv2.__version__,
        "gdal": str(rasterio.__gdal_version__),
        "rasterio": rasterio.__version__,
    }


def version_differences(wanted: Mapping[str, str], found: Mapping[str, str]) -> list[str]:
    return [
        f"{name} {found.get(name, 'absent')}, not {version}"
        for name, version in wanted.items()
        if found.get(name) != version
    ]


def plan_sheets(request: AtlasRequest, recipe: AtlasRecipe, mosaic: Mosaic) -> list[SheetTask]:
    """A task for each sheet of an area that imagery may touch, from south to north, west to east.
    `mosaic`: that of the orthophotos of the request."""
    imagery = Imagery(mosaic)
    names = sorted(_names(recipe, imagery, request))
    if not names:
        raise AreaError("the area lies outside the orthophotos")
    made_by = versions()
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
            request=request_digest(recipe, part, made_by, request),
            made_by=made_by,
        )
        orthos = _orthos_of(request.orthos, mosaic, part)
        tasks.append(SheetTask(sheet, replace(request, orthos=orthos, route=None), recipe))
    return tasks


def request_digest(
    recipe: AtlasRecipe, part: Mosaic, made_by: Mapping[str, str], request: AtlasRequest
) -> str:
    """Each file counts with its name, size and second of change, in the order in which files cover
    each other; its folder does not count, as it may differ between machines."""
    stamps = [
        [Path(name).name, size, changed_ns // 10**9]
        for source in part.sources
        for name, size, changed_ns in source.stamp
    ]
    depends: list[Any] = [recipe.to_plain(), dict(made_by), part.common_stamp, stamps]
    heights = [] if request.dem is None else [request.dem]
    for path in (*heights, *request.surface):
        found, name = path.stat(), path.name
        depends.append([name, found.st_size, found.st_mtime_ns // 10**9, request.dem_datum])
    if request.surface:
        depends.append(["surface", len(request.surface), request.true_ortho])
    if request.relief is not None:
        depends.append(request.relief)
    text = json.dumps(depends, sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(text.encode()).hexdigest()


def margin_m(recipe: AtlasRecipe) -> float:
    """A tile, and 64 pixels beyond it for gradients and resampling."""
    return max((each.tile_px + 64) * each.gsd_m for each in (recipe, recipe.coarse))


class Imagery:
    """Orthophotos by the boxes around them: of thousands, few show a sheet."""

    def __init__(self, mosaic: Mosaic) -> None:
        self.mosaic = mosaic
        boxes = []
        for source in mosaic.sources:
            lat, lon = source.outline_latlon_deg.T
            lon = lon - 360 * np.round((lon - lon[0]) / 360)
            boxes.append([lon.min(), lat.min(), lon.max(), lat.max()])
        self._boxes = np.array(boxes, np.float64)

    def under(self, bounds_deg: Extent, reach_m: float) -> Mosaic:
        west, south, east, north = box_around(Area.from_bounds(bounds_deg), reach_m)
        left, bottom, right, top = self._boxes.T
        shift = 360 * np.round(((west + east) / 2 - (left + right) / 2) / 360)
        near = (left + shift < east) & (right + shift > west) & (bottom < north) & (top > south)
        chosen = np.flatnonzero(near).tolist()
        sources = tuple(self.mosaic.sources[index] for index in chosen)
        return Mosaic(sources, tuple(self.mosaic.stretches[index] for index in chosen))

    def sheets(self, recipe: AtlasRecipe) -> set[str]:
        found: set[str] = set()
        for west, south, east, north in self._boxes.tolist():
            around = wrapped_deg(west) if east - west < 360 else -180.0
            found.update(recipe.sheets.over((around, south, around + east - west, north)))
        return found


def _names(recipe: AtlasRecipe, imagery: Imagery, request: AtlasRequest) -> set[str]:
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
    world = recipe.sheets
    for part in sheets_of_route(route, band_m):
        area = Area.from_route(part, band_m)
        for name in there.intersection(world.over(box_deg(area, 0.0))):
            west, south, east, north = world.bounds_deg(name)
            lon, lat = np.meshgrid(np.linspace(west, east, 17), np.linspace(south, north, 17))
            points = area.frame.en_from_latlon(lat.ravel(), lon.ravel())
            if area.contains(points, world.side_m / 16 * math.sqrt(0.5)).any():
                yield name


def _overlap(bounds_deg: Extent, other: Extent) -> bool:
    west, south, east, north = bounds_deg
    shift = 360 * round(((other[0] + other[2]) / 2 - (west + east) / 2) / 360)
    across = min(east + shift, other[2]) - max(west + shift, other[0])
    along = min(north, other[3]) - max(south, other[1])
    return min(across, along) > 1e-9  # boxes that overlap by less only touch


def _require_possible(recipe: AtlasRecipe, bounds_deg: Extent, imagery_gsd_m: float) -> None:
    """Raise `AreaError` for recipes by which this sheet cannot be built with any imagery. An
    `AreaError` of a worker then means that there is no imagery."""
    area = Area.from_bounds(bounds_deg)
    grid = grid_of(
        area, min(imagery_gsd_m, recipe.gsd_m), recipe.gsd_m, recipe.tile_px, recipe.overlap
    )
    CellLayout.for_tiles(grid.tile_px, grid.stride_px)
    coarse = coarse_grid(area, recipe.coarse)
    CellLayout.for_tiles(coarse.tile_px, coarse.stride_px)


def _orthos_of(orthos: Sequence[Path], mosaic: Mosaic, part: Mosaic) -> tuple[Path, ...]:
    """What a worker needs to read the same pixels: all files where the stretch to 8 bits was
    derived from many together."""
    if any(each is not None for each in mosaic.stretches):
        return tuple(orthos)
    needed = {source.path for source in part.sources if source.folder is None}
    folders = {source.folder for source in part.sources if source.folder is not None}
    return tuple(path for path in orthos if path in needed or path in folders)


def require_same(tasks: Sequence[SheetTask], known: Mapping[str, Sheet]) -> None:
    pairs = [(known[task.sheet.id], task.sheet) for task in tasks if task.sheet.id in known]
    other = [(found, wanted) for found, wanted in pairs if found.request != wanted.request]
    if not other:
        return
    why: set[str] = set()
    for found, wanted in other:
        differences = version_differences(wanted.made_by, found.made_by)
        why.update(differences or ["their imagery has changed"])
    named = ", ".join(sheet.id for sheet, _ in other[:5]) + (", .." if len(other) > 5 else "")
    raise AtlasError(
        f"{len(other)} of {len(tasks)} sheets of the atlas are of other imagery or versions "
        f"({'; '.join(sorted(why)[:4])}): {named}; rebuild them with --replace"
    )


@dataclass
class BuildReport:
    """The results of a build of `total` sheets, by name; grows while sheets are finished.

    `unchanged`: sheets that were there already; `empty`: those without imagery; `failed`: why."""

    url: str  # the atlas
    total: int  # sheets asked for
    built: dict[str, Sheet] = field(default_factory=dict)
    unchanged: list[str] = field(default_factory=list)
    empty: list[str] = field(default_factory=list)
    failed: dict[str, str] = field(default_factory=dict)
    wall_s: float = 0.0

    @property
    def untried(self) -> int:
        return self.total - sum(map(len, (self.built, self.unchanged, self.empty, self.failed)))

    @property
    def is_complete(self) -> bool:
        return not self.failed and not self.untried

    def to_plain(self) -> dict[str, Any]:
        built = self.built.values()
        return {
            "atlas": self.url,
            "built": len(built),
            "unchanged": len(self.unchanged),
            "empty": len(self.empty),
            "failed": [{"sheet": name, "error": why} for name, why in sorted(self.failed.items())],
            "untried": self.untried,
            "area_km2": round(sum(each.area_km2 for each in built), 4),
            "tiles": sum(each.tiles for each in built),
            "size_mb": round(sum(each.size_bytes for each in built) / 1e6, 4),
            "wall_s": round(self.wall_s, 3),
        }


def build_atlas(
    request: AtlasRequest, runner: TaskRunner, progress: Progress = no_progress
) -> BuildReport:
    """Build the missing sheets with a runner that was entered, and report the results. A sheet that
    fails is listed in the result, and the others are built. Raises `AreaError`, `ImageryError`,
    `MissingFileError`; `AtlasError` where present sheets are of other imagery or versions;
    `WorkerError` where a worker has other versions; `StorageError`."""
    started_s = time.monotonic()
    require_relief(request.relief, request.dem, request.surface)
    require_surface(request.surface, true_ortho=request.true_ortho)
    orthos = [Path(path).absolute() for path in request.orthos]
    mosaic = Mosaic.open(orthos)
    recipe = recipe_for(request, mosaic)
    dem = request.dem and open_dem(Path(request.dem).absolute(), request.dem_datum).path
    surface = tuple(
        open_dem(Path(path).absolute(), request.dem_datum).path for path in request.surface
    )
    request = replace(request, url=Store(request.url).url, orthos=orthos, dem=dem, surface=surface)
    tasks = plan_sheets(request, recipe, mosaic)
    atlas = Atlas.open_or_create(request.url, recipe)
    known = atlas.sheets()
    if not request.replace:
        require_same(tasks, known)
    result = BuildReport(atlas.url, len(tasks))
    missing = []
    for task in tasks:
        same = known.get(task.sheet.id)
        if same is not None and same.request == task.sheet.request:
            result.unchanged.append(same.id)
        else:
            missing.append(task)
    log.info("%d of %d sheets to build", len(missing), len(tasks))
    _build_sheets(missing, runner, result, progress)
    atlas.snapshot()
    if request.index and not result.failed:
        from orthonav.ground.atlas.index import make_index  # with FAISS

        make_index(atlas, progress=progress)
    result.wall_s = time.monotonic() - started_s
    return result


def recipe_for(request: AtlasRequest, mosaic: Mosaic) -> AtlasRecipe:
    try:
        if Store(request.url).size(CATALOG) is not None:
            atlas = Atlas.open(request.url)
            wanted = replace(atlas.recipe, **_requested(request, atlas.recipe.coarse))
            atlas.require_recipe(wanted)
            return wanted
        gsd_m = rounded_gsd_m(mosaic.gsd_m)
        return AtlasRecipe(**{"gsd_m": gsd_m, **_requested(request, CoarseRecipe())})
    except (TypeError, AtlasError) as error:
        raise AtlasError(f"recipe of the atlas is impossible: {error}") from error


def _requested(request: AtlasRequest, coarse: CoarseRecipe) -> dict[str, Any]:
    fields = dict(request.recipe)
    if isinstance(fields.get("coarse"), Mapping):
        fields["coarse"] = replace(coarse, **fields["coarse"])
    return fields


def build_sheet(task: SheetTask) -> Sheet | None:
    """A sheet, put into the atlas; None where there is no imagery."""
    wanted = task.sheet
    if differences := version_differences(wanted.made_by, versions()):
        raise WorkerError(
            f"{platform.node()} has other versions than the machine that leads, and would make "
            f"other maps: {'; '.join(differences)}; install the same on all"
        )
    mosaic = Imagery(Mosaic.open(task.request.orthos)).under(
        wanted.bounds_deg, margin_m(task.recipe)
    )
    if request_digest(task.recipe, mosaic, wanted.made_by, task.request) != wanted.request:
        raise AtlasError("the imagery has changed, or is not the same on all machines")
    with tempfile.TemporaryDirectory(prefix="orthonav-sheet-") as folder:
        return _built(task, mosaic, Path(folder))


def _built(task: SheetTask, mosaic: Mosaic, folder: Path) -> Sheet | None:
    sheet, made, common = task.sheet, task.request, asdict(task.recipe)
    del common["sheet_km"], common["coarse"]
    files = {"map": folder / f"{sheet.id}.onav", "coarse": folder / f"{sheet.id}.safetensors"}
    shared = ("orthos", "dem", "surface", "true_ortho", "dem_datum", "relief")
    common |= {name: getattr(made, name) for name in shared}
    place: dict[str, Any] = {"out": files["map"], "bounds_deg": sheet.bounds_deg}
    request = BuildRequest(**place, **common, workers=1, dem_needed=False)
    try:
        info = build_map(request).manifest.sheets[0]
    except AreaError as error:  # the recipe was tried when the task was made: no imagery
        log.info("%s is empty: %s", sheet.id, error)
        return None
    write_coarse(mosaic, sheet.bounds_deg, task.recipe.coarse, files["coarse"])
    described = replace(sheet, tiles=info.tiles, area_km2=info.area_km2)
    return Atlas.open(made.url).put(files, described)


def _build_sheets(
    tasks: Sequence[SheetTask], runner: TaskRunner, result: BuildReport, progress: Progress
) -> None:
    not_stored = 0
    with closing(runner.run(build_sheet, tasks)) as finished:
        for task, made in finished:
            name, full = task.sheet.id, False
            if isinstance(made, Sheet):
                result.built[name] = made
            elif made is None:
                result.empty.append(name)
            elif made.kind == WorkerError.__name__:
                raise WorkerError(made.text)
            else:
                log.info("sheet %s failed: %s: %s", name, made.kind, made.text)
                log.debug("%s", made.trace)
                full = made.kind in ("StorageError", "OutputError")
                result.failed[name] = f"{made.kind}: {made.text}"
            progress("sheets", 1 - result.untried / result.total)
            not_stored = not_stored + 1 if full else 0
            if not_stored >= GIVE_UP_AFTER:
                log.error("%d sheets in a row could not be stored: the build ends", not_stored)
                return
