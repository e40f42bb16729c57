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
from numpy.typing import NDArray

from orthonav.atlas.agreement import Agreement, Hypothesis, Seen
from orthonav.atlas.ground import Ground, Place, Sighting, ViewOnGround
from orthonav.atlas.recipe import CoarseRecipe
from orthonav.confidence.registered import USUAL_BIAS, USUAL_WEIGHTS, RegisteredConfidence
from orthonav.errors import AtlasError
from orthonav.geo.camera import Camera
from orthonav.geo.frames import LocalFrame, distances_m
from orthonav.localizer.checks import check_footprint, check_telemetry, check_view
from orthonav.localizer.rectify import Rectified, prepare_view, rectify_footprint
from orthonav.localizer.registration import USUAL_CHANCES
from orthonav.records import Fix, NoFix, Telemetry

CANDIDATES = 40
"""Places of the whole atlas that are registered."""
TURN_STEP_DEG = 8.0
LOG_SCALES = (-0.06, 0.06)
"""Headings and scales under which coarse tiles are looked for."""
KNOWN_SIGMAS = 2.0
DEFAULT_YAW_STD_DEG = 7.0
REACH_STRIDES = 0.8
TURN_STD_RAD = math.radians(4.0)
VIEW_TILES = (0.6, 2.5)
"""Sides of views, in coarse tiles, of which a tile says enough."""
FOLLOWED = 4
"""Hypotheses whose next view is looked for where it is expected."""
RIVAL_SHARE = 0.25
"""A rival lies farther from a place than this share of the view's side."""
SURE_VIEWS, SURE = 2.5, 0.98
"""A hypothesis this sure is followed without looking through the whole atlas."""
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
        self, view: Rectified, poses: Sequence[tuple[float, float]], count: int
    ) -> list[Candidate]:
        """Tiles most like the view under some of the poses, best first, apart from each other."""


class LostLocator:
    """Places the views of one flight in an atlas. Mutable; not to be shared between threads."""

    def __init__(self, ground: Ground, lookup: Lookup, *, heading_known: bool = False) -> None:
        self._ground, self._lookup = ground, lookup
        self._heading_known = heading_known
        self._agreement = Agreement()

    @property
    def state_name(self) -> str | None:
        """`searching` until views agree, then `tracking`, `lost` where the latest does not."""
        best = self._agreement.best
        if best is None or (best.views < SURE_VIEWS and not self._agreement.agreed):
            return "searching"
        return "tracking" if self._agreement.agreed else "lost"

    def passed(self, camera: Camera, telemetry: Telemetry, reason: NoFix) -> Fix | NoFix:
        """Nothing is known of a view that cannot be used."""
        return reason

    def locate(self, grey: NDArray[np.uint8], camera: Camera, telemetry: Telemetry) -> Fix | NoFix:
        """Where `grey` (H, W) was taken, once views agree; until then what is missing.

        Raises `StorageError` where the sheets cannot be fetched.
        """
        recipe = self._lookup.recipe
        refused = check_telemetry(telemetry, camera, recipe.gsd_m, self._heading_known)
        refused = refused or check_view(grey)
        if refused is not None:
            return refused
        view = _rectified(grey, camera, telemetry, recipe.gsd_m)
        refused = check_footprint(view, 1.0, MIN_VIEW_PX)
        if refused is not None:
            return refused
        side_m = math.sqrt(float(view.valid.sum())) * recipe.gsd_m
        least, most = (share * recipe.tile_m for share in VIEW_TILES)
        if not least <= side_m <= most:
            return NoFix(
                "wrong_scale",
                f"view is {side_m:.0f} m wide; the coarse tiles of this atlas are for views of "
                f"{least:.0f} to {most:.0f} m",
            )
        return self._placed(ViewOnGround(grey, camera, telemetry), view, side_m)

    def _placed(self, view: ViewOnGround, coarse: Rectified, side_m: float) -> Fix | NoFix:
        time_ns = view.telemetry.time_ns
        expected = self._expected(view, time_ns)
        local_m2 = sum(math.pi * place.reach_m**2 for place in expected)
        sightings = [self._ground.register(view, place) for place in expected]
        searched_m2 = local_m2
        if not self._is_sure():
            places = self._candidates(view, coarse)
            searched_m2 += sum(math.pi * place.reach_m**2 for place in places)
            sightings += [self._ground.register(view, place) for place in places]
        found = _distinct([each for each in sightings if each is not None], side_m)
        seen = [
            Seen(one.lat_deg, one.lon_deg, one.turn_rad, one.log_scale, odds, key)
            for key, one in enumerate(found)
            if (odds := self._log_odds(key, found)) is not None
        ]
        chance = local_m2 / searched_m2 if searched_m2 else 1.0
        if self._is_sure():
            chance = 0.0  # nothing else was looked at; its own odds are against chance
        self._agreement.see(seen, time_ns, side_m, chance)
        return self._outcome(found, view)

    def _is_sure(self) -> bool:
        best = self._agreement.best
        return (
            best is not None
            and self._agreement.agreed
            and best.views >= SURE_VIEWS
            and self._agreement.probability >= SURE
        )

    def _expected(self, view: ViewOnGround, time_ns: int) -> list[Place]:
        """Where hypotheses expect the view."""
        found = []
        for each in self._agreement.hypotheses[:FOLLOWED]:
            lat, lon = each.expected(time_ns)
            turn, std = each.last.turn_rad, each.turn_std_rad(time_ns)
            if self._heading_known:
                turn, std = math.radians(view.telemetry.yaw_deg), self._yaw_std_rad(view.telemetry)
            reach_m = each.reach_m(time_ns)
            found.append(Place(lat, lon, turn, each.last.log_scale, reach_m, std))
        return found

    def _yaw_std_rad(self, telemetry: Telemetry) -> float:
        told = telemetry.yaw_std_deg
        usable = told is not None and math.isfinite(told)
        return math.radians(told if usable and told is not None else DEFAULT_YAW_STD_DEG)

    def _candidates(self, view: ViewOnGround, coarse: Rectified) -> list[Place]:
        """Places of the whole atlas that are like the view."""
        headings = np.arange(0.0, 360.0, TURN_STEP_DEG)
        if self._heading_known:
            reach = KNOWN_SIGMAS * math.degrees(self._yaw_std_rad(view.telemetry))
            steps = math.floor(min(180.0, reach) / TURN_STEP_DEG + 0.5)
            headings = view.telemetry.yaw_deg + TURN_STEP_DEG * np.arange(-steps, steps + 1)
        poses = [(math.radians(turn), scale) for turn in headings.tolist() for scale in LOG_SCALES]
        recipe = self._lookup.recipe
        reach_m = REACH_STRIDES * recipe.tile_m * (1 - recipe.overlap)
        return [
            _camera_place(each, coarse, reach_m)
            for each in self._lookup.candidates(coarse, poses, CANDIDATES)
        ]

    def _log_odds(self, key: int, found: Sequence[Sighting]) -> float | None:
        """Log odds of one of the places of a view against all the others, best first."""
        one = found[key]
        _, sheet = self._ground.at(one.lat_deg, one.lon_deg)
        if sheet is None:
            return None
        rivals = [each.evidence for place, each in enumerate(found) if place != key]
        evidence = _against(one.evidence, rivals)
        confidence = sheet.confidence or USUAL_CONFIDENCE
        likely = min(max(confidence(evidence), LEAST), 1 - LEAST)
        return math.log(likely / (1 - likely))

    def _outcome(self, found: Sequence[Sighting], view: ViewOnGround) -> Fix | NoFix:
        best = self._agreement.best
        if best is None:
            return NoFix("no_match", "no place of the atlas could be compared with the view")
        probability = self._agreement.probability
        if not self._agreement.agreed:
            return NoFix(
                "searching",
                f"{len(self._agreement.hypotheses)} places are possible; the likeliest is held by "
                f"{best.views:.1f} views",
            )
        return _fix(found[best.last.key], best, probability, view, self._radius_m(best))

    def _radius_m(self, best: Hypothesis) -> float:
        _, sheet = self._ground.at(best.last.lat_deg, best.last.lon_deg)
        if sheet is None:
            raise AtlasError("a sheet that was just used is gone")
        return sheet.radius_m


def _rectified(
    grey: NDArray[np.uint8], camera: Camera, telemetry: Telemetry, gsd_m: float
) -> Rectified:
    """The view at the resolution of the coarse tiles, its own heading up."""
    return rectify_footprint(
        prepare_view(grey, camera, telemetry.agl_m, gsd_m),
        pitch_deg=telemetry.pitch_deg,
        roll_deg=telemetry.roll_deg,
        agl_m=telemetry.agl_m,
        gsd_m=gsd_m,
        multiple_px=1,
    )


def _camera_place(candidate: Candidate, view: Rectified, reach_m: float) -> Place:
    """Where the camera is if the middle of the view lies where a candidate says."""
    cos, sin = math.cos(candidate.turn_rad), math.sin(candidate.turn_rad)
    ahead = view.offset_en_m * math.exp(candidate.log_scale)
    east = cos * ahead[0] + sin * ahead[1]
    north = cos * ahead[1] - sin * ahead[0]
    frame = LocalFrame(candidate.lat_deg, candidate.lon_deg)
    lat, lon = frame.latlon_from_en(np.array([-east, -north]))
    return Place(
        float(lat), float(lon), candidate.turn_rad, candidate.log_scale, reach_m, TURN_STD_RAD
    )


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
    """The evidence of a place with the best elsewhere in the whole atlas as its rival."""
    made = dict(evidence)
    for rival, value in (("rival", "strength"), ("look_rival", "look"), ("fine_rival", "fine")):
        others = [each[value] for each in rivals if math.isfinite(each[value])]
        made[rival] = max([made[rival], *others]) if math.isfinite(made[rival]) else made[rival]
    return made


def _fix(
    one: Sighting, best: Hypothesis, probability: float, view: ViewOnGround, radius_m: float
) -> Fix:
    covariance = np.array(one.covariance[:2, :2])
    lean_std_deg = view.telemetry.lean_std_deg
    if lean_std_deg is not None:
        covariance += np.eye(2) * (view.telemetry.agl_m * math.radians(lean_std_deg)) ** 2
    covariance.flags.writeable = False
    evidence = {**one.evidence, "views": best.views, "log_odds": best.log_odds}
    return Fix(
        lat_deg=one.lat_deg,
        lon_deg=one.lon_deg,
        cov_en_m2=covariance,
        confidence=min(probability, MAX_CONFIDENCE),
        radius_m=radius_m,
        heading_deg=math.degrees(one.turn_rad) % 360,
        agl_m=view.telemetry.agl_m * math.exp(one.log_scale),
        evidence=MappingProxyType(evidence),
    )
