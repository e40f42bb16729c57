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
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from orthonav.check.change import USUAL, Severity, another_year, leaning
from orthonav.check.ortho import OrthoPyramid
from orthonav.check.persistence import MARGIN_PX, features, usual_model
from orthonav.errors import MapFileError, WorkerError
from orthonav.geo.camera import Camera
from orthonav.localizer import Localizer
from orthonav.localizer.registration import RegistrationLocalizer
from orthonav.mapfile import open_map
from orthonav.records import NoFix, Prior, Telemetry
from orthonav.register.reference import GreyPyramid
from orthonav.register.registrar import Levels, apart_px

EVERY_PX = 8
LEVELS_TOLD = 3
"""Persistence is told at every so many pixels, at so many levels."""
LEAST_VALID = 0.3
"""Views that see less of the map than this share are not tried: there nothing is found."""
AT_ONCE = 8
"""Trials that a worker is handed at a time."""
RELIEF_CHANGES_M = 15.0


@dataclass(frozen=True)
class TrialPlan:
    """How views are made: `camera` at `agl_m`, what is told wrongly (standard deviations), `seed`.

    `yaw_std_deg` None: heading unknown. `relief_m` is the standard deviation of the height of what
    stands on the ground and leans in views from low. `yaw_off_deg`, to either side at random, and
    `agl_off` (a share) are added to the errors of what is told.
    """

    map_path: Path
    camera: Camera
    agl_m: float
    yaw_std_deg: float | None = 5.0
    agl_std: float = 0.05
    prior_std_m: float | None = None
    accept: float = 0.9
    relief_m: float = 0.0
    seed: int = 1
    severity: Severity = USUAL
    other_path: Path | None = None
    yaw_off_deg: float = 0.0
    agl_off: float = 0.0

    @property
    def width_m(self) -> float:
        """Long and short side of what is seen, in metres."""
        return self.agl_m * self.camera.width_px / self.camera.fx_px

    @property
    def height_m(self) -> float:
        """The other side."""
        return self.agl_m * self.camera.height_px / self.camera.fy_px

    @property
    def side_m(self) -> float:
        """Root of the area that is seen."""
        return math.sqrt(self.width_m * self.height_m)


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
    with ProcessPoolExecutor(workers, context, _begin, (plans,)) as pool:
        try:
            yield from pool.map(_work, jobs, chunksize=AT_ONCE)
        except BrokenProcessPool as error:
            raise WorkerError(
                f"one of the {workers} processes that try views ended on its own, for want of "
                "memory perhaps: fewer of them (--workers) need less"
            ) from error
        finally:
            pool.shutdown(wait=False, cancel_futures=True)


_plans: list[TrialPlan] = []
_trier: "Trier | None" = None


def _begin(plans: list[TrialPlan]) -> None:
    """Of a worker: it ends with the process that began it, which alone answers to Ctrl-C."""
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
        self._own = Pictures(registration.registrar.reference.pyramid, registration)
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
            pyramid = self._registration.registrar.reference.pyramid
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
        level = max(view_levels(plan, registration).final - 1, 0)
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
            finer = level < view_levels(plan, registration).final
            lasting = [each[inner] for each in told_persistence(grey, gsd_m, int(finer))]
            expected = float(np.mean([each.mean() for each in lasting[:2]]))
            picture = another_year(rng, picture, stranger, lasting, plan.severity)
        if plan.relief_m > 0:
            rim_px = plan.relief_m * size / 2 / plan.agl_m
            picture = leaning(rng, picture, rim_px, RELIEF_CHANGES_M / gsd_m)
        view, camera, telemetry = _view(rng, plan, picture, gsd_m)
        return self._placed(rng, plan, index, place, view, camera, telemetry, expected)

    def _placed(
        self,
        rng: np.random.Generator,
        plan: TrialPlan,
        index: int,
        place_en_m: NDArray[np.float64],
        view: NDArray[np.uint8],
        camera: Camera,
        telemetry: Telemetry,
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
        prepared = registration.prepared(view, camera, telemetry, plan.yaw_std_deg is not None)
        best = None
        if not isinstance(prepared, NoFix) and (
            prior is None or registration.touches_map(prior, prepared)
        ):
            best = registration.best(prepared, prior)
        if best is None or isinstance(prepared, NoFix):
            return Trial(index, here, math.nan, 0.0, expected, nowhere, nowhere, math.nan)
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


def told_persistence(
    grey: NDArray[np.uint8], gsd_m: float, first: int = 0
) -> list[NDArray[np.float32]]:
    """Persistence (H, W) of a picture at its own resolution, half of it, and a quarter.

    That at resolutions finer than that of level `first` is taken to be the same as there.
    """
    model = usual_model()
    found: list[NDArray[np.float32]] = []
    picture = grey
    height, width = grey.shape
    for level in range(LEVELS_TOLD):
        if level >= first:
            told = model(features(picture, gsd_m * 2**level, max(EVERY_PX >> level, 1)))
            large = cv2.resize(told, (width, height), interpolation=cv2.INTER_LINEAR)
            found.append(np.asarray(large, np.float32))
        half = cv2.resize(picture, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
        picture = np.asarray(half, np.uint8)
        if min(picture.shape) < 2 * MARGIN_PX and found:
            break
    return [found[0]] * first + found


def view_levels(plan: TrialPlan, registration: RegistrationLocalizer) -> Levels:
    """The levels of the map that views are placed at."""
    levels = registration.registrar.reference.levels
    return Levels.of(plan.side_m / registration.grid.gsd_m, levels)


class Pictures:
    """The grey pictures of a map, in the plane of the map that is checked."""

    def __init__(self, layer: GreyPyramid, registration: RegistrationLocalizer) -> None:
        self._layer, self._grid = layer, registration.grid

    def around(
        self, en_m: NDArray[np.float64], size: int, level: int
    ) -> tuple[NDArray[np.uint8], NDArray[np.bool_], NDArray[np.float64]] | None:
        """Grey and valid around a place, `size` pixels of the level and the margin of persistence,
        and where its middle really is; None where too little of it is on the map."""
        unit_m = self._grid.gsd_m * 2**level
        whole = size + 2 * MARGIN_PX
        col = round((en_m[0] - self._grid.west_m) / unit_m - whole / 2)
        row = round((self._grid.north_m - en_m[1]) / unit_m - whole / 2)
        grey, valid = self._layer.read(level, row, col, whole, whole)
        inner = np.s_[MARGIN_PX : MARGIN_PX + size, MARGIN_PX : MARGIN_PX + size]
        if valid[inner].mean() < LEAST_VALID:
            return None
        if not valid.all():
            grey = np.where(valid, grey, np.uint8(grey[valid].mean()))
        east = self._grid.west_m + (col + whole / 2) * unit_m
        north = self._grid.north_m - (row + whole / 2) * unit_m
        return grey, valid, np.array([east, north])

    def stranger(self, rng: np.random.Generator, size: int, level: int) -> NDArray[np.uint8]:
        """Mirrored ground (size, size) from anywhere: it must not be found where it is from."""
        rows, cols = self._layer.shape(level)
        for _ in range(12):
            row = int(rng.integers(0, max(rows - size, 1)))
            col = int(rng.integers(0, max(cols - size, 1)))
            grey, valid = self._layer.read(level, row, col, size, size)
            if valid.all():
                break
        else:
            grey = np.where(valid, grey, np.uint8(128))
        return np.ascontiguousarray(grey[:, ::-1])


def _view(
    rng: np.random.Generator, plan: TrialPlan, picture: NDArray[np.uint8], gsd_m: float
) -> tuple[NDArray[np.uint8], Camera, Telemetry]:
    """A vertical view of the middle of a picture under any heading, and what is told of it."""
    size = picture.shape[0]
    width = max(8, round(plan.width_m / gsd_m))
    height = max(8, round(plan.height_m / gsd_m))
    yaw_deg = float(rng.uniform(0, 360))
    cos, sin = math.cos(math.radians(yaw_deg)), math.sin(math.radians(yaw_deg))
    linear = np.array([[cos, -sin], [sin, cos]])
    move = np.full(2, (size - 1) / 2) - linear @ [(width - 1) / 2, (height - 1) / 2]
    camera_gsd_m = plan.camera.gsd_m(plan.agl_m)
    if camera_gsd_m > gsd_m:
        picture = np.asarray(
            cv2.GaussianBlur(picture, (0, 0), 0.5 * camera_gsd_m / gsd_m), np.uint8
        )
    flags = cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP
    view = cv2.warpAffine(
        picture,
        np.column_stack([linear, move]),
        (width, height),
        flags=flags,
        borderMode=cv2.BORDER_REFLECT,
    )
    focal = plan.agl_m / gsd_m
    yaw_std = plan.yaw_std_deg
    sign = 1.0 if rng.random() < 0.5 else -1.0
    yaw_error = sign * plan.yaw_off_deg
    if yaw_std is not None:
        yaw_error += float(rng.normal(0, yaw_std))
    told_m = plan.agl_m * max(0.5, 1 + plan.agl_off + float(rng.normal(0, plan.agl_std)))
    telemetry = Telemetry(
        time_ns=0,
        yaw_deg=yaw_deg + yaw_error,
        pitch_deg=0.0,
        roll_deg=0.0,
        agl_m=told_m,
        yaw_std_deg=yaw_std,
        agl_std_m=plan.agl_std * told_m,
    )
    camera = Camera(width, height, focal, focal, width / 2, height / 2)
    return np.asarray(view, dtype=np.uint8), camera, telemetry
