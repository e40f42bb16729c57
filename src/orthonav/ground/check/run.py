"""The check of a map: trials, predictions for all of it and along a route, verdict."""

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from orthonav.core.cores import usable_cores
from orthonav.core.errors import AreaError, CameraError, MapFileError
from orthonav.core.files import Progress, no_progress
from orthonav.core.mapfile import open_map
from orthonav.core.mapfile.reader import MapFile
from orthonav.core.records import MAP_STD_M
from orthonav.ground.changes.record import CellGrid
from orthonav.ground.check.estimate import Prediction, Predictor
from orthonav.ground.check.findings import (
    Findings,
    blind_stretches,
    envelope_of,
    envelope_work,
    found_lookalikes,
    heights_of,
    heights_work,
    predicted_along,
    verdict_of,
)
from orthonav.ground.check.outcome import (
    OF_REQUEST,
    Along,
    Alternative,
    Cells,
    CheckResult,
    Conditions,
    Envelope,
)
from orthonav.ground.check.places import MapCoverage, cell_side_m, checked_m2, trial_places
from orthonav.ground.check.request import CheckRequest
from orthonav.ground.check.trials import (
    MIN_VALID,
    Trial,
    TrialPlan,
    registration_of,
    require_overlap,
    run_many,
)
from orthonav.ground.planning.area import Area
from orthonav.ground.planning.route import distance_to_polyline_m
from orthonav.ground.planning.spacing import MIN_BAND_VIEWS, default_band_m

Array = NDArray[np.float64]
ENVELOPE_PLACES, HEIGHT_PLACES = 16, 30
"""Places of trials for the envelope (25 at each) and for other heights (4 at each)."""
BANDS = (0.25, 0.5)
MIN_VIEWS = 20
MAX_ASPECT = 8.0
MIN_COVERED = 0.25
MAX_CELLS_AROUND = 250_000
"""Limit of cells in the box around a band, most of them empty."""


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


def check(map_path: Path | str, *, progress: Progress = no_progress, **asked: Any) -> CheckResult:
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
        self.radius_m, self.floor_px = registration.radius_m, registration.floor_px
        self.calibrated = registration.confidence is not None
        self.workers = request.workers or usable_cores()
        self.plan = self._plan()
        self.conditions = Conditions(
            self.plan.width_m,
            self.plan.height_m,
            self.plan.agl_m,
            radius_m=self.radius_m,
            **{name: getattr(request, name) for name in OF_REQUEST},
        )
        self.bands_m = self._leg_bands_m()
        self.area = self._area()
        if request.other_date is not None:
            require_overlap(request.other_date, self.sheet)
        self.extent = self.coverage.extent_en_m if self.area is None else self.area.extent_en_m
        self.checked_m2 = checked_m2(self.coverage, self.area)

    def _plan(self) -> TrialPlan:
        request, agl_m = self.request, self.request.agl_m
        if agl_m is None:
            agl_m = self.sheet.grid.tile_m / min(request.camera.extent)
        plan = TrialPlan(request, agl_m)
        short_m, long_m = sorted((plan.width_m, plan.height_m))
        if long_m > MAX_ASPECT * short_m:
            raise CameraError(
                f"a view may be at most {MAX_ASPECT:g} times as long as wide, but with this camera "
                f"{plan.footprint_text}; check the calibration"
            )
        if MIN_VALID * (short_m**2 + long_m**2) > self.coverage.area_m2:
            raise AreaError(
                f"views do not fit on the map: {plan.footprint_text}; fly lower, or build a larger "
                "map"
            )
        return plan

    def _leg_bands_m(self) -> tuple[float, ...]:
        route, band_m = self.request.route, self.request.band_m
        if route is None:
            return ()
        if band_m is None:
            band_m = default_band_m(self.plan.side_m, self.request.prior_std_m)
        Area.from_route(route, band_m)
        return route.bands_m(band_m) or ()

    def _area(self) -> Area | None:
        route = self.request.route
        if route is None:
            return None
        line = route.points_en_m(self.sheet.frame)
        bands_m = tuple(max(each, MIN_BAND_VIEWS * self.plan.side_m) for each in self.bands_m)
        half = max(bands_m) / 2
        (west, south), (east, north) = line.min(axis=0) - half, line.max(axis=0) + half
        extent = (float(west), float(south), float(east), float(north))
        return Area(self.sheet.frame, extent, replace(route, leg_bands_m=bands_m), half * 2)

    def result(self) -> CheckResult:
        request, side_m = self.request, self.plan.side_m
        rng = np.random.default_rng([request.seed, 4])
        places = trial_places(
            self.coverage, self.area, self.extent, self.checked_m2, side_m, request.effort, rng
        )
        own, other = self._trials(places)
        envelope, heights = self._extra_trials(own, rng) if request.extras else (None, [])
        predictor = self._predictor(own, other)
        cells = self._cells(predictor, own)
        along = self._along(predictor)
        outside = 0.0
        if along is not None:
            outside = float(1 - self.coverage.covers(along.points_en_m).mean())
        known = np.isfinite(cells.probability)
        mean, low, changed = (
            float(each[known].mean()) if known.any() else 0.0
            for each in (cells.probability, cells.low, cells.changed)
        )
        stretches = () if along is None else blind_stretches(along, self.conditions, side_m)
        lookalikes = found_lookalikes(
            [*own, *other],
            self.sheet.frame,
            view_side_m=side_m,
            radius_m=self.radius_m,
            prior_std_m=request.prior_std_m,
        )
        findings = Findings(
            along,
            stretches,
            lookalikes,
            mean=mean if along is None else float(along.probability.mean()),
            low=low if along is None else float(along.low.mean()),
            calibrated=self.calibrated,
            wrong=int(predictor.wrong.sum()),
            trials=len(own) + len(other),
            outside=outside,
            changed=changed,
            allowed_m=request.prior_std_m,
            predicted_px=None if other else side_m / self.sheet.grid.gsd_m,
        )
        route = request.route
        return CheckResult(
            about=replace(request.about, map_sha256=self.opened.manifest.sha256),
            conditions=self.conditions,
            frame=self.sheet.frame,
            cells=cells,
            verdict=verdict_of(findings),
            area_km2=float(known.sum()) * cells.side_m**2 / 1e6,
            mean=mean,
            second_date=bool(other),
            along=along,
            route_en_m=None if route is None else route.points_en_m(self.sheet.frame),
            band_m=None if self.area is None else self.area.band_m,
            stretches=stretches,
            lookalikes=lookalikes,
            envelope=envelope,
            alternatives=self._alternatives(heights, own, cells),
        )

    def _predictor(self, own: Sequence[Trial], other: Sequence[Trial]) -> Predictor:
        request, side_m = self.request, self.plan.side_m
        lasting = self.coverage.without(request.changes, self.sheet.frame)
        recalibration = request.recalibration
        if request.other_sensor:
            recalibration = recalibration.other_sensor()
        recalibrated: Callable[[Array], Array] = np.asarray  # a second date needs no recalibration
        if request.other_date is None:
            view_px, has_prior = side_m / self.sheet.grid.gsd_m, request.prior_std_m is not None
            recalibrated = partial(recalibration, view_px=view_px, has_prior=has_prior)
        return Predictor(
            own,
            view_side_m=side_m,
            spacing_m=math.sqrt(self.checked_m2 / max(len(own), 1)),
            other_date=other,
            least_error_m=self._least_error_m,
            coverage=lambda points: lasting.seen_share(points, side_m),
            recalibrated=recalibrated,
            scenes_std=recalibration.std,
        )

    @property
    def _least_error_m(self) -> float:
        """Errors of a fix that trials do not show, root mean square: two orthophotos against each
        other, the displacement of the map as a whole, the unreported tilt at a height that may be
        off."""
        floor_m = self.floor_px * self.sheet.grid.gsd_m
        high_m = self.plan.agl_m * math.hypot(1.0, self.request.agl_std)
        tilt_m = high_m * math.tan(math.radians(self.request.tilt_std_deg))
        return math.sqrt(2) * math.hypot(floor_m, MAP_STD_M, tilt_m)

    def _trials(self, places: Array) -> tuple[list[Trial], list[Trial]]:
        other_date, plan = self.request.other_date, self.plan
        work = [(plan, places)]
        if other_date is not None:
            work.append((replace(plan, second_date=True), places))
        own, *others = run_many(work, self.workers, lambda share: self.progress("trials", share))
        if len(own) < MIN_VIEWS:
            raise AreaError(
                f"only {len(own)} of {len(places)} trial views fit on the map: "
                f"{plan.footprint_text}; fly lower, or build a larger map"
            )
        if others and not others[0]:
            raise AreaError(
                f"the orthophoto of the other date does not cover the checked area: {other_date}"
            )
        return own, others[0] if others else []

    def _extra_trials(
        self, own: Sequence[Trial], rng: np.random.Generator
    ) -> tuple[Envelope | None, list[list[Trial]]]:
        # Where views are not placed, errors of heading and height make no difference.
        placed = [each.en_m for each in own if each.right]
        order = rng.permutation(len(placed))[:ENVELOPE_PLACES]
        exact = np.array([placed[i] for i in order], np.float64).reshape(-1, 2)
        places = np.array([each.en_m for each in own])
        places = places[rng.permutation(len(places))[:HEIGHT_PLACES]]
        errors = envelope_work(self.plan, exact) if len(exact) >= ENVELOPE_PLACES // 2 else []
        found = run_many(
            [*errors, *heights_work(self.plan, places)],
            self.workers,
            lambda share: self.progress("envelope", share),
        )
        envelope = envelope_of(found[: len(errors)]) if errors else None
        return envelope, found[len(errors) :]

    def _predict(
        self, predictor: Predictor, points: Array, covered: NDArray[np.bool_]
    ) -> Prediction:
        """Predictions for places (N, 2): probability 0 and no error where the map is empty."""
        found = predictor.at(points)
        for values in (found.probability, found.low, found.high, found.wrong):
            values[~covered] = 0.0
        found.error_m[~covered] = np.nan
        return found

    def _cells(self, predictor: Predictor, own: Sequence[Trial]) -> Cells:
        west, south, east, north = self.extent
        around_m2 = (east - west) * (north - south)
        side_m = cell_side_m(around_m2, self.plan.side_m)
        if self.area is not None:
            side_m = cell_side_m(self.checked_m2, self.plan.side_m)
            side_m = max(side_m, math.sqrt(around_m2 / MAX_CELLS_AROUND))
        grid = CellGrid.over(self.extent, side_m)
        points = grid.centres_en_m
        here = covered = self.coverage.cell_share(grid).ravel() > MIN_COVERED
        if self.area is not None:
            # A band that is narrower than a cell still crosses cells.
            bands_m = self.area.route.bands_m(None) if self.area.route else None
            narrowest_m = min(bands_m or (0.0,))
            here = self.area.contains(points, max(0.0, (side_m - narrowest_m) / 2))
        found = self._predict(predictor, points[here], covered[here])
        columns = {name: np.full((grid.rows, grid.cols), np.nan) for name in vars(found)}
        for name, values in vars(found).items():
            columns[name].ravel()[here] = values
        columns["changed"] = self._changed(grid)
        trials = grid.counts(np.array([each.en_m for each in own]))
        return Cells(grid.west_m, grid.north_m, side_m, trials=trials, **columns)

    def _changed(self, grid: CellGrid) -> Array:
        """Fraction (rows, cols) of every cell that changed since the map was made."""
        if self.request.changes is None:
            return np.zeros((grid.rows, grid.cols))
        whole = self.coverage.cell_share(grid)
        lasting = self.coverage.without(self.request.changes, self.sheet.frame).cell_share(grid)
        return np.clip(1 - lasting / np.maximum(whole, 1e-6), 0.0, 1.0) * (whole > 0)

    def _along(self, predictor: Predictor) -> Along | None:
        if self.area is None:
            return None

        def predict(points: Array) -> Prediction:
            return self._predict(predictor, points, self.coverage.covers(points))

        side_m = self.plan.side_m
        return predicted_along(self.area, self.bands_m, side_m, self.conditions, predict)

    def _alternatives(
        self, heights: list[list[Trial]], own: Sequence[Trial], cells: Cells
    ) -> tuple[Alternative, ...]:
        found: tuple[Alternative, ...] = ()
        if heights:
            found = heights_of(self.plan, own, heights)
        route, widths = self.request.route, set(self.bands_m)
        if route is None or len(widths) != 1:
            return found
        line = route.points_en_m(self.sheet.frame)
        away_m = distance_to_polyline_m(cells.grid.centres_en_m, line)
        probability = cells.probability.ravel()
        bands = []
        for part in (*BANDS, 1.0):
            width_m = part * max(widths)
            inside = (away_m <= max(width_m, cells.side_m) / 2) & np.isfinite(probability)
            if inside.any() and width_m > cells.side_m:
                mean = float(probability[inside].mean())
                bands.append(Alternative("band_m", width_m, mean, chosen=part == 1.0))
        return found + tuple(bands) if len(bands) > 1 else found
