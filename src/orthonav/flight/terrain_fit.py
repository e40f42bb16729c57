"""Whether a terrain fits the views of a flight; a fault of it is named once."""

import logging
import math

import numpy as np

from orthonav.geo.ground import TerrainHeights
from orthonav.records import Fix

MIN_VIEWS = 20
"""Fewer confident views say nothing about the terrain."""
OFF_M = 25.0
"""Heights by the views and by the terrain that differ by more on the whole are named: barometers
explain less, a wrong datum more."""
SPREAD_M, SPREAD_SHARE = 3.0, 0.02
"""So is a difference whose robust standard deviation is more, in metres and as a share of the
height above ground: by a right terrain it was 1.3 %, by one displaced by 200 m 2 to 3 %
(`python -m benchmarks.terrain_flight`)."""
HOLES_SHARE = 0.1
"""So are holes below more than this share of the confident views."""
log = logging.getLogger(__name__)


class TerrainFit:
    """Compares heights above sea by confident views with those reported. Mutable."""

    def __init__(self, terrain: TerrainHeights) -> None:
        self._terrain = terrain
        self._off_m: list[float] = []
        self._agl_m: list[float] = []
        self._holes = 0
        self._said: set[str] = set()

    def take(self, fix: Fix, above_sea_m: float) -> None:
        """A confident fix of a view that reported this height above sea."""
        below_m = float(self._terrain(np.array([fix.lat_deg]), np.array([fix.lon_deg]))[0])
        if math.isfinite(below_m):
            self._off_m.append(below_m + fix.agl_m - above_sea_m)
            self._agl_m.append(fix.agl_m)
        else:
            self._holes += 1
        views = len(self._off_m) + self._holes
        if views < MIN_VIEWS or views % MIN_VIEWS:
            return
        if self._holes > HOLES_SHARE * views:
            self._say("holes", "the terrain has no height below %d of %d views", self._holes, views)
        if len(self._off_m) >= MIN_VIEWS:
            self._judge()

    def _judge(self) -> None:
        off = np.array(self._off_m)
        middle_m = float(np.median(off))
        spread_m = 1.4826 * float(np.median(np.abs(off - middle_m)))
        log.debug("heights by views less reported ones: %.1f m +- %.1f m", middle_m, spread_m)
        if abs(middle_m) > OFF_M:
            self._say(
                "datum",
                "by the views the aircraft is %.0f m %s than reported over this terrain: check its "
                "vertical datum, the place of take-off and the altitude of the autopilot",
                abs(middle_m),
                "higher" if middle_m > 0 else "lower",
            )
        if spread_m > max(SPREAD_M, SPREAD_SHARE * float(np.median(self._agl_m))):
            self._say(
                "place",
                "heights by the views scatter by %.0f m about those reported over this terrain: it "
                "may be displaced, or not show this ground",
                spread_m,
            )

    def _say(self, kind: str, said: str, *values: object) -> None:
        if kind not in self._said:
            self._said.add(kind)
            log.warning(said, *values)
