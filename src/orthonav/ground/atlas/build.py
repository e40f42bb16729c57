"""Building an atlas: every sheet with imagery is a task of its own, for any worker on any machine.

A sheet is finished when its item is written, so an interrupted build keeps its finished sheets and
the same command resumes it. The same imagery, recipe and versions give the same atlas byte for
byte, with any number of workers, on processors that round alike."""

import contextlib
import fcntl
import logging
import math
import shutil
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np
import rasterio
from numpy.typing import NDArray

from orthonav import __version__
from orthonav.core.errors import AreaError, AtlasError, OrthonavError, OutputError, WorkerError
from orthonav.core.files import Progress, no_progress, with_paths
from orthonav.core.geo.swapped import swapped_hint
from orthonav.core.tiles.cells import CellLayout
from orthonav.ground.atlas.catalog import CATALOG, Atlas, AtlasRecipe, CoarseRecipe
from orthonav.ground.atlas.cluster import Failure, TaskRunner
from orthonav.ground.atlas.coarse import coarse_grid, write_coarse
from orthonav.ground.atlas.cut import box_around, box_deg, turned
from orthonav.ground.atlas.item import Sheet
from orthonav.ground.atlas.store import Store
from orthonav.ground.build.build import BuildRequest, build_map
from orthonav.ground.build.sheet import digest, grid_of, rounded_gsd_m
from orthonav.ground.imagery.mosaic import Mosaic
from orthonav.ground.imagery.terrain import open_dem
from orthonav.ground.planning.area import Area, Extent, require_one_area
from orthonav.ground.planning.route import Route
from orthonav.ground.planning.sheets import sheets_of_route

MARGIN_PX = 64  # pixels beyond a tile that gradients and resampling use, and some more
TOUCH_DEG = 1e-9  # boxes that overlap by less than this only touch: a tenth of a millimetre
_POINTS = 17  # points along a side of a sheet at which it is compared with a search band


@dataclass(frozen=True)
class AtlasRequest:
    """What to build into an atlas. `recipe`: fields of `AtlasRecipe` that were requested, `coarse`
    with some or all of its own; the others are the atlas's, or the defaults (`gsd_m`: that of the
    imagery). `route`, `band_m`: area: a search band around a route, in metres. Without bounds or
    route all imagery is the area. `replace`: rebuild sheets of other imagery or program versions
    instead of refusing them. `dem`, `dem_datum`: terrain model of which sheets get a terrain layer
    where it has heights, and what its heights count from."""

    url: str  # the atlas, a folder or an fsspec URL, created where it does not exist
    orthos: Sequence[Path]  # files and folders of orthophotos; the first covers the next
    recipe: Mapping[str, Any] = field(default_factory=dict)
    bounds_deg: Extent | None = None  # area: west, south, east, north
    route: Route | None = None
    band_m: float | None = None
    replace: bool = False
    index: bool = True  # also make the index of the coarse tiles
    dem: Path | None = None
    dem_datum: str | None = None

    def __post_init__(self) -> None:
        with_paths(self, "orthos", "dem")


@dataclass(frozen=True)
class SheetTask:
    """A sheet to be built, with all that a worker on another machine needs."""

    sheet: Sheet  # its description, without tiles and area yet
    atlas: str  # folder or URL of the atlas
    orthos: tuple[Path, ...]  # the files and folders that may show it
    recipe: AtlasRecipe  # how it is made
    dem: Path | None = None
    dem_datum: str | None = None


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
    """Each file counts with its name, size and second of change, in the order in which files cover
    each other; its folder does not count, as it may differ between machines."""
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
    reach_m = (recipe.tile_px + MARGIN_PX) * recipe.gsd_m
    if recipe.coarse is None:
        return reach_m
    return max(reach_m, (recipe.coarse.tile_px + MARGIN_PX) * recipe.coarse.gsd_m)


class Imagery:
    def __init__(self, mosaic: Mosaic) -> None:
        self.mosaic = mosaic

    def under(self, bounds_deg: Extent, reach_m: float) -> Mosaic:
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
            lon, lat = np.meshgrid(
                np.linspace(west, east, _POINTS), np.linspace(south, north, _POINTS)
            )
            points = area.frame.en_from_latlon(lat.ravel(), lon.ravel())
            if area.contains(points, world.side_m / (_POINTS - 1) * math.sqrt(0.5)).any():
                yield name


def _overlap(bounds_deg: Extent, other: Extent) -> bool:
    west, south, east, north = bounds_deg
    shift = 360 * round(((other[0] + other[2]) / 2 - (west + east) / 2) / 360)
    across = min(east + shift, other[2]) - max(west + shift, other[0])
    return across > TOUCH_DEG and min(north, other[3]) - max(south, other[1]) > TOUCH_DEG


def _require_possible(recipe: AtlasRecipe, bounds_deg: Extent, imagery_gsd_m: float) -> None:
    """Raise `AreaError` for recipes by which this sheet cannot be built with any imagery. An
    `AreaError` of a worker then means that there is no imagery."""
    area = Area.from_bounds(bounds_deg)
    grid = grid_of(
        area, min(imagery_gsd_m, recipe.gsd_m), recipe.gsd_m, recipe.tile_px, recipe.overlap
    )
    CellLayout.for_tiles(grid.tile_px, grid.stride_px)
    if recipe.coarse is not None:
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


Status = Literal["built", "unchanged", "empty", "failed"]


@dataclass(frozen=True)
class SheetResult:
    """`unchanged`: the sheet was there already; `empty`: there is no imagery."""

    sheet: str  # name
    status: Status
    error: str = ""  # why it failed
    cpu_s: float = 0.0  # processor time
    wall_s: float = 0.0  # time that the worker spent on it
    size_bytes: int = 0
    area_km2: float = 0.0
    tiles: int = 0
    peak_bytes: int = 0  # greatest memory that the worker process ever had


@dataclass
class BuildReport:
    """The results of a build of `total` sheets; grows while sheets are finished."""

    url: str  # the atlas
    total: int  # sheets asked for
    started_s: float = field(default_factory=time.monotonic)  # monotonic clock at the start
    results: list[SheetResult] = field(default_factory=list)  # sheets that are finished or failed
    finish_error: str | None = None  # why snapshot or index could not be written
    wall_s: float = 0.0

    def names(self, status: Status) -> list[str]:
        return sorted(each.sheet for each in self.results if each.status == status)

    @property
    def untried(self) -> int:
        return self.total - len(self.results)

    @property
    def share(self) -> float:
        return len(self.results) / max(1, self.total)

    @property
    def is_complete(self) -> bool:
        return not self.names("failed") and not self.untried and self.finish_error is None

    def line(self) -> str:
        plain = self.to_plain()
        text = f"{len(self.results):,} of {self.total:,} sheets"
        if plain["area_km2"]:
            text += (
                f", {plain['km2_per_hour']:,.0f} km2/h, {plain['cpu_s_per_km2']:.2f} CPU s/km2, "
                f"{plain['mb_per_km2']:.2f} MB/km2"
            )
        tried = len(self.results) - plain["unchanged"]
        if tried:
            left_s = plain["wall_s"] / tried * self.untried
            text += f", {duration(left_s)} left"
        return text + (f", {len(plain['failed'])} failed" if plain["failed"] else "")

    def to_plain(self, cpu_hour_price: float | None = None) -> dict[str, Any]:
        """Sums and rates as plain values; `cpu_hour_price` is the price of an hour of a core.
        `core_s` is how long workers were busy with sheets, which is what machines are paid for."""
        built = [each for each in self.results if each.status == "built"]
        tried = [each for each in self.results if each.status != "unchanged"]
        wall_s = self.wall_s or time.monotonic() - self.started_s
        area_km2 = sum(each.area_km2 for each in built)
        size_mb = sum(each.size_bytes for each in built) / 1e6
        core_s, cpu_s = sum(each.wall_s for each in tried), sum(each.cpu_s for each in tried)
        plain: dict[str, Any] = {
            "atlas": self.url,
            "built": len(built),
            "unchanged": len(self.names("unchanged")),
            "empty": len(self.names("empty")),
            "failed": [
                {"sheet": each.sheet, "error": each.error}
                for each in sorted(self.results, key=lambda each: each.sheet)
                if each.status == "failed"
            ],
            "untried": self.untried,
            "area_km2": round(area_km2, 4),
            "tiles": sum(each.tiles for each in built),
            "size_mb": round(size_mb, 4),
            "wall_s": round(wall_s, 3),
            "core_s": round(core_s, 3),
            "cpu_s": round(cpu_s, 3),
            "peak_mb": round(max((each.peak_bytes for each in tried), default=0) / 1e6, 1),
            "finish_error": self.finish_error,
            "sheets_per_hour": _rate(3600 * len(built), wall_s),
            "km2_per_hour": _rate(3600 * area_km2, wall_s),
            "cpu_s_per_km2": _rate(cpu_s, area_km2),
            "mb_per_km2": _rate(size_mb, area_km2),
        }
        if cpu_hour_price is not None:
            cost = core_s / 3600 * cpu_hour_price
            plain["cost"] = round(cost, 4)
            plain["cost_per_km2"] = _rate(cost, area_km2, 6)
        return plain


def duration(seconds: float) -> str:
    if seconds < 90:
        return f"{seconds:.0f} s"
    minutes = round(seconds / 60)
    return f"{minutes} min" if minutes < 90 else f"{minutes // 60} h {minutes % 60:02d} min"


def _rate(value: float, by: float, digits: int = 4) -> float | None:
    return round(value / by, digits) if by > 0 else None


log = logging.getLogger(__name__)

PROGRESS_EVERY_S = 10.0  # between two lines of progress
GIVE_UP_AFTER = 8  # sheets in a row that could not be stored: the disk is full or gone
SCRATCH = "orthonav-sheet-"  # names of temporary folders begin with it
_LOCK = "in-use"
LEARNT = ("autoencoder", "caevl", "triplet")  # methods for which a worker is given a GPU


def build_atlas(
    request: AtlasRequest,
    runner: TaskRunner,
    progress: Progress = no_progress,
    report: Callable[[str], None] = log.info,
) -> BuildReport:
    """Build the missing sheets with a runner that was entered, and report the results. A sheet that
    fails is listed in the result, and the others are built. `progress` is called with a stage and
    its share done, `report` with lines for people. Raises `AreaError`, `ImageryError`,
    `MissingFileError`; `AtlasError` where present sheets are of other imagery or versions;
    `WorkerError` where workers have other versions; `StorageError`."""
    started_s = time.monotonic()
    orthos = [Path(path).absolute() for path in request.orthos]
    mosaic = Mosaic.open(orthos)
    recipe = recipe_for(request, mosaic)
    dem = request.dem and open_dem(Path(request.dem).absolute(), request.dem_datum).path
    request = replace(request, url=Store(request.url).url, orthos=orthos, dem=dem)
    tasks = plan_sheets(request, recipe, mosaic)
    _require_same_versions(runner)
    atlas = Atlas.open_or_create(request.url, recipe)
    known = atlas.sheets()
    if not request.replace:
        require_same(tasks, known)
    result = BuildReport(atlas.url, len(tasks), started_s)
    missing = []
    for task in tasks:
        same = known.get(task.sheet.id)
        if same is not None and same.request == task.sheet.request:
            result.results.append(SheetResult(same.id, "unchanged", area_km2=same.area_km2))
        else:
            missing.append(task)
    there = len(result.results)
    unchanged = f", {there} are there already" if there else ""
    report(
        f"{len(tasks):,} sheets of at most {recipe.sheet_km:g} km at {recipe.gsd_m:g} m"
        f"{unchanged}; {len(missing):,} to build, {runner.at_once} at a time"
    )
    _build_sheets(missing, recipe, runner, result, progress, report)
    index = request.index and recipe.coarse is not None and not result.names("failed")
    result.finish_error = _finish(atlas, index, progress)
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
        return AtlasRecipe(**{"gsd_m": gsd_m, **_requested(request, None)})
    except (TypeError, AtlasError) as error:
        raise AtlasError(f"recipe of the atlas is impossible: {error}") from error


def _requested(request: AtlasRequest, coarse: CoarseRecipe | None) -> dict[str, Any]:
    fields = dict(request.recipe)
    if isinstance(fields.get("coarse"), Mapping):
        fields["coarse"] = replace(coarse or CoarseRecipe(), **fields["coarse"])
    return fields


def build_sheet(task: SheetTask) -> SheetResult:
    wall_s, cpu_s = time.perf_counter(), time.process_time()
    wanted = task.sheet
    if differences := version_differences(wanted.made_by, versions()):
        raise WorkerError(_other_versions("this worker", differences))
    mosaic = Imagery(Mosaic.open(task.orthos)).under(wanted.bounds_deg, margin_m(task.recipe))
    found = request_digest(task.recipe, mosaic, wanted.made_by, task.dem, task.dem_datum)
    if found != wanted.request:
        raise AtlasError("the imagery has changed, or is not the same on all machines")
    with scratch_folder() as folder:
        built = _built(task, mosaic, folder)
    sheet = built or wanted  # of which nothing is known yet
    return SheetResult(
        wanted.id,
        "empty" if built is None else "built",
        cpu_s=time.process_time() - cpu_s,
        wall_s=time.perf_counter() - wall_s,
        size_bytes=sheet.size_bytes,
        area_km2=sheet.area_km2,
        tiles=sheet.tiles,
        peak_bytes=_peak_bytes(),
    )


def _built(task: SheetTask, mosaic: Mosaic, folder: Path) -> Sheet | None:
    recipe = asdict(task.recipe)
    del recipe["sheet_km"], recipe["coarse"]
    name, bounds_deg = task.sheet.id, task.sheet.bounds_deg
    files = {"map": folder / f"{name}.onav"}
    request = BuildRequest(
        orthos=task.orthos,
        out=files["map"],
        bounds_deg=bounds_deg,
        workers=1,
        dem=task.dem,
        dem_datum=task.dem_datum,
        dem_needed=False,
        cells=True,
        **recipe,
    )
    try:
        info = build_map(request, announce=log.debug).manifest.sheets[0]
    except AreaError as error:  # the recipe was tried when the task was made: no imagery
        log.info("%s is empty: %s", name, error)
        return None
    if task.recipe.coarse is not None:
        files["coarse"] = folder / f"{name}.safetensors"
        write_coarse(mosaic, bounds_deg, task.recipe.coarse, files["coarse"])
    described = replace(task.sheet, tiles=info.tiles, area_km2=info.area_km2)
    return Atlas.open(task.atlas).put(files, described)


def _build_sheets(
    tasks: Sequence[SheetTask],
    recipe: AtlasRecipe,
    runner: TaskRunner,
    result: BuildReport,
    progress: Progress,
    report: Callable[[str], None],
) -> None:
    reported_s = time.monotonic()
    not_stored = 0
    gpu = recipe.method.partition(":")[0] in LEARNT
    finished = runner.run(build_sheet, tasks, gpu=gpu)
    for task, made in finished:
        if isinstance(made, Failure):
            log.info("sheet %s failed: %s: %s", task.sheet.id, made.kind, made.text)
            log.debug("%s", made.trace)
            not_stored = not_stored + 1 if made.kind in ("StorageError", "OutputError") else 0
            made = SheetResult(task.sheet.id, "failed", f"{made.kind}: {made.text}")
        else:
            not_stored = 0
        result.results.append(made)
        progress("sheets", result.share)
        if not_stored >= GIVE_UP_AFTER:
            report(f"{not_stored} sheets in a row could not be stored: the others are not tried")
            getattr(finished, "close", lambda: None)()
            return
        if time.monotonic() - reported_s >= PROGRESS_EVERY_S:
            reported_s = time.monotonic()
            report(result.line())


def _require_same_versions(runner: TaskRunner) -> None:
    wanted = versions()
    for name, found in runner.everywhere(versions):
        if isinstance(found, Failure):
            raise WorkerError(f"{name} cannot run orthonav: {found.text}")
        if differences := version_differences(wanted, found):
            raise WorkerError(_other_versions(name, differences))


def _other_versions(name: str, differences: Sequence[str]) -> str:
    return (
        f"{name} has other versions than the machine that leads, and would make other maps: "
        f"{'; '.join(differences)}; install the same on all"
    )


def _finish(atlas: Atlas, index: bool, progress: Progress) -> str | None:
    """Write snapshot and index; the error where that fails, which loses no sheet."""
    try:
        atlas.snapshot()
        if index:
            from orthonav.ground.atlas.index import make_index  # with FAISS

            make_index(atlas, progress=progress)
    except OrthonavError as error:
        return str(error)
    return None


@contextmanager
def scratch_folder() -> Iterator[Path]:
    """A new folder in the system's folder of temporary files (`TMPDIR`), removed afterwards. It is
    locked while this process lives; folders of processes that were killed are removed first."""
    root = Path(tempfile.gettempdir())
    for path in root.glob(f"{SCRATCH}*/{_LOCK}"):
        with contextlib.suppress(OSError), path.open("r+") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            shutil.rmtree(path.parent, ignore_errors=True)
    try:
        made = tempfile.TemporaryDirectory(prefix=SCRATCH, dir=root, ignore_cleanup_errors=True)
    except OSError as error:
        raise OutputError(f"no temporary folder can be made ({error.strerror}): {root}") from error
    with made as name:
        folder = Path(name)
        with (folder / f".{_LOCK}").open("w") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)
            (folder / f".{_LOCK}").rename(folder / _LOCK)  # visible to others only when locked
            yield folder


def _peak_bytes() -> int:
    """Greatest memory that this process ever had, earlier sheets included; 0 where unknown. Linux's
    own count: that of getrusage includes the parent's."""
    with contextlib.suppress(OSError):
        status = Path("/proc/self/status").read_text(encoding="ascii", errors="replace")
        for line in status.splitlines():
            if line.startswith("VmHWM:"):
                return int(line.split()[1]) * 1024
    return 0
