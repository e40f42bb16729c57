"""Placing the views of a flight in an atlas without any prior position.

Each view is searched among the coarse tiles of the whole atlas, under all possible headings. The
best places, and the places where earlier views let expect it, are registered on their sheets. Each
match has odds against the best other match of the whole atlas. A place is found where several views
agree on it: one view alone never decides where in a country an aircraft is. From there on the
aircraft is tracked on a map cut around it, in memory. Before the aircraft can reach its border,
another one is cut around the place where it is expected, and the track continues there. A view that
the track does not recognize is searched in the whole atlas too: where several of them agree on a
place, another track begins there.

A chain is a sequence of places, one per view, that an aircraft can have flown through. A view found
where a chain expects it supports the chain by its odds against the best other place in the whole
atlas, and by how unlikely it is that a wrong place lies there by chance. A view counts by the share
of it that is new ground, because views of the same ground are not independent."""

import logging
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from orthonav.core.errors import AreaError, AtlasError, MapFileError
from orthonav.core.geo.frames import LocalFrame, distances_m
from orthonav.core.localize import Localizer
from orthonav.core.localize.confidence import DEFAULT_CONFIDENCE
from orthonav.core.localize.rectify import RectifiedView, downsampled, rectify_footprint
from orthonav.core.localize.view import LIMITS, check_footprint, check_view, pose_prior
from orthonav.core.records import CONFIDENT, Fix, NoFix, Prior, Telemetry, View
from orthonav.core.track import Model, State
from orthonav.core.track.tracker import Tracker
from orthonav.core.track.trust import MOST_LATELY
from orthonav.ground.atlas.catalog import Atlas
from orthonav.ground.atlas.cut import cut_in_memory
from orthonav.ground.atlas.search import (
    Placement,
    SearchRegion,
    SheetRegistrar,
    TileSearch,
    ViewMatches,
    ViewRegistrar,
    nearest_m,
)
from orthonav.ground.planning.area import Area

log = logging.getLogger(__name__)

# Values without another source were chosen with `benchmarks.atlas_lost` at d63ac91.
MAX_SPEED_MPS = 120.0  # faster than the aircraft that this program is for
SLACK_M = 60.0  # errors of two registered positions, seven pixels of 8 m
TURN_RATE_RAD_S = math.radians(12.0)  # four times a standard-rate turn (3 deg/s)
TURN_SLACK_RAD = math.radians(12.0)  # errors of two registered headings
SCALE_SLACK = 0.12  # greatest difference of log scale between two views, besides climbing
CLIMB_PER_S = 0.02  # change of log scale per second: 20 m/s at 1000 m
MIN_NEW = 0.15  # fraction of a view that must be new ground (docs/decisions/tracking.md)
ANCHORS = 30  # places that counted and are remembered: circling over them proves nothing more
MAX_REACH_M = 5_000.0  # a chain whose aircraft may be farther away is dropped
MIN_VELOCITY_S = 0.5  # views closer in time do not give a velocity
AGILE_MPS = 10.0  # the velocity may change by so much, and by half, between two views
MISSED = 1.6  # nats that a view without support costs a chain: exp(-1.6) is 0.2, `1 - FOUND`
CHANCE = 0.05  # least probability that a wrong place lies by chance where a chain expects the view
FOUND = 0.8  # probability that the right place is found where a chain expects the view
MAX_LOG_ODDS = 5.0  # no single view counts more than this: odds of 150
MAX_CHAINS = 12
HOPELESS = 9.0  # chains less likely than the best by more nats are dropped
MIN_VIEWS = 1.7  # views of new ground that must agree: two that overlap by 30 %
MAX_CHAIN_LOG_ODDS = 14.0  # so that a chain that became wrong is given up after some views


@dataclass(frozen=True)
class PlaceEvidence(Placement):
    log_odds: float  # of this place against all others of the atlas, from this view alone (nats)
    key: int  # number by which the caller recognizes the view


@dataclass(frozen=True, eq=False)
class Chain:
    last: PlaceEvidence  # the latest place
    time_ns: int  # when it was seen
    log_odds: float  # of the chain (nats)
    views: float  # how many agree, in views of new ground
    latest_log_odds: float  # what the latest view alone says of its place (nats)
    anchors: tuple[PlaceEvidence, ...]  # the places of the views that counted
    velocity_en_mps: NDArray[np.float64] | None = None  # east and north, None where unknown
    missed: int = 0  # views since the latest place that did not support the chain

    def latest(self, count: int) -> tuple[PlaceEvidence, ...]:
        places = self.anchors if self.anchors[-1] is self.last else (*self.anchors, self.last)
        return places[-count:]

    def _seconds(self, time_ns: int) -> float:
        return max(0.0, (time_ns - self.time_ns) / 1e9)

    def reach_m(self, time_ns: int) -> float:
        speed = MAX_SPEED_MPS
        if self.velocity_en_mps is not None:
            latest = float(np.hypot(*self.velocity_en_mps))
            speed = min(speed, (0.5 + self.missed) * latest + AGILE_MPS)
        return SLACK_M + speed * self._seconds(time_ns)

    def expected(self, time_ns: int) -> tuple[float, float]:
        if self.velocity_en_mps is None:
            return self.last.latlon_deg
        frame = LocalFrame(*self.last.latlon_deg)
        lat, lon = frame.latlon_from_en(self.velocity_en_mps * self._seconds(time_ns))
        return float(lat), float(lon)

    def turn_std_rad(self, time_ns: int) -> float:
        turned = TURN_SLACK_RAD + TURN_RATE_RAD_S * self._seconds(time_ns)
        return min(math.pi / 2, turned / 3)

    def reaches(self, place: PlaceEvidence, time_ns: int) -> bool:
        dt_s = self._seconds(time_ns)
        away = distances_m([self.expected(time_ns)], [place.latlon_deg])[0]
        turned = abs(math.remainder(place.turn_rad - self.last.turn_rad, 2 * math.pi))
        scaled = abs(place.log_scale - self.last.log_scale)
        return bool(
            away <= self.reach_m(time_ns)
            and turned <= TURN_SLACK_RAD + TURN_RATE_RAD_S * dt_s
            and scaled <= SCALE_SLACK + CLIMB_PER_S * dt_s
        )


class Agreement:
    def __init__(self) -> None:
        self.chains: list[Chain] = []

    def add_view(
        self, places: Sequence[PlaceEvidence], time_ns: int, side_m: float, chance: float
    ) -> None:
        """`side_m`: width of the view. `chance`: probability that the best of the wrong places lies
        where a chain expects it, the fraction of the searched area that was searched there."""
        gain = math.log(FOUND / min(max(chance, CHANCE), FOUND))
        made: list[Chain] = []
        supporting = [each for each in places if _support(each, gain) > 0]
        for chain in self.chains:
            if time_ns < chain.time_ns or chain.reach_m(time_ns) > MAX_REACH_M:
                continue
            made += [
                _extended(chain, each, time_ns, side_m, gain)
                for each in supporting
                if chain.reaches(each, time_ns)
            ]
            made.append(replace(chain, log_odds=chain.log_odds - MISSED, missed=chain.missed + 1))
        # New chains come last: of two equal chains the older one comes first.
        for each in places:
            odds = min(each.log_odds, MAX_LOG_ODDS)
            made.append(Chain(each, time_ns, odds, 1.0, odds, (each,)))
        chains = _distinct(made, side_m)
        # Subtracted from all alike: the limit must not make them equal.
        excess = max(0.0, chains[0].log_odds - MAX_CHAIN_LOG_ODDS) if chains else 0.0
        self.chains = [replace(each, log_odds=each.log_odds - excess) for each in chains]

    @property
    def best(self) -> Chain | None:
        return self.chains[0] if self.chains else None

    @property
    def confidence(self) -> float:
        best = self.best
        if best is None:
            return 0.0
        odds = np.array([0.0, *(each.log_odds for each in self.chains)])
        probability = float(np.exp(odds[1] - np.logaddexp.reduce(odds)))
        return min(probability, 1 / (1 + math.exp(-best.latest_log_odds)))

    @property
    def agreed(self) -> bool:
        best = self.best
        return best is not None and best.views >= MIN_VIEWS and best.missed == 0


def _support(place: PlaceEvidence, gain: float) -> float:
    return min(place.log_odds, MAX_LOG_ODDS) + gain


def _extended(
    chain: Chain, place: PlaceEvidence, time_ns: int, side_m: float, gain: float
) -> Chain:
    there = [each.latlon_deg for each in chain.anchors]
    new = min(1.0, nearest_m(place.latlon_deg, there) / max(side_m, 1.0))
    anchors = (*chain.anchors, place)[-ANCHORS:]
    if new < MIN_NEW:
        new, anchors = 0.0, chain.anchors
    support = _support(place, gain)
    return Chain(
        last=place,
        time_ns=time_ns,
        log_odds=max(chain.log_odds + new * support, min(place.log_odds, MAX_LOG_ODDS)),
        views=chain.views + new,
        latest_log_odds=support,
        anchors=anchors,
        velocity_en_mps=_velocity(chain, place, (time_ns - chain.time_ns) / 1e9),
    )


def _velocity(chain: Chain, place: PlaceEvidence, dt_s: float) -> NDArray[np.float64] | None:
    if dt_s < MIN_VELOCITY_S:
        return chain.velocity_en_mps
    frame = LocalFrame(*chain.last.latlon_deg)
    velocity = frame.en_from_latlon(place.lat_deg, place.lon_deg) / dt_s
    speed = float(np.hypot(*velocity))
    return np.asarray(velocity * min(1.0, MAX_SPEED_MPS / max(speed, 1e-9)))


def _distinct(made: Sequence[Chain], side_m: float) -> list[Chain]:
    chains: list[Chain] = []
    for each in sorted(made, key=lambda one: (-one.log_odds, -one.views)):
        if chains and each.log_odds < chains[0].log_odds - HOPELESS:
            break
        if nearest_m(each.last.latlon_deg, [one.last.latlon_deg for one in chains]) >= side_m / 4:
            chains.append(each)
        if len(chains) == MAX_CHAINS:
            break
    return chains


# Values without another source: `benchmarks.atlas_lost` at d63ac91.
CANDIDATES = 40  # places of the whole atlas that are judged, 4 ms each
TURN_STEP_DEG = 8.0
LOG_SCALES = (-0.06, 0.06)
"""Headings and log scales under which coarse tiles are searched: each
view has a pose that is off by 4 deg and 6 % at most, for scales within 12 %."""
KNOWN_SIGMAS = 2.0  # standard deviations of a reported heading that are searched to either side
REACH_STRIDES = 0.8  # of coarse tiles, searched around a candidate: over half a diagonal
TURN_STD_RAD = math.radians(4.0)  # of the heading of a candidate: half of `TURN_STEP_DEG`
VIEW_TILES = (0.6, 2.5)  # least and greatest side of a view, in coarse tiles
FOLLOWED, FOLLOWED_NATS = 4, 4.0  # chains whose expected places are searched
START_PX = 5.0  # of a found place: half of the radius within which confidence counts it right
REPLAYED = 4  # latest views of a place that a track begins with


@dataclass(frozen=True, eq=False)
class FoundPlace:
    """A place on which several views agree. `seen`: the latest of these views, each with the place
    of its camera, the last one that of the view found."""

    seen: tuple[tuple[View, Placement], ...]
    std_m: float  # standard deviation of such a place, per axis
    confidence: float  # probability that the places are right, against all others of the atlas


class PlaceFinder:
    def __init__(
        self, registrar: SheetRegistrar, search: TileSearch, *, heading_known: bool = False
    ) -> None:
        self._registrar, self._search = registrar, search
        self._heading_known = heading_known
        self._number = 0
        self.restart()

    def restart(self) -> None:
        self._agreement = Agreement()
        self._views: dict[int, View] = {}

    def find(self, view: View) -> FoundPlace | NoFix:
        recipe = self._search.recipe
        refused = check_view(view, recipe.gsd_m, self._heading_known)
        if refused is not None:
            return refused
        coarse = rectified(view, recipe.gsd_m)
        refused = check_footprint(coarse, 1.0, LIMITS.min_view_px)
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
        registrar, matches = ViewRegistrar(self._registrar, view, side_m), ViewMatches(side_m)
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


SIGMAS = 3.0  # standard deviations of a position within which the aircraft is
AHEAD_M = 1000.0  # a map reaches so much farther than the next view can: fewer maps are cut
LIKELY = 0.5  # least confidence of a fix
MODEL = Model(wide_m=MAX_REACH_M / SIGMAS, most_agreement=1.0)
"""Views of a flight without a prior may be far apart in time: their positions are never predicted
well. So each must show the map by itself, however well it agrees with the prediction, and a wide
prediction is no reason to confirm the track again (docs/decisions/atlas.md)."""


class LocalTrack:
    """The track of one aircraft from a found place on. Mutable; not to be shared between threads.
    `fix`: the position at the last view, None where that view does not show the map there."""

    def __init__(self, atlas: Atlas, found: FoundPlace, *, heading_known: bool) -> None:
        self._atlas = atlas
        views = [view for view, _ in found.seen]
        places = [place.latlon_deg for _, place in found.seen]
        first, last = views[0].telemetry, views[-1].telemetry
        middle = LocalFrame(*places[0])
        away = distances_m([places[0]] * len(places), places)
        self._area, localizer = self._cut(
            middle, float(away.max()) + SIGMAS * found.std_m + _half_diagonal_m(views[-1])
        )
        scale = math.hypot(MODEL.log_scale, views[0].camera.focal_std)
        model = replace(MODEL.at_height(first.agl_m), log_scale=scale)
        self._tracker = Tracker(localizer, model=model, heading_known=heading_known)
        prior: Prior | None = Prior(*places[0], found.std_m)
        for view in views:
            telemetry = replace(view.telemetry, prior=prior)
            seen = self._tracker.locate(replace(view, telemetry=telemetry))
            if prior is not None:  # agreement has confirmed this place
                mixture, prior = self._tracker.mixture, None
                mixture.hypotheses = [
                    replace(each, shown=replace(each.shown, ground=MOST_LATELY))
                    for each in mixture.hypotheses
                ]
        self._take(seen, last, found.confidence)
        here = [(self._last.lat_deg, self._last.lon_deg)]
        off_m = distances_m(here, [places[-1]])[0]
        self.agrees = bool(off_m <= self._last.radius_m)

    @property
    def state(self) -> State:
        return self._tracker.state

    def locate(self, view: View) -> bool:
        """Follow a view; False where the track has ended: the aircraft may be anywhere, or a lost
        track is not found again at once."""
        if not self._can_follow(view.telemetry, _half_diagonal_m(view)):
            return False
        was_lost = self.state is State.LOST
        self._take(self._tracker.locate(view), view.telemetry)
        return not (was_lost and self.state is State.LOST)

    def passed(self, telemetry: Telemetry, reason: NoFix) -> bool:
        if not self._can_follow(telemetry, 0.0):
            return False
        self._take(self._tracker.passed(telemetry, reason), telemetry)
        return True

    def _take(self, seen: Fix | NoFix, telemetry: Telemetry, most: float = 1.0) -> None:
        assert isinstance(seen, Fix)  # a track with a start always has an estimate
        self._time_ns, self._last = telemetry.time_ns, seen
        most = min(seen.evidence["recognized"], most)
        confidence, place = min(seen.confidence, most), min(seen.place_probability, most)
        limited = replace(seen, confidence=confidence, place_probability=place)
        self.fix = limited if confidence >= LIKELY else None

    def _can_follow(self, telemetry: Telemetry, half_view_m: float) -> bool:
        """Whether the aircraft is near enough to the expected place to be sought there. A view that
        may reach beyond the map gets another one."""
        fix = self._last
        seconds = max(0.0, (telemetry.time_ns - self._time_ns) / 1e9)
        velocity = np.array([fix.evidence["vel_east_mps"], fix.evidence["vel_north_mps"]])
        speed = min(float(np.hypot(*velocity)) / 2 + AGILE_MPS, MAX_SPEED_MPS)
        if fix.evidence["vel_std_mps"] > AGILE_MPS:
            velocity, speed = np.zeros(2), MAX_SPEED_MPS
        spread_m = SIGMAS * fix.std_m
        reach_m = spread_m + speed * seconds
        if reach_m > MAX_REACH_M:
            return False
        lat, lon = LocalFrame(fix.lat_deg, fix.lon_deg).latlon_from_en(velocity * seconds)
        west, south, east, north = self._area.extent_en_m
        x, y = self._area.frame.en_from_latlon(lat, lon).tolist()
        if min(x - west, east - x, y - south, north - y) < reach_m + half_view_m:
            middle = LocalFrame(float(lat), float(lon))
            self._area, localizer = self._cut(middle, reach_m + half_view_m)
            self._tracker.continue_on(localizer)
        return True

    def _cut(self, middle: LocalFrame, reach_m: float) -> tuple[Area, Localizer]:
        half_m = reach_m + AHEAD_M
        area = Area(middle, (-half_m, -half_m, half_m, half_m))
        localizer = Localizer(cut_in_memory(self._atlas, area))
        if localizer.registration is not None and localizer.registration.confidence is None:
            localizer.registration.confidence = DEFAULT_CONFIDENCE
        return area, localizer


class AtlasLocator:
    def __init__(
        self, registrar: SheetRegistrar, search: TileSearch, *, heading_known: bool = False
    ) -> None:
        self._atlas = registrar.atlas
        self._heading_known = heading_known
        self._finder = PlaceFinder(registrar, search, heading_known=heading_known)
        self._track: LocalTrack | None = None
        self._state = State.SEARCHING

    @property
    def state_name(self) -> str | None:
        return self._state.value

    def passed(self, telemetry: Telemetry, reason: NoFix) -> Fix | NoFix:
        self._follow(lambda track: track.passed(telemetry, reason))
        return self._outcome(reason)

    def locate(self, view: View) -> Fix | NoFix:
        self._follow(lambda track: track.locate(view))
        if self._track is not None and self._track.fix is not None:
            self._finder.restart()
            return self._outcome()
        found = self._finder.find(view)
        if isinstance(found, NoFix):
            return self._outcome(found)
        try:
            begun = LocalTrack(self._atlas, found, heading_known=self._heading_known)
            if begun.agrees:
                self._track = begun
        except (AreaError, AtlasError, MapFileError) as error:
            log.warning("no map can be cut around the place found: %s", error)
        return self._outcome()

    def _follow(self, take_in: Callable[[LocalTrack], bool]) -> None:
        if self._track is None:
            return
        try:
            if not take_in(self._track):
                self._track = None
        except (AreaError, AtlasError, MapFileError) as error:
            log.warning("no map can be cut where the aircraft is expected: %s", error)
            self._track = None

    def _outcome(self, reason: NoFix | None = None) -> Fix | NoFix:
        if self._track is not None:
            self._state = self._track.state
        elif self._state is not State.SEARCHING:
            self._state = State.LOST
        fix = None if self._track is None else self._track.fix
        unconfirmed = NoFix("searching", "the last view does not confirm the place found")
        return fix or reason or unconfirmed


def _half_diagonal_m(view: View) -> float:
    return view.telemetry.agl_m * math.hypot(*view.camera.extent) / 2
