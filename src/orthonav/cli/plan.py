"""`orthonav plan`: derive map requirements from a route, a camera and a height."""

import argparse
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from orthonav.cli.common import add_area, add_dem, beside, counted, print_json

EVERYDAY = (
    *("--route", "--bounds", "--band-m", "--camera", "--agl-m", "--speed-mps", "--dem"),
    *("--out", "--json"),
)
MAX_SHOWN = 12  # sheets and legs named in the text

if TYPE_CHECKING:
    from orthonav.ground.planning.area import Area, Extent
    from orthonav.ground.planning.route import Route
    from orthonav.ground.planning.spacing import Caution, LegProfile, ViewPlan


def add(parser: argparse.ArgumentParser) -> None:
    number = partial(parser.add_argument, type=float)
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
    number("--agl-m", help="height above ground (default: from the route)")
    number("--speed-mps", help="ground speed")
    number("--gsd-m", help="ground resolution, metres per pixel (default: from the view)")
    parser.add_argument("--tile-px", type=int, help="width of a tile (default: from the view)")
    number(
        "--overlap",
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
    from orthonav.core.errors import RouteError
    from orthonav.core.files import write_text
    from orthonav.ground.planning.route import read_route, to_geojson
    from orthonav.ground.planning.spacing import (
        default_band_m,
        terrain_cautions,
        view_cautions,
    )

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
    cautions += terrain_cautions(legs)
    plain: dict[str, Any] = {
        "route": None if route is None else _route_plain(route, options),
        "view": None if view is None else _view_plain(view, gsd_m, options.speed_mps),
        "map": _map_plain(options, areas, sheets, gsd_m, tile_px),
        "terrain": [_leg_plain(leg) for leg in legs] if options.dem else None,
        "cautions": [{"code": each.code, "text": each.text} for each in cautions],
    }
    if options.out is not None:
        write_text(options.out, to_geojson([x for x in sheets if not isinstance(x, tuple)]))
        plain["out"] = str(options.out)
    with beside(options.out):
        if options.json:
            print_json(plain)
        else:
            print(plan_text(plain))


def _sheets(
    options: argparse.Namespace, route: "Route | None"
) -> "tuple[list[Route | Extent], list[Area]]":
    from orthonav.ground.planning.area import Area
    from orthonav.ground.planning.sheets import sheets_of_route

    if route is None:
        return [options.bounds], [Area.from_bounds(options.bounds)]
    parts = sheets_of_route(route, options.band_m)
    return [*parts], [Area.from_route(part, options.band_m) for part in parts]


def _view(options: argparse.Namespace, route: "Route | None") -> "ViewPlan | None":
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
    from orthonav.ground.planning.spacing import LANDING_M

    if options.dem is not None and route.heights:
        heights_m = [height for leg in _profile(options, route, None) for height in leg.agl_m]
    else:
        found = [height for height in route.heights if height is not None]
        heights_m = [height.height_m for height in found if height.frame == "agl"]
    return min((height for height in heights_m if height >= LANDING_M), default=None)


def _map_of(options: argparse.Namespace, view: "ViewPlan | None") -> tuple[float, int]:
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
    from orthonav.ground.planning.spacing import profile

    bands_m = route.bands_m(options.band_m or 0.0) or ()
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
    from orthonav.ground.planning.spacing import estimate_map

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


def plan_text(plain: dict[str, Any]) -> str:
    lines = []
    if plain["route"] is not None:
        lines.append(_row("route", _route_text(plain["route"])))
    if plain["view"] is not None:
        lines += _view_lines(plain["view"])
    out = None if plain.get("out") == "-" else plain.get("out")
    lines += _map_lines(plain["map"], None if plain["route"] is None else out or "FILE")
    if plain["terrain"] is not None:
        lines += _leg_lines(plain["terrain"])
    for caution in plain["cautions"]:
        lines.append(_row("caution", caution["text"]))
    if "out" in plain:
        lines.append(_row("written", out or "to stdout"))
    return "\n".join(lines)


def _row(name: str, text: str) -> str:
    return f"{name:<9}{text}"


def _route_text(route: dict[str, Any]) -> str:
    name = f"{route['name']}, " if route["name"] else ""
    text = f"{name}{counted(route['waypoints'], 'waypoint')}, {route['length_m'] / 1000:.2f} km"
    if route["duration_s"] is not None:
        seconds = route["duration_s"]
        text += f", {seconds:.0f} s" if seconds < 300 else f", {seconds / 60:.0f} min"
    if route["heights_above"]:
        text += f", heights above {' and '.join(map(_reference, route['heights_above']))}"
    if route["legs_with_own_band"]:
        text += f", {counted(route['legs_with_own_band'], 'leg')} with a band of its own"
    if route["legs_with_own_band"] < max(1, route["waypoints"] - 1):
        text += f", search band {route['band_m']:.0f} m"
    return text


def _reference(name: str) -> str:
    return {"agl": "ground", "unknown": "an unknown reference"}.get(name, name)


def _view_lines(view: dict[str, Any]) -> list[str]:
    first = (
        f"{view['width_m']:.0f} x {view['height_m']:.0f} m from {view['agl_m']:.0f} m, "
        f"{view['gsd_m']:.3g} m per pixel, {view['across_px']:.0f} map pixels across"
    )
    second = f"overlapping views at most {view['spacing_m']:.0f} m apart"
    if view["rate_hz"] is not None:
        second += f": {view['rate_hz']:.2g} views per second"
    return [_row("view", first), _row("", second)]


def _map_lines(made: dict[str, Any], route: str | None) -> list[str]:
    low, high = made["map_mb"]
    size = f"{low:.1f} to {high:.1f} MB" if high - low > 0.05 else f"{high:.1f} MB"
    lines = [
        _row(
            "build",
            f"--gsd-m {made['gsd_m']:g} --tile-px {made['tile_px']} --overlap {made['overlap']:g}"
            f"{'' if made['registration'] else ' --no-registration'} "
            f"(a tile is {made['tile_m']:g} m wide)",
        ),
        _row(
            "map",
            f"{made['area_km2']:,.2f} km2, {made['tiles']:,} tiles, {size}, "
            f"built in about {made['build_minutes']:,.0f} min on one core; "
            f"imagery needed: {made['imagery_km2']:,.1f} km2",
        ),
    ]
    sheets = made["sheets"]
    if len(sheets) > 1:
        lines.append(
            _row("sheets", f"{len(sheets)}: a map holds one sheet; build one map per sheet")
        )
        if route == "FILE":
            lines.append(_row("", "write the sheets with --out FILE"))
        for sheet in sheets[:MAX_SHOWN]:
            where = f"--route {route}#{sheet['name']}"
            if route is None:
                where = f"--bounds={','.join(map(_degrees, sheet['bounds_deg']))}"
            lines.append(_row("", f"{where}  {sheet['area_km2']:,.0f} km2"))
        if len(sheets) > MAX_SHOWN:
            lines.append(_row("", f"and {len(sheets) - MAX_SHOWN} more (--json)"))
    return lines


def _leg_lines(legs: list[dict[str, Any]]) -> list[str]:
    lines = [_row("terrain", "leg  length m   ground m      above ground m  relief in a view")]
    for leg in legs[:MAX_SHOWN]:
        ground = "{:.0f}..{:.0f}".format(*leg["ground_m"])
        over = "{:.0f}..{:.0f}".format(*leg["agl_m"])
        text = f"{leg['leg']:>3}  {leg['length_m']:>8.0f}   {ground:<12}  {over:<14}"
        lines.append(_row("", f"{text}  {leg['relief']:.1%}"))
    if len(legs) > MAX_SHOWN:
        lines.append(_row("", f"and {len(legs) - MAX_SHOWN} more (--json)"))
    return lines


def _degrees(value: float) -> str:
    return f"{value:.6f}".rstrip("0").rstrip(".")
