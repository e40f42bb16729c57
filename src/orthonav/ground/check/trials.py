"""Trials: views of the map's ground as another year might show it, placed by the code that flies.

Each trial draws a place, a heading and errors of the telemetry, makes a view and registers it. With
an orthophoto of a second date, trials are repeated with views of that.
"""

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

import cv2
import numpy as np
from numpy.typing import NDArray

from orthonav.core.errors import MapFileError, WorkerError
from orthonav.core.localize import Localizer
from orthonav.core.localize.localizer import RegistrationLocalizer
from orthonav.core.mapfile import open_map
from orthonav.core.mapfile.reader import MapFile
from orthonav.core.records import NoFix, Prior, View
from orthonav.core.register.template import Levels
from orthonav.ground.check.change import another_year, displaced
from orthonav.ground.check.persistence import MARGIN_PX
from orthonav.ground.check.views import (
    OrthoPyramid,
    TrialPlan,
    crop_around,
    mirrored_donor,
    reported_persistence,
    view_of,
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

    `en_m`: true position.
    `error_m`: error of the fix; NaN without one.
    `confidence`: of the fix; 0 without one.
    `expected`: mean persistence of the view; NaN for a second date.
    `right`, `wrong`: the fix is accepted, and within the radius of the map or not.
    `found_en_m`: position of the fix.
    `rival_en_m`: best other place at least a quarter of a view away.
    `rival_share`: its score divided by the best score; NaN without a rival.
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
    """Set up a worker, which ends when its parent does."""
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
    """Registration over level ground; raises `MapFileError` where the map has no layer for it."""
    found = Localizer(opened, level_ground=True).registration
    if found is None:
        raise MapFileError(f"only maps with a registration layer can be checked: {opened.path}")
    return found


class Trier:
    """Runs trials of plans that share a map.

    Files are opened by the first trial, so that errors of a worker reach its parent.
    """

    def __init__(self, plans: Sequence[TrialPlan]) -> None:
        self._plans = plans
        self._files = ExitStack()

    def close(self) -> None:
        """Close the orthophoto of the second date."""
        self._files.close()

    def __call__(self, job: _Job) -> _Outcome:
        """Run a job: number of the plan, index, metres east and north.

        Raises as `registration_of` does.
        """
        number, index, east, north = job
        plan = self._plans[number]
        rng = np.random.default_rng([plan.request.seed + plan.second_date, index])
        return number, self._trial(rng, plan, np.array([east, north]))

    @cached_property
    def _registration(self) -> RegistrationLocalizer:
        return registration_of(open_map(self._plans[0].request.map_path))

    @cached_property
    def _other(self) -> OrthoPyramid:
        """The orthophoto of the second date."""
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
        fix = registration.fix(search, best, view.telemetry)
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
