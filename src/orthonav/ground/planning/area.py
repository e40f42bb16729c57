"""The reference area: where the aircraft may be, and thus where tile centres are placed."""

from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from orthonav.core.errors import AreaError, UsageError
from orthonav.core.extras import needed
from orthonav.core.geo.frames import MAX_SHEET_M, LocalFrame
from orthonav.core.geo.swapped import swapped_bounds_hint
from orthonav.ground.planning.route import Array, Route

Extent = tuple[float, float, float, float]


@dataclass(frozen=True)
class Area:
    """The extent (west, south, east, north in metres of `frame`), or the search band around a
    route: the width of each leg, or `band_m` metres for legs without one."""

    frame: LocalFrame
    extent_en_m: Extent
    route: Route | None = None
    band_m: float = 0.0

    @classmethod
    def from_bounds(cls, bounds_deg: Extent) -> "Area":
        west, south, east, north = unwrapped(bounds_deg)
        if max(abs(south), abs(north)) > 89.9 or east - west > 10 or north - south > 10:
            hint = swapped_bounds_hint((west, south, east, north))
            raise UsageError(
                "bounds must be west,south,east,north in degrees, at most 10 degrees across"
                f"{hint}, got {','.join(map(str, bounds_deg))}"
            )
        lon, lat = outline((west, south, east, north), 32).T
        return cls.from_outline(lat, lon)

    @classmethod
    def from_outline(cls, lat_deg: Array, lon_deg: Array) -> "Area":
        """Smallest north-up box around outline points, in a plane centred on that box. Longitudes
        are unwrapped near the first point, so the outline may cross the antimeridian."""
        lon_deg = lon_deg - 360 * np.round((lon_deg - lon_deg[0]) / 360)
        frame = LocalFrame(
            round(float(lat_deg.min() + lat_deg.max()) / 2, 7),
            round(float(lon_deg.min() + lon_deg.max()) / 2, 7),
        )
        points = frame.en_from_latlon(lat_deg, lon_deg)
        west, south = points.min(axis=0)
        east, north = points.max(axis=0)
        return cls(frame, _checked((float(west), float(south), float(east), float(north))))

    @classmethod
    def from_route(cls, route: Route, band_m: float | None = None) -> "Area":
        """Search band around `route`, `band_m` metres wide for legs without a width of their
        own."""
        if band_m is not None and not (np.isfinite(band_m) and band_m > 0):
            raise UsageError(f"band_m must be wider than 0 m, got {band_m}")
        bands_m = route.bands_m(band_m)
        if bands_m is None:
            raise UsageError("the route has no search band; give its width in metres (--band-m)")
        lat_lon = np.array(route.waypoints)
        box = cls.from_outline(lat_lon[:, 0], lat_lon[:, 1])
        line = route.points_en_m(box.frame)
        ends = line[1:] if len(line) > 1 else line
        half = np.array(bands_m)[:, None] / 2
        west, south = (np.minimum(line[: len(ends)], ends) - half).min(axis=0)
        east, north = (np.maximum(line[: len(ends)], ends) + half).max(axis=0)
        extent = _checked((float(west), float(south), float(east), float(north)))
        return cls(box.frame, extent, route, band_m or 0.0)

    def contains(self, points_en_m: Array, margin_m: float = 0.0) -> NDArray[np.bool_]:
        """Mask `(N,)` of the local points `(N, 2)` inside, or at most `margin_m` outside."""
        if self.route is not None:
            shapely = needed("shapely", "geo", "a route")
            points, inside = shapely.points(points_en_m), np.zeros(len(points_en_m), np.bool_)
            for band_m, legs in self._bands:
                inside |= shapely.dwithin(legs, points, max(0.0, band_m / 2 + margin_m))
            return inside
        west, south, east, north = self.extent_en_m
        low = np.array([west, south]) - margin_m
        high = np.array([east, north]) + margin_m
        return np.asarray(((points_en_m >= low) & (points_en_m <= high)).all(axis=1))

    @cached_property
    def _bands(self) -> list[tuple[float, Any]]:
        """Widths of the search band, and prepared geometries of the legs that have them."""
        shapely = needed("shapely", "geo", "a route")
        assert self.route is not None
        bands_m = np.array(self.route.bands_m(self.band_m or None))
        line = self.route.points_en_m(self.frame)
        legs = shapely.linestrings(np.stack([line[: len(bands_m)], line[-len(bands_m) :]], axis=1))
        found = [
            (width, shapely.multilinestrings(legs[bands_m == width]))
            for width in np.unique(bands_m).tolist()
        ]
        shapely.prepare([each for _, each in found])
        return found


def outline(box: Extent, points: int) -> Array:
    """Points (4 * points, 2), x and y, around a box (west, south, east, north) from its corner."""
    west, south, east, north = box
    corners = np.array([[west, south], [east, south], [east, north], [west, north], [west, south]])
    share = np.arange(points)[:, None] / points
    return np.concatenate([start + (end - start) * share for start, end in pairwise(corners)])


def unwrapped(bounds_deg: Extent) -> Extent:
    west, south, east, north = bounds_deg
    if west > east + 180:  # as in GeoJSON (RFC 7946, 5.2)
        east += 360
    if not (np.isfinite(bounds_deg).all() and west < east <= west + 360 and south < north):
        raise UsageError(
            "bounds must be west,south,east,north in degrees with west < east and south < north, "
            f"got {','.join(map(str, bounds_deg))}"
        )
    return west, south, east, north


def require_one_area(route: Route | None, band_m: float | None, bounds_deg: Extent | None) -> None:
    if route is not None and bounds_deg is not None:
        raise UsageError("give either a route with a search band or bounds, not both")
    if route is None and band_m is not None:
        raise UsageError("a search band needs a route (--route)")


def _checked(extent: Extent) -> Extent:
    west, south, east, north = extent
    across = max(east - west, north - south)
    if across > MAX_SHEET_M:
        raise AreaError(
            f"area is {across / 1000:.1f} km across, a sheet holds at most "
            f"{MAX_SHEET_M / 1000:.0f} km; build it in parts with --bounds or --route "
            "(orthonav plan cuts a route into sheets), or as an atlas"
        )
    return extent
