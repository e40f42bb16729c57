"""Building an atlas: every sheet is a task of its own, whoever does it and wherever.

A sheet is finished when its item is written, so whatever ends a build, by whichever signal, keeps
what was finished, and the same command goes on from there. The same imagery, recipe and versions
give the same atlas byte for byte, however many workers there were, on processors that calculate
alike.
"""

import contextlib
import logging
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from orthonav.atlas.catalog import CATALOG, Atlas, NewSheet
from orthonav.atlas.cluster import Failure, Runner
from orthonav.atlas.coarse import write_coarse
from orthonav.atlas.recipe import AtlasRecipe, CoarseRecipe
from orthonav.atlas.scratch import scratch_folder
from orthonav.atlas.store import Store
from orthonav.atlas.tally import AtlasBuilt, SheetDone, Tally
from orthonav.atlas.tasks import (
    Imagery,
    SheetTask,
    is_same,
    margin_m,
    plan_sheets,
    refuse_differences,
    request_digest,
    version_differences,
    versions,
)
from orthonav.errors import AreaError, AtlasError, OrthonavError, WorkerError
from orthonav.geo.area import Area, Extent
from orthonav.geo.frames import LocalFrame
from orthonav.geo.route import Route
from orthonav.imagery.mosaic import Mosaic
from orthonav.prepare.build import BuildRequest, build_map
from orthonav.prepare.layout import grid_of

__all__ = [
    "AtlasBuilt",
    "AtlasRequest",
    "SheetDone",
    "SheetTask",
    "build_atlas",
    "build_sheet",
    "plan_sheets",
]

log = logging.getLogger(__name__)

PROGRESS_EVERY_S = 10.0
GIVE_UP_AFTER = 8
"""So many sheets in a row that could not be stored end a build: the disk is full, or away."""
LEARNT = ("autoencoder", "triplet")
"""Methods that a GPU speeds up."""
Progress = Callable[[str, float], None]


@dataclass(frozen=True)
class AtlasRequest:
    """What to build into the atlas at `url`, a folder or an fsspec URL, which need not be there.

    `recipe` are the fields of `AtlasRecipe` that are asked for; the others are the atlas's own, or
    the usual ones (`gsd_m`: the imagery's); `coarse` may be some of its own. With neither
    `bounds_deg` nor `route` all the imagery is the area. Sheets that are there are kept; with
    `replace` those that were made otherwise are made anew. `index` also makes the index of the
    coarse tiles.
    """

    url: str
    orthos: Sequence[Path]
    recipe: Mapping[str, Any] = field(default_factory=dict)
    bounds_deg: Extent | None = None
    route: Route | None = None
    band_m: float | None = None
    replace: bool = False
    index: bool = True


def build_atlas(
    request: AtlasRequest,
    runner: Runner,
    progress: Progress | None = None,
    tell: Callable[[str], None] = log.info,
) -> AtlasBuilt:
    """Build the sheets that are missing, by a runner that was entered, and say what came of them.

    A sheet that fails is told of in the result, and the others are built. `progress` is called
    with a stage and its share done, `tell` with lines for people. Raises `AreaError`,
    `ImageryError`, `MissingFileError`; `AtlasError` where sheets that are there were made
    otherwise; `WorkerError` where workers have other versions; `StorageError`.
    """
    started_s = time.monotonic()
    report = progress or (lambda stage, share: None)
    orthos = [Path(path).absolute() for path in request.orthos]
    mosaic = Mosaic.open(orthos)
    recipe = recipe_for(request, mosaic)
    tasks = plan_sheets(
        Store.open(request.url).url,
        recipe,
        mosaic,
        orthos,
        bounds_deg=request.bounds_deg,
        route=request.route,
        band_m=request.band_m,
    )
    _require_same_versions(runner)
    atlas = Atlas.open_or_create(request.url, recipe)
    known = atlas.sheets()
    if not request.replace:
        refuse_differences(tasks, known)
    todo = [task for task in tasks if task.sheet not in known or not is_same(task, known)]
    tally = Tally(len(tasks), started_s)
    for task in tasks:
        if task.sheet in known and is_same(task, known):
            tally.take(SheetDone(task.sheet, "kept", area_km2=known[task.sheet].area_km2))
    tell(_announced(tally, tasks, recipe, runner))
    _work(todo, recipe, runner, tally, report, tell)
    whole = request.index and recipe.coarse is not None and not tally.failed
    tally.finish_error = _finished(atlas, whole, report)
    return tally.result(atlas.url)


def recipe_for(request: AtlasRequest, mosaic: Mosaic) -> AtlasRecipe:
    """The recipe asked for. Raises `AtlasError` where it cannot be, or is not the atlas's."""
    try:
        if Store.open(request.url).size(CATALOG) is not None:
            there = Atlas.open(request.url).recipe
            wanted = replace(there, **_given(request, there.coarse))
            if differences := there.differences(wanted):
                raise AtlasError(
                    "all sheets of an atlas are made alike; this one has "
                    f"{'; '.join(differences)}: {request.url}"
                )
            return wanted
        recipe = AtlasRecipe(**{"gsd_m": mosaic.gsd_m, **_given(request, None)})
        recipe = AtlasRecipe.from_plain(recipe.to_plain())  # checks it
        if "gsd_m" in request.recipe:
            return recipe
        return replace(recipe, gsd_m=_usual_gsd_m(mosaic, recipe))
    except TypeError as error:
        raise AtlasError(f"recipe of the atlas is impossible: {error}") from error


def _given(request: AtlasRequest, coarse: CoarseRecipe | None) -> dict[str, Any]:
    """Fields of the recipe that were asked for; of coarse tiles some may be."""
    given = dict(request.recipe)
    if isinstance(given.get("coarse"), Mapping):
        given["coarse"] = replace(coarse or CoarseRecipe(), **given["coarse"])
    return given


def build_sheet(task: SheetTask) -> SheetDone:
    """Build a sheet and put it into the atlas. Depends on nothing but the task and the imagery.

    Raises `AtlasError` where this program's versions or its imagery are not the task's,
    `ImageryError`, `OutputError`, `StorageError`.
    """
    wall_s, cpu_s = time.perf_counter(), time.process_time()
    if differences := version_differences(task.made_by, versions()):
        raise WorkerError(_other_versions("this worker", differences))
    mosaic = Imagery(Mosaic.open(task.orthos)).under(task.bounds_deg, margin_m(task.recipe))
    if request_digest(task.recipe, mosaic, task.made_by) != task.request:
        raise AtlasError("the imagery has changed, or is not the same on all machines")
    with scratch_folder() as folder:
        tiles, area_km2, size_bytes = _built(task, mosaic, folder)
    return SheetDone(
        task.sheet,
        "built" if tiles else "empty",
        cpu_s=time.process_time() - cpu_s,
        wall_s=time.perf_counter() - wall_s,
        size_bytes=size_bytes,
        area_km2=area_km2,
        tiles=tiles,
        peak_bytes=_peak_bytes(),
    )


def _built(task: SheetTask, mosaic: Mosaic, folder: Path) -> tuple[int, float, int]:
    """Tiles, km2 and bytes of a sheet that is now in the atlas; zeros where it has no imagery."""
    recipe = task.recipe
    files = {"map": folder / f"{task.sheet}.onav"}
    request = BuildRequest(
        orthos=task.orthos,
        out=files["map"],
        bounds_deg=task.bounds_deg,
        gsd_m=recipe.gsd_m,
        tile_px=recipe.tile_px,
        overlap=recipe.overlap,
        method=recipe.method,
        edges=recipe.edges,
        seed=recipe.seed,
        registration=recipe.registration,
        calibration_views=recipe.calibration_views,
        workers=1,
        cells=True,
    )
    try:
        manifest = build_map(request, announce=log.debug).manifest
    except AreaError as error:  # the recipe was tried when the task was made: it is the imagery
        log.info("%s is empty: %s", task.sheet, error)
        return 0, 0.0, 0
    if recipe.coarse is not None:
        files["coarse"] = folder / f"{task.sheet}.safetensors"
        write_coarse(mosaic, task.bounds_deg, recipe.coarse, files["coarse"])
    info = manifest.sheets[0]
    described = NewSheet(
        id=task.sheet,
        bounds_deg=task.bounds_deg,
        gsd_m=recipe.gsd_m,
        tiles=info.tiles,
        area_km2=info.area_km2,
        dates=task.dates,
        imagery=task.imagery,
        request=task.request,
        made_by=task.made_by,
    )
    put = Atlas.open(task.atlas).put(task.sheet, files, described)
    return info.tiles, info.area_km2, put.size_bytes


def _work(
    todo: Sequence[SheetTask],
    recipe: AtlasRecipe,
    runner: Runner,
    tally: Tally,
    report: Progress,
    tell: Callable[[str], None],
) -> None:
    """Have the sheets built; `tally` knows what came of them."""
    progress_s = time.monotonic()
    in_a_row = 0
    gpu = recipe.method.partition(":")[0] in LEARNT
    finished = runner.run(build_sheet, todo, gpu=gpu)
    for task, made in finished:
        if isinstance(made, Failure):
            tally.fail(task.sheet, made)
            log.info("sheet %s failed: %s: %s", task.sheet, made.kind, made.text)
            log.debug("%s", made.trace)
            in_a_row = in_a_row + 1 if made.kind in ("StorageError", "OutputError") else 0
        else:
            tally.take(made)
            in_a_row = 0
        report("sheets", tally.share)
        if in_a_row >= GIVE_UP_AFTER:
            tell(f"{in_a_row} sheets in a row could not be stored: the others are not tried")
            getattr(finished, "close", lambda: None)()
            return
        if time.monotonic() - progress_s >= PROGRESS_EVERY_S:
            progress_s = time.monotonic()
            tell(tally.line())


def _announced(
    tally: Tally, tasks: Sequence[SheetTask], recipe: AtlasRecipe, runner: Runner
) -> str:
    left = len(tasks) - tally.done
    kept = f", {tally.done} are there already" if tally.done else ""
    return (
        f"{len(tasks):,} sheets of at most {recipe.sheet_km:g} km at {recipe.gsd_m:g} m{kept}; "
        f"{left:,} to build, {runner.at_once} at a time"
    )


def _require_same_versions(runner: Runner) -> None:
    """Raises `WorkerError` naming the difference where a machine would make other bytes."""
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


def _finished(atlas: Atlas, index: bool, report: Progress) -> str | None:
    """Write snapshot and index; what went wrong where they cannot be: the sheets are there."""
    try:
        atlas.snapshot()
        if index:
            from orthonav.atlas.index import make_index  # with FAISS

            make_index(atlas, progress=report)
    except OrthonavError as error:
        return str(error)
    return None


def _usual_gsd_m(mosaic: Mosaic, recipe: AtlasRecipe) -> float:
    """The ground resolution of the imagery as people state it."""
    side_m = recipe.sheet_km * 1000
    area = Area(LocalFrame(0.0, 0.0), (0.0, 0.0, side_m, side_m))
    return grid_of(area, mosaic.gsd_m, None, recipe.tile_px, recipe.overlap).gsd_m


def _peak_bytes() -> int:
    """Most memory that this process ever had: it remembers the sheets before, too."""
    with contextlib.suppress(OSError):  # Linux's own count: the other remembers the parent, too
        status = Path("/proc/self/status").read_text(encoding="ascii", errors="replace")
        for line in status.splitlines():
            if line.startswith("VmHWM:"):
                return int(line.split()[1]) * 1024
    with contextlib.suppress(ImportError):  # not a Unix
        import resource

        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        return peak if sys.platform == "darwin" else peak * 1024
    return 0
