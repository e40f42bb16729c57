"""The check of a map: where could views be placed, and would a route be flown well?"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from orthonav.check.envelope import (
    accepted_share,
    envelope_of,
    envelope_work,
    heights_of,
    heights_work,
)
from orthonav.check.estimate import Estimate, Field
from orthonav.check.lookalikes import found_lookalikes
from orthonav.check.ortho import check_same_ground
from orthonav.check.outcome import (
    Along,
    Alternative,
    Cells,
    CheckResult,
    Conditions,
    Envelope,
)
from orthonav.check.places import (
    Ground,
    Lattice,
    cell_side_m,
    checked_extent,
    looked_at_m2,
    trial_places,
)
from orthonav.check.request import CheckRequest
from orthonav.check.route import blind_stretches, predicted_along
from orthonav.check.trials import Trial, run_many
from orthonav.check.verdict import Findings, verdict_of
from orthonav.check.views import LEAST_VALID, TrialPlan
from orthonav.cores import usable_cores
from orthonav.errors import AreaError, CameraError, MapFileError
from orthonav.geo.area import Area
from orthonav.geo.route import distance_to_polyline_m
from orthonav.localizer import Localizer
from orthonav.mapfile import open_map
from orthonav.mapfile.reader import MapFile

Array = NDArray[np.float64]
BAND_PRIORS = 4.0
"""Where no band is told it is so many standard deviations of the prior wide."""
ENVELOPE_PLACES = 16
HEIGHT_PLACES = 30
BANDS = (0.25, 0.5)
LEAST_TRIALS = 20
LEAST_BAND_VIEWS = 0.5
"""Bands are looked at so many sides of a view wide, at least."""
MOST_OBLONG = 8.0
"""A view is at most so many times as long as wide."""
LEAST_SHOWN = 0.25
"""Cells of which the map shows less than this share are beyond it."""
MOST_CELLS_AROUND = 250_000
"""Cells of the box around a band, most of them empty."""
Report = Callable[[str, float], None]


def check_map(request: CheckRequest, report: Report | None = None) -> tuple[CheckResult, MapFile]:
    """Check a map; `report` is told what is done and how far, 0..1.

    Raises `MapFileError` where the map cannot be checked, `AreaError` where the route or the other
    date lie elsewhere or views are too large for the map, `CameraError` where they are too oblong,
    `WorkerError` where a process ended on its own.
    """
    told = report or (lambda what, share: None)
    opened = open_map(request.map_path)
    return _Check(request, opened, told).result(), opened


@dataclass
class _Check:
    request: CheckRequest
    opened: MapFile
    report: Report
    ground: Ground = field(init=False)
    area: Area | None = field(init=False)

    def __post_init__(self) -> None:
        if len(self.opened.manifest.sheets) != 1:
            raise MapFileError(f"this program checks maps of one sheet: {self.opened.path}")
        registration = Localizer(self.opened).registration
        if registration is None:
            raise MapFileError(
                f"only maps with a registration layer can be checked: {self.opened.path}"
            )
        self.sheet = registration.sheet
        self.ground = Ground.of(registration.pyramid, self.sheet.grid)
        self.radius_m, self.floor_px = registration.radius_m, registration.floor_px
        self.calibrated = registration.confidence is not None
        self.plan = self._plan()
        self.conditions = self._conditions()
        self.area = self._area()
        if self.request.other_date is not None:
            check_same_ground(self.request.other_date, self.sheet)
        self.extent = checked_extent(self.ground, self.area)

    def _plan(self) -> TrialPlan:
        request, camera = self.request, self.request.camera
        agl_m = request.agl_m
        if agl_m is None:
            tile_m = self.sheet.grid.tile_m
            agl_m = tile_m / min(camera.width_px / camera.fx_px, camera.height_px / camera.fy_px)
        plan = TrialPlan(
            request.map_path,
            camera,
            agl_m,
            request.yaw_std_deg,
            request.agl_std,
            request.prior_std_m,
            request.relief_m,
            request.seed,
        )
        sides_m = sorted((plan.width_m, plan.height_m))
        if sides_m[1] > MOST_OBLONG * sides_m[0]:
            raise CameraError(
                f"views must be at most {MOST_OBLONG:g} times as long as wide, this camera's see "
                f"{plan.width_m:.4g} x {plan.height_m:.4g} m"
            )
        if LEAST_VALID * math.hypot(*sides_m) ** 2 > self.ground.area_m2:
            raise AreaError(f"views do not fit on the map: {_too_large(plan)}")
        return plan

    def _conditions(self) -> Conditions:
        request, plan = self.request, self.plan
        return Conditions(
            plan.width_m,
            plan.height_m,
            plan.agl_m,
            request.yaw_std_deg,
            request.agl_std,
            request.prior_std_m,
            request.accept,
            self.radius_m,
            request.speed_mps,
            request.drift,
        )

    @property
    def band_m(self) -> float | None:
        """Width of the band where legs do not say theirs."""
        if self.request.route is None or self.request.band_m is not None:
            return self.request.band_m
        prior_m = self.request.prior_std_m
        if prior_m is None:
            return BAND_PRIORS * self.plan.side_m
        return max(BAND_PRIORS * prior_m, LEAST_BAND_VIEWS * self.plan.side_m)

    def _area(self) -> Area | None:
        route = self.request.route
        if route is None:
            return None
        Area.from_route(route, self.band_m)  # raises what is wrong with it
        # The same route in the plane of the map.
        line = route.points_en_m(self.sheet.frame)
        least_m = LEAST_BAND_VIEWS * self.plan.side_m
        bands_m = tuple(max(each, least_m) for each in self._leg_bands_m)
        half = max(bands_m) / 2
        (west, south), (east, north) = line.min(axis=0) - half, line.max(axis=0) + half
        extent = (float(west), float(south), float(east), float(north))
        return Area(self.sheet.frame, extent, replace(route, leg_bands_m=bands_m), half * 2)

    @property
    def _leg_bands_m(self) -> tuple[float, ...]:
        """Width of the band of every leg of the route."""
        route = self.request.route
        return () if route is None else route.bands_m(self.band_m) or ()

    def result(self) -> CheckResult:
        """All of it."""
        rng = np.random.default_rng([self.request.seed, 4])
        side_m = self.plan.side_m
        places = trial_places(self.ground, self.area, self.extent, side_m, self.request.effort, rng)
        own, other, envelope, heights = self._trials(places, rng)
        spacing_m = math.sqrt(self._looked_at_m2 / max(len(own), 1))
        told = Field(
            own,
            radius_m=self.radius_m,
            accept=self.request.accept,
            view_side_m=side_m,
            spacing_m=spacing_m,
            other_date=other,
            least_error_m=self._floor_m(),
            seen=lambda points: self.ground.seen(points, side_m),
        )
        cells = self._cells(told, own)
        along = self._along(told)
        stretches = () if along is None else blind_stretches(along, self.conditions, side_m)
        lookalikes = found_lookalikes(
            [*own, *other],
            self.sheet.frame,
            view_side_m=side_m,
            radius_m=self.radius_m,
            prior_std_m=self.request.prior_std_m,
        )
        known = np.isfinite(cells.probability)
        everywhere = float(cells.probability[known].mean()) if known.any() else 0.0
        mean = everywhere if along is None else float(along.probability.mean())
        every = [*own, *other]
        outside = 0.0
        if along is not None:
            outside = float(1 - self.ground.shown(along.points_en_m).mean())
        findings = Findings(
            self.conditions,
            mean,
            self.calibrated,
            int(told.wrong.sum()),
            len(every),
            outside,
            along,
            stretches,
            lookalikes,
        )
        route_en_m = None
        if self.request.route is not None:
            route_en_m = self.request.route.points_en_m(self.sheet.frame)
        planned = accepted_share(own, self.request.accept, self.radius_m)
        alternatives = self._alternatives(heights, planned, cells)
        return CheckResult(
            about=self.request.about,
            conditions=self.conditions,
            frame=self.sheet.frame,
            cells=cells,
            verdict=verdict_of(findings),
            area_km2=float(known.sum()) * cells.side_m**2 / 1e6,
            mean=everywhere,
            second_date=bool(other),
            along=along,
            route_en_m=route_en_m,
            band_m=None if self.area is None else self.area.band_m,
            stretches=stretches,
            lookalikes=lookalikes,
            envelope=envelope,
            alternatives=alternatives,
        )

    @cached_property
    def _looked_at_m2(self) -> float:
        return looked_at_m2(self.ground, self.area)

    def _floor_m(self) -> float:
        """Error of a fix that trials do not show: how well orthophotos of two dates agree."""
        return self.floor_px * self.sheet.grid.gsd_m * math.sqrt(2)

    def _trials(
        self, places: Array, rng: np.random.Generator
    ) -> tuple[list[Trial], list[Trial], Envelope | None, list[list[Trial]]]:
        plan = self.plan
        work = [(plan, places)]
        if self.request.other_date is not None:
            work.append((_with_other(plan, self.request.other_date), places))
        first = run_many(work, self._workers, lambda share: self.report("trials", share))
        own = first[0]
        other = first[1] if self.request.other_date is not None else []
        if len(own) < LEAST_TRIALS:
            raise AreaError(
                f"only {len(own)} of {len(places)} trial views fit on the map: {_too_large(plan)}"
            )
        if self.request.other_date is not None and not other:
            raise AreaError(
                f"the other date shows no ground where the check looks: {self.request.other_date}"
            )
        if not self.request.extras:
            return own, other, None, []
        fine = self._found_places(own, rng)
        spread = np.array([each.en_m for each in own])
        spread = spread[rng.permutation(len(spread))[:HEIGHT_PLACES]]
        errors = envelope_work(plan, fine) if len(fine) >= ENVELOPE_PLACES // 2 else []
        more = run_many(
            [*errors, *heights_work(plan, spread)],
            self._workers,
            lambda share: self.report("envelope", share),
        )
        envelope = None
        if errors:
            envelope = envelope_of(more[: len(errors)], self.request.accept, self.radius_m)
        return own, other, envelope, more[len(errors) :]

    def _found_places(self, own: Sequence[Trial], rng: np.random.Generator) -> Array:
        """Places where views were placed well: elsewhere errors of heading change nothing."""
        good = [
            each.en_m
            for each in own
            if each.confidence >= self.request.accept and each.error_m <= self.radius_m
        ]
        order = rng.permutation(len(good))[:ENVELOPE_PLACES]
        return np.array([good[i] for i in order], np.float64).reshape(-1, 2)

    @property
    def _workers(self) -> int:
        if self.request.workers is not None:
            return self.request.workers
        return usable_cores()

    def _told(self, told: Field, points: Array, shown: NDArray[np.bool_]) -> Estimate:
        """Estimates at places; probability 0 where the map shows nothing."""
        found, off = told.at(points), ~shown
        for name in ("probability", "low", "high", "wrong"):
            getattr(found, name)[off] = 0.0
        found.error_m[off] = np.nan
        return found

    def _cells(self, told: Field, own: Sequence[Trial]) -> Cells:
        west, south, east, north = self.extent
        around_m2 = (east - west) * (north - south)
        side_m = cell_side_m(around_m2, self.plan.side_m)
        if self.area is not None:
            side_m = cell_side_m(self._looked_at_m2, self.plan.side_m)
            side_m = max(side_m, math.sqrt(around_m2 / MOST_CELLS_AROUND))
        lattice = Lattice.over(self.extent, side_m)
        points = lattice.centres_en_m
        shape = (lattice.rows, lattice.cols)
        here = shown = self.ground.share_shown(lattice).ravel() > LEAST_SHOWN
        if self.area is not None:
            # A band that is narrower than a cell still runs through cells.
            bands_m = self.area.route.bands_m(None) if self.area.route else None
            narrowest_m = min(bands_m or (0.0,))
            here = self.area.contains(points, max(0.0, (side_m - narrowest_m) / 2))
        found = self._told(told, points[here], shown[here])
        tried = np.zeros(shape, np.int32)
        for each in own:
            col = math.floor((each.en_m[0] - lattice.west_m) / side_m)
            row = math.floor((lattice.north_m - each.en_m[1]) / side_m)
            if 0 <= row < shape[0] and 0 <= col < shape[1]:
                tried[row, col] += 1

        def spread(values: Array) -> Array:
            whole = np.full(len(points), np.nan)
            whole[here] = values
            return whole.reshape(shape)

        return Cells(
            lattice.west_m,
            lattice.north_m,
            side_m,
            spread(found.probability),
            spread(found.low),
            spread(found.high),
            spread(found.error_m),
            spread(found.wrong),
            tried,
            spread(found.lasting),
        )

    def _along(self, told: Field) -> Along | None:
        if self.area is None:
            return None

        def at(points: Array) -> tuple[Array, Array]:
            found = self._told(told, points, self.ground.shown(points))
            return found.probability, found.error_m

        side_m = self.plan.side_m
        made = predicted_along(self.area, self._leg_bands_m, side_m, self.conditions, at)
        found = self._told(told, made.points_en_m, self.ground.shown(made.points_en_m))
        return replace(made, low=found.low, high=found.high)

    def _alternatives(
        self, heights: list[list[Trial]], planned: float, cells: Cells
    ) -> tuple[Alternative, ...]:
        made: tuple[Alternative, ...] = ()
        if heights:
            made = heights_of(self.plan, heights, planned, self.request.accept, self.radius_m)
        return made + self._bands(cells)

    def _bands(self, cells: Cells) -> tuple[Alternative, ...]:
        """What narrower bands would come to, where the whole route has one."""
        widths = set(self._leg_bands_m)
        if self.area is None or self.area.route is None or len(widths) != 1:
            return ()
        rows, cols = cells.probability.shape
        lattice = Lattice(cells.west_m, cells.north_m, cells.side_m, rows, cols)
        line = self.area.route.points_en_m(self.area.frame)
        away_m = distance_to_polyline_m(lattice.centres_en_m, line)
        told = cells.probability.ravel()
        found = []
        for width_m, part in ((part * max(widths), part) for part in (*BANDS, 1.0)):
            inside = (away_m <= max(width_m, cells.side_m) / 2) & np.isfinite(told)
            if inside.any() and width_m > cells.side_m:
                mean = float(told[inside].mean())
                found.append(Alternative("band_m", width_m, mean, chosen=part == 1.0))
        return tuple(found) if len(found) > 1 else ()


def _too_large(plan: TrialPlan) -> str:
    return (
        f"a view from {plan.agl_m:.0f} m sees {plan.width_m:.0f} x {plan.height_m:.0f} m; fly "
        "lower, or build a larger map"
    )


def _with_other(plan: TrialPlan, other: Path) -> TrialPlan:
    return replace(plan, other_path=other, seed=plan.seed + 1)
