"""Trials: views of the map's own ground as another year might show it, placed by what flies.

Each trial draws a place, a heading and what is told wrongly, makes the view and registers it. The
same is done with pictures of a second date where there is one.
"""

import math
import os
import signal
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from multiprocessing import get_context, parent_process
from multiprocessing.synchronize import Event
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from orthonav.check.change import another_year, tilted
from orthonav.check.ortho import OrthoPyramid
from orthonav.check.persistence import MARGIN_PX
from orthonav.check.views import (
    Pictures,
    TrialPlan,
    reported_persistence,
    view_levels,
    view_of,
)
from orthonav.errors import MapFileError, WorkerError
from orthonav.localizer import Localizer
from orthonav.mapfile import open_map
from orthonav.records import NoFix, Prior, View
from orthonav.register.registrar import apart_px

AT_ONCE = 8
"""Trials that a worker is handed at a time."""
RELIEF_CHANGES_M = 15.0


@dataclass(frozen=True, eq=False)
class Trial:
    """What came out of one. Positions are metres in the plane of the map's sheet.

    `confidence` 0 where there was no answer; `expected` is the mean persistence of what was seen;
    `rival_en_m` the best place elsewhere that was finished and `rival_share` its score as a share
    of that of the best, NaN where there was none.
    """

    index: int
    en_m: tuple[float, float]
    error_m: float
    confidence: float
    expected: float
    found_en_m: tuple[float, float]
    rival_en_m: tuple[float, float]
    rival_share: float


def run_trials(
    plan: TrialPlan,
    places_en_m: NDArray[np.float64],
    workers: int,
    report: Callable[[float], None] | None = None,
) -> list[Trial]:
    """A trial at each of the places (N, 2), in their order; those off the map are left out."""
    return run_many([(plan, places_en_m)], workers, report)[0]


def run_many(
    work: Sequence[tuple[TrialPlan, NDArray[np.float64]]],
    workers: int,
    report: Callable[[float], None] | None = None,
) -> list[list[Trial]]:
    """Trials of several plans of one map, each as `run_trials` does; `report` is called with 0..1.

    The same whatever the number of `workers`, which are processes. Raises `WorkerError` where one
    of them ends on its own.
    """
    jobs = [
        (number, index, float(east), float(north))
        for number, (_, places) in enumerate(work)
        for index, (east, north) in enumerate(places)
    ]
    plans = [plan for plan, _ in work]
    found: list[list[Trial]] = [[] for _ in work]
    for done, (number, trial) in enumerate(_all(plans, jobs, workers)):
        if trial is not None:
            found[number].append(trial)
        if report is not None:
            report((done + 1) / len(jobs))
    return found


_Job = tuple[int, int, float, float]


def _all(
    plans: list[TrialPlan], jobs: list[_Job], workers: int
) -> Iterator[tuple[int, Trial | None]]:
    if workers <= 1 or len(jobs) < 4 * AT_ONCE:
        trier = Trier(plans)
        try:
            for job in jobs:
                yield trier(job)
        finally:
            trier.close()
        return
    # Started afresh: forking a process that has threads is not safe.
    context = get_context("spawn")
    workers = min(workers, -(-len(jobs) // AT_ONCE))
    ended = context.Event()
    with ProcessPoolExecutor(workers, context, _begin, (plans, ended)) as pool:
        try:
            yield from _handed_out(pool, jobs)
        except BrokenProcessPool as error:
            raise WorkerError(
                f"one of the {workers} processes that try views ended on its own, for want of "
                "memory perhaps: fewer of them (--workers) need less"
            ) from error
        finally:
            ended.set()  # what was handed out already is not waited for
            pool.shutdown(cancel_futures=True)


def _handed_out(pool: ProcessPoolExecutor, jobs: list[_Job]) -> Iterator[tuple[int, Trial | None]]:
    """Outcome of all jobs in their order. Workers inherit that Ctrl-C is held back meanwhile: it is
    for the process that began them."""
    if not hasattr(signal, "pthread_sigmask"):  # Windows
        return pool.map(_work, jobs, chunksize=AT_ONCE)
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        return pool.map(_work, jobs, chunksize=AT_ONCE)
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


_plans: list[TrialPlan] = []
_ended: Event | None = None
_trier: "Trier | None" = None


def _begin(plans: list[TrialPlan], ended: Event) -> None:
    """Of a worker: it ends with the process that began it, which alone answers to Ctrl-C."""
    global _ended
    _ended = ended
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with_parent, daemon=True).start()
    cv2.setNumThreads(1)
    _plans[:] = plans


def _end_with_parent() -> None:
    parent = parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


def _work(job: _Job) -> tuple[int, Trial | None]:
    global _trier
    if _ended is not None and _ended.is_set():
        return job[0], None
    if _trier is None:  # here, so that what goes wrong is told
        _trier = Trier(_plans)
    return _trier(job)


class Trier:
    """Makes and places views of plans that share a map."""

    def __init__(self, plans: Sequence[TrialPlan]) -> None:
        """Open the map; raises `MapFileError` where it has no registration layer."""
        registration = Localizer(open_map(plans[0].map_path)).registration
        if registration is None:
            raise MapFileError(
                f"only maps with a registration layer can be checked: {plans[0].map_path}"
            )
        self._registration = registration
        self._own = Pictures(registration.pyramid, registration)
        self._plans = plans
        self._others: dict[Path, tuple[OrthoPyramid, Pictures]] = {}

    def close(self) -> None:
        """Close the files of other dates."""
        for pyramid, _ in self._others.values():
            pyramid.close()
        self._others.clear()

    def __call__(self, job: _Job) -> tuple[int, Trial | None]:
        """The trial of a job: number of the plan, index, metres east and north."""
        number, index, east, north = job
        plan = self._plans[number]
        rng = np.random.default_rng([plan.seed, index])
        pictures = self._own if plan.other_path is None else self._other(plan.other_path)
        return number, self._trial(rng, plan, pictures, index, np.array([east, north]))

    def _other(self, path: Path) -> "Pictures":
        if path not in self._others:
            pyramid = self._registration.pyramid
            other = OrthoPyramid(path, self._registration.sheet, pyramid.levels)
            self._others[path] = other, Pictures(other, self._registration)
        return self._others[path][1]

    def _trial(
        self,
        rng: np.random.Generator,
        plan: TrialPlan,
        pictures: "Pictures",
        index: int,
        en_m: NDArray[np.float64],
    ) -> Trial | None:
        registration = self._registration
        # One finer than views are finished at: doubtful ones are looked at there too.
        final = view_levels(plan, registration).final
        level = max(final - 1, 0)
        gsd_m = registration.grid.gsd_m * 2**level
        size = math.ceil(math.hypot(plan.width_m, plan.height_m) / gsd_m) + 4
        made = pictures.around(en_m, size, level)
        if made is None:
            return None
        grey, valid, place = made
        stranger = self._own.stranger(rng, size, level)
        inner = np.s_[MARGIN_PX : MARGIN_PX + size, MARGIN_PX : MARGIN_PX + size]
        picture = np.where(valid[inner], grey[inner], stranger)
        expected = math.nan
        if plan.other_path is None:
            lasting = [each[inner] for each in reported_persistence(grey, gsd_m, final - level)]
            expected = float(np.mean([each.mean() for each in lasting[:2]]))
            picture = another_year(rng, picture, stranger, lasting, plan.severity)
        if plan.relief_m > 0:
            rim_px = plan.relief_m * size / 2 / plan.agl_m
            picture = tilted(rng, picture, rim_px, RELIEF_CHANGES_M / gsd_m)
        view = view_of(rng, plan, picture, gsd_m)
        return self._placed(rng, plan, index, place, view, expected)

    def _placed(
        self,
        rng: np.random.Generator,
        plan: TrialPlan,
        index: int,
        place_en_m: NDArray[np.float64],
        view: View,
        expected: float,
    ) -> Trial:
        registration = self._registration
        here = (float(place_en_m[0]), float(place_en_m[1]))
        nowhere = (math.nan, math.nan)
        prior = None
        if plan.prior_std_m is not None:
            told = place_en_m + rng.normal(0, plan.prior_std_m, 2)
            lat, lon = registration.sheet.frame.latlon_from_en(told)
            prior = Prior(float(lat), float(lon), plan.prior_std_m)
        seen = registration.register(view, prior, plan.yaw_std_deg is not None)
        if isinstance(seen, NoFix) or isinstance(seen.found, NoFix):
            return Trial(index, here, math.nan, 0.0, expected, nowhere, nowhere, math.nan)
        prepared, best = seen.prepared, seen.found
        confidence = registration.confidence
        sure = 0.0 if confidence is None else confidence(best.evidence())
        found = registration.camera_en_m(prepared, best.placed.pose)
        rivals = [
            (score, placed)
            for score, placed in best.finalists
            if apart_px(placed, best.placed) * registration.grid.gsd_m > plan.side_m / 4
        ]
        rival, share = nowhere, math.nan
        if rivals:
            score, placed = max(rivals, key=lambda each: each[0])
            east, north = registration.camera_en_m(prepared, placed.pose)
            rival, share = (float(east), float(north)), score / max(best.score, 1e-6)
        error = float(np.hypot(*(found - place_en_m)))
        at = (float(found[0]), float(found[1]))
        return Trial(index, here, error, sure, expected, at, rival, share)
