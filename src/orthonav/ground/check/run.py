"""The check of a map: trials, predictions for all of it and along a route, verdict."""

import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from orthonav.core.cores import usable_cores
from orthonav.core.errors import AreaError, CameraError, MapFileError
from orthonav.core.files import Progress, StrPath, no_progress
from orthonav.core.localize.ground import SAMPLING
from orthonav.core.mapfile import open_map
from orthonav.core.mapfile.reader import MapFile
from orthonav.core.mapfile.terrain import SURFACE, TerrainLayer
from orthonav.core.records import MAP_STD_M
from orthonav.ground.check.cells import (
    CellGrid,
    MapCoverage,
    cell_side_m,
    checked_m2,
    trial_places,
)
from orthonav.ground.check.estimate import Prediction, Predictor
from orthonav.ground.check.findings import (
    Findings,
    likely_outages,
    predicted_along,
    verdict_of,
)
from orthonav.ground.check.flights import after_fix_m, scene_shifts, shifted, simulated
from orthonav.ground.check.records import (
    Along,
    Cells,
    CheckRequest,
    CheckResult,
    Conditions,
    Range,
)
from orthonav.ground.check.trials import (
    MIN_VALID,
    Trial,
    registration_of,
    require_other_date,
    run_trials,
)
from orthonav.ground.planning.area import Area
from orthonav.ground.planning.spacing import MIN_BAND_VIEWS, default_band_m

Array = NDArray[np.float64]


@dataclass(frozen=True)
class TrialNumbers:
    """How many trials are made. Figures at which the benchmark's maps need no more."""

    batch: int = 32  # trials of a batch: at least so many,
    batch_share: float = 0.34  # and this fraction of those before
    per_view: float = 0.2  # trials per area of a view that are made in any case,
    least: int = 96  # at least so many,
    most: int = 1500  # and at most
    fewest: int = 40  # at any effort
    min_found: int = 20  # on the map: fewer say nothing
    precise: float = 0.25
    """Enough trials: the standard error of the mean chance is this fraction of the deviation from
    scene to scene, and the last batch did not change the verdict."""


TRIALS = TrialNumbers()


def check_map(
    request: CheckRequest, progress: Progress = no_progress
) -> tuple[CheckResult, MapFile]:
    """Check a map; `progress` is called with the stage and the fraction done, 0 to 1.

    Raises `MapFileError` where the map cannot be checked, `AreaError` where the route or the other
    date lie outside the map or views are too large for it, `CameraError` for footprints that are
    too narrow, `WorkerError` where a worker process ended unexpectedly.
    """
    opened = open_map(request.map_path)
    return _Check(request, opened, progress).result(), opened


def check(map_path: StrPath, *, progress: Progress = no_progress, **asked: Any) -> CheckResult:
    """Predict where on a map views can be localized.

    `asked`: fields of `CheckRequest`, such as `route`, `agl_m`, `camera`, `prior_std_m`. It starts
    processes: call it below `if __name__ == "__main__":`, or with `workers=1`. Raises as
    `check_map`, and `CheckError` for values out of range.
    """
    return check_map(CheckRequest(Path(map_path), **asked), progress)[0]


class _Check:
    def __init__(self, request: CheckRequest, opened: MapFile, progress: Progress) -> None:
        self.request, self.opened, self.progress = request, opened, progress
        if len(opened.manifest.sheets) != 1:
            raise MapFileError(f"only maps of one sheet can be checked: {opened.path}")
        registration = registration_of(opened)
        self.sheet = registration.sheet
        self.coverage = MapCoverage.of(registration.pyramid, self.sheet.grid)
        surface = TerrainLayer.of(opened, layer=SURFACE)
        self.above_m = None if surface is None else self.coverage.of_each(surface.at_en_m)
        self.calibrated = registration.confidence is not None
        agl_m = request.agl_m or self.sheet.grid.tile_m / min(request.camera.extent)
        self.conditions = Conditions.of(request, agl_m, registration.radius_m)
        self._require_views()
        self.area = self._area()
        if request.other_date is not None:
            require_other_date(request.other_date, opened)
        self.extent = self.coverage.extent_en_m if self.area is None else self.area.extent_en_m
        self.checked_m2 = checked_m2(self.coverage, self.area)
        self.wanted = max(self._limited(0.0), 2 * TRIALS.batch)  # the verdict has to hold

    def _require_views(self) -> None:
        footprint = self.conditions.footprint_text
        short_m, long_m = sorted((self.conditions.width_m, self.conditions.height_m))
        if long_m > 8 * short_m:
            raise CameraError(
                f"a view may be at most 8 times as long as wide, but with this camera {footprint}; "
                "check the calibration"
            )
        if MIN_VALID * (short_m**2 + long_m**2) > self.coverage.area_m2:
            raise AreaError(
                f"views do not fit on the map: {footprint}; fly lower, or build a larger map"
            )

    def _area(self) -> Area | None:
        """The bands of the route, at least half a view wide."""
        request, side_m = self.request, self.conditions.side_m
        if request.route is None:
            return None
        band_m = request.band_m
        if band_m is None:
            band_m = default_band_m(side_m, request.prior_std_m)
        Area.from_route(request.route, band_m)  # which raises for a width of 0 or a route too long
        bands_m = tuple(
            max(each, MIN_BAND_VIEWS * side_m) for each in request.route.bands_m(band_m) or ()
        )
        line = request.route.points_en_m(self.sheet.frame)
        half = max(bands_m) / 2
        (west, south), (east, north) = line.min(axis=0) - half, line.max(axis=0) + half
        extent = (float(west), float(south), float(east), float(north))
        route = replace(request.route, leg_bands_m=bands_m)
        return Area(self.sheet.frame, extent, route, half * 2)

    def result(self) -> CheckResult:
        """What trials say, made until more of them would not change the answer."""
        request = self.request
        workers = request.workers or usable_cores()
        own: list[Trial] = []
        other: list[Trial] = []
        result, tried = None, 0
        trials = run_trials(request, self.conditions, self._batches(), workers, self._show)
        with closing(trials):
            for count, mine, others in trials:
                own, other, tried = [*own, *mine], [*other, *others], tried + count
                if len(own) < TRIALS.min_found:
                    continue
                before, predictor = result, self._predictor(own, other)
                result = self._judged(predictor, own, other)
                aim = TRIALS.precise * predictor.scenes_std / math.sqrt(request.effort)
                self.wanted = self._limited(tried * (predictor.mean_std / aim) ** 2)
                same = before is not None and before.verdict.word is result.verdict.word
                if same and tried >= self.wanted:
                    break
                self.wanted = max(self.wanted, tried + self._batch(tried))
        self.progress("trials", 1.0)
        if result is None:
            raise AreaError(
                f"only {len(own)} of {tried} trial views fit on the map: "
                f"{self.conditions.footprint_text}; fly lower, or build a larger map"
            )
        if request.other_date is not None and not other:
            raise AreaError(
                "the orthophoto of the other date does not cover the checked area: "
                f"{request.other_date}"
            )
        return result

    def _show(self, done: int) -> None:
        self.progress("trials", min(done / self.wanted, 0.99))

    def _limited(self, trials: float) -> int:
        """A number of trials within what area and effort ask for."""
        views = self.checked_m2 / self.conditions.side_m**2
        ends = (min(max(TRIALS.least, TRIALS.per_view * views), TRIALS.most), TRIALS.most)
        least, most = (max(each * self.request.effort, TRIALS.fewest) for each in ends)
        return round(min(max(trials, least), most))

    def _batch(self, done: int) -> int:
        """Number of trials of the next batch."""
        more = max(TRIALS.batch, round(TRIALS.batch_share * done))
        return min(more, self._limited(math.inf) - done)

    def _batches(self) -> Iterator[Array]:
        """Places of trials, every batch spread over all of the checked area."""
        rng = np.random.default_rng([self.request.seed, 4])
        done = 0
        while (count := self._batch(done)) > 0:
            yield trial_places(self.coverage, self.area, self.extent, self.checked_m2, count, rng)
            done += count

    def _judged(
        self, predictor: Predictor, own: Sequence[Trial], other: Sequence[Trial]
    ) -> CheckResult:
        request, conditions, frame = self.request, self.conditions, self.sheet.frame
        prior_m = conditions.prior_std_m
        cells, along = self._cells(predictor, own), self._along(predictor)
        shifts = scene_shifts(math.hypot(predictor.scenes_std, predictor.mean_std))
        wrong, flights, outside = int(predictor.wrong.sum()), None, 0.0
        known = np.isfinite(cells.probability)
        if along is not None:
            rng = np.random.default_rng([request.seed, 5])
            flights = simulated(along, conditions, shifts, wrong, rng)
            outside = float(np.mean(~self.coverage.covers(along.points_en_m)))
        chances = cells.probability[known] if known.any() else np.zeros(1)
        mean = Range.of(shifted(chances, shifts).mean(axis=1))
        objects, unknown = self._objects(cells.grid.centres_en_m[known.ravel()])
        findings = Findings(
            mean=flights.probability if flights else mean,
            flights=flights,
            conditions=conditions,
            calibrated=self.calibrated,
            wrong=wrong,
            trials=len(own) + len(other),
            outside=outside,
            after_fix_m=after_fix_m((cells if along is None else along).error_m, conditions.risk),
            view_px=conditions.side_m / self.sheet.grid.gsd_m,
            prior_px=math.inf if prior_m is None else prior_m / self.sheet.grid.gsd_m,
            second_date=bool(other),
            objects=objects,
            unknown=unknown,
        )
        return CheckResult(
            about=replace(request.about, map_sha256=self.opened.manifest.sha256),
            conditions=conditions,
            frame=frame,
            cells=cells,
            verdict=verdict_of(findings),
            area_km2=float(known.sum()) * cells.grid.side_m**2 / 1e6,
            mean=findings.mean,
            second_date=bool(other),
            along=along,
            flights=flights,
            route_en_m=None if request.route is None else request.route.points_en_m(frame),
            band_m=None if self.area is None else self.area.band_m,
            outages=likely_outages(along, flights, conditions) if along and flights else (),
        )

    def _predictor(self, own: Sequence[Trial], other: Sequence[Trial]) -> Predictor:
        request, side_m = self.request, self.conditions.side_m
        recalibration = request.recalibration.of_camera(request.camera_kind)
        recalibrated: Callable[[Array], Array] = np.asarray  # a second date needs no recalibration
        scenes_std = recalibration.std
        if request.other_date is None:
            view_px, has_prior = side_m / self.sheet.grid.gsd_m, request.prior_std_m is not None
            recalibrated = partial(recalibration, view_px=view_px, has_prior=has_prior)
            scenes_std = recalibration.std_of(view_px)
        return Predictor(
            own,
            view_side_m=side_m,
            spacing_m=math.sqrt(self.checked_m2 / max(len(own), 1)),
            other_date=other,
            least_error_m=math.sqrt(2) * MAP_STD_M,
            coverage=lambda points: self.coverage.seen_share(points, side_m),
            recalibrated=recalibrated,
            scenes_std=scenes_std,
        )

    def _predict(
        self, predictor: Predictor, points: Array, covered: NDArray[np.bool_]
    ) -> Prediction:
        """Predictions for places (N, 2): probability 0 and no error where the map is empty."""
        found = predictor.at(points)
        for values in (found.probability, found.low, found.high):
            values[~covered] = 0.0
        found.error_m[~covered] = np.nan
        return found

    def _cells(self, predictor: Predictor, own: Sequence[Trial]) -> Cells:
        west, south, east, north = self.extent
        around_m2 = (east - west) * (north - south)
        side_m = cell_side_m(around_m2, self.conditions.side_m)
        if self.area is not None:
            side_m = cell_side_m(self.checked_m2, self.conditions.side_m)
            side_m = max(side_m, math.sqrt(around_m2 / 250_000))  # most of them empty
        grid = CellGrid.over(self.extent, side_m)
        points = grid.centres_en_m
        here = covered = self.coverage.seen_share(points, side_m) > 0.25
        if self.area is not None:
            # A band that is narrower than a cell still crosses cells.
            bands_m = self.area.route.bands_m(None) if self.area.route else None
            narrowest_m = min(bands_m or (0.0,))
            here = self.area.contains(points, max(0.0, (side_m - narrowest_m) / 2))
        found = self._predict(predictor, points[here], covered[here])
        columns = {name: np.full((grid.rows, grid.cols), np.nan) for name in vars(found)}
        for name, values in vars(found).items():
            columns[name].ravel()[here] = values
        trials = grid.counts(np.array([each.en_m for each in own]))
        return Cells(grid=grid, trials=trials, **columns)

    def _objects(self, places: Array) -> tuple[float, float]:
        """Fractions of places (N, 2) whose view shows many houses and trees (over a tenth of it,
        higher than 2.5 m), and for which the map does not know."""
        if self.above_m is None or not len(places):
            return 0.0, 1.0
        side_m, pixels = self.conditions.side_m, self.coverage.pixels
        shown, known = (
            MapCoverage(pixels, each).seen_share(places, side_m)
            for each in (self.above_m > 2.5, np.isfinite(self.above_m))
        )
        unknown = known < SAMPLING.min_known * self.coverage.seen_share(places, side_m)
        return float(((shown >= 0.1) & ~unknown).mean()), float(unknown.mean())

    def _along(self, predictor: Predictor) -> Along | None:
        if self.area is None:
            return None
        covers = self.coverage.covers
        return predicted_along(
            self.area, self.conditions, lambda at: self._predict(predictor, at, covers(at))
        )
