"""Placing the views of a flight in an atlas without any prior position.

Views are searched in the whole atlas until several agree on a place (`orthonav.ground.atlas.find`).
From there on the aircraft is tracked on a map cut around it, in memory. Before the aircraft can
reach its border, another one is cut around the place where it is expected, and the track continues
there. A view that the track does not recognize is searched in the whole atlas too: where several of
them agree on a place, another track begins there.
"""

import logging
import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from orthonav.core.errors import AreaError, AtlasError
from orthonav.core.geo.frames import LocalFrame, distances_m
from orthonav.core.localize import Localizer
from orthonav.core.localize.confidence import USUAL_CONFIDENCE
from orthonav.core.records import Fix, NoFix, Prior, Telemetry, View
from orthonav.core.track import Model, State
from orthonav.core.track.mixture import MOST_SIGHTED
from orthonav.core.track.tracker import Tracker
from orthonav.ground.atlas.agreement import AGILE_MPS, MAX_REACH_M, MAX_SPEED_MPS
from orthonav.ground.atlas.catalog import Atlas
from orthonav.ground.atlas.cut import cut_in_memory
from orthonav.ground.atlas.find import FoundPlace, PlaceFinder
from orthonav.ground.atlas.sheet_registration import SheetRegistrar
from orthonav.ground.atlas.tile_search import TileSearch
from orthonav.ground.planning.area import Area

log = logging.getLogger(__name__)

SIGMAS = 3.0
"""Standard deviations of a position within which the aircraft is."""
AHEAD_M = 1000.0
"""A map reaches so much farther than the next view can: fewer maps are cut."""
LIKELY = 0.5
"""Least confidence of a fix."""
MODEL = Model(wide_m=MAX_REACH_M / SIGMAS, most_agreement=1.0)
"""Views of a flight without a prior may be far apart in time: their positions are never predicted
well. So each must show the map by itself, however well it agrees with the prediction, and a wide
prediction is no reason to confirm the track again (docs/decisions/atlas.md)."""


class LocalTrack:
    """The track of one aircraft from a found place on. Mutable; not to be shared between threads.

    `fix`: the position at the last view, None where that view does not show the map there.
    """

    def __init__(self, atlas: Atlas, found: FoundPlace, *, heading_known: bool) -> None:
        """Begin with the views on which the place was found. Raises as `cut_in_memory`."""
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
                    replace(each, sighted=MOST_SIGHTED) for each in mixture.hypotheses
                ]
        self._take(seen, last, found.confidence)
        here = [(self._last.lat_deg, self._last.lon_deg)]
        off_m = distances_m(here, [places[-1]])[0]
        self.agrees = bool(off_m <= self._last.radius_m)

    @property
    def state(self) -> State:
        """State after the last view."""
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
        """The same for a view whose picture cannot be used for `reason`."""
        if not self._can_follow(telemetry, 0.0):
            return False
        self._take(self._tracker.passed(telemetry, reason), telemetry)
        return True

    def _take(self, seen: Fix | NoFix, telemetry: Telemetry, most: float = 1.0) -> None:
        """Keep the estimate of the tracker; it is a fix with a confidence of `most`, and of what
        the view itself says of the place."""
        assert isinstance(seen, Fix)  # a track with a start always has an estimate
        self._time_ns, self._last = telemetry.time_ns, seen
        confidence = min(seen.confidence, seen.evidence["recognized"], most)
        self.fix = replace(seen, confidence=confidence) if confidence >= LIKELY else None

    def _can_follow(self, telemetry: Telemetry, half_view_m: float) -> bool:
        """Whether the aircraft is near enough to the expected place to be sought there.

        A view that may reach beyond the map gets another one.
        """
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
        """A map around a place that shows all within reach, and its area."""
        half_m = reach_m + AHEAD_M
        area = Area(middle, (-half_m, -half_m, half_m, half_m))
        localizer = Localizer(cut_in_memory(self._atlas, area))
        if localizer.registration is not None and localizer.registration.confidence is None:
            localizer.registration.confidence = USUAL_CONFIDENCE
        return area, localizer


class AtlasLocator:
    """Places the views of one flight. Mutable; not to be shared between threads."""

    def __init__(
        self, registrar: SheetRegistrar, search: TileSearch, *, heading_known: bool = False
    ) -> None:
        """Raises `AtlasError` where no maps can be cut out of the atlas."""
        self._atlas = registrar.atlas
        recipe = self._atlas.recipe
        if recipe.method.partition(":")[0] != "gradient" or not recipe.registration:
            raise AtlasError(
                "an aircraft is tracked on maps that are cut out of the atlas; that needs the "
                f"method gradient and registration layers: {self._atlas.url}"
            )
        self._heading_known = heading_known
        self._finder = PlaceFinder(registrar, search, heading_known=heading_known)
        self._track: LocalTrack | None = None
        self._state = State.SEARCHING

    @property
    def state_name(self) -> str | None:
        """That of the track: `searching` before there is one, `lost` after it has ended."""
        return self._state.value

    def passed(self, telemetry: Telemetry, reason: NoFix) -> Fix | NoFix:
        """The outcome of a view that cannot be used: `reason`."""
        self._follow(lambda track: track.passed(telemetry, reason))
        return self._outcome(reason)

    def locate(self, view: View) -> Fix | NoFix:
        """Where a view was taken, once views agree; until then the reason why not.

        Raises `CameraError` where the image is not of the camera's size, `StorageError` where
        sheets cannot be fetched.
        """
        self._follow(lambda track: track.locate(view))
        if self._track is not None and self._track.fix is not None:
            self._finder.restart()
            return self._outcome()
        found = self._finder.find(view)
        if isinstance(found, NoFix):
            return self._outcome(found)
        self._begin(found)
        return self._outcome()

    def _follow(self, take_in: Callable[[LocalTrack], bool]) -> None:
        """Let the track, if there is one, take in a view; forget a track that has ended."""
        if self._track is None:
            return
        try:
            if not take_in(self._track):
                self._track = None
        except (AreaError, AtlasError) as error:
            log.warning("no map can be cut where the aircraft is expected: %s", error)
            self._track = None

    def _begin(self, found: FoundPlace) -> None:
        """Begin another track at a place, where its views agree on it on a map cut there too."""
        try:
            begun = LocalTrack(self._atlas, found, heading_known=self._heading_known)
        except (AreaError, AtlasError) as error:
            log.warning("no map can be cut around the place found: %s", error)
            return
        if begun.agrees:
            self._track = begun

    def _outcome(self, reason: NoFix | None = None) -> Fix | NoFix:
        """The fix of the track, or why there is none."""
        if self._track is not None:
            self._state = self._track.state
        elif self._state is not State.SEARCHING:
            self._state = State.LOST
        fix = None if self._track is None else self._track.fix
        unconfirmed = NoFix("searching", "the last view does not confirm the place found")
        return fix or reason or unconfirmed


def _half_diagonal_m(view: View) -> float:
    """Half of the diagonal of the ground that a view shows from straight above."""
    return view.telemetry.agl_m * math.hypot(*view.camera.extent) / 2
