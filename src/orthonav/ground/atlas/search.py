"""Searching a view in a whole atlas: coarse tiles, then registration on sheets.

`TileSearch` finds the most similar coarse tiles. `SheetRegistrar` registers the view on the part of
a sheet around a place, so that evidence is made of that part only: a whole sheet takes longer to
make ready than a view to register on it. `ViewMatches` weighs the matches: searching a region takes
ten times as long as judging the place near its middle, so all candidates are judged, those with
hope are finished, and of these the strongest are searched until one is proven. The others count as
rivals by what is known of them, as the candidates of one search do within a sheet."""

import functools
import logging
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from orthonav.core.errors import AtlasError, MapFileError
from orthonav.core.geo.frames import LocalFrame, distances_m
from orthonav.core.localize.confidence import DEFAULT_CONFIDENCE, RegisteredConfidence, logit
from orthonav.core.localize.ground import GroundModel
from orthonav.core.localize.localizer import RegistrationLocalizer
from orthonav.core.localize.place import REFINEMENT, Finished, Judged
from orthonav.core.localize.policy import DEFAULT_PLAN
from orthonav.core.localize.rectify import RectifiedView
from orthonav.core.localize.search import Search
from orthonav.core.localize.view import PreparedView, prepare
from orthonav.core.mapfile import open_map
from orthonav.core.mapfile.layer import level_shape
from orthonav.core.records import PRIOR_SIGMAS, NoFix, Prior, View
from orthonav.core.register.channels import COARSE, FINE
from orthonav.core.register.pose import Pose
from orthonav.core.register.search import Peak
from orthonav.core.register.window import GreyPyramid
from orthonav.core.tiles import represent
from orthonav.core.tiles.bank import embed_poses
from orthonav.core.variants import make_variant
from orthonav.ground.atlas.catalog import Atlas, CoarseRecipe
from orthonav.ground.atlas.coarse import EDGES
from orthonav.ground.atlas.index import (
    WHITENING_NAME,
    half_whitened,
    index_file,
    load_whitening,
    read_manifest,
    stale_sheets,
)
from orthonav.ground.atlas.vectors import ShardedIndex

log = logging.getLogger(__name__)

MAX_OPEN = 16  # sheets kept open: their decoded pictures take up to 64 MB each, 1 GB in all
BORDER_SHARE = 0.25  # of its side that the middle of a view may lie outside the box of a sheet
WIDEST = 1.25  # greatest scale at which all of a view lies on the part of a sheet, on level ground
PER_POSE = 60  # tiles found for each pose; several neighbouring tiles are one place
EFFORTS = ((10**6, 0.4, 300), (3 * 10**7, 0.25, 800))
MOST_EFFORT = 0.085, 1500
"""Greatest number of tiles, fraction of the lists scanned, tiles compared by their stored vectors:
finds 98 % of the tiles that exact search finds among 10^7, 95 % among 10^8
(`benchmarks.atlas_search` at d63ac91)."""
APART_STRIDES = 1.5  # tiles nearer to each other are one place: the eight neighbours of a tile
MAX_LAT_DEG = 89.8  # nearer to a pole a view has no meaningful heading


@dataclass(frozen=True)
class Placement:
    lat_deg: float
    lon_deg: float
    turn_rad: float  # heading of the top of the view
    log_scale: float  # logarithm of true over reported height

    @property
    def latlon_deg(self) -> tuple[float, float]:
        return self.lat_deg, self.lon_deg


def nearest_m(place: tuple[float, float], others: Sequence[tuple[float, float]]) -> float:
    return float(distances_m([place] * len(others), others).min(initial=math.inf))


class TileSearch:
    """The index of an atlas with its shards mapped. Not to be shared between threads. `unknown`
    names the sheets that are not in the index, which are not found."""

    def __init__(self, atlas: Atlas) -> None:
        manifest = read_manifest(atlas)
        if manifest is None or atlas.recipe.coarse is None:
            raise AtlasError(
                "the atlas has no index: make it with 'orthonav atlas index', or build an atlas "
                f"with coarse tiles: {atlas.url}"
            )
        self.atlas = atlas
        self.recipe: CoarseRecipe = atlas.recipe.coarse
        self.unknown = stale_sheets(atlas, manifest)[0]
        file = partial(index_file, atlas, manifest)
        self._embedder = load_whitening(file(WHITENING_NAME))
        self._representation = make_variant(represent.TABLE, EDGES)
        self._index = ShardedIndex(file, manifest.shards)
        if self._embedder.dims != self._index.quantizers.recipe.dims:
            raise AtlasError(f"files of the index do not fit together: {atlas.url}")
        efforts = (effort for most, *effort in EFFORTS if len(self._index) <= most)
        share, rerank = next(efforts, MOST_EFFORT)
        self._probes = max(1, round(share * manifest.recipe.lists))
        self._rerank = int(rerank)

    def matches(
        self, view: RectifiedView, poses: Sequence[tuple[float, float]], count: int
    ) -> list[Placement]:
        """Centres of the tiles most similar to a view, rectified to their resolution, under any of
        the poses (heading in rad, log scale), best first, apart from each other."""
        embedded = embed_poses(
            self._embedder, self._representation, view.grey, view.valid, poses, self.recipe.tile_px
        )
        queries = half_whitened(self._embedder, embedded)
        per_pose = min(PER_POSE, len(self._index))
        scores, ids = self._index.search(queries, per_pose, self._probes, self._rerank)
        pose_of = np.repeat(np.arange(len(poses)), per_pose)
        flat_scores, flat_ids = scores.reshape(-1), ids.reshape(-1)
        order = np.argsort(-flat_scores, kind="stable")
        apart_m = APART_STRIDES * self.recipe.tile_m * (1 - self.recipe.overlap)
        found: list[Placement] = []
        for at in order[np.isfinite(flat_scores[order])].tolist():
            place = self._index.place_deg(int(flat_ids[at]))
            if place is None or abs(place[0]) > MAX_LAT_DEG or abs(place[1]) > 180:
                continue
            if nearest_m(place, [each.latlon_deg for each in found]) < apart_m:
                continue
            found.append(Placement(*place, *poses[int(pose_of[at])]))
            if len(found) == count:
                break
        return found


@dataclass(frozen=True)
class SearchRegion(Placement):
    middle_latlon_deg: tuple[float, float]  # middle of the ground that the view shows
    reach_m: float  # how far from the place is searched
    turn_std_rad: float  # standard deviation of the heading


@dataclass(frozen=True, eq=False)
class SheetMatch(Placement):
    """The placement of a view registered on a sheet. `confidence`: what the sheet makes of the
    evidence, None where it has learnt nothing."""

    evidence: Mapping[str, float]  # scores of the match and of its rivals
    confidence: RegisteredConfidence | None


@dataclass
class PyramidPart:
    """Part of the grey levels of a sheet: `height` x `width` pixels of level 0 from (`row`, `col`)
    on, which are multiples of a pixel of the coarsest level."""

    whole: GreyPyramid
    levels: int
    row: int
    col: int
    height: int
    width: int

    def shape(self, level: int) -> tuple[int, int]:
        return level_shape(self.height, self.width, level)

    def read(
        self, level: int, row: int, col: int, height: int, width: int
    ) -> tuple[NDArray[np.uint8], NDArray[np.bool_]]:
        first = (self.row >> level) + row, (self.col >> level) + col
        return self.whole.read(level, *first, height, width)


class SheetRegistrar:
    def __init__(self, atlas: Atlas) -> None:
        self.atlas = atlas
        self._lattice = atlas.recipe.sheets
        self._usable = set(atlas.sheets())
        self._sheet = functools.lru_cache(maxsize=MAX_OPEN)(self._opened)

    def near(self, region: SearchRegion, side_m: float) -> list[RegistrationLocalizer]:
        frame = LocalFrame(*region.middle_latlon_deg)
        reach_m = region.reach_m + BORDER_SHARE * side_m
        lats, lons = frame.latlon_from_en(np.array([[-reach_m, -reach_m], [reach_m, reach_m]]))
        box = float(lons[0]), float(lats[0]), float(lons[1]), float(lats[1])
        opened = (self._sheet(name) for name in self._lattice.over(box) if name in self._usable)
        return [sheet for sheet in opened if sheet is not None]

    def at(self, region: SearchRegion) -> RegistrationLocalizer | None:
        """The sheet in whose box the middle of a view is expected, None where it cannot be used.
        Raises `StorageError` where it cannot be fetched."""
        name = self._lattice.name_at(*region.middle_latlon_deg)
        return self._sheet(name) if name in self._usable else None

    def _opened(self, name: str) -> RegistrationLocalizer | None:
        try:
            opened = open_map(self.atlas.path(self.atlas.sheets()[name]))
            return RegistrationLocalizer.of_map(opened, None, level_ground=False)
        except (AtlasError, MapFileError) as error:
            log.warning("sheet %s cannot be used: %s", name, error)
            self._usable.discard(name)
            return None


class ViewRegistrar:
    def __init__(self, sheets: SheetRegistrar, view: View, side_m: float) -> None:
        self._sheets, self._side_m = sheets, side_m
        self._prepared = functools.cache(functools.partial(prepare, view, heading_known=False))

    def searched(self, region: SearchRegion) -> SheetMatch | None:
        """The best match in all of a region, on all sheets that may hold the middle of the view;
        None where it cannot be compared."""
        parts = (self._part(each, region) for each in self._sheets.near(region, self._side_m))
        found = [match for part in parts if part is not None and (match := part.searched())]
        return max(found, key=lambda each: each.evidence["strength"], default=None)

    def judged(self, region: SearchRegion) -> "JudgedRegion | None":
        """The best place near the middle of a region at the level where views are judged, on the
        sheet that covers it; None where there is none."""
        sheet = self._sheets.at(region)
        part = None if sheet is None else self._part(sheet, region)
        return part if part is not None and part.judged else None

    def _part(self, sheet: RegistrationLocalizer, region: SearchRegion) -> "JudgedRegion | None":
        view = self._prepared(sheet.grid.gsd_m, sheet.pyramid.levels)
        if isinstance(view, NoFix):
            return None
        pose_prior = replace(view.prior, turn_rad=region.turn_rad, turn_std_rad=region.turn_std_rad)
        view = replace(view, prior=pose_prior)
        prior = Prior(*region.latlon_deg, region.reach_m / PRIOR_SIGMAS)
        whole = Search(sheet, view, prior)
        if not whole.touches_map:
            return None
        half_diagonal_px = math.hypot(*view.templates.valid.shape) / 2 * 2**view.levels.final
        margin_px = max(
            FINE.margin_px * 2**view.levels.mid, COARSE.margin_px * 2**view.levels.coarse
        )
        around_px = whole.reach_px + WIDEST * half_diagonal_px + margin_px
        part = part_of(sheet, whole.middle_px, around_px)
        if part is None:
            return None
        if part.ground is not None:
            view = replace(view, prior=part.ground.expected(view))
        return JudgedRegion(part, view, region, prior)


def part_of(
    sheet: RegistrationLocalizer, middle_px: tuple[float, float], around_px: float
) -> RegistrationLocalizer | None:
    """The part of a sheet that reaches `around_px` from a point (x, y), both in pixels of level 0;
    None where that is empty."""
    pyramid, grid = sheet.pyramid, sheet.grid
    unit = 2 ** (pyramid.levels - 1)
    row, col, *ends = (
        min(max(math.floor((at + sign * around_px) / unit) * unit + more, 0), extent)
        for sign, more in ((-1, 0), (1, unit))
        for at, extent in zip(reversed(middle_px), pyramid.shape(0), strict=True)
    )
    height, width = ends[0] - row, ends[1] - col
    if not height or not width:
        return None
    north_m, west_m = grid.north_m - row * grid.gsd_m, grid.west_m + col * grid.gsd_m
    lattice = {"tile_px": 1, "stride_px": 1, "rows": height, "cols": width}
    part_grid = replace(grid, west_m=west_m, north_m=north_m, **lattice)
    part = RegistrationLocalizer(
        replace(sheet.sheet, grid=part_grid),
        PyramidPart(pyramid, pyramid.levels, row, col, height, width),
        confidence=sheet.confidence,
        radius_m=sheet.radius_m,
        floor_px=sheet.floor_px,
        plan=sheet.plan,
    )
    if sheet.ground is not None:
        whole = sheet.ground
        part.ground = GroundModel(whole.terrain, part_grid, whole.info, whole.land, whole.surface)
    return part


@dataclass(frozen=True, eq=False)
class JudgedRegion:
    sheet: RegistrationLocalizer
    view: PreparedView
    region: SearchRegion
    prior: Prior

    @functools.cached_property
    def search(self) -> Search:
        return Search(self.sheet, self.view, self.prior)

    @functools.cached_property
    def judged(self) -> list[Judged]:
        """Places near the middle of the region, under headings and scales around its own, at the
        level where views are judged, best first."""
        view, region, search = self.view, self.region, self.search
        east, north = self.sheet.sheet.frame.en_from_latlon(*region.latlon_deg)
        turns = (region.turn_rad + sign * region.turn_std_rad for sign in (-1, 0, 1))
        seen_from = (np.array([east, north, turn, region.log_scale]) for turn in turns)
        poses = [Peak(0.0, self.sheet.pose_of(view, each)) for each in seen_from]
        near = search.nearby(poses, region.reach_m / self.sheet.grid.gsd_m)
        return search.refiner.judge([each.pose for each in near], view.levels.coarse)

    @property
    def look(self) -> float:
        return self.search.refiner.best_and_rival(self.judged)[0]

    @property
    def latlon_deg(self) -> tuple[float, float]:
        return self._latlon_deg(self.judged[0].pose)

    def finished(self) -> SheetMatch:
        refiner = self.search.refiner
        places = refiner.on_terrain(self.judged, 1)
        return self._match(refiner.below_camera(refiner.finished(places, len(places))))

    def searched(self) -> SheetMatch | None:
        """The best match in all of the region; this takes ten times as long."""
        found = self.search.best()
        return None if found is None else self._match(self.search.refiner.below_camera(found))

    def _latlon_deg(self, pose: Pose) -> tuple[float, float]:
        camera_en_m = self.sheet.camera_en_m(self.view, pose)
        lat, lon = self.sheet.sheet.frame.latlon_from_en(camera_en_m)
        return float(lat), float(lon)

    def _match(self, found: Finished) -> SheetMatch:
        pose = found.pose
        place = *self._latlon_deg(pose), pose.turn_rad, pose.log_scale
        return SheetMatch(*place, found.scores, self.sheet.confidence)


SEARCHED = 4  # candidates: the right one and the best rivals (docs/decisions/atlas.md)
PROVEN = logit(1 - DEFAULT_PLAN.trial_doubt, 0.0)
"""Log odds of a match that ends the search of candidates: as for a place whose rivals were not all
searched."""
RIVAL_SHARE = 0.25  # matches farther apart than this share of the view's side are different places
LEAST = 1e-5  # least and greatest (1 - LEAST) probability of a match, for finite odds


class ViewMatches:
    """The matches of a view `side_m` wide. `found`: the strongest of each place, strongest first.
    `compared`: the regions of candidates that were finished, or searched."""

    def __init__(self, side_m: float) -> None:
        self._apart_m = RIVAL_SHARE * side_m
        self._judged: list[JudgedRegion] = []
        self.compared: list[SearchRegion] = []
        self.found: list[SheetMatch] = []

    def add_candidates(self, registrar: ViewRegistrar, regions: Sequence[SearchRegion]) -> None:
        judged = [each for each in map(registrar.judged, regions) if each is not None]
        judged.sort(key=lambda each: -each.look)
        hopeful = sum(each.look >= REFINEMENT.hope * judged[0].look for each in judged)
        hopeful = max(hopeful, REFINEMENT.min_hopeful)
        self._judged = judged[hopeful:]
        self.compared = [each.region for each in judged[:hopeful]]
        finished = [(each.finished(), each) for each in judged[:hopeful]]
        finished.sort(key=lambda each: -each[0].evidence["strength"])
        found = [match for match, _ in finished]
        self.found = self._distinct(found)
        searched: list[SheetMatch] = []
        for number, (_, region) in enumerate(finished[:SEARCHED]):
            match = region.searched()
            if match is None:
                continue
            searched.append(match)
            if nearest_m(match.latlon_deg, [found[number].latlon_deg]) > self._apart_m:
                found.append(match)  # the place that was judged remains a rival
            else:
                found[number] = match
            self.found = self._distinct(found)
            if self._proven and self.found[0] in searched:
                break

    def add_expected(self, registrar: ViewRegistrar, regions: Sequence[SearchRegion]) -> None:
        """Search the regions where a view is expected, the likeliest first, up to one in which the
        strongest match is proven. One in which a candidate is proven already is not searched."""
        for region in regions:
            if not self._proven_in(region) and (found := registrar.searched(region)):
                self.found = self._distinct([*self.found, found])
            if self._proven_in(region):
                break

    @property
    def _proven(self) -> bool:
        return bool(self.found) and self.log_odds(0) >= PROVEN

    def _proven_in(self, region: SearchRegion) -> bool:
        if not self._proven:
            return False
        return nearest_m(region.latlon_deg, [self.found[0].latlon_deg]) <= region.reach_m

    def log_odds(self, number: int) -> float:
        one = self.found[number]
        rivals = [each.evidence for at, each in enumerate(self.found) if at != number]
        looks = [
            each.look
            for each in self._judged
            if nearest_m(each.latlon_deg, [one.latlon_deg]) > self._apart_m
        ]
        confidence = one.confidence or DEFAULT_CONFIDENCE
        return logit(confidence(against(one.evidence, rivals, looks)), LEAST)

    def _distinct(self, matches: Sequence[SheetMatch]) -> list[SheetMatch]:
        distinct: list[SheetMatch] = []
        for each in sorted(matches, key=lambda one: -one.evidence["strength"]):
            others = [one.latlon_deg for one in distinct]
            if nearest_m(each.latlon_deg, others) > self._apart_m:
                distinct.append(each)
        return distinct


def against(
    evidence: Mapping[str, float],
    rivals: Sequence[Mapping[str, float]],
    looks: Sequence[float] = (),
) -> dict[str, float]:
    """The evidence of a match with the best other match of the whole atlas as its rival. `looks`:
    scores, at the level where views are judged, of places that were not finished. The finest level
    counts only where the strongest rival was compared there too."""
    made = dict(evidence)
    for rival, value in (("rival", "strength"), ("look_rival", "look")):
        made[rival] = max([made[rival], *(each[value] for each in rivals)])
    made["look_rival"] = max([made["look_rival"], *looks])
    strongest = max(rivals, key=lambda each: each["strength"], default=None)
    if strongest is None or not math.isfinite(made["fine"]):
        return made
    if math.isfinite(strongest["fine"]):
        made["fine_rival"] = max(made["fine_rival"], strongest["fine"])
    else:
        made["fine"] = made["fine_rival"] = math.nan
    return made
