"""A planned route, independent of its file format, and the checked values of route files."""

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from orthonav.core.errors import RouteError
from orthonav.core.geo.frames import MAX_SHEET_M, LocalFrame
from orthonav.core.geo.swapped import swapped_hint

HeightFrame = Literal["agl", "home", "amsl", "hae"]
MAX_WAYPOINTS = 100_000  # sanity limit against files that exhaust memory


def require_few_waypoints(count: int) -> None:
    if count > MAX_WAYPOINTS:
        raise RouteError(
            f"route has at least {count:,} waypoints, at most {MAX_WAYPOINTS:,} are read; "
            "simplify it"
        )


@dataclass(frozen=True)
class Height:
    """Height of a waypoint. `height_m`: metres above the reference. `frame`: the reference, "agl"
    (terrain below the waypoint), "home" (terrain at the take-off position), "amsl" (mean sea
    level), "hae" (the WGS 84 ellipsoid), or None if the file does not state it."""

    height_m: float
    frame: HeightFrame | None = None

    def __post_init__(self) -> None:
        if not abs(self.height_m) <= 100_000:  # the edge of space
            raise RouteError(f"height of a waypoint must be within 100,000 m, got {self.height_m}")
        if self.frame is not None and self.frame not in get_args(HeightFrame):
            known = ", ".join(get_args(HeightFrame))
            raise RouteError(f"height reference must be {known}, got {self.frame!r:.40}")


@dataclass(frozen=True)
class Route:
    """Waypoints joined by straight legs; raises `RouteError` if invalid. Leg i goes from waypoint i
    to waypoint i + 1; a route of one waypoint has one leg of length 0. `waypoints`: `(lat_deg,
    lon_deg)`, WGS84, at least one; |lat| <= 90, |lon| <= 360. `heights`: one per waypoint, None if
    unknown; empty if the file has none. `leg_bands_m`: full width of the search band per leg in
    metres, None for the default; empty if the file has none. `home_amsl_m`: height of the take-off
    position above mean sea level, metres, None if unknown."""

    waypoints: tuple[tuple[float, float], ...]
    heights: tuple[Height | None, ...] = ()
    leg_bands_m: tuple[float | None, ...] = ()
    name: str | None = None  # name of the line in its file, None if it has none
    home_amsl_m: float | None = None

    def __post_init__(self) -> None:
        if not self.waypoints:
            raise RouteError("route has no waypoints")
        require_few_waypoints(len(self.waypoints))
        for lat, lon in self.waypoints:
            if not (abs(lat) <= 90 and abs(lon) <= 360):
                raise RouteError(
                    "waypoint must have a latitude within 90 and a longitude within 360 degrees, "
                    f"got {lat}, {lon}{swapped_hint(lat, lon)}"
                )
        if not any(self.heights):
            object.__setattr__(self, "heights", ())
        if self.leg_bands_m and len(self.leg_bands_m) != self.legs:
            raise RouteError(f"route has {len(self.leg_bands_m)} bands for {self.legs} legs")
        for band_m in self.leg_bands_m:
            if band_m is not None and not 0 < band_m <= MAX_SHEET_M:
                raise RouteError(
                    "search band of a leg must be wider than 0 and at most as wide as a sheet, "
                    f"{MAX_SHEET_M:,.0f} m, got {band_m}"
                )

    @property
    def legs(self) -> int:
        return max(1, len(self.waypoints) - 1)

    def points_en_m(self, frame: LocalFrame) -> NDArray[np.float64]:
        lat_lon = np.array(self.waypoints, dtype=np.float64)
        return frame.en_from_latlon(lat_lon[:, 0], lat_lon[:, 1])

    def bands_m(self, default_m: float | None) -> tuple[float, ...] | None:
        """Width of the search band of each leg, `default_m` for legs without one. None if a leg has
        none and there is no default."""
        if not self.leg_bands_m:
            return None if default_m is None else (default_m,) * self.legs
        bands = [default_m if band is None else band for band in self.leg_bands_m]
        known = tuple(band for band in bands if band is not None)
        return known if len(known) == len(bands) else None

    def part(self, first: int, last: int, name: str | None = None) -> "Route":
        return Route(
            self.waypoints[first : last + 1],
            self.heights[first : last + 1],
            self.leg_bands_m[first : max(last, first + 1)],
            name or self.name,
            self.home_amsl_m,
        )


def listed(names: Sequence[str], most: int) -> str:
    return ", ".join(names[:most]) + (", .." if len(names) > most else "")


def number(value: Any, what: str) -> float:
    if type(value) not in (int, float) or not math.isfinite(value):
        raise RouteError(f"{what} must be a number, got {value!r:.80}")
    return float(value)


def number_or_none(value: Any, what: str) -> float | None:
    if value is None or (isinstance(value, float) and math.isnan(value)):
        return None
    return number(value, what)


def parsed(text: str, what: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise RouteError(f"{what} must be a number, got {text!r:.80}")
    return value


def decoded(data: bytes) -> str:
    if not data.strip():
        raise RouteError("route file is empty")
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise RouteError(
            "route file is not UTF-8 text; check that its suffix matches its format"
        ) from error


def json_object(data: bytes) -> dict[str, Any]:
    try:
        plain = json.loads(decoded(data))
    except (json.JSONDecodeError, RecursionError) as error:
        raise RouteError(f"route cannot be read as JSON ({error})") from error
    if not isinstance(plain, dict):
        raise RouteError(f"route must be a JSON object, got {type(plain).__name__}")
    return plain
