"""Trial views, cut from the map's own imagery or from that of a second date."""

import math
import os
import signal
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import ExitStack, closing
from dataclasses import dataclass
from functools import cached_property
from multiprocessing import get_context, parent_process
from multiprocessing.synchronize import Event
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from orthonav.core.errors import AreaError, MapFileError, WorkerError
from orthonav.core.geo.camera import Camera
from orthonav.core.geo.grid import TileGrid
from orthonav.core.localize import Localizer
from orthonav.core.localize.fix import fix_of
from orthonav.core.localize.localizer import RegistrationLocalizer
from orthonav.core.mapfile import open_map
from orthonav.core.mapfile.layer import level_shape
from orthonav.core.mapfile.manifest import SheetInfo
from orthonav.core.mapfile.reader import MapFile
from orthonav.core.records import NoFix, Prior, Telemetry, View
from orthonav.core.register.pose import rotation
from orthonav.core.register.template import Levels
from orthonav.core.register.window import GreyPyramid
from orthonav.ground.check.ageing import MARGIN_PX, another_year, default_model, displaced, features
from orthonav.ground.check.request import CheckRequest
from orthonav.ground.imagery.mosaic import Mosaic, SheetRaster

EVERY_PX, PERSISTENCE_LEVELS = 8, 3
"""Persistence is computed every so many pixels, at so many levels: coarser detail lasts alike."""
MIN_VALID = 0.3
"""Views that see less of the map than this fraction are skipped: the localizer refuses them."""
_DONOR_DRAWS = 12

Grey = NDArray[np.uint8]
Points = NDArray[np.float64]


@dataclass(frozen=True)
class TrialPlan:
    """How trial views are made; the seed of `request` and the number of a trial give its random
    numbers.

    `second_date`: views are cut from the orthophoto of a second date, not from the map's imagery
    with simulated ageing.
    `yaw_off_deg`: additional heading error, to either side at random; `agl_off`: height error, a
    fraction of the height.
    """

    request: CheckRequest
    agl_m: float
    second_date: bool = False
    yaw_off_deg: float = 0.0
    agl_off: float = 0.0

    @property
    def width_m(self) -> float:
        """Footprint along the rows of the image."""
        return self.agl_m * self.request.camera.width_px / self.request.camera.fx_px

    @property
    def height_m(self) -> float:
        """Footprint along the columns of the image."""
        return self.agl_m * self.request.camera.height_px / self.request.camera.fy_px

    @property
    def side_m(self) -> float:
        """Side of the square with the area of the footprint."""
        return math.sqrt(self.width_m * self.height_m)

    @property
    def footprint_text(self) -> str:
        return f"a view from {self.agl_m:.0f} m covers {self.width_m:.0f} x {self.height_m:.0f} m"


def reported_persistence(grey: Grey, gsd_m: float, first: int = 0) -> list[NDArray[np.float32]]:
    """Persistence maps (H, W) of a picture at its own resolution, half of it, and a quarter.

    Resolutions finer than that of level `first` repeat its values.
    """
    model = default_model()
    found: list[NDArray[np.float32]] = []
    picture = grey
    height, width = grey.shape
    for level in range(PERSISTENCE_LEVELS):
        if level >= first:
            coarse = model(features(picture, gsd_m * 2**level, max(EVERY_PX >> level, 1)))
            full = cv2.resize(coarse, (width, height), interpolation=cv2.INTER_LINEAR)
            found.append(np.asarray(full, np.float32))
        half = cv2.resize(picture, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
        picture = np.asarray(half, np.uint8)
        if min(picture.shape) < 2 * MARGIN_PX and found:
            break
    return [found[0]] * first + found


def crop_around(
    layer: GreyPyramid, grid: TileGrid, en_m: Points, size: int, level: int
) -> tuple[Grey, NDArray[np.bool_], Points] | None:
    """Grey, valid and the exact centre of a square crop; None where too little of it has imagery.

    The crop is `size` pixels of the level wide, plus `MARGIN_PX` on each side. `layer` is in the
    plane of the checked map, whose tile grid is `grid`.
    """
    unit_m = grid.gsd_m * 2**level
    whole = size + 2 * MARGIN_PX
    col = round((en_m[0] - grid.west_m) / unit_m - whole / 2)
    row = round((grid.north_m - en_m[1]) / unit_m - whole / 2)
    grey, valid = layer.read(level, row, col, whole, whole)
    if valid[MARGIN_PX:-MARGIN_PX, MARGIN_PX:-MARGIN_PX].mean() < MIN_VALID:
        return None
    if not valid.all():
        grey = np.where(valid, grey, np.uint8(grey[valid].mean()))
    east = grid.west_m + (col + whole / 2) * unit_m
    north = grid.north_m - (row + whole / 2) * unit_m
    return grey, valid, np.array([east, north])


def mirrored_donor(rng: np.random.Generator, layer: GreyPyramid, size: int, level: int) -> Grey:
    """Mirrored ground (size, size) of a random place, so that it matches no place."""
    rows, cols = layer.shape(level)
    for _ in range(_DONOR_DRAWS):
        row = int(rng.integers(0, max(rows - size, 1)))
        col = int(rng.integers(0, max(cols - size, 1)))
        grey, valid = layer.read(level, row, col, size, size)
        if valid.all():
            break
    else:
        grey = np.where(valid, grey, np.uint8(128))
    return np.ascontiguousarray(grey[:, ::-1])


class OrthoPyramid:
    """Grey levels of an orthophoto in the plane and at the resolutions of a map's sheet. Not safe
    to share between threads."""

    def __init__(self, path: Path, sheet: SheetInfo, levels: int) -> None:
        self.levels = levels
        self._sheet, self._mosaic = sheet, Mosaic.open([path])
        self._opened: dict[int, SheetRaster] = {}
        self._stack = ExitStack()

    def close(self) -> None:
        self._stack.close()
        self._opened.clear()

    def shape(self, level: int) -> tuple[int, int]:
        return level_shape(self._sheet.grid.height_px, self._sheet.grid.width_px, level)

    def read(
        self, level: int, row: int, col: int, height: int, width: int
    ) -> tuple[NDArray[np.uint8], NDArray[np.bool_]]:
        """Grey and valid (height, width) of a window, which may reach beyond the sheet."""
        pixels = self._raster(level).read_grey(col, row, width, height)
        return pixels.grey, pixels.valid

    def _raster(self, level: int) -> SheetRaster:
        if level not in self._opened:
            grid = self._sheet.grid
            rows, cols = self.shape(level)
            raster = self._mosaic.sheet(
                self._sheet.frame,
                west_m=grid.west_m,
                north_m=grid.north_m,
                width_px=cols,
                height_px=rows,
                gsd_m=grid.gsd_m * 2**level,
                threads=1,  # trials run in several processes
            )
            self._opened[level] = self._stack.enter_context(raster)
        return self._opened[level]


def require_overlap(path: Path, sheet: SheetInfo) -> None:
    lat_lon = Mosaic.open([path]).outline_latlon_deg
    points = sheet.frame.en_from_latlon(lat_lon[:, 0], lat_lon[:, 1])
    west_m, south_m, east_m, north_m = sheet.grid.extent_en_m
    (west, south), (east, north) = points.min(axis=0), points.max(axis=0)
    if east < west_m or west > east_m or north < south_m or south > north_m:
        raise AreaError(f"the orthophoto of the other date does not overlap the map: {path}")


def view_of(rng: np.random.Generator, plan: TrialPlan, picture: Grey, gsd_m: float) -> View:
    size = picture.shape[0]
    width = max(8, round(plan.width_m / gsd_m))
    height = max(8, round(plan.height_m / gsd_m))
    yaw_deg = float(rng.uniform(0, 360))
    linear = rotation(math.radians(yaw_deg))
    move = np.full(2, (size - 1) / 2) - linear @ [(width - 1) / 2, (height - 1) / 2]
    camera_gsd_m = plan.request.camera.gsd_m(plan.agl_m)
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
    focal = plan.agl_m / gsd_m
    camera = Camera(width, height, focal, focal, width / 2, height / 2)
    return View(np.asarray(view, dtype=np.uint8), camera, _telemetry(rng, plan, yaw_deg))


def _telemetry(rng: np.random.Generator, plan: TrialPlan, yaw_deg: float) -> Telemetry:
    yaw_error_deg = plan.yaw_off_deg if rng.random() < 0.5 else -plan.yaw_off_deg
    if plan.request.yaw_std_deg is not None:
        yaw_error_deg += float(rng.normal(0, plan.request.yaw_std_deg))
    agl_m = plan.agl_m * max(0.5, 1 + plan.agl_off + float(rng.normal(0, plan.request.agl_std)))
    return Telemetry(
        time_ns=0,
        yaw_deg=yaw_deg + yaw_error_deg,
        pitch_deg=0.0,
        roll_deg=0.0,
        agl_m=agl_m,
        yaw_std_deg=plan.request.yaw_std_deg,
        agl_std_m=plan.request.agl_std * agl_m,
        tilt_std_deg=plan.request.tilt_std_deg,
    )


AT_ONCE = 8
"""Trials that a worker takes at a time: about a second of work."""
RELIEF_CELL_M = 15.0
"""Distance over which the height of objects changes: a house or a group of trees."""
NOWHERE = (math.nan, math.nan)

Work = tuple[TrialPlan, NDArray[np.float64]]
"""A plan and the places (N, 2) of its trials, metres in the plane of the map's sheet."""


@dataclass(frozen=True, eq=False)
class Trial:
    """The outcome of one trial. Positions are metres in the plane of the map's sheet.

    `error_m`: error of the fix, NaN without one; `confidence`: 0 without one.
    `expected`: mean persistence of the view; NaN for a second date.
    `right`, `wrong`: the fix is accepted, and within the radius of the map or not.
    `rival_en_m`: best other place at least a quarter of a view away; `rival_share`: its score
    divided by the best score.
    """

    en_m: tuple[float, float]
    error_m: float
    confidence: float
    expected: float
    right: bool = False
    wrong: bool = False
    found_en_m: tuple[float, float] = NOWHERE
    rival_en_m: tuple[float, float] = NOWHERE
    rival_share: float = math.nan


def run_many(
    work: Sequence[Work], workers: int, progress: Callable[[float], None] = lambda share: None
) -> list[list[Trial]]:
    """Trials of several plans of one map, in the order of their places; those off it are left out.

    `progress` is called with 0..1. The result does not depend on the number of `workers`
    (processes). Raises `WorkerError` where one of them ends unexpectedly.
    """
    jobs = [
        (number, index, float(east), float(north))
        for number, (_, places) in enumerate(work)
        for index, (east, north) in enumerate(places)
    ]
    plans = [plan for plan, _ in work]
    found: list[list[Trial]] = [[] for _ in work]
    for done, (number, trial) in enumerate(_run_jobs(plans, jobs, workers)):
        if trial is not None:
            found[number].append(trial)
        progress((done + 1) / len(jobs))
    return found


_Job = tuple[int, int, float, float]
_Outcome = tuple[int, Trial | None]


def _run_jobs(plans: list[TrialPlan], jobs: list[_Job], workers: int) -> Iterator[_Outcome]:
    if workers <= 1 or len(jobs) < 4 * AT_ONCE:
        trier = Trier(plans)
        try:
            yield from map(trier, jobs)
        finally:
            trier.close()
        return
    context = get_context("spawn")  # forking a process with threads is not safe
    workers = min(workers, -(-len(jobs) // AT_ONCE))
    stop = context.Event()
    with ProcessPoolExecutor(workers, context, _start_worker, (plans, stop)) as pool:
        try:
            yield from _submit(pool, jobs)
        except BrokenProcessPool as error:
            raise WorkerError(
                f"one of the {workers} worker processes ended unexpectedly, perhaps for lack of "
                "memory; try fewer (--workers)"
            ) from error
        finally:
            stop.set()  # do not wait for submitted jobs
            pool.shutdown(cancel_futures=True)


def _submit(pool: ProcessPoolExecutor, jobs: list[_Job]) -> Iterator[_Outcome]:
    """Outcomes in the order of the jobs. Ctrl-C is blocked while workers start, which inherit that:
    only the parent handles it."""
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        return pool.map(_work, jobs, chunksize=AT_ONCE)
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


_stop: Event
_trier: "Trier"


def _start_worker(plans: list[TrialPlan], stop: Event) -> None:
    global _stop, _trier
    _stop, _trier = stop, Trier(plans)
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_exit_with_parent, daemon=True).start()
    cv2.setNumThreads(1)


def _exit_with_parent() -> None:
    parent = parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


def _work(job: _Job) -> _Outcome:
    return (job[0], None) if _stop.is_set() else _trier(job)


def registration_of(opened: MapFile) -> RegistrationLocalizer:
    found = Localizer(opened, level_ground=True).registration
    if found is None:
        raise MapFileError(f"only maps with a registration layer can be checked: {opened.path}")
    return found


class Trier:
    """Runs trials. Files are opened by the first one, so that errors of a worker reach its
    parent."""

    def __init__(self, plans: Sequence[TrialPlan]) -> None:
        self._plans = plans
        self._files = ExitStack()

    def close(self) -> None:
        self._files.close()

    def __call__(self, job: _Job) -> _Outcome:
        number, index, east, north = job
        plan = self._plans[number]
        rng = np.random.default_rng([plan.request.seed + plan.second_date, index])
        return number, self._trial(rng, plan, np.array([east, north]))

    @cached_property
    def _registration(self) -> RegistrationLocalizer:
        return registration_of(open_map(self._plans[0].request.map_path))

    @cached_property
    def _other(self) -> OrthoPyramid:
        path, registration = self._plans[0].request.other_date, self._registration
        assert path is not None
        other = OrthoPyramid(path, registration.sheet, registration.pyramid.levels)
        return self._files.enter_context(closing(other))

    def _trial(
        self, rng: np.random.Generator, plan: TrialPlan, en_m: NDArray[np.float64]
    ) -> Trial | None:
        registration, request = self._registration, plan.request
        grid = registration.grid
        # One level finer than the final one, where ambiguous views are registered too.
        final = Levels.of(plan.side_m / grid.gsd_m, registration.pyramid.levels).final
        level = max(final - 1, 0)
        gsd_m = grid.gsd_m * 2**level
        size = math.ceil(math.hypot(plan.width_m, plan.height_m) / gsd_m) + 4
        layer = self._other if plan.second_date else registration.pyramid
        crop = crop_around(layer, grid, en_m, size, level)
        if crop is None:
            return None
        grey, valid, place = crop
        donor = mirrored_donor(rng, registration.pyramid, size, level)
        inner = np.s_[MARGIN_PX : MARGIN_PX + size, MARGIN_PX : MARGIN_PX + size]
        lasting = valid[inner]
        if request.changes is not None and not plan.second_date:
            steps = (np.arange(size) + 0.5 - size / 2) * gsd_m
            points = np.stack(np.meshgrid(steps, -steps), axis=-1) + place
            lasting = lasting & ~request.changes.covers(points, registration.sheet.frame)
        picture = np.where(lasting, grey[inner], donor)
        expected = math.nan
        if not plan.second_date:
            maps = [each[inner] for each in reported_persistence(grey, gsd_m, final - level)]
            expected = float(np.mean([each.mean() for each in maps[:2]]))
            picture = another_year(rng, picture, donor, maps)
        if request.relief_m > 0:
            rim_px = request.relief_m * size / 2 / plan.agl_m
            picture = displaced(rng, picture, rim_px, RELIEF_CELL_M / gsd_m)
        view = view_of(rng, plan, picture, gsd_m)
        return self._placed(rng, plan, place, view, expected)

    def _placed(
        self,
        rng: np.random.Generator,
        plan: TrialPlan,
        place_en_m: NDArray[np.float64],
        view: View,
        expected: float,
    ) -> Trial:
        registration = self._registration
        here = (float(place_en_m[0]), float(place_en_m[1]))
        prior = None
        if plan.request.prior_std_m is not None:
            at = place_en_m + rng.normal(0, plan.request.prior_std_m, 2)
            lat, lon = registration.sheet.frame.latlon_from_en(at)
            prior = Prior(float(lat), float(lon), plan.request.prior_std_m)
        search = registration.search(view, prior, plan.request.yaw_std_deg is not None)
        best = search if isinstance(search, NoFix) else search.run()
        if isinstance(search, NoFix) or isinstance(best, NoFix):
            return Trial(here, math.nan, 0.0, expected)
        fix = fix_of(search, best)
        found = registration.sheet.frame.en_from_latlon(fix.lat_deg, fix.lon_deg)
        rivals = [
            each
            for each in best.rivals
            if each.apart_px(best) * registration.grid.gsd_m > plan.side_m / 4
        ]
        rival, share = NOWHERE, math.nan
        if rivals:
            strongest = max(rivals, key=lambda each: each.score)
            east, north = registration.camera_en_m(search.view, strongest.pose)
            rival, share = (float(east), float(north)), strongest.score / max(best.score, 1e-6)
        error_m = float(np.hypot(*(found - place_en_m)))
        confidence = fix.confidence if math.isfinite(fix.confidence) else 0.0
        accepted, near = confidence >= plan.request.accept, error_m <= fix.radius_m
        return Trial(
            en_m=here,
            error_m=error_m,
            confidence=confidence,
            expected=expected,
            right=accepted and near,
            wrong=accepted and not near,
            found_en_m=(float(found[0]), float(found[1])),
            rival_en_m=rival,
            rival_share=share,
        )
