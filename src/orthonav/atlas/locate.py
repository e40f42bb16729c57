"""Placing the views of a flight in an atlas without any prior position.

Views are searched in the whole atlas until several agree on a place (`orthonav.atlas.find`). From
there on the aircraft is tracked on a map cut around it (`orthonav.atlas.local_track`). A view that
the track does not recognize is searched in the whole atlas too: where several of them agree on a
place, another track begins there.
"""

import logging
from collections.abc import Callable

from orthonav.atlas.catalog import Atlas
from orthonav.atlas.find import FoundPlace, PlaceFinder
from orthonav.atlas.local_track import LocalTrack
from orthonav.atlas.sheet_registration import SheetRegistrar
from orthonav.atlas.tile_search import TileSearch
from orthonav.errors import AreaError, AtlasError
from orthonav.records import Fix, NoFix, Telemetry, View
from orthonav.track import State

log = logging.getLogger(__name__)


class AtlasLocator:
    """Places the views of one flight. Mutable; not to be shared between threads."""

    def __init__(
        self, registrar: SheetRegistrar, search: TileSearch, *, heading_known: bool = False
    ) -> None:
        """Raises `AtlasError` where no maps can be cut out of the atlas."""
        self._atlas: Atlas = registrar.atlas
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
