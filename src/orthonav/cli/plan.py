"""`orthonav plan`: derive map requirements from a route, a camera and a height."""

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

from orthonav.cli.common import add_area, add_options, beside, camera_of, counted, print_result
from orthonav.cli.source import dem_of
from orthonav.core.errors import AreaError, UsageError
from orthonav.core.files import write_text
from orthonav.ground import planning

if TYPE_CHECKING:
    from orthonav.ground.imagery.terrain import Dem

EXAMPLE = "--route route.kml --agl-m 120"
EVERYDAY = (
    *("--route", "--bounds", "--band-m", "--camera", "--agl-m", "--speed-mps", "--dem"),
    *("--out", "--json"),
)


def add(parser: argparse.ArgumentParser) -> None:
    add_area(parser, required=True)
    add_options(parser, "--camera", "--speed-mps", "--gsd-m", "--tile-px", "--dem", "--dem-datum")
    add_options(parser, "--agl-m", help="height above ground (default: from the route)")
    add_options(parser, "--overlap", default=0.875)
    text = "write the route as GeoJSON, one line per sheet: build --route ROUTE.geojson#sheet-1"
    parser.add_argument("--out", type=Path, metavar="ROUTE.geojson", help=text)
    add_options(parser, "--json")


def run(options: argparse.Namespace) -> None:
    route = planning.read_route(options.route) if options.route else None
    if route is None and (options.band_m is not None or options.dem or options.out):
        raise UsageError("--band-m, --dem and --out need a route (--route)")
    if options.speed_mps is not None and not 0 < options.speed_mps < 10_000:
        raise UsageError(f"--speed-mps must be above 0, below 10,000; got {options.speed_mps:g}")
    dem = dem_of(options, route)
    view = _view(options, route, dem)
    gsd_m, tile_px = _map_of(options, view)
    cautions = [] if view is None else planning.view_cautions(view, gsd_m, tile_px)
    legs, sheets = [], []
    areas = [planning.Area.from_bounds(options.bounds)] if route is None else []
    if route is not None:
        if options.band_m is None:
            options.band_m = planning.default_band_m(0.0 if view is None else view.side_m)
        sheets = planning.sheets_of_route(route, options.band_m)
        areas = [planning.Area.from_route(sheet, options.band_m) for sheet in sheets]
    if route is not None and dem is not None:
        agl_m, view_m = (options.agl_m, 0.0) if view is None else (view.agl_m, view.short_m)
        bands_m = route.bands_m(options.band_m) or ()
        legs = planning.profile(route, bands_m, agl_m, view_m, dem)
        cautions += planning.terrain_cautions(legs)
    plain: dict[str, Any] = {
        "route": None if route is None else _route_plain(route, options),
        "view": None if view is None else _view_plain(view, gsd_m, options.speed_mps),
        "map": _map_plain(options, areas, sheets, gsd_m, tile_px),
        "terrain": None if dem is None else [vars(leg) for leg in legs],
        "cautions": [vars(each) for each in cautions],
    }
    if options.out is not None:
        write_text(options.out, planning.to_geojson(sheets))
        plain["out"] = str(options.out)
    with beside(options.out):
        print_result(options, plain, plan_text(plain))


def _view(
    options: argparse.Namespace, route: "planning.Route | None", dem: "Dem | None"
) -> "planning.ViewPlan | None":
    agl_m = options.agl_m
    if agl_m is None and route is not None:
        agl_m = min(planning.flown_agl_m(route, dem), default=None)
    if agl_m is None and options.camera is None:
        return None
    if agl_m is None:
        raise UsageError(
            "--camera needs a height above ground: give --agl-m, or a route with heights (above "
            "ground; with --dem also above the sea or above home)"
        )
    return planning.ViewPlan.of(camera_of(options), agl_m)


def _map_of(options: argparse.Namespace, view: "planning.ViewPlan | None") -> tuple[float, int]:
    if view is None and options.gsd_m is None:
        raise AreaError(
            "the ground resolution of the map is unknown; give --agl-m, a route with heights "
            "above ground, or --gsd-m"
        )
    if view is None:
        return options.gsd_m, 256 if options.tile_px is None else options.tile_px
    gsd_m, tile_px = planning.suited_map(view)
    if options.gsd_m is not None:
        gsd_m, tile_px = options.gsd_m, planning.suited_tile_px(view, options.gsd_m)
    return gsd_m, tile_px if options.tile_px is None else options.tile_px


def _route_plain(route: "planning.Route", options: argparse.Namespace) -> dict[str, Any]:
    length_m, speed_mps = float(planning.leg_lengths_m(route).sum()), options.speed_mps
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


def _view_plain(view: "planning.ViewPlan", gsd_m: float, speed_mps: float | None) -> dict[str, Any]:
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
    areas: "list[planning.Area]",
    sheets: "list[planning.Route]",
    gsd_m: float,
    tile_px: int,
) -> dict[str, Any]:
    sizes: dict[str, Any] = {"gsd_m": gsd_m, "tile_px": tile_px, "overlap": options.overlap}
    made = [planning.estimate_map(area, **sizes, maps=len(areas)) for area in areas]
    names = [sheet.name for sheet in sheets] or [None]
    bounds_deg = [round(x, 6) for x in options.bounds] if options.bounds else None
    return {
        **sizes,
        "tile_m": round(gsd_m * tile_px, 3),
        "area_km2": round(sum(each.area_km2 for each in made), 3),
        "imagery_km2": round(sum(each.imagery_km2 for each in made), 3),
        "tiles": sum(each.tiles for each in made),
        "map_mb": [round(sum(each.map_mb[i] for each in made), 2) for i in (0, 1)],
        "build_minutes": round(sum(each.build_s for each in made) / 60, 1),
        "sheets": [
            {
                "name": name,
                "bounds_deg": bounds_deg,
                "area_km2": round(each.area_km2, 3),
                "map_mb": [round(size, 2) for size in each.map_mb],
            }
            for name, each in zip(names, made, strict=True)
        ],
    }


def plan_text(plain: dict[str, Any]) -> str:
    """Lines of a name, empty where it is that of the line before, and a text."""
    rows = [] if plain["route"] is None else [("route", _route_text(plain["route"]))]
    if (view := plain["view"]) is not None:
        rows.append(
            (
                "view",
                f"{view['width_m']:.0f} x {view['height_m']:.0f} m from {view['agl_m']:.0f} m, "
                f"{view['gsd_m']:.3g} m per pixel, {view['across_px']:.0f} map pixels across",
            )
        )
        rate = "" if view["rate_hz"] is None else f": {view['rate_hz']:.2g} views per second"
        rows.append(("", f"overlapping views at most {view['spacing_m']:.0f} m apart{rate}"))
    rows += _map_rows(plain["map"], plain)
    if plain["terrain"] is not None:
        rows.append(("terrain", "leg  length m   ground m      above ground m  relief in a view"))
        rows += _some([_leg_text(leg) for leg in plain["terrain"]])
    rows += [("caution", caution["text"]) for caution in plain["cautions"]]
    if "out" in plain:
        rows.append(("written", "to stdout" if plain["out"] == "-" else plain["out"]))
    return "\n".join(f"{name:<9}{text}" for name, text in rows)


def _some(texts: list[str]) -> list[tuple[str, str]]:
    """At most 12 rows, and how many more there are."""
    more = [f"and {len(texts) - 12} more (--json)"] if len(texts) > 12 else []
    return [("", text) for text in (*texts[:12], *more)]


def _leg_text(leg: dict[str, Any]) -> str:
    ground = "{:.0f}..{:.0f}".format(*leg["ground_m"])
    over = "{:.0f}..{:.0f}".format(*leg["agl_m"])
    text = f"{leg['leg']:>3}  {leg['length_m']:>8.0f}   {ground:<12}  {over:<14}"
    return f"{text}  {leg['relief']:.1%}"


def _route_text(route: dict[str, Any]) -> str:
    parts = [route["name"]] if route["name"] else []
    parts += [counted(route["waypoints"], "waypoint"), f"{route['length_m'] / 1000:.2f} km"]
    if (seconds := route["duration_s"]) is not None:
        parts.append(f"{seconds:.0f} s" if seconds < 300 else f"{seconds / 60:.0f} min")
    if above := route["heights_above"]:
        names = {"agl": "ground", "unknown": "an unknown reference"}
        parts.append(f"heights above {' and '.join(names.get(name, name) for name in above)}")
    if own := route["legs_with_own_band"]:
        parts.append(f"{counted(own, 'leg')} with a band of its own")
    if own < max(1, route["waypoints"] - 1):
        parts.append(f"search band {route['band_m']:.0f} m")
    return ", ".join(parts)


def _map_rows(made: dict[str, Any], plain: dict[str, Any]) -> list[tuple[str, str]]:
    low, high = made["map_mb"]
    size = f"{low:.1f} to {high:.1f} MB" if high - low > 0.05 else f"{high:.1f} MB"
    rows = [
        (
            "build",
            f"--gsd-m {made['gsd_m']:g} --tile-px {made['tile_px']} --overlap {made['overlap']:g} "
            f"(a tile is {made['tile_m']:g} m wide)",
        ),
        (
            "map",
            f"{made['area_km2']:,.2f} km2, {made['tiles']:,} tiles, {size}, "
            f"built in about {made['build_minutes']:,.0f} min on one core; "
            f"imagery needed: {made['imagery_km2']:,.1f} km2",
        ),
    ]
    sheets = made["sheets"]
    if len(sheets) == 1:
        return rows
    rows.append(("sheets", f"{len(sheets)}: a map holds one sheet; build one map per sheet"))
    out = plain.get("out", "-")
    if out == "-":
        rows.append(("", "write the sheets with --out FILE"))
    file = "FILE" if out == "-" else out
    named = [f"--route {file}#{each['name']}  {each['area_km2']:,.0f} km2" for each in sheets]
    return rows + _some(named)
