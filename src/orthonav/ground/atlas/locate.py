"""Positions of the views of a flight in an atlas, without a prior position.

Each view is sought among the coarse tiles of the whole atlas. The sheets with the most similar ones
are opened as maps, and a tracker begins on each: the ordinary one, which knows that the aircraft
may be anywhere in the atlas. One that has confirmed a place by several views continues alone, from
sheet to sheet. A view that it does not recognize is sought in the whole atlas too."""

import logging
import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import lru_cache

import numpy as np

from orthonav.core.errors import AtlasError, MapFileError, StorageError
from orthonav.core.geo.frames import LocalFrame
from orthonav.core.localize import Localizer
from orthonav.core.localize.confidence import DEFAULT_CONFIDENCE
from orthonav.core.mapfile import open_map
from orthonav.core.records import Fix, NoFix, Telemetry, View
from orthonav.core.track import Model, State
from orthonav.core.track.tracker import Tracker
from orthonav.ground.atlas.catalog import Atlas
from orthonav.ground.atlas.search import SheetSearch

log = logging.getLogger(__name__)

MODEL = Model(wide_m=1700.0, most_agreement=1.0)
"""Views of a flight without a prior may be far apart in time: their positions are never predicted
well. So each must show the map by itself, however well it agrees with the prediction, and a wide
prediction is no reason to confirm the track again (docs/atlas.md)."""
MIN_CONFIDENCE = 0.5  # of a fix, by the view alone too
MAX_TRACKS = 3  # the least likely are dropped
MAX_NEW_TRACKS = 2  # at a view: opening and searching a sheet takes a second


class SheetMaps:
    """The sheets of an atlas as opened maps; those used last stay open."""

    def __init__(self, atlas: Atlas) -> None:
        self._atlas, sheets = atlas, atlas.sheets()
        self.area_m2 = 1e6 * sum(each.area_km2 for each in sheets.values())
        self.open = lru_cache(maxsize=4)(self._opened)

    def name_at(self, lat_deg: float, lon_deg: float) -> str:
        return self._atlas.recipe.sheets.name_at(lat_deg, lon_deg)

    def _opened(self, name: str) -> Localizer | None:
        """None where there is no such sheet, or it cannot be used."""
        sheet = self._atlas.sheets().get(name)
        if sheet is None:
            return None
        try:
            localizer = Localizer(open_map(self._atlas.path(sheet)))
        except (AtlasError, MapFileError, StorageError) as error:
            log.warning("sheet %s cannot be used: %s", name, error)
            return None
        if localizer.registration is not None and localizer.registration.confidence is None:
            localizer.registration.confidence = DEFAULT_CONFIDENCE
        return localizer


class SheetTrack:
    """One track, on the sheet where the aircraft is expected. Mutable.

    `fix`: at the last view; None unless the track is confirmed and that view shows the map there.
    `has_ended`: lost at two views in a row."""

    def __init__(self, maps: SheetMaps, sheet: str, localizer: Localizer, first: View, **how: bool):
        self.sheet, self._maps = sheet, maps
        scale = math.hypot(MODEL.log_scale, first.camera.focal_std)
        model = replace(MODEL.at_height(first.telemetry.agl_m), log_scale=scale)
        self._tracker = Tracker(
            localizer, model=model, use_prior=False, area_m2=maps.area_m2, **how
        )
        self._last: tuple[Fix, int] | None = None
        self.fix: Fix | None = None
        self.has_ended = False

    @property
    def state(self) -> State:
        return self._tracker.state

    @property
    def belief(self) -> float:
        """Probability that the aircraft is at any of the places of this track."""
        return 1 - self._tracker.mixture.elsewhere

    def locate(self, view: View) -> None:
        was_lost = self.state is State.LOST
        self._change_sheet(view.telemetry.time_ns)
        self._take(self._tracker.locate(view), view.telemetry)
        self.has_ended = was_lost and self.state is State.LOST

    def passed(self, telemetry: Telemetry, reason: NoFix) -> None:
        self._take(self._tracker.passed(telemetry, reason), telemetry)

    def _change_sheet(self, time_ns: int) -> None:
        """Continue on the sheet where the aircraft is expected by now, if there is one."""
        if self._last is None:
            return
        fix, before_ns = self._last
        velocity = np.array([fix.evidence["vel_east_mps"], fix.evidence["vel_north_mps"]])
        moved_m = velocity * min(max((time_ns - before_ns) / 1e9, 0.0), 600.0)
        lat, lon = LocalFrame(fix.lat_deg, fix.lon_deg).latlon_from_en(moved_m)
        name = self._maps.name_at(float(lat), float(lon))
        if name != self.sheet and (localizer := self._maps.open(name)) is not None:
            self._tracker.continue_on(localizer)
            self.sheet = name

    def _take(self, seen: Fix | NoFix, telemetry: Telemetry) -> None:
        self.fix = None
        if isinstance(seen, NoFix):
            return
        self._last = seen, telemetry.time_ns
        most = seen.evidence["recognized"]
        confidence, place = min(seen.confidence, most), min(seen.place_probability, most)
        if self.state is State.TRACKING and confidence >= MIN_CONFIDENCE:
            self.fix = replace(seen, confidence=confidence, place_probability=place)


class AtlasLocator:
    """Places the views of one flight, one after another. Not to be shared between threads."""

    def __init__(self, search: SheetSearch, *, heading_known: bool = False) -> None:
        self._search, self._heading_known = search, heading_known
        self._maps = SheetMaps(search.atlas)
        self._tracks: list[SheetTrack] = []  # the likeliest first
        self._state = State.SEARCHING

    @property
    def state_name(self) -> str:
        return self._state.value

    def locate(self, view: View) -> Fix | NoFix:
        self._follow(lambda track: track.locate(view))
        if self._fix is not None:
            return self._outcome()
        sheets = self._search.sheets(view, self._heading_known)
        if isinstance(sheets, NoFix):
            return self._outcome(sheets)
        searched = {each.sheet for each in self._tracks if each.state is State.SEARCHING}
        begun = [
            SheetTrack(self._maps, name, localizer, view, heading_known=self._heading_known)
            for name in [name for name in sheets if name not in searched][:MAX_NEW_TRACKS]
            if (localizer := self._maps.open(name)) is not None
        ]
        before, self._tracks = self._tracks, begun
        self._follow(lambda track: track.locate(view))
        self._tracks = _likeliest([*before, *self._tracks])
        return self._outcome()

    def passed(self, telemetry: Telemetry, reason: NoFix) -> Fix | NoFix:
        self._follow(lambda track: track.passed(telemetry, reason))
        return self._outcome(reason)

    @property
    def _fix(self) -> Fix | None:
        return next((each.fix for each in self._tracks if each.fix is not None), None)

    def _follow(self, take_in: Callable[[SheetTrack], None]) -> None:
        """Where one has a fix all others end."""
        left = []
        for each in self._tracks:
            try:
                take_in(each)
            except MapFileError as error:
                log.warning("sheet %s cannot be used: %s", each.sheet, error)
                continue
            if each.fix is not None:
                left = [each]
                break
            if not each.has_ended:
                left.append(each)
        self._tracks = left

    def _outcome(self, reason: NoFix | None = None) -> Fix | NoFix:
        fix = self._fix
        if fix is not None:
            self._state = State.TRACKING
        elif any(each.state.is_followed for each in self._tracks):
            self._state = State.COASTING
        elif self._state is not State.SEARCHING:
            self._state = State.LOST
        text = f"no place is confirmed by several views; {len(self._tracks)} sheets are possible"
        return fix or reason or NoFix("searching", text)


def _likeliest(tracks: Sequence[SheetTrack]) -> list[SheetTrack]:
    """At most `MAX_TRACKS`, and on each sheet one that was never confirmed."""
    ordered = sorted(tracks, key=lambda each: -each.belief)
    searching = [each for each in ordered if each.state is State.SEARCHING]
    best = {each.sheet: each for each in reversed(searching)}
    left = [each for each in ordered if each not in searching or best[each.sheet] is each]
    return left[:MAX_TRACKS]
