"""Registering views on the sheets of an atlas, which are opened when they are needed.

A view is registered on the part of a sheet around a place, so that evidence is made of that part
only: the candidates of a view lie on as many sheets as there are, and a whole sheet takes longer to
make ready than a view to register on it.
"""

import functools
import logging
import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from orthonav.core.errors import AtlasError, MapFileError
from orthonav.core.geo.frames import LocalFrame
from orthonav.core.localize.confidence import RegisteredConfidence
from orthonav.core.localize.ground import Relief
from orthonav.core.localize.localizer import RegistrationLocalizer
from orthonav.core.localize.place import Place
from orthonav.core.localize.search import Search
from orthonav.core.localize.view import PreparedView, prepare
from orthonav.core.mapfile import open_map
from orthonav.core.mapfile.layer import level_shape
from orthonav.core.records import PRIOR_SIGMAS, NoFix, Prior, View
from orthonav.core.register.channels import COARSE, FINE
from orthonav.core.register.pose import Pose
from orthonav.core.register.search import Peak
from orthonav.core.register.window import GreyPyramid
from orthonav.ground.atlas.agreement import Placement, nearest_m
from orthonav.ground.atlas.catalog import Atlas

log = logging.getLogger(__name__)

MAX_OPEN = 16
"""Sheets kept open: their decoded pictures take up to 64 MB each, 1 GB in all."""
BORDER_SHARE = 0.25
"""Sheets reach half a tile beyond their box: a sheet is
searched where the middle of a view may lie up to this share of its side outside the box."""
WIDEST = 1.25
"""On level ground all of a view of up to this scale lies on the part of a sheet where it is
registered."""


@dataclass(frozen=True)
class SearchRegion(Placement):
    """A placement around which a view is registered.

    `middle_latlon_deg`: middle of the ground that the view shows.
    `reach_m`: how far from the place is searched.
    `turn_std_rad`: standard deviation of the heading.
    """

    middle_latlon_deg: tuple[float, float]
    reach_m: float
    turn_std_rad: float

    def contains(self, place: Placement) -> bool:
        """Whether a place is within reach."""
        return nearest_m(self.latlon_deg, [place.latlon_deg]) <= self.reach_m


@dataclass(frozen=True, eq=False)
class SheetMatch(Placement):
    """The placement of a view registered on a sheet.

    `evidence`: scores of the match and of its rivals.
    `confidence`: what the sheet makes of the evidence, None where it has learnt nothing.
    """

    evidence: Mapping[str, float]
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
        """Rows and columns of a level."""
        return level_shape(self.height, self.width, level)

    def read(
        self, level: int, row: int, col: int, height: int, width: int
    ) -> tuple[NDArray[np.uint8], NDArray[np.bool_]]:
        """Grey and valid (height, width) of a window."""
        first = (self.row >> level) + row, (self.col >> level) + col
        return self.whole.read(level, *first, height, width)


class SheetRegistrar:
    """Registers views on the sheets of an atlas. Not to be shared between threads."""

    def __init__(self, atlas: Atlas) -> None:
        self.atlas = atlas
        self._lattice = atlas.recipe.sheets
        self._usable = set(atlas.sheets())
        self._sheet = functools.lru_cache(maxsize=MAX_OPEN)(self._opened)

    def of_view(self, view: View, side_m: float) -> "ViewRegistrar":
        """What registers a view `side_m` wide."""
        return ViewRegistrar(self, view, side_m)

    def near(self, region: SearchRegion, side_m: float) -> list[RegistrationLocalizer]:
        """The usable sheets within reach of the middle of a view. Raises `StorageError` where a
        sheet cannot be fetched."""
        frame = LocalFrame(*region.middle_latlon_deg)
        reach_m = region.reach_m + BORDER_SHARE * side_m
        lats, lons = frame.latlon_from_en(np.array([[-reach_m, -reach_m], [reach_m, reach_m]]))
        box = float(lons[0]), float(lats[0]), float(lons[1]), float(lats[1])
        opened = (self._sheet(name) for name in self._lattice.over(box) if name in self._usable)
        return [sheet for sheet in opened if sheet is not None]

    def at(self, region: SearchRegion, side_m: float) -> list[RegistrationLocalizer]:
        """The sheet in whose box the middle of a view is expected; where it cannot be used, its
        neighbours within reach. Raises `StorageError` where a sheet cannot be fetched."""
        name = self._lattice.name_at(*region.middle_latlon_deg)
        sheet = self._sheet(name) if name in self._usable else None
        return self.near(region, side_m) if sheet is None else [sheet]

    def _opened(self, name: str) -> RegistrationLocalizer | None:
        """A sheet, None where it is damaged (logged once)."""
        try:
            opened = open_map(self.atlas.path(self.atlas.sheets()[name]))
            return RegistrationLocalizer.of_map(opened, None, level_ground=False)
        except (AtlasError, MapFileError) as error:
            log.warning("sheet %s cannot be used: %s", name, error)
            self._usable.discard(name)
            return None


class ViewRegistrar:
    """Registers one view, which is prepared once for all sheets that are alike."""

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
        parts = (self._part(each, region) for each in self._sheets.at(region, self._side_m))
        found = [part for part in parts if part is not None and part.judged]
        return max(found, key=lambda each: each.look, default=None)

    def _part(self, sheet: RegistrationLocalizer, region: SearchRegion) -> "JudgedRegion | None":
        """The view on the part of a sheet around a region; None where it does not reach there."""
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
            FINE.margin_px * 2**view.levels.judged, COARSE.margin_px * 2**view.levels.coarse
        )
        around_px = whole.reach_px + WIDEST * half_diagonal_px + margin_px
        part = part_of(sheet, whole.middle_px, around_px)
        if part is None:
            return None
        if part.relief is not None:
            view = replace(view, prior=part.relief.expected(view))
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
    if sheet.relief is not None:
        part.relief = Relief(sheet.relief.terrain, part_grid)
    return part


@dataclass(frozen=True, eq=False)
class JudgedRegion:
    """A view on the part of a sheet around a region."""

    sheet: RegistrationLocalizer
    view: PreparedView
    region: SearchRegion
    prior: Prior

    @functools.cached_property
    def search(self) -> Search:
        """The search for the view in the region."""
        return Search(self.sheet, self.view, self.prior)

    @functools.cached_property
    def judged(self) -> list[Place]:
        """Places near the middle of the region, under headings and scales around its own, at the
        level where views are judged, best first."""
        view, region, search = self.view, self.region, self.search
        east, north = self.sheet.sheet.frame.en_from_latlon(*region.latlon_deg)
        turns = (region.turn_rad + sign * region.turn_std_rad for sign in (-1, 0, 1))
        seen_from = (np.array([east, north, turn, region.log_scale]) for turn in turns)
        poses = [Peak(0.0, self.sheet.pose_of(view, each)) for each in seen_from]
        near = search.nearby(poses, region.reach_m / self.sheet.grid.gsd_m)
        return search.placer.judge([each.pose for each in near], view.levels.coarse)

    @property
    def look(self) -> float:
        """Score of the best of them, less the cost of its prior."""
        return self.search.placer.standing(self.judged)[0]

    @property
    def latlon_deg(self) -> tuple[float, float]:
        """Latitude and longitude of the camera there."""
        return self._latlon_deg(self.judged[0].pose)

    def finished(self) -> SheetMatch:
        """The match at the best of them."""
        placer = self.search.placer
        places = placer.on_terrain(self.judged, 1)
        return self._match(placer.below_camera(placer.finished(places, len(places))))

    def searched(self) -> SheetMatch | None:
        """The best match in all of the region; this takes ten times as long."""
        found = self.search.best()
        return None if found is None else self._match(self.search.placer.below_camera(found))

    def _latlon_deg(self, pose: Pose) -> tuple[float, float]:
        camera_en_m = self.sheet.camera_en_m(self.view, pose)
        lat, lon = self.sheet.sheet.frame.latlon_from_en(camera_en_m)
        return float(lat), float(lon)

    def _match(self, found: Place) -> SheetMatch:
        pose = found.pose
        place = *self._latlon_deg(pose), pose.turn_rad, pose.log_scale
        return SheetMatch(*place, found.scores, self.sheet.confidence)
