"""A recording whose heights become heights above ground, at its recorded positions."""

import math
from collections.abc import Iterator
from dataclasses import dataclass, field, replace

from orthonav.core.errors import FlightError
from orthonav.core.flight.heights import (
    GroundHeights,
    Undulation,
    assumed_heights,
    is_measured,
    warn_of_mismatch,
)
from orthonav.core.geo.ground import TerrainHeights, ground_around
from orthonav.ground.recordings.recording import Recording, SourceView, rounded


@dataclass(eq=False)
class OverTerrain:
    """Heights above ground of the views of a recording. Mutable: it counts.

    `terrain`: heights above mean sea level. `name`: the terrain in words. `geoid`: None where
    heights above the ellipsoid cannot be used. `without`: number of views without a height above
    ground, because no height or no position was recorded, or because it lies over a hole of the
    terrain or outside it.
    """

    terrain: TerrainHeights
    name: str
    geoid: Undulation | None = None
    without: int = field(default=0, init=False)

    def recording(self, recording: Recording) -> Recording:
        """The same recording with heights above ground; its note says how.

        Raises `FlightError` where no position was recorded.
        """
        first = next((v for v in recording.views if v.truth_latlon_deg is not None), None)
        if first is None or first.truth_latlon_deg is None:
            raise FlightError(
                "--dem needs recorded positions, and the recording has none: import without it, "
                f"and give it to orthonav localize: {recording.path}"
            )
        take_off = ground_around(
            self.terrain, recording.take_off_latlon_deg or first.truth_latlon_deg, 0.0
        )
        heights = GroundHeights(self.terrain, take_off, self.geoid)
        off_m = heights.mismatch_m(first.telemetry)
        if math.isfinite(off_m):
            warn_of_mismatch(off_m)
        assumed = assumed_heights(first.telemetry, self.name)
        note = "; ".join(filter(None, [recording.note, assumed]))
        return replace(recording, stream=lambda: self._views(recording, heights), note=note)

    def _views(self, recording: Recording, heights: GroundHeights) -> Iterator[SourceView]:
        self.without = 0
        for view in recording.views:
            telemetry, place = view.telemetry, view.truth_latlon_deg
            below = None if place is None else ground_around(self.terrain, place, 0.0)
            if below is not None and place is not None:
                telemetry = heights.above(telemetry, below, place)
            if telemetry is view.telemetry and not is_measured(telemetry):
                telemetry = replace(telemetry, agl_m=math.nan)  # level ground is not assumed
            self.without += math.isnan(telemetry.agl_m)
            yield replace(view, telemetry=rounded(telemetry))
