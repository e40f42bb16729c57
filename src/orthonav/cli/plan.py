"""`orthonav plan`: derive map requirements from a route, a camera and a height."""

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

from orthonav.cli.common import add_area, add_dem, beside, print_json

EVERYDAY = (
    *("--route", "--bounds", "--band-m", "--camera", "--agl-m", "--speed-mps", "--dem"),
    *("--out", "--json"),
)

if TYPE_CHECKING:
    from orthonav.ground.planning.area import Area, Extent
    from orthonav.ground.planning.route import Route
    from orthonav.ground.planning.spacing import Caution, ViewPlan
    from orthonav.ground.planning.terrain import LegProfile


def add(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    add_area(
        parser,
        parser.add_mutually_exclusive_group(required=True),
        " (default: 600 m, at least half a view)",
    )
    parser.add_argument(
        "--camera",
        type=Path,
        metavar="FILE",
        help="camera file: flight.json, or of OpenCV, ROS or Kalibr (YAML, JSON); default: 1280 x "
        "960 px, 65 by 51 deg",
    )
    parser.add_argument("--agl-m", type=float, help="height above ground (default: from the route)")
    parser.add_argument("--speed-mps", type=float, help="ground speed")
    parser.add_argument(
        "--gsd-m", type=float, help="ground resolution, metres per pixel (default: from the view)"
    )
    parser.add_argument("--tile-px", type=int, help="width of a tile (default: from the view)")
    parser.add_argument(
        "--overlap",
        type=float,
        default=0.875,
        metavar="FRACTION",
        help="overlap of neighbouring tiles, as a fraction of their width (default 0.875)",
    )
    parser.add_argument(
        "--no-registration",
        dest="registration",
        action="store_const",
        const=False,
        default=True,
        help="plan a map without the registration layer",
    )
    add_dem(parser, "to report height above ground and relief by leg")
    parser.add_argument(
        "--out",
        type=Path,
        metavar="ROUTE.geojson",
        help="write the route as GeoJSON, one line per sheet: build --route ROUTE.geojson#sheet-1",
    )
    parser.add_argument("--json", action="store_true", help="print the plan as JSON")


def run(options: argparse.Namespace) -> None:
    """Compute and print the plan."""
    from orthonav.cli.plan_text import plan_text
    from orthonav.core.errors import RouteError
    from orthonav.ground.planning.route import read_route
    from orthonav.ground.planning.spacing import default_band_m, rate_cautions, view_cautions
    from orthonav.ground.planning.terrain import terrain_cautions

    route = read_route(options.route) if options.route else None
    if options.dem_datum is not None and options.dem is None:
        raise RouteError("--dem-datum needs a terrain model: give --dem too")
    if route is None and (options.band_m is not None or options.dem or options.out):
        raise RouteError("--band-m, --dem and --out need a route (--route)")
    if options.speed_mps is not None and not 0 < options.speed_mps < 10_000:
        raise RouteError(f"ground speed must be above 0 m/s, got {options.speed_mps}")
    view = _view(options, route)
    if route is not None and options.band_m is None:
        options.band_m = default_band_m(0.0 if view is None else view.side_m)
    sheets, areas = _sheets(options, route)
    gsd_m, tile_px = _map_of(options, view)
    legs: list[LegProfile] = []
    if route is not None and options.dem is not None:
        legs = _profile(options, route, view)
    cautions: list[Caution] = [] if view is None else view_cautions(view, gsd_m, tile_px)
    if view is not None and options.speed_mps is not None:
        cautions += rate_cautions(view, options.speed_mps)
    cautions += terrain_cautions(legs)
    plain: dict[str, Any] = {
        "route": None if route is None else _route_plain(route, options),
        "view": None if view is None else _view_plain(view, gsd_m, options.speed_mps),
        "map": _map_plain(options, areas, sheets, gsd_m, tile_px),
        "terrain": [_leg_plain(leg) for leg in legs] if options.dem else None,
        "cautions": [{"code": each.code, "text": each.text} for each in cautions],
    }
    if options.out is not None:
        _write(options.out, [sheet for sheet in sheets if not isinstance(sheet, tuple)])
        plain["out"] = str(options.out)
    with beside(options.out):
        if options.json:
            print_json(plain)
        else:
            print(plan_text(plain))


def _sheets(
    options: argparse.Namespace, route: "Route | None"
) -> "tuple[list[Route | Extent], list[Area]]":
    """Sheets as arguments of `build` (routes or bounds), and their areas."""
    from orthonav.ground.planning.area import Area
    from orthonav.ground.planning.sheets import sheets_of_bounds, sheets_of_route

    if route is None:
        boxes = sheets_of_bounds(options.bounds)
        return [*boxes], [Area.from_bounds(box) for box in boxes]
    parts = sheets_of_route(route, options.band_m)
    return [*parts], [Area.from_route(part, options.band_m) for part in parts]


def _view(options: argparse.Namespace, route: "Route | None") -> "ViewPlan | None":
    """The view from `--agl-m`, else from the lowest height of the route."""
    from orthonav.core.errors import CameraError
    from orthonav.core.geo.camera_files import read_camera_file
    from orthonav.ground.planning.spacing import DEFAULT_CAMERA, ViewPlan

    agl_m = options.agl_m
    if agl_m is None and route is not None:
        agl_m = _lowest_agl_m(options, route)
    if agl_m is None and options.camera is None:
        return None
    if agl_m is None:
        raise CameraError(
            "--camera needs a height above ground: give --agl-m, or a route with heights (above "
            "ground; with --dem also above the sea or above home)"
        )
    camera = read_camera_file(options.camera) if options.camera else DEFAULT_CAMERA
    return ViewPlan.of(camera, agl_m)


def _lowest_agl_m(options: argparse.Namespace, route: "Route") -> float | None:
    """Lowest height above ground along the route, without take-off and landing; None: unknown."""
    from orthonav.ground.planning.terrain import LANDING_M

    if options.dem is not None and route.heights:
        heights_m = [height for leg in _profile(options, route, None) for height in leg.agl_m]
    else:
        found = [height for height in route.heights if height is not None]
        heights_m = [height.height_m for height in found if height.frame == "agl"]
    return min((height for height in heights_m if height >= LANDING_M), default=None)


def _map_of(options: argparse.Namespace, view: "ViewPlan | None") -> tuple[float, int]:
    """Ground resolution and tile width: from the options, else chosen for the view."""
    from orthonav.core.errors import AreaError
    from orthonav.ground.planning.spacing import suited_map, suited_tile_px

    if view is None:
        if options.gsd_m is None:
            raise AreaError(
                "the ground resolution of the map is unknown; give --agl-m, a route with heights "
                "above ground, or --gsd-m"
            )
        return options.gsd_m, 256 if options.tile_px is None else options.tile_px
    gsd_m, tile_px = suited_map(view)
    if options.gsd_m is not None:
        gsd_m, tile_px = options.gsd_m, suited_tile_px(view, options.gsd_m)
    return gsd_m, tile_px if options.tile_px is None else options.tile_px


def _profile(
    options: argparse.Namespace, route: "Route", view: "ViewPlan | None"
) -> list["LegProfile"]:
    from orthonav.cli.heights import dem_for_route
    from orthonav.ground.planning.terrain import profile

    bands_m = route.bands_m(options.band_m) or ()
    view_m = 0.0 if view is None else view.short_m
    agl_m = options.agl_m if view is None else view.agl_m
    ground = dem_for_route(options, route)
    assert ground is not None
    return profile(route, bands_m, agl_m, view_m, ground)


def _route_plain(route: "Route", options: argparse.Namespace) -> dict[str, Any]:
    from orthonav.ground.planning.route import leg_lengths_m

    length_m, speed_mps = float(leg_lengths_m(route).sum()), options.speed_mps
    frames = {each.frame for each in route.heights if each is not None}
    return {
        "name": route.name,
        "waypoints": len(route.waypoints),
        "length_m": round(length_m, 1),
        "duration_s": None if speed_mps is None else round(length_m / speed_mps, 1),
        "band_m": round(options.band_m, 1),
        "heights_above": sorted("unknown" if frame is None else frame for frame in frames),
        "legs_with_own_band": sum(band is not None for band in route.leg_bands_m),
    }


def _view_plain(view: "ViewPlan", gsd_m: float, speed_mps: float | None) -> dict[str, Any]:
    return {
        "agl_m": round(view.agl_m, 2),
        "width_m": round(view.width_m, 2),
        "height_m": round(view.height_m, 2),
        "gsd_m": round(view.gsd_m, 4),
        "across_px": round(view.across_px(gsd_m), 1),
        "spacing_m": round(view.spacing_m, 2),
        "rate_hz": None if speed_mps is None else round(speed_mps / view.spacing_m, 3),
    }


def _map_plain(
    options: argparse.Namespace,
    areas: list["Area"],
    sheets: list["Route | Extent"],
    gsd_m: float,
    tile_px: int,
) -> dict[str, Any]:
    from orthonav.ground.planning.estimate import estimate_map

    made = [
        estimate_map(
            area,
            gsd_m=gsd_m,
            tile_px=tile_px,
            overlap=options.overlap,
            registration=options.registration,
            maps=len(areas),
        )
        for area in areas
    ]
    return {
        "gsd_m": gsd_m,
        "tile_px": tile_px,
        "tile_m": round(gsd_m * tile_px, 3),
        "overlap": options.overlap,
        "registration": options.registration,
        "area_km2": round(sum(each.area_km2 for each in made), 3),
        "imagery_km2": round(sum(each.imagery_km2 for each in made), 3),
        "tiles": sum(each.tiles for each in made),
        "map_mb": [round(sum(each.map_mb[i] for each in made), 2) for i in (0, 1)],
        "build_minutes": round(sum(each.build_s for each in made) / 60, 1),
        "sheets": [
            {
                "name": None if isinstance(sheet, tuple) else sheet.name,
                "bounds_deg": [round(value, 6) for value in sheet]
                if isinstance(sheet, tuple)
                else None,
                "area_km2": round(each.area_km2, 3),
                "map_mb": [round(size, 2) for size in each.map_mb],
            }
            for sheet, each in zip(sheets, made, strict=True)
        ],
    }


def _leg_plain(leg: "LegProfile") -> dict[str, Any]:
    return {
        "leg": leg.leg,
        "length_m": round(leg.length_m, 1),
        "ground_m": [round(each, 1) for each in leg.ground_m],
        "agl_m": [round(each, 1) for each in leg.agl_m],
        "relief": round(leg.relief, 4),
    }


def _write(path: Path, sheets: list["Route"]) -> None:
    from orthonav.core.files import write_text
    from orthonav.ground.planning.routes.geojson import to_geojson

    write_text(path, to_geojson(sheets))
