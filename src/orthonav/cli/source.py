"""Recordings and terrain of `import`, `localize`, `calibrate` and others: options and reading."""

import argparse
import logging
import math
from pathlib import Path
from typing import TYPE_CHECKING, Any

import orthonav
from orthonav.cli.common import add_options, given, watched
from orthonav.core.errors import FlightError, ImageryError, MissingExtraError, UsageError
from orthonav.core.geo.swapped import swapped_hint
from orthonav.ground import planning

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator

    from orthonav.cli.common import Progress
    from orthonav.core.flight.heights import Array, FlownHeights, Undulation
    from orthonav.core.flight.recording import RecordedView
    from orthonav.core.geo.ground import TerrainHeights
    from orthonav.core.localize.confidence import Acceptance
    from orthonav.ground.imagery.terrain import Dem
    from orthonav.ground.recordings import Recording, SourceOptions
    from orthonav.onboard.run import Locator

FAR_M = 1000.0
"""A recorded position farther from the map causes a warning: GNSS and logs err by less."""
log = logging.getLogger(__name__)


def topic(text: str) -> tuple[str, str]:
    role, equals, name = text.partition("=")
    if not (role and equals and name):
        raise argparse.ArgumentTypeError(f"expected ROLE=/topic, got '{text}'")
    return role, name


def add_source(parser: argparse.ArgumentParser, *, dem: bool = True) -> None:
    """Add the options; see docs/flights.md."""
    group = parser.add_argument_group("reading the recording")
    add = group.add_argument
    text = "log to join by time: PX4 .ulg, ArduPilot .bin or .tlog, DJI .srt, .csv; or a .csv of "
    add("--telemetry", type=Path, metavar="LOG", help=f"{text}images by file name")
    text = "offset that is added to the times of images to get times of the log (default 0)"
    add("--time-offset-s", type=float, default=0.0, help=text)
    add_options(group, "--camera", "--mask", "--mount-deg")
    text = "source of image, camera_info, attitude, velocity, position or height: a ROS topic, or "
    text += "an instance in a log, such as position=GPS[1]"
    names: dict[str, Any] = {"dest": "topics", "metavar": "ROLE=NAME"}
    add("--topic", type=topic, action="append", default=[], help=text, **names)
    text = "views per second taken from a recording: of a video (default 1)"
    add("--rate-hz", type=float, default=1.0, help=text)
    text = "longer side of the sensor of photographs, for the focal length"
    add("--sensor-width-mm", type=float, metavar="MM", help=text)
    text = "field of view across the width of the images, where the camera is not known"
    add("--fov-deg", type=float, help=text)
    add_options(group, "--agl-m", help="height above ground of all views, not the recorded one")
    text = "altitude of the ground, in the reference of the recorded altitudes, where no heights "
    add("--ground-alt-m", type=float, help=f"{text}were recorded")
    if dem:
        add_options(group, "--dem", "--dem-datum")
    text = "assume pitch and roll 0 where they were not recorded"
    add("--looks-down", action="store_true", help=text)
    text = "standard deviation of the prior position, per axis; the recorded position is then the "
    add("--prior-std-m", type=float, help=f"{text}prior (default: no prior)")


def distance_from_map(
    latlon_deg: tuple[float, float], localizer: "orthonav.Localizer"
) -> tuple[float, str]:
    """Distance of a position from the map (m, 0 on the map), and a hint where swapped latitude and
    longitude explain it, else an empty text."""
    import numpy as np

    grid, frame = localizer.grid, localizer.sheet.frame
    low, high = np.reshape(grid.extent_en_m, (2, 2))

    def beyond_m(lat_deg: float, lon_deg: float) -> float:
        position = frame.en_from_latlon(lat_deg, lon_deg)
        return float(np.hypot(*np.maximum(np.maximum(low - position, position - high), 0.0)))

    hint = swapped_hint(*latlon_deg, lambda lat, lon: beyond_m(lat, lon) <= FAR_M)
    return beyond_m(*latlon_deg), hint


def far_from_map(view: "RecordedView", localizer: "orthonav.Localizer") -> tuple[float, str] | None:
    """`distance_from_map` of the recorded position of a view or of its prior, the farther one; None
    without a position."""
    prior, recorded = view.telemetry.prior, view.truth_latlon_deg
    places = [] if recorded is None else [recorded]
    places += [] if prior is None else [(prior.lat_deg, prior.lon_deg)]
    known = [place for place in places if all(map(math.isfinite, place))]
    return max((distance_from_map(place, localizer) for place in known), default=None)


def far_text(what: str, far_m: float, hint: str) -> str:
    return f"{what} {far_m / 1000:,.0f} km from the map; check the map and the positions{hint}"


def warn_if_far_from_map(flight: "Recording", localizer: "orthonav.Localizer") -> None:
    view = next(iter(flight.views), None)
    found = None if view is None else far_from_map(view, localizer)
    if found is not None and found[0] > FAR_M:
        log.warning("%s", far_text("the recorded position of the first view is", *found))


def source_options(options: argparse.Namespace, **more: Any) -> "SourceOptions":
    from orthonav.ground.recordings import SourceOptions

    more |= {"mount_deg": tuple(options.mount_deg), "topics": dict(options.topics)}
    return SourceOptions(**given(options, SourceOptions) | more)


def open_source(
    path: Path | list[Path], options: argparse.Namespace, *, over_terrain: bool = False
) -> "Recording":
    """The open recording; its choices and warnings are logged. `over_terrain`: whether a terrain
    turns its heights into heights above ground."""
    from orthonav.ground import recordings

    recording = recordings.open_source(path, source_options(options, over_terrain=over_terrain))
    for said in (*recording.choices, *recording.warnings):
        log.warning("%s", said)
    return recording


def dem_of(options: argparse.Namespace, route: "planning.Route | None" = None) -> "Dem | None":
    """The terrain of `--dem`; at least one waypoint of the route lies in it."""
    if options.dem is None:
        if options.dem_datum is not None and not getattr(options, "surface", None):
            raise UsageError("--dem-datum needs a terrain model: give --dem too")
        return None
    if getattr(options, "ground_alt_m", None) is not None:
        raise UsageError("--ground-alt-m assumes level ground: give it or --dem")
    if hasattr(options, "fov_deg") and options.agl_m is not None:  # of a recording, not of a plan
        raise UsageError("--agl-m is the height above ground of the views: give it or --dem")
    from orthonav.ground.imagery.terrain import open_dem

    dem = open_dem(options.dem, options.dem_datum)
    if route is not None and is_above_sea(route):
        dem.require_datum("heights of the route are above the sea")
    if route is not None and not any(dem.covers(*waypoint) for waypoint in route.waypoints):
        hint = swapped_hint(*route.waypoints[0], dem.covers)
        raise ImageryError(f"the route lies outside the terrain{hint}: {options.dem}")
    return dem


def is_above_sea(route: "planning.Route") -> bool:
    """Whether heights of a route, or of its take-off, count from the sea."""
    frames = {each.frame for each in route.heights if each is not None}
    return "amsl" in frames or ("home" in frames and route.home_amsl_m is not None)


def map_heights(
    opened: "orthonav.MapFile",
    terrain: "TerrainHeights | None" = None,
    *,
    datum_known: bool = True,
    **how: Any,
) -> "FlownHeights | None":
    """Heights above ground on a map by `terrain` (`datum_known`: whether it counts from the sea),
    else by its own; None where it has none. `how`: of `FlownHeights`."""
    from orthonav.core.flight.heights import FlownHeights
    from orthonav.core.mapfile.terrain import TerrainLayer

    layer = None if terrain is not None else TerrainLayer.of(opened)
    found = terrain or layer
    if found is None:
        return None
    known = datum_known if layer is None else layer.info.is_above_sea
    return FlownHeights(found, _area_deg(opened), datum_known=known, **how)


def _area_deg(opened: "orthonav.MapFile") -> "tuple[Array, Array]":
    """Positions spread over a map, at which its terrain is averaged."""
    import numpy as np

    sheet = opened.manifest.sheets[0]
    grid = sheet.grid
    half_m, points = grid.tile_m / 2, 48
    east, north = np.meshgrid(
        grid.west_m + np.linspace(half_m, grid.width_px * grid.gsd_m - half_m, points),
        grid.north_m - np.linspace(half_m, grid.height_px * grid.gsd_m - half_m, points),
    )
    return sheet.frame.latlon_from_en(np.stack([east.ravel(), north.ravel()], axis=1))


def flight_heights(
    options: argparse.Namespace, opened: "orthonav.MapFile", flight: "Recording", dem: "Dem | None"
) -> "FlownHeights | None":
    """Heights above ground of the views of a recorded flight; None without a terrain. What is
    assumed about heights is logged once."""
    from orthonav.core.flight.heights import DATUM_ADVICE, needs_datum

    if dem is not None and not any(map(dem.covers, *_area_deg(opened))):
        raise ImageryError(f"the terrain lies outside the map: {dem.path}")
    layer = opened.manifest.sheets[0].terrain
    if dem is not None and layer is not None and not (dem.datum.is_known and layer.is_above_sea):
        raise FlightError(
            "the terrain of --dem and that of the map may count from different levels, as the "
            "vertical datum of one is unknown: omit --dem, or state both with --dem-datum"
        )
    first = next(iter(flight.views), None)
    if first is None:
        return None
    if dem is None and layer is None:
        say_assumed_heights(flight)
        return None
    place = flight.take_off_latlon_deg or first.truth_latlon_deg
    heights = map_heights(
        opened,
        dem,
        take_off=None if place is None else (*place, 0.0),
        geoid=_geoid_for(first.telemetry),
        use_prior=getattr(options, "prior", None) != "none",
        datum_known=dem is None or dem.datum.is_known,
    )
    if heights is not None and not heights.datum_known and needs_datum(first.telemetry):
        raise FlightError(
            "the flight has heights above the sea or the ellipsoid only, and the vertical datum "
            f"of the terrain is unknown: {DATUM_ADVICE}"
        )
    say_assumed_heights(flight, f"the terrain of {'the map' if dem is None else options.dem.name}")
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


def _geoid_for(telemetry: "orthonav.Telemetry") -> "Undulation | None":
    """The geoid, where the height above the ellipsoid is known and that above the sea is not. Where
    it is needed and missing, a warning says what to install."""
    if telemetry.hae_m is None or telemetry.amsl_m is not None:
        return None
    try:
        from orthonav.ground.imagery.terrain import geoid

        return geoid()
    except (ImageryError, MissingExtraError) as error:
        if telemetry.home_m is None:
            log.warning("%s", error)
        return None


def located(
    options: argparse.Namespace,
    locator: "Locator",
    flight: "Recording",
    views: "Iterable[RecordedView]",
    shown: "Progress",
    accept: "Acceptance | None" = None,
    heights: "FlownHeights | None" = None,
    take: "Callable[[RecordedView, orthonav.ViewResult], None]" = lambda view, result: None,
) -> "list[orthonav.ViewResult]":
    """Results of the views of a recording; `take` gets each view with its own."""
    from orthonav.ground.recordings.localize import localize_flight

    results, newest = [], list["RecordedView"]()

    def read() -> "Iterator[RecordedView]":
        for view in views:
            newest[:] = [view]
            yield view

    skip = getattr(options, "skip_bad_images", True)
    how: dict[str, Any] = {"skip_bad_images": skip, "accept": accept, "heights": heights}
    found = localize_flight(locator, flight, views=read(), **how)
    for result in watched(found, flight.expected, options.command, shown):
        results.append(result)
        take(newest[0], result)
    return results
