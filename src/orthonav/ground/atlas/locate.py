"""Positions of the views of a flight in an atlas, without a prior position.

Each view is sought among the coarse tiles of the whole atlas. The sheets with the most similar ones
are opened as maps, and a tracker begins on each: the ordinary one, which knows that the aircraft
may be anywhere in the atlas. All of them take in every view and compete: one that has confirmed a
place by several views has a fix unless another recognizes the views elsewhere. Once the others are
unlikely it continues alone, from sheet to sheet. A view that it does not recognize is sought in the
whole atlas too."""

import logging
import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import lru_cache, partial

import numpy as np

from orthonav.core.errors import AtlasError, MapFileError
from orthonav.core.geo.frames import LocalFrame, distances_m
from orthonav.core.localize import Localizer
from orthonav.core.localize.confidence import DEFAULT_CONFIDENCE
from orthonav.core.localize.plan import DEFAULT_PLAN
from orthonav.core.localize.view import (
    LIMITS,
    RectifiedView,
    check_footprint,
    check_view,
    downsampled,
    pose_prior,
    rectify_footprint,
)
from orthonav.core.mapfile import open_map
from orthonav.core.records import CONFIDENT, Fix, NoFix, Telemetry, View
from orthonav.core.register.search import rated_directions
from orthonav.core.tiles import represent
from orthonav.core.tiles.bank import embed_directions
from orthonav.core.track import Model, State
from orthonav.core.track.tracker import Tracker
from orthonav.core.variants import make_variant
from orthonav.ground.atlas.catalog import Atlas
from orthonav.ground.atlas.coarse import EDGES
from orthonav.ground.atlas.index import (
    LEARNT,
    half_whitened,
    index_file,
    load_learnt,
    read_manifest,
    stale_sheets,
)
from orthonav.ground.atlas.vectors import NONE, ShardedIndex

log = logging.getLogger(__name__)

MAX_REACH_M = 5_000.0  # a track whose aircraft may be farther from where it is expected ends
SIGMAS = 3.0  # standard deviations of a position within which the aircraft is
MODEL = Model(wide_m=MAX_REACH_M / SIGMAS, most_agreement=1.0)
"""Views of a flight without a prior may be far apart in time: their positions are never predicted
well. So each must show the map by itself, however well it agrees with the prediction, and a wide
prediction is no reason to confirm the track again (docs/atlas.md)."""
MIN_CONFIDENCE = 0.5  # of a fix, by the view alone too
MAX_UNSEEN = 2  # views in a row without which a place still rules out a fix at another one
MAX_TRACKS = 3  # the least likely are dropped
MAX_NEW_TRACKS = 2  # at a view: opening and searching a sheet takes a second


EFFORTS = (
    (10**6, 0.4, 300),
    (3 * 10**7, 0.25, 800),
    (math.inf, 0.085, 1500),
)
"""Greatest number of tiles, fraction of the lists scanned, tiles compared by their stored vectors:
finds 98 % of the tiles that exact search finds among 10^7, 95 % among 10^8
(`benchmarks.atlas_search` at d63ac91)."""


class SheetSearch:
    """The index of an atlas with its shards mapped. Not to be shared between threads."""

    def __init__(self, atlas: Atlas) -> None:
        """Warns of sheets that are not in the index. Raises `AtlasError` without an index."""
        manifest = read_manifest(atlas)
        if manifest is None:
            raise AtlasError(
                f"the atlas has no index: make it with 'orthonav atlas index': {atlas.url}"
            )
        self.atlas = atlas
        self.recipe = atlas.recipe.coarse
        if new := stale_sheets(atlas, manifest)[0]:
            log.warning(
                "%d sheets are missing from the index and are not searched; update it with "
                "'orthonav atlas index'",
                len(new),
            )
        file = partial(index_file, atlas, manifest)
        self._policy = DEFAULT_PLAN
        self._embedder, quantizers = load_learnt(file(LEARNT), manifest.recipe)
        self._representation = make_variant(represent.TABLE, EDGES)
        self._index = ShardedIndex(file, manifest.shards, quantizers)
        share, rerank = next(effort for most, *effort in EFFORTS if len(self._index) <= most)
        self._probes = max(1, round(share * manifest.recipe.lists))
        self._rerank = int(rerank)

    def sheets(self, view: View, heading_known: bool) -> list[str] | NoFix:
        """Names of the sheets with the tiles most similar to a view, best first, or why it cannot
        be searched."""
        refused = check_view(view, self.recipe.gsd_m, heading_known)
        if refused is not None:
            return refused
        coarse = self._rectified(view)
        if isinstance(coarse, NoFix):
            return coarse
        prior = pose_prior(view.telemetry, heading_known, view.camera.focal_std)
        plan = self._policy
        poses = [
            direction
            for direction, _ in rated_directions(
                prior, plan.coarse_steps, plan.bank_sigmas, plan.likely_penalty
            )
        ]
        embedded = embed_directions(
            *(self._embedder, self._representation, coarse.grey, coarse.valid, poses),
            self.recipe.tile_px,
        )
        queries = half_whitened(self._embedder, embedded)
        scores, ids = self._index.search(queries, 20, self._probes, self._rerank)
        best_first = ids.ravel()[np.argsort(-scores, axis=None, kind="stable")]
        found = self._index.sheets_of(best_first[best_first != NONE])
        there = self.atlas.sheets()
        return [name for name in dict.fromkeys(found) if name in there]

    def _rectified(self, view: View) -> RectifiedView | NoFix:
        """At the resolution of the coarse tiles; `NoFix` unless about as wide as one."""
        gsd_m, tile_m = self.recipe.gsd_m, self.recipe.tile_m
        coarse = rectify_footprint(downsampled(view, gsd_m), gsd_m=gsd_m, multiple_px=1)
        side_m = math.sqrt(float(coarse.valid.sum())) * gsd_m
        least, most = (share * tile_m for share in self._policy.view_tiles)
        if least <= side_m <= most:
            return check_footprint(coarse, 1.0, LIMITS.min_view_px) or coarse
        return NoFix(
            "wrong_scale",
            f"view is {side_m:.0f} m wide; the coarse tiles of this atlas are for views of "
            f"{least:.0f} to {most:.0f} m",
        )


class SheetMaps:
    """The sheets of an atlas as opened maps; those used last stay open."""

    def __init__(self, atlas: Atlas) -> None:
        self._atlas, sheets = atlas, atlas.sheets()
        self.area_m2 = 1e6 * sum(each.area_km2 for each in sheets.values())
        self.open = lru_cache(maxsize=4)(self._opened)

    def name_at(self, lat_deg: float, lon_deg: float) -> str:
        return self._atlas.recipe.sheets.name_at(lat_deg, lon_deg)

    def _opened(self, name: str) -> Localizer | None:
        """None where there is no such sheet, or it cannot be used. Raises `StorageError` where it
        cannot be fetched."""
        sheet = self._atlas.sheets().get(name)
        if sheet is None:
            return None
        path = self._atlas.path(sheet)
        try:
            localizer = Localizer(open_map(path))
            if localizer.registration is None:
                raise MapFileError(f"map has no registration layer: {path}")
        except (AtlasError, MapFileError) as error:
            log.warning("sheet %s cannot be used: %s", name, error)
            return None
        if localizer.registration.confidence is None:
            localizer.registration.confidence = DEFAULT_CONFIDENCE
        return localizer


class SheetTrack:
    """One track, on the sheet where the aircraft is expected. Mutable.

    `fix`: at the last view; None unless the track is confirmed and that view shows the map there.
    `unseen`: views in a row, up to now, in which it did not recognize the map. `has_ended`: lost at
    two views in a row, or the aircraft may be too far away."""

    def __init__(self, maps: SheetMaps, sheet: str, localizer: Localizer, first: View, **how: bool):
        self.sheet, self._maps = sheet, maps
        scale = math.hypot(MODEL.log_scale, first.camera.focal_std)
        model = replace(MODEL.at_height(first.telemetry.agl_m), log_scale=scale)
        self._tracker = Tracker(
            localizer, model=model, use_prior=False, area_m2=maps.area_m2, **how
        )
        self._last: tuple[Fix, int] | None = None
        self.fix: Fix | None = None
        self.unseen = MAX_UNSEEN
        self.has_ended = False

    @property
    def state(self) -> State:
        return self._tracker.state

    @property
    def odds(self) -> float:
        """That the aircraft is at any of the places of this track."""
        elsewhere = max(self._tracker.mixture.elsewhere, 1e-9)
        return (1 - elsewhere) / elsewhere

    def is_elsewhere(self, fix: Fix) -> bool:
        """Whether the aircraft cannot be both at a fix and at the likeliest place of this track."""
        if self._last is None:
            return True
        here = self._last[0]
        off_m = distances_m([(here.lat_deg, here.lon_deg)], [(fix.lat_deg, fix.lon_deg)])[0]
        near_m = here.radius_m + fix.radius_m + SIGMAS * math.hypot(here.std_m, fix.std_m)
        return bool(off_m > near_m)

    def locate(self, view: View) -> None:
        was_lost = self.state is State.LOST
        if self._ends(view.telemetry.time_ns):
            return
        seen = self._tracker.locate(view)
        self._take(seen, view.telemetry)
        is_seen = isinstance(seen, Fix) and seen.recognized >= MIN_CONFIDENCE
        self.unseen = 0 if is_seen else self.unseen + 1
        self.has_ended = was_lost and self.state is State.LOST

    def passed(self, telemetry: Telemetry, reason: NoFix) -> None:
        if not self._ends(telemetry.time_ns):
            self._take(self._tracker.passed(telemetry, reason), telemetry)

    def _ends(self, time_ns: int) -> bool:
        """True where the aircraft may be too far from where it is expected by now. Else the track
        continues on the sheet there, if there is one."""
        if self._last is None:
            return False
        fix, before_ns = self._last
        seconds = max((time_ns - before_ns) / 1e9, 0.0)
        known = fix.known_velocity_en_mps
        velocity = np.array(known or (0.0, 0.0))
        # It may change by half and by 10 m/s. One less certain than that is unknown.
        fastest_mps = 120.0  # beyond the aircraft that this program is for
        speed_mps = min(float(np.hypot(*velocity)) / 2 + 10.0, fastest_mps)
        if known is None or not fix.vel_std_mps <= 10.0:
            velocity, speed_mps = np.zeros(2), fastest_mps
        self.has_ended = SIGMAS * fix.std_m + speed_mps * seconds > MAX_REACH_M
        if not self.has_ended:
            lat, lon = LocalFrame(fix.lat_deg, fix.lon_deg).latlon_from_en(velocity * seconds)
            name = self._maps.name_at(float(lat), float(lon))
            if name != self.sheet and (localizer := self._maps.open(name)) is not None:
                self._tracker.continue_on(localizer)
                self.sheet = name
        return self.has_ended

    def _take(self, seen: Fix | NoFix, telemetry: Telemetry) -> None:
        self.fix = None
        if isinstance(seen, NoFix):
            return
        self._last = seen, telemetry.time_ns
        fix = _limited(seen, seen.recognized if math.isfinite(seen.recognized) else 0.0)
        if self.state is State.TRACKING and fix.confidence >= MIN_CONFIDENCE:
            self.fix = fix


class AtlasLocator:
    """Places the views of one flight, one after another. Not to be shared between threads."""

    def __init__(self, search: SheetSearch, *, heading_known: bool = False) -> None:
        self._search, self._heading_known = search, heading_known
        self._maps = SheetMaps(search.atlas)
        self._tracks: list[SheetTrack] = []  # the likeliest first
        self._believed: SheetTrack | None = None  # the one whose fix was published last
        self._state = State.SEARCHING

    @property
    def state_name(self) -> str:
        return self._state.value

    def locate(self, view: View) -> Fix | NoFix:
        self._tracks = _followed(self._tracks, lambda track: track.locate(view))
        best, reason = self._best(), None
        if best is None or best[0] is not self._believed:
            reason = self._begin(view)
        return self._outcome(reason)

    def passed(self, telemetry: Telemetry, reason: NoFix) -> Fix | NoFix:
        self._tracks = _followed(self._tracks, lambda track: track.passed(telemetry, reason))
        return self._outcome(reason)

    def _begin(self, view: View) -> NoFix | None:
        """Begin tracks on the sheets that a view may show; `NoFix` where it cannot be searched."""
        sheets = self._search.sheets(view, self._heading_known)
        if isinstance(sheets, NoFix):
            return sheets
        taken = (each for each in self._tracks if each.fix or each.state is State.SEARCHING)
        searched = {each.sheet for each in taken}
        begun = [
            SheetTrack(self._maps, name, localizer, view, heading_known=self._heading_known)
            for name in [name for name in sheets if name not in searched][:MAX_NEW_TRACKS]
            if (localizer := self._maps.open(name)) is not None
        ]
        begun = _followed(begun, lambda track: track.locate(view))
        self._tracks = _likeliest([*self._tracks, *begun])
        return None

    def _best(self) -> tuple[SheetTrack, Fix, float] | None:
        """The likeliest track with a fix, that fix, and the probability of its place among all
        tracks; None where another recognized a view elsewhere lately."""
        fixed = [(each.odds, each, each.fix) for each in self._tracks if each.fix is not None]
        if not fixed:
            return None
        odds, best, fix = max(fixed, key=lambda each: each[0])
        rivals = [each for each in self._tracks if each.is_elsewhere(fix)]
        if any(each.unseen < MAX_UNSEEN for each in rivals):
            return None
        most = odds / (1 + odds + sum(each.odds for each in rivals))
        return best, _limited(fix, most), most

    def _published(self) -> Fix | None:
        """The fix of the best track. Once it is confident the others end."""
        found = self._best()
        if found is None or found[1].confidence < MIN_CONFIDENCE:
            return None
        self._believed, fix, most = found
        if most >= CONFIDENT:
            self._tracks = [self._believed]
        return fix

    def _outcome(self, reason: NoFix | None = None) -> Fix | NoFix:
        fix = self._published()
        if fix is not None:
            self._state = State.TRACKING
        elif self._state is not State.SEARCHING:
            is_followed = any(each.state.is_followed for each in self._tracks)
            self._state = State.COASTING if is_followed else State.LOST
        text = f"no place is confirmed by several views; {len(self._tracks)} sheets are possible"
        return fix or reason or NoFix("searching", text)


def _limited(fix: Fix, most: float) -> Fix:
    confidence, place = min(fix.confidence, most), min(fix.place_probability, most)
    return replace(fix, confidence=confidence, place_probability=place)


def _followed(
    tracks: Sequence[SheetTrack], take_in: Callable[[SheetTrack], None]
) -> list[SheetTrack]:
    """Those that have not ended after a view."""
    left = []
    for each in tracks:
        try:
            take_in(each)
        except MapFileError as error:
            log.warning("sheet %s cannot be used: %s", each.sheet, error)
            continue
        if not each.has_ended:
            left.append(each)
    return left


def _likeliest(tracks: Sequence[SheetTrack]) -> list[SheetTrack]:
    """At most `MAX_TRACKS`, and on each sheet one that was never confirmed."""
    ordered = sorted(tracks, key=lambda each: -each.odds)
    searching = [each for each in ordered if each.state is State.SEARCHING]
    best = {each.sheet: each for each in reversed(searching)}
    left = [each for each in ordered if each not in searching or best[each.sheet] is each]
    return left[:MAX_TRACKS]
