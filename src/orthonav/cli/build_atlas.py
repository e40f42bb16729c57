"""`orthonav atlas build`: build the sheets of an atlas, on one machine or many."""

import argparse
import sys
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from orthonav.cli.build import add_recipe, recipe_of, reporter
from orthonav.cli.common import add_area, add_dem, add_orthos, print_json, progress

if TYPE_CHECKING:
    from orthonav.ground.atlas.cluster import TaskRunner

EVERYDAY = (
    *("--route", "--bounds", "--band-m", "--gsd-m", "--sheet-km"),
    *("--replace", "--cluster", "--workers", "--json"),
)
COARSE = ("gsd_m", "tile_px", "overlap")
SHOWN_FAILURES = 20


def add(parser: argparse.ArgumentParser) -> None:
    """Arguments of the action, in groups."""
    add_orthos(parser, "orthophoto (any georeferenced raster that GDAL reads)")
    parser.add_argument("--json", action="store_true", help="print the summary as JSON")
    area = parser.add_argument_group("area (default: all imagery)")
    add_area(area, area.add_mutually_exclusive_group())
    sheets = parser.add_argument_group("sheets (set by the first build of an atlas)")
    sheets.add_argument(
        "--sheet-km", type=float, metavar="KM", help="greatest width of a sheet (default 10)"
    )
    add_recipe(sheets)
    add_dem(sheets, "which gives sheets a terrain layer, and maps that are cut out of them")
    sheets.add_argument(
        "--replace", action="store_true", help="rebuild sheets that have other imagery or versions"
    )
    coarse = parser.add_argument_group("coarse tiles, for views without a prior")
    coarse.add_argument(
        "--coarse-gsd-m",
        type=float,
        help="ground resolution of coarse tiles, metres per pixel (default 8)",
    )
    coarse.add_argument("--coarse-tile-px", type=int, help="width of a coarse tile (default 128)")
    coarse.add_argument(
        "--coarse-overlap",
        type=float,
        metavar="FRACTION",
        help="overlap of neighbouring coarse tiles, as a fraction of their width (default 0.875)",
    )
    coarse.add_argument(
        "--no-coarse",
        dest="coarse",
        action="store_false",
        help="omit the coarse tiles, from which the search index is made",
    )
    coarse.add_argument(
        "--no-index",
        dest="index",
        action="store_false",
        help="do not update the search index at the end",
    )
    cluster = parser.add_argument_group("workers")
    cluster.add_argument(
        "--workers",
        type=int,
        metavar="N",
        help="number of parallel workers: sheets that are built at a time (default: 1; with "
        "--cluster one per core)",
    )
    cluster.add_argument(
        "--cluster",
        metavar="local|ADDRESS",
        help="build with Ray, on the cores of this machine (local) or on the cluster at HOST:PORT "
        "(default: one sheet after the other in this process)",
    )
    cluster.add_argument(
        "--cpu-hour-price",
        type=float,
        metavar="PRICE",
        help="price of a core for an hour: the summary then shows the cost of the sheets",
    )


def run(options: argparse.Namespace) -> int:
    """Build, print a summary; returns 1 where a sheet failed."""
    from orthonav.ground.atlas.build import AtlasRequest, build_atlas
    from orthonav.ground.planning.route import read_route

    request = AtlasRequest(
        url=options.atlas,
        orthos=options.ortho,
        recipe=_recipe(options),
        bounds_deg=options.bounds,
        route=read_route(options.route) if options.route else None,
        band_m=options.band_m,
        replace=options.replace,
        index=options.index,
        dem=options.dem,
        dem_datum=options.dem_datum,
    )
    try:
        with _runner(options) as runner, progress(options) as shown:
            result = build_atlas(request, runner, shown, reporter(options))
    except KeyboardInterrupt:
        print(
            "orthonav: error: interrupted; finished sheets are stored, rerun to resume",
            file=sys.stderr,
        )
        return 1
    plain = result.to_plain(options.cpu_hour_price)
    if options.json:
        print_json(plain)
    else:
        print(_text(plain))
    for line in _failures(plain):
        print(f"orthonav: error: {line}", file=sys.stderr)
    return 0 if result.is_complete else 1


def _recipe(options: argparse.Namespace) -> dict[str, Any]:
    """The fields of `AtlasRecipe` that were given."""
    from orthonav.core.errors import AtlasError

    given = recipe_of(options)
    if options.sheet_km is not None:
        given["sheet_km"] = options.sheet_km
    values = {name: getattr(options, f"coarse_{name}") for name in COARSE}
    coarse = {name: value for name, value in values.items() if value is not None}
    if coarse and not options.coarse:
        raise AtlasError("--no-coarse leaves out the coarse tiles: remove the other --coarse-..")
    if coarse or not options.coarse:
        given["coarse"] = coarse or None
    return given


def _runner(options: argparse.Namespace) -> "TaskRunner":
    from orthonav.ground.atlas.cluster import RayRunner, SerialRunner

    if options.cluster is None and options.workers in (None, 1):
        return SerialRunner()
    address = None if options.cluster in (None, "local") else options.cluster
    return RayRunner(address, options.workers)


def _text(plain: Mapping[str, Any]) -> str:
    """The summary for people."""
    lines = [
        f"atlas        {plain['atlas']}",
        f"sheets       {plain['built']} built, {plain['unchanged']} unchanged, "
        f"{plain['empty']} empty, {len(plain['failed'])} failed"
        + (f", {plain['untried']} not tried" * bool(plain["untried"])),
    ]
    if plain["built"]:
        lines += [
            f"area         {plain['area_km2']:.1f} km2 in {plain['tiles']:,} tiles",
            f"size         {plain['size_mb']:.1f} MB, {plain['mb_per_km2']:.2f} MB per km2",
            f"time         {plain['wall_s']:.0f} s: {plain['km2_per_hour']:,.0f} km2 per hour, "
            f"{plain['cpu_s_per_km2']:.2f} CPU s per km2",
            f"memory       {plain['peak_mb']:.0f} MB at most in a process",
        ]
        if "cost" in plain:
            lines.append(f"cost         {plain['cost']:.4g}, {plain['cost_per_km2']:.4g} per km2")
    return "\n".join(lines)


def _failures(plain: Mapping[str, Any]) -> list[str]:
    lines = [" ".join(f"sheet {x['sheet']}: {x['error']}".split()) for x in plain["failed"]]
    if len(lines) > SHOWN_FAILURES:
        more = f"and {len(lines) - SHOWN_FAILURES} more sheets, see --json"
        lines = [*lines[:SHOWN_FAILURES], more]
    if plain["finish_error"]:
        lines.append(f"snapshot and index could not be written: {plain['finish_error']}")
    return lines
