"""A planned route as all file formats give it."""

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from orthonav.errors import RouteError
from orthonav.geo.frames import LocalFrame

HeightFrame = Literal["agl", "home", "amsl"]
HEIGHT_FRAMES: tuple[HeightFrame, ...] = ("agl", "home", "amsl")
MAX_HEIGHT_M = 100_000.0
MAX_BAND_M = 50_000.0
MAX_WAYPOINTS = 100_000


@dataclass(frozen=True)
class Height:
    """Height of a waypoint in metres, and above what.

    `frame` is "agl" (the ground below it), "home" (the ground at the take-off place), "amsl" (mean
    sea level), or None where the file does not say.
    """

    height_m: float
    frame: HeightFrame | None = None

    def __post_init__(self) -> None:
        if not abs(self.height_m) <= MAX_HEIGHT_M:
            raise RouteError(
                f"height of a waypoint must be within {MAX_HEIGHT_M:,.0f} m, got {self.height_m}"
            )
        if self.frame is not None and self.frame not in HEIGHT_FRAMES:
            raise RouteError(
                f"height must be above one of {', '.join(HEIGHT_FRAMES)}, got {self.frame!r:.40}"
            )


@dataclass(frozen=True)
class Route:
    """Waypoints of the planned trajectory as `(lat_deg, lon_deg)`, at least one.

    Leg i goes from waypoint i to waypoint i + 1; a route of one waypoint has one leg, of no length.
    `heights` has one entry per waypoint (None: not said), `leg_bands_m` the width of the search
    band of each leg (None: the default); both are empty where the file says nothing of the kind.
    `home_amsl_m` is the take-off place's height above mean sea level. Raises `RouteError`.
    """

    waypoints: tuple[tuple[float, float], ...]
    heights: tuple[Height | None, ...] = ()
    leg_bands_m: tuple[float | None, ...] = ()
    name: str | None = None
    home_amsl_m: float | None = None

    def __post_init__(self) -> None:
        if not self.waypoints:
            raise RouteError("route has no waypoints")
        if len(self.waypoints) > MAX_WAYPOINTS:
            raise RouteError(
                f"route has {len(self.waypoints):,} waypoints, at most {MAX_WAYPOINTS:,} are read; "
                "thin it out"
            )
        for lat, lon in self.waypoints:
            if not (abs(lat) <= 90 and abs(lon) <= 360):
                raise RouteError(
                    f"waypoint is not a latitude and longitude in degrees: {lat}, {lon}"
                )
        if self.heights and len(self.heights) != len(self.waypoints):
            raise RouteError(
                f"route has {len(self.heights)} heights for {len(self.waypoints)} waypoints"
            )
        if self.leg_bands_m and len(self.leg_bands_m) != self.legs:
            raise RouteError(f"route has {len(self.leg_bands_m)} bands for {self.legs} legs")
        for band_m in self.leg_bands_m:
            if band_m is not None and not 0 < band_m <= MAX_BAND_M:
                raise RouteError(
                    f"search band of a leg must be wider than 0 and at most {MAX_BAND_M:,.0f} m, "
                    f"got {band_m}"
                )
        if self.home_amsl_m is not None and not math.isfinite(self.home_amsl_m):
            raise RouteError(f"height of the take-off place is not a number: {self.home_amsl_m}")

    @property
    def legs(self) -> int:
        """Number of legs, at least one."""
        return max(1, len(self.waypoints) - 1)

    def points_en_m(self, frame: LocalFrame) -> NDArray[np.float64]:
        """Waypoints as local `(N, 2)` metres of `frame`."""
        lat_lon = np.array(self.waypoints, dtype=np.float64)
        return frame.en_from_latlon(lat_lon[:, 0], lat_lon[:, 1])

    def bands_m(self, default_m: float | None) -> tuple[float, ...] | None:
        """Width of the search band of each leg; None where a leg has none and there is no default.

        `default_m` is for the legs that do not say.
        """
        if not self.leg_bands_m:
            return None if default_m is None else (default_m,) * self.legs
        bands = [default_m if band is None else band for band in self.leg_bands_m]
        known = tuple(band for band in bands if band is not None)
        return known if len(known) == len(bands) else None

    def part(self, first: int, last: int, name: str | None = None) -> "Route":
        """The legs from waypoint `first` to waypoint `last`, both included."""
        return Route(
            self.waypoints[first : last + 1],
            self.heights[first : last + 1],
            self.leg_bands_m[first : max(last, first + 1)],
            name or self.name,
            self.home_amsl_m,
        )
