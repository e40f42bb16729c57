"""Whether a terrain fits the views of a flight; a fault of it is named once."""

import logging
from collections import deque

import numpy as np
from numpy.typing import NDArray

from orthonav.core.geo.ground import TerrainHeights
from orthonav.core.records import Fix

MIN_VIEWS = 20
"""Fewer confident views say nothing about the terrain."""
OFF_M = 25.0
"""Heights by the views and by the terrain that differ by more on the whole are named: barometers
explain less, a wrong datum more."""
SPREAD_M, SPREAD_SHARE = 3.0, 0.02
"""So is a difference whose robust standard deviation is more, in metres and as a share of the
height above ground: by a right terrain it was 1.3 %, by one displaced by 200 m 2 to 3 %
(`python -m benchmarks.terrain_flight`)."""
MAX_VIEWS = 2000
"""Only so many of the latest confident views are kept."""
HOLES_SHARE = 0.1
"""So are holes below more than this share of the confident views."""
log = logging.getLogger(__name__)


class TerrainFit:
    """Compares heights above sea by confident views with those reported. Mutable.

    It judges by the latest `MAX_VIEWS` of them, so that long flights cost no more memory and time.
    """

    def __init__(self, terrain: TerrainHeights) -> None:
        self._terrain = terrain
        # Height by the view less the reported one (NaN over a hole), and height above ground.
        self._latest: deque[tuple[float, float]] = deque(maxlen=MAX_VIEWS)
        self._views = 0
        self._said: set[str] = set()

    def take(self, fix: Fix, above_sea_m: float) -> None:
        """A confident fix of a view that reported this height above sea."""
        below_m = float(self._terrain(np.array([fix.lat_deg]), np.array([fix.lon_deg]))[0])
        self._latest.append((below_m + fix.agl_m - above_sea_m, fix.agl_m))
        self._views += 1
        if self._views % MIN_VIEWS:
            return
        off_m, agl_m = np.array(self._latest).T
        known = np.isfinite(off_m)
        holes, views = int((~known).sum()), len(known)
        if holes > HOLES_SHARE * views:
            self._say("holes", "the terrain has no height below %d of %d views", holes, views)
        if views - holes >= MIN_VIEWS:
            self._judge(off_m[known], agl_m[known])

    def _judge(self, off_m: NDArray[np.float64], agl_m: NDArray[np.float64]) -> None:
        middle_m = float(np.median(off_m))
        spread_m = 1.4826 * float(np.median(np.abs(off_m - middle_m)))
        log.debug("heights by views less reported ones: %.1f m +- %.1f m", middle_m, spread_m)
        if abs(middle_m) > OFF_M:
            self._say(
                "datum",
                "by the views the aircraft is %.0f m %s than reported over this terrain: check its "
                "vertical datum, the take-off position and the altitude of the autopilot",
                abs(middle_m),
                "higher" if middle_m > 0 else "lower",
            )
        if spread_m > max(SPREAD_M, SPREAD_SHARE * float(np.median(agl_m))):
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
