"""Finding in an atlas, without any prior position, where the views of a flight were taken.

Each view is searched among the coarse tiles of the whole atlas, under all possible headings. The
best places, and the places where earlier views let expect it, are registered on their sheets. Each
match has odds against the best other match of the whole atlas (`orthonav.ground.atlas.matches`).
Only places on which several views agree are found (`orthonav.ground.atlas.agreement`).
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from orthonav.core.geo.frames import LocalFrame
from orthonav.core.localize.rectify import RectifiedView, downsampled, rectify_footprint
from orthonav.core.localize.view import MIN_VIEW_PX, check_footprint, check_view, pose_prior
from orthonav.core.records import CONFIDENT, NoFix, View
from orthonav.ground.atlas.agreement import (
    MAX_REACH_M,
    Agreement,
    PlaceEvidence,
    Placement,
)
from orthonav.ground.atlas.matches import ViewMatches
from orthonav.ground.atlas.sheet_registration import SearchRegion, SheetRegistrar
from orthonav.ground.atlas.tile_search import TileSearch

# Values without another source: `python -m benchmarks.atlas_lost`.
CANDIDATES = 40
"""Places of the whole atlas that are judged, 4 ms each."""
TURN_STEP_DEG = 8.0
LOG_SCALES = (-0.06, 0.06)
"""Headings and log scales under which coarse tiles are searched: each
view has a pose that is off by 4 deg and 6 % at most, for scales within 12 %."""
KNOWN_SIGMAS = 2.0
"""Standard deviations of a reported heading that are searched to either side."""
REACH_STRIDES = 0.8
"""Strides of the coarse tiles around a candidate that are searched: more than half a diagonal."""
TURN_STD_RAD = math.radians(4.0)
"""Of the heading of a candidate: half of `TURN_STEP_DEG`."""
VIEW_TILES = (0.6, 2.5)
"""Least and greatest side of a view, in coarse tiles."""
FOLLOWED, FOLLOWED_NATS = 4, 4.0
"""Chains whose expected places are searched: at most so many, and not less likely than the best by
more nats."""
START_PX = 5.0
"""Standard deviation of a found place, in pixels of the sheets: half of the radius within which
their confidence counts a place as right."""
REPLAYED = 4
"""Latest views of a place that a track begins with."""


@dataclass(frozen=True, eq=False)
class FoundPlace:
    """A place on which several views agree.

    `seen`: the latest of these views, each with the place of its camera, the last one that of the
    view found. `std_m`: standard deviation of such a place, per axis. `confidence`: probability
    that the places are right, against all others of the atlas.
    """

    seen: tuple[tuple[View, Placement], ...]
    std_m: float
    confidence: float


class PlaceFinder:
    """Finds where in an atlas the views of a flight were taken. Mutable; not to be shared between
    threads."""

    def __init__(
        self, registrar: SheetRegistrar, search: TileSearch, *, heading_known: bool = False
    ) -> None:
        self._registrar, self._search = registrar, search
        self._heading_known = heading_known
        self._agreement = Agreement()
        self._views: dict[int, View] = {}
        self._number = 0

    def restart(self) -> None:
        """Forget all views."""
        self._agreement = Agreement()
        self._views = {}

    def find(self, view: View) -> FoundPlace | NoFix:
        """The place on which this view and earlier ones agree; until then the reason why not.

        Raises `CameraError` where the image is not of the camera's size, `StorageError` where
        sheets cannot be fetched.
        """
        recipe = self._search.recipe
        refused = check_view(view, recipe.gsd_m, self._heading_known)
        if refused is not None:
            return refused
        coarse = rectified(view, recipe.gsd_m)
        refused = check_footprint(coarse, 1.0, MIN_VIEW_PX)
        if refused is not None:
            return refused
        side_m = math.sqrt(float(coarse.valid.sum())) * recipe.gsd_m
        least, most = (share * recipe.tile_m for share in VIEW_TILES)
        if not least <= side_m <= most:
            return NoFix(
                "wrong_scale",
                f"view is {side_m:.0f} m wide; the coarse tiles of this atlas are for views of "
                f"{least:.0f} to {most:.0f} m",
            )
        return self._placed(view, coarse, side_m)

    def _placed(self, view: View, coarse: RectifiedView, side_m: float) -> FoundPlace | NoFix:
        time_ns = view.telemetry.time_ns
        expected = self._expected(view, coarse, time_ns)
        candidates = self._candidates(view, coarse)
        registrar, matches = self._registrar.of_view(view, side_m), ViewMatches(side_m)
        matches.add_candidates(registrar, candidates)
        matches.add_expected(registrar, expected)
        places = [
            PlaceEvidence(
                *one.latlon_deg, one.turn_rad, one.log_scale, matches.log_odds(at), self._number
            )
            for at, one in enumerate(matches.found)
        ]
        # Candidates that were only judged might hide a match: their area does not count.
        all_m2 = _searched_m2([*expected, *matches.compared])
        chance = _searched_m2(expected) / all_m2 if all_m2 else 1.0
        self._agreement.add_view(places, time_ns, side_m, chance)
        self._views[self._number] = view
        self._number += 1
        used = {each.key for chain in self._agreement.chains for each in chain.latest(REPLAYED)}
        self._views = {key: view for key, view in self._views.items() if key in used}
        return self._outcome()

    def _expected(self, view: View, coarse: RectifiedView, time_ns: int) -> list[SearchRegion]:
        """Where the most likely one chains expect the view."""
        found = []
        chains = self._agreement.chains[:FOLLOWED]
        for each in chains:
            if each.log_odds < chains[0].log_odds - FOLLOWED_NATS:
                break
            reach_m = each.reach_m(time_ns)
            if time_ns < each.time_ns or reach_m > MAX_REACH_M:
                continue
            turn, std = each.last.turn_rad, each.turn_std_rad(time_ns)
            if self._heading_known:
                turn = math.radians(view.telemetry.yaw_deg)
                std = pose_prior(view.telemetry, True).turn_std_rad
            camera, scale = each.expected(time_ns), each.last.log_scale
            middle = _moved(camera, coarse, turn, scale, 1.0)
            found.append(SearchRegion(*camera, turn, scale, middle, reach_m, std))
        return found

    def _candidates(self, view: View, coarse: RectifiedView) -> list[SearchRegion]:
        """The places of the whole atlas that are most similar to the view."""
        headings = np.arange(0.0, 360.0, TURN_STEP_DEG)
        if self._heading_known:
            reach = KNOWN_SIGMAS * math.degrees(pose_prior(view.telemetry, True).turn_std_rad)
            steps = math.floor(min(180.0, reach) / TURN_STEP_DEG + 0.5)
            headings = view.telemetry.yaw_deg + TURN_STEP_DEG * np.arange(-steps, steps + 1)
        poses = [(math.radians(turn), scale) for turn in headings.tolist() for scale in LOG_SCALES]
        recipe = self._search.recipe
        reach_m = REACH_STRIDES * recipe.tile_m * (1 - recipe.overlap)
        found = []
        for each in self._search.matches(coarse, poses, CANDIDATES):
            turn, scale, middle = each.turn_rad, each.log_scale, each.latlon_deg
            camera = _moved(middle, coarse, turn, scale, -1.0)
            found.append(SearchRegion(*camera, turn, scale, middle, reach_m, TURN_STD_RAD))
        return found

    def _outcome(self) -> FoundPlace | NoFix:
        agreement = self._agreement
        best = agreement.best
        if best is None:
            return NoFix("no_match", "no part of the atlas could be compared with the view")
        if not agreement.agreed or agreement.confidence < CONFIDENT:
            return NoFix(
                "searching",
                f"{len(agreement.chains)} places are possible; {best.views:.1f} views support the "
                "most likely one",
            )
        seen = tuple((self._views[each.key], each) for each in best.latest(REPLAYED))
        return FoundPlace(seen, START_PX * self._search.atlas.recipe.gsd_m, agreement.confidence)


def rectified(view: View, gsd_m: float) -> RectifiedView:
    """The view rectified to `gsd_m` metres per pixel, its own heading up."""
    return rectify_footprint(downsampled(view, gsd_m), gsd_m=gsd_m, multiple_px=1)


def _searched_m2(regions: Sequence[SearchRegion]) -> float:
    return sum(math.pi * region.reach_m**2 for region in regions)


def _moved(
    place: tuple[float, float], view: RectifiedView, turn_rad: float, log_scale: float, sign: float
) -> tuple[float, float]:
    """From the camera to the middle of the ground in view (`sign` 1), or back (-1); degrees."""
    cos, sin = math.cos(turn_rad), math.sin(turn_rad)
    ahead = view.offset_en_m * math.exp(log_scale) * sign
    moved = np.array([cos * ahead[0] + sin * ahead[1], cos * ahead[1] - sin * ahead[0]])
    lat, lon = LocalFrame(*place).latlon_from_en(moved)
    return float(lat), float(lon)
