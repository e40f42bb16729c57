"""Trial views, cut from the map's own imagery or from that of a second date."""

import math
import os
import signal
import threading
from collections.abc import Callable, Generator, Iterable, Iterator
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass
from functools import cached_property, partial
from multiprocessing import get_context, parent_process
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from orthonav.core.errors import AreaError, MapFileError, WorkerError
from orthonav.core.geo.camera import Camera
from orthonav.core.geo.grid import TileGrid
from orthonav.core.localize import Localizer
from orthonav.core.localize.localizer import registered
from orthonav.core.localize.prepared import PreparedMap
from orthonav.core.mapfile import open_map
from orthonav.core.mapfile.layer import level_shape
from orthonav.core.mapfile.reader import MapFile
from orthonav.core.records import NoFix, Prior, Telemetry, View
from orthonav.core.register.template import Levels
from orthonav.core.register.window import GreyPyramid, rotation
from orthonav.ground.check.ageing import MARGIN_PX, another_year, displaced, reported_persistence
from orthonav.ground.check.records import CheckRequest, Conditions
from orthonav.ground.imagery.mosaic import Mosaic, SheetRaster

MIN_VALID = 0.3
"""Views that see less of the map than this fraction are skipped: the localizer refuses them."""
Grey = NDArray[np.uint8]
Points = NDArray[np.float64]


def crop_around(
    read: Callable[[int, int, int], tuple[Grey, NDArray[np.bool_]]],
    grid: TileGrid,
    en_m: Points,
    size: int,
    gsd_m: float,
) -> tuple[Grey, NDArray[np.bool_], Points] | None:
    """Grey, valid and the exact centre of a square crop; None where too little of it has imagery.

    The crop is `size` pixels of `gsd_m` wide, plus `MARGIN_PX` on each side. `read` takes row,
    column and side of a square in such pixels of the sheet, which may reach beyond it.
    """
    whole = size + 2 * MARGIN_PX
    col = round((en_m[0] - grid.west_m) / gsd_m - whole / 2)
    row = round((grid.north_m - en_m[1]) / gsd_m - whole / 2)
    grey, valid = read(row, col, whole)
    if valid[MARGIN_PX:-MARGIN_PX, MARGIN_PX:-MARGIN_PX].mean() < MIN_VALID:
        return None
    if not valid.all():
        grey = np.where(valid, grey, np.uint8(grey[valid].mean()))
    east = grid.west_m + (col + whole / 2) * gsd_m
    north = grid.north_m - (row + whole / 2) * gsd_m
    return grey, valid, np.array([east, north])


def mirrored_donor(rng: np.random.Generator, layer: GreyPyramid, size: int, level: int) -> Grey:
    """Mirrored ground (size, size) of a random place, so that it matches no place."""
    rows, cols = layer.shape(level)
    for _ in range(12):
        row = int(rng.integers(0, max(rows - size, 1)))
        col = int(rng.integers(0, max(cols - size, 1)))
        grey, valid = layer.read(level, row, col, size, size)
        if valid.all():
            break
    else:
        grey = np.where(valid, grey, np.uint8(128))
    return np.ascontiguousarray(grey[:, ::-1])


def require_other_date(path: Path, opened: MapFile) -> None:
    """Raise `AreaError` for an orthophoto of other ground, or that the map was built from."""
    mosaic, sheet = Mosaic.open([path]), opened.manifest.sheets[0]
    if any(each["date"] and each in opened.manifest.imagery for each in mosaic.describe()):
        raise AreaError(f"the map was built from this orthophoto; name one of another date: {path}")
    lat_lon = mosaic.outline_latlon_deg
    points = sheet.frame.en_from_latlon(lat_lon[:, 0], lat_lon[:, 1])
    west_m, south_m, east_m, north_m = sheet.grid.extent_en_m
    (west, south), (east, north) = points.min(axis=0), points.max(axis=0)
    if east < west_m or west > east_m or north < south_m or south > north_m:
        raise AreaError(f"the orthophoto of the other date does not overlap the map: {path}")


def view_of(
    rng: np.random.Generator,
    request: CheckRequest,
    conditions: Conditions,
    picture: Grey,
    gsd_m: float,
) -> View:
    """A view from the middle of a picture (S, S), with errors of its telemetry."""
    size = picture.shape[0]
    width = max(8, round(conditions.width_m / gsd_m))
    height = max(8, round(conditions.height_m / gsd_m))
    yaw_deg = float(rng.uniform(0, 360))
    linear = rotation(math.radians(yaw_deg))
    move = np.full(2, (size - 1) / 2) - linear @ [(width - 1) / 2, (height - 1) / 2]
    camera_gsd_m = request.camera.gsd_m(conditions.agl_m)
    if camera_gsd_m > gsd_m:
        blur_px = 0.5 * camera_gsd_m / gsd_m
        picture = np.asarray(cv2.GaussianBlur(picture, (0, 0), blur_px), np.uint8)
    view = cv2.warpAffine(
        picture,
        np.column_stack([linear, move]),
        (width, height),
        flags=cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP,
        borderMode=cv2.BORDER_REFLECT,
    )
    focal = conditions.agl_m / gsd_m
    camera = Camera(width, height, focal, focal, width / 2, height / 2)
    yaw_error_deg = float(rng.normal(0, conditions.yaw_std_deg or 0.0))
    agl_m = conditions.agl_m * max(0.5, 1 + float(rng.normal(0, conditions.agl_std)))
    telemetry = Telemetry(
        time_ns=0,
        yaw_deg=yaw_deg + yaw_error_deg,
        pitch_deg=0.0,
        roll_deg=0.0,
        agl_m=agl_m,
        yaw_std_deg=conditions.yaw_std_deg,
        agl_std_m=conditions.agl_std * agl_m,
        tilt_std_deg=conditions.tilt_std_deg,
    )
    return View(np.asarray(view, dtype=np.uint8), camera, telemetry)


@dataclass(frozen=True, eq=False)
class Trial:
    """The outcome of one trial. Positions are metres in the plane of the map's sheet.

    `error_m`: error of the fix, NaN without one; `stated_m`: the same as its covariance states it
    (root mean square), NaN without.
    `expected`: mean persistence of the view; NaN for a second date.
    `right`, `wrong`: the fix is accepted, and within the radius of the map or not.
    """

    en_m: tuple[float, float]
    error_m: float
    expected: float
    right: bool = False
    wrong: bool = False
    stated_m: float = math.nan


def run_trials(
    request: CheckRequest,
    conditions: Conditions,
    batches: Iterable[Points],
    workers: int,
    progress: Callable[[int], None] = lambda done: None,
) -> Generator[tuple[int, list[Trial], list[Trial]], None, None]:
    """Trials at batches of places (N, 2) in the plane of the map's sheet, in their order: of the
    map's own imagery with simulated ageing, and of the second date, if any, after the number of
    places; those off the map are left out.

    `progress` is called with the number of places done. The result does not depend on the number of
    `workers` (processes). Raises `WorkerError` where one of them ends unexpectedly.
    """
    dates = (False,) if request.other_date is None else (False, True)
    number = 0
    with _runner(request, conditions, workers) as run:
        for places in batches:
            here = list(enumerate(places.tolist(), number))
            jobs = [(date, index, east, north) for index, (east, north) in here for date in dates]
            found: tuple[list[Trial], list[Trial]] = [], []
            for done, (job, trial) in enumerate(zip(jobs, run(jobs), strict=True), 1):
                if trial is not None:
                    found[job[0]].append(trial)
                progress(number + done // len(dates))
            number += len(places)
            yield len(places), *found


_Job = tuple[bool, int, float, float]
"""Whether it is of the second date, its number, and its place."""
_Run = Callable[[list[_Job]], Iterable[Trial | None]]


@contextmanager
def _runner(request: CheckRequest, conditions: Conditions, workers: int) -> Iterator[_Run]:
    """Runs jobs, in this process if `workers` is 1."""
    if workers <= 1:
        with closing(Trier(request, conditions)) as trier:
            yield partial(map, trier)
        return
    context = get_context("spawn")  # forking a process with threads is not safe
    with ProcessPoolExecutor(workers, context, _start_worker, (request, conditions)) as pool:
        try:
            yield partial(_submit, pool)
        except BrokenProcessPool as error:
            raise WorkerError(
                f"one of the {workers} worker processes ended unexpectedly, perhaps for lack of "
                "memory; try fewer (--workers)"
            ) from error
        finally:
            pool.shutdown(cancel_futures=True)


def _submit(pool: ProcessPoolExecutor, jobs: list[_Job]) -> Iterator[Trial | None]:
    """Outcomes in the order of the jobs. Ctrl-C is blocked while workers start, which inherit that:
    only the parent handles it."""
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        return pool.map(_work, jobs)
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


_trier: "Trier"


def _start_worker(request: CheckRequest, conditions: Conditions) -> None:
    global _trier
    _trier = Trier(request, conditions)
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_exit_with_parent, daemon=True).start()
    cv2.setNumThreads(1)


def _exit_with_parent() -> None:
    parent = parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


def _work(job: _Job) -> Trial | None:
    return _trier(job)


def registration_of(opened: MapFile) -> PreparedMap:
    found = Localizer(opened, level_ground=True).registration
    if found is None:
        raise MapFileError(f"only maps with a registration layer can be checked: {opened.path}")
    return found


class Trier:
    """Runs trials. Files are opened by the first one, so that errors of a worker reach its
    parent."""

    def __init__(self, request: CheckRequest, conditions: Conditions) -> None:
        self._request, self._conditions = request, conditions
        self._files = ExitStack()

    def close(self) -> None:
        self._files.close()

    def __call__(self, job: _Job) -> Trial | None:
        """The trial at a place; None where too little of a view has imagery."""
        second_date, index, east, north = job
        registration, request, conditions = self._registration, self._request, self._conditions
        rng = np.random.default_rng([request.seed + second_date, index])
        level = self._level
        gsd_m = registration.grid.gsd_m * 2**level
        size = math.ceil(math.hypot(conditions.width_m, conditions.height_m) / gsd_m) + 4
        read = self._read_other if second_date else self._read_own
        crop = crop_around(read, registration.grid, np.array([east, north]), size, gsd_m)
        if crop is None:
            return None
        grey, valid, place = crop
        donor = mirrored_donor(rng, registration.pyramid, size, level)
        inner = np.s_[MARGIN_PX : MARGIN_PX + size, MARGIN_PX : MARGIN_PX + size]
        picture = np.where(valid[inner], grey[inner], donor)
        expected = math.nan
        if not second_date:
            found = reported_persistence(grey, gsd_m, self._final_level - level)
            maps = [each[inner] for each in found]
            expected = float(np.mean([each.mean() for each in maps[:2]]))
            picture = another_year(rng, picture, donor, maps)
        if request.relief_m > 0:
            rim_px = request.relief_m * size / 2 / conditions.agl_m
            picture = displaced(rng, picture, rim_px, 15.0 / gsd_m)  # a house, a group of trees
        view = view_of(rng, request, conditions, picture, gsd_m)
        return self._placed(rng, place, view, expected)

    @cached_property
    def _registration(self) -> PreparedMap:
        return registration_of(open_map(self._request.map_path))

    @cached_property
    def _final_level(self) -> int:
        registration = self._registration
        side_px = self._conditions.side_m / registration.grid.gsd_m
        return Levels.of(side_px, registration.pyramid.levels, finer=registration.is_finer).final

    @property
    def _level(self) -> int:
        """One level finer than the final one, where ambiguous views are registered too."""
        return max(self._final_level - 1, 0)

    @cached_property
    def _other(self) -> SheetRaster:
        """The second date in the plane of the sheet, at the resolution of the level."""
        grid, path = self._registration.grid, self._request.other_date
        assert path is not None
        rows, cols = level_shape(grid.height_px, grid.width_px, self._level)
        raster = Mosaic.open([path]).sheet(
            self._registration.sheet.frame,
            west_m=grid.west_m,
            north_m=grid.north_m,
            width_px=cols,
            height_px=rows,
            gsd_m=grid.gsd_m * 2**self._level,
            threads=1,  # trials run in several processes
        )
        return self._files.enter_context(raster)

    def _read_own(self, row: int, col: int, side: int) -> tuple[Grey, NDArray[np.bool_]]:
        return self._registration.pyramid.read(self._level, row, col, side, side)

    def _read_other(self, row: int, col: int, side: int) -> tuple[Grey, NDArray[np.bool_]]:
        pixels = self._other.read_grey(col, row, side, side)
        return pixels.grey, pixels.valid

    def _placed(
        self, rng: np.random.Generator, place_en_m: Points, view: View, expected: float
    ) -> Trial:
        registration, conditions = self._registration, self._conditions
        here = (float(place_en_m[0]), float(place_en_m[1]))
        prior = None
        if conditions.prior_std_m is not None:
            at = place_en_m + rng.normal(0, conditions.prior_std_m, 2)
            lat, lon = registration.sheet.frame.latlon_from_en(at)
            prior = Prior(float(lat), float(lon), conditions.prior_std_m)
        fix = registered(registration, view, prior, conditions.yaw_std_deg is not None)
        if isinstance(fix, NoFix):
            return Trial(here, math.nan, expected)
        found = registration.sheet.frame.en_from_latlon(fix.lat_deg, fix.lon_deg)
        error_m = float(np.hypot(*(found - place_en_m)))
        accepted, near = fix.confidence >= conditions.accept, error_m <= fix.radius_m
        return Trial(
            en_m=here,
            error_m=error_m,
            expected=expected,
            right=accepted and near,
            wrong=accepted and not near,
            stated_m=math.sqrt(float(np.trace(fix.cov_en_m2))),
        )
