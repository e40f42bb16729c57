"""Building an atlas: every sheet is a task of its own, for any worker on any machine.

A sheet is finished when its item is written, so an interrupted build keeps its finished sheets and
the same command resumes it. The same imagery, recipe and versions give the same atlas byte for
byte, with any number of workers, on processors that round alike.
"""

import contextlib
import fcntl
import logging
import shutil
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from orthonav.core.errors import AreaError, AtlasError, OrthonavError, OutputError, WorkerError
from orthonav.core.files import Progress, no_progress
from orthonav.ground.atlas.build_report import BuildReport, SheetResult
from orthonav.ground.atlas.catalog import CATALOG, Atlas
from orthonav.ground.atlas.cluster import Failure, TaskRunner
from orthonav.ground.atlas.coarse import write_coarse
from orthonav.ground.atlas.item import Sheet
from orthonav.ground.atlas.recipe import AtlasRecipe, CoarseRecipe
from orthonav.ground.atlas.sheet_tasks import (
    AtlasRequest,
    Imagery,
    SheetTask,
    margin_m,
    plan_sheets,
    request_digest,
    require_same,
    version_differences,
    versions,
)
from orthonav.ground.atlas.store import Store
from orthonav.ground.build.build import BuildRequest, build_map
from orthonav.ground.build.sheet import rounded_gsd_m
from orthonav.ground.imagery.mosaic import Mosaic
from orthonav.ground.imagery.terrain import open_dem

log = logging.getLogger(__name__)

PROGRESS_EVERY_S = 10.0
"""Between two lines of progress."""
GIVE_UP_AFTER = 8
"""Sheets in a row that could not be stored, after which a build ends: the disk is full or gone."""
SCRATCH = "orthonav-sheet-"
"""Names of temporary folders begin with it."""
_LOCK = "in-use"
LEARNT = ("autoencoder", "caevl", "triplet")
"""Methods for which a worker is given a GPU."""


def build_atlas(
    request: AtlasRequest,
    runner: TaskRunner,
    progress: Progress = no_progress,
    report: Callable[[str], None] = log.info,
) -> BuildReport:
    """Build the missing sheets with a runner that was entered, and report the results.

    A sheet that fails is listed in the result, and the others are built. `progress` is called
    with a stage and its share done, `report` with lines for people. Raises `AreaError`,
    `ImageryError`, `MissingFileError`; `AtlasError` where present sheets are of other imagery or
    versions; `WorkerError` where workers have other versions; `StorageError`.
    """
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
    """The requested recipe. Raises `AtlasError` where it is impossible, or not the atlas's."""
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
    """The requested fields of the recipe; those of the coarse tiles completed."""
    fields = dict(request.recipe)
    if isinstance(fields.get("coarse"), Mapping):
        fields["coarse"] = replace(coarse or CoarseRecipe(), **fields["coarse"])
    return fields


def build_sheet(task: SheetTask) -> SheetResult:
    """Build a sheet and put it into the atlas. Depends only on the task and the imagery.

    Raises `WorkerError` where this program has other versions than the task, `AtlasError` where it
    sees other imagery, `ImageryError`, `OutputError`, `StorageError`.
    """
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
    """The sheet, which is now in the atlas; None where it has no imagery."""
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
    """Have the sheets built and add what comes of them to `result`."""
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
    """Raise `WorkerError` where a machine has other versions and would make other bytes."""
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
    """A new folder in the system's folder of temporary files (`TMPDIR`), removed afterwards.

    It is locked while this process lives; folders of processes that were killed are removed first.
    Raises `OutputError`.
    """
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
    """Greatest memory that this process ever had, earlier sheets included; 0 where unknown.

    Linux's own count: that of getrusage includes the parent's.
    """
    with contextlib.suppress(OSError):
        status = Path("/proc/self/status").read_text(encoding="ascii", errors="replace")
        for line in status.splitlines():
            if line.startswith("VmHWM:"):
                return int(line.split()[1]) * 1024
    return 0
