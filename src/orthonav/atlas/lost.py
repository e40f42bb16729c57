"""Lost in a country: views placed in an atlas of which nothing is known before.

Each view is looked for among the coarse tiles of the whole atlas, under all headings that it may
have; the best few places, and those where views before let expect it, are registered in their
sheets. What registers best has odds against the best elsewhere; only what several views agree on is
called a fix (`agreement`).
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Protocol

import numpy as np

from orthonav.atlas.agreement import (
    MAX_REACH_M,
    MIN_VIEWS,
    Agreement,
    Hypothesis,
    Seen,
)
from orthonav.atlas.ground import Ground, Place, Sighting
from orthonav.atlas.recipe import CoarseRecipe
from orthonav.confidence.registered import (
    USUAL_BIAS,
    USUAL_CHANCES,
    USUAL_WEIGHTS,
    RegisteredConfidence,
)
from orthonav.geo.frames import LocalFrame, distances_m
from orthonav.localizer.checks import check_footprint, check_view
from orthonav.localizer.rectify import RectifiedView, downsampled, rectify_footprint
from orthonav.records import DEFAULT_YAW_STD_DEG, MIN_YAW_STD_DEG, Fix, NoFix, Telemetry, View

CANDIDATES = 24
"""Places of the whole atlas that are registered."""
TURN_STEP_DEG = 8.0
LOG_SCALES = (-0.06, 0.06)
"""Headings and scales under which coarse tiles are looked for."""
KNOWN_SIGMAS = 2.0
REACH_STRIDES = 0.8
TURN_STD_RAD = math.radians(4.0)
VIEW_TILES = (0.6, 2.5)
"""Sides of views, in coarse tiles, of which a tile says enough."""
FOLLOWED, FOLLOWED_NATS = 4, 4.0
"""Hypotheses whose next view is looked for where it is expected: so many, no less likely than the
best by more than this."""
RIVAL_SHARE = 0.25
"""A rival lies farther from a place than this share of the view's side."""
SURE_VIEWS, CONFIDENT, SURE_REACH_M = 2.5, 0.97, 600.0
"""A hypothesis this sure, and this sure of where the view is, is followed without looking through
the whole atlas."""
WHOLE_EVERY = 5
"""So many views in a row; then it is looked through again."""
LIKELY = 0.5
"""Less likely places are no fix."""
MAX_CONFIDENCE = 0.999
LEAST = 1e-5
USUAL_CONFIDENCE = RegisteredConfidence(USUAL_BIAS, USUAL_WEIGHTS, USUAL_CHANCES)
"""Of sheets with too little imagery to learn one, at the border of what was flown over."""
MIN_VIEW_PX = 24.0


@dataclass(frozen=True)
class Candidate:
    """A coarse tile like the view: where the middle of the view lies, its heading and scale."""

    lat_deg: float
    lon_deg: float
    turn_rad: float
    log_scale: float
    score: float


class Lookup(Protocol):
    """The coarse tiles of an atlas."""

    @property
    def recipe(self) -> CoarseRecipe:
        """How they were cut."""

    def candidates(
        self, view: RectifiedView, poses: Sequence[tuple[float, float]], count: int
    ) -> list[Candidate]:
        """Tiles most like the view under some of the poses, best first, apart from each other."""


class LostLocator:
    """Places the views of one flight in an atlas. Mutable; not to be shared between threads."""

    def __init__(self, ground: Ground, lookup: Lookup, *, heading_known: bool = False) -> None:
        self._ground, self._lookup = ground, lookup
        self._heading_known = heading_known
        self._agreement = Agreement()
        self._seen_last = False
        self._since_whole = 0

    @property
    def state_name(self) -> str | None:
        """`searching` until views agree, then `tracking`, `lost` where the latest does not."""
        best = self._agreement.best
        if best is None or best.views < MIN_VIEWS:
            return "searching"
        return "tracking" if self._agreement.agreed and self._seen_last else "lost"

    def passed(self, telemetry: Telemetry, reason: NoFix) -> Fix | NoFix:
        """Nothing is known of a view that cannot be used."""
        self._seen_last = False
        return reason

    def locate(self, view: View) -> Fix | NoFix:
        """Where a view was taken, once views agree; until then what is missing.

        Raises `CameraError` where the image is not the camera's, `StorageError` where the sheets
        cannot be fetched.
        """
        self._seen_last = False
        recipe = self._lookup.recipe
        refused = check_view(view, recipe.gsd_m, self._heading_known)
        if refused is not None:
            return refused
        coarse = _rectified(view, recipe.gsd_m)
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

    def _placed(self, view: View, coarse: RectifiedView, side_m: float) -> Fix | NoFix:
        time_ns = view.telemetry.time_ns
        places = expected = self._expected(view, coarse, time_ns)
        if self._is_confident(time_ns, side_m):
            self._since_whole += 1
        else:
            self._since_whole = 0
            places = [*expected, *self._candidates(view, coarse)]
        made = (self._ground.register(view, place, side_m) for place in places)
        found = _distinct([each for each in made if each is not None], side_m)
        seen = [
            Seen(one.lat_deg, one.lon_deg, one.turn_rad, one.log_scale, _log_odds(key, found), key)
            for key, one in enumerate(found)
        ]
        # Where only what was expected was looked at, all of it lies there.
        all_m2 = _searched_m2(places)
        chance = _searched_m2(expected) / all_m2 if all_m2 else 1.0
        self._agreement.see(seen, time_ns, side_m, chance)
        return self._outcome(found, view)

    def _is_confident(self, time_ns: int, side_m: float) -> bool:
        """Whether it is enough to look where the view is expected; not for ever."""
        best = self._agreement.best
        return (
            best is not None
            and self._agreement.agreed
            and best.views >= SURE_VIEWS
            and self._agreement.confidence >= CONFIDENT
            and best.reach_m(time_ns) <= max(side_m, SURE_REACH_M)
            and self._since_whole < WHOLE_EVERY
        )

    def _expected(self, view: View, coarse: RectifiedView, time_ns: int) -> list[Place]:
        """Where hypotheses expect the view."""
        found = []
        hypotheses = self._agreement.hypotheses[:FOLLOWED]
        for each in hypotheses:
            if each.log_odds < hypotheses[0].log_odds - FOLLOWED_NATS:
                break
            reach_m = each.reach_m(time_ns)
            if time_ns < each.time_ns or reach_m > MAX_REACH_M:
                continue
            turn, std = each.last.turn_rad, each.turn_std_rad(time_ns)
            if self._heading_known:
                turn = math.radians(view.telemetry.yaw_deg)
                std = _yaw_std_rad(view.telemetry)
            camera = each.expected(time_ns)
            scale = each.last.log_scale
            middle = _moved(camera, coarse, turn, scale, 1.0)
            found.append(Place(*camera, middle, turn, scale, reach_m, std))
        return found

    def _candidates(self, view: View, coarse: RectifiedView) -> list[Place]:
        """Places of the whole atlas that are like the view."""
        headings = np.arange(0.0, 360.0, TURN_STEP_DEG)
        if self._heading_known:
            reach = KNOWN_SIGMAS * math.degrees(_yaw_std_rad(view.telemetry))
            steps = math.floor(min(180.0, reach) / TURN_STEP_DEG + 0.5)
            headings = view.telemetry.yaw_deg + TURN_STEP_DEG * np.arange(-steps, steps + 1)
        poses = [(math.radians(turn), scale) for turn in headings.tolist() for scale in LOG_SCALES]
        recipe = self._lookup.recipe
        reach_m = REACH_STRIDES * recipe.tile_m * (1 - recipe.overlap)
        found = []
        for each in self._lookup.candidates(coarse, poses, CANDIDATES):
            middle = each.lat_deg, each.lon_deg
            camera = _moved(middle, coarse, each.turn_rad, each.log_scale, -1.0)
            found.append(
                Place(*camera, middle, each.turn_rad, each.log_scale, reach_m, TURN_STD_RAD)
            )
        return found

    def _outcome(self, found: Sequence[Sighting], view: View) -> Fix | NoFix:
        agreement = self._agreement
        best = agreement.best
        if best is None:
            return NoFix("no_match", "no place of the atlas could be compared with the view")
        confidence = min(agreement.confidence, MAX_CONFIDENCE)
        if not agreement.agreed or confidence < LIKELY:
            return NoFix(
                "searching",
                f"{len(agreement.hypotheses)} places are possible; the likeliest is held by "
                f"{best.views:.1f} views",
            )
        self._seen_last = True
        return _fix(found[best.last.key], best, confidence, view)


def _searched_m2(places: Sequence[Place]) -> float:
    return sum(math.pi * place.reach_m**2 for place in places)


def _yaw_std_rad(telemetry: Telemetry) -> float:
    told = telemetry.yaw_std_deg
    if told is None or not math.isfinite(told):
        told = DEFAULT_YAW_STD_DEG
    return math.radians(min(max(told, MIN_YAW_STD_DEG), 180.0))


def _log_odds(key: int, found: Sequence[Sighting]) -> float:
    """Log odds of one of the places of a view against all the others, strongest first."""
    one = found[key]
    rivals = [each.evidence for place, each in enumerate(found) if place != key]
    confidence = one.confidence or USUAL_CONFIDENCE
    likely = min(max(confidence(_against(one.evidence, rivals)), LEAST), 1 - LEAST)
    return math.log(likely / (1 - likely))


def _rectified(view: View, gsd_m: float) -> RectifiedView:
    """The view at the resolution of the coarse tiles, its own heading up."""
    return rectify_footprint(downsampled(view, gsd_m), gsd_m=gsd_m, multiple_px=1)


def _moved(
    place: tuple[float, float], view: RectifiedView, turn_rad: float, log_scale: float, way: float
) -> tuple[float, float]:
    """From the camera to the middle of what it sees (`way` 1), or back (-1); degrees."""
    cos, sin = math.cos(turn_rad), math.sin(turn_rad)
    ahead = view.offset_en_m * math.exp(log_scale) * way
    moved = np.array([cos * ahead[0] + sin * ahead[1], cos * ahead[1] - sin * ahead[0]])
    lat, lon = LocalFrame(*place).latlon_from_en(moved)
    return float(lat), float(lon)


def _distinct(sightings: Sequence[Sighting], side_m: float) -> list[Sighting]:
    """The strongest of those that are one place, strongest first."""
    kept: list[Sighting] = []
    for each in sorted(sightings, key=lambda one: -one.evidence["strength"]):
        others = [(one.lat_deg, one.lon_deg) for one in kept]
        place = [(each.lat_deg, each.lon_deg)] * len(others)
        if not others or distances_m(place, others).min() > RIVAL_SHARE * side_m:
            kept.append(each)
    return kept


def _against(
    evidence: Mapping[str, float], rivals: Sequence[Mapping[str, float]]
) -> dict[str, float]:
    """The evidence of a place with the best elsewhere in the whole atlas as its rival.

    The finest level says something only where the strongest rival was looked at there too.
    """
    made = dict(evidence)
    for rival, value in (("rival", "strength"), ("look_rival", "look")):
        made[rival] = max([made[rival], *(each[value] for each in rivals)])
    strongest = max(rivals, key=lambda each: each["strength"], default=None)
    if strongest is None or not math.isfinite(made["fine"]):
        return made
    if math.isfinite(strongest["fine"]):
        made["fine_rival"] = max(made["fine_rival"], strongest["fine"])
    else:
        made["fine"] = made["fine_rival"] = math.nan
    return made


def _fix(one: Sighting, best: Hypothesis, confidence: float, view: View) -> Fix:
    covariance = np.array(one.covariance[:2, :2])
    tilt_std_deg = view.telemetry.tilt_std_deg
    if tilt_std_deg is not None and math.isfinite(tilt_std_deg):
        covariance += np.eye(2) * (view.telemetry.agl_m * math.radians(tilt_std_deg)) ** 2
    covariance.flags.writeable = False
    evidence = {**one.evidence, "views": best.views, "log_odds": best.log_odds}
    return Fix(
        lat_deg=one.lat_deg,
        lon_deg=one.lon_deg,
        cov_en_m2=covariance,
        confidence=confidence,
        radius_m=one.radius_m,
        heading_deg=math.degrees(one.turn_rad) % 360,
        agl_m=view.telemetry.agl_m * math.exp(one.log_scale),
        evidence=MappingProxyType(evidence),
    )
