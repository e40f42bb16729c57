"""Placing a view by registration: rectify it, find candidates, refine them, judge the best.

Candidates come from where they cost least: a search by FFT of the whole sheet or of the part that
the prior allows, at the level where the view is judged or one coarser; or, on large sheets, tiles
whose embeddings are alike. Where the outcome leaves doubt, the next dearer way is tried too.
"""

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import pairwise
from types import MappingProxyType
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from orthonav.confidence.registered import Chances, RegisteredConfidence
from orthonav.localizer.checks import check_footprint
from orthonav.localizer.propose import TileProposer
from orthonav.localizer.rectify import RectifiedView, downsampled, rectify_footprint
from orthonav.mapfile.manifest import SheetInfo
from orthonav.records import Fix, NoFix, Prior, Telemetry, View
from orthonav.register.pose import Pose
from orthonav.register.reference import GreyPyramid, Reference
from orthonav.register.refine import Placed
from orthonav.register.registrar import Levels, PosePrior, Registered, Registrar
from orthonav.register.search import Candidate, bank, search
from orthonav.register.template import ViewTemplates
from orthonav.search.exact import rows_within

DEFAULT_YAW_STD_DEG = 7.0
DEFAULT_AGL_STD = 0.08
MIN_YAW_STD_DEG = 2.0
MIN_AGL_STD = 0.03
MAX_AGL_STD = 0.15
TURN_STEP_RAD, SCALE_STEP = math.radians(8.0), 0.13
LOOK_TURN_STEP_RAD, LOOK_SCALE_STEP = math.radians(6.0), 0.09
"""Steps of heading and scale: of candidates that are refined at a coarser level first, and of those
that are not."""
BANK_SIGMAS = 3.0
MAX_NATS = 5.5
STAGES_NATS = (-1.0, 0.4, 2.0, math.inf)
"""Headings and scales are tried in stages, by how unlikely they are."""
PRIOR_SIGMAS = 3.0
CANDIDATES = 24
STAGE_CANDIDATES = 8
MIN_CANDIDATES = 6
CANDIDATE_SHARE = 0.5
MIN_VIEW_PX = 24.0
MIN_TILT_COS = 0.5
USUAL_CHANCES = Chances(32.0, 15.0, 48.0)
DOUBT = 0.01
"""Views of this confidence to one less it are looked at one level finer."""
POSE_MS = 0.1
PIXEL_MS = 5.5e-7
LOOK_MS = 14.0
LAST_MS = 900.0
"""What searches cost on one core of a desktop, roughly: to choose between them, no more."""
MAX_SEARCH_PX = 8_000_000
"""Windows larger than this (some 300 MB) are not searched by FFT: on such a map views are found by
tiles, or with a prior."""


class _ClearMargin(NamedTuple):
    """A view this far above chance and above its rivals is not searched again."""

    strength: float
    look_ratio: float
    peak_ratio: float


CLEAR = _ClearMargin(2.2, 1.9, 1.9)
CLEAR_AT_JUDGED = _ClearMargin(1.8, 1.5, 1.5)
"""Less is enough where the level that misses least was searched, if only in part."""


@dataclass(frozen=True, eq=False)
class PreparedView:
    """A view made ready: its templates, levels, and where the camera is seen from its middle.

    `rectified_at` makes the view at the ground resolution of a level.
    """

    rectified_at: Callable[[int], RectifiedView]
    templates: ViewTemplates
    levels: Levels
    side_px: float
    camera_px: NDArray[np.float64]
    prior: PosePrior


class RegistrationLocalizer:
    """Places views on one sheet by registration. Safe to share between threads."""

    def __init__(
        self,
        sheet: SheetInfo,
        layer: GreyPyramid,
        confidence: RegisteredConfidence | None,
        radius_m: float,
        floor_px: float,
        propose: TileProposer | None = None,
        last_ms: float = LAST_MS,
    ) -> None:
        """`floor_px` is the standard deviation with which maps of two dates agree, in pixels.

        Without `propose` candidates come from FFT search alone. Searches dearer than `last_ms`,
        by a rough estimate, are left out.
        """
        self.sheet, self.grid = sheet, sheet.grid
        self.registrar = Registrar(Reference(layer))
        self.confidence, self.radius_m = confidence, radius_m
        self.propose = propose
        self.floor_px, self._last_ms = floor_px, last_ms

    def locate(self, view: View, prior: Prior | None, heading_known: bool) -> Fix | NoFix:
        """Where a view was taken; checks of view and telemetry have been made."""
        prepared = self.prepared(view, heading_known)
        if isinstance(prepared, NoFix):
            return prepared
        if prior is not None and not self.touches_map(prior, prepared):
            return NoFix("outside_map", "the map does not reach to where the prior says")
        best = self.best(prepared, prior)
        if best is None:
            detail = "no place of the map could be compared with the view"
            if prior is None:
                detail += "; a large map needs a prior, or views as large as its tiles"
            return NoFix("no_match", detail)
        return self._fix(prepared, best, view.telemetry)

    def prepared(self, view: View, heading_known: bool) -> PreparedView | NoFix:
        """The view rectified to the level where it is finished, heading up, all that it sees."""
        camera, telemetry = view.camera, view.telemetry
        agl_m = telemetry.agl_m
        tilt = math.cos(math.radians(telemetry.pitch_deg)) * math.cos(
            math.radians(telemetry.roll_deg)
        )
        # The area seen grows with the inverse cube of the cosine, as far as it is looked at.
        nominal_m = (agl_m / max(tilt, MIN_TILT_COS) ** 1.5) * math.sqrt(
            camera.width_px * camera.height_px / (camera.fx_px * camera.fy_px)
        )
        levels = Levels.of(nominal_m / self.grid.gsd_m, self.registrar.reference.levels)
        gsd_m = self.grid.gsd_m * 2**levels.final
        reduce = levels.coarse - levels.final

        def rectified_at(finest: int) -> RectifiedView:
            finest_m = self.grid.gsd_m * 2**finest
            return rectify_footprint(
                downsampled(view, finest_m),
                gsd_m=finest_m,
                multiple_px=2 ** max(0, reduce + levels.final - finest),
            )

        rectified = rectified_at(levels.final)
        refused = check_footprint(rectified, gsd_m / self.grid.gsd_m, MIN_VIEW_PX)
        if refused is not None:
            return refused
        templates = ViewTemplates(rectified.grey, rectified.valid, levels.final)
        pose_prior = _pose_prior(telemetry, heading_known)
        offset = rectified.offset_en_m / self.grid.gsd_m
        side_px = math.sqrt(float(rectified.valid.sum())) * gsd_m / self.grid.gsd_m
        camera_px = np.array([-offset[0], offset[1]])
        return PreparedView(rectified_at, templates, levels, side_px, camera_px, pose_prior)

    def best(self, view: PreparedView, prior: Prior | None) -> Registered | None:
        """The best place over all ways of search that had to be tried."""
        judged: list[Placed] = []
        best: Registered | None = None
        candidates = 0
        for level, found in self._ways(view, prior):
            judged += self.registrar.judged(
                view.templates, view.levels, found, level, view.prior, judged
            )
            candidates += len(found)
            best = None
            enough = CLEAR_AT_JUDGED if level == view.levels.look else CLEAR
            if judged and self._looks_sure(view, judged, enough):
                best = self._finished(view, judged, candidates)
                if self._is_confident(best, enough):
                    return best
        if not judged:
            return None
        best = best or self._finished(view, judged, candidates)
        if view.levels.final == 0 or not self._is_doubtful(best):
            return best
        made = view.rectified_at(view.levels.final - 1)
        finer = ViewTemplates(made.grey, made.valid, view.levels.final - 1)
        return self.registrar.deepened(view.templates, finer, view.levels, best)

    def _finished(self, view: PreparedView, judged: list[Placed], candidates: int) -> Registered:
        return self.registrar.finished(view.templates, view.levels, judged, view.prior, candidates)

    def _looks_sure(self, view: PreparedView, judged: list[Placed], enough: _ClearMargin) -> bool:
        """Whether finishing the best of them may end the search."""
        best, rival = self.registrar.standing(view.templates, judged, view.prior)
        return best > enough.strength * self._chances.look and best > enough.look_ratio * rival

    def _is_confident(self, best: Registered, enough: _ClearMargin) -> bool:
        if best.score <= enough.strength * self._chances.total:
            return False
        return best.look_ratio > enough.look_ratio and best.peak_ratio > enough.peak_ratio

    def _is_doubtful(self, best: Registered) -> bool:
        """Whether one finer level could change whether the place is believed."""
        if self.confidence is None:
            return True
        return DOUBT <= self.confidence(best.evidence()) <= 1 - DOUBT

    @property
    def _chances(self) -> Chances:
        return self.confidence.chances if self.confidence else USUAL_CHANCES

    def _ways(
        self, view: PreparedView, prior: Prior | None
    ) -> Iterator[tuple[int, list[Candidate]]]:
        """Candidates and the level they were found at, by the cheapest way first.

        The level where views are judged misses least: it alone is searched where that is cheap,
        elsewhere after a cheaper way that left doubt, if it can be afforded at all. The likeliest
        headings and scales come first.
        """
        look, coarse = view.levels.look, view.levels.coarse
        rough = _by_likelihood(view.prior, TURN_STEP_RAD, SCALE_STEP)
        fine = _by_likelihood(view.prior, LOOK_TURN_STEP_RAD, LOOK_SCALE_STEP)
        look_ms = self._search_ms(view, prior, look, len(fine))
        if look_ms > LOOK_MS:
            poses = [pose for pose, _ in rough]
            coarse_ms = self._search_ms(view, prior, coarse, len(poses))
            rows = self._tiles(view, prior)
            ways = sorted([(coarse_ms, False), (self._tiles_ms(view, rows, len(poses)), True)])
            # The cheapest if it can be done at all; a second one only where it can be afforded.
            dearest = 0.0 if look_ms <= self._last_ms else self._last_ms
            for number, (cost_ms, from_tiles) in enumerate(ways):
                if math.isinf(cost_ms) or (number and cost_ms > dearest):
                    break
                if from_tiles and self.propose is not None:
                    yield coarse, self.propose.candidates(view.rectified_at(0), poses, rows)
                else:
                    yield coarse, self._searched(view, prior, coarse, poses, CANDIDATES)
        if look_ms <= max(self._last_ms, LOOK_MS):
            for least, most in pairwise(STAGES_NATS):
                stage = [pose for pose, nats in fine if least < nats <= most]
                if stage:
                    yield look, self._searched(view, prior, look, stage, STAGE_CANDIDATES)

    def _tiles(self, view: PreparedView, prior: Prior | None) -> NDArray[np.intp] | None:
        """Rows of the tiles that the prior allows, None for all."""
        if prior is None or self.propose is None:
            return None
        x, y = self._prior_px(prior, view)
        grid = self.grid
        centre = np.array([grid.west_m + x * grid.gsd_m, grid.north_m - y * grid.gsd_m])
        reach_m = self._reach_px(view, prior) * grid.gsd_m + grid.stride_m
        return rows_within(self.propose.centres_en_m, centre, reach_m)

    def _tiles_ms(self, view: PreparedView, rows: NDArray[np.intp] | None, poses: int) -> float:
        """What candidates from tiles cost; infinite where there can be none."""
        if self.propose is None or not self.propose.fits(view.side_px):
            return math.inf
        tiles = len(self.propose.centres_en_m) if rows is None else len(rows)
        return self.propose.cost_ms(poses, tiles) if tiles else math.inf

    def _search_ms(self, view: PreparedView, prior: Prior | None, level: int, poses: int) -> float:
        rows, cols = self.registrar.reference.shape(level)
        if prior is not None:
            across = 2 * self._reach_px(view, prior) / 2**level
            rows, cols = round(min(rows, across)), round(min(cols, across))
        side = view.side_px / 2**level
        if prior is not None or min(rows, cols) < 3 * side:
            rows, cols = round(rows + side), round(cols + side)
        pixels = float(rows * cols)
        if pixels > MAX_SEARCH_PX:
            return math.inf
        return poses * (POSE_MS + PIXEL_MS * pixels * math.log2(pixels))

    def _searched(
        self,
        view: PreparedView,
        prior: Prior | None,
        level: int,
        poses: list[tuple[float, float]],
        count: int,
    ) -> list[Candidate]:
        recipe = view.levels.recipe(level)
        if prior is None:
            window = self.registrar.whole_window(level, recipe, view.side_px)
        else:
            window = self.registrar.part_window(
                level,
                recipe,
                view.side_px,
                self._prior_px(prior, view),
                self._reach_px(view, prior),
            )
        found = search(view.templates.at(level, recipe), window, poses, count)
        worth = sum(each.score >= CANDIDATE_SHARE * found[0].score for each in found)
        return found[: max(worth, MIN_CANDIDATES)]

    def _prior_px(self, prior: Prior, view: PreparedView) -> tuple[float, float]:
        """Where the middle of the view should lie by the prior, x and y at level 0."""
        east, north = self.sheet.frame.en_from_latlon(prior.lat_deg, prior.lon_deg)
        x = (float(east) - self.grid.west_m) / self.grid.gsd_m
        y = (self.grid.north_m - float(north)) / self.grid.gsd_m
        if view.prior.turn_rad is None:
            return x, y
        cos, sin = math.cos(view.prior.turn_rad), math.sin(view.prior.turn_rad)
        moved = np.array([[cos, -sin], [sin, cos]]) @ view.camera_px
        return x - float(moved[0]), y - float(moved[1])

    def _reach_px(self, view: PreparedView, prior: Prior) -> float:
        """How far from there the middle of the view may lie."""
        tilt = float(np.hypot(*view.camera_px))
        turn = 2.0 if view.prior.turn_rad is None else 2 * view.prior.turn_std_rad
        reach = PRIOR_SIGMAS * max(prior.std_m, 0.0) / self.grid.gsd_m
        return float(reach + tilt * min(turn, 1.0) + 2.0 * 2**view.levels.coarse)

    def touches_map(self, prior: Prior, view: PreparedView) -> bool:
        """Whether any of the map lies where the prior allows the view to be."""
        x, y = self._prior_px(prior, view)
        reach = self._reach_px(view, prior)
        rows, cols = self.registrar.reference.shape(0)
        return -reach < x < cols + reach and -reach < y < rows + reach

    def _fix(self, view: PreparedView, best: Registered, telemetry: Telemetry) -> Fix:
        placed = best.placed
        lat, lon = self.sheet.frame.latlon_from_en(self.camera_en_m(view, placed.pose))
        covariance = self.covariance(view, placed)[:2, :2]
        if telemetry.tilt_std_deg is not None:
            tilt_m = telemetry.agl_m * math.radians(telemetry.tilt_std_deg)
            covariance = covariance + np.eye(2) * tilt_m**2
        covariance.flags.writeable = False
        evidence = best.evidence()
        confidence = math.nan if self.confidence is None else self.confidence(evidence)
        return Fix(
            lat_deg=float(lat),
            lon_deg=float(lon),
            cov_en_m2=covariance,
            confidence=confidence,
            radius_m=self.radius_m,
            heading_deg=math.degrees(placed.pose.turn_rad) % 360,
            agl_m=telemetry.agl_m * math.exp(placed.pose.log_scale),
            evidence=MappingProxyType(evidence),
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


def _pose_prior(telemetry: Telemetry, heading_known: bool) -> PosePrior:
    """What the telemetry says of heading and scale."""
    yaw_std = _or_default(telemetry.yaw_std_deg, DEFAULT_YAW_STD_DEG)
    agl_std_m = telemetry.agl_std_m
    agl_std = None if agl_std_m is None else agl_std_m / telemetry.agl_m
    return PosePrior(
        math.radians(telemetry.yaw_deg) if heading_known else None,
        math.radians(min(max(yaw_std, MIN_YAW_STD_DEG), 90.0)),
        min(max(_or_default(agl_std, DEFAULT_AGL_STD), MIN_AGL_STD), MAX_AGL_STD),
    )


def _or_default(value: float | None, default: float) -> float:
    return default if value is None or not math.isfinite(value) else value


def _by_likelihood(
    prior: PosePrior, turn_step_rad: float, scale_step: float
) -> list[tuple[tuple[float, float], float]]:
    """Headings (rad) and log scales to try, each with its `nats`, the likeliest first."""
    made = bank(
        None if prior.turn_rad is None else prior.turn_std_rad,
        prior.log_scale_std,
        turn_step_rad=turn_step_rad,
        scale_step=scale_step,
        sigmas=BANK_SIGMAS,
    )
    told = prior.turn_rad or 0.0
    cell = turn_step_rad / 2, scale_step / 2
    poses = [(told + turn, log_scale) for turn, log_scale in made.poses]
    known = [(pose, prior.nats(*pose, within=cell)) for pose in poses]
    return sorted((each for each in known if each[1] <= MAX_NATS), key=lambda each: each[1])
