"""Heights above ground from the heights that were reported, over the terrain.

Heights above ground (`agl_m`), take-off (`home_m`), mean sea level (`amsl_m`) and the ellipsoid
(`hae_m`) are different numbers. This module is the only place that turns one into another.
"""

import logging
import math
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from orthonav.core.geo.frames import LocalFrame
from orthonav.core.geo.ground import Ground, TerrainHeights, ground_around, ground_over
from orthonav.core.records import CONFIDENT, DEFAULT_AGL_STD, Fix, NoFix, Telemetry

Array = NDArray[np.float64]
Place = tuple[float, float]
Undulation = Callable[[Array, Array], Array]
"""Height of the geoid above the ellipsoid (m) at latitudes and longitudes (deg)."""
DATUM_ADVICE = "state it with --dem-datum, or use heights above ground or take-off"
_LOST = ("searching", "lost")  # states of a track that has no position
log = logging.getLogger(__name__)


@dataclass(frozen=True)
class HeightLimits:
    """How places age, and from which differences of heights on a warning is logged."""

    usual_mps: float = 30.0  # speed where none is reported: that of a fast small aircraft
    velocity_error: float = 0.3  # of a reported velocity, a fraction, turns between fixes included
    largest_std_m: float = 10_000.0  # a place with more is unknown: a map is at most 50 km across
    mismatch_m: float = 20.0
    """Between heights above sea and above take-off: barometers and positions of take-off explain
    less, a wrong datum more."""
    off_m: float = 25.0
    """Between heights by the views and by the terrain on the whole: barometers explain less."""
    spread_m: float = 3.0
    spread_share: float = 0.02
    """Their robust standard deviation, in metres and as a fraction of the height above ground: by a
    right terrain it was 1.3 %, by one displaced by 200 m 2 to 3 %
    (`benchmarks.terrain_flight` at d63ac91)."""
    holes_share: float = 0.1  # of the confident views, over holes of the terrain
    min_views: int = 20  # fewer confident views say nothing about the terrain
    max_views: int = 2000  # only so many of the latest confident views are kept


LIMITS = HeightLimits()


def is_measured(telemetry: Telemetry) -> bool:
    """Whether the height above ground was measured.

    A height above ground that equals the one above take-off assumes level ground, as imports
    without a terrain do.
    """
    return math.isfinite(telemetry.agl_m) and telemetry.agl_m != telemetry.home_m


def assumed_heights(
    telemetry: Telemetry, terrain: str | None, advice: str = "give --dem"
) -> str | None:
    """What is assumed about the height of a view, in words; None where it was measured.

    `terrain`: name of the terrain that is used, None without one. `advice`: what would help then.
    """
    if is_measured(telemetry):
        return None
    kinds = {"sea level": telemetry.amsl_m, "take-off": telemetry.home_m}
    known = [name for name, value in kinds.items() if value is not None]
    known += ["the ellipsoid"] if telemetry.hae_m is not None else []
    if not known:
        return None
    if terrain is not None:
        plus = " plus the terrain there" if known[0] == "take-off" else ""
        return f"height above ground is the height above {known[0]}{plus} minus {terrain}"
    if math.isfinite(telemetry.agl_m):
        return f"level ground is assumed: height above ground is that above take-off; {advice}"
    return f"only heights above {' and '.join(known)} are known, none above ground: {advice}"


def needs_datum(telemetry: Telemetry) -> bool:
    """Whether its height above ground follows only from the height of the ground above the sea."""
    known = is_measured(telemetry) or telemetry.home_m is not None
    return not known and (telemetry.amsl_m is not None or telemetry.hae_m is not None)


class FlownHeights:
    """Heights above ground along a flight whose position is what its fixes say. Mutable.

    The ground below is that around the prior or the last confident fix, whichever is known better;
    without either it is that of the whole area searched, whose spread widens the standard deviation
    of the height.
    """

    def __init__(
        self,
        terrain: TerrainHeights,
        area_deg: tuple[Array, Array],
        *,
        take_off: tuple[float, float, float] | None = None,
        geoid: Undulation | None = None,
        use_prior: bool = True,
        datum_known: bool = True,
    ) -> None:
        """`terrain`: its heights above mean sea level. `area_deg`: latitudes and longitudes spread
        over the area searched. `take_off`: latitude, longitude and standard deviation (m) of the
        take-off position. `geoid`: needed for heights above the ellipsoid; None without one.
        `datum_known`: whether the terrain counts from the sea; where not, heights above the sea and
        the ellipsoid are ignored."""
        self._terrain, self._area_deg, self._geoid = terrain, area_deg, geoid
        self._use_prior, self.datum_known = use_prior, datum_known
        known = take_off and ground_around(terrain, take_off[:2], take_off[2])
        self._take_off = known or self._whole
        self._unchecked = known is not None
        self._last: tuple[int, Place, float] | None = None
        self._fit, self._newest = TerrainFit(terrain), Telemetry(-1, 0.0, 0.0, 0.0, math.nan)

    def corrected(self, telemetry: Telemetry) -> Telemetry:
        """The telemetry with its height above ground and the standard deviation of that; unchanged
        where it was measured, NaN where the terrain does not give it: level ground is not
        assumed."""
        if is_measured(telemetry):
            return telemetry
        self._check(telemetry)
        self._newest = telemetry
        place, place_std_m = self._place(telemetry)
        below = None if place is None else ground_around(self._terrain, place, place_std_m)
        below = below or self._whole
        found = self._above_sea(telemetry, *(place or self._area_deg))
        if below is None or found is None:
            return replace(telemetry, agl_m=math.nan)
        above_sea_m, std_m = found
        agl_m, agl_std_m = above_sea_m - below.height_m, telemetry.agl_std_m
        spread_m = math.hypot(std_m, below.std_m)
        if spread_m > 0:
            own_m = DEFAULT_AGL_STD * abs(agl_m) if agl_std_m is None else agl_std_m
            agl_std_m = math.hypot(own_m, spread_m)
        return replace(telemetry, agl_m=agl_m, agl_std_m=agl_std_m, below=below)

    def _check(self, telemetry: Telemetry) -> None:
        """Warn once where heights above sea and above take-off differ much over this terrain."""
        home_m, amsl_m, take_off = telemetry.home_m, telemetry.amsl_m, self._take_off
        if not (self._unchecked and self.datum_known) or take_off is None:
            return
        if home_m is None or amsl_m is None:
            return
        self._unchecked = False
        off_m = home_m + take_off.height_m - amsl_m
        if abs(off_m) > LIMITS.mismatch_m:
            log.warning(
                "heights above take-off and above sea level differ by %.0f m over this terrain: "
                "check its vertical datum, the take-off position and the altitude of the autopilot",
                off_m,
            )

    def _above_sea(
        self, telemetry: Telemetry, lat_deg: ArrayLike, lon_deg: ArrayLike
    ) -> tuple[float, float] | None:
        """Height above the datum of the terrain and its standard deviation, at a place or on
        average over some; None where unknown."""
        if self.datum_known and telemetry.amsl_m is not None:
            return telemetry.amsl_m, 0.0
        if telemetry.home_m is not None and self._take_off is not None:
            return telemetry.home_m + self._take_off.height_m, self._take_off.std_m
        if self.datum_known and telemetry.hae_m is not None and self._geoid is not None:
            undulations_m = self._geoid(np.atleast_1d(lat_deg), np.atleast_1d(lon_deg))
            return telemetry.hae_m - float(undulations_m.mean()), 0.0
        return None

    def observe(self, time_ns: int, outcome: Fix | NoFix, state: str | None) -> None:
        """Take note of the outcome of a view: a confident fix says where the aircraft is.

        A track that is lost does not know it any more, wherever its last fix was.
        """
        if state in _LOST:
            self._last = None
        if not isinstance(outcome, Fix) or not outcome.confidence >= CONFIDENT:
            return
        if state in (None, "tracking"):
            std_m = math.sqrt(float(np.trace(outcome.cov_en_m2)) / 2)
            self._last = time_ns, (outcome.lat_deg, outcome.lon_deg), std_m
            reported = self._above_sea(self._newest, *self._last[1])
            if self._newest.time_ns == time_ns and reported is not None:
                self._fit.take(outcome, reported[0])

    def ground_m(self, fix: Fix) -> float:
        """Height of the terrain above sea level at a fix; NaN where that is unknown."""
        if not self.datum_known:
            return math.nan
        std_m = math.sqrt(float(np.trace(fix.cov_en_m2)) / 2)
        below = ground_around(self._terrain, (fix.lat_deg, fix.lon_deg), std_m)
        return math.nan if below is None else below.height_m

    def _place(self, telemetry: Telemetry) -> tuple[Place | None, float]:
        found: list[tuple[float, Place | None]] = []
        prior = telemetry.prior if self._use_prior else None
        if prior is not None:
            found.append((prior.std_m, (prior.lat_deg, prior.lon_deg)))
        if self._last is not None:
            found.append(_aged(*self._last, telemetry))
        std_m, place = min(found, default=(math.inf, None))
        return (place, std_m) if std_m <= LIMITS.largest_std_m else (None, math.inf)

    @cached_property
    def _whole(self) -> Ground | None:
        return ground_over(self._terrain, *self._area_deg)


def _aged(time_ns: int, place: Place, std_m: float, telemetry: Telemetry) -> tuple[float, Place]:
    """Standard deviation and place at a view, of a place known at an earlier time."""
    seconds = (telemetry.time_ns - time_ns) / 1e9
    if telemetry.vel_en_mps is None:
        return std_m + LIMITS.usual_mps * abs(seconds), place
    moved_m = np.array(telemetry.vel_en_mps) * seconds
    lat, lon = LocalFrame(*place).latlon_from_en(moved_m)
    return std_m + LIMITS.velocity_error * float(np.hypot(*moved_m)), (float(lat), float(lon))


class TerrainFit:
    """Compares heights above sea by confident views with those reported. Mutable.

    It judges by the latest of them, so that long flights cost no more memory and time.
    """

    def __init__(self, terrain: TerrainHeights) -> None:
        self._terrain = terrain
        # Height by the view less the reported one (NaN over a hole), and height above ground.
        self._latest: deque[tuple[float, float]] = deque(maxlen=LIMITS.max_views)
        self._views = 0
        self._said: set[str] = set()

    def take(self, fix: Fix, above_sea_m: float) -> None:
        """A confident fix of a view that reported this height above sea."""
        below_m = float(self._terrain(np.array([fix.lat_deg]), np.array([fix.lon_deg]))[0])
        self._latest.append((below_m + fix.agl_m - above_sea_m, fix.agl_m))
        self._views += 1
        if self._views % LIMITS.min_views:
            return
        off_m, agl_m = np.array(self._latest).T
        known = np.isfinite(off_m)
        holes, views = int((~known).sum()), len(known)
        if holes > LIMITS.holes_share * views:
            self._say("the terrain has no height below %d of %d views", holes, views)
        if views - holes >= LIMITS.min_views:
            self._judge(off_m[known], agl_m[known])

    def _judge(self, off_m: NDArray[np.float64], agl_m: NDArray[np.float64]) -> None:
        middle_m = float(np.median(off_m))
        spread_m = 1.4826 * float(np.median(np.abs(off_m - middle_m)))
        log.debug("heights by views less reported ones: %.1f m +- %.1f m", middle_m, spread_m)
        if abs(middle_m) > LIMITS.off_m:
            self._say(
                "by the views the aircraft is %.0f m %s than reported over this terrain: check its "
                "vertical datum, the take-off position and the altitude of the autopilot",
                abs(middle_m),
                "higher" if middle_m > 0 else "lower",
            )
        if spread_m > max(LIMITS.spread_m, LIMITS.spread_share * float(np.median(agl_m))):
            self._say(
                "heights by the views scatter by %.0f m about those reported over this terrain: it "
                "may be displaced, or not show this ground",
                spread_m,
            )

    def _say(self, said: str, *values: object) -> None:
        if said not in self._said:
            self._said.add(said)
            log.warning(said, *values)
