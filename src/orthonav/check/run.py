"""The check of a map: where could views be placed, and would a route be flown well?"""

import math
import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from orthonav.check.envelope import (
    envelope_of,
    envelope_work,
    heights_of,
    heights_work,
    kept_share,
)
from orthonav.check.estimate import Estimate, Field
from orthonav.check.lookalikes import found_lookalikes
from orthonav.check.ortho import check_same_ground
from orthonav.check.outcome import (
    About,
    Along,
    Alternative,
    Cells,
    CheckResult,
    Conditions,
    Envelope,
)
from orthonav.check.places import Ground, Lattice, cell_side_m, checked_extent, trial_places
from orthonav.check.route import blind_stretches, predicted_along
from orthonav.check.trials import Trial, TrialPlan, run_many
from orthonav.check.verdict import Findings, verdict_of
from orthonav.errors import AreaError, CameraError, MapFileError
from orthonav.geo.area import Area
from orthonav.geo.camera import Camera
from orthonav.geo.route import Route
from orthonav.mapfile import open_map
from orthonav.mapfile.layer import GreyLayer
from orthonav.mapfile.reader import MapFile

Array = NDArray[np.float64]
DEFAULT_CAMERA = Camera(1280, 960, 1000.0, 1000.0, 640.0, 480.0)
"""A field of view of 65 by 51 degrees."""
DEFAULT_SPEED_MPS = 20.0
DEFAULT_DRIFT = 0.03
"""Dead reckoning without GNSS: metres of error per metre flown. With the wind known from before and
an airspeed sensor 2 to 5 % are usual."""
DEFAULT_PRIOR_STD_M = 150.0
DEFAULT_RELIEF_M = 3.0
BAND_PRIORS = 4.0
"""Where no band is told it is so many standard deviations of the prior wide."""
ENVELOPE_PLACES = 16
HEIGHT_PLACES = 30
BANDS = (0.25, 0.5)
LEAST_TRIALS = 20
NOTHING_SAID = About("", "", "")
Report = Callable[[str, float], None]


@dataclass(frozen=True)
class CheckRequest:
    """What to check: a map for views of `camera` from `agl_m` above ground.

    Without `agl_m` it is the height at which the shorter side of a view covers a tile of the map.
    `band_m` is for legs of `route` that do not say theirs. `other_date` is an orthophoto of the
    same ground that is not in the map. Standard deviations as in `orthonav.check.outcome`.
    `relief_m` is that of the height of houses and trees, which lean in pictures from low;
    `effort` multiplies the number of trials; `workers` None: one process per core.
    """

    map_path: Path
    route: Route | None = None
    band_m: float | None = None
    other_date: Path | None = None
    camera: Camera = DEFAULT_CAMERA
    agl_m: float | None = None
    yaw_std_deg: float | None = 5.0
    agl_std: float = 0.05
    prior_std_m: float | None = DEFAULT_PRIOR_STD_M
    accept: float = 0.9
    speed_mps: float = DEFAULT_SPEED_MPS
    drift: float = DEFAULT_DRIFT
    relief_m: float = DEFAULT_RELIEF_M
    effort: float = 1.0
    extras: bool = True
    workers: int | None = None
    seed: int = 1
    about: About = NOTHING_SAID

    def __post_init__(self) -> None:
        """Raises `CameraError` or `AreaError` on impossible numbers."""
        limits: dict[str, tuple[float | None, float, float, str]] = {
            "height above ground": (self.agl_m, 1.0, 50_000.0, "m"),
            "yaw_std_deg": (self.yaw_std_deg, 0.0, 90.0, "deg"),
            "agl_std": (self.agl_std, 0.0, 0.5, "(a share of the height: 0.05 is 5 %)"),
            "prior_std_m": (self.prior_std_m, 0.0, 1e6, "m"),
            "accept": (self.accept, 0.01, 0.999, ""),
            "speed_mps": (self.speed_mps, 0.1, 10_000.0, "m/s"),
            "drift": (self.drift, 0.0, 1.0, "(a share of the way: 0.03 is 3 %)"),
            "relief_m": (self.relief_m, 0.0, 1000.0, "m"),
            "effort": (self.effort, 0.05, 50.0, ""),
        }
        for name, (value, low, high, unit) in limits.items():
            if value is not None and not low <= value <= high:
                raise CameraError(f"{name} must be {low:g} to {high:g} {unit}, got {value}".strip())


def check_map(request: CheckRequest, report: Report | None = None) -> tuple[CheckResult, MapFile]:
    """Check a map; `report` is told what is done and how far, 0..1.

    Raises `MapFileError` where the map cannot be checked and `AreaError` where the route or the
    other date lie elsewhere.
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
        layer = GreyLayer.of(self.opened)
        if layer is None:
            raise MapFileError(
                f"only maps with a registration layer can be checked: {self.opened.path}"
            )
        self.sheet = self.opened.manifest.sheets[0]
        self.ground = Ground.of(layer, self.sheet.grid)
        plain = self.opened.manifest.registration or {}
        self.radius_m = float(plain.get("radius_m", 10 * self.sheet.grid.gsd_m))
        self.calibrated = plain.get("confidence") is not None
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
        return TrialPlan(
            request.map_path,
            camera,
            agl_m,
            request.yaw_std_deg,
            request.agl_std,
            request.prior_std_m,
            request.accept,
            request.relief_m,
            request.seed,
        )

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
        return 4 * self.plan.side_m if prior_m is None else max(BAND_PRIORS * prior_m, 1.0)

    def _area(self) -> Area | None:
        route = self.request.route
        if route is None:
            return None
        made = Area.from_route(route, self.band_m)
        # The same route in the plane of the map.
        line = route.points_en_m(self.sheet.frame)
        half = max(route.bands_m(self.band_m) or (0.0,)) / 2
        (west, south), (east, north) = line.min(axis=0) - half, line.max(axis=0) + half
        extent = (float(west), float(south), float(east), float(north))
        return Area(self.sheet.frame, extent, route, made.band_m)

    def result(self) -> CheckResult:
        """All of it."""
        rng = np.random.default_rng([self.request.seed, 4])
        side_m = self.plan.side_m
        places = trial_places(self.ground, self.area, self.extent, side_m, self.request.effort, rng)
        own, other, envelope, heights = self._trials(places, rng)
        spacing_m = math.sqrt(self._looked_at_m2() / max(len(own), 1))
        told = Field(
            own,
            radius_m=self.radius_m,
            accept=self.request.accept,
            view_side_m=side_m,
            spacing_m=spacing_m,
            other_date=other,
            least_error_m=self._floor_m(),
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
        planned = kept_share(own, self.request.accept, self.radius_m)
        alternatives = self._alternatives(heights, planned, told)
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
            band_m=self.band_m,
            stretches=stretches,
            lookalikes=lookalikes,
            envelope=envelope,
            alternatives=alternatives,
        )

    def _looked_at_m2(self) -> float:
        if self.area is None:
            return self.ground.area_m2
        west, south, east, north = self.extent
        probe = Lattice.over(self.extent, math.sqrt((east - west) * (north - south)) / 200)
        points = probe.centres_en_m
        here = self.area.contains(points) & self.ground.shown(points)
        return float(here.sum()) * probe.side_m**2

    def _floor_m(self) -> float:
        """Error of a fix that trials do not show: how well orthophotos of two dates agree."""
        plain = self.opened.manifest.registration or {}
        floor_px = float(plain.get("position_floor_px", 0.6))
        return floor_px * self.sheet.grid.gsd_m * math.sqrt(2)

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
                f"only {len(own)} of {len(places)} trial views fit on the map: a view from "
                f"{plan.agl_m:.0f} m sees {plan.width_m:.0f} x {plan.height_m:.0f} m; fly lower, "
                "or build a larger map"
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
            return max(1, self.request.workers)
        return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else 2

    def _told(self, told: Field, points: Array) -> Estimate:
        """Estimates at places; probability 0 where the map shows nothing."""
        found = told.at(points)
        off = ~self.ground.shown(points)
        for name in ("probability", "low", "high", "wrong"):
            getattr(found, name)[off] = 0.0
        found.error_m[off] = np.nan
        return found

    def _cells(self, told: Field, own: Sequence[Trial]) -> Cells:
        west, south, east, north = self.extent
        side_m = cell_side_m((east - west) * (north - south), self.plan.side_m)
        if self.area is not None:
            side_m = cell_side_m(self._looked_at_m2(), self.plan.side_m)
        lattice = Lattice.over(self.extent, side_m)
        points = lattice.centres_en_m
        shape = (lattice.rows, lattice.cols)
        here = self.ground.share_shown(lattice).ravel() > 0.25
        if self.area is not None:
            here = self.area.contains(points)
        found = self._told(told, points[here])
        tried = np.zeros(shape, np.int32)
        for each in own:
            col = int((each.en_m[0] - lattice.west_m) / side_m)
            row = int((lattice.north_m - each.en_m[1]) / side_m)
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
            found = self._told(told, points)
            return found.probability, found.error_m

        band_m = max(self.area.route.bands_m(self.band_m) or (0.0,)) if self.area.route else 0.0
        return predicted_along(self.area, band_m, self.plan.side_m, self.conditions, at)

    def _alternatives(
        self, heights: list[list[Trial]], planned: float, told: Field
    ) -> tuple[Alternative, ...]:
        made: tuple[Alternative, ...] = ()
        if heights:
            made = heights_of(self.plan, heights, planned, self.request.accept, self.radius_m)
        return made


def _with_other(plan: TrialPlan, other: Path) -> TrialPlan:
    return replace(plan, other_path=other, seed=plan.seed + 1)
