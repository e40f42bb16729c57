"""Heights above ground for the commands: the terrain of `--dem` or of the map."""

import argparse
import logging
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from orthonav.core.flight.heights import Array, FlownHeights, Undulation
    from orthonav.core.geo.ground import TerrainHeights
    from orthonav.core.mapfile import MapFile
    from orthonav.ground.imagery.terrain import Dem
    from orthonav.ground.planning.route import Route
    from orthonav.ground.recordings import Recording

AREA_POINTS = 48  # positions along a side of a map at which its terrain is averaged
log = logging.getLogger(__name__)


def dem_of(options: argparse.Namespace) -> "Dem | None":
    from orthonav.core.errors import FlightError

    if options.dem is None:
        if options.dem_datum is not None:
            raise FlightError("--dem-datum needs a terrain model: give --dem too")
        return None
    if getattr(options, "ground_alt_m", None) is not None:
        raise FlightError("--ground-alt-m assumes level ground: give it or --dem")
    if hasattr(options, "fov_deg") and options.agl_m is not None:  # of a recording, not of a plan
        raise FlightError("--agl-m is the height above ground of the views: give it or --dem")
    from orthonav.ground.imagery.terrain import open_dem

    return open_dem(options.dem, options.dem_datum)


def dem_for_route(options: argparse.Namespace, route: "Route") -> "Dem | None":
    """The same for a route, at least one waypoint of which lies in it."""
    from orthonav.core.errors import ImageryError
    from orthonav.core.geo.swapped import swapped_hint

    dem = dem_of(options)
    if dem is not None and not any(dem.covers(*waypoint) for waypoint in route.waypoints):
        hint = swapped_hint(*route.waypoints[0], dem.covers)
        raise ImageryError(f"the route lies outside the terrain{hint}: {options.dem}")
    return dem


def map_heights(
    opened: "MapFile",
    terrain: "TerrainHeights | None" = None,
    *,
    take_off: tuple[float, float, float] | None = None,
    geoid: "Undulation | None" = None,
    use_prior: bool = True,
) -> "FlownHeights | None":
    """Heights above ground on a map by `terrain`, else by its own; None where it has none."""
    from orthonav.core.flight.heights import FlownHeights
    from orthonav.core.mapfile.terrain import TerrainLayer

    terrain = terrain or TerrainLayer.of(opened)
    if terrain is None:
        return None
    area_deg = _area_deg(opened)
    return FlownHeights(terrain, area_deg, take_off=take_off, geoid=geoid, use_prior=use_prior)


def _area_deg(opened: "MapFile") -> "tuple[Array, Array]":
    import numpy as np

    sheet = opened.manifest.sheets[0]
    grid = sheet.grid
    half_m = grid.tile_m / 2
    east, north = np.meshgrid(
        grid.west_m + np.linspace(half_m, grid.width_px * grid.gsd_m - half_m, AREA_POINTS),
        grid.north_m - np.linspace(half_m, grid.height_px * grid.gsd_m - half_m, AREA_POINTS),
    )
    return sheet.frame.latlon_from_en(np.stack([east.ravel(), north.ravel()], axis=1))


def flight_heights(
    options: argparse.Namespace, opened: "MapFile", flight: "Recording", dem: "Dem | None"
) -> "FlownHeights | None":
    """Heights above ground of the views of a recorded flight; None without a terrain. What is
    assumed about heights is logged once."""
    from orthonav.core.errors import ImageryError

    if dem is not None and not any(map(dem.covers, *_area_deg(opened))):
        raise ImageryError(f"the terrain lies outside the map: {dem.path}")
    first = next(iter(flight.views), None)
    if first is None:
        return None
    has_terrain = dem is not None or opened.manifest.sheets[0].terrain is not None
    place = flight.take_off_latlon_deg or getattr(first, "truth_latlon_deg", None)
    heights = map_heights(
        opened,
        dem,
        take_off=None if place is None else (*place, 0.0),
        geoid=geoid_for(flight) if has_terrain else None,
        use_prior=getattr(options, "prior", None) != "none",
    )
    name = None
    if heights is not None:
        name = "the terrain of the map" if dem is None else f"the terrain of {options.dem.name}"
    say_assumed_heights(flight, name)
    return heights


def say_assumed_heights(
    flight: "Recording",
    terrain: str | None = None,
    advice: str = "give --dem, or build the map with it",
) -> None:
    """Log what is assumed about the heights of a flight, over a terrain or without one. `advice`:
    what would help. Other recordings than flights have said it when they were opened."""
    from orthonav.core.flight.heights import assumed_heights

    first = next(iter(flight.views), None)
    said = None if first is None else assumed_heights(first.telemetry, terrain, advice)
    if said is not None and (terrain is not None or flight.kind in ("flight", "log")):
        log.log(logging.WARNING if terrain is None else logging.INFO, "%s", said)


def geoid_for(flight: "Recording") -> "Undulation | None":
    """The geoid, where the height above the ellipsoid is known and that above the sea is not. Where
    it is needed and missing, a warning says what to install."""
    from orthonav.core.errors import ImageryError, MissingExtraError

    first = next(iter(flight.views), None)
    if first is None or first.telemetry.hae_m is None or first.telemetry.amsl_m is not None:
        return None
    try:
        from orthonav.ground.imagery.terrain import geoid

        return geoid()
    except (ImageryError, MissingExtraError) as error:
        if first.telemetry.home_m is None:
            log.warning("%s", error)
        return None
