"""Placing a view by registration on the map's imagery: collect candidates, refine, judge the best.

`plan` decides which searches to run, this module runs them until one place stands out from chance
and from its rivals. `register` is the one way from a view to its best place; `locate` makes a fix
of it, `tracker`, `orthonav.atlas` and `orthonav.check` use the place itself.
"""

import functools
import math
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from itertools import takewhile
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from orthonav.confidence.registered import USUAL_CHANCES, Chances, RegisteredConfidence
from orthonav.errors import MapFileError, VariantError
from orthonav.localizer.over_relief import GroundSeen, ViewOnLevelGround, ViewOverRelief
from orthonav.localizer.plan import DEFAULT_PLAN, Budget, ClearMargin, Search, SearchPlan
from orthonav.localizer.prepared import PreparedView, prepare
from orthonav.localizer.propose import TileProposer
from orthonav.localizer.rectify import looks_aside, off_nadir_deg
from orthonav.localizer.relief import LevelTerrain, Relief
from orthonav.localizer.relief_camera import CameraFound
from orthonav.mapfile.layer import GreyLayer
from orthonav.mapfile.manifest import SheetInfo
from orthonav.mapfile.reader import MapFile
from orthonav.mapfile.terrain import TerrainLayer
from orthonav.records import PRIOR_SIGMAS, Fix, NoFix, Prior, Telemetry, View
from orthonav.register.pose import Pose, rotation
from orthonav.register.reference import GreyPyramid, Reference
from orthonav.register.refine import Placed
from orthonav.register.registrar import Registered, Registrar
from orthonav.register.search import Candidate, search
from orthonav.search.exact import rows_within


@dataclass(frozen=True, eq=False)
class RegisteredView:
    """A prepared view and its best place; `found` is a `NoFix` where it could not be compared.

    `ground`: what it saw, where the map has a terrain or the view looks aside. `camera`: makes the
    camera with its pitch and roll, None where these are not examined.
    """

    prepared: PreparedView
    found: Registered | NoFix
    ground: GroundSeen | None = None
    camera: Callable[[], CameraFound | None] = lambda: None


class RegistrationLocalizer:
    """Places views on one sheet by registration. Safe to share between threads."""

    def __init__(
        self,
        sheet: SheetInfo,
        layer: GreyPyramid,
        *,
        confidence: RegisteredConfidence | None,
        radius_m: float,
        floor_px: float,
        propose: TileProposer | None = None,
        plan: SearchPlan = DEFAULT_PLAN,
        terrain: TerrainLayer | None = None,
    ) -> None:
        """Take a sheet and its imagery; `of_map` does so for a map.

        `confidence`: None before it is learnt. `radius_m`: the error that it is about. `floor_px`:
        standard deviation with which maps of two dates agree, in pixels of level 0. Without
        `propose`, candidates come from searches by FFT only; without `terrain` the ground is level.
        """
        self.sheet, self.grid = sheet, sheet.grid
        self._pool = ThreadPoolExecutor(plan.threads) if plan.threads > 1 else None
        self.registrar = Registrar(Reference(layer), self._pool)
        self.confidence, self.radius_m = confidence, radius_m
        self.propose, self.plan = propose, plan
        self.floor_px = floor_px
        self.relief = None if terrain is None else Relief(terrain, self.grid)

    @classmethod
    def of_map(
        cls,
        opened: MapFile,
        propose: TileProposer | None,
        plan: SearchPlan = DEFAULT_PLAN,
        *,
        level_ground: bool = True,
    ) -> "RegistrationLocalizer | None":
        """A localizer for the only sheet of a map; None where the map has no registration layer.

        Unless `level_ground`, views are placed on the map's terrain, where it has one.

        Raises `MapFileError` where the manifest's registration is damaged.
        """
        layer = GreyLayer.of(opened)
        if layer is None:
            return None
        plain = opened.manifest.registration or {}
        try:
            fitted = plain.get("confidence")
            confidence = None if fitted is None else RegisteredConfidence.from_plain(fitted)
            radius_m, floor_px = float(plain["radius_m"]), float(plain["position_floor_px"])
        except (VariantError, KeyError, TypeError, ValueError) as error:
            raise MapFileError(f"map cannot be flown ({error}): {opened.path}") from error
        if not (0 < radius_m < math.inf and 0 <= floor_px < math.inf):
            raise MapFileError(f"map has impossible registration parameters: {opened.path}")
        return cls(
            opened.manifest.sheets[0],
            layer,
            confidence=confidence,
            radius_m=radius_m,
            floor_px=floor_px,
            propose=propose,
            plan=plan,
            terrain=None if level_ground else TerrainLayer.of(opened),
        )

    @property
    def pyramid(self) -> GreyPyramid:
        """The grey levels of the sheet at all its resolutions."""
        return self.registrar.reference.pyramid

    def locate(self, view: View, prior: Prior | None, heading_known: bool) -> Fix | NoFix:
        """The position from which a view was taken; `check_view` has accepted the view."""
        seen = self.register(view, prior, heading_known)
        if isinstance(seen, NoFix):
            return seen
        if isinstance(seen.found, NoFix):
            return seen.found
        return self._fix(seen.prepared, seen.found, view.telemetry, seen)

    def register(
        self,
        view: View,
        prior: Prior | None = None,
        heading_known: bool = True,
        *,
        heading_std_rad: float | None = None,
    ) -> RegisteredView | NoFix:
        """The view and its best place within `prior`; `NoFix` where it shows too little.

        `heading_std_rad`: standard deviation of the heading in place of the reported one, which
        has limits.
        """
        prepared = self.prepared(view, heading_known)
        if isinstance(prepared, NoFix):
            return prepared
        if heading_std_rad is not None:
            pose_prior = replace(prepared.prior, turn_std_rad=heading_std_rad)
            prepared = replace(prepared, prior=pose_prior)
        if self.relief is not None:
            prepared = replace(prepared, prior=self.relief.expected(prepared))
        if prior is not None and not self._touches_map(prior, prepared):
            outside = NoFix("outside_map", "the map does not reach to where the prior says")
            return RegisteredView(prepared, outside)
        ground = self.on_ground(prepared)
        found = self.best(prepared, prior, ground)
        if found is None:
            detail = "no place of the map could be compared with the view"
            if prior is None:
                detail += "; a large map needs a prior, or views as large as its tiles"
            return RegisteredView(prepared, NoFix("no_match", detail))
        resect = functools.partial(ground.resected, found.placed)
        return RegisteredView(prepared, *ground.by_camera(found), resect)

    def prepared(self, view: View, heading_known: bool) -> PreparedView | NoFix:
        """The view rectified and made ready for registration; `NoFix` where it shows too little."""
        return prepare(view, self.grid.gsd_m, self.pyramid.levels, heading_known)

    def best(
        self, view: PreparedView, prior: Prior | None, ground: ViewOnLevelGround | None = None
    ) -> Registered | None:
        """The best place after all searches that had to be run; None where nothing was found.

        `ground`: the view on the ground of the map; None: made here.
        """
        ground = ground or self.on_ground(view)
        budget = Budget(self.plan.budget_ms)
        judged: list[Placed] = []
        direct: list[Placed] = []
        best: Registered | None = None
        candidates = 0
        enough = self.plan.clear

        def finished(judged: list[Placed], finer: int = 0) -> Registered:
            made = view.templates, view.levels, judged, view.prior, candidates, ground.finish
            if not finer:
                return self.registrar.finished(*made, direct)
            return self.registrar.finished(*made, direct, ground.finer, finer)

        rows = functools.cache(lambda: self._rows_near(view, prior))
        searches = self.plan.searches(
            view.levels,
            view.prior,
            lambda level, poses: self._fft_ms(view, prior, level, poses),
            lambda: self._tiles(view, rows()),
        )
        for each in takewhile(lambda each: budget.allows(each.cost_ms), searches):
            if early := self._found_early(view, ground, judged, each.cost_ms, enough, finished):
                return early
            if each.from_tiles and self.propose is not None:
                found = self._from_tiles(view, prior, each, rows(), self.propose)
            else:
                found = self._searched(view, prior, each)
            if each.level < view.levels.look:
                direct = self.registrar.direct(view.templates, view.levels, found)
            else:
                judged += self.registrar.judged(
                    view.templates, view.levels, found, each.level, view.prior, judged
                )
            candidates += len(found)
            best = None
            enough = self.plan.enough(each, view.levels)
            if judged and self._seems_clear(view, judged, enough):
                best = finished(judged)
                # Candidates from tiles are not all places: their rivals alone prove too little.
                proven = not each.from_tiles or self._is_proven(best)
                if proven and self._is_clear(best, enough):
                    return best
        return self._concluded(view, ground, judged, best, budget, finished) if judged else None

    def _concluded(
        self,
        view: PreparedView,
        ground: ViewOnLevelGround,
        judged: list[Placed],
        best: Registered | None,
        budget: Budget,
        finished: Callable[..., Registered],
    ) -> Registered:
        """The best place after all searches, none of which ended with one that stands out.

        `best`: what is known of it; None: not finished yet.
        """
        if best is None or self.relief is not None:
            if budget.allows(0.0):
                judged = ground.placed_on_terrain(judged, self.plan.terrain_candidates)
            best = finished(judged)
        for kept, cost_ms in self.plan.finer if view.levels.final > 0 else ():
            if self._is_proven(best) or not budget.allows(cost_ms):
                break
            best = finished(judged, kept)
        return replace(best, cut_short=budget.cut_short)

    def _found_early(
        self,
        view: PreparedView,
        ground: ViewOnLevelGround,
        judged: list[Placed],
        cost_ms: float,
        enough: ClearMargin,
        finished: Callable[..., Registered],
    ) -> Registered | None:
        """The best place so far, if it stands out on the terrain and no search could change that.

        `cost_ms`: that of the next search. None where trials on the terrain cost more, on level
        ground, where the place would have ended the search before, and with a budget of time,
        which does not know the cost of this.
        """
        cheap = cost_ms <= self.plan.terrain_trials * self.plan.terrain_trial_ms
        if cheap or ground.is_level or not judged or math.isfinite(self.plan.budget_ms):
            return None
        on_terrain = ground.placed_on_terrain(judged, self.plan.terrain_trials)
        best, rival = self.registrar.standing(view.templates, on_terrain, view.prior)
        if best <= max(enough.look_ratio * rival, self._chances.look):
            return None
        found = finished(on_terrain)
        return found if self._is_clear(found, enough) and self._is_proven(found) else None

    def on_ground(self, view: PreparedView) -> ViewOnLevelGround:
        """A view on the terrain of the map, where it has one."""
        if self.relief is not None:
            return ViewOverRelief(self.relief, self.registrar, view)
        if looks_aside(view.picture_at(view.levels.final)):
            level = Relief(LevelTerrain(), self.grid)
            return ViewOverRelief(level, self.registrar, view)
        return ViewOnLevelGround(self.registrar, view)

    def _seems_clear(self, view: PreparedView, judged: list[Placed], enough: ClearMargin) -> bool:
        """Whether the best candidate may end the search, before the cost of finishing it."""
        best, rival = self.registrar.standing(view.templates, judged, view.prior)
        return best > enough.strength * self._chances.look and best > enough.look_ratio * rival

    def _is_clear(self, best: Registered, enough: ClearMargin) -> bool:
        """Whether a finished place ends the search."""
        if best.score <= enough.strength * self._chances.total:
            return False
        return best.look_ratio > enough.look_ratio and best.peak_ratio > enough.peak_ratio

    def _is_proven(self, best: Registered) -> bool:
        """Whether a place is so confident that no further search could change the verdict."""
        if self.confidence is None:
            return False
        return self.confidence(best.evidence()) > 1 - self.plan.doubt

    @property
    def _chances(self) -> Chances:
        return self.confidence.chances if self.confidence else USUAL_CHANCES

    def _rows_near(self, view: PreparedView, prior: Prior | None) -> NDArray[np.intp] | None:
        """Rows of the tiles that the prior allows, None for all."""
        if prior is None or self.propose is None:
            return None
        x, y = self._prior_px(prior, view)
        grid = self.grid
        centre = np.array([grid.west_m + x * grid.gsd_m, grid.north_m - y * grid.gsd_m])
        reach_m = self._reach_px(view, prior) * grid.gsd_m + grid.stride_m
        return rows_within(self.propose.centres_en_m, centre, reach_m)

    def _tiles(self, view: PreparedView, rows: NDArray[np.intp] | None) -> tuple[int, int]:
        """Number of tiles that can be compared with a view, and of numbers in their embeddings."""
        if self.propose is None or not self.propose.fits(view.side_px, self.plan.view_tiles):
            return 0, 0
        count = len(self.propose.centres_en_m) if rows is None else len(rows)
        return count, self.propose.embedder.dims

    def _fft_ms(self, view: PreparedView, prior: Prior | None, level: int, poses: int) -> float:
        """Estimated cost of an FFT search at a level, of the sheet or of what the prior allows."""
        rows, cols = self.registrar.reference.shape(level)
        if prior is not None:
            across = 2 * self._reach_px(view, prior) / 2**level
            rows, cols = round(min(rows, across)), round(min(cols, across))
        side = view.side_px / 2**level
        if prior is not None or min(rows, cols) < 3 * side:
            rows, cols = round(rows + side), round(cols + side)
        return self.plan.fft_ms(poses, rows, cols)

    def _from_tiles(
        self,
        view: PreparedView,
        prior: Prior | None,
        run: Search,
        rows: NDArray[np.intp] | None,
        propose: TileProposer,
    ) -> list[Candidate]:
        """Candidates from the most similar tiles, each at its best place near by, best first."""
        plan, stride_px = self.plan, self.grid.stride_m / self.grid.gsd_m
        found = propose.candidates(
            view.rectified_at(0), run.poses, rows, run.candidates, plan.tile_apart_strides
        )
        reach_px = plan.tile_reach_strides * stride_px
        found = self.registrar.nearby(view.templates, view.levels, found, reach_px)
        if prior is None:
            return found
        x, y = self._prior_px(prior, view)
        most_px = self._reach_px(view, prior)
        return [
            each
            for each in found
            if max(abs(each.pose.x_px - x), abs(each.pose.y_px - y)) <= most_px
        ]

    def _searched(self, view: PreparedView, prior: Prior | None, run: Search) -> list[Candidate]:
        """Candidates of one FFT search, best first."""
        recipe = view.levels.recipe(run.level)
        if prior is None:
            window = self.registrar.whole_window(run.level, recipe, view.side_px)
        else:
            window = self.registrar.part_window(
                run.level,
                recipe,
                view.side_px,
                self._prior_px(prior, view),
                self._reach_px(view, prior),
            )
        template = view.templates.at(run.level, recipe)
        scales = view.prior.scale_map
        # Every thread has memory for a whole window.
        fits = math.prod(window.size) * self.plan.threads <= self.plan.max_search_px
        pool = self._pool if fits else None
        found = search(template, window, run.poses, run.candidates, scales, pool)
        least = self.plan.candidate_share
        worth = sum(each.score >= least * found[0].score for each in found)
        return found[: max(worth, self.plan.min_candidates)]

    def _prior_px(self, prior: Prior, view: PreparedView) -> tuple[float, float]:
        """The middle of the view as the prior expects it, x and y at level 0."""
        east, north = self.sheet.frame.en_from_latlon(prior.lat_deg, prior.lon_deg)
        x = (float(east) - self.grid.west_m) / self.grid.gsd_m
        y = (self.grid.north_m - float(north)) / self.grid.gsd_m
        if view.prior.turn_rad is None:
            return x, y
        moved = rotation(view.prior.turn_rad) @ view.camera_px
        return x - float(moved[0]), y - float(moved[1])

    def _reach_px(self, view: PreparedView, prior: Prior) -> float:
        """How far from there the middle of the view may lie, in pixels of level 0."""
        tilt = float(np.hypot(*view.camera_px))
        turn = 2.0 if view.prior.turn_rad is None else 2 * view.prior.turn_std_rad
        reach = PRIOR_SIGMAS * max(prior.std_m, 0.0) / self.grid.gsd_m
        return float(reach + tilt * min(turn, 1.0) + 2.0 * 2**view.levels.coarse)

    def _touches_map(self, prior: Prior, view: PreparedView) -> bool:
        """Whether any of the map lies where the prior allows the view to be."""
        x, y = self._prior_px(prior, view)
        reach = self._reach_px(view, prior)
        rows, cols = self.registrar.reference.shape(0)
        return -reach < x < cols + reach and -reach < y < rows + reach

    def _fix(
        self,
        view: PreparedView,
        best: Registered,
        telemetry: Telemetry,
        seen: RegisteredView,
    ) -> Fix:
        placed, camera = best.placed, seen.camera()
        place = self.camera_en_m(view, placed.pose)
        spread = self.covariance(view, placed)
        covariance = spread[:2, :2]
        heading_deg = math.degrees(placed.pose.turn_rad) % 360
        agl_m = telemetry.agl_m * math.exp(placed.pose.log_scale)
        assert placed.covariance is not None
        gsd_m = self.grid.gsd_m
        # Coarse imagery of another date is displaced by more (benchmarks/pixel_ellipses.py).
        floor_m = self.floor_px * gsd_m * 2.0**view.levels.final
        of_middle: NDArray[np.float64] | None = placed.covariance[:2, :2] * gsd_m**2
        stds = {
            "heading_std_deg": math.degrees(math.sqrt(spread[2, 2])),
            "log_scale_std": math.sqrt(spread[3, 3]),
        }
        if camera is not None:
            place, agl_m = camera.orientation.position_m[:2], camera.agl_m
            heading_deg = float(camera.orientation.attitude_deg[0]) % 360
            covariance = camera.covariance[:2, :2] + np.eye(2) * floor_m**2
            stds = _attitude_found(camera, telemetry)
            of_middle = camera.middle_covariance
        elif telemetry.tilt_std_deg is not None:
            # A line of sight off nadir meets the ground farther out by 1 / cos^2.
            cos = math.cos(math.radians(off_nadir_deg(telemetry)))
            tilt_m = agl_m * math.radians(telemetry.tilt_std_deg) / cos**2
            covariance = covariance + np.eye(2) * tilt_m**2
        if of_middle is not None:
            widest = float(np.linalg.eigvalsh(of_middle)[-1])
            stds["middle_std_m"] = math.sqrt(widest + floor_m**2)
        lat, lon = self.sheet.frame.latlon_from_en(place)
        covariance.flags.writeable = False
        evidence = best.evidence()
        confidence = math.nan if self.confidence is None else self.confidence(evidence)
        evidence |= stds
        middle = None
        if seen.ground is not None:
            if seen.ground.gain is not None:
                evidence["terrain_gain"] = seen.ground.gain
            middle_en_m = seen.ground.middle_en_m if camera is None else camera.middle_en_m
            middle_deg = self.sheet.frame.latlon_from_en(middle_en_m)
            middle = float(middle_deg[0]), float(middle_deg[1])
        return Fix(
            lat_deg=float(lat),
            lon_deg=float(lon),
            cov_en_m2=covariance,
            confidence=confidence,
            radius_m=self.radius_m,
            heading_deg=heading_deg,
            agl_m=agl_m,
            evidence=MappingProxyType(evidence),
            ground_latlon_deg=middle,
        )

    def camera_en_m(self, view: PreparedView, pose: Pose) -> NDArray[np.float64]:
        """Metres east and north (2,) of the camera where a view's window lies at `pose`."""
        x, y = pose.map_px(view.camera_px)
        gsd_m = self.grid.gsd_m
        return np.array([self.grid.west_m + float(x) * gsd_m, self.grid.north_m - float(y) * gsd_m])

    def seen_from(self, view: PreparedView, pose: Pose) -> NDArray[np.float64]:
        """Where the camera of a view at `pose` is (4,): metres east and north, heading (rad) and
        log scale."""
        return np.array([*self.camera_en_m(view, pose), pose.turn_rad, pose.log_scale])

    def pose_of(self, view: PreparedView, seen_from: NDArray[np.float64]) -> Pose:
        """Where a view's window lies if the camera is at (4,): metres east and north, heading
        (rad) and log scale. The inverse of `seen_from`."""
        east, north, turn, log_scale = seen_from.tolist()
        x, y = (east - self.grid.west_m), (self.grid.north_m - north)
        moved = Pose(0.0, 0.0, turn, log_scale).map_px(view.camera_px)
        gsd_m = self.grid.gsd_m
        return Pose(x / gsd_m - float(moved[0]), y / gsd_m - float(moved[1]), turn, log_scale)

    def covariance(self, view: PreparedView, placed: Placed) -> NDArray[np.float64]:
        """Covariance (4, 4) of the camera's east and north (m), heading (rad) and log scale."""
        assert placed.covariance is not None
        moved = placed.pose.linear @ view.camera_px
        camera_from_pose = np.eye(4)
        camera_from_pose[:2, 2:] = [[-moved[1], moved[0]], [moved[0], moved[1]]]
        spread = camera_from_pose @ placed.covariance @ camera_from_pose.T
        spread[:2, :2] += np.eye(2) * self.floor_px**2
        metres = np.diag([self.grid.gsd_m, -self.grid.gsd_m, 1.0, 1.0])
        return np.asarray(metres @ spread @ metres)


def _attitude_found(camera: CameraFound, telemetry: Telemetry) -> dict[str, float]:
    """Pitch and roll by resection over the reported ones, and standard deviations."""
    _, pitch_deg, roll_deg = camera.orientation.attitude_deg.tolist()
    up_m, heading, pitch, roll = np.sqrt(np.diag(camera.covariance)[2:]).tolist()
    return {
        "heading_std_deg": heading,
        "log_scale_std": up_m / camera.agl_m,
        "pitch_bias_deg": pitch_deg - telemetry.pitch_deg,
        "roll_bias_deg": roll_deg - telemetry.roll_deg,
        "pitch_bias_std_deg": pitch,
        "roll_bias_std_deg": roll,
    }
