"""The check of a map: trials, predictions for all of it and along a route, verdict."""

import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from orthonav.core.cores import usable_cores
from orthonav.core.errors import AreaError, CameraError, MapFileError
from orthonav.core.files import Progress, StrPath, no_progress
from orthonav.core.geo.grid import TileGrid
from orthonav.core.localize.ground import SAMPLING
from orthonav.core.mapfile import open_map
from orthonav.core.mapfile.reader import MapFile
from orthonav.core.mapfile.terrain import SURFACE, TerrainLayer
from orthonav.core.records import MAP_STD_M
from orthonav.core.register.window import GreyPyramid
from orthonav.ground.check.cells import CellGrid
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
    require_overlap,
    run_trials,
)
from orthonav.ground.planning.area import Area, Extent
from orthonav.ground.planning.spacing import MIN_BAND_VIEWS, default_band_m

Array = NDArray[np.float64]
MIN_VIEWS = 20
MAX_ASPECT = 8.0
MIN_COVERED = 0.25
MAX_CELLS_AROUND = 250_000
"""Limit of cells in the box around a band, most of them empty."""
# Limits of work and of what a page can show; the benchmark's maps need no more trials.
MAX_CELLS = 4000
CELLS_PER_VIEW = 4.0
"""Cells per side of a view, unless that gives too many."""
BATCH, BATCH_SHARE = 32, 0.34
"""Trials of a batch: at least so many, and this fraction of those before."""
MIN_TRIALS, MAX_TRIALS = 96, 1500
TRIALS_PER_VIEW = 0.2
"""Trials per area of a view that are made in any case."""
FEWEST_TRIALS = 40
PRECISE = 0.25
"""Enough trials: the standard error of the mean chance is this fraction of the deviation from scene
to scene, and the last batch did not change the verdict."""
MASK_PX = 2048
"""The coverage of the map is read at the finest level no larger than this."""
LOWEST_OBJECT_M, MANY_OBJECTS = 2.5, 0.1
"""A house or tree is higher; a view shows many where they are at least this fraction of it."""
_REDRAWS = 6
_MAX_POINTS = 500_000


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
            require_overlap(request.other_date, self.sheet)
        self.extent = self.coverage.extent_en_m if self.area is None else self.area.extent_en_m
        self.checked_m2 = checked_m2(self.coverage, self.area)
        self.wanted = max(self._limited(0.0), 2 * BATCH)  # the verdict has to hold

    def _require_views(self) -> None:
        footprint = self.conditions.footprint_text
        short_m, long_m = sorted((self.conditions.width_m, self.conditions.height_m))
        if long_m > MAX_ASPECT * short_m:
            raise CameraError(
                f"a view may be at most {MAX_ASPECT:g} times as long as wide, but with this camera "
                f"{footprint}; check the calibration"
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
                if len(own) < MIN_VIEWS:
                    continue
                before, predictor = result, self._predictor(own, other)
                result = self._judged(predictor, own, other)
                aim = PRECISE * predictor.scenes_std / math.sqrt(request.effort)
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
        least = max(MIN_TRIALS, TRIALS_PER_VIEW * self.checked_m2 / self.conditions.side_m**2)
        ends = (min(least, MAX_TRIALS), MAX_TRIALS)
        least, most = (max(each * self.request.effort, FEWEST_TRIALS) for each in ends)
        return round(min(max(trials, least), most))

    def _batch(self, done: int) -> int:
        """Number of trials of the next batch."""
        return min(max(BATCH, round(BATCH_SHARE * done)), self._limited(math.inf) - done)

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
            flights = simulated(along.distance_m, along, conditions, shifts, wrong, rng)
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
            area_km2=float(known.sum()) * cells.side_m**2 / 1e6,
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
            side_m = max(side_m, math.sqrt(around_m2 / MAX_CELLS_AROUND))
        grid = CellGrid.over(self.extent, side_m)
        points = grid.centres_en_m
        here = covered = self.coverage.seen_share(points, side_m) > MIN_COVERED
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
        return Cells(
            west_m=grid.west_m, north_m=grid.north_m, side_m=side_m, trials=trials, **columns
        )

    def _objects(self, places: Array) -> tuple[float, float]:
        """Fractions of places (N, 2) whose view shows many houses and trees, and for which the map
        does not know."""
        if self.above_m is None or not len(places):
            return 0.0, 1.0
        side_m, pixels = self.conditions.side_m, self.coverage.pixels
        shown, known = (
            MapCoverage(pixels, each).seen_share(places, side_m)
            for each in (self.above_m > LOWEST_OBJECT_M, np.isfinite(self.above_m))
        )
        unknown = known < SAMPLING.min_known * self.coverage.seen_share(places, side_m)
        return float(((shown >= MANY_OBJECTS) & ~unknown).mean()), float(unknown.mean())

    def _along(self, predictor: Predictor) -> Along | None:
        if self.area is None:
            return None
        covers = self.coverage.covers
        return predicted_along(
            self.area, self.conditions, lambda at: self._predict(predictor, at, covers(at))
        )


@dataclass(frozen=True, eq=False)
class MapCoverage:
    """Where a map has imagery: `valid` (rows, cols) of the pixels of a raster."""

    pixels: CellGrid
    valid: NDArray[np.bool_]

    @classmethod
    def of(cls, layer: GreyPyramid, grid: TileGrid) -> "MapCoverage":
        level = 0
        while level < layer.levels - 1 and max(layer.shape(level)) > MASK_PX:
            level += 1
        rows, cols = layer.shape(level)
        _, valid = layer.read(level, 0, 0, rows, cols)
        return cls(CellGrid(grid.west_m, grid.north_m, grid.gsd_m * 2**level, rows, cols), valid)

    def of_each(self, at_en_m: Callable[[Array], Array]) -> Array:
        """Values (rows, cols) at the pixels, a row at a time."""
        rows = self.pixels.centres_en_m.reshape(*self.valid.shape, 2)
        return np.stack([at_en_m(row) for row in rows])

    def covers(self, points_en_m: Array) -> NDArray[np.bool_]:
        numbers = self.pixels.numbers(points_en_m)
        return np.asarray((numbers >= 0) & self.valid.ravel()[numbers])

    def seen_share(self, points_en_m: Array, side_m: float) -> Array:
        """Fraction (N,) of squares of a side around points (N, 2) that the map covers."""
        side = max(1, round(side_m / self.pixels.side_m))
        padded = np.pad(self.valid.astype(np.float32), side)
        share = cv2.blur(padded, (side, side), borderType=cv2.BORDER_CONSTANT)
        numbers = self.pixels.numbers(points_en_m, side)
        return np.where(numbers >= 0, np.asarray(share, np.float64).ravel()[numbers], 0.0)

    @property
    def extent_en_m(self) -> Extent:
        rows, cols = np.flatnonzero(self.valid.any(axis=1)), np.flatnonzero(self.valid.any(axis=0))
        if not len(rows):
            raise AreaError("the map has no imagery; build it again from an orthophoto with data")
        return (
            self.pixels.west_m + cols[0] * self.pixels.side_m,
            self.pixels.north_m - (rows[-1] + 1) * self.pixels.side_m,
            self.pixels.west_m + (cols[-1] + 1) * self.pixels.side_m,
            self.pixels.north_m - rows[0] * self.pixels.side_m,
        )

    @property
    def area_m2(self) -> float:
        return float(self.valid.sum()) * self.pixels.side_m**2


def checked_m2(coverage: MapCoverage, area: Area | None) -> float:
    """Area of the map's imagery within `area`, the band of a route; all of it without one.

    Raises `AreaError` where the band does not touch the imagery.
    """
    if area is None:
        return coverage.area_m2
    west, south, east, north = area.extent_en_m
    side_m = math.sqrt((east - west) * (north - south) / _MAX_POINTS)
    points = CellGrid.over(area.extent_en_m, side_m).centres_en_m
    count = np.count_nonzero(area.contains(points) & coverage.covers(points))
    if not count:
        left, below, right, above = coverage.extent_en_m
        far_m = math.hypot(max(west - right, left - east, 0), max(south - above, below - north, 0))
        raise AreaError(
            f"the band of the route does not touch the map, {far_m / 1000:,.1f} km from it; give "
            "the map of this route, and check that latitude and longitude are not swapped"
        )
    return float(count) * side_m**2


def cell_side_m(area_m2: float, view_side_m: float) -> float:
    return max(view_side_m / CELLS_PER_VIEW, math.sqrt(area_m2 / MAX_CELLS))


def trial_places(
    coverage: MapCoverage,
    area: Area | None,
    extent: Extent,
    wanted_m2: float,
    count: int,
    rng: np.random.Generator,
) -> Array:
    """Some `count` places (N, 2), spread evenly at random over `wanted_m2` of checked imagery."""
    side_m = math.sqrt(wanted_m2 / count)
    all_m2 = (extent[2] - extent[0]) * (extent[3] - extent[1])
    cells = CellGrid.over(extent, max(side_m, math.sqrt(all_m2 / _MAX_POINTS)))

    def usable(points: Array) -> NDArray[np.bool_]:
        covered = coverage.covers(points)
        return covered if area is None else covered & area.contains(points)

    points = cells.drawn(rng)
    good = usable(points)
    for _ in range(_REDRAWS):  # another point of a cell on the border may be usable
        again = cells.drawn(rng)
        better = ~good & usable(again)
        points[better] = again[better]
        good |= better
    found = points[good]
    if len(found) > count:  # of a band that is narrower than a cell
        found = found[np.linspace(0, len(found) - 1, count).round().astype(int)]
    return found
